"""Stations of one owner under one CA: they verify each other's datasheets and rekey each other's nodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.errors import BadData, NotAuthentic, NotFound, PolicyRefused
from teds_provision.handover import certify as fleet
from teds_provision.handover.certify import (
    adopt_certificate,
    ask_for_certificate,
    read_certificate,
    read_request,
    sign_request,
    write_certificate,
)
from teds_provision.handover.export_keys import export_keys, plan_export
from teds_provision.handover.import_keys import ImportPlan, import_keys, plan_import
from teds_provision.handover.selection import ExportOrder
from teds_provision.handover.trust import add, candidate
from teds_provision.station.station import Station, initialise
from teds_provision.steps.agree import agree
from teds_provision.steps.identify import identify
from teds_provision.steps.verify import Verified, verify_image
from teds_provision.store import WhitelistEntry
from teds_provision.teds.image import Image
from teds_provision.vault import forget_vaults, passphrase
from tests.bench import PASSPHRASE, Board, make_station, talk
from tests.handover.desk import provisioned, session, trust


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


@pytest.fixture(autouse=True)
def cheap(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("teds_provision.vault.choose.PRODUCT", passphrase.THROWAWAY)
    monkeypatch.setattr("teds_provision.vault.file_vault.PRODUCT", passphrase.THROWAWAY)
    yield
    forget_vaults()


def request(home: Path, name: str) -> bytes:
    return ask_for_certificate(home, name=name, keystore="file", ask=ask)


def member(home: Path, name: str, owner: Station) -> Station:
    """A station without a CA of its own, certified by ``owner``."""
    certificate = sign_request(owner, read_request(request(home, name)))
    return adopt_certificate(home, read_certificate(write_certificate(certificate)), ask=ask)


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "owner", "owner")
    yield made
    made.close()


@pytest.fixture
def pair(tmp_path: Path, owner: Station) -> Iterator[tuple[Station, Station]]:
    made = member(tmp_path / "east", "east", owner), member(tmp_path / "west", "west", owner)
    yield made
    for station in made:
        station.close()


def test_a_certified_station_has_the_owners_ca_and_no_ca_key(pair: tuple[Station, Station], owner: Station) -> None:
    for station in pair:
        assert station.ca == owner.ca
        assert station.vault.ca() is None
        with pytest.raises(NotFound):
            station.identity.certify(owner.point)


def test_until_it_is_certified_a_station_does_nothing(tmp_path: Path) -> None:
    home = tmp_path / "east"
    first = request(home, "east")
    assert read_request(request(home, "other name")) == read_request(first)
    with pytest.raises(NotFound, match="waits for the certificate"):
        Station.open(home, ask=ask)
    with pytest.raises(NotFound, match="waits for the certificate"):
        initialise(home, name=None, keystore="file", ask=ask)


@pytest.mark.parametrize("direction", [1, -1])
def test_they_verify_each_others_datasheets(pair: tuple[Station, Station], direction: int) -> None:
    one, other = pair[::direction]
    board = Board()
    done = provisioned(one, board)
    image = Image(board.uuid, done.image.blocks)
    assert Verified(board.uuid, tuple(verify_image(other, image))).verdict == "authentic"


@pytest.mark.parametrize("direction", [1, -1])
def test_they_rekey_each_others_nodes_by_tap(pair: tuple[Station, Station], direction: int) -> None:
    one, other = pair[::direction]
    board = Board()
    provisioned(one, board)
    other.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        assert agree(other, node, identify(other, node)).epoch == 2
    assert board.state.ca == one.ca
    assert provisioned(other, board).verified.verdict == "authentic"


@pytest.mark.parametrize("direction", [1, -1])
def test_they_hand_over_once_they_have_each_others_certificate(
    pair: tuple[Station, Station], owner: Station, tmp_path: Path, direction: int
) -> None:
    one, other = pair[::direction]
    board = Board()
    provisioned(one, board)
    trust(one, other)
    trust(other, one)
    order = ExportOrder((other.name,), None, "move")
    with pytest.raises(PolicyRefused, match="not certified by the CA"):
        plan_export(one, order)
    path = tmp_path / "other.cert"
    known = sign_request(owner, read_request(fleet.make_request(other.name, other.vault.identity())))
    path.write_bytes(write_certificate(known))
    add(one, [candidate(one, other.name, path, "station")])
    bundle = tmp_path / "bundle.jwe"
    export_keys(one, plan_export(one, order), bundle)
    plan = plan_import(other, bundle.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert plan.ca_is_known
    import_keys(other, plan)
    assert session(other, board) == 2


def test_a_stranger_verifies_nothing_of_theirs(pair: tuple[Station, Station], tmp_path: Path) -> None:
    board = Board()
    done = provisioned(pair[0], board)
    stranger = make_station(tmp_path / "stranger", "stranger")
    verified = Verified(board.uuid, tuple(verify_image(stranger, Image(board.uuid, done.image.blocks))))
    assert verified.verdict == "not authentic"
    stranger.close()


def test_signing_a_request_again_gives_the_same_certificate(tmp_path: Path, owner: Station) -> None:
    asked = read_request(request(tmp_path / "east", "east"))
    first = sign_request(owner, asked)
    owner.vault.drop_ca()  # type: ignore[attr-defined]
    assert sign_request(owner, asked) == first
    with pytest.raises(NotFound, match="CA key is not in this vault"):
        sign_request(owner, read_request(request(tmp_path / "west", "west")))


def test_a_request_proves_that_its_station_holds_the_key(tmp_path: Path) -> None:
    asked = request(tmp_path / "east", "east")
    with pytest.raises(NotAuthentic):
        read_request(asked.replace(b'"east"', b'"evil"'))
    for bad in (b"", b"{}", b"[1]", asked[:-20], b"-----BEGIN PRIVATE KEY-----", asked.replace(b"P-256", b"P-384")):
        with pytest.raises(BadData):
            read_request(bad)


def test_a_certificate_is_for_one_station(tmp_path: Path, owner: Station) -> None:
    certificate = sign_request(owner, read_request(request(tmp_path / "east", "east")))
    request(tmp_path / "west", "west")
    with pytest.raises(PolicyRefused, match="is for station"):
        adopt_certificate(tmp_path / "west", certificate, ask=ask)
    with pytest.raises(NotFound):
        adopt_certificate(tmp_path / "nowhere", certificate, ask=ask)
    with pytest.raises(NotAuthentic):
        read_certificate(forged())


def forged() -> bytes:
    from teds_provision.handover.certify import Certificate
    from teds_provision.protocol.keys import SoftwareKey

    station, stranger = SoftwareKey(31), SoftwareKey(32)
    return write_certificate(Certificate("x", station.point, stranger.point, station.sign(b"no")))


def test_adopting_again_changes_nothing(tmp_path: Path, owner: Station) -> None:
    home = tmp_path / "east"
    certificate = sign_request(owner, read_request(request(home, "east")))
    for _ in range(2):
        station = adopt_certificate(home, certificate, ask=ask)
        assert (station.ca, station.name) == (owner.ca, "east")
        station.close()


def test_a_station_with_a_ca_of_its_own_joins_for_the_nodes_of_another(tmp_path: Path, owner: Station) -> None:
    home = tmp_path / "east"
    make_station(home, "east").close()
    certificate = sign_request(owner, read_request(request(home, "east")))
    station = adopt_certificate(home, certificate, ask=ask)
    assert station.ca != owner.ca
    assert station.identity.signature_under(owner.ca) == certificate.signature
    station.close()


def test_the_ca_key_is_kept_away_and_brought_back(tmp_path: Path, owner: Station) -> None:
    path = tmp_path / "ca.pem"
    fleet.export_ca(owner, owner.vault, path, "a long enough passphrase")
    assert fleet.drop_ca(owner)
    assert not fleet.drop_ca(owner)
    with pytest.raises(PolicyRefused, match="is not in this vault"):
        fleet.require_ca(owner)
    fleet.import_ca(owner, owner.vault, path, "a long enough passphrase")
    assert fleet.require_ca(owner).point == owner.ca
    other = make_station(tmp_path / "other", "other")
    with pytest.raises(PolicyRefused, match="another CA key"):
        fleet.import_ca(other, other.vault, path, "a long enough passphrase")
    other.close()
