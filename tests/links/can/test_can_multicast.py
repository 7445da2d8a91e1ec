"""The bus of one machine by our own hands: the same datagrams as python-can's, and nothing of ours comes back."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message, unpack_message
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import LinkError
from teds_provision.links.can import multicast
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.spec import parse_spec
from tests.pace import PATIENCE

pytestmark = pytest.mark.link
IDENTIFIERS = st.integers(0, (1 << 29) - 1)


def frames() -> st.SearchStrategy[Frame]:
    classic = st.builds(Frame, IDENTIFIERS, st.binary(max_size=8), st.just(False))
    return classic | st.builds(Frame, IDENTIFIERS, st.binary(max_size=64), st.just(True))


@given(frames())
def test_a_datagram_is_the_one_that_python_can_writes(frame: Frame) -> None:
    message = can.Message(
        arbitration_id=frame.identifier, data=frame.data, is_fd=frame.fd, bitrate_switch=frame.fd, is_extended_id=True
    )
    assert unpack_message(multicast.written(frame), check=True).equals(message, timestamp_delta=None)
    assert multicast.read(pack_message(message), 0.0, fd=True).frame == frame
    heard = multicast.read(multicast.written(frame), 1.5, fd=False).frame
    assert heard == (None if frame.fd else frame), "FD is heard where the bus has it alone"


FIELDS = {
    "arbitration_id": 0x18DAF121,
    "is_extended_id": True,
    "is_remote_frame": False,
    "is_error_frame": False,
    "dlc": 2,
    "data": b"ab",
    "is_fd": False,
}


def test_what_is_no_data_frame_of_ours_says_nothing() -> None:
    assert multicast.read(msgpack.packb(FIELDS), 0.0, fd=False).frame == Frame(0x18DAF121, b"ab")
    others: list[object] = [
        *({**FIELDS, **change} for change in (
            {"arbitration_id": -1}, {"arbitration_id": 1 << 29}, {"arbitration_id": "1"}, {"arbitration_id": True},
            {"is_extended_id": False}, {"is_remote_frame": True}, {"data": "ab"}, {"data": None}, {"dlc": 3},
            {"data": bytes(9), "dlc": 9}, {"data": bytes(65), "dlc": 65, "is_fd": True}, {"is_error_frame": True},
        )),
        {}, [1, 2], 7, None, {1: 2},
    ]  # fmt: skip
    wrong = [other for other in others if multicast.read(msgpack.packb(other), 0.0, fd=True).frame is not None]
    assert not wrong, wrong
    assert multicast.read(msgpack.packb({**FIELDS, "is_error_frame": True}), 0.0, fd=True).error == 0x18DAF121


@given(st.binary(max_size=80))
def test_any_datagram_may_come(octets: bytes) -> None:
    multicast.read(octets, 0.0, fd=True)


def test_python_can_hears_us_and_we_hear_it(group: str) -> None:
    spec = parse_spec(group + "&fd=1")
    port = int(group.rpartition("=")[2])
    ours = Bus(spec)
    with can.Bus(interface="udp_multicast", channel=spec.channel, port=port, hop_limit=0, fd=True) as theirs:
        for frame in (Frame(0x18DA21F1, b"classic"), Frame(0x18DA21F1, bytes(range(64)), fd=True)):
            ours.send(frame)
            heard = theirs.recv(PATIENCE)
            assert heard is not None
            assert (heard.arbitration_id, bytes(heard.data), heard.is_fd, heard.bitrate_switch) == (
                frame.identifier,
                frame.data,
                frame.fd,
                frame.fd,
            )
            theirs.send(heard)
            assert theirs.recv(PATIENCE) is not None, "python-can hears itself"
            assert ours.receive(PATIENCE) == frame, "octet for octet what we sent, and yet another's"
    ours.close()


@pytest.mark.parametrize("filtered", [True, False])
def test_our_own_frames_do_not_come_back(monkeypatch: pytest.MonkeyPatch, group: str, filtered: bool) -> None:
    if not filtered:  # another system than Linux: recognised by the sender
        monkeypatch.setattr(multicast, "_drop_own", lambda receiving, own: None)
    spec = parse_spec(group)
    bus, other = Bus(spec), Bus(spec)
    frame = Frame(0x18DA21F1, b"mine")
    for _ in range(3):
        bus.send(frame)
    assert [other.receive(PATIENCE) for _ in range(3)] == [frame] * 3
    woken = select.select([bus._descriptor], [], [], 0)[0]
    assert bool(woken) == (not filtered), "the kernel drops them before anybody is woken"
    other.send(frame)  # the very same, but from another program
    heard = [bus.receive(1.0) for _ in range(4)]  # each of its own that came wakes it, and is nothing
    if not any(heard):
        heard.append(bus.receive(PATIENCE))
    assert [item for item in heard if item] == [frame]
    bus.close()
    other.close()


class DelayedClock:
    """The module ``time`` for a thread that is put aside for 10 ms before each reading of a clock."""

    def __init__(self) -> None:
        self.lost = 0

    def _reading(self, clock: Callable[[], int]) -> int:
        self.lost += 10_000_000
        return clock() + self.lost

    def time(self) -> float:
        return self._reading(time.time_ns) / 1e9

    def time_ns(self) -> int:
        return self._reading(time.time_ns)

    def monotonic(self) -> float:
        return self._reading(time.monotonic_ns) / 1e9


def test_a_frame_never_comes_before_it_was_sent(monkeypatch: pytest.MonkeyPatch, group: str) -> None:
    """On a busy machine a message was "from the future" now and then, and the bound of a node's time was false."""
    bus, other = Bus(parse_spec(group)), Bus(parse_spec(group))
    sent = time.monotonic()
    other.send(Frame(0x18DA21F1, b"when"))
    monkeypatch.setattr(multicast, "time", DelayedClock())
    heard = bus.receive(PATIENCE)
    assert heard is not None
    assert heard.at >= sent
    bus.close()
    other.close()


