"""Which events an act makes, with which members, and which acts make none (contract/plant.md section 2)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import PolicyError
from teds_provision.handover import deny, incoming, life, outgoing, pending
from teds_provision.protocol.handover.receipt import Receipt
from teds_provision.protocol.keys import SoftwareKey, reset_message, verify
from teds_provision.protocol.plant.roster import Share
from teds_provision.provisioning.agree import _activate, agree, reset_node
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.write import _report_written
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover, NodeRecord, WhitelistEntry
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile.load import default_folders, files_digest, find_profile
from tests.bench import Board, make_station, talk
from tests.plant.handing import Plant
from tests.plant.owner import ANGLE, alone, join, member, roster_of

REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
KEY, OTHER = "ab" * 32, "cd" * 32
A = bytes.fromhex("8d4d9da65281f7000000")
SECURITY_TEDS = SecurityTeds(SoftwareKey(7).point, bytes(64), sequence=7, key_epoch=5).encode()


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "home")
    made.unlock()
    made.plant.put_record(PlantRecord(REGISTRY))
    yield made
    made.close()


def told(station: Station, uuid: bytes | None = None) -> list[dict[str, Any]]:
    """Return the events since, without their id and time, and those of one node without its UUID."""
    waiting = station.plant.outbox(999)
    station.plant.drop_events(id for _, id, _ in waiting)
    events = [json.loads(text) for _, _, text in waiting]
    return [
        {name: value for name, value in one.items() if name not in ("id", "at") and value != (uuid and uuid.hex())}
        for one in events
    ]


def met(station: Station, board: Board) -> None:
    with talk(board) as node:
        who = identify(station, node)
        agree(station, node, who, newcomer=WhitelistEntry(node.uuid, who.fingerprint, assurance="tap"))


def test_a_pin_is_told_with_its_key_and_how_and_again_only_if_it_changed(station: Station) -> None:
    def put(key: str | None, assurance: Any, name: str | None = None) -> list[dict[str, Any]]:
        station.pins.put(WhitelistEntry(A, key, assurance=assurance, name=name))
        return told(station, A)

    def pinned(key: str, assurance: str) -> dict[str, Any]:
        return {"act": "pinned", "fingerprint": key, "assurance": assurance}

    assert put(None, "uuid", "right") == [{"act": "named", "name": "right"}]
    assert put(None, "uuid", "right") == []
    assert put(KEY[:32], "uuid") == [], "no whole fingerprint"
    assert put(KEY, "uuid") == [pinned(KEY, "uuid")]
    assert put(KEY, "uuid") == []
    assert put(KEY, "tap") == [pinned(KEY, "tap")]
    assert put(OTHER, "tap", "left") == [{"act": "named", "name": "left"}, pinned(OTHER, "tap")]
    assert put(OTHER, "tap", " left") == [], "no name of a plant"
    assert station.pins.remove(A)
    assert told(station, A) == [{"act": "unpinned"}]
    assert not station.pins.remove(A)
    assert put(KEY, "registry") == [], "that is a keeper's word"
    assert station.pins.remove(A)
    assert told(station) == []


def test_a_key_is_told_when_it_is_proven_and_again_when_it_is_rotated(station: Station) -> None:
    board = Board(A)
    met(station, board)
    (first,) = station.keys.keys_of(A)
    node = station.nodes.get(A)
    assert node is not None
    pinned = station.pins.pinned(A)
    assert told(station, A) == [
        {"act": "pinned", "fingerprint": pinned, "assurance": "tap"},
        {"act": "agreed", "fingerprint": pinned, "epoch": 1, "key_id": first.key_id},
    ]
    with talk(board) as talking:
        agree(station, talking, identify(station, talking), rotate=True)
    active = next(key for key in station.keys.keys_of(A) if key.state == "active")
    assert active.key_id != first.key_id
    assert told(station, A) == [{"act": "agreed", "fingerprint": pinned, "epoch": 2, "key_id": active.key_id}]
    station.keys.add_pending(A, key=bytes(16), key_id=bytes(8), epoch=3)
    assert told(station) == [], "not proven yet"
    pending_key = next(key for key in station.keys.keys_of(A) if key.state == "pending")
    _activate(station, pending_key)
    assert told(station, A) == [{"act": "agreed", "fingerprint": pinned, "epoch": 3, "key_id": "0" * 16}]
    _activate(station, replace(pending_key, state="active"))
    _activate(station, replace(pending_key, source="import"))
    assert told(station) == [], "another station agreed it"
    other = bytes(9) + b"\x01"
    station.pins.put(WhitelistEntry(other, KEY[:32], assurance="uuid"))
    station.keys.add_pending(other, key=bytes(16), key_id=bytes(8), epoch=1)
    _activate(station, station.keys.keys_of(other)[0])
    assert told(station) == [], "no whole fingerprint"


def test_the_greatest_epoch_is_told_of_the_keys_that_are_left_no_more(station: Station) -> None:
    for epoch in (2, 3, 1):
        station.keys.add_pending(A, key=bytes(16), key_id=bytes([epoch]) * 8, epoch=epoch)
    assert station.keys.remove(A) == 3
    assert told(station, A) == [{"act": "forgot", "epoch": 3}]
    assert station.keys.remove(A) == 0
    assert told(station) == []


def test_a_profile_is_told_by_the_name_of_its_file_and_with_the_day_that_is_due(station: Station) -> None:
    image = Image(A, {SECURITY: SECURITY_TEDS})
    known = NodeRecord(A, profile="/home/keeper/profiles/load.toml", due="2026-12-31")
    _report_written(station, image, known, 7)
    digest = hashlib.sha256(SECURITY_TEDS).hexdigest()
    assert told(station, A) == [{
        "act": "written", "epoch": 5, "sequence": 7, "teds_sha256": digest, "profile": "load.toml",
        "profile_sha256": None, "due": "2026-12-31",
    }]  # fmt: skip


def test_what_a_receiver_refused_was_not_given(station: Station) -> None:
    row = Handover("0b5f6f5e-0f3b-4a55-9d7c-2f1b8a3c4d5e", "out", "copy", (KEY, OTHER), "open", "[]")
    receipt = SimpleNamespace(imported=(), refused=(SimpleNamespace(uuid=A),), sender=OTHER)
    with station.transaction():
        pending._settle(station, row, cast("Receipt", receipt))
    assert told(station, A) == [{"act": "undone", "bundle": row.id, "peer": OTHER, "why": "refused"}]


def test_a_datasheet_is_told_when_it_is_signed_and_when_it_is_written(station: Station) -> None:
    board = Board(A)
    met(station, board)
    told(station)
    for once_more in (False, True):
        with talk(board) as node:
            done = provision(
                station, node, lambda who: prepare(station, BuildOrder(profile=ANGLE, name="left"), who.uuid),
                operator=AcceptingOperator(), reporter=SilentReporter(),
            )  # fmt: skip
        octets = done.image.security
        assert octets is not None
        digest = hashlib.sha256(octets).hexdigest()
        profile = files_digest(find_profile(ANGLE), default_folders(station.home))
        signed = {"epoch": 1, "sequence": 1, "teds_sha256": digest}
        assert told(station, A) == ([] if once_more else [
            {"act": "signed", **signed},
            {"act": "named", "name": "left"},
            {"act": "firmware", "runs": None},
            {"act": "written", **signed, "profile": ANGLE, "profile_sha256": profile, "due": None},
        ])  # fmt: skip


def test_a_reset_is_told_with_its_proof_and_that_no_key_is_left(station: Station) -> None:
    board = Board(A)
    met(station, board)
    told(station)
    with talk(board) as node:
        reset_node(station, node, identify(station, node))
    forgot, reset = told(station, A)
    assert forgot == {"act": "forgot", "epoch": 1}
    challenge, proof, point = (bytes.fromhex(reset.pop(name)) for name in ("challenge", "proof", "point"))
    assert reset == {"act": "reset", "epoch": 1}
    assert point == board.key.point
    assert verify(point, reset_message(A, 1, challenge), proof)


def test_a_ban_is_told_once_with_what_it_takes_away_and_its_lifting_by_h(station: Station) -> None:
    met(station, Board(A))
    told(station)
    life.revoke(station, A, "lost")
    entry = station.policy.revocation(A)
    assert entry is not None
    assert told(station, A) == [
        {"act": "revoked", "statement": entry.statement}, {"act": "unpinned"}, {"act": "forgot", "epoch": 1}
    ]  # fmt: skip
    life.revoke(station, A, "lost")
    assert told(station) == []
    assert deny.lift(station, A)
    h = hashlib.sha256(entry.statement.rpartition(".")[0].encode()).hexdigest()
    assert told(station) == [{"act": "lifted", "of": h}]
    assert not deny.lift(station, A)
    assert told(station) == []


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path, "north", "south")
    made.trusted()
    made.roster({"north": "keeper line base", "south": "base"}, Share(("all", ""), ()))
    yield made
    made.close()


@pytest.mark.parametrize("mode", ["copy", "move"])
def test_a_handover_is_told_by_who_gives_and_who_takes_and_once(plant: Plant, mode: Any) -> None:
    north, south, now = plant["north"], plant["south"], datetime.now(UTC)
    board = Board(os.urandom(10))
    met(north, board)
    (key,) = north.keys.keys_of(board.uuid)
    told(north)
    with north.lock("test"):
        order = outgoing.ExportOrder(("south",), (board.uuid,), mode)
        sealed = outgoing.seal_export(north, outgoing.plan_export(north, order), now)
        with north.transaction():
            outgoing.record_export(north, sealed)
        (gave,) = told(north, board.uuid)
        again = outgoing.seal_export(north, outgoing.plan_export(north, order), now)
        with north.transaction():
            outgoing.record_export(north, again)
        assert told(north) == [], "the same bundle once more"
    bundle = gave["bundle"]
    handed = {"epoch": 1, "key_id": key.key_id, "mode": mode, "bundle": bundle}
    assert gave == {"act": "gave", **handed, "peer": south.fingerprint}
    with south.lock("test"):
        south.unlock()
        plan = incoming.plan_import(south, sealed.octets, now)
        assert isinstance(plan, incoming.ImportPlan)
        with south.transaction():
            done = incoming.import_bundle(south, plan)
    took = [one for one in told(south, board.uuid) if one["act"] == "took"]
    assert took == [{"act": "took", **handed, "peer": north.fingerprint}]
    assert isinstance(incoming.plan_import(south, sealed.octets, now), incoming.ImportResult)
    assert told(south) == []
    if mode == "copy":
        pending.close(north, done.receipt)
        assert told(north) == []
        return
    (row,) = north.handovers.all()
    pending.undo(north, row)
    assert told(north, board.uuid) == [
        {"act": "undone", "bundle": bundle, "peer": south.fingerprint, "why": "taken back"}
    ]
    (row,) = north.handovers.all()
    pending.undo(north, row)
    assert told(north) == []


# -- the own role ------------------------------------------------------------------------------------------------------


def test_without_line_no_factory_node_is_keyed_and_without_sign_no_datasheet_is_signed(tmp_path: Path) -> None:
    made = alone(tmp_path / "alone")
    made.unlock()

    def roles(*words: str) -> None:
        before = made.plant.roster
        assert before is not None
        named = member(made, "owner", *words)
        join(made, roster_of(made, named, version=before.version + 1, previous=before.hash))

    def refused(board: Board, role: str, hint: str) -> None:
        with talk(board) as node, pytest.raises(PolicyError, match=f"does not have the role {role} in plant") as error:
            provision(
                made, node, lambda who: prepare(made, BuildOrder(profile=ANGLE), who.uuid),
                operator=AcceptingOperator(), reporter=SilentReporter(),
            )  # fmt: skip
        assert error.value.exit_code == 6
        assert hint in error.value.hint

    keyed, factory = Board(A), Board(os.urandom(10))
    met(made, keyed)
    roles("keeper", "sign", "base")
    refused(factory, "line", "Key it on a station that has this role")
    assert made.keys.keys_of(factory.uuid) == []
    with talk(keyed) as node:
        agree(made, node, identify(made, node), rotate=True)  # one that it keyed before is its own
    roles("keeper", "line", "base")
    refused(keyed, "sign", "sign --by OFFICE")
    roles("keeper", "line", "sign", "base")
    with talk(factory) as node:
        done = provision(
            made, node, lambda who: prepare(made, BuildOrder(profile=ANGLE), who.uuid),
            operator=AcceptingOperator(), reporter=SilentReporter(),
        )  # fmt: skip
    assert done.verified.verdict == "authentic"
    made.close()
