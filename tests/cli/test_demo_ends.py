"""The demo leaves nothing behind, however it is ended."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from .shell import clean_environment


@pytest.mark.link
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
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
