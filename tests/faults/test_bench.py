"""A minute's worth of the fault bench; `make faults` takes an hour, `make faults FULL=1` all of it."""

from __future__ import annotations

import shutil

import pytest

from tests.faults.bench import main

pytestmark = [
    pytest.mark.system,
    pytest.mark.link,
    pytest.mark.timeout(600),
    pytest.mark.skipif(shutil.which("cc") is None, reason="a C compiler is missing"),
]


def test_a_cut_or_a_failing_disk_loses_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    acts = ("agree", "provision", "rotate", "move", "receipt")
    code = main(["--quick", "--jobs", "3", *(word for act in acts for word in ("--only", act))])
    told = capsys.readouterr().out
    assert code == 0, told
    assert "lost 0" in told
