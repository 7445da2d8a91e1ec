"""Errors of a bus that does not open, cannot be read or takes no frame, with their remedies; all without a bus.

The interface is a mock: no test machine has one that fails in each of these ways.
"""

from __future__ import annotations

import errno
import logging
import socket
import threading
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest

from teds_provision.errors import LinkError, NoReaderError, UsageError
from teds_provision.links.can import bus as bus_module
from teds_provision.links.can.bus import Bus, Frame, SentFrames, clock_is_ours
from teds_provision.links.can.multicast import ReceivedFrame
from teds_provision.links.can.spec import parse_spec

ADAPTER = "Check that the adapter is up and plugged in."


class Interface:
    """An interface of python-can: each call does, in turn, what its list has."""

    def __init__(self, **steps: list[Any]) -> None:
        self.steps, self.state = steps, can.BusState.ACTIVE
        self.sent: list[can.Message] = []
        self.filters: Any = None
        self.ended = 0

    def _next(self, name: str) -> Any:
        step = self.steps[name].pop(0) if self.steps.get(name) else None
        if isinstance(step, Exception):
            raise step
        return step

    def recv(self, timeout: float) -> can.Message | None:
        assert timeout >= 0
        found = self._next("recv")
        return cast("can.Message | None", found)

    def send(self, message: can.Message, timeout: float) -> None:
        assert timeout == 1.0
        self._next("send")
        self.sent.append(message)

    def set_filters(self, filters: Any) -> None:
        self.filters = filters

    def fileno(self) -> int:
        raise NotImplementedError

    def shutdown(self) -> None:
        self.ended += 1
        self._next("shutdown")


def opened(monkeypatch: pytest.MonkeyPatch, text: str, interface: Interface) -> Bus:
    monkeypatch.setattr(can, "Bus", lambda **_options: interface)
    return Bus(parse_spec(text))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (can.CanOperationError("Failed to receive"), "cannot be read: Failed to receive."),
        (OSError(errno.ENETDOWN, "Network is down"), "cannot be read: [Errno 100] Network is down."),
        (ValueError("bad length.\nmore"), "cannot be read: bad length."),
        (can.CanError(), "cannot be read: CanError."),
    ],
)
def test_a_bus_that_cannot_be_read_is_named_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    bus = opened(monkeypatch, "virtual:faulty", Interface(recv=[error]))
    with pytest.raises(LinkError) as no:
        bus.receive(0.0)
    assert (no.value.message, no.value.hint) == (f"The CAN bus virtual:faulty {words}", ADAPTER)


