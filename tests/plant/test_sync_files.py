"""Two and three stations of one owner, and a stick that is carried between them."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.errors import ForkError, LinkError, NotMemberError, PolicyError, StoreLockedError
from teds_provision.handover import deny
from teds_provision.plant.apply_pages import heads_digest, merged_views
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sync import resume, sync
from teds_provision.plant.transport import CarriedPage, Parcel
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.plant.document import hash_of, open_request
from teds_provision.protocol.plant.event import hash_of_statement
from teds_provision.protocol.plant.page import PageDraft, sign_page
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.stations import Plant, ask, certified

UUID = bytes.fromhex("8d4d9da65281f7000000")
KEY = "ab" * 32


@pytest.fixture
def plants(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    made.close()


def pin(station: Station, uuid: bytes = UUID, key: str = KEY) -> None:
    station.pins.put(WhitelistEntry(uuid, key, assurance="tap"))


def alarms(station: Station) -> list[str]:
    return [alarm.code for alarm in station.plant.alarms.all()]


def test_what_one_station_says_reaches_all_and_all_see_the_same(plants: Plant) -> None:
    south, west = plants.member("south", "base"), plants.member("west", "line", "sign")
    pin(west)
    plants.round()
    plants.round()
    assert len({heads_digest(station) for station in plants.stations}) == 1
    for station in (plants.north, south):
        roster = station.plant.roster
        assert roster is not None
        assert merged_views(station, roster, [UUID])[UUID].pins == {west.fingerprint: KEY}
        assert not alarms(station)


def test_a_keepers_pin_goes_on_the_whitelist_of_all_and_off_when_he_takes_it_back(plants: Plant) -> None:
    south = plants.member("south", "base")
    pin(plants.north)
    plants.round()
    entry = south.pins.entry(UUID)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance) == (KEY, "registry")
    assert plants.north.pins.remove(UUID)
    plants.round()
    assert south.pins.entry(UUID) is None


def test_a_pin_of_ones_own_stays_whatever_a_keeper_says(plants: Plant) -> None:
    south = plants.member("south", "base")
    pin(south, key="cd" * 32)
    pin(plants.north)
    plants.round()
    entry = south.pins.entry(UUID)
    assert entry is not None
    assert entry.fingerprint == "cd" * 32
    assert [name for _, name, _ in south.plant.claims.conflicts(UUID)] == ["other pin"]


@pytest.mark.parametrize(("who", "ends"), [("north", True), ("west", True), ("east", False)])
def test_a_ban_out_of_a_bundle_ends_where_a_keeper_or_its_signer_lifts_it(plants: Plant, who: str, ends: bool) -> None:
    south = plants.member("south", "base")
    stations = {"north": plants.north, "west": plants.member("west", "line"), "east": plants.member("east", "base")}
    stations["west"].unlock()
    ban = seal_revocation(stations["west"].vault.identity(), uuid=UUID, node=KEY, why="lost", created=datetime.now(UTC))
    with south.transaction():
        deny.deny(south, ban, key=None)
    plants.round()
    assert south.policy.revocation(UUID) is not None, "no page has it"
    stations[who].plant.record_event("lifted", None, of=hash_of_statement(ban.statement))
    plants.round()
    assert (south.policy.revocation(UUID) is None) == ends
    with south.transaction():
        deny.deny(south, ban, key=None)
    plants.sync(south)
    assert (south.policy.revocation(UUID) is None) == ends, "a later bundle brings it once more"


def test_a_ban_counts_again_if_the_page_that_lifted_it_counts_no_more(plants: Plant) -> None:
    south, west = plants.member("south", "base", "keeper"), plants.member("west", "line", "keeper")
    west.unlock()
    ban = seal_revocation(west.vault.identity(), uuid=UUID, node=KEY, why="lost", created=datetime.now(UTC))
    west.plant.record_event("revoked", UUID, statement=ban.statement)
    pin(plants.north)
    plants.round()
    copy = plants.folder / "copy"
    shutil.copytree(south.home, copy)
    south.plant.record_event("lifted", None, of=hash_of_statement(ban.statement))
    plants.round()
    assert plants.north.policy.revocation(UUID) is None
    stick = plants.folder / "other stick"
    stick.mkdir()
    with Station.open(copy, ask=ask) as twin:
        twin.plant.record_event("named", UUID, name="hand")
        plants.sync(twin, stick)
    plants.sync(plants.north, stick)
    assert "two-histories" in alarms(plants.north)
    assert plants.north.policy.revocation(UUID) is not None


def test_a_second_sync_with_nothing_new_does_nothing(plants: Plant) -> None:
    plants.member("south", "base")
    plants.round()
    done = plants.sync(plants.north)
    assert (done.pushed, done.fetched, done.rosters) == (0, 0, [])


def test_a_removed_station_hears_of_it_and_is_asked_for_nothing_more(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    plants.round()
    plants.change(
        plant.owner.draft_removal(
            plants.north, "west", "lost", plants.north.plant.pages.chain(west.fingerprint).counted[0]
        )
    )
    plants.sync(plants.north)
    with pytest.raises(NotMemberError, match="removed"):
        plants.sync(west)


def test_a_folder_of_another_registry_gives_nothing(plants: Plant, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    stranger = Plant(tmp_path / "other")
    stranger.sync(stranger.north)
    shutil.copytree(stranger.stick, plants.stick, dirs_exist_ok=True)
    done = plants.sync(plants.north)
    assert done.fetched == 0
    stranger.close()


def test_a_stick_that_is_not_plugged_in_is_reported(plants: Plant) -> None:
    with pytest.raises(LinkError, match="no folder"):
        plants.sync(plants.north, plants.folder / "nothing")


def test_junk_ends_nothing_and_is_asked_for_again(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    page = plants.stick / west.fingerprint / "1.jws"
    good = page.read_bytes()
    page.write_bytes(good[:-5] + b"AAAAA")
    plants.sync(plants.north)
    assert alarms(plants.north) == ["junk"]
    page.write_bytes(good)
    plants.sync(plants.north)
    assert alarms(plants.north) == []
    assert plants.north.plant.pages.chain(west.fingerprint).counted[0] == 1


def test_a_copy_of_a_home_at_work_finds_itself_out(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    west.close()
    shutil.copytree(plants.folder / "west", plants.folder / "copy")
    west = Station.open(plants.folder / "west", ask=ask)
    copy = Station.open(plants.folder / "copy", ask=ask)
    pin(copy, bytes(10))
    plants.sync(copy)
    pin(west, bytes([1] * 10))
    with pytest.raises(ForkError, match="copy of this home"):
        plants.sync(west)
    assert west.plant.unsent() >= 1
    assert west.plant.home == copy.plant.home
    assert resume(west, plant.folder_transport.FolderTransport(plants.stick)) == 1
    assert west.plant.home != copy.plant.home, "if the copy writes again, its pages show that they are of another home"
    plants.sync(west)
    plants.sync(plants.north)
    roster = plants.north.plant.roster
    assert roster is not None
    views = merged_views(plants.north, roster, [bytes(10), bytes([1] * 10)])
    assert all(view.pins for view in views.values())
    assert "two-histories" not in alarms(plants.north)
    west.close()
    copy.close()


def test_two_histories_on_two_sticks_are_found_where_they_meet(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    west.close()
    shutil.copytree(plants.folder / "west", plants.folder / "copy")
    other = plants.folder / "other stick"
    shutil.copytree(plants.stick, other)
    west, copy = (Station.open(plants.folder / name, ask=ask) for name in ("west", "copy"))
    pin(west, bytes([1] * 10))
    pin(copy, bytes([2] * 10))
    plants.sync(west)
    plants.sync(copy, other)
    plants.sync(plants.north)
    plants.sync(plants.north, other)
    assert alarms(plants.north) == ["two-histories"]
    chain = plants.north.plant.pages.chain(west.fingerprint)
    assert chain.counted[0] == 1, "the part that both share goes on counting"
    roster = plants.north.plant.roster
    assert roster is not None
    seen = merged_views(plants.north, roster, [UUID, bytes([1] * 10)])
    assert seen[UUID].pins
    assert not seen[bytes([1] * 10)].pins
    west.close()
    copy.close()


def test_a_home_that_a_backup_rebuilt_takes_its_pages_back_before_it_says_more(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    west.close()
    shutil.copytree(plants.folder / "west", plants.folder / "yesterday")
    west = Station.open(plants.folder / "west", ask=ask)
    pin(west, bytes([1] * 10))
    plants.sync(west)
    west.close()
    back = Station.open(plants.folder / "yesterday", ask=ask)
    back.unlock()
    back.plant.begin_restored()
    pin(back, bytes([2] * 10))
    plants.sync(back)
    assert not back.plant.restored
    assert back.plant.pages.chain(back.fingerprint).counted[0] == 3
    assert not alarms(back)
    back.close()


def test_a_rebuilt_home_waits_if_another_station_has_seen_more_of_it(plants: Plant) -> None:
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    west.close()
    shutil.copytree(plants.folder / "west", plants.folder / "yesterday")
    west = Station.open(plants.folder / "west", ask=ask)
    old = plants.folder / "old stick"
    shutil.copytree(plants.stick, old)
    pin(west, bytes([1] * 10))
    plants.sync(west)
    plants.sync(plants.north)
    pin(plants.north, bytes([3] * 10))
    plants.sync(plants.north)
    west.close()
    shutil.copytree(plants.stick / plants.north.fingerprint, old / plants.north.fingerprint, dirs_exist_ok=True)
    back = Station.open(plants.folder / "yesterday", ask=ask)
    plants.sync(back, old)  # it hears what north has seen of it
    back.unlock()
    back.plant.begin_restored()
    with pytest.raises(PolicyError, match="has seen its page 2"):
        plants.sync(back, old)
    plants.sync(back)
    assert not back.plant.restored
    back.close()


class CountingTransport(FolderTransport):
    """A transport that gives what it is asked for and no page more, as a registry's database does."""

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        return (page for page in super().pages(station, after) if page.number > after)


