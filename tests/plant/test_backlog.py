"""What a store with a past says when its station joins a plant (contract/plant.md section 2), table by table."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from teds_provision.handover.deny import deny
from teds_provision.handover.life import revoke
from teds_provision.handover.pending import BundleNotes, refused_in
from teds_provision.plant.backlog import backlog, count
from teds_provision.protocol.handover.receipt import Receipt, RefusedNode, seal_receipt
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, Handover, KeyRecord, NodeRecord, WhitelistEntry
from teds_provision.teds.image import Image
from tests.bench import Board, copied_station, make_station
from tests.handover.desk import provisioned

A, B, C, D, E = (bytes([number]) * 10 for number in range(1, 6))
NODE = SoftwareKey(51)
PIN = fingerprint(NODE.point)
SOUTH, WEST = SoftwareKey(52), SoftwareKey(53)
TO_SOUTH, TO_WEST = fingerprint(SOUTH.point), fingerprint(WEST.point)
BUNDLE = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
AT = "2026-01-31T12:00:00Z"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    with copied_station(tmp_path / "home") as made:
        made.unlock()
        yield made


def key(uuid: bytes, epoch: int, state: Any = "active", source: Any = "agreement") -> KeyRecord:
    return KeyRecord(uuid, epoch, f"{epoch:016x}", state, epoch, b"wrapped", source, AT)


def said(station: Station, *acts: str) -> list[tuple[str, bytes | None, dict[str, Any]]]:
    return [event for event in backlog(station) if not acts or event[0] in acts]


def test_whole_pins_that_are_ones_own_are_published(station: Station) -> None:
    station.pins.put(
        WhitelistEntry(A, PIN, assurance="tap"),
        WhitelistEntry(B, PIN, assurance="registry"),
        WhitelistEntry(C, PIN[:32], assurance="uuid"),
        WhitelistEntry(D),
        WhitelistEntry(E, PIN, assurance="import"),
    )
    assert said(station) == [
        ("pinned", A, {"fingerprint": PIN, "assurance": "tap"}),
        ("pinned", E, {"fingerprint": PIN, "assurance": "import"}),
    ]


def test_a_key_is_agreed_if_this_station_agreed_on_it_and_a_session_proved_it(station: Station) -> None:
    for uuid in (A, B, C):
        station.pins.put(WhitelistEntry(uuid, PIN, assurance="tap"))
    station.keys.add(key(A, 2), key(A, 3, "pending"), key(B, 1, source="import"), key(C, 1, "pending"), key(D, 1))
    assert said(station, "agreed") == [("agreed", A, {"fingerprint": PIN, "epoch": 2, "key_id": f"{2:016x}"})]
    station.nodes.put(NodeRecord(D, NODE.point))
    assert [uuid for _, uuid, _ in said(station, "agreed")] == [A, D], "pinned by what it showed"


def notes(*nodes: tuple[bytes, str], refused: tuple[bytes, ...] = ()) -> str:
    uuids, keys = tuple(uuid.hex() for uuid, _ in nodes), tuple(name for _, name in nodes if name)
    left_out = tuple((uuid.hex(), "why") for uuid in refused)
    return BundleNotes(uuids, "c", "ca", AT, refused=left_out, keys=keys).to_json()


def receipt(of: SoftwareKey, *refused: bytes) -> str:
    made = Receipt(
        BUNDLE, "ab" * 32, fingerprint(of.point), "cd" * 32, (), tuple(RefusedNode(uuid, "why") for uuid in refused),
        datetime(2026, 2, 1, tzinfo=UTC),
    )  # fmt: skip
    return seal_receipt(made, of).decode()


def test_what_was_given_is_published_for_each_receiver_that_took_it(station: Station) -> None:
    station.keys.add(key(A, 2), key(B, 4))
    station.nodes.put(NodeRecord(B, NODE.point, epoch=4))
    station.nodes.put(NodeRecord(C, NODE.point, epoch=7))
    left = notes((A, f"{2:016x}"), (B, "00" * 8), (C, "11" * 8), (D, "22" * 8))
    both = (TO_SOUTH, TO_WEST)
    taken = "\n".join([receipt(SOUTH, B), receipt(WEST)])
    station.handovers.put(Handover(BUNDLE, "out", "copy", both, "closed", left, receipt=taken, created=AT))
    station.handovers.put(Handover("undone", "out", "move", (TO_WEST,), "undone", left, created=AT))

    def gave(uuid: bytes, epoch: int, key_id: str, peer: str) -> tuple[str, bytes, dict[str, Any]]:
        return "gave", uuid, {"epoch": epoch, "key_id": key_id, "mode": "copy", "bundle": BUNDLE, "peer": peer}

    assert said(station, "gave") == [
        gave(A, 2, f"{2:016x}", TO_SOUTH), gave(A, 2, f"{2:016x}", TO_WEST),
        gave(B, 4, "00" * 8, TO_WEST),  # south refused it: it has never had that key
        gave(C, 7, "11" * 8, TO_SOUTH), gave(C, 7, "11" * 8, TO_WEST),
        gave(D, 0, "22" * 8, TO_SOUTH), gave(D, 0, "22" * 8, TO_WEST),
    ]  # fmt: skip
    assert count(said(station)) == {"agreed": 1, "gave": 7}
    assert refused_in(receipt(SOUTH, B, C)) == {B.hex(), C.hex()}
    assert refused_in("no receipt") == refused_in("a.b.c") == frozenset()


def test_a_row_of_version_1_names_no_keys_and_the_present_one_is_meant(station: Station) -> None:
    station.keys.add(key(A, 2))
    station.handovers.put(Handover(BUNDLE, "out", "move", (TO_WEST,), "open", notes((A, ""), (B, "")), created=AT))
    assert [(act, uuid, facts["key_id"]) for act, uuid, facts in said(station)] == [("gave", A, f"{2:016x}")]


def test_what_was_taken_is_published_while_it_is_the_key_in_use(station: Station) -> None:
    station.keys.add(
        key(A, 2, source="import"), key(B, 2, source="import"), key(C, 2), key(D, 2, "pending", source="import")
    )
    came = notes((A, ""), (B, ""), (C, ""), (D, ""), refused=(B,))
    station.handovers.put(Handover(BUNDLE, "in", "move", (TO_SOUTH,), "imported", came, created=AT))
    took = {"epoch": 2, "key_id": f"{2:016x}", "mode": "move", "bundle": BUNDLE, "peer": TO_SOUTH}
    assert said(station, "took", "gave") == [("took", A, took)]


def test_bans_of_this_station_alone_are_published(station: Station) -> None:
    own = revoke(station, A, "lost").entry
    statement = seal_revocation(SOUTH, uuid=B, node=None, why="burnt", created=datetime(2026, 2, 1, tzinfo=UTC))
    deny(station, statement, key=PIN)
    assert said(station) == [("revoked", A, {"statement": own.statement})]


def test_datasheets_that_this_station_signed_are_published_once_each(station: Station, tmp_path: Path) -> None:
    board, other_board = Board(), Board(uuid=B)
    done = provisioned(station, board)
    other = make_station(tmp_path / "other", "other")
    foreign = provisioned(other, other_board).image
    other.close()
    station.nodes.put(NodeRecord(B, other_board.key.point))
    station.datasheets.keep_datasheet(foreign)
    (signed,) = said(station, "signed")
    octets = done.image.blocks[0, 128]
    facts = {"epoch": 1, "sequence": 1, "teds_sha256": hashlib.sha256(octets).hexdigest()}
    assert signed == ("signed", board.uuid, facts)

    def drafted(stage: Any, security: bytes) -> list[Any]:
        """Return what is published of a datasheet that was not written yet."""
        image = Image(board.uuid, {**done.image.blocks, (0, 128): security})
        station.datasheets.keep_draft(Draft(board.uuid, image, stage=stage))
        return said(station, "signed")

    assert drafted("signed", octets) == [signed], "the same once more"
    station._store.execute("DELETE FROM datasheets")
    assert (drafted("built", octets), drafted("signed", octets)) == ([], [signed])
    changed = bytearray(octets)
    at = changed.index(b"\x64\x58") + 2  # field 100, base64
    changed[at] = ord("B") if changed[at] == ord("A") else ord("A")
    changed[-2:] = (0xFFFF - sum(changed[:-2]) % 0x10000).to_bytes(2, "big")
    assert drafted("signed", bytes(changed)) == [], "its signature is not good"
