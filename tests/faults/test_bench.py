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


@pytest.mark.parametrize(
    "acts",
    [
        ("provision", "receipt"),
        pytest.param(
            ("agree", "rotate"),
            marks=pytest.mark.nightly(
                "tests/faults/test_bench.py::test_a_cut_or_a_failing_disk_loses_nothing[provision receipt] agrees on a "
                "key as well; tests/provisioning/test_agree.py::test_a_cut_rotation_leaves_a_working_key"
            ),
        ),
        pytest.param(
            ("move",),
            marks=pytest.mark.nightly(
                "tests/handover/test_handover_cut.py::test_an_export_cut_at_every_write,"
                " tests/handover/test_move.py::test_a_first_contact_cut_anywhere_is_carried_on"
            ),
        ),
    ],
    ids=" ".join,
)
def test_a_cut_or_a_failing_disk_loses_nothing(capsys: pytest.CaptureFixture[str], acts: tuple[str, ...]) -> None:
    code = main(["--quick", "--jobs", "3", *(word for act in acts for word in ("--only", act))])
    output = capsys.readouterr().out
    assert code == 0, output
    assert "lost 0" in output
