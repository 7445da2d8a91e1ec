"""How long a station waits on CAN, and what it sends again when (wire.md, "CAN" and "Repetition").

The bus is a mock, and time passes only where the station waits: every moment is exact.
"""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError, GarbledError, LinkError, MessageTooLongError, NodeSilentError
from teds_provision.links.can import link as link_module
from teds_provision.links.can.bus_multiplexer import AddressPair, ReplyEvent
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.link import CanLink

SHORT, LONG = b"\0\0\x80\x07\0\0", b"\0\0\1\3\0\x64" + bytes(100)
"""Of one frame, and of 16: six octets in the first, seven in each other."""
REPLY, BUSY = b"\1\0\0", b"\0\0\1\x11"


class MockBus:
    """A bus whose node does what ``node`` says of each frame: what arrives when, counted from that moment."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.lossy, self.losses = 100.0, False, 0
        self.node: Callable[[bytes], list[tuple[float, str, bytes]]] = lambda frame: []
        self.line = AddressPair(0x21, 0xF1)
        self.sent: list[tuple[float, bytes]] = []
        self.due: list[tuple[float, str, bytes]] = []
        self.spec = SimpleNamespace(fd=False, text="mock:0")
        self.failed = False
        self.conflicts = SimpleNamespace(seen_within=lambda: False)
        monkeypatch.setattr(link_module, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.pass_time))

    def pass_time(self, seconds: float) -> None:
        self.now = round(self.now + seconds, 6)

    def address_pair(self, node: int, own: int | None) -> AddressPair:
        return self.line

    def send(self, frame: Frame) -> None:
        assert frame.identifier == 0x18DA21F1
        self.sent.append((round(self.now - 100, 3), frame.data))
        self.due += [(self.now + after, kind, octets) for after, kind, octets in self.node(frame.data)]

    def next_of(self, queue: SimpleQueue[Any], seconds: float) -> Any:
        wanted = ("flow", "early") if queue is self.line.flows else ("begun", "whole")
        found = min((item for item in self.due if item[1] in wanted), default=None)
        if found is None or found[0] > self.now + seconds:
            self.pass_time(seconds)
            raise Empty
        self.due.remove(found)
        self.now = max(self.now, found[0])
        if found[1] == "flow":
            return found[2]
        event = ReplyEvent("begun" if found[1] == "begun" else "whole", found[2], self.now)
        if found[1] == "early":  # the reply is there, and whoever waits for a flow control is woken
            self.line.events.put(event)
            return b""
        if event.kind == "begun":
            self.line.partial, self.line.heard_at = SimpleNamespace(), self.now  # type: ignore[assignment]
        return event

    def check(self) -> None:
        """Be a bus that is well."""

    def note_loss(self) -> None:
        self.losses += 1

    def has_conflict(self, node: int) -> bool:
        return False

    def exchange(self, frame: bytes) -> bytes:
        return CanLink(lambda: self, lambda: 7, 0x21).exchange(frame)  # type: ignore[arg-type, return-value]

    def fails(self, frame: bytes) -> tuple[type[LinkError], float]:
        """Return how an exchange fails, and after how long."""
        with pytest.raises(LinkError) as failure:
            self.exchange(frame)
        return type(failure.value), round(self.now - 100, 3)

    def firsts(self) -> list[float]:
        """When a request began: its only frame, or its first one."""
        return [at for at, data in self.sent if data[0] >> 4 < 2]


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> MockBus:
    return MockBus(monkeypatch)


@pytest.mark.parametrize(("lossy", "sent", "ends"), [(False, [0, 1.5, 5.0], 10.0), (True, [0, 0.3, 1.5], 6.5)])
def test_a_silent_node_is_asked_three_times_and_has_five_seconds_at_the_end(
    bus: MockBus, lossy: bool, sent: list[float], ends: float
) -> None:
    bus.lossy = lossy
    assert bus.fails(SHORT) == (NodeSilentError, ends)
    assert bus.firsts() == sent
    assert len({data for _, data in bus.sent}) == 1, "the same octets, transaction included"
    assert bus.sent[0][1] == b"\7\7" + SHORT


def test_a_reply_may_take_five_seconds_after_the_last_frame(bus: MockBus) -> None:
    bus.node = lambda _frame: [(4.999, "whole", b"\7" + REPLY)] if len(bus.sent) == 3 else []
    assert bus.exchange(SHORT) == REPLY
    assert round(bus.now - 100, 3) == 9.999


def test_a_reply_that_began_has_a_second_from_frame_to_frame(bus: MockBus) -> None:
    bus.node = lambda _frame: [(0.5, "begun", b""), (1.4, "whole", b"\7" + REPLY)] if len(bus.sent) == 1 else []
    assert bus.exchange(SHORT) == REPLY
    bus.node = lambda _frame: [(0.5, "begun", b"")]
    bus.sent.clear()
    bus.now = 100.0
    assert bus.fails(SHORT) == (GarbledError, 4.5)
    assert bus.firsts() == [0, 1.5, 3.0], "half a second, and the second after it"


def test_a_busy_node_is_sent_the_same_octets_each_100_ms_for_ten_seconds(bus: MockBus) -> None:
    bus.node = lambda data: [(0.0, "early", b"\7" + BUSY)] if data[0] >> 4 == 1 else []
    assert bus.exchange(LONG) == BUSY
    assert bus.firsts() == [round(0.1 * count, 3) for count in range(101)]
    assert len({data for _, data in bus.sent}) == 1


def test_a_refusal_17_is_no_try(bus: MockBus) -> None:
    bus.node = lambda data: [(0.0, "early", b"\7" + BUSY)] if data[0] >> 4 == 1 and len(bus.sent) <= 50 else []
    assert bus.fails(LONG)[0] is NodeSilentError
    after = bus.firsts()[50:]
    assert len(after) >= 3, "three tries are left"


def test_no_try_begins_fifteen_seconds_after_the_first_frame_of_the_first(bus: MockBus) -> None:
    """The node refuses for 9.9 s, takes each request slowly then, and does not reply."""

    def node(data: bytes) -> list[tuple[float, str, bytes]]:
        if data[0] >> 4 != 1:
            return []
        return [(0.0, "early", b"\7" + BUSY) if bus.now < 109.85 else (0.0, "flow", b"\x30\0\x7f")]

    bus.node = node
    took = 14 * 0.127
    assert bus.fails(LONG) == (NodeSilentError, round(9.9 + took + 1.5 + took + 3.5, 3))
    assert bus.firsts()[99:] == [9.9, round(9.9 + took + 1.5, 3)], "a third one would begin at 18.5 s"


def test_without_a_flow_control_it_is_asked_again_within_n_bs(bus: MockBus) -> None:
    assert bus.fails(LONG)[0] is NodeSilentError
    waits = [round(later - sooner, 3) for sooner, later in zip(bus.firsts(), bus.firsts()[1:], strict=False)]
    assert waits[:2] == [0.25, 0.5]
    assert set(waits[2:]) == {1.0}
    assert bus.now - 100 >= 5.0, "as long as a silent node is waited for"


def test_ten_waits_of_a_node_are_borne(bus: MockBus) -> None:
    def node(data: bytes) -> list[tuple[float, str, bytes]]:
        if data[0] >> 4 == 1:
            waits = [(0.2 + 0.9 * count, "flow", b"\x31\0\0") for count in range(10)]
            return [*waits, (9.1, "flow", b"\x30\0\0")]
        return [(0.0, "whole", b"\7" + REPLY)] if data[0] == 0x2F else []

    bus.node = node
    assert bus.exchange(LONG) == REPLY
    assert bus.firsts() == [0]


@pytest.mark.parametrize(
    ("flow", "moments"),
    [
        (b"\x30\0\0", [0.0] * 15),  # no limit of the block
        (b"\x30\0\5", [round(0.005 * count, 3) for count in range(15)]),
        (b"\x30\0\x80", [round(0.127 * count, 3) for count in range(15)]),  # reserved
        (b"\x30\0\xf1", [round(0.0001 * count, 3) for count in range(15)]),
        (
            b"\x30\4\1",
            [0.0, 0.001, 0.002, 0.003, 0.003, 0.004, 0.005, 0.006, 0.006, 0.007, 0.008, 0.009, 0.009, 0.01, 0.011],
        ),
    ],
    ids=["no limit", "5 ms", "reserved", "100 µs", "blocks of 4"],
)
def test_a_station_keeps_the_block_and_the_gap_that_a_node_asks_for(
    bus: MockBus, flow: bytes, moments: list[float]
) -> None:
    asked = 0

    def node(data: bytes) -> list[tuple[float, str, bytes]]:
        nonlocal asked
        if data[0] >> 4 == 1:
            return [(0.0, "flow", flow)]
        asked += 1
        if asked == 15:
            return [(0.0, "whole", b"\7" + REPLY)]
        return [(0.0, "flow", flow)] if flow[1] and asked % flow[1] == 0 else []

    bus.node = node
    assert bus.exchange(LONG) == REPLY
    assert [data[0] for _, data in bus.sent] == [0x10, *range(0x21, 0x30)]
    assert [at for at, _ in bus.sent[1:]] == moments


def test_a_node_whose_buffer_overflows_is_named(bus: MockBus) -> None:
    bus.node = lambda _frame: [(0.0, "flow", b"\x32\0\0")]
    with pytest.raises(MessageTooLongError, match="overflow"):
        bus.exchange(LONG)


def test_an_order_is_not_sent_again_to_a_busy_node(bus: MockBus) -> None:
    bus.node = lambda _frame: [(0.0, "early", b"\7" + BUSY)]
    link = CanLink(lambda: bus, lambda: 7, 0x21)  # type: ignore[arg-type, return-value]
    assert link.exchange_within(LONG, 2.0) == BUSY
    assert bus.firsts() == [0]


def the_link(bus: MockBus) -> CanLink:
    return CanLink(lambda: bus, lambda: 7, 0x21)  # type: ignore[arg-type, return-value]


@pytest.mark.parametrize(
    ("answers", "found", "ends"),
    [
        ([], b"", 1.0),
        ([(0.5, "flow", b"\x30\x10\0")], b"\x30\x10\0", 0.5),
        ([(0.5, "whole", b"\7" + BUSY)], b"\5\7" + BUSY + b"\xcc\xcc", 0.51),
        ([(0.5, "begun", b"")], b"\x10", 0.51),
    ],
)
def test_the_first_frame_of_a_long_request_is_answered_by_one_frame_or_by_none_in_a_second(
    bus: MockBus, answers: list[tuple[float, str, bytes]], found: bytes, ends: float
) -> None:
    bus.node = lambda _frame: answers
    assert the_link(bus).begin(100) == found
    assert bus.now - 100 == pytest.approx(ends, abs=0.02)
    assert [data for _, data in bus.sent] == [b"\x10\x64\7\0\0\0\0\0"]


def test_an_answer_to_a_first_frame_in_fd_is_a_frame_of_fd(bus: MockBus) -> None:
    bus.spec.fd = True
    reply = b"\7" + bytes(range(19))
    bus.node = lambda _frame: [(0.5, "whole", reply)]
    assert the_link(bus).begin(100) == b"\0\x14" + reply + b"\xcc\xcc"
    assert [len(data) for _, data in bus.sent] == [64]


@pytest.mark.parametrize(
    ("answer", "uuid"),
    [
        (None, None),
        (b"\1\0\x18" + bytes(range(10)) + b"\2\0\1\0\0\4\0" + bytes(7), None),
        (b"\1\0\1\x05", None),
        (b"\0\0\1\x05", None),
    ],
)
def test_an_address_at_which_nobody_identifies_itself_well_has_no_identity(
    bus: MockBus, answer: bytes | None, uuid: bytes | None
) -> None:
    bus.node = lambda _frame: [] if answer is None else [(0.01, "whole", b"\7" + answer)]
    found = the_link(bus).identify_at(0x21)
    assert (found and found.uuid) == uuid
    assert len(bus.sent) == 1, "asked once"
    assert bus.now - 100 <= 1.0


def test_a_reply_under_an_address_in_conflict_is_nobodys(bus: MockBus) -> None:
    """Two nodes answer there: which of them gave the reply is unknown."""
    bus.node = lambda _frame: [(0.1, "whole", b"\7" + REPLY)]
    assert bus.exchange(SHORT) == REPLY
    bus.has_conflict = lambda node: node == 0x21  # type: ignore[method-assign]
    with pytest.raises(AddressConflictError, match="Two nodes answer at CAN address 0x21"):
        bus.exchange(SHORT)


@pytest.mark.parametrize(("seen", "failed", "named"), [(True, False, True), (True, True, False), (False, False, False)])
def test_a_silent_node_may_be_due_to_another_station_of_our_address_unless_the_bus_failed(
    bus: MockBus, seen: bool, failed: bool, named: bool
) -> None:
    bus.conflicts = SimpleNamespace(seen_within=lambda: seen, text="Another station uses 0xF1.", hint="Use another.")
    bus.failed = failed
    with pytest.raises(NodeSilentError) as silent:
        bus.exchange(SHORT)
    assert silent.value.message.endswith(" Another station uses 0xF1.") is named
    assert (silent.value.hint == "Use another.") is named


@pytest.mark.parametrize(
    ("clash", "listed", "torn", "error", "message", "hint"),
    [
        (False, False, False, NodeSilentError, "The node at 0x05 on virtual:a no longer answers.",
         "Check its power, its wiring and its address."),
        (False, False, True, GarbledError,
         "The node at 0x05 on virtual:a answers, but frames of its replies are missing.",
         "Check wiring, bit rate, bus load."),
        (True, False, True, None, "", ""),
        (False, True, True, None, "", ""),
    ],
)  # fmt: skip
def test_why_an_exchange_failed_is_named_with_its_remedy(
    clash: bool, listed: bool, torn: bool, error: type[Exception] | None, message: str, hint: str
) -> None:
    """Two nodes under one address tear each other's replies: that is the cause, whatever was torn."""
    exchange: Any = link_module._Exchange.__new__(link_module._Exchange)
    exchange._line = SimpleNamespace(node=5)
    spec = SimpleNamespace(text="virtual:a")
    exchange._bus = SimpleNamespace(spec=spec, has_conflict=lambda node: listed and node == 5)
    exchange._clash, exchange._torn = clash, torn
    failure = exchange._failed()
    if error is None:
        due = link_module.conflict(5)
        assert (type(failure), failure.message) == (type(due), due.message)
    else:
        assert (type(failure), failure.message, failure.hint) == (error, message, hint)
