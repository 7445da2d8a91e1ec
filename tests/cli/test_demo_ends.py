"""The demo runs to its end in a process of its own, and leaves nothing behind, however it is ended."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from .shell import clean_environment


@pytest.mark.link
def test_the_whole_story_as_make_demo_starts_it(tmp_path: Path) -> None:
    """Start an interpreter: what the demo loads late, by name, is loaded by no process that forks."""
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", "--json", "demo"],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
        env=clean_environment(TMPDIR=str(tmp_path)),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads(done.stdout)
    assert record["verdict"] == "authentic"
    assert {"import-keys", "verify", "measure", "set"} <= {step["name"] for step in record["steps"]}
    assert list(tmp_path.iterdir()) == []


OTHER_SIGNAL = pytest.mark.nightly(
    "tests/cli/test_demo_ends.py::test_an_ended_demo_takes_its_node_and_its_folder_away[15] ends by the same way"
)


@pytest.mark.link
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=OTHER_SIGNAL)])
def test_an_ended_demo_takes_its_node_and_its_folder_away(tmp_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "teds_provision", "demo"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=clean_environment(TMPDIR=str(tmp_path)),
    )
    try:
        until = time.monotonic() + 60
        while not list(tmp_path.glob("*/node-flash/lock")):  # the node runs
            assert time.monotonic() < until
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        process.communicate(timeout=60)  # ends only when the node, which has the same stdout or none, lets go
    finally:
        process.kill()
    assert process.returncode == 130
    assert list(tmp_path.iterdir()) == []