@pytest.mark.parametrize(
    "error", [can.CanOperationError("no buffer"), OSError(errno.ENETDOWN, "down"), ValueError("a")]
)
def test_a_bus_that_takes_no_frame_is_named(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    interface = Interface(send=[error])
    bus = opened(monkeypatch, "virtual:faulty", interface)
    with pytest.raises(LinkError) as no:
        bus.send(Frame(0x18DA21F1, b"a"))
    assert no.value.message == f"The CAN bus virtual:faulty does not take a frame: {error}."
    assert interface.sent == []


def test_the_cause_of_a_cause_is_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    outer = can.CanOperationError("wrapped")
    outer.__cause__ = OSError(errno.ENODEV, "No such device")
    bus = opened(monkeypatch, "virtual:faulty", Interface(recv=[outer]))
    with pytest.raises(LinkError, match=r"cannot be read: \[Errno 19\] No such device\."):
        bus.receive(0.0)


def test_a_controller_that_has_failed_is_bus_off_whatever_it_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    for steps in ({"recv": [None]}, {"recv": [OSError(5, "x")]}, {"send": [OSError(5, "x")]}):
        interface = Interface(**steps)
        bus = opened(monkeypatch, "socketcan:can7", interface)
        interface.state = can.BusState.ERROR
        with pytest.raises(LinkError) as no:
            bus.send(Frame(1, b"a")) if "send" in steps else bus.receive(0.0)
        assert no.value.message == "The CAN controller of socketcan:can7 went bus-off: too many frame errors."
        assert no.value.hint == (
            "Check wiring, termination (120 ohm at both ends) and the bit rate; then: "
            "ip link set can7 type can restart."
        )


def test_a_frame_goes_out_extended_and_by_fd_if_it_was_asked_so(monkeypatch: pytest.MonkeyPatch) -> None:
    interface = Interface()
    bus = opened(monkeypatch, "socketcan:can0?fd=1", interface)
    bus.send(Frame(0x18DA21F1, b"abc"))
    bus.send(Frame(0x18DA21F2, bytes(64), fd=True))
    seen = [(m.arbitration_id, m.is_extended_id, bytes(m.data), m.is_fd, m.bitrate_switch) for m in interface.sent]
    assert seen == [(0x18DA21F1, True, b"abc", False, False), (0x18DA21F2, True, bytes(64), True, True)]
    assert bus.busy_seconds == 0.0


def test_of_socketcan_the_kernel_lets_through_what_is_for_this_program(monkeypatch: pytest.MonkeyPatch) -> None:
    interface = Interface()
    opened(monkeypatch, "socketcan:can0", interface)
    assert all(each["extended"] is True for each in interface.filters)
    assert {(each["can_id"] >> 16, each["can_mask"] >> 16) for each in interface.filters} >= {(0x1CFF, 0x1FFF)}
    other = Interface()
    opened(monkeypatch, "virtual:faulty", other)
    assert other.filters is None


def test_an_interface_that_cannot_be_waited_for_is_waited_for_in_its_read(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = opened(monkeypatch, "virtual:faulty", Interface())
    near, far = socket.socketpair()
    with near, far:
        bus.wait(600, near)
    assert (bus.can_be_waited_for, bus.stamps_arrivals) == (False, False)


def test_a_bus_that_fails_at_its_end_ends_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    interface = Interface(shutdown=[RuntimeError("driver")])
    opened(monkeypatch, "virtual:faulty", interface).close()
    assert interface.ended == 1


def test_what_came_in_unread_is_thrown_away_as_far_as_there_is_some(monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [can.Message(arbitration_id=0x18DAF121, is_rx=True, data=b"a") for _ in range(5)]
    interface = Interface(recv=list(messages))
    bus = opened(monkeypatch, "virtual:faulty", interface)
    bus.drain(2)
    assert len(interface.steps["recv"]) == 3
    bus.drain()
    assert interface.steps["recv"] == []


def test_of_echoes_that_never_come_4096_are_kept() -> None:
    sent = SentFrames()
    frames = [Frame(number, b"a") for number in range(4098)]
    for frame in frames:
        sent.sent(frame)
    assert [sent.discard_echo(frame) for frame in (*frames[:3], frames[-1])] == [False, False, True, True]


# -- a bus that does not open ------------------------------------------------------------------------------------------

MULTICAST = "This needs a multicast address and a route to it: sudo ip route add 239.0.0.0/8 dev lo."
FAULTS: list[tuple[str, Exception, str, str]] = [
    (
        "socketcan:can0", OSError(errno.EAFNOSUPPORT, "x"), "This kernel has no CAN support.",
        "Load it (sudo modprobe can_raw), or go over the network: socketcand:can0?host=….",
    ),
    (
        "socketcan:can7", OSError(errno.ENODEV, "x"), "There is no CAN interface can7.",
        "To list the interfaces: ip -brief link show type can.",
    ),
    (
        "socketcan:can7", OSError(errno.ENETDOWN, "Network is down"),
        "The CAN bus socketcan:can7 does not open: [Errno 100] Network is down.",
        "Bring it up: sudo ip link set can7 up type can bitrate 500000.",
    ),
    (
        "socketcan:can7?bitrate=250000&data_bitrate=4000000&fd=1", can.CanInitializationError("down"),
        "The CAN bus socketcan:can7 does not open: down.",
        "Bring it up: sudo ip link set can7 up type can bitrate 250000 dbitrate 4000000 fd on.",
    ),
    (
        "udp_multicast:10.0.0.1", OSError(errno.ENODEV, "No such device"),
        "The CAN bus udp_multicast:10.0.0.1 does not open: [Errno 19] No such device.", MULTICAST,
    ),
    (
        "virtual:a", ValueError("bad channel."), "The CAN bus virtual:a does not open: bad channel.",
        "Check the channel's name and that the adapter is plugged in. Is its driver installed?",
    ),
    (
        "pcan:PCAN_USBBUS1", NameError("name 'PCANBasic' is not defined"),
        "The CAN bus pcan:PCAN_USBBUS1 does not open: its driver library is not installed.", "",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "error", "words", "cure"), FAULTS)
def test_a_bus_that_does_not_open_is_named_with_its_cure(
    monkeypatch: pytest.MonkeyPatch, text: str, error: Exception, words: str, cure: str
) -> None:
    def fail(**_options: Any) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(NoReaderError) as no:
        Bus(parse_spec(text))
    assert no.value.message == words
    if cure:
        assert no.value.hint == cure
    else:
        assert (no.value.hint or "").startswith(
            "Check the channel's name and that the adapter is plugged in. It needs "
        )


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (TypeError("__init__() got an unexpected keyword argument 'colour'"), "takes no colour="),
        (TypeError("__init__() missing 1 required positional argument: 'serial'"), "also needs 'serial'"),
        (TypeError("bad operand"), "does not take these options: bad operand"),
    ],
)
def test_an_option_that_an_interface_does_not_take_is_named(
    monkeypatch: pytest.MonkeyPatch, error: TypeError, why: str
) -> None:
    def fail(**_options: Any) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(UsageError) as no:
        Bus(parse_spec("virtual:a"))
    assert no.value.message == f"The CAN interface virtual {why}."
    assert no.value.hint == (
        "teds-provision's own options are bitrate, data_bitrate, fd, node, source and pace; any other goes"
        " to the interface."
    )


def test_an_interface_that_python_can_does_not_have_here_names_those_that_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(**_options: Any) -> None:
        raise can.CanInterfaceNotImplementedError("no module named x")

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(NoReaderError) as no:
        Bus(parse_spec("virtual:a"))
    assert no.value.message == "Cannot use CAN interface 'virtual' here: no module named x."
    assert (no.value.hint or "").startswith("python-can knows ")
    assert ", socketcan, " in (no.value.hint or "")


def test_a_frame_of_a_busy_bus_between_question_and_answer_costs_socketcand_one_more_try(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    port, interface, tries = listener.getsockname()[1], Interface(), list[dict[str, Any]]()
    threading.Thread(target=listener.accept, daemon=True).start()

    def busy(**options: Any) -> Interface:
        tries.append(options)
        if len(tries) == 1:
            raise can.CanError("unexpected answer < frame 123 >")
        return interface

    monkeypatch.setattr(can, "Bus", busy)
    bus = Bus(parse_spec(f"socketcand:can0?port={port}"))
    assert [each["host"] for each in tries] == ["127.0.0.1"] * 2
    assert (tries[0]["tcp_tune"], bus.stamps_arrivals) == (True, True)
    listener.close()


@pytest.mark.parametrize(
    ("text", "ours"),
    [
        ("socketcan:can0", True), ("socketcand:can0?host=localhost", True), ("udp_multicast:239.74.163.2", True),
        ("socketcand:can0", True), ("socketcand:can0?host=10.0.0.9", False), ("virtual:a", False),
        ("pcan:PCAN_USBBUS1", False),
    ],
)  # fmt: skip
def test_the_kernel_of_this_machine_stamps_the_frames_of_its_own_interfaces(text: str, ours: bool) -> None:
    assert clock_is_ours(parse_spec(text)) is ours


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("socketcan:can0", {}),
        ("socketcan:can0?fd=1", {"fd": True}),
        ("pcan:PCAN_USBBUS1?fd=1&bitrate=250000", {"fd": True, "bitrate": 250_000}),
        ("udp_multicast:239.74.163.2?port=4000", {"fd": False, "hop_limit": 0, "port": 4000}),
        ("udp_multicast:239.74.163.2?fd=1&hop_limit=1", {"fd": True, "hop_limit": 1}),
    ],
)
def test_a_bus_is_opened_for_fd_if_it_was_asked_for_and_multicast_is_always_asked(
    text: str, options: dict[str, Any]
) -> None:
    assert bus_module._options(parse_spec(text)) == options


