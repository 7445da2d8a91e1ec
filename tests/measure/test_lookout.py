"""What is seen on the buses, who begins together, whether datasheets suffice, and who holds what: without a bus."""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    AddressConflictError,
    BadDataError,
    BadDatasheetError,
    InternalError,
    NodeRefusedError,
    NoNodeError,
    NotAuthenticError,
    PolicyError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.links.can.link import conflict
from teds_provision.links.discovery import PolledDiscovery, Sighting
from teds_provision.links.ports import Contact
from teds_provision.measure import presence, request
from teds_provision.measure.clock import ClockMap, Exchange
from teds_provision.measure.presence import MOST, TWIN, Presence
from teds_provision.measure.request import Requirements
from teds_provision.measure.running import common_start, retry_policy
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.retry_policy import RetryPolicy
from teds_provision.protocol.announce import Announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.stream_commands import SOON, WAITS
from teds_provision.station.store.lock import UsageLock, UsageLockTakenError
from teds_provision.teds.fits import parse_require
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from tests.e2e.desk import ANGLE
from tests.pace import PATIENCE, until

ONE, TWO, THREE = (bytes([number]) * 10 for number in (1, 2, 3))


class Port:
    """A port that is only named."""

    def __init__(self, place: str) -> None:
        self.place = place


def seen(uuid: bytes, address: int, *, place: str = "can:x", at: float | None = None) -> Sighting:
    identity = Identity(uuid, NodeState.PROVISIONED, 1, 1, 2048, address)
    port: Any = Port(place)
    return Sighting(identity, address, port, time.monotonic() if at is None else at)


def find(sightings: Presence, uuid: bytes, **more: Any) -> Sighting:
    return sightings.find(uuid, seconds=more.pop("seconds", 0.05), stop=threading.Event(), **more)


def test_a_node_that_was_seen_is_found_and_one_that_was_not_is_missing_meanwhile() -> None:
    sightings = Presence()
    sightings.add_sighting(seen(ONE, 7))
    assert find(sightings, ONE).address == 7
    with pytest.raises(NoNodeError):
        find(sightings, TWO)
    assert not sightings.missing()
    found: list[Sighting] = []
    waiting = threading.Thread(target=lambda: found.append(find(sightings, TWO, seconds=PATIENCE)))
    waiting.start()
    until(sightings.missing)
    assert sightings.is_awaited(Announce(9, 2, uuid_crc(TWO)))
    assert not sightings.is_awaited(Announce(9, 2, uuid_crc(ONE)))
    sightings.add_sighting(seen(TWO, 9))
    waiting.join(60)
    assert [sighting.address for sighting in found] == [9]


class EmptyAir:
    """An adapter that hears nobody."""

    place = "ble:x"
    rounds = 0

    def find_all(self, **_more: object) -> Iterator[Contact]:
        self.rounds += 1
        raise NoNodeError("Nobody advertises.")


def test_who_asks_a_look_out_that_has_nothing_to_do_waits_for_one_round_alone() -> None:
    air: Any = EmptyAir()
    lookout = PolledDiscovery(air, Presence())
    began = time.monotonic()
    lookout.discover()
    lookout.discover()
    seconds = time.monotonic() - began
    lookout.close()
    assert air.rounds == 2
    assert seconds < lookout.LONGEST / 2


def test_what_turned_out_wrong_goes_behind_another_that_says_the_same() -> None:
    sightings = Presence()
    forged, true = seen(ONE, 7), seen(ONE, 8)
    sightings.add_sighting(forged)
    sightings.search_again(forged)
    for sighting in (seen(ONE, 7), true, seen(ONE, 7)):
        sightings.add_sighting(sighting)
    assert find(sightings, ONE).address == 8


