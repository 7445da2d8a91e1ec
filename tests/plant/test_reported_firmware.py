"""Firmware that a board reported to a station in a session, and what the plant's other stations see of it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision import plant
from teds_provision.plant.sync import write_page
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.roster import Share
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.firmware import keep_firmware, read_firmware
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.inventory import inventory
from teds_provision.station.firmware import FirmwareReading
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord
from tests.bench import talk
from tests.cli.shell import call
from tests.plant.handing import keyed
from tests.plant.stations import Plant
from tests.provisioning.test_firmware import FirmwareBoard

OLD = FirmwareReport("nrf/loadcell", (1, 2, 0), 3, bytes([0xA1]) * 32)
NEW = FirmwareReport("nrf/loadcell", (1, 3, 0), 0, bytes([0xA2]) * 32)
TRIAL = FirmwareReport("nrf/loadcell", (1, 3, 0), 0, bytes([0xA2]) * 32, FirmwareFlag.ON_TRIAL)


@pytest.fixture
def plants(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    made.close()


def board_with(station: Station, report: FirmwareReport | None) -> FirmwareBoard:
    """Return a board with firmware that reports, or without; keyed by a station."""
    board = FirmwareBoard(os.urandom(10), report=report)
    keyed(station, board)
    return board


def look(station: Station, board: FirmwareBoard) -> None:
    """The station asks the board in a session."""
    with talk(board) as node:
        identify(station, node)
        require_session(station, node)
        keep_firmware(station, board.uuid, read_firmware(node))


def shared_with(plants: Plant, station: Station) -> None:
    """North gives a station the keys of all its boards."""
    for first, other in ((plants.north, station), (station, plants.north)):
        first.policy.trust(TrustRecord(other.name, "station", other.point, other.fingerprint))
    plants.change(plant.owner.shared(plants.north, Share(("all", ""), (station.fingerprint,))))
    plants.round()


def identify_reply(station: Station, board: FirmwareBoard) -> dict[str, Any]:
    """Return what the plant says of a board, by a station."""
    (node,) = plant.status.nodes(station, plant.apply_pages.require_roster(station), board.uuid.hex())
    member: dict[str, Any] = node["says"]
    return member


def version(station: Station, board: FirmwareBoard) -> tuple[str | None, str] | None:
    """Return the firmware that is shown, and who saw it; None: no station reports any."""
    firmware = identify_reply(station, board)["firmware"]
    return None if firmware is None else (firmware["version"], firmware["by"])


def waiting(station: Station) -> list[object]:
    """Firmware that waits for the station's next page."""
    events = [json.loads(text) for _, _, text in station.plant.outbox(1000)]
    return [event["runs"] for event in events if event["act"] == "firmware"]


# -- what is reported ------------------------------------------------------------------------------------------------


def test_two_stations_see_what_either_read_last_and_who_read_it(plants: Plant, later: Callable[[], None]) -> None:
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    shared_with(plants, south)
    assert version(south, board) is None
    look(plants.north, board)
    plants.round()
    assert version(south, board) == version(plants.north, board) == ("1.2.0", "north")
    later()
    board.report = NEW
    look(south, board)
    plants.round()
    assert version(south, board) == version(plants.north, board) == ("1.3.0", "south")
    reports = identify_reply(plants.north, board)["firmware_by"]
    assert {name: seen["version"] for name, seen in reports.items()} == {"north": "1.2.0", "south": "1.3.0"}
    assert reports["south"]["image"] == "a2" * 32
    assert (reports["north"]["text"], reports["north"]["build"]) == ("nrf/loadcell", 3)


def test_a_board_that_went_back_is_reported_again_by_who_saw_that_firmware_before(
    plants: Plant, later: Callable[[], None]
) -> None:
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    shared_with(plants, south)
    look(plants.north, board)
    plants.round()
    later()
    board.report = NEW
    look(south, board)
    plants.round()
    later()
    keep_firmware(plants.north, board.uuid, FirmwareReading(OLD, sealed=False))
    assert waiting(plants.north) == [], "anybody on the bus can send that"
    board.report = OLD  # by its debug connector
    for _ in range(3):
        look(plants.north, board)
    assert len(waiting(plants.north)) == 1
    plants.round()
    assert version(south, board) == ("1.2.0", "north")


def test_a_board_without_about_is_not_reported_as_one_that_was_never_read(plants: Plant) -> None:
    board = board_with(plants.north, None)
    plants.round()
    assert version(plants.north, board) is None
    look(plants.north, board)
    plants.round()
    assert version(plants.north, board) == (None, "north")