def test_a_server_that_hung_up_is_told_from_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = socket.socketpair()
    bus = SimpleNamespace(_SocketCanDaemonBus__socket=near)
    assert not bus_module._hung_up(cast("Any", bus))
    far.send(b"<")
    assert not bus_module._hung_up(cast("Any", bus))
    near.recv(1)
    far.close()
    assert bus_module._hung_up(cast("Any", bus))
    near.close()
    assert bus_module._hung_up(cast("Any", bus))
    assert not bus_module._hung_up(cast("Any", SimpleNamespace()))


def test_a_datagram_that_python_can_cannot_unpack_is_no_frame_and_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [can.CanOperationError("could not unpack received message"), can.Message(arbitration_id=9, data=b"a")]
    bus = opened(monkeypatch, "virtual:faulty", Interface(recv=list(steps)))
    assert [bus.receive(0.0), bus.receive(0.0)] == [None, Frame(9, b"a")]


@pytest.mark.parametrize("error", [OSError(errno.ENETUNREACH, "Network is unreachable"), ValueError("bad group")])
def test_a_fast_path_that_does_not_open_closes_the_bus_that_did(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_given: Any, **_more: Any) -> None:
        raise error

    interface: Any = Interface()
    monkeypatch.setattr(bus_module, "of_bus", fail)
    with pytest.raises(NoReaderError):
        bus_module._multicast(interface, parse_spec("udp_multicast:239.74.163.2"))
    assert interface.ended == 1
    assert bus_module._multicast(interface, parse_spec("virtual:a")) is None