def test_a_rebuilt_home_compares_its_whole_chain_with_what_is_there(plants: Plant) -> None:
    """Another home wrote a page under its key, below those that it knows to be there: it is a copied disk."""
    west = plants.member("west", "line", "sign")
    pin(west)
    plants.sync(west)
    west.close()
    shutil.copytree(plants.folder / "west", plants.folder / "twin")
    other = plants.folder / "other stick"
    shutil.copytree(plants.stick, other)
    twin = Station.open(plants.folder / "twin", ask=ask)
    pin(twin, bytes([9] * 10))
    plants.sync(twin, other)
    twin.close()
    west = Station.open(plants.folder / "west", ask=ask)
    for number in (1, 2, 3):
        pin(west, bytes([number] * 10))
        plants.sync(west)
    joined = west.plant.joined
    assert joined is not None
    assert joined.acknowledged >= 4
    shutil.copytree(other / west.fingerprint, plants.stick / west.fingerprint, dirs_exist_ok=True)
    sync(west, CountingTransport(plants.stick))  # what it saw there once, it does not read again
    west.unlock()
    west.plant.begin_restored()
    with pytest.raises(ForkError):
        sync(west, CountingTransport(plants.stick))
    assert alarms(west) == ["fork"]
    west.close()


def test_a_person_names_the_branch_or_the_roster_does(plants: Plant) -> None:
    chain = replace(plants.north.plant.pages.chain("f" * 64), accepted=(3, "a" * 64))
    plants.north.plant.pages.put_chain(chain)
    assert plants.north.plant.pages.chain("f" * 64) == chain


