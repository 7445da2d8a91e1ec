"""The Python of the virtual environment: the usual one, unless that of the system is faster by far."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.cli.shell import ROOT

SYSTEM = "/usr/bin/python3"


def chosen(folder: Path, prints: str) -> str:
    """Return the choice beside a python3 that takes so many microseconds; "": it is not fit."""
    usual = folder / "python3"
    usual.write_text(f"#!/bin/sh\n{f'echo {prints}' if prints else 'exit 1'}\n")
    usual.chmod(0o755)
    environment = os.environ | {"PATH": f"{folder}:/usr/bin:/bin"}
    words = [ROOT / "scripts" / "choose-python"]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_the_usual_python_is_taken_if_it_is_as_fast(tmp_path: Path) -> None:
    assert chosen(tmp_path, "1") == "python3"


@pytest.mark.skipif(not os.access(SYSTEM, os.X_OK), reason="this system has no Python of its own")
@pytest.mark.parametrize("usual", ["999999999", ""], ids=["slow", "not fit"])
def test_the_python_of_the_system_is_taken_if_it_is_faster_by_far(tmp_path: Path, usual: str) -> None:
    fit = "import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))"
    if subprocess.run([SYSTEM, "-c", fit], stderr=subprocess.DEVNULL, check=False).returncode:
        pytest.skip("the Python of this system makes no environment for the program")
    assert chosen(tmp_path, usual) == SYSTEM