def test_only_a_change_is_an_event(plants: Plant) -> None:
    board = board_with(plants.north, OLD)
    for _ in range(5):
        look(plants.north, board)
    board.report = NEW
    look(plants.north, board)
    look(plants.north, board)
    assert waiting(plants.north) == [list(OLD.stated), list(NEW.stated)]
    plants.round()
    look(plants.north, board)
    assert waiting(plants.north) == []


def test_what_was_received_outside_a_session_and_an_image_on_trial_reach_no_page(plants: Plant) -> None:
    board = board_with(plants.north, OLD)
    for plain in (OLD, NEW, None):
        keep_firmware(plants.north, board.uuid, FirmwareReading(plain, sealed=False))
    assert waiting(plants.north) == []
    look(plants.north, board)
    keep_firmware(plants.north, board.uuid, FirmwareReading(NEW, sealed=False))
    board.report = TRIAL
    look(plants.north, board)
    assert waiting(plants.north) == [list(OLD.stated)]
    board.report = NEW  # confirmed
    look(plants.north, board)
    assert waiting(plants.north) == [list(OLD.stated), list(NEW.stated)]


def test_it_is_kept_and_reported_together_or_not(plants: Plant) -> None:
    board = board_with(plants.north, OLD)

    def fails() -> None:
        with plants.north.transaction():
            look(plants.north, board)
            raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert waiting(plants.north) == []
    assert plants.north.firmware_reports.get(board.uuid) is None


def test_a_station_that_joins_brings_what_it_read_with_its_time(plants: Plant) -> None:
    board = board_with(plants.north, OLD)
    look(plants.north, board)
    (kept,) = plants.north.firmware_reports.all()
    keep_firmware(plants.north, os.urandom(10), FirmwareReading(OLD, sealed=False))
    reports = [members for act, _, members in plant.backlog.backlog(plants.north) if act == "firmware"]
    assert reports == [{"runs": list(OLD.stated), "at": kept.at}]


def test_a_stations_clock_ahead_makes_no_event_of_each_reading(plants: Plant) -> None:
    """Its report stands first, with its time, until then; nothing that others write could take its place."""
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    south.plant.record_event("firmware", board.uuid, runs=list(NEW.stated), at="2099-01-01T00:00:00Z")
    plants.round()
    for _ in range(3):
        look(plants.north, board)
    assert len(waiting(plants.north)) == 1


def test_nodes_plant_prints_it_beside_the_holder(plants: Plant, later: Callable[[], None]) -> None:
    south = plants.member("south", "base")
    board, without = board_with(plants.north, OLD), board_with(plants.north, None)
    shared_with(plants, south)
    look(plants.north, board)
    look(plants.north, without)
    later()
    board.report = NEW
    look(south, board)
    plants.round()
    called = call(south.home, "nodes", "--plant")
    assert called.code == 0, called.err
    lines = called.out.splitlines()
    shown = lines.index(next(line for line in lines if line.startswith(board.uuid.hex())))
    assert "(epoch 1), firmware nrf/loadcell 1.3.0 (south, " in lines[shown]
    assert lines[shown + 1].startswith("  also reported: firmware nrf/loadcell 1.2.0+3 (north, ")
    assert any(line.startswith(without.uuid.hex()) and "firmware not reported (north, " in line for line in lines)
    log = call(south.home, "registry", "log", board.uuid.hex()).out
    assert "south 2  firmware  uuid=" + board.uuid.hex() + " runs=nrf/loadcell 1.3.0+0" in log, log


def test_a_key_that_is_handed_over_brings_no_firmware(plants: Plant) -> None:
    """What the giver read proves nothing here: the plant shows it, the receiver's own list and verdicts do not."""
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    look(plants.north, board)
    shared_with(plants, south)
    plants.round()
    assert south.keys.held(board.uuid)
    assert south.firmware_reports.get(board.uuid) is None
    (known,) = inventory(south, [board.uuid])
    assert known.firmware is None
    assert version(south, board) == ("1.2.0", "north")
    look(south, board)
    (known,) = inventory(south, [board.uuid])
    assert known.firmware is not None
    assert (known.firmware["version"], known.firmware["from"], known.firmware["changed"]) == (
        "1.2.0",
        "session",
        False,
    )


# -- stations that leave, and versions --------------------------------------------------------------------------------


