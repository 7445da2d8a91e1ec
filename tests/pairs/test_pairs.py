"""Cells of the pair bench at the gate: each change, each long run, each time.

`make pairs` runs all cells; bench.py says what it leaves out.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.pairs.cells import cell_named, run_cell
from tests.pairs.scene import Scenes

pytestmark = pytest.mark.link

CHOSEN = (
    "revoke during ncap run",
    "decommission during ncap run",
    "group remove during ncap run",
    "group add during measure",
    "group delete before ncap run",
    "whitelist remove during measure",
    "vault passphrase during ncap run",
    "vault rewrap during provision --watch",
    "vault rewrap during signer run",
    "agree --rotate during ncap run",
    "write --from during ncap run",
    "provision during ncap run",
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


@pytest.fixture(scope="module")
def scenes() -> Iterator[Scenes]:
    with Scenes.open() as made:
        yield made


@pytest.mark.parametrize("name", CHOSEN)
def test_a_change_beside_a_long_run_loses_nothing(scenes: Scenes, name: str) -> None:
    assert run_cell(scenes, cell_named(name), punctual=False).complaints == ()
