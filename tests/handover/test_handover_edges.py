"""Handovers at their edges: copies for one station, bundles of one command, nodes that are met, foreign keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NoNodeError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    UsageError,
)
from teds_provision.handover import incoming, outgoing, trust
from teds_provision.handover.incoming import NodeProof, NodeProofFailure, prove_nodes
from teds_provision.handover.outgoing import ExportOrder, export_all, export_bundle, plan_copies, plan_export
from teds_provision.handover.pending import BundleNotes
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover, KeyRecord, NodeRecord, StationRecord, TrustRecord
from tests.bench import PASSPHRASE, copied_station

SOUTH, WEST, NODE, OTHER = (SoftwareKey(number).point for number in (131, 132, 133, 134))
TO_SOUTH = fingerprint(SOUTH)
A, B, C = (bytes.fromhex("8d4d9da65281f70000") + bytes([number]) for number in (1, 2, 3))
NOW = datetime(2026, 3, 1, 8, tzinfo=UTC)
AT = "2026-03-01T08:00:00Z"


@pytest.fixture
def north(tmp_path: Path) -> Iterator[Station]:
    """A station that trusts south, with nodes A, B and C that are ready to go."""
    with copied_station(tmp_path / "north") as station:
        station.unlock()
        station.policy.trust(TrustRecord("south", "station", SOUTH, TO_SOUTH))
        for number, uuid in enumerate((A, B, C), 1):
            station.nodes.put(NodeRecord(uuid, NODE))
            station.keys.add(KeyRecord(uuid, 1, f"{number:016x}", "active", 1, b"w", "agreement", AT))
        yield station


def test_copies_have_the_owners_ca_and_leave_out_what_may_not_go(north: Station) -> None:
    to = TrustRecord("south", "station", SOUTH, TO_SOUTH)

    def copied(*uuids: bytes, most: int = 9) -> list[list[bytes]]:
        return [[node.uuid for node in plan.nodes] for plan in plan_copies(north, to, uuids, NOW, most=most)]

    assert copied(C, A, B) == [[A, B, C]]
    assert copied(C, A, B, most=2) == [[A, B], [C]]
    north.keys.set_ca_of(B, SoftwareKey(135).point)
    assert copied(A, B, C) == [[A, C]], "a node that keeps another CA"
    north.keys.demand_rotation(A, "why")
    assert copied(A, B, C) == [[C]]
    assert copied(A, B) == []
    [plan] = plan_copies(north, to, [C], NOW)
    assert (plan.mode, [record.name for record in plan.receivers], plan.ca) == ("copy", ["south"], north.ca)
    assert (plan.skipped, plan.also_held_by) == ((), ())


def test_bundles_of_one_command_have_the_id_of_the_first_as_its_run(
    north: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They rest together before the first file exists, and the same command carries all of them on."""
    written = list[str]()

    def cut(_station: Station, plan: Any, output: Path) -> Any:
        written.append(output.name)
        raise KeyboardInterrupt

    outputs = [tmp_path / "a", tmp_path / "b"]

    def planned() -> list[Any]:
        return outgoing.plan_exports(north, ExportOrder(("south",), (A, B, C), "move"), most=2, now=NOW)

    plans = planned()
    with monkeypatch.context() as patch:
        patch.setattr(outgoing, "export_bundle", cut)
        with pytest.raises(KeyboardInterrupt):
            export_all(north, plans, outputs)
    assert written == ["a"]
    assert {stone.uuid for stone in north.policy.tombstones()} == {A, B, C}
    runs = {row.id: BundleNotes.from_json(row.nodes).run for row in north.handovers.all()}
    assert runs == {plans[0].id: plans[0].id, plans[1].id: plans[0].id}
    again = planned()
    assert sorted(plan.id for plan in again) == sorted(plan.id for plan in plans)
    assert {plan.run for plan in again} == {plans[0].id}
    monkeypatch.setattr(outgoing, "export_bundle", lambda _station, plan, output: (plan.id, plan.run, output.name))
    done = cast("Any", export_all(north, again, outputs))
    assert done == [(plan.id, plans[0].id, name) for plan, name in zip(again, "ab", strict=True)]
    one = cast("Any", export_all(north, again[:1], outputs[:1]))
    assert one == [(again[0].id, plans[0].id, "a")]


def test_a_file_of_something_else_is_not_replaced_by_a_handover_that_is_carried_on(
    north: Station, tmp_path: Path
) -> None:
    first = plan_export(north, ExportOrder(("south",), (B,)), now=NOW)
    notes = BundleNotes((B.hex(),), first.content, "04", "2026-03-08T08:00:00Z", files=("ab" * 32,))
    north.handovers.put(Handover("h2", "out", "copy", (TO_SOUTH,), "open", notes.to_json(), created=AT))
    again = plan_export(north, ExportOrder(("south",), (B,)), now=NOW)
    assert again.earlier is not None
    letter = tmp_path / "letter"
    letter.write_text("a letter")
    with pytest.raises(UsageError, match="already exists"):
        export_bundle(north, again, letter, NOW)
    assert letter.read_text() == "a letter"


# -- nodes that prove the keys that came -------------------------------------------------------------------------------


