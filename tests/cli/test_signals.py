"""A signal may come at any instant of a command, also while it holds the lock of what it waits for."""

from __future__ import annotations

import ast
import subprocess
import sys

from teds_provision.provisioning.meeting import IdleStop
from tests.test_architecture import MODULES

INTERRUPTED = """
import signal, sys
from teds_provision.cli.measure.sample import ending
from teds_provision.provisioning.meeting import IdleStop
stop = IdleStop(None)
with ending(stop):
    with stop._cond:  # as for some microseconds in each wait
        signal.raise_signal(signal.SIGTERM)
    print(stop.wait(5), stop.is_set(), stop.ran_out)
"""


def test_a_command_that_is_about_to_wait_hears_its_signal() -> None:
    done = subprocess.run([sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout) == (0, "True True False\n"), done.stderr


def test_a_wait_that_was_told_to_stop_did_not_run_out() -> None:
    """A batch says which of both ended it, also if the time is over by then."""
    stop = IdleStop(0.0)
    assert (stop.is_set(), stop.ran_out, stop.is_asked) == (True, True, False)
    stop.request_stop()
    assert (stop.is_set(), stop.ran_out, stop.is_asked) == (True, False, True)


def test_no_signal_handler_takes_a_lock() -> None:
    """``Event.set`` in a handler waits for ever for the lock that the interrupted thread holds.

    ``IdleStop.request_stop``.
    """
    found, setting = [], [module for module in MODULES if "signal.signal" in module.read_text()]
    assert setting
    for module in setting:
        tree = ast.parse(module.read_text())
        functions = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "signal.signal":
                handler = call.args[1]
                body = functions.get(handler.id, handler) if isinstance(handler, ast.Name) else handler
                taken = {ast.unparse(node.func) for node in ast.walk(body) if isinstance(node, ast.Call)}
                found += [f"{module.name}:{call.lineno}: {name}" for name in taken if name.endswith(".set")]
    assert found == []
