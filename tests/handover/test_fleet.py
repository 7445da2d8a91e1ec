"""Stations of one owner under one CA: they verify each other's datasheets and rekey each other's nodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    VaultError,
)
from teds_provision.handover import trust as fleet
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.handover.trust import (
    add,
    adopt_certificate,
    ask_for_certificate,
    candidate,
    read_certificate,
    read_request,
    sign_request,
    write_certificate,
)
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.sign import SignOrder, sign_image
from teds_provision.provisioning.verify import verify_image
from teds_provision.provisioning.verify_node import verify_at_node
from teds_provision.provisioning.write import write
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image
from teds_provision.vault.base import Ask
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, Board, MemoryLink, make_station, talk
from tests.handover.desk import provisioned, session, trust


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


@pytest.fixture(autouse=True)
def vaults_forgotten() -> Iterator[None]:
    yield
    forget_vaults()


def request(home: Path, name: str) -> bytes:
    return ask_for_certificate(home, name=name, keystore="file", ask=ask)


def member(home: Path, name: str, owner: Station) -> Station:
    """Return a station without a CA of its own, certified by ``owner``."""
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
        with pytest.raises(NotFoundError):
            station.identity.certify(owner.point)


def test_until_it_is_certified_a_station_does_nothing(tmp_path: Path) -> None:
    home = tmp_path / "east"
    first = request(home, "east")
    assert read_request(request(home, "other name")) == read_request(first)
    with pytest.raises(NotFoundError, match="waiting for its CA's certificate"):
        Station.open(home, ask=ask)
    with pytest.raises(NotFoundError, match="waiting for its CA's certificate"):
        initialise(home, name=None, keystore="file", ask=ask)


@pytest.mark.parametrize("direction", [1, -1])
def test_they_verify_each_others_datasheets(pair: tuple[Station, Station], direction: int) -> None:
    first, other = pair[::direction]
    board = Board()
    done = provisioned(first, board)
    image = Image(board.uuid, done.image.blocks)
    assert Verification(board.uuid, tuple(verify_image(other, image))).verdict == "authentic"


@pytest.mark.parametrize("direction", [1, -1])
def test_they_rekey_each_others_nodes_by_tap_if_a_person_confirms(
    pair: tuple[Station, Station], direction: int
) -> None:
    """Figure 5 of the paper: whoever holds the present key is locked out, so that somebody is asked before."""
    first, other = pair[::direction]
    board = Board()
    provisioned(first, board)
    other.pins.put(WhitelistEntry(board.uuid))
    before, asked = board.state, list[str]()
    with talk(board) as node, pytest.raises(PolicyError, match="lock out the current holder"):
        agree(other, node, identify(other, node))

    def no(question: str, _refusal: PolicyError) -> None:
        raise PolicyError("You said no.")

    for rotate in (False, True):
        with talk(board) as node, pytest.raises(PolicyError, match="You said no"):
            agree(other, node, identify(other, node), rotate=rotate, take_over=no)
    with pytest.raises(PolicyError, match="lock out the current holder"):
        provisioned(other, board)
    assert (board.state, other.keys.held(board.uuid)) == (before, False)
    with talk(board) as node:
        assert (
            agree(other, node, identify(other, node), take_over=lambda question, _refusal: asked.append(question)).epoch
            == 2
        )
    assert len(asked) == 1
    assert board.state.ca == first.ca
    assert provisioned(other, board).verified.verdict == "authentic"


def test_a_node_that_calls_itself_new_and_shows_a_signed_datasheet_is_not_taken_over(
    pair: tuple[Station, Station],
) -> None:
    first, other = pair
    board = Board()
    provisioned(first, board)
    other.pins.put(WhitelistEntry(board.uuid))
    before = board.state
    with talk(board) as node:
        who = replace(identify(other, node), state=NodeState.FACTORY)  # Identify is a hint: anyone may have sent it
        with pytest.raises(PolicyError, match="lock out the current holder"):
            agree(other, node, who)
    assert (board.state, other.keys.held(board.uuid)) == (before, False)


def test_who_is_asked_once_is_not_asked_again_when_the_link_fails(pair: tuple[Station, Station]) -> None:
    first, other = pair
    board, asked = Board(), list[str]()
    provisioned(first, board)
    other.pins.put(WhitelistEntry(board.uuid))
    with talk(board, ForgetfulLink(board)) as node:
        who = identify(other, node)
        monkey = node.is_alive
        node.is_alive = lambda: True  # type: ignore[method-assign]
        assert agree(other, node, who, take_over=lambda question, _refusal: asked.append(question)).epoch == 2
        node.is_alive = monkey  # type: ignore[method-assign]
    assert len(asked) == 1


def test_the_station_that_was_locked_out_is_told_of_a_tap_elsewhere_and_then_who_signs(
    pair: tuple[Station, Station],
) -> None:
    first, other = pair
    board = Board()
    provisioned(first, board)
    other.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        agree(other, node, identify(other, node), rotate=True)
    for words in (
        "epoch 2, after 1 here: keyed elsewhere by tap or rotated by another holder",
        "which station did so will show once it signs",
    ):
        with pytest.raises(PolicyError, match=words):
            session(first, board)
        assert words in why_unproven(first, board)
    assert provisioned(other, board).verified.verdict == "authentic"
    signed = f"signed by station {other.fingerprint[:16]}, which your CA certified"
    with pytest.raises(PolicyError, match=signed):
        session(first, board)
    trust(first, other)
    with pytest.raises(PolicyError, match=f"signed by west \\({other.fingerprint[:16]}\\)") as caught:
        session(first, board)
    assert "attack" not in caught.value.message + (caught.value.hint or "")
    assert "proves nothing" not in caught.value.message
    assert [record.epoch for record in first.keys.keys_of(board.uuid)] == [1], "a hint changes no key"


def why_unproven(station: Station, board: Board) -> str:
    with talk(board) as node:
        verified = verify_at_node(station, node, identify(station, node)).verified
    assert verified.verdict == "unproven"
    return next(check.why for check in verified.checks if check.name == "session")


class ForgetfulLink(MemoryLink):
    """A link that loses the first reply to Request."""

    lost = False

    def exchange(self, frame: bytes) -> bytes:
        reply = super().exchange(frame)
        if frame[2:4] == bytes([128, 1]) and not self.lost:
            self.lost = True
            raise NodeSilentError("The reply was lost.")
        return reply


def test_an_image_that_was_built_elsewhere_is_signed_for_the_epoch_and_sequence_that_it_brings(
    pair: tuple[Station, Station],
) -> None:
    """East meets the node and builds, west alone signs: what west never heard of stands in the image."""
    east, west = pair
    board, renamed = Board(), BuildOrder("temperature-sensor", name="renamed")
    provisioned(east, board)
    with talk(board) as node:
        agree(east, node, identify(east, node), rotate=True)
    assert provisioned(east, board).verified.verdict == "authentic"
    built = build(east, board.uuid, renamed).image
    west.pins.put(WhitelistEntry(board.uuid))
    signed = sign_image(west, SignOrder(board.uuid, built), None).signed
    brought = security.decode(signed.image.blocks[SECURITY])
    assert (brought.key_epoch, brought.sequence) == (2, board.state.sequence + 1)
    again = sign_image(west, SignOrder(board.uuid, signed.image), None).signed
    assert (again.signature, again.reused) == (signed.signature, True)
    with talk(board) as node:
        require_session(east, node)
        write(east, node, signed.image)
    assert board.state.sequence == brought.sequence


def test_an_image_does_not_use_up_the_sequence_of_a_node_that_the_signer_knows(owner: Station) -> None:
    board = Board()
    image = provisioned(owner, board).image
    lie = replace(security.decode(image.blocks[SECURITY]), signature=None, sequence=2**32 - 2, station_key=None)
    forged = image.with_block(SECURITY, lie.encode())
    with pytest.raises(PolicyError, match="the last one known here is 1"):
        sign_image(owner, SignOrder(board.uuid, forged), None)
    record = owner.nodes.get(board.uuid)
    assert record is not None
    assert record.sequence == 1


@pytest.mark.parametrize("direction", [1, -1])
def test_they_hand_over_once_they_have_each_others_certificate(
    pair: tuple[Station, Station], owner: Station, tmp_path: Path, direction: int
) -> None:
    first, other = pair[::direction]
    board = Board()
    provisioned(first, board)
    trust(first, other)
    trust(other, first)
    order = ExportOrder((other.name,), None, "move")
    with pytest.raises(PolicyError, match="not certified by the CA"):
        plan_export(first, order)
    path = tmp_path / "other.cert"
    known = sign_request(owner, read_request(fleet.make_request(other.name, other.vault.identity())))
    path.write_bytes(write_certificate(known))
    add(first, [candidate(first, other.name, path, "station")])
    bundle = tmp_path / "bundle.jwe"
    export_bundle(first, plan_export(first, order), bundle)
    plan = plan_import(other, bundle.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert plan.ca_is_known
    import_bundle(other, plan)
    assert session(other, board) == 2


def test_a_stranger_verifies_nothing_of_theirs(pair: tuple[Station, Station], tmp_path: Path) -> None:
    board = Board()
    done = provisioned(pair[0], board)
    stranger = make_station(tmp_path / "stranger", "stranger")
    verified = Verification(board.uuid, tuple(verify_image(stranger, Image(board.uuid, done.image.blocks))))
    assert verified.verdict == "not authentic"
    stranger.close()


def test_signing_a_request_again_gives_the_same_certificate(tmp_path: Path, owner: Station) -> None:
    asked = read_request(request(tmp_path / "east", "east"))
    first = sign_request(owner, asked)
    owner.vault.drop_ca()  # type: ignore[attr-defined]
    assert sign_request(owner, asked) == first
    with pytest.raises(NotFoundError, match="CA key is not in this vault"):
        sign_request(owner, read_request(request(tmp_path / "west", "west")))


def test_a_request_proves_that_its_station_holds_the_key(tmp_path: Path) -> None:
    asked = request(tmp_path / "east", "east")
    with pytest.raises(NotAuthenticError):
        read_request(asked.replace(b'"east"', b'"evil"'))
    for bad in (b"", b"{}", b"[1]", asked[:-20], b"-----BEGIN PRIVATE KEY-----", asked.replace(b"P-256", b"P-384")):
        with pytest.raises(BadDataError):
            read_request(bad)


def test_a_certificate_is_for_one_station(tmp_path: Path, owner: Station) -> None:
    certificate = sign_request(owner, read_request(request(tmp_path / "east", "east")))
    request(tmp_path / "west", "west")
    with pytest.raises(PolicyError, match="is for station"):
        adopt_certificate(tmp_path / "west", certificate, ask=ask)
    with pytest.raises(NotFoundError):
        adopt_certificate(tmp_path / "nowhere", certificate, ask=ask)
    with pytest.raises(NotAuthenticError):
        read_certificate(forged())


def forged() -> bytes:
    from teds_provision.handover.trust import Certificate
    from teds_provision.protocol.keys import SoftwareKey

    station, stranger = SoftwareKey(31), SoftwareKey(32)
    return write_certificate(Certificate("x", station.point, stranger.point, station.sign(b"no")))


@pytest.mark.parametrize("cut", [KeyboardInterrupt(), VaultError("It is locked.")], ids=["Ctrl-C", "locked"])
def test_a_station_that_is_not_completed_is_closed(
    tmp_path: Path, owner: Station, monkeypatch: pytest.MonkeyPatch, cut: BaseException
) -> None:
    certificate = sign_request(owner, read_request(request(tmp_path / "east", "east")))
    closed: list[str] = []
    whole = Station.close

    def close(station: Station) -> None:
        closed.append(station.name)
        whole(station)

    def fail(*_: object) -> None:
        raise cut

    monkeypatch.setattr(Station, "close", close)
    monkeypatch.setattr(fleet, "_adopt", fail)
    with pytest.raises(type(cut)):
        adopt_certificate(tmp_path / "east", certificate, ask=ask)
    assert closed == ["east"]


def test_while_a_station_is_made_only_answers_that_are_known_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It holds its lock meanwhile: a question ends that, is asked, and all begins again."""
    answers: list[Any] = []

    def requested(station: Station, _name: object, _keystore: object, known: Ask) -> bytes:
        answers.append((station._ask is known, known("Passphrase", False)))
        return b"request"

    monkeypatch.setattr(fleet, "_requested", requested)
    assert ask_for_certificate(tmp_path / "east", name="east", keystore="file", ask=ask) == b"request"
    assert answers == [(True, PASSPHRASE)]