def test_the_node_itself_is_waited_for_if_a_copy_of_its_identity_answers_sooner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Who answers at once was taken again and again, and the node, after its random wait, never."""
    monkeypatch.setattr("teds_provision.measure.presence.TWIN", 5.0)
    sightings = Presence()
    copy, true = seen(ONE, 7), seen(ONE, 8)
    sightings.add_sighting(copy)
    sightings.add_sighting(true)
    sightings.search_again(copy)
    lost = time.monotonic()
    sightings.add_sighting(seen(ONE, 7))
    with pytest.raises(NoNodeError):
        find(sightings, ONE, fresh=lost)
    sightings.add_sighting(seen(ONE, 8))
    assert find(sightings, ONE, fresh=lost).address == 8
    sightings.search_again(seen(ONE, 8))
    alone = time.monotonic()
    sightings.add_sighting(seen(ONE, 7))
    monkeypatch.setattr("teds_provision.measure.presence.TWIN", TWIN)
    assert find(sightings, ONE, seconds=PATIENCE, fresh=alone).address == 7, "nobody else answers: it is tried again"


def test_a_copy_that_refuses_is_no_reason_to_give_a_node_up_that_answers_elsewhere() -> None:
    """Who gave himself a node's UUID, and said that he knows no key, ended its measurement before it began."""
    sightings, unknown = Presence(), PolicyError("It knows none of the keys.")
    copy = seen(ONE, 7)
    sightings.add_sighting(copy)
    sightings.search_again(copy)
    look = functools.partial(sightings.has_other_place, ONE)
    assert RetryPolicy(60.0).gives_up(unknown, proven=False, elsewhere=look), "nobody else answers"
    threading.Timer(TWIN / 5, sightings.add_sighting, [seen(ONE, 8)]).start()
    assert not RetryPolicy(60.0).gives_up(unknown, proven=False, elsewhere=look)
    assert RetryPolicy(60.0).gives_up(unknown, proven=True, elsewhere=look), "said in a session it is the node's word"
    assert not RetryPolicy(None).gives_up(unknown, proven=True, elsewhere=look)
    assert not RetryPolicy(60.0).gives_up(NodeRefusedError("busy", reason=17), proven=True, elsewhere=look)
    assert RetryPolicy(0.0).gives_up(NodeRefusedError("busy", reason=17), proven=True, elsewhere=look)


def test_a_copy_that_refuses_while_the_node_is_silent_for_a_moment_is_no_reason_either() -> None:
    sightings, unknown = Presence(), PolicyError("It knows none of the keys.")
    for silent_then_copy in (8, 7):
        sightings.add_sighting(seen(ONE, silent_then_copy))
        sightings.search_again(seen(ONE, silent_then_copy))
    look = functools.partial(sightings.has_other_place, ONE)
    assert not RetryPolicy(60.0).gives_up(unknown, proven=False, elsewhere=look)


def test_made_up_uuids_fill_no_memory_and_put_no_node_out() -> None:
    sightings = Presence()
    announced = seen(TWO, 8)
    sightings.add_sighting(announced)
    sightings.on_announce(announced, lambda: None)
    for number in range(3 * MOST):
        sightings.add_sighting(seen(number.to_bytes(10, "big"), number % 239))
        if number % 100 == 0:
            sightings.add_sighting(seen(ONE, 7))  # answers now and then, as everyone is asked every 30 s
    assert len(sightings.all()) <= MOST + 1, "beside the one that is measured"
    assert {ONE, TWO} <= {sighting.uuid for sighting in sightings.all()}


def test_only_what_was_seen_since_counts_for_a_node_that_was_lost() -> None:
    sightings = Presence()
    sightings.add_sighting(seen(ONE, 7))
    with pytest.raises(NoNodeError):
        find(sightings, ONE, fresh=time.monotonic())


def test_nothing_is_opened_under_an_address_that_two_nodes_have() -> None:
    messages: list[str] = []
    sightings = Presence(note=messages.append)
    sightings.add_sighting(seen(ONE, 7))
    sightings.conflict("can:x", 7, conflict(7))
    with pytest.raises(AddressConflictError):
        find(sightings, ONE)
    assert messages


def test_an_announce_is_passed_on_by_address_or_by_uuid() -> None:
    sightings, heard = Presence(), list[str]()
    for name, uuid, address in (("one", ONE, 7), ("two", TWO, 8)):
        sightings.on_announce(seen(uuid, address), lambda name=name: heard.append(name))
    sightings.announced("can:x", Announce(7, 2, 0))
    sightings.announced("can:x", Announce(99, 2, uuid_crc(TWO)))
    sightings.announced("can:other", Announce(7, 2, uuid_crc(TWO)))
    assert heard == ["one", "two"]
    sightings.let_announce(ONE)
    sightings.announced("can:x", Announce(7, 2, 0))
    assert heard == ["one", "two"]


def clock(offset: int) -> ClockMap:
    """Return a node's clock that stands ``offset`` ns behind the host's, asked just now."""
    made, now = ClockMap(), time.monotonic_ns()
    made.exchange(Exchange(now - 2000, now, now - 1500 - offset, now - 500 - offset, 1, 50))
    return made


