"""An open bus: what is not a data frame, and what the controller says of itself."""

from __future__ import annotations

import errno
import socket
from queue import Empty, SimpleQueue
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest
from can.interfaces.virtual import VirtualBus

from teds_provision.errors import LinkError, UsageError
from teds_provision.links.can import bus as bus_module
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.bus_multiplexer import BusReader
from teds_provision.links.can.interface_keys import known_keys
from teds_provision.links.can.spec import parse_spec
from tests.pace import PATIENCE


def test_bus_off_is_a_link_failure_that_names_the_cure() -> None:
    bus = Bus(parse_spec("virtual:bus-off"))
    with can.Bus(interface="virtual", channel="bus-off") as controller:
        controller.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
        with pytest.raises(LinkError, match="bus-off") as failure:
            bus.receive(1)
    bus.close()
    assert "restart" in failure.value.hint


def test_a_frame_that_another_sends_later_is_no_echo_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each echo counts once, for three seconds; some never come."""
    clock, ours, sent = [100.0], Frame(0x18DA21F1, b"a"), bus_module.SentFrames()
    monkeypatch.setattr(bus_module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    sent.sent(ours)
    clock[0] += 2.0
    sent.sent(ours)
    clock[0] += 2.0
    assert [sent.discard_echo(ours) for _ in range(2)] == [True, False], "that of the first never came"
    sent.sent(ours)
    clock[0] += 4.0
    assert not sent.discard_echo(ours)


def test_hears_extended_data_frames_alone() -> None:
    bus = Bus(parse_spec("virtual:others"))
    with can.Bus(interface="virtual", channel="others") as other:
        other.send(can.Message(arbitration_id=0x7F1, is_extended_id=False, data=b"a"))
        other.send(can.Message(arbitration_id=0x18DAF121, is_remote_frame=True, dlc=3))
        other.send(can.Message(arbitration_id=1, is_error_frame=True, data=bytes(8)))
        other.send(can.Message(arbitration_id=0x18DAF121, data=b"b"))
    assert [bus.receive(0.1) for _ in range(4)] == [None, None, None, Frame(0x18DAF121, b"b")]
    bus.close()


class ShortQueueBus(VirtualBus):
    """An interface with a queue of ten frames, as SocketCAN's; full until it has refused a frame ``refusals`` times."""

    def __init__(self, channel: str, refusals: int = 3, **options: Any) -> None:
        super().__init__(channel, **options)
        self._refusals, self._refused, self._queued = refusals, 0, 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self._queued == 10:
            self._refused += 1
            if self._refused <= self._refusals:
                try:
                    raise OSError(errno.ENOBUFS, "No buffer space available")
                except OSError as error:
                    raise can.CanOperationError(f"Failed to transmit: {error.strerror}", error.errno) from error
            self._refused, self._queued = 0, 9
        self._queued += 1
        super().send(msg, timeout)


@pytest.fixture
def short_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(can.interfaces.BACKENDS, "short_queue", (__name__, "ShortQueueBus"))
    monkeypatch.setattr(can.util, "VALID_INTERFACES", frozenset({*can.VALID_INTERFACES, "short_queue"}))


@pytest.mark.usefixtures("short_queue")
def test_a_full_queue_is_waited_for_and_keeps_the_order() -> None:
    sent = [Frame(0x18DA21F1, bytes([number])) for number in range(40)]
    bus = Bus(parse_spec("short_queue:long-message"))
    with can.Bus(interface="virtual", channel="long-message") as other:
        for frame in sent:
            bus.send(frame)
        heard = [other.recv(PATIENCE) for _ in sent]
    bus.close()
    assert [bytes(message.data) for message in heard if message is not None] == [frame.data for frame in sent]


@pytest.mark.usefixtures("short_queue")
def test_a_queue_that_stays_full_is_a_link_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "_SEND_SECONDS", 0.01)
    bus = Bus(parse_spec("short_queue:nobody?refusals=1000000"))
    for number in range(10):
        bus.send(Frame(0x18DA21F1, bytes([number])))
    with pytest.raises(LinkError, match="No buffer space"):
        bus.send(Frame(0x18DA21F1, b"one more"))
    bus.close()


def test_a_datagram_that_is_no_frame_is_passed_over(group: str) -> None:
    spec = parse_spec(group)
    bus = Bus(spec)
    port = int(group.rpartition("=")[2])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        stranger.sendto(b"\xc1nonsense", (spec.channel, port))
    assert bus.receive(0.3) is None
    other = Bus(spec)
    other.send(Frame(0x18DA21F1, b"still here"[:8]))
    assert bus.receive(PATIENCE) == Frame(0x18DA21F1, b"still he")
    assert other.receive(0.1) is None  # its own, given back by the kernel, is no frame of another
    bus.send(Frame(0x18DA21F1, b"still here"[:8]))
    assert other.receive(PATIENCE) == Frame(0x18DA21F1, b"still he")
    bus.close()
    other.close()