class Desk:
    """A port at which nodes come, in this order; an error in their place is raised."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *comes: object, proves: dict[bytes, object]) -> None:
        self.comes, self.events = list(comes), list[str]()
        self.proves = proves
        monkeypatch.setattr(incoming, "open_port", self._open)
        monkeypatch.setattr(incoming, "Conversation", self._talk)
        monkeypatch.setattr(incoming, "prove_node", self._prove)

    def _open(self, links: Any) -> Any:
        if isinstance(links, Exception):
            raise links
        return self

    def find(self, wanted: Callable[[Any], bool], *, seconds: float, notice: object) -> Any:
        assert (seconds, notice) == (2.5, "notice")
        while self.comes:
            come = self.comes.pop(0)
            if isinstance(come, Exception):
                raise come
            contact = SimpleNamespace(identity=SimpleNamespace(uuid=come))
            if wanted(contact.identity):
                return contact
        raise NoNodeError("Nobody came.")

    def close(self) -> None:
        self.events.append("closed")

    @contextmanager
    def _talk(self, contact: Any, *, notice: object) -> Iterator[Any]:
        assert notice == "notice"
        yield contact.identity.uuid

    def _prove(self, _station: Any, uuid: bytes) -> NodeProof:
        self.events.append(f"{uuid[-1]}")
        if (error := self.proves.get(uuid)) is not None:
            raise cast("Exception", error)
        return NodeProof(uuid, 3, rotated=True)

    @contextmanager
    def hold(self) -> Iterator[None]:
        self.events.append("held")
        yield
        self.events.append("free")


def test_nodes_prove_their_keys_in_the_order_in_which_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    reporter: Any = SimpleNamespace(notice="notice")

    def proven(desk: Desk, links: Any = None) -> list[Any]:
        return prove_nodes(
            cast("Any", None), links or SimpleNamespace(timeout=2.5), [A, B, C], reporter, hold=desk.hold
        )

    met, failed = NodeProof, NodeProofFailure
    desk = Desk(monkeypatch, C, bytes(10), C, A, B, proves={A: PolicyError("It was given away.")})
    assert proven(desk) == [failed(A, "It was given away."), met(B, 3, rotated=True), met(C, 3, rotated=True)]
    assert desk.events == ["held", "3", "free", "held", "1", "held", "2", "free", "closed"]
    desk = Desk(monkeypatch, B, proves={})
    assert proven(desk) == [failed(A, "it was not met"), met(B, 3, rotated=True), failed(C, "it was not met")]
    desk = Desk(monkeypatch, B, LinkError("The reader is gone."), A, proves={})
    gone = "The reader is gone."
    assert proven(desk) == [failed(A, gone), met(B, 3, rotated=True), failed(C, gone)]
    assert desk.events[-1] == "closed"
    desk = Desk(monkeypatch, proves={})
    assert proven(desk, LinkError("There is no reader.")) == [failed(uuid, "There is no reader.") for uuid in (A, B, C)]
    assert desk.events == []


# -- trust -------------------------------------------------------------------------------------------------------------


def test_a_file_that_is_no_certificate_or_not_signed_by_its_ca(monkeypatch: pytest.MonkeyPatch) -> None:
    ca, station = SoftwareKey(21), SoftwareKey(22)
    signature = ca.sign(trust.station_key_message(station.point))
    good = trust.write_certificate(trust.Certificate("south", station.point, ca.point, signature))
    assert trust.read_certificate(good).name == "south"
    with pytest.raises(BadDataError) as error:
        trust.read_certificate(good.replace(trust.CERTIFICATE_FORMAT.encode(), b"another-format/1"))
    assert error.value.message.startswith("This is not a station's certificate (")
    assert error.value.hint == "See: trust ca sign"
    forged = trust.write_certificate(trust.Certificate("south", station.point, ca.point, bytes(64)))
    with pytest.raises(NotAuthenticError, match="does not verify under the CA key that it names"):
        trust.read_certificate(forged)


def test_digits_that_fit_two_trusted_keys_name_neither(north: Station) -> None:
    north.policy.trust(TrustRecord("owner", "ca", SOUTH, TO_SOUTH))
    with pytest.raises(UsageError) as error:
        trust.find_trusted(north, TO_SOUTH[:16])
    assert (error.value.message, error.value.hint) == (
        f"{TO_SOUTH[:16]!r} matches 2 trusted keys.", "Give the name, or more digits."
    )  # fmt: skip
    assert trust.find_trusted(north, TO_SOUTH[:16], "ca").name == "owner"
    assert trust.find_trusted(north, "south").role == "station"


def test_a_certificate_is_adopted_by_the_station_that_requested_it(tmp_path: Path, north: Station) -> None:
    certificate: Any = SimpleNamespace(station=SOUTH, ca=OTHER, name="south", signature=bytes(64))
    with Station.make(tmp_path / "empty") as empty:
        empty.identity.put(StationRecord("south", "file", "it was asked for"))
        with pytest.raises(NotFoundError) as error:
            trust._adopt(empty, certificate)
    assert (error.value.message, error.value.hint) == (
        "This station has not requested a certificate.", "First: init --request FILE"
    )  # fmt: skip
    with pytest.raises(PolicyError) as other:
        trust._adopt(north, certificate)
    assert other.value.message == (
        f"The certificate is for station {TO_SOUTH[:16]}, this one is {north.fingerprint[:16]}."
    )


def test_a_saved_ca_key_founds_a_station_in_an_empty_home_or_its_own(
    north: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = SoftwareKey(23)
    monkeypatch.setattr(trust, "read_ca", lambda path, passphrase: owner)
    monkeypatch.setattr(trust.SoftwareKey, "from_secret", staticmethod(lambda secret: secret))
    with pytest.raises(PolicyError) as error:
        trust.found_under(north.home, tmp_path / "ca", PASSPHRASE, name=None, keystore=None, ask=lambda *_: PASSPHRASE)
    assert (error.value.message, error.value.hint) == (
        f"{north.home} holds a station of another CA ({fingerprint(north.ca)[:16]}). Nothing was changed.",
        "Choose an empty home: teds-provision --home NEW init --ca FILE",
    )
