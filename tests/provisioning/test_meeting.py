"""Where a node is looked for and how long, which of several is meant, and when the wait for boards is over."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    AddressConflictError,
    NoNodeError,
    NoReaderError,
    StoreLockedError,
    TedsProvisionError,
    UsageError,
    VaultLockedError,
)
from teds_provision.links import Contact, LinkSettings, Notice
from teds_provision.links.ports import Port
from teds_provision.links.streaming import MeasuringLink
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning import meeting
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.meeting import (
    IdleStop,
    avoid_measuring_source,
    continue_over_ble,
    drop_duplicate_uuids,
    likely_address,
    likely_places,
    meet,
    pick_single_node,
    refuse_duplicate_uuids,
    watch_nodes,
)
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station

UUID = bytes.fromhex("8d4d9da65281f7000000")
FREE = SimpleNamespace(is_taken_alone=False)
TAKEN = SimpleNamespace(is_taken_alone=True)


def identity(uuid: bytes = UUID, state: NodeState = NodeState.KEYED) -> Identity:
    return Identity(uuid, state, 1, 0, 1024, 0)


class MockLink:
    closed = 0

    def close(self) -> None:
        self.closed += 1


def contact(uuid: bytes = UUID, address: int | None = 0x21, state: NodeState = NodeState.KEYED) -> Contact:
    return Contact(identity(uuid, state), MockLink(), address=address)  # type: ignore[arg-type]


# -- one of several ----------------------------------------------------------------------------------------------------


def test_the_only_node_is_meant_or_the_only_one_that_is_not_finished(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = {bytes([1]) * 10, bytes([2]) * 10}
    monkeypatch.setattr(type(station.datasheets), "reads_well", lambda _own, uuid: uuid in good)
    done, done_too = (contact(bytes([n]) * 10, n, NodeState.PROVISIONED) for n in (1, 2))
    unread = contact(bytes([3]) * 10, 3, NodeState.PROVISIONED)
    new = contact(bytes([4]) * 10, 4, NodeState.FACTORY)
    assert pick_single_node(station, [done]) is done
    assert pick_single_node(station, [done, done_too, new]) is new
    assert pick_single_node(station, [done, unread]) is unread
    with pytest.raises(UsageError) as refused:
        pick_single_node(station, [done, unread, new])
    assert refused.value.message == (
        f"3 nodes answer on the bus, 2 of them not finished: {'03' * 10} at 0x03, {'04' * 10} at 0x04."
    )
    with pytest.raises(UsageError, match=rf"^2 nodes answer on the bus: {'01' * 10} at 0x01, {'02' * 10} at 0x02\.$"):
        pick_single_node(station, [done, done_too])
    many = [contact(bytes([n]) * 10, n) for n in range(10, 16)]
    with pytest.raises(UsageError, match=rf"^6 nodes answer on the bus: .* {'0e' * 10} at 0x0e, …\.$"):
        pick_single_node(station, many)


def test_a_uuid_that_answers_twice_costs_its_own_node_alone() -> None:
    one, twin, other = contact(address=0x21), contact(address=0x22), contact(bytes(10), 0x23)
    notices: list[Notice] = []
    assert drop_duplicate_uuids([one, other, twin], notices.append) == [other]
    (notice,) = notices
    assert (notice.kind, notice.uuid) == ("conflict", UUID)
    assert notice.text.startswith(f"Node {UUID.hex()} answers at 0x21 and at 0x22: one of them is an impostor.")
    assert notice.text.endswith(
        " Disconnect one of them, or select one by node=ADDRESS in --can: its key shows which one is genuine."
    )
    with pytest.raises(AddressConflictError):
        drop_duplicate_uuids([one, twin], notices.append)
    with pytest.raises(AddressConflictError, match="answers at 0x0a and at 0x0b: one of them"):
        refuse_duplicate_uuids([contact(address=0x0A), other, contact(address=0x0B)])


# -- where a node is ---------------------------------------------------------------------------------------------------


def test_where_a_node_is_looked_for_if_no_link_was_chosen(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    last = {UUID: "can:socketcan:can0", bytes(10): "can:socketcan:can0", bytes(9) + b"\1": "ble:hci0"}
    monkeypatch.setattr(type(station.nodes), "last_places", lambda _own, uuids: {uuid: last[uuid] for uuid in uuids})
    assert likely_places(station, LinkSettings(), list(last)) == ("can:socketcan:can0", "ble:hci0")
    named = LinkSettings(can=("socketcan:can1", "socketcan:can2"), ble="hci1")
    assert likely_places(station, named, [UUID]) == ("can:socketcan:can1", "can:socketcan:can2", "ble:hci1")
    for chosen in (LinkSettings(via="can"), LinkSettings(via_chosen=True), LinkSettings(nfc="usb")):
        assert likely_places(station, chosen, [UUID]) == ()
    assert likely_places(station, LinkSettings(nfc="usb", reader_chosen=False), [UUID]) == ("can:socketcan:can0",)


def test_the_address_of_the_last_contact_goes_before_the_nodes_default(station: Station) -> None:
    default = likely_address(station, UUID)
    assert 1 <= default <= 239
    station.nodes.remember(UUID, name="x")
    assert likely_address(station, UUID) == default
    station.nodes.remember(UUID, can_address=5)
    assert likely_address(station, UUID) == 5


Searches = list[tuple[str, float, bool]]


class Desk:
    """The links of a machine: who is where, which reader there is, and what was searched in which order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.there, self.missing = 100.0, "", set[str]()
        self.searched: Searches = []
        self.asked = 0
        monkeypatch.setattr(meeting, "time", self)
        monkeypatch.setattr(meeting, "_met_at", self._met_at)

    def monotonic(self) -> float:
        return self.now

    @contextmanager
    def _met_at(
        self, _station: Any, links: LinkSettings, uuid: bytes, _reporter: Any, before: Any, *, quietly: bool = False
    ) -> Iterator[Any]:
        (place,) = links.places
        self.searched.append((place, links.timeout, quietly))
        if place in self.missing:
            raise NoReaderError(f"There is no {place}.")
        before()
        self.now += links.timeout
        if place != self.there:
            raise NoNodeError(f"Nobody at {place}.", hint="Tap it.")
        yield SimpleNamespace(uuid=uuid, place=place)

    def before(self) -> None:
        self.asked += 1


