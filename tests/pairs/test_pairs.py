"""Cells of the pair bench at the gate: of each time, and of most changes and long runs.

`make pairs` runs all cells; bench.py says what it leaves out.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.pairs.cells import cell_named, run_cell
from tests.pairs.scene import Scenes

pytestmark = pytest.mark.link

CHOSEN = (
    "group delete before ncap run",
    "vault rewrap during provision --watch",
    "vault rewrap during signer run",
    "export-keys move during measure",
    "replace during measure",
    "restore before measure",
    "edit of the sheet during provision --batch",
    "whitelist add during provision --all",
    "registry remove after registry sync",
)
NCAP, MEASURE = "tests/ncap/", "tests/measure/"
HERE = "tests/pairs/test_pairs.py::test_a_change_beside_a_long_run_loses_nothing"
NIGHTLY = {
    "revoke during ncap run": f"{NCAP}test_newcomers.py::test_whom_a_person_revokes_leaves_and_the_others_stay",
    "vault passphrase during ncap run": f"{NCAP}test_changed_vault.py::"
    "test_a_new_passphrase_and_two_new_master_keys_do_not_lock_a_running_ncap",
    "agree --rotate during ncap run": f"{NCAP}test_newcomers_in_pairs.py::"
    "test_a_new_key_is_agreed_while_it_is_measured",
    "write --from during ncap run": f"{NCAP}test_newcomers.py::"
    "test_a_node_is_written_while_it_is_matched_and_no_other_is_affected",
    "provision during ncap run": f"{NCAP}test_written_while_measured.py::"
    "test_a_node_is_provisioned_while_it_is_measured_and_the_gap_is_reported",
    "trust remove during ncap run": f"{NCAP}test_decided_today.py::"
    "test_ncap_releases_the_node_moves_it_no_more_and_marks_its_recording[trust removed-uuids]",
    "decommission during ncap run": f"{NCAP}test_decided_today.py::"
    "test_a_node_that_was_taken_out_of_service_is_not_tried_for_ever_by_a_frozen_measurement",
    "group remove during ncap run": f"{NCAP}test_newcomers.py::"
    "test_an_expression_on_a_running_station_takes_in_whom_it_means",
    "group add during measure": f"{MEASURE}test_carried_on.py::"
    "test_a_group_that_was_killed_is_carried_on_by_the_same_command",
    "whitelist remove during measure": f"{MEASURE}test_carried_on.py::"
    "test_a_node_that_is_taken_off_the_whitelist_is_measured_and_moved_no_more[measure]",
    "import-keys during provision --batch": f"{HERE}[edit of the sheet during provision --batch]",
    "backup during provision --watch": f"{HERE}[vault rewrap during provision --watch]",
    "registry add during signer run": f"{HERE}[vault rewrap during signer run]",
    "job new during signer run": f"{HERE}[vault rewrap during signer run]",
    "job close after signer run": f"tests/plant/test_jobs.py::test_a_closed_job_is_refused; {HERE}"
    "[vault rewrap during signer run]",
}
"""Cells left out of the gate, and the test there that has the same two commands in it, or the same long run.

What is left of those of the last kind is the store's lock and transactions, which the change of the cell that stays
takes as well.
"""


@pytest.fixture(scope="module")
def scenes() -> Iterator[Scenes]:
    with Scenes.open() as made:
        yield made


@pytest.mark.parametrize(
    "name",
    [*CHOSEN, *(pytest.param(name, marks=pytest.mark.nightly(held)) for name, held in NIGHTLY.items())],
)
def test_a_change_beside_a_long_run_loses_nothing(scenes: Scenes, name: str) -> None:
    assert run_cell(scenes, cell_named(name), punctual=False).complaints == ()