def test_what_the_fast_path_hears_is_a_frame_nothing_or_the_end_of_the_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = opened(monkeypatch, "virtual:faulty", Interface())
    frame, found = Frame(0x18DAF121, b"a"), list[Any]()
    heard: list[Any] = [
        None,
        ReceivedFrame(None),
        ReceivedFrame(frame),
        ReceivedFrame(None, 0x01),  # an error frame that does not say bus-off
        ReceivedFrame(None, 0x41),
        OSError(errno.ENETDOWN, "Network is down"),
    ]

    def receive(seconds: float) -> Any:
        assert seconds == 0.25
        step = heard.pop(0)
        if isinstance(step, Exception):
            raise step
        return step

    multicast: Any = SimpleNamespace(receive=receive)
    while heard:
        try:
            found.append(bus._heard(multicast, 0.25))
        except LinkError as failure:
            found.append(failure.message)
    assert found == [
        None,
        None,
        frame,
        None,
        "The CAN controller of virtual:faulty went bus-off: too many frame errors.",
        "The CAN bus virtual:faulty cannot be read: [Errno 100] Network is down.",
    ]


@pytest.mark.parametrize("refused", [False, True])
def test_of_multicast_one_group_is_heard_and_the_kernel_keeps_more_than_256_frames(
    monkeypatch: pytest.MonkeyPatch, refused: bool
) -> None:
    """Sixty nodes answer one question with 300; a kernel that does not allow more is no failure."""
    asked: list[tuple[Any, ...]] = []

    class Socket(socket.socket):
        def setsockopt(self, *words: Any) -> None:
            asked.append(words)
            if refused and words[1] == socket.SO_RCVBUF:
                raise PermissionError(errno.EPERM, "not permitted")

    interface: Any = Interface()
    with Socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        interface._multicast = SimpleNamespace(_socket=own)
        monkeypatch.setattr(can, "Bus", lambda **_options: interface)
        assert bus_module.open_bus(parse_spec("udp_multicast:239.74.163.2")) is interface
        assert bus_module.open_bus(parse_spec("virtual:a")) is interface
    assert asked == [(socket.IPPROTO_IP, 49, 0), (socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)]
    assert interface.filters is None


def test_the_libraries_of_can_write_no_lines_of_their_own_and_filters_are_whole(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("can", "isotp"):
        caplog.set_level(logging.WARNING, logger=name)
    interface: Any = Interface()
    monkeypatch.setattr(can, "Bus", lambda **_options: interface)
    spec = parse_spec("socketcan:can0")
    bus_module.open_bus(spec)
    assert interface.filters is None, "all that is on the bus"
    bus_module.open_bus(spec, [(0x18DA00F1, 0x1FFF00FF), (0x1CFF0000, 0x1FFF0000)])
    assert interface.filters == [
        {"can_id": 0x18DA00F1, "can_mask": 0x1FFF00FF, "extended": True},
        {"can_id": 0x1CFF0000, "can_mask": 0x1FFF0000, "extended": True},
    ]
    assert [logging.getLogger(name).level for name in ("can", "isotp")] == [logging.CRITICAL] * 2


def test_an_interface_whose_driver_is_missing_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_options: Any) -> None:
        raise can.CanInterfaceNotImplementedError("no library")

    monkeypatch.setattr(can, "Bus", fail)
    with pytest.raises(NoReaderError) as no:
        Bus(parse_spec("kvaser:0"))
    assert no.value.message == "Cannot use CAN interface 'kvaser' here: no library."
    assert no.value.hint == "It needs Kvaser's CANlib (linuxcan, from kvaser.com)."


def test_a_socketcand_that_is_not_there_is_started_or_named_with_its_host() -> None:
    assert bus_module._cure(parse_spec("socketcand:can0?host=desk&port=1")) == (
        "Start socketcand there, or give its address: socketcand:can0?host=127.0.0.1&port=29536."
    )