def test_adopting_again_changes_nothing(tmp_path: Path, owner: Station) -> None:
    home = tmp_path / "east"
    certificate = sign_request(owner, read_request(request(home, "east")))
    for _ in range(2):
        station = adopt_certificate(home, certificate, ask=ask)
        assert (station.ca, station.name) == (owner.ca, "east")
        (line,) = [entry for entry in station.audit_log.entries() if entry.outcome == "certified"]
        assert (line.act, line.detail) == ("init", {"ca": fingerprint(owner.ca), "own": True})
        station.close()


def test_a_station_with_its_own_ca_joins_for_the_nodes_of_another(tmp_path: Path, owner: Station) -> None:
    home = tmp_path / "east"
    make_station(home, "east").close()
    certificate = sign_request(owner, read_request(request(home, "east")))
    station = adopt_certificate(home, certificate, ask=ask)
    assert station.ca != owner.ca
    assert station.identity.signature_under(owner.ca) == certificate.signature
    (line,) = [entry for entry in station.audit_log.entries() if entry.outcome == "certified"]
    assert (line.act, line.detail) == ("init", {"ca": fingerprint(owner.ca), "own": False})
    station.close()


def test_the_ca_key_is_kept_away_and_brought_back(tmp_path: Path, owner: Station) -> None:
    path = tmp_path / "ca.pem"
    assert fleet.export_ca(owner, owner.vault, path, "a long enough passphrase")
    assert not fleet.export_ca(owner, owner.vault, path, "a long enough passphrase"), "it is there"
    assert fleet.drop_ca(owner)
    assert not fleet.drop_ca(owner)
    with pytest.raises(PolicyError, match="is not in this vault"):
        fleet.require_ca(owner)
    fleet.import_ca(owner, owner.vault, path, "a long enough passphrase")
    assert fleet.require_ca(owner).point == owner.ca
    log = [(entry.outcome, entry.detail) for entry in owner.audit_log.entries() if entry.act == "ca"]
    ca = {"ca": fingerprint(owner.ca)}
    assert [entry for entry in log if entry[0] in ("exported", "imported")] == [("exported", ca), ("imported", ca)]
    other = make_station(tmp_path / "other", "other")
    with pytest.raises(PolicyError, match="a CA key other than"):
        fleet.import_ca(other, other.vault, path, "a long enough passphrase")
    other.close()
