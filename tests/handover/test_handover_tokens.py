"""A handover between stations whose keys never leave their tokens: SoftHSM on both sides."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.handover import trust as fleet
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.life import revoke
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.handover.pending import close
from teds_provision.station.station import Station, initialise
from teds_provision.vault.selection import forget_vaults
from tests.handover.desk import boards, held, key_up, provisioned, session, trust
from tests.vault.softhsm import PIN, loaded, unload

pytestmark = pytest.mark.system


def ask(prompt: str, confirm: bool) -> str:
    return PIN


@pytest.fixture(scope="module")
def uris(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with pytest.MonkeyPatch.context() as patch:
        yield loaded(tmp_path_factory.mktemp("hsm"), patch, ("north", "south", "east"))
        forget_vaults()
        unload()


def test_copy_move_receipt_and_revocation_with_keys_in_tokens(uris: dict[str, str], tmp_path: Path) -> None:
    stations: dict[str, Station] = {}
    for name in ("north", "south"):
        stations[name] = initialise(tmp_path / name, name=name, keystore=uris[name], ask=ask)[0]
    north, south = stations["north"], stations["south"]
    trust(north, south)
    trust(south, north)
    first, other, lost = boards(3)
    for board in (first, other, lost):
        key_up(north, board)
    revoke(north, lost.uuid, "lost")
    for mode, board in (("copy", first), ("move", other)):
        bundle = tmp_path / f"{mode}.jwe"
        order = ExportOrder(("south",), (board.uuid,), mode)  # type: ignore[arg-type]
        export_bundle(north, plan_export(north, order), bundle)
        plan = plan_import(south, bundle.read_bytes())
        assert isinstance(plan, ImportPlan)
        taken = import_bundle(south, plan)
        assert session(south, board) == (2 if mode == "move" else 1)
        assert close(north, taken.receipt).fresh
    assert session(north, first) == 1
    assert held(north, other) == []
    # north's ban travels with the bundles, and counts nowhere but over nodes that north gave (issue 7, L2)
    assert [entry.why for entry in north.policy.revocations()] == ["lost"]
    assert south.policy.revocations() == []
    assert provisioned(south, first).verified.verdict == "authentic"
    for station in stations.values():
        station.close()


def test_a_token_station_without_its_own_ca_key(uris: dict[str, str], tmp_path: Path) -> None:
    home = tmp_path / "east"
    asked = fleet.ask_for_certificate(home, name="east", keystore=uris["east"], ask=ask)
    owner = initialise(tmp_path / "owner", name="owner", keystore=uris["north"], ask=ask)[0]
    certificate = fleet.sign_request(owner, fleet.read_request(asked))
    station = fleet.adopt_certificate(home, certificate, ask=ask)
    assert station.ca == owner.ca
    assert station.vault.ca() is None
    (board,) = boards(1)
    assert provisioned(station, board).verified.verdict == "authentic"
    assert board.state.ca == owner.ca
    station.close()
    owner.close()