def test_an_older_roster_is_no_news(plants: Plant) -> None:
    plants.member("south", "base")
    first = (plants.north.plant.held_roster() or pytest.fail("no roster")).version
    plants.sync(plants.north)
    plants.change(plant.owner.renewed(plants.north, timedelta(days=30)))
    west = plants.member("west", "line")  # it never saw the first ones
    done = plants.sync(west)
    assert (plants.stick / "roster" / f"{first}.jws").exists()
    assert done.remarks == []


def test_a_clock_a_year_ahead_makes_no_roster_that_counts(plants: Plant) -> None:
    south = plants.member("south", "base")
    plants.round()
    draft = plant.owner.renewed(plants.north, timedelta(days=30))
    ahead = replace(draft, created=draft.created + timedelta(days=365), expires=draft.expires + timedelta(days=365))
    version = south.plant.roster.version if south.plant.roster else 0
    signed = plant.owner.signed(plants.north, ahead)
    FolderTransport(plants.stick).post_roster(signed.version, signed.hash, signed.octets)
    done = plants.sync(south)
    assert any("check this machine's clock" in line for line in done.remarks)
    assert south.plant.roster is not None
    assert south.plant.roster.version == version


def test_a_roster_of_an_owners_wrong_clock_is_dated_anew_by_his_word(
    plants: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every version after it kept the wrong date: for a year no station took a roster, not even one that removes."""
    south = plants.member("south", "base")
    plants.round()
    with monkeypatch.context() as wrong:
        wrong.setattr(plant.owner, "now", lambda: datetime.now(UTC) + timedelta(days=365))
        plants.change(plant.owner.renewed(plants.north, timedelta(days=90)))
    held = plants.north.plant.roster
    assert held is not None
    assert plant.owner.is_ahead(held)
    plants.change(plant.owner.renewed(plants.north, timedelta(days=90)))
    plants.round()
    assert (south.plant.roster.version if south.plant.roster else 0) < held.version
    again = plant.owner.renewed(plants.north, timedelta(days=90), redate=True)
    assert not plant.owner.says_the_same(plants.north.plant.roster, again)
    assert any("dates it" in line for line in plant.owner.changes(plants.north.plant.roster, again))
    plants.change(again)
    plants.round()
    assert south.plant.roster == plants.north.plant.roster
    later = plant.owner.following(plants.north)
    assert not plant.owner.is_ahead(later)


def test_a_slow_clock_dates_no_roster(plants: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its end would be over everywhere at once. The page of another member shows which clock is wrong."""
    south, held = plants.member("south", "base"), plants.north.plant.roster
    assert held is not None
    with pytest.raises(PolicyError, match="not in the future"):
        plant.owner.require_wrong_date(plants.north, held)
    monkeypatch.setattr(plant.owner, "now", lambda: datetime.now(UTC) - timedelta(days=365))
    plant.owner.require_wrong_date(plants.north, held)  # nobody else has said anything yet
    pin(south)
    plants.round()
    with pytest.raises(PolicyError, match="is behind: the newest page of south is dated 20"):
        plant.owner.require_wrong_date(plants.north, held)


def test_a_request_to_join_of_a_wrong_clock_is_made_anew_with_the_same_login(
    plants: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stayed dated in the future, whatever was done about the clock, and no owner took it."""
    south = certified(plants.folder / "late", "late", plants.north)
    with monkeypatch.context() as wrong:
        wrong.setattr(plant.membership, "now", lambda: datetime.now(UTC) + timedelta(days=3))
        early = plant.membership.request(south)
        assert plant.membership.request(south) == early
    made = plant.membership.request(south)
    assert made != early
    assert open_request(made).login == open_request(early).login
    assert plant.owner.add(plants.north, open_request(made), frozenset({"base"})).named("late") is not None
    south.close()


def test_a_clock_that_was_put_back_a_year_revives_no_roster(plants: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    roster = plants.north.plant.roster
    record = plants.north.plant.joined
    assert roster is not None
    assert record is not None
    monkeypatch.setattr(plant.status, "now", lambda: datetime.now(UTC) - timedelta(days=365))
    assert plant.status.moment(roster) == roster.created
    assert not plant.status.status(plants.north, record, roster).expired
    monkeypatch.setattr(plant.status, "now", lambda: datetime.now(UTC) + timedelta(days=365))
    assert plant.status.status(plants.north, record, roster).exit_code == 6


def test_a_page_of_a_clock_a_year_ahead_counts_and_no_name_of_it_wins_for_ever(plants: Plant) -> None:
    south = plants.member("south", "base")
    plants.round()
    pin(south)
    chain, roster = south.plant.pages.chain(south.fingerprint), south.plant.roster
    assert roster is not None
    ahead = datetime.now(UTC) + timedelta(days=365)
    draft = PageDraft(roster.registry, chain.counted[0] + 1, chain.counted[1], "0" * 16, ahead, {}, (1, "0" * 64))
    octets = sign_page(draft, [], south.vault.identity())
    FolderTransport(plants.stick).append(south.fingerprint, draft.number, draft.previous, hash_of(octets), octets)
    plants.sync(plants.north)
    assert plants.north.plant.pages.chain(south.fingerprint).counted[0] == draft.number
    assert alarms(plants.north) == []


def test_syncs_at_once_in_one_home_write_every_event_once(plants: Plant) -> None:
    nodes = [bytes([n] * 10) for n in range(1, 9)]
    homes = [Station.open(plants.north.home, ask=ask) for _ in nodes]
    ends: list[str] = []
    gate = threading.Barrier(len(homes))

    def record(station: Station, uuid: bytes) -> None:
        gate.wait()
        pin(station, uuid)
        try:
            plants.sync(station)
            ends.append("done")
        except StoreLockedError:  # another one had it for 10 s
            ends.append("locked")

    threads = [threading.Thread(target=record, args=pair) for pair in zip(homes, nodes, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(ends) == len(homes)
    assert set(ends) <= {"done", "locked"}
    plants.sync(plants.north)
    uuids = [stated.event["uuid"] for stated in plant.status.log(plants.north)]
    assert sorted(uuids) == [uuid.hex() for uuid in nodes]
    assert plants.north.plant.unsent() == 0
    assert alarms(plants.north) == []
    for station in homes:
        station.close()


def test_a_page_of_another_history_is_stored_beside_the_first_one(tmp_path: Path) -> None:
    """Two pages of one number are a fork, which readers have to see."""
    folder, station = FolderTransport(tmp_path), "ab" * 32
    for octets in (b"h.one.s", b"h.another.s", b"h.another.s"):
        folder.append(station, 1, "", hash_of(octets), octets)
    assert sorted(page.octets for page in folder.pages(station, 0)) == [b"h.another.s", b"h.one.s"]


def test_a_stick_that_was_unplugged_is_not_made_anew_on_the_disk_below(tmp_path: Path) -> None:
    """A line that runs on wrote its request into an empty mount point, and waited for an answer that never came."""
    stick = tmp_path / "stick"
    stick.mkdir()
    transport = FolderTransport(stick)
    stick.rmdir()
    with pytest.raises(LinkError, match="There is no folder"):
        transport.send(Parcel("0b5f0b5f-0b5f-4b5f-8b5f-0b5f0b5f0b5f", "0" * 64, b"{}", "2099-01-01T00:00:00Z"))
    assert not stick.exists()
