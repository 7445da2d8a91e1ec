"""The model of a key's life: its rules hold, and each rule that is broken is noticed (model/README.md)."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECK = Path(__file__).parent.parent / "model" / "check.py"


@pytest.mark.system
@pytest.mark.timeout(600)
@pytest.mark.skipif(shutil.which("spin") is None or shutil.which("cc") is None, reason="spin or a C compiler missing")
@pytest.mark.parametrize(
    "how",
    [
        "--quicker",
        pytest.param(
            "--quick",
            marks=pytest.mark.nightly(
                "tests/test_model.py::test_the_rules_hold_and_each_broken_rule_is_found[--quicker]: the same rules,"
                " and one broken rule of each kind is found, LIFTED by"
                " tests/model/test_replay.py::test_the_code_refuses_what_breaks_the_model;"
                " who changes a model runs make model"
            ),
        ),
    ],
)
def test_the_rules_hold_and_each_broken_rule_is_found(how: str) -> None:
    done = subprocess.run([sys.executable, str(CHECK), how], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"without rule {'EPOCH_BACK' if how == '--quicker' else 'LIFTED'}" in done.stdout
    assert "WRONG" not in done.stdout
