"""A member that lies: pages that it signed well, full of what could trip a reader; nobody is stopped by it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest

from teds_provision import plant
from teds_provision.cli.rendering import local_time
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.protocol.plant.document import PAGE, hash_of, sign_document
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.stations import Plant

NODE = bytes.fromhex("8d4d9da65281f7000000")
OTHER = bytes.fromhex("8d4d9da65281f7000001")
KEY, LIE = "ab" * 32, "cd" * 32
FAR = 0xFFFFFFFF
AT = "2026-03-01T12:00:00Z"


def wire(act: str, number: int, uuid: bytes | None = NODE, at: str = AT, **members: Any) -> dict[str, Any]:
    about = {} if uuid is None else {"uuid": uuid.hex()}
    return {"act": act, "id": f"{number:016x}", "at": at, **about, **members}


ATTACKS: dict[str, dict[str, Any]] = {
    "a day that is none": {"created": "2026-02-31T25:61:61Z"},
    "the first day": {"created": "0001-01-01T00:00:00Z"},
    "the last day": {"created": "9999-12-31T23:59:59Z"},
    "heads beyond everything": {"heads": {"ee" * 32: [FAR, LIE]}},
    "a head of itself from the future": {"heads": "own"},
    "five thousand heads": {"heads": {f"{n:064x}": [1, LIE] for n in range(5_000)}},
    "audit that is none": {"audit": {"a": [[[]]]}},
    "a home with an escape": {"home": "\x1b[2J"},
    "the highest epoch": {"events": [wire("agreed", 1, fingerprint=LIE, epoch=FAR, key_id="ee" * 8)]},
    "the highest sequence": {"events": [wire("written", 1, epoch=FAR, sequence=FAR, teds_sha256=LIE, profile="p",
                                             profile_sha256=LIE, due=None)]},
    "all is forgotten": {"events": [wire("forgot", 1, epoch=FAR)]},
    "every bundle undone": {"events": [wire("undone", 1, bundle="x" * 36, peer=KEY, why="")]},
    "an event at no time": {"events": [{**wire("named", 1, name="x"), "at": "9999-99-99T99:99:99Z"}]},
    "a name with an escape": {"events": [{**wire("named", 1, name="x"), "name": "\x1b]0;owned\x07"}]},
    "names by the thousand": {"events": [wire("named", n, n.to_bytes(10, "big"), name="x" * 100) for n in range(1000)]},
    "one id for all": {"events": [wire("named", 1, name=str(n)) for n in range(50)]},
    "more events than a page takes": {"events": [wire("named", n, name="x") for n in range(1, 1500)]},
    "a number as text": {"events": [{**wire("agreed", 1, fingerprint=LIE, epoch=1, key_id="ee" * 8), "epoch": "1"}]},
    "true as a number": {"events": [{**wire("agreed", 1, fingerprint=LIE, epoch=1, key_id="ee" * 8), "epoch": True}]},
    "lists where words stand": {"events": [{"act": ["named"], "id": {}, "at": 1, "uuid": []}, [], None, 7]},
    "an alarm about everybody": {"events": [wire("alarm", 1, None, code="fork", about=KEY, n=FAR)]},
    "a ban that nobody signed": {"events": [{**wire("named", 1, name="x"), "act": "revoked", "statement": "a.b.c"}]},
    "a reset that is none": {"events": [wire("reset", 1, epoch=FAR, challenge="00" * 32, proof="00" * 64,
                                             point="04" + "00" * 64)]},
}  # fmt: skip


@pytest.fixture(scope="module")
def plants(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    made = Plant(tmp_path_factory.mktemp("liar"))
    made.member("west", "line", "sign")
    made.north.pins.put(WhitelistEntry(NODE, KEY, assurance="tap"))
    made.round()
    yield made
    made.close()


def lied(plants: Plant, liar: Station, change: dict[str, Any]) -> int:
    """The liar signs its next page with something in it that no program of ours writes; returns its number."""
    chain = plants.north.plant.pages.chain(liar.fingerprint)
    n, previous = chain.counted
    members = {
        "format": PAGE.format, "registry": plants.roster.registry, "station": liar.fingerprint, "n": n + 1,
        "previous": previous, "home": "0" * 16, "created": AT, "heads": {}, "audit": [1, "0" * 64], "events": [],
    } | change  # fmt: skip
    if members["heads"] == "own":
        members["heads"] = {liar.fingerprint: [n + 100, LIE], plants.north.fingerprint: [FAR, LIE]}
    liar.unlock()
    octets = sign_document(members, liar.vault.identity(), PAGE)
    FolderTransport(plants.stick).append(liar.fingerprint, n + 1, previous, hash_of(octets), octets)
    return n + 1


@pytest.mark.parametrize("name", ATTACKS)
def test_no_page_of_a_liar_stops_a_reader_or_takes_anything(plants: Plant, name: str) -> None:
    north, west = plants.north, plants.stations[1]
    base = 1_000_000 * (1 + list(ATTACKS).index(name))
    change = dict(ATTACKS[name])
    for event in change.get("events", ()):  # an id stands once in a chain: each attack brings its own
        if isinstance(event, dict) and isinstance(event.get("id"), str):
            event["id"] = f"{base + int(event['id'], 16):016x}"
    n = lied(plants, west, change)
    plants.sync(north)
    record, roster = north.plant.joined, north.plant.roster
    assert record is not None
    assert roster is not None
    assert north.plant.pages.chain(west.fingerprint).counted[0] == n, "its chain goes on"
    shown = plant.status.status(north, record, roster)
    assert {standing.name for standing in shown.standings} == {"north", "west"}
    entries = list(plant.status.log(north, of=west.fingerprint))
    listed = {node["uuid"]: node for node in plant.status.nodes(north, roster)}
    assert listed[NODE.hex()]["says"]["pinned_by"]["north"] == KEY
    assert listed[NODE.hex()]["says"]["revoked"] == []
    assert all("\x1b" not in str(stated.event) for stated in entries)
    entry = north.pins.entry(NODE)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance) == (KEY, "tap")
    assert north.pins.entry(OTHER) is None
    assert north.policy.denied(NODE, None) is None


@pytest.fixture
def east(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "JST-9")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("east")
@pytest.mark.parametrize("day", ["9999-12-31T23:59:59Z", ""])
def test_the_pages_of_a_thief_are_listed_whatever_day_he_wrote(day: str) -> None:
    """`registry remove --stolen` lists them for a person to choose the last one from."""
    assert local_time(day) == day
    assert local_time("2026-03-01T12:00:00Z") == "2026-03-01 21:00:00+09:00"