def test_the_kernel_keeps_back_what_this_bus_sent_and_nothing_else(group: str) -> None:
    """A frame of our own that had to be read, only to be dropped, cost a streaming node a third of its time."""
    bus, other = Bus(parse_spec(group)), Bus(parse_spec(group))
    frame = Frame(0x1CFF2021, b"octets")
    for _ in range(20):
        bus.send(frame)
    heard = bus._bus._multicast._socket  # type: ignore[attr-defined]
    heard.setblocking(False)
    with pytest.raises(BlockingIOError):
        heard.recv(200)
    assert [other.receive(PATIENCE) for _ in range(20)] == [frame] * 20
    other.send(frame)
    assert bus.receive(PATIENCE) == frame
    bus.close()
    other.close()


def test_frames_that_may_leave_this_machine_are_recognised_too(group: str) -> None:
    """The source port of a bus on another machine may be ours."""
    spec = parse_spec(f"{group}&hop_limit=1")
    bus = Bus(spec)
    bus.send(Frame(0x1CFF2021, b"octets"))
    assert bus.receive(0.3) is None
    bus.close()


def test_socketcand_has_no_fd() -> None:
    with pytest.raises(UsageError, match="classic"):
        Bus(parse_spec("socketcand:can0?fd=1"))


@pytest.mark.parametrize(
    ("text", "heard"),
    [("socketcan:vcan0", True), ("socketcan:vcan0?receive_own_messages=1", True), ("virtual:test", False)],
)
def test_on_socketcan_programs_of_one_machine_hear_each_other(
    monkeypatch: pytest.MonkeyPatch, text: str, heard: bool
) -> None:
    """The kernel marks what any program of this machine sent; python-can makes is_rx False of that."""
    import can

    class Kernel:
        state = can.BusState.ACTIVE

        def __init__(self) -> None:
            self.frames: list[can.Message] = []

        def recv(self, timeout: float) -> can.Message | None:
            return self.frames.pop(0) if self.frames else None

        def send(self, message: can.Message, timeout: float) -> None:
            if "own" in text:
                self.frames.append(message)

        def shutdown(self) -> None:
            pass

    kernel = Kernel()
    monkeypatch.setattr("teds_provision.links.can.bus.open_bus", lambda _spec, _filters: kernel)
    bus = Bus(parse_spec(text))
    bus.send(Frame(0x18DA21F1, b"own"))
    assert bus.receive(0) is None, "what this very program sent is no news"
    kernel.frames.append(can.Message(arbitration_id=0x18DAF121, data=b"other", is_rx=False))
    assert (bus.receive(0) is not None) == heard
    bus.close()


@pytest.mark.parametrize(
    ("place", "key", "known"),
    [
        ("udp_multicast:239.74.163.2?prot=4000", "prot", "port"),
        ("socketcan:can0?bit_rate=250000", "bit_rate", "bitrate"),
        ("slcan:/dev/ttyACM0?speed=9600", "speed", "tty_baudrate"),
        ("virtual:x?nodes=3", "nodes", "node"),
    ],
)
def test_a_key_that_no_interface_has_is_refused_with_those_that_it_has(place: str, key: str, known: str) -> None:
    """python-can takes any and says nothing: a bit rate with a slip was the default one."""
    with pytest.raises(UsageError) as refusal:
        Bus(parse_spec(place))
    assert repr(key) in refusal.value.message
    assert known in refusal.value.hint.split(": ")[1].rstrip(".").split(", ")


def test_keys_that_an_interface_picks_out_of_what_it_is_given_are_known() -> None:
    assert {"accept_virtual", "driver_mode", "tseg1", "bitrate"} <= known_keys("kvaser")
    assert {"port", "hop_limit", "receive_own_messages"} <= known_keys("udp_multicast")
    assert {"host", "port"} <= known_keys("socketcand")
    assert known_keys("no such interface") == frozenset()


class FailedBus:
    """A bus that fails at its third frame; it counts who reads on."""

    can_be_waited_for = stamps_arrivals = True

    def __init__(self) -> None:
        self.reads = 0

    def receive(self, _seconds: float) -> Frame | None:
        """Return a frame, or fail."""
        self.reads += 1
        if self.reads == 3:
            raise LinkError("The adapter was pulled out.")
        assert self.reads < 3, "it is read on"
        return Frame(0x18DAF121, b"a")

    def wait(self, seconds: float, woken: object) -> None:
        """Return at once."""


def test_after_a_bus_has_failed_nobody_reads_it_any_more() -> None:
    """Reading on would spin, and hand the failure to everyone again and again."""
    bus: Any = FailedBus()
    taken, failures = list[Frame](), list[LinkError]()
    loop = BusReader(bus, taken.append, failures.append, cast(Any, None))
    loop._read_all()
    loop.run()
    waiting: SimpleQueue[Frame] = SimpleQueue()
    with pytest.raises(Empty):
        loop.wait_for(waiting, 0.0)
    with pytest.raises(Empty):
        loop.wait_for(waiting, 0.001)
    assert (bus.reads, len(taken), len(failures)) == (3, 2, 1)
