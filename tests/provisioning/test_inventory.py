"""What a list says of each node: every member from its own place in the store, and how nodes are found."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotFoundError, PolicyError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.provisioning.inventory import NodeFit, fits_of, inventory, require, search, with_verdicts
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord, RevocationRecord, Tombstone, WhitelistEntry
from teds_provision.teds.fits import Fit, parse_fits
from teds_provision.teds.image import Image
from teds_provision.teds.origin import Origin
from tests.bench import Board
from tests.handover.desk import provisioned

UUID = bytes.fromhex("8d4d9da65281f7000000")


def test_each_member_of_a_node_has_its_own_source(station: Station) -> None:
    station.nodes.remember(
        UUID,
        name="finger",
        profile="gripper",
        point=station.point,
        state=1,
        epoch=3,
        sequence=4,
        last_seen="2026-11-28T01:02:03Z",
        due="2027-01-01",
        charging=json.dumps({"percent": 50}),
        channels=5,
        can_address=0x21,
        teds_sha256="cd" * 32,
        retired="broken",
    )
    station.pins.put(WhitelistEntry(UUID, fingerprint(station.point), "2026-01-01T00:00:00Z", "tap", "listed"))
    station.groups.create("left", [UUID])
    station.groups.create("arm", [UUID])
    station.policy.deny(RevocationRecord(UUID, None, "stolen", "{}"))
    (known,) = inventory(station, [UUID])
    shown = known.to_json()
    since = shown["revoked"].pop("since")
    assert since
    assert shown == {
        "uuid": "8d4d9da65281f7000000",
        "name": "finger",
        "profile": "gripper",
        "state": "keyed",
        "epoch": 3,
        "sequence": 4,
        "fingerprint": station.fingerprint,
        "whitelisted": True,
        "assurance": "tap",
        "verdict": None,
        "retired": "broken",
        "reading": None,
        "last_seen": "2026-11-28T01:02:03Z",
        "due": "2027-01-01",
        "charging": {"percent": 50},
        "channels": 5,
        "can_address": 33,
        "group": "arm",
        "groups": ["arm", "left"],
        "teds_sha256": "cd" * 32,
        "keys": [],
        "rotation_due": None,
        "moved_to": None,
        "holders": [],
        "wrapped": None,
        "revoked": {"why": "stolen"},
        "firmware": None,
    }


def test_what_only_the_whitelist_knows_of_a_node(station: Station) -> None:
    station.pins.put(WhitelistEntry(UUID, "ab" * 16, "2026-01-01T00:00:00Z", "import", "listed"))
    (known,) = inventory(station, [UUID])
    assert (known.name, known.fingerprint, known.assurance, known.whitelisted) == ("listed", "ab" * 16, "import", True)
    assert (known.state, known.epoch, known.profile) == (None, 0, None)


@pytest.mark.parametrize(
    ("facts", "state"),
    [
        ({"name": "x"}, None),
        ({"point": SoftwareKey(221).point, "state": 1}, "keyed"),  # its key came in a bundle
        ({"last_seen": "2026-11-28T01:02:03Z", "state": 0}, "factory"),
        ({"last_seen": "2026-11-28T01:02:03Z", "state": 2}, "provisioned"),
        ({"last_seen": "2026-11-28T01:02:03Z", "state": 9}, "unknown (9)"),
    ],
)
def test_a_node_that_was_never_met_has_no_state(station: Station, facts: dict[str, object], state: str | None) -> None:
    station.nodes.remember(UUID, **facts)
    (known,) = inventory(station, [UUID])
    assert known.state == state


def test_how_nodes_are_found(station: Station) -> None:
    one, two, three = (UUID[:-1] + bytes([number]) for number in range(3))
    seen = {"last_seen": "2026-11-28T01:02:03Z"}
    station.nodes.remember(one, name="arm", profile="gripper", state=1, **seen)
    station.nodes.remember(two, name="arm 2", profile="load-cell", state=2, **seen)
    station.nodes.remember(three, name=three.hex()[:8])
    assert search(station, "arm") == [one], "an exact name goes before a part of one"
    assert search(station, "rm") == [one, two]
    assert search(station, f"0x{two.hex().upper()}") == [two]
    assert search(station, "gripper") == [one]
    assert search(station, "arm", state="provisioned") == [two], "with another condition it is a part"
    assert search(station, state="keyed") == [one]
    assert search(station, state="unseen") == [three]
    assert search(station) == [one, two, three]
    assert search(station, state="moved") == [], "no state of Identify"
    station.nodes.remember(two, name=three.hex())
    assert search(station, three.hex()) == [three], "a whole UUID goes before a name"
    station.nodes.remember(two, name=f"0x{three.hex()}")
    assert search(station, f" 0x{three.hex()} ") == [three]
    station.nodes.remember(two, name="facade")
    assert search(station, "facade") == [two], "digits that are no whole UUID"
    for text in ("nobody", "ff" * 10):
        with pytest.raises(NotFoundError, match=f"^No node matches '{text}'"):
            search(station, text)


def test_what_is_listed_of_a_node_that_was_verified(station: Station, board: Board) -> None:
    origin = Origin("iio", "bme280").encode()
    board.flash.state = replace(board.state, blocks={(0, 130): origin}, read_only=frozenset({(0, 130)}))
    board.power_on()
    provisioned(station, board)
    (known,) = inventory(station, [board.uuid])
    shown = known.to_json()
    assert shown["fingerprint"] == fingerprint(board.key.point)
    assert (shown["verdict"], shown["reading"]["from"]) == ("authentic", "session")
    assert shown["firmware"]["state"] == "unjudged"
    assert shown["wrapped"] == {"kind": "iio", "name": "bme280", "sha256": None}


def test_a_datasheet_that_is_not_known_is_skipped_and_the_others_are_judged(station: Station, board: Board) -> None:
    provisioned(station, board)
    asked = [parse_fits("angle >= 1 deg"), parse_fits("force >= 1 N")]
    unknown = bytes(10)
    found = list(fits_of(station, asked, [unknown, board.uuid], datetime(2026, 11, 28, tzinfo=UTC)))
    assert [(fit.uuid, fit.fit.result) for fit in found] == [
        (unknown, "skipped"),
        (unknown, "skipped"),
        (board.uuid, found[2].fit.result),
        (board.uuid, "failed"),
    ]
    assert found[0].to_json() == {
        "uuid": "00" * 10,
        "channel": None,
        "name": "",
        "result": "skipped",
        "why": "its datasheet is unknown here.",
    }


def test_a_requirement_that_no_channel_meets_ends_with_its_reasons() -> None:
    asked = parse_fits("force >= 1 N")
    good, bad, skipped = (
        NodeFit(bytes(10), asked, Fit(number, "a", result, why))  # type: ignore[arg-type]
        for number, result, why in ((1, "passed", "x."), (2, "failed", "too small."), (3, "skipped", "not stated."))
    )
    require([good, bad])
    with pytest.raises(PolicyError) as refused:
        require([bad, bad, skipped])
    assert refused.value.message == "No channel suffices for force: too small. not stated."
    named = replace(asked, channel="grip")
    with pytest.raises(PolicyError) as refused:
        require([replace(good, requirement=named), replace(bad, requirement=named)])
    assert refused.value.message == 'The channel "grip" does not suffice: too small.'
    with pytest.raises(PolicyError):
        require([good, replace(bad, requirement=named)])


def test_a_session_is_missed_at_a_node_whose_key_is_held_and_was_not_given_away(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    held, moved, bare = (UUID[:-1] + bytes([number]) for number in (1, 2, 3))
    for uuid in (held, moved, bare):
        station.nodes.remember(uuid, epoch=1)
    for uuid in (held, moved):
        station.keys.add(KeyRecord(uuid, 1, "01" * 8, "active", 1, b"w", "agreement", "2026-01-01T00:00:00Z"))
    station.policy.put_tombstone(Tombstone(moved, "ab" * 32, "h", "2026-01-01T00:00:00Z"))
    asked: list[Any] = []
    judging = SimpleNamespace(verdicts_of=lambda _station, *given: (asked.append(given), {})[1])
    monkeypatch.setattr("teds_provision.provisioning.inventory.readings", judging)
    assert len(list(with_verdicts(station, [held, moved, bare]))) == 3
    assert asked == [([held, moved, bare], [held])]


def test_a_datasheet_without_a_channel_is_as_good_as_none(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    requirement = parse_fits("force >= 1 N")
    for image in (None, Image(UUID, {})):
        monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_, image=image: image)
        (found,) = fits_of(station, [requirement], [UUID], datetime(2026, 3, 1, tzinfo=UTC))
        assert (found.fit.result, found.fit.why) == ("skipped", "its datasheet is unknown here.")