def test_a_removed_station_is_believed_to_its_last_page(plants: Plant, later: Callable[[], None]) -> None:
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    shared_with(plants, south)
    look(south, board)
    plants.round()
    last = plants.north.plant.pages.chain(south.fingerprint).counted[0]
    later()
    board.report = NEW
    look(south, board)
    plants.sync(south)
    plants.sync(plants.north)
    assert version(plants.north, board) == ("1.3.0", "south")
    plants.change(plant.owner.draft_removal(plants.north, "south", "stolen", last))
    assert version(plants.north, board) == ("1.2.0", "south")
    look(plants.north, board)
    plants.sync(plants.north)
    assert version(plants.north, board) == ("1.3.0", "north")


def test_a_station_of_an_earlier_version_goes_on_and_sees_all_after_its_upgrade(
    plants: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It skips the events, as those of any act that it does not know; what was skipped is there after the upgrade."""
    south = plants.member("south", "base", "line")
    board, own = board_with(plants.north, OLD), board_with(south, OLD)
    look(plants.north, board)
    with monkeypatch.context() as earlier:
        earlier.delitem(event.FORMS, "firmware")
        earlier.setattr(type(south.plant), "record_event", before_firmware(type(south.plant).record_event))
        earlier.setattr(type(south.plant), "folded_acts", lambda _: frozenset(event.FORMS))
        look(south, own)  # kept, and not reported: that version had no such event
        plants.sync(south)
        south.plant.put_folded_acts(event.FORMS)
        events = [json.loads(text) for _, _, text in plants.north.plant.outbox(1000)]
    assert [event["act"] for event in events].count("firmware") == 1
    plants.sync(plants.north)
    with monkeypatch.context() as earlier:
        earlier.delitem(event.FORMS, "firmware")
        done = plants.sync(south)
        assert done.fetched >= 1
        assert not [alarm.code for alarm in south.plant.alarms.all()]
        assert version(south, board) is None
    done = plants.sync(south)
    assert any("read again" in line for line in done.remarks)
    assert version(south, board) == ("1.2.0", "north")
    assert version(south, own) == ("1.2.0", "south")
    plants.sync(plants.north)
    assert version(plants.north, own) == ("1.2.0", "south")
    assert not any("read again" in line for line in plants.sync(south).remarks)
    assert waiting(south) == []


def before_firmware(record_event: Any) -> Any:
    """As a version writes that knows no such act."""

    def without(self: Any, act: str, *rest: Any, **members: Any) -> None:
        if act != "firmware":
            record_event(self, act, *rest, **members)

    return without


def test_pages_read_again_give_what_they_gave(plants: Plant) -> None:
    """Bans, digests, pins and names as well: the fold of a chain is one and the same."""
    south = plants.member("south", "base")
    board = board_with(plants.north, OLD)
    plants.north.plant.record_event("named", board.uuid, name="grip")
    plants.north.plant.record_event("signed", board.uuid, epoch=1, sequence=1, teds_sha256="d1" * 32)
    look(plants.north, board)
    plants.round()
    roster = plant.apply_pages.require_roster(south)

    def everything() -> object:
        digests = south.plant.claims.signers(bytes.fromhex("d1" * 32))
        return plant.apply_pages.merged_views(south, roster, [board.uuid]), digests, south.plant.pages.chains()

    before = everything()
    south.plant.put_folded_acts(event.FORMS.keys() - {"firmware"})
    assert plant.apply_pages.fold_new_acts(south, roster) >= 1
    assert everything() == before
    assert plant.apply_pages.fold_new_acts(south, roster) == 0


def test_a_home_that_a_backup_rebuilt_reports_what_it_sees_next(plants: Plant) -> None:
    """Its row is older than its own last page: as a hint it is replaced, and reported, whatever the board says."""
    board = board_with(plants.north, OLD)
    look(plants.north, board)
    write_page(plants.north, plant.apply_pages.require_roster(plants.north))
    plants.north.firmware_reports.make_hint(board.uuid)
    record = plants.north.firmware_reports.get(board.uuid)
    assert record is not None
    assert not record.in_session
    look(plants.north, board)
    assert waiting(plants.north) == [list(OLD.stated)]


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let a minute pass on the clock of what stations keep and report: events carry whole seconds."""
    passed = [0]

    def now() -> str:
        return (datetime.now(UTC) - timedelta(hours=1) + timedelta(minutes=passed[0])).strftime("%Y-%m-%dT%H:%M:%SZ")

    monkeypatch.setattr("teds_provision.station.firmware_reports.utc_now", now)

    def pass_time() -> None:
        passed[0] += 1

    return pass_time
