"""What a station makes of each frame that comes to it, and what it sends for it (wire.md, "CAN"). The bus is a mock."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from queue import Empty

import pytest

from teds_provision.errors import LinkClosedError, LinkError
from teds_provision.links.can.bus_multiplexer import AddressConflicts, AddressPair, BusMultiplexer
from teds_provision.links.can.data_streams import CanStreams
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec

FROM_NODE, TO_NODE = 0x18DAF121, 0x18DA21F1
GO_ON, SENT_AWAY = "301000cccccccccc", "321000cccccccccc"
FIRST, SECOND, THIRD = "1014070102030405", "21060708090a0b0c", "220d0e0f10111213"
WHOLE = "07" + bytes(range(1, 20)).hex()


class MockBus:
    """A bus on which a test speaks for everyone else; it notes what the station sends."""

    can_be_waited_for = stamps_arrivals = False
    busy_seconds = 0.0

    def __init__(self) -> None:
        self.spec = parse_spec("virtual:mock")
        self.sent: list[Frame] = []
        self.failure: LinkError | None = None
        self._frames: queue.Queue[Frame] = queue.Queue()
        self._taken = False

    def hear(self, *datas: str, identifier: int = FROM_NODE, fd: bool = False, at: float = 0.0) -> list[str]:
        """Let frames come, one after the other; return the data of what the station sends to the node for them."""
        before = len(self.sent)
        for data in datas:
            self._frames.put(Frame(identifier, bytes.fromhex(data), fd, at))
        self._frames.join()
        answers = self.sent[before:]
        assert {frame.identifier for frame in answers} <= {TO_NODE}
        assert {frame.fd for frame in answers} <= {fd}
        return [frame.data.hex() for frame in answers]

    def receive(self, seconds: float) -> Frame | None:
        if self._taken:
            self._taken = False
            self._frames.task_done()
        try:
            frame = self._frames.get(timeout=seconds)
        except Empty:
            if self.failure is not None:
                raise self.failure from None
            return None
        self._taken = True
        return frame

    def send(self, frame: Frame) -> None:
        self.sent.append(frame)

    def close(self) -> None:
        """Be gone."""


@pytest.fixture
def bus() -> MockBus:
    return MockBus()


@pytest.fixture
def station(bus: MockBus) -> Iterator[BusMultiplexer]:
    made = BusMultiplexer(bus)  # type: ignore[arg-type]
    made.conflicts = AddressConflicts(0xF1, lambda: 0.0)
    made.conflicts._opened = -3.0
    yield made
    made.close()


def events(line: AddressPair) -> list[str]:
    """Return what the thread that waits for the reply learns: ``whole`` with the octets, else the word."""
    learnt = []
    while not line.events.empty():
        event = line.events.get_nowait()
        learnt.append(event.body.hex() if event.kind == "whole" else event.kind)
    return learnt


def test_a_reply_is_asked_on_frame_by_frame_until_it_is_whole(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(FIRST) == [GO_ON]
        assert bus.hear(SECOND) == []
        assert bus.hear(THIRD) == []
        assert events(line) == ["begun", WHOLE]
        line.gap = 5
        assert bus.hear(FIRST) == ["301005cccccccccc"], "the gap that leaves room for data"


def test_a_reply_in_fd_is_asked_on_in_fd(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear("104607" + "11" * 61, fd=True) == [GO_ON]
        assert bus.hear("21" + "11" * 8 + "cccccc", fd=True) == []
        assert events(line) == ["begun", "07" + "11" * 69]
        bus.hear(f"1{62 + 17 * 63:03x}07" + "11" * 61, fd=True)
        assert bus.hear(*(f"2{number & 15:x}" + "11" * 63 for number in range(1, 18)), fd=True) == [GO_ON]


def test_a_flow_control_is_due_after_each_sixteen_frames_and_none_at_the_end(
    bus: MockBus, station: BusMultiplexer
) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        length = 6 + 33 * 7
        assert bus.hear(f"1{length:03x}07" + "22" * 5) == [GO_ON]
        for number in range(1, 34):
            due = [GO_ON] if number in (16, 32) else []
            assert bus.hear(f"2{number & 15:x}" + "22" * 7) == due, number
        assert events(line) == ["begun", "07" + "22" * (length - 1)]


def test_a_frame_that_comes_twice_does_no_harm(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(FIRST, FIRST) == [GO_ON]
        assert bus.hear(SECOND, SECOND, THIRD) == []
        assert events(line) == ["begun", WHOLE]


def test_a_reply_that_begins_again_is_taken_from_there_and_another_one_is_a_second_node(
    bus: MockBus, station: BusMultiplexer
) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(FIRST, SECOND, FIRST) == [GO_ON, GO_ON]
        assert bus.hear(SECOND, THIRD) == []
        assert events(line) == ["begun", "begun", WHOLE]
        assert bus.hear(FIRST, FIRST[:-2] + "ff") == [GO_ON, GO_ON]
        assert events(line) == ["begun", "clash", "begun"]


def test_the_rest_of_a_torn_reply_is_sent_away(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(FIRST, THIRD) == [GO_ON, SENT_AWAY]
        assert events(line) == ["begun", "torn"]
        assert bus.hear(SECOND, THIRD) == []
        assert events(line) == []
        assert bus.hear(FIRST, SECOND, THIRD) == [GO_ON]
        assert events(line) == ["begun", WHOLE]


@pytest.mark.parametrize(("octets", "answer"), [(0x0FFF, GO_ON), (0x1000, SENT_AWAY), (0x7FFFFFFF, SENT_AWAY)])
def test_a_reply_of_more_than_4095_octets_is_sent_away(
    bus: MockBus, station: BusMultiplexer, octets: int, answer: str
) -> None:
    head = f"1{octets:03x}07aaaaaaaaaa" if octets < 4096 else f"1000{octets:08x}07aa"
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(head) == [answer]
        assert events(line) == (["begun"] if answer == GO_ON else [])


def test_a_reply_of_one_frame_wakes_also_who_waits_for_a_flow_control(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear("0407010000cccccc") == []
        assert events(line) == ["07010000"]
        assert line.flows.get_nowait() == b""


def test_a_reply_of_another_transaction_is_dropped_and_a_late_one_ended(bus: MockBus, station: BusMultiplexer) -> None:
    """A late one would keep the node busy; one that nobody asked for is for another station at this address."""
    pair = station.address_pair(0x21)
    with pair.exchange(6):
        pass
    with pair.exchange(7) as line:
        late, foreign = FIRST.replace("07", "06", 1), FIRST.replace("07", "63", 1)
        assert bus.hear(late) == [SENT_AWAY]
        assert bus.hear("0406010000cccccc") == []
        for count in range(4):
            assert not station.conflicts.seen_within(), count
            assert bus.hear("0463010000cccccc" if count % 2 else foreign) == []
        assert station.conflicts.seen_within()
        assert events(line) == []
        assert line.flows.empty()
    assert bus.hear(FIRST) == [SENT_AWAY], "its exchange is over"


def test_replies_of_sixteen_transactions_are_known_as_late(bus: MockBus, station: BusMultiplexer) -> None:
    pair = station.address_pair(0x21)
    for transaction in range(17):
        with pair.exchange(transaction):
            pass
    assert bus.hear(FIRST.replace("07", "01", 1)) == [SENT_AWAY]
    assert bus.hear(FIRST.replace("07", "00", 1)) == []


def test_flow_controls_are_kept_while_a_request_is_under_way_alone(bus: MockBus, station: BusMultiplexer) -> None:
    pair = station.address_pair(0x21)
    bus.hear("300000")
    assert pair.flows.empty()
    with pair.exchange(7):
        bus.hear("300000")
        assert pair.flows.get_nowait() == b"\x30\0\0"
        bus.hear("300000", "0407010000cccccc")
    with pair.exchange(7) as line:
        assert pair.flows.empty(), "one of the request before"
        assert events(line) == []


@pytest.mark.parametrize("identifier", [0x18DAF221, 0x18DAF122, 0x18DBF121, 0x18D9F121])
def test_a_frame_for_another_station_or_of_another_node_is_no_reply(
    bus: MockBus, station: BusMultiplexer, identifier: int
) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        for _ in range(4):
            assert bus.hear("0407010000cccccc", FIRST, identifier=identifier) == []
        assert events(line) == []
    unsolicited = identifier == 0x18DAF122
    assert station.conflicts.seen_within() == unsolicited, "for us, and nobody here asked for it"


def test_a_pair_of_another_station_address_has_its_own_replies(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21, 0xF2).exchange(7) as other, station.address_pair(0x21).exchange(7) as own:
        bus.hear("0407010000cccccc", identifier=0x18DAF221)
        assert (events(other), events(own)) == (["07010000"], [])


def test_frames_from_our_address_that_we_did_not_send_show_another_station(
    bus: MockBus, station: BusMultiplexer
) -> None:
    bus.hear("0207", identifier=0x18DA22F1)
    assert not station.conflicts.seen_within()
    bus.hear("0207", identifier=0x18DBFFF1)
    assert station.conflicts.seen_within()
    assert station.conflicts.frames_within(within=10)


# -- answers to everyone, announces ------------------------------------------------------------------------------------


def test_answers_to_everyone_are_taken_while_they_are_asked_for_and_half_a_second_longer(
    bus: MockBus, station: BusMultiplexer
) -> None:
    with station.gather(9) as asked:
        assert bus.hear(FIRST.replace("07", "09", 1), at=asked.began + 5.0) == [GO_ON]
        assert bus.hear(SECOND, THIRD, at=asked.began + 6.0) == []
        assert asked.heard_at == asked.began + 6.0
        assert asked.next(0) == 0x21
        assert asked.replies.answers == {0x21: bytes(range(1, 20))}
        over = time.monotonic()
    until = asked.until
    assert over + 0.5 <= until <= time.monotonic() + 0.5
    other = FIRST.replace("07", "09", 1)[:-2] + "ff"
    assert bus.hear(other, at=until + 0.001) == []
    assert not station.has_conflict(0x21)
    assert bus.hear(other, at=until - 0.001) == [GO_ON]
    assert station.has_conflict(0x21), "two nodes at one address"


def test_a_long_answer_to_everyone_is_asked_on_after_each_sixteen_frames(bus: MockBus, station: BusMultiplexer) -> None:
    length = 6 + 17 * 7
    with station.gather(9) as asked:
        assert bus.hear(f"1{length:03x}09" + "22" * 5) == [GO_ON]
        for number in range(1, 18):
            assert bus.hear(f"2{number & 15:x}" + "22" * 7) == ([GO_ON] if number == 16 else []), number
        assert asked.replies.answers == {0x21: b"\x22" * (length - 1)}
        assert (asked.replies.busy, asked.replies.conflicts) == (False, set())


@pytest.mark.parametrize("data", ["00", "0f07aaaaaaaaaaaa", "0007aaaaaaaaaaaa", "1000", "10030711111111", "40", ""])
def test_a_frame_that_is_no_beginning_of_a_reply_is_passed_over(
    bus: MockBus, station: BusMultiplexer, data: str
) -> None:
    with station.address_pair(0x21).exchange(7) as line:
        assert bus.hear(data) == []
        assert (events(line), line.partial) == ([], None)
    for _ in range(8):
        bus.hear(data)
    assert not station.conflicts.seen_within()


def test_a_conflict_is_forgotten_once_one_node_alone_answers_a_later_question(
    bus: MockBus, station: BusMultiplexer
) -> None:
    def answer(transaction: str, *ends: str) -> None:
        with station.gather(int(transaction, 16)):
            bus.hear(*(f"04{transaction}0100{end}cccccc" for end in ends))

    answer("09", "00", "01")
    assert station.has_conflict(0x21)
    answer("0a", "00", "01")
    assert station.has_conflict(0x21)
    answer("0b", "00")
    assert not station.has_conflict(0x21)
    answer("0c", "00", "00")
    assert not station.has_conflict(0x21), "two that are equal are not sure to be two nodes"


def test_a_reply_after_an_answer_to_everyone_is_a_reply(bus: MockBus, station: BusMultiplexer) -> None:
    with station.gather(9):
        bus.hear(FIRST.replace("07", "09", 1), SECOND)
        with station.address_pair(0x21).exchange(7) as line:
            bus.hear(FIRST, SECOND, THIRD)
            assert events(line) == ["begun", WHOLE]


def test_an_announce_ends_the_wait_for_its_node_and_a_press_does_not(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(0) as line, station.address_pair(0x22).exchange(7) as other:
        bus.hear("0100010203040100", identifier=0x1CFF0021)  # pressed
        assert events(line) == []
        assert not station.announced_since(0x21, 0.0)
        bus.hear("0100010203040000", identifier=0x1CFF0021)
        assert (events(line), events(other)) == (["announced"], [])
        assert station.announced_since(0x21, 0.0)
        assert not station.announced_since(0x22, 0.0)
    assert not station.presses.marks(0x21, 0x01020305)
    assert station.presses.marks(0x21, 0x01020304)
    bus.hear("0100010203040000", identifier=0x1CFF0021)
    assert events(line) == [], "nobody waits"


def test_a_listener_that_ends_takes_no_other_with_it(bus: MockBus, station: BusMultiplexer) -> None:
    first, second, third = (station.listen(lambda frame: frame.identifier == 0x1CFF2021) for _ in range(3))
    second.close()
    bus.hear("aa", identifier=0x1CFF2021)
    bus.hear("bb", identifier=0x1CFF2022)
    assert second.get(0) is None
    for listener in (first, third):
        assert [frame.data for frame in listener.get_all(0)] == [b"\xaa"]
    assert second.get(0) is None, "it was woken once, and heard nothing"


def test_of_the_frames_from_our_address_the_latest_count() -> None:
    """Those of an hour ago had no room left for those of now."""
    now = [0.0]
    conflicts = AddressConflicts(0xF1, lambda: now[0])
    now[0] = 3.0
    for _ in range(200):
        conflicts.check_frame(Frame(0x18DA22F1, b"a"))
        conflicts.record_unsolicited(0x21)
    assert conflicts.seen_within()
    now[0] = 3600.0
    assert not conflicts.seen_within()
    for _ in range(2):
        assert not conflicts.frames_within(within=10)
        conflicts.check_frame(Frame(0x18DA22F1, b"a"))
    assert conflicts.frames_within(within=10)
    now[0] = 7200.0
    for _ in range(4):
        assert not conflicts.seen_within()
        conflicts.record_unsolicited(0x21)
    assert conflicts.seen_within()
    assert not conflicts.frames_within(within=10), "replies do not count"


def test_the_end_of_the_bus_ends_every_wait(bus: MockBus, station: BusMultiplexer) -> None:
    with station.address_pair(0x21).exchange(7) as line, station.gather(9) as asked:
        listener = station.listen(lambda _frame: True)
        bus.failure = LinkError("gone")
        assert asked.next(60) == -1
        assert line.events.get(timeout=60).kind == "failed"
        assert line.flows.get(timeout=60) == b""
        with pytest.raises(LinkError, match="gone"):
            listener.get(60)
        with pytest.raises(LinkError, match="gone"):
            station.send(Frame(TO_NODE, b"\0\0"))
    assert station.failed


def test_a_bus_is_closed_once(bus: MockBus, station: BusMultiplexer, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []
    monkeypatch.setattr(bus, "close", lambda: closed.append("closed"))
    listener = station.listen(lambda _frame: True)
    assert not station.failed
    station.close()
    station.close()
    assert (closed, station.failed, station.busy_seconds) == (["closed"], True, 0.0)
    with pytest.raises(LinkClosedError, match=r"^The bus virtual:mock was closed\.$"):
        listener.get(60)
    with pytest.raises(LinkClosedError):
        station.send(Frame(TO_NODE, b"\0\0"))


# -- data --------------------------------------------------------------------------------------------------------------


def data_id(node: int, stream: int = 0, segment: int = 0, own: int = 1) -> int:
    """Return the identifier of a data frame (operation.md section 5)."""
    return 0x1CFF0000 | own << 13 | stream << 11 | segment << 8 | node


def test_data_are_taken_of_open_streams_that_are_for_this_station(bus: MockBus, station: BusMultiplexer) -> None:
    streams = CanStreams()
    opened = [streams.open(node, stream, 4, fd=False) for node, stream in ((0x21, 0), (0x21, 3), (0x22, 0))]
    assert len({id(assembly) for assembly in opened}) == 3
    now = time.monotonic()

    def taken() -> list[tuple[int, int, str]]:
        with streams.listen(station) as heard:
            for node, stream, own in ((0x21, 0, 1), (0x21, 3, 1), (0x22, 0, 1), (0x21, 1, 1), (0x22, 0, 2)):
                bus.hear(f"{node:02x}{stream:02x}aabb", identifier=data_id(node, stream, own=own), at=now + 5.0)
            messages = heard.get_all(60.0)
            assert heard.lost == 0
        assert {message.at for message in messages} <= {int((now + 5.0) * 1e9)}
        return [(message.node, message.stream, message.octets.hex()) for message in messages]

    assert taken() == [(0x21, 0, "2100aabb"), (0x21, 3, "2103aabb"), (0x22, 0, "2200aabb")]
    streams.close(0x21, 3)
    streams.close(0x30, 0)
    assert taken() == [(0x21, 0, "2100aabb"), (0x22, 0, "2200aabb")]
    streams.open(0x22, 0, 4, fd=False)
    now -= 10.0  # of a run before it
    assert taken() == []


@pytest.mark.parametrize(("own", "free"), [(0xF1, "F2"), (0xF2, "F1"), (0xF7, "F1")])
def test_a_station_whose_address_another_one_uses_is_offered_another_one(own: int, free: str) -> None:
    conflicts = AddressConflicts(own, lambda: 0.0)
    assert conflicts.text == f"Another base station on this bus uses this station's source address 0x{own:02X}."
    assert conflicts.hint == (
        f"Give each station its own address, 0xF1 to 0xF7: add source=0x{free} to --can of one of them."
    )
