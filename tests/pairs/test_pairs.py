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
    "decommission during ncap run",
    "group remove during ncap run",
    "group add during measure",
    "group delete before ncap run",
    "whitelist remove during measure",
    "vault rewrap during provision --watch",
    "vault rewrap during signer run",
    "trust remove during ncap run",
    "export-keys move during measure",
    "replace during measure",
    "import-keys during provision --batch",
    "backup during provision --watch",
    "restore before measure",
    "edit of the sheet during provision --batch",
    "whitelist add during provision --all",
    "registry add during signer run",
    "registry remove after registry sync",
    "job close after signer run",
    "job new during signer run",
)
NIGHTLY = {
    "revoke during ncap run": "test_newcomers.py::test_whom_a_person_revokes_leaves_and_the_others_stay",
    "vault passphrase during ncap run": "test_changed_vault.py::"
    "test_a_new_passphrase_and_two_new_master_keys_do_not_lock_a_running_ncap",
    "agree --rotate during ncap run": "test_newcomers_in_pairs.py::test_a_new_key_is_agreed_while_it_is_measured",
    "write --from during ncap run": "test_newcomers.py::"
    "test_a_node_is_written_while_it_is_matched_and_no_other_is_affected",
    "provision during ncap run": "test_written_while_measured.py::"
    "test_a_node_is_provisioned_while_it_is_measured_and_the_gap_is_reported",
}
"""Cells left out of the gate, and the test of the service that has the same two commands in it."""


@pytest.fixture(scope="module")
def scenes() -> Iterator[Scenes]:
    with Scenes.open() as made:
        yield made


@pytest.mark.parametrize(
    "name",
    [*CHOSEN, *(pytest.param(name, marks=pytest.mark.nightly(f"tests/ncap/{held}")) for name, held in NIGHTLY.items())],
)
def test_a_change_beside_a_long_run_loses_nothing(scenes: Scenes, name: str) -> None:
    assert run_cell(scenes, cell_named(name), punctual=False).complaints == ()
