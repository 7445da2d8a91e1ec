"""Frames of a sensor's own bus: what counts as a frame, when it came, and a bus that fails. The interface is a mock."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any, cast

import can
import msgpack
import pytest

from teds_provision.errors import LinkError
from teds_provision.links.can import multicast, sensor_bus
from teds_provision.links.can.sensor_bus import SensorBus, SensorFrame
from teds_provision.links.can.spec import parse_spec


class Interface:
    def __init__(self, *steps: Any) -> None:
        self.steps, self.filters, self.waited = list(steps), None, list[float]()

    def recv(self, timeout: float) -> Any:
        self.waited.append(timeout)
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        return step

    def set_filters(self, filters: Any) -> None:
        self.filters = filters

    def shutdown(self) -> None:
        raise RuntimeError("driver")


def opened(
    monkeypatch: pytest.MonkeyPatch, text: str, interface: Interface, *wanted: tuple[int, int, bool]
) -> SensorBus:
    monkeypatch.setattr(sensor_bus, "open_bus", lambda _spec: interface)
    monkeypatch.setattr(sensor_bus, "time", SimpleNamespace(time=lambda: 5000.0, monotonic=lambda: 100.0))
    return SensorBus(parse_spec(text), wanted)


def message(**more: Any) -> can.Message:
    members: dict[str, Any] = {"arbitration_id": 0x123, "is_extended_id": False, "data": b"ab", "timestamp": 4999.5}
    return can.Message(**members | more)


@pytest.mark.parametrize(
    ("text", "stamp", "at"),
    [
        ("socketcan:can0", 4999.5, 99.5),
        ("socketcan:can0", 5000.0, 100.0),
        ("socketcan:can0", 5000.5, 100.0),
        ("socketcan:can0", 0.0, 100.0),
        ("virtual:a", 4999.5, 100.0),
    ],
)
def test_a_frame_is_dated_by_this_kernel_alone(
    monkeypatch: pytest.MonkeyPatch, text: str, stamp: float, at: float
) -> None:
    bus = opened(monkeypatch, text, Interface(message(timestamp=stamp)))
    assert bus.receive(0.5) == SensorFrame(0x123, False, b"ab", at)
    assert bus.stamped is text.startswith("socketcan")


def test_data_frames_alone_are_frames_of_a_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    interface = Interface(
        None, message(is_error_frame=True), message(is_remote_frame=True, data=None), message(is_extended_id=True)
    )
    bus = opened(monkeypatch, "socketcan:can0", interface)
    found = [bus.receive(seconds) for seconds in (-1.0, 0.0, 0.2, 0.2)]
    assert found == [None, None, None, SensorFrame(0x123, True, b"ab", 99.5)]
    assert interface.waited == [0.0, 0.0, 0.2, 0.2]


def test_socketcan_lets_through_what_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, wanted, filters in (
        ("socketcan:can0", [(0x123, 0x7FF, False)], [{"can_id": 0x123, "can_mask": 0x7FF, "extended": False}]),
        ("socketcan:can0", [], None),
        ("virtual:a", [(0x123, 0x7FF, False)], None),
    ):
        interface = Interface()
        opened(monkeypatch, text, interface, *wanted)
        assert interface.filters == filters


@pytest.mark.parametrize("error", [can.CanOperationError("gone"), OSError(100, "down"), ValueError("odd")])
def test_a_bus_that_cannot_be_read_is_named(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    bus = opened(monkeypatch, "socketcan:can0", Interface(error))
    with pytest.raises(LinkError) as no:
        bus.receive(0.0)
    assert no.value.message == f"The CAN bus socketcan:can0 cannot be read: {error}."
    assert no.value.hint == "Check that the adapter is up and plugged in."
    bus.close()


GOOD: dict[str, Any] = {"arbitration_id": 0x123, "data": b"ab", "is_extended_id": False}
DATAGRAMS: list[tuple[Any, SensorFrame | None]] = [
    (GOOD, SensorFrame(0x123, False, b"ab", 1.0)),
    ({"arbitration_id": 0x1FFFFFFF, "data": b""}, SensorFrame(0x1FFFFFFF, True, b"", 1.0)),
    (GOOD | {"arbitration_id": 0x7FF, "data": bytes(64)}, SensorFrame(0x7FF, False, bytes(64), 1.0)),
    (GOOD | {"arbitration_id": 0x800}, None),
    ({"arbitration_id": 0x20000000, "data": b""}, None),
    (GOOD | {"arbitration_id": -1}, None),
    (GOOD | {"arbitration_id": "1"}, None),
    (GOOD | {"arbitration_id": True}, None),
    (GOOD | {"data": "ab"}, None),
    (GOOD | {"data": bytes(65)}, None),
    (GOOD | {"is_error_frame": True}, None),
    (GOOD | {"is_remote_frame": True}, None),
    ({"data": b"ab"}, None),
    ([1, 2], None),
    (b"\xc1", None),
]


@pytest.mark.parametrize(("fields", "frame"), DATAGRAMS)
def test_a_datagram_is_a_frame_or_passed_over(
    monkeypatch: pytest.MonkeyPatch, fields: Any, frame: SensorFrame | None
) -> None:
    octets = fields if isinstance(fields, bytes) else msgpack.packb(fields)
    monkeypatch.setattr(sensor_bus, "arrival", lambda _ancillary: 1.0)
    source: Any = SimpleNamespace(recvmsg=lambda *_: (octets, [], 0, ("127.0.0.1", 5)))
    assert SensorBus._datagram(cast("Any", None), source) == frame


class _Sender:
    """A socket of which the first send finds no room."""

    def __init__(self) -> None:
        self.near, self.far = socket.socketpair()
        self.sent, self.full = list[bytes](), 1

    def fileno(self) -> int:
        return self.near.fileno()

    def send(self, datagram: bytes) -> None:
        if self.full:
            self.full -= 1
            raise BlockingIOError
        self.sent.append(datagram)


def test_a_datagram_that_finds_no_room_is_sent_once_when_there_is_some(monkeypatch: pytest.MonkeyPatch) -> None:
    sender = _Sender()
    rig: Any = SimpleNamespace(_out=sender)
    multicast.Multicast.send(rig, b"frame", 60.0)
    assert sender.sent == [b"frame"]
    asked: list[Any] = []

    def no_room(*given: Any) -> tuple[list[Any], list[Any], list[Any]]:
        asked.append(given)
        return [], [], []

    sender.full = 1
    monkeypatch.setattr(multicast, "select", SimpleNamespace(select=no_room))
    with pytest.raises(TimeoutError, match="no room for another datagram"):
        multicast.Multicast.send(rig, b"frame", 0.25)
    assert asked == [([], [sender], [], 0.25)]
    assert sender.sent == [b"frame"]
    sender.near.close()
    sender.far.close()