def test_nodes_that_are_there_in_time_begin_at_one_moment_and_a_late_one_when_it_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("teds_provision.measure.running.common_start.AHEAD", 2.0)  # both are awake before it
    common = CommonStart({ONE, TWO, THREE}, waiting=1.0)
    clocks, ticks = {ONE: clock(10**9), TWO: clock(7 * 10**9)}, dict[bytes, int]()
    began = time.monotonic()
    threads = [
        threading.Thread(target=lambda uuid=uuid: ticks.update({uuid: common.start(uuid, clocks[uuid])}))
        for uuid in clocks
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    moments = [clocks[uuid].host_of(tick) for uuid, tick in ticks.items()]
    assert abs(moments[0] - moments[1]) < 1e-4
    assert min(moments) > began + 1.0 + 2.0
    assert common.spread == pytest.approx(abs(moments[0] - moments[1]), abs=1e-6)
    assert 0 <= common.seconds_until(ticks[ONE]) < 3
    assert common.start(ONE, clocks[ONE]) == SOON, "after a restart it begins by itself"
    while common.seconds_until(ticks[ONE]):
        time.sleep(0.01)
    assert common.start(THREE, clock(0)) == SOON


def test_a_node_alone_waits_for_no_other_and_one_that_is_gone_is_not_waited_for() -> None:
    assert CommonStart({ONE}).start(ONE, clock(0)) == SOON
    common = CommonStart({ONE, TWO}, waiting=math.inf)  # no wait is so long: it would raise
    common.drop_node(TWO)
    assert common.start(ONE, clock(0)) != SOON


def test_a_stream_waits_for_the_trigger_until_it_has_gone_out() -> None:
    common = CommonStart({ONE, TWO}, trigger=True)
    assert common.start(ONE, clock(0)) == WAITS
    assert not common.due(1, 2)
    assert common.due(2, 2)
    assert common.seconds_left is None
    common.triggered()
    assert not common.due(2, 2)
    assert common.start(TWO, clock(0)) == SOON


def sheet(uuid: bytes) -> Sheet:
    return Sheet.from_image(Image(uuid, load_profile(ANGLE, None).build(uuid).blocks))


def test_a_trigger_waits_for_all_nodes_15_s_from_the_first_ready_one_and_is_noticed_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(common_start, "time", SimpleNamespace(monotonic=lambda: now[0]))
    common = CommonStart({ONE, TWO}, trigger=True)
    assert (common.due(0, 2), common.notice_due()) == (False, False)
    now[0] = 900.0
    assert (common.due(0, 2), common.notice_due()) == (False, False), "nobody is ready yet"
    assert (common.due(1, 2), common.notice_due()) == (False, False)
    now[0] = 901.0
    assert not common.notice_due()
    now[0] = 901.5
    assert [common.notice_due(), common.notice_due()] == [True, False]
    now[0] = 915.0
    assert not common.due(1, 2)
    now[0] = 915.5
    assert common.due(1, 2)
    assert common.due(0, 2), "the first one counts, though it has gone since"
    common.triggered()
    assert (common.due(2, 2), common.seconds_left) == (False, 0.0)
    at_once = CommonStart({ONE, TWO})
    assert not at_once.due(2, 2), "a start time needs no trigger"
    assert (at_once.seconds_left, at_once.spread) == (0.0, 0.0)
    for uuid, tick in ((ONE, 10**9), (TWO, 10**9 + 4_000_000)):
        at_once.record_start(uuid, clock(0), tick)
    assert at_once.spread == pytest.approx(0.004, abs=1e-4)


def test_datasheets_are_judged_once_all_are_there_and_one_that_is_gone_is_not_waited_for() -> None:
    met = parse_require('[angle]\nrange = ">= 10 deg"\n', "task")
    required = Requirements(met, waiting=60)
    required.expect([ONE, TWO])
    threading.Timer(0.05, required.drop_node, [TWO]).start()
    with pytest.raises(PolicyError):  # a profile without calibration gives no value
        required.offer(ONE, sheet(ONE), threading.Event())
    assert [fit["uuid"] for fit in required.fits] == [ONE.hex()]


def test_a_mark_names_its_holder_and_shows_one_that_was_killed(tmp_path: Path) -> None:
    place = tmp_path / "marks" / "bus.lock"
    with UsageLock(place, command="measure crane") as held:
        assert not held.left_behind
        assert UsageLock(place, command="").is_taken
        with pytest.raises(UsageLockTakenError, match="measure crane"), UsageLock(place, command="set"):
            pass
        with pytest.raises(UsageLockTakenError), UsageLock(place, command="set", shared=True):
            pass
    assert not UsageLock(place, command="").is_taken
    with (
        UsageLock(place, command="set a", shared=True),
        UsageLock(place, command="set b", shared=True),
        pytest.raises(UsageLockTakenError, match="set b"),
        UsageLock(place, command="measure"),
    ):
        pass
    with UsageLock(place, command="set b", shared=True), UsageLock(place, command="set c", shared=True):
        with UsageLock(place, command="set d", shared=True):
            pass
        with pytest.raises(UsageLockTakenError, match="set d"), UsageLock(place, command="measure"):
            pass  # the first to leave takes no name away: it may be that of one who stays
    with UsageLock(place, command="measure") as free:
        assert not free.left_behind, "whoever leaves in order puts the mark away"
    place.write_text(f"{{{' ' * 500}}}")  # what a process leaves that was killed, of a longer name than the next one's
    with UsageLock(place, command="measure") as again:
        assert again.left_behind
        assert "(measure)" in (again.holder or "")


def test_of_too_many_nodes_the_one_that_was_heard_longest_ago_is_forgotten() -> None:
    sightings, uuids = Presence(), [number.to_bytes(10, "big") for number in range(MOST + 1)]
    for uuid in (*uuids[:MOST], uuids[0], uuids[MOST]):  # the first one answers again before one too many comes
        sightings.add_sighting(seen(uuid, 7))
    assert {sighting.uuid for sighting in sightings.all()} == {*uuids} - {uuids[1]}


def test_a_node_is_missing_until_the_last_of_those_who_wait_for_it_has_gone() -> None:
    sightings = Presence()
    found = threading.Event()

    def wait() -> None:
        sightings.find(ONE, seconds=PATIENCE, stop=threading.Event())
        found.set()

    waiting = threading.Thread(target=wait)
    waiting.start()
    until(sightings.missing)
    for _ in range(2):
        with pytest.raises(NoNodeError):
            find(sightings, ONE, seconds=0.0)
        assert sightings.missing()
    sightings.add_sighting(seen(ONE, 7))
    waiting.join(PATIENCE)
    assert found.is_set()
    assert not sightings.missing()


def test_a_sighting_wakes_those_alone_who_wait_for_that_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand nodes that begin together would wake each other half a million times."""
    sightings, woken = Presence(), list[str]()

    def notified(waits: threading.Condition) -> None:
        woken.append(next(name for name, own in conditions.items() if own is waits))

    with sightings._turn, ExitStack() as waiting:
        names = {"one": ONE, "one again": ONE, "two": TWO, "three": THREE}
        conditions = {name: waiting.enter_context(sightings._news_of(uuid)) for name, uuid in names.items()}
        monkeypatch.setattr(threading.Condition, "notify", notified)
        sightings._turn.release()
        try:
            sightings.add_sighting(seen(TWO, 7))
            assert woken == ["two"]
            sightings.add_sighting(seen(ONE, 8))
            assert sorted(woken[1:]) == ["one", "one again"]
            sightings.conflict("can:x", 9, conflict(9))
            assert len(woken) == 3 + 4, "whoever may have been at that address"
        finally:
            sightings._turn.acquire()
    assert not sightings._waiting


def test_a_measured_node_is_never_forgotten_however_many_are_measured() -> None:
    """More than 1024 on the buses of one process: the one that answers last is found like the first."""
    sightings, measured = Presence(), [number.to_bytes(10, "big") for number in range(1100)]
    for uuid in measured:
        sightings.add_sighting(seen(uuid, 7))
        sightings.on_announce(find(sightings, uuid), lambda: None)
    for uuid in (measured[0], measured[-1]):
        sightings.add_sighting(seen(uuid, 7))
    assert {sighting.uuid for sighting in sightings.all()} == {*measured}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_two_places_the_one_that_answered_last_is_tried(order: tuple[int, int]) -> None:
    sightings, now = Presence(), time.monotonic()
    places = seen(ONE, 7, at=now - 5.0), seen(ONE, 9, place="can:y", at=now)
    for place in order:
        sightings.add_sighting(places[place])
    assert find(sightings, ONE).address == 9
    last = sightings.seen_at(ONE)
    assert last is not None
    assert (last.address, [sighting.address for sighting in sightings.all()]) == (9, [9])


def test_datasheets_are_waited_for_from_the_first_one_on_however_many_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """If one of ten never comes, the last of the others would wait ten times as long."""
    now = [100.0]
    monkeypatch.setattr(request, "time", SimpleNamespace(monotonic=lambda: now[0]))

    class Turn:
        def __enter__(self) -> None:
            pass

        def __exit__(self, *_: object) -> None:
            pass

        def notify_all(self) -> None:
            pass

        def wait(self, seconds: float) -> None:
            now[0] += seconds

    requirements = Requirements((), waiting=10.0)
    monkeypatch.setattr(requirements, "_turn", Turn())
    requirements.expect([ONE, TWO, THREE])
    for uuid in (ONE, TWO):
        requirements.offer(uuid, sheet(uuid), threading.Event())
        assert now[0] == pytest.approx(110.0)


def test_two_nodes_at_one_address_are_the_reason_for_half_a_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(presence, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sightings = Presence()
    sightings.add_sighting(seen(ONE, 7, at=100.0))
    sightings.add_sighting(seen(TWO, 8, at=100.0))
    sightings.conflict("can:x", 7, AddressConflictError("Two nodes answer at 0x07.", hint="Change one."))
    assert sightings.seen_at(ONE) is None, "nothing is opened there"
    assert sightings.seen_at(TWO) is not None
    for after, error in ((29.0, AddressConflictError), (31.0, NoNodeError)):
        now[0] = 100.0 + after
        with pytest.raises(error):
            find(sightings, ONE, seconds=-1.0)


def test_a_node_that_answers_where_it_is_has_not_moved() -> None:
    """Each broadcast would make its supervisor doubt a session that gives values."""
    sightings, course = Presence(), list[str]()
    here, there = seen(ONE, 7), seen(ONE, 9, place="can:y")
    sightings.on_announce(here, lambda: course.append("announced"), lambda: course.append("moved"))
    for sighting in (here, seen(TWO, 9), here):
        sightings.add_sighting(sighting)
    assert course == []
    sightings.add_sighting(there)
    assert course == ["moved"]
    sightings.let_announce(ONE)
    sightings.add_sighting(there)
    assert course == ["moved"]


NO_KEY, SILENT = PolicyError("It knows none of the keys."), NoNodeError("Silent.")


@pytest.mark.parametrize(
    ("timeout", "ran", "after", "error", "how", "gives_up"),
    [
        (10.0, False, 9.9, SILENT, {}, False),
        (10.0, False, 10.1, SILENT, {}, True),
        (10.0, False, 0.0, NO_KEY, {"proven": True}, True),
        (10.0, False, 0.0, NO_KEY, {"elsewhere": True}, False),
        (10.0, False, 0.0, NO_KEY, {}, True),
        (10.0, False, 0.0, NO_KEY, {"decided": True, "elsewhere": True}, True),
        (10.0, False, 0.0, NotAuthenticError("Forged."), {"proven": True}, True),
        (10.0, False, 0.0, BadDataError("No sensor."), {"proven": True}, True),
        (10.0, False, 0.0, StoreError("The disk is away."), {"proven": True}, True),
        (10.0, False, 0.0, InternalError("A bug."), {"proven": True}, True),
        (10.0, False, 0.0, NodeRefusedError("Busy.", reason=17), {"proven": True}, False),
        (10.0, False, 10.1, NodeRefusedError("Busy.", reason=17), {"proven": True}, True),
        (10.0, False, 0.0, NodeRefusedError("No stream.", reason=22), {"proven": True}, False),
        (10.0, False, 0.0, NodeRefusedError("Too long.", reason=4), {"proven": True}, True),
        (10.0, True, 99.0, SILENT, {}, False),
        (10.0, True, 0.0, NO_KEY, {"proven": True}, False),
        (10.0, True, 0.0, NO_KEY, {"decided": True}, True),
        (10.0, True, 0.0, BadDatasheetError("Not authentic."), {"proven": True}, True),
        (10.0, True, 0.0, BadDatasheetError("Not authentic."), {}, False),
        (None, False, 99.0, SILENT, {}, False),
        (None, False, 0.0, NO_KEY, {"decided": True}, False),
        (None, True, 0.0, BadDatasheetError("Not authentic."), {"proven": True}, False),
    ],
)
def test_when_a_node_is_given_up(
    timeout: float | None,
    ran: bool,
    after: float,
    error: TedsProvisionError,
    how: dict[str, bool],
    gives_up: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until its first value for a time, and at once for what no time cures; the service never gives up."""
    now = [100.0]
    monkeypatch.setattr(retry_policy, "time", SimpleNamespace(monotonic=lambda: now[0]))
    policy = RetryPolicy(timeout)
    if ran:
        policy.has_run()
    now[0] += after
    found = policy.gives_up(
        error,
        proven=how.get("proven", False),
        decided=how.get("decided", False),
        elsewhere=lambda: how.get("elsewhere", False),
    )
    assert found is gives_up


def test_a_node_that_is_tried_again_says_when_and_for_how_long(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(retry_policy, "time", SimpleNamespace(monotonic=lambda: now[0]))
    policy = RetryPolicy(10.0)
    now[0] = 103.0
    assert (policy.next_try(2.0), policy.next_try(8.0)) == ("2 s, giving up in 7 s", "7 s, giving up in 7 s")
    now[0] = 111.0
    assert policy.seconds_left == 0.0
    policy.has_run()
    assert (policy.next_try(8.0), policy.seconds_left) == ("8 s", math.inf)


def test_the_same_trouble_with_addresses_is_noted_every_ten_minutes(monkeypatch: pytest.MonkeyPatch) -> None:
    now, notes = [1000.0], list[str]()
    monkeypatch.setattr(presence, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sightings = Presence(note=lambda text: notes.append(f"{text} at {now[0] - 1000.0:g}"))
    for at, text in ((0.0, "one"), (1.0, "two"), (599.0, "one"), (600.0, "one"), (600.5, "two"), (601.5, "two")):
        now[0] = 1000.0 + at
        sightings.report(text)
    assert notes == ["one at 0", "two at 1", "one at 600", "two at 601.5"]
    for number in range(1100):
        sightings.report(str(number))
    assert len(sightings._reported) == 1024, "who makes up addresses fills no memory"
    assert "one" not in sightings._reported, "the oldest is forgotten"


def test_a_node_is_gone_once_however_often_it_is_waited_for_in_vain() -> None:
    sightings = Presence()
    for _ in range(3):
        with pytest.raises(NoNodeError, match=f"Node {ONE.hex()} did not answer within 0 s"):
            find(sightings, ONE, seconds=0.0)
    assert sightings.gone == 1
    sightings.add_sighting(seen(ONE, 7))
    find(sightings, ONE)
    assert sightings.gone == 1
    with pytest.raises(NoNodeError):
        find(sightings, ONE, seconds=0.0, fresh=time.monotonic() + 5.0)
    assert sightings.gone == 2


def test_who_stops_waiting_for_a_node_is_told_that_it_did_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = threading.Event()
    stopped.set()
    monkeypatch.setattr(threading.Condition, "wait", lambda _news, _seconds: pytest.fail("it waits on"))
    with pytest.raises(NoNodeError):
        Presence().find(ONE, seconds=PATIENCE, stop=stopped)


def test_nodes_that_are_welcome_are_those_that_were_named_last() -> None:
    sightings = Presence()
    for named in ([ONE, TWO], [TWO, THREE]):
        sightings.expect(named)
    welcome = [sightings.is_welcome(Announce(9, 2, uuid_crc(uuid))) for uuid in (ONE, TWO, THREE)]
    assert welcome == [False, True, True]
    assert not sightings.is_awaited(Announce(9, 2, uuid_crc(TWO))), "no thread waits for it"


def test_a_place_of_two_boards_is_one_more_place_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presence, "TWIN", 0.0)
    monkeypatch.setattr(presence, "ROUND", 0.0)
    sightings = Presence()
    sightings.add_sighting(seen(ONE, 7))
    assert not sightings.has_other_place(ONE)
    sightings.search_again(seen(ONE, 7))
    assert not sightings.has_other_place(ONE), "it was wrong there, and that is the one place"
    sightings.conflict("can:y", 7, conflict(7))
    assert not sightings.has_other_place(ONE), "the same address of another bus"
    sightings.conflict("can:x", 7, conflict(7))
    assert sightings.has_other_place(ONE)
    assert sightings.conflict_at(seen(TWO, 7)) is not None
    assert sightings.conflict_at(seen(TWO, 8)) is None