def test_another_machine_with_our_port_is_no_echo_of_ours(group: str) -> None:
    """The filter goes by address and port: ports of two machines are alike sooner or later."""
    spec = parse_spec(group)
    bus, other = Bus(spec), Bus(spec)
    assert bus._multicast is not None
    assert other._multicast is not None
    address, port = other._multicast._own
    frame = Frame(0x18DAF121, b"afar")
    multicast._drop_own(bus._multicast._in, ("203.0.113.1", port))
    other.send(frame)
    assert bus.receive(PATIENCE) == frame
    multicast._drop_own(bus._multicast._in, (address, port))
    other.send(frame)
    assert bus.receive(0.2) is None
    bus.close()
    other.close()


def test_an_error_frame_that_says_bus_off_is_a_link_failure(group: str) -> None:
    spec = parse_spec(group)
    bus = Bus(spec)
    port = int(group.rpartition("=")[2])
    with can.Bus(interface="udp_multicast", channel=spec.channel, port=port, hop_limit=0) as injector:
        injector.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
        with pytest.raises(LinkError, match="bus-off"):
            bus.receive(PATIENCE)
    bus.close()


@pytest.mark.parametrize("seconds", [-30.0, 30.0])
def test_a_stamp_after_the_wall_clock_was_set_counts_as_none(seconds: float) -> None:
    """Set back, it would put the arrival into the future, and a bound of the node's clock would be wrong."""
    stamp = time.time_ns() - int(seconds * 1e9)
    ancillary = [(socket.SOL_SOCKET, multicast._TIMESTAMPNS, multicast._STAMP.pack(*divmod(stamp, 10**9)))]
    before = time.monotonic()
    assert before <= multicast.arrival(ancillary) <= time.monotonic()


class SocketOnPaper:
    """Stands for a socket of either family, as many machines have no IPv6: keeps what it was set to."""

    def __init__(self, family: int, kind: int) -> None:
        self.course: list[object] = [(family, kind)]

    def setsockopt(self, *words: int) -> None:
        self.course.append(words)

    def connect(self, place: tuple[str, int]) -> None:
        self.course.append(place)

    def setblocking(self, blocking: bool) -> None:
        self.course.append(blocking)


@pytest.mark.parametrize(
    ("family", "group", "level", "option"),
    [
        (socket.AF_INET, "239.74.163.2", socket.IPPROTO_IP, socket.IP_MULTICAST_TTL),
        (socket.AF_INET6, "ff01::7a:1", socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS),
    ],
)
def test_the_hop_limit_bounds_how_far_frames_go(
    family: int, group: str, level: int, option: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multicast.socket, "socket", SocketOnPaper)
    for hops in (0, 3):
        sender = multicast._sender(family, group, 43113, hops)
        assert sender.course == [  # type: ignore[attr-defined]
            (family, socket.SOCK_DGRAM), (level, option, hops), (group, 43113), False,
        ]  # fmt: skip


def test_a_sender_that_finds_no_way_to_its_group_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SocketOnPaper] = []

    class Unconnected(SocketOnPaper):
        def __init__(self, *words: int) -> None:
            super().__init__(*words)
            made.append(self)

        def connect(self, place: tuple[str, int]) -> None:
            raise OSError(101, "Network is unreachable")

        def close(self) -> None:
            self.course.append("closed")

    monkeypatch.setattr(multicast.socket, "socket", Unconnected)
    with pytest.raises(OSError, match="unreachable"):
        multicast._sender(socket.AF_INET, "239.74.163.2", 43113, 0)
    assert made[0].course[-1] == "closed"