def met(station: Station, desk: Desk, links: LinkSettings) -> str:
    with meet(station, links, UUID, SilentReporter(), before=desk.before) as node:
        return str(node.place)  # type: ignore[attr-defined]


BUSES = LinkSettings(can=("a:1", "a:2"), timeout=60.0)


def test_each_named_bus_is_searched_for_a_moment_and_then_a_tap_is_waited_for(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(monkeypatch)
    desk.there = "nfc:"
    assert met(station, desk, BUSES) == "nfc:"
    assert desk.searched == [("can:a:1", 1.5, False), ("can:a:2", 1.5, False), ("nfc:", 57.0, False)]
    assert desk.asked == 1, "one question for a passphrase"
    desk.searched.clear()
    desk.there = "can:a:1"
    assert met(station, desk, BUSES) == "can:a:1"
    assert len(desk.searched) == 1


def test_a_reader_of_this_machine_is_looked_at_first_without_a_word(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(monkeypatch)
    links = LinkSettings(nfc="usb", can="a:1", reader_chosen=False, timeout=1.0)
    with pytest.raises(NoNodeError) as lost:
        met(station, desk, links)
    assert desk.searched == [("nfc:usb", 0.4, True), ("can:a:1", 1.0, False), ("nfc:usb", 0.1, False)]
    assert lost.value.message == "Nobody at nfc:usb. It did not answer on a:1 either."
    assert lost.value.hint == "Tap it."


def test_without_a_reader_the_first_bus_gets_the_time_that_is_left(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(monkeypatch)
    desk.missing = {"nfc:"}
    with pytest.raises(NoNodeError) as lost:
        met(station, desk, BUSES)
    assert desk.searched[-2:] == [("nfc:", 57.0, False), ("can:a:1", 57.0, False)]
    assert lost.value.message == (
        f"Node {UUID.hex()} did not answer on a:1 or a:2 within 60 s, and there is no NFC reader."
    )
    desk.there = "can:a:2"
    desk.missing = {"nfc:", "can:a:1"}
    assert met(station, desk, BUSES) == "can:a:2", "an adapter that is not plugged in ends nothing"


# -- beside a measurement ----------------------------------------------------------------------------------------------


class MockPort(MeasuringLink):
    def __init__(self) -> None:
        self.used: list[int] = []
        self.bus = SimpleNamespace(wire="w", source=0xF1, sources=(0xF1, 0xF2, 0xF3))

    @property
    def shared_bus(self) -> Any:
        return self.bus

    def use_source(self, source: int) -> None:
        self.used.append(source)


MockPort.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]  # it has only what is asked of it here


@pytest.mark.parametrize(
    ("running", "taken", "used"),
    [(False, {0xF1}, []), (True, set(), []), (True, {0xF1}, [0xF2]), (True, {0xF1, 0xF2}, [0xF3])],
)
def test_a_node_that_is_measured_is_asked_from_the_next_free_address(
    station: Station, monkeypatch: pytest.MonkeyPatch, running: bool, taken: set[int], used: list[int]
) -> None:
    own = type(station.measurements)
    monkeypatch.setattr(own, "is_running", lambda _own, _uuid: running)
    monkeypatch.setattr(own, "source", lambda _own, _wire, source: TAKEN if source in taken else FREE)
    port = MockPort()
    avoid_measuring_source(station, port, UUID)  # type: ignore[arg-type]
    assert port.used == used


def test_without_a_free_address_another_one_is_to_be_named(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    own = type(station.measurements)
    monkeypatch.setattr(own, "is_running", lambda _own, _uuid: True)
    monkeypatch.setattr(own, "source", lambda _own, _wire, _source: TAKEN)
    for source, other in ((0xF1, "0xF2"), (0xF3, "0xF1")):
        port = MockPort()
        port.bus.source, port.bus.sources = source, (source,)
        with pytest.raises(StoreLockedError) as refused:
            avoid_measuring_source(station, port, UUID)  # type: ignore[arg-type]
        assert refused.value.message == f"Node {UUID.hex()} is being measured from source address 0x{source:02X}."
        assert refused.value.hint == f"Add source={other} to --can, or end that measurement."
    port.bus = None
    avoid_measuring_source(station, port, UUID)  # type: ignore[arg-type]


# -- on over the air ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ble", "named", "place"),
    [
        ("hci0", "C1:D8:57:00:01:01", "ble:hci0?address=C1:D8:57:00:01:01"),
        ("hci0?a=1", "C1:D8:57:00:01:01", "ble:hci0?a=1&address=C1:D8:57:00:01:01"),
        ("hci0?address=X", "C1:D8:57:00:01:01", "ble:hci0?address=X"),
        ("hci0", None, "ble:hci0"),
    ],
)
def test_after_the_tap_the_same_node_is_found_over_the_air(
    monkeypatch: pytest.MonkeyPatch, ble: str, named: str | None, place: str
) -> None:
    found: list[Any] = []
    port = SimpleNamespace(
        closed=0, find=lambda wanted, **more: (wanted(identity()), wanted(identity(bytes(10))), more)
    )
    port.close = lambda: setattr(port, "closed", port.closed + 1)
    monkeypatch.setattr(meeting, "open_place", lambda where, _trace: found.append(where) or port)
    links = LinkSettings(nfc="usb", ble=ble, timeout=7.0)
    go_on = continue_over_ble(links, print)
    assert go_on is not None
    moved: list[Any] = []
    node: Any = SimpleNamespace(
        tapped=True,
        uuid=UUID,
        contact=SimpleNamespace(ble=SimpleNamespace(text=named) if named else None),
        move_to=lambda find, release: moved.append((find(), release)),
    )
    go_on(node)
    assert found == [place]
    ((answers, release),) = moved
    assert answers == (True, False, {"seconds": 7.0, "notice": print})
    assert (release, port.closed) == (port.close, 0)

    failures: list[BaseException] = [NoNodeError("it does not advertise"), KeyboardInterrupt()]

    def fail(_find: object, _release: object) -> None:
        raise failures[port.closed]

    node.move_to = fail
    for closed, failure in enumerate(failures, 1):
        with pytest.raises(type(failure)):
            go_on(node)
        assert port.closed == closed
    node.tapped, node.move_to = False, None
    go_on(node)
    assert continue_over_ble(LinkSettings(nfc="usb"), print) is None
    assert continue_over_ble(LinkSettings(via="can", nfc="usb", ble="hci0"), print) is None
    assert continue_over_ble(LinkSettings(ble="hci0"), print) is None


# -- board after board -------------------------------------------------------------------------------------------------


def test_the_wait_for_the_next_board_is_over_after_its_time_but_not_while_one_is_worked_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimpleNamespace(now=50.0)
    monkeypatch.setattr(meeting, "time", SimpleNamespace(monotonic=lambda: clock.now))
    never = IdleStop(10.0)
    stop = IdleStop(10.0)
    clock.now += 9.9
    assert (never.is_set(), stop.is_set()) == (False, False)
    stop.renew()
    clock.now += 9.9
    assert (never.is_set(), stop.is_set()) == (True, False)
    with stop.working(), stop.working():
        clock.now += 500.0
        assert not stop.is_set()
    assert not stop.is_set(), "the whole time again"
    clock.now += 10.0
    assert (stop.is_set(), stop.ran_out, stop.is_asked, stop.wait(5.0)) == (True, True, False, True)
    for ask in (IdleStop.request_stop, IdleStop.set):
        asked = IdleStop(None)
        clock.now += 1e9
        assert not asked.is_set()
        ask(asked)
        assert (asked.is_set(), asked.is_asked, asked.ran_out) == (True, True, False)
    both = IdleStop(1.0)
    both.request_stop()
    clock.now += 2.0
    assert not both.ran_out, "a person was first"
    assert not IdleStop(None).wait(0.0)
    waits: list[float] = []

    def wait(_event: threading.Event, seconds: float) -> None:
        waits.append(round(seconds, 3))
        clock.now += seconds

    monkeypatch.setattr(threading.Event, "wait", wait)
    assert not IdleStop(None).wait(0.5)
    assert waits == [0.2, 0.2, 0.1], "whoever sets it elsewhere is seen soon"
    assert IdleStop(0.3).wait()


def watched(
    monkeypatch: pytest.MonkeyPatch, ports: list[list[Contact]], work: Callable[[Any], Any]
) -> tuple[list[Any], list[Any]]:
    made = []
    for number, contacts in enumerate(ports):
        port = SimpleNamespace(place=f"nfc:{number}", closed=0, watch=lambda contacts=contacts, **_more: iter(contacts))
        port.close = lambda port=port: setattr(port, "closed", port.closed + 1)
        made.append(port)
    monkeypatch.setattr(meeting, "open_ports", lambda _links: made)
    arrivals: list[Any] = []
    try:
        arrivals += watch_nodes(LinkSettings(), work, SilentReporter(), IdleStop(None))
    finally:
        assert [port.closed for port in made] == [1] * len(made)
    return arrivals, made


@pytest.mark.parametrize("readers", [1, 2])
def test_an_error_ends_one_board_and_each_is_left_before_the_next(
    monkeypatch: pytest.MonkeyPatch, readers: int
) -> None:
    boards = [contact(bytes([number]) * 10) for number in range(4)]
    refused = UsageError("no")

    def work(node: Any) -> str:
        number = node.uuid[0]
        if number == 1:
            raise refused
        if number == 2:
            raise SessionLostError(refused)
        return f"did {number}"

    ports = [boards] if readers == 1 else [boards[:2], boards[2:]]
    arrivals, _ = watched(monkeypatch, ports, work)
    shown = {arrival.uuid[0]: (arrival.place, arrival.result, arrival.error) for arrival in arrivals}
    last = f"nfc:{readers - 1}"
    assert shown == {
        0: ("nfc:0", "did 0", None),
        1: ("nfc:0", None, refused),
        2: (last, None, refused),
        3: (last, "did 3", None),
    }
    assert [board.link.closed for board in boards] == [1] * 4  # type: ignore[attr-defined]


@pytest.mark.parametrize("readers", [1, 2])
def test_a_vault_that_is_locked_ends_the_whole_watch(monkeypatch: pytest.MonkeyPatch, readers: int) -> None:
    def work(_node: Any) -> None:
        raise VaultLockedError("locked")

    boards = [[contact(bytes([number]) * 10)] for number in range(readers)]
    with pytest.raises(VaultLockedError):
        watched(monkeypatch, boards, work)


def test_a_reader_that_is_missing_is_named_with_where_the_node_was_last(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(_links: LinkSettings) -> Port:
        raise NoReaderError("No reader is plugged in.", hint="Plug one in.")

    monkeypatch.setattr(meeting, "open_port", missing)
    station.nodes.remember(UUID, can_address=0x21)

    def error(links: LinkSettings) -> TedsProvisionError:
        with pytest.raises(NoReaderError) as refused, meet(station, links, UUID, SilentReporter()):
            pass
        return refused.value

    found = error(LinkSettings())
    assert found.message == (
        f"No link to node {UUID.hex()} is named, and no NFC reader can be used: No reader is plugged in."
    )
    assert found.hint == (
        "Give its link: --can socketcan:can0, --ble hci0 or --nfc usb; or set it once in config.toml."
        " It was last met on a CAN bus, at address 0x21."
    )
    for address, place in ((0x0A, "0x0A"), (0, None)):
        station.nodes.remember(UUID, can_address=address)
        hint = error(LinkSettings()).hint
        assert hint.endswith(f" It was last met on a CAN bus, at address {place}." if place else "in config.toml.")
    assert error(LinkSettings(nfc="usb")).message == "No reader is plugged in."
    assert error(LinkSettings(via_chosen=True)).message == "No reader is plugged in."


# -- at one link -------------------------------------------------------------------------------------------------------


class OnePort:
    """A port at which these nodes are, and what was asked of it in which order."""

    def __init__(self, *contacts: Contact) -> None:
        self.contacts, self.calls = list(contacts), list[Any]()

    def find(self, wanted: Callable[[Identity], bool], **asked: Any) -> Contact:
        self.calls.append(asked)
        found = [contact for contact in self.contacts if wanted(contact.identity)]
        if not found:
            raise NoNodeError("nobody")
        return found[0]

    def find_all(self, **asked: Any) -> list[Contact]:
        self.calls.append(asked)
        return self.contacts

    def close(self) -> None:
        self.calls.append("closed")


def opened(monkeypatch: pytest.MonkeyPatch, *contacts: Contact) -> OnePort:
    port = OnePort(*contacts)
    monkeypatch.setattr(meeting, "open_port", lambda _links: port.calls.append("opened") or port)
    monkeypatch.setattr(meeting, "avoid_measuring_source", lambda *asked: port.calls.append(asked[2]))
    return port


def test_one_node_is_met_on_the_chosen_link_at_its_last_address_and_left_whole(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, meant = contact(bytes(10), 0x22), contact()
    port = opened(monkeypatch, other, meant)
    station.nodes.remember(UUID, can_address=0x21)
    links, reporter = LinkSettings(via="can", can="a:1", timeout=7.0, via_chosen=True), SilentReporter()
    with meet(station, links, UUID, reporter, before=lambda: port.calls.append("asked")) as node:
        assert node.contact is meant
        assert port.calls == [
            "opened", UUID, "asked", {"seconds": 7.0, "notice": reporter.notice, "address": 0x21},
        ]  # fmt: skip
    assert port.calls[-1] == "closed"
    assert meant.link.closed == 1  # type: ignore[attr-defined]
    with meeting._met_at(station, links, UUID, reporter, print, quietly=True):
        assert port.calls[-1]["notice"] != reporter.notice, "a look aside says nothing"
    port.contacts = [other]
    with pytest.raises(NoNodeError), meet(station, links, UUID, reporter):
        pass
    assert port.calls[-1] == "closed"


def test_any_node_is_the_only_one_that_is_not_finished(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(type(station.datasheets), "reads_well", lambda *_: True)
    done, new = contact(bytes(10), 0x22, NodeState.PROVISIONED), contact()
    port = opened(monkeypatch, done, new)
    links, reporter = LinkSettings(via="can", can="a:1", timeout=7.0), SilentReporter()
    with meet(station, links, None, reporter, before=lambda: port.calls.append("asked")) as node:
        assert node.contact is new
    assert port.calls == ["opened", "asked", {"seconds": 7.0, "notice": reporter.notice}, "closed"]
    port.contacts = [new, contact(bytes(9) + b"\1", 0x23, NodeState.KEYED)]
    with pytest.raises(UsageError), meet(station, links, None, reporter):
        pass
    assert port.calls[-1] == "closed"


def test_all_nodes_are_met_but_those_that_cannot_be_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    one, twin, other = contact(address=0x21), contact(address=0x22), contact(bytes(10), 0x23)
    port = opened(monkeypatch, one, twin, other)
    links, reporter = LinkSettings(via="can", can="a:1", timeout=7.0, listen=2.0), SilentReporter()
    with meeting.meet_all(links, reporter) as nodes:
        assert [node.contact for node in nodes] == [other]
    assert port.calls == ["opened", {"seconds": 7.0, "notice": reporter.notice, "listen": 2.0}, "closed"]
    assert [found.link.closed for found in (one, twin, other)] == [0, 0, 1]  # type: ignore[attr-defined]


def test_the_readers_are_stopped_when_the_caller_stops_or_one_of_them_fails() -> None:
    def serve(*, stop: threading.Event, notice: object) -> Iterator[Contact]:
        yield contact()
        threading.Event.wait(stop)

    ports: Any = [SimpleNamespace(place=f"nfc:{number}", watch=serve) for number in range(2)]
    stop = threading.Event()
    arrivals = meeting._together(ports, lambda _node: "done", SilentReporter(), stop)
    assert next(arrivals).result == "done"
    arrivals.close()  # type: ignore[attr-defined]
    assert stop.is_set()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("nfc:")]
