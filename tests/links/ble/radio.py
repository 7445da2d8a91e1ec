"""The air of a test: a private D-Bus with a stand-in for bluetoothd, and nodes, in processes of their own."""

from __future__ import annotations

import atexit
import functools
import json
import os
import shutil
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import pytest

from tests.zygote import FIRST_FD, ForkedProcess, Zygote

ROOT = Path(__file__).resolve().parents[3]
CONFIG = """<!DOCTYPE busconfig PUBLIC "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>system</type><listen>unix:path={path}</listen><auth>EXTERNAL</auth><policy context="default">
<allow send_destination="*" eavesdrop="true"/><allow eavesdrop="true"/><allow own="*"/></policy></busconfig>"""

needs_dbus = pytest.mark.skipif(shutil.which("dbus-daemon") is None, reason="dbus-daemon is not installed")
"""For tests that need the private bus."""


AIR = "tests.links.ble.air"


@dataclass
class AirProcess(ForkedProcess):
    """The air as a fork of one that has imported bumble: its two ends."""

    stdin: TextIO
    stdout: TextIO


@functools.cache
def _zygote() -> Zygote:
    made = Zygote(os.environ | {"PYTHONPATH": str(ROOT)}, module=AIR)
    atexit.register(made.close)
    return made


class Radio:
    """Air, bus and nodes; everything ends by :meth:`close`, by its id."""

    def __init__(
        self,
        folder: Path,
        nodes: list[Path] | None = None,
        *,
        manners: dict[str, Any] | None = None,
        hci: list[int] | None = None,
        stranger_seconds: float = 10.0,
        in_c: bool = False,
    ) -> None:
        self.path = folder / "bus"
        self._processes: list[subprocess.Popen[str] | AirProcess] = []
        config = folder / "bus.conf"
        config.write_text(CONFIG.format(path=self.path))
        daemon = self._start(["dbus-daemon", f"--config-file={config}", "--nofork", "--nopidfile", "--print-address"])
        assert daemon.stdout is not None
        daemon.stdout.readline()
        self._air = self._start_air()
        self._lock = threading.Lock()
        self.addresses: list[str] = self._say(
            {
                "nodes": [str(node) for node in nodes or []],
                "bus": self.address,
                "manners": manners or {},
                "hci": hci or [],
                "stranger_seconds": stranger_seconds,
                "in_c": in_c,
            }
        )["nodes"]

    @property
    def address(self) -> str:
        """What DBUS_SYSTEM_BUS_ADDRESS must say."""
        return f"unix:path={self.path}"

    def do(self, *words: Any) -> Any:
        """Have the air do something; see air.BleScene.do."""
        answer = self._say(list(words))
        assert "error" not in answer, answer
        return answer["result"]

    def close(self) -> None:
        """End everything."""
        for process in reversed(self._processes):
            with suppress(OSError):
                if process.stdin is not None:
                    process.stdin.close()
            try:
                process.wait(5 if process is self._air else 0.1)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(60)
            if process.stdout is not None:
                process.stdout.close()

    def _say(self, words: Any) -> Any:
        assert self._air.stdin is not None
        assert self._air.stdout is not None
        with self._lock:
            self._air.stdin.write(json.dumps(words) + "\n")
            self._air.stdin.flush()
            line = self._air.stdout.readline()
        assert line, f"the air ended with {self._air.poll()}"
        return json.loads(line)

    def _start_air(self) -> subprocess.Popen[str] | AirProcess:
        if "COVERAGE_PROCESS_START" in os.environ or "COVERAGE_PROCESS_CONFIG" in os.environ:
            return self._start([sys.executable, "-m", AIR])
        (asked, ask), (answers, answered) = os.pipe(), os.pipe()
        try:
            forked = _zygote().run(AIR, [str(FIRST_FD)], dict(os.environ), out=answered, err=2, given=(asked,))
        finally:
            os.close(asked)
            os.close(answered)
        process = AirProcess(forked.pid, forked.status, os.fdopen(ask, "w"), os.fdopen(answers))
        self._processes.append(process)
        return process

    def _start(self, words: list[str]) -> subprocess.Popen[str]:
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        quiet = subprocess.DEVNULL if words[0] == "dbus-daemon" else None  # it warns that it may not open 65536 files
        process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=quiet, text=True, env=environment, cwd=ROOT
        )
        self._processes.append(process)
        return process
