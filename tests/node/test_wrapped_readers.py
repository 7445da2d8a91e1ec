"""Readers of wrapped sensors step by step, without bus, device and sysfs: who gets a frame, how often a file is read.

Devices, buffers and clocks are mocks; ``test_wrapped_dbc`` and ``test_wrapped_devices`` have real ones.
"""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, LinkError, NoReaderError, NotFoundError
from teds_provision.links.can.sensor_bus import SensorFrame
from teds_provision.node.wrapped import canopen_device, dbc_message, description, iio_reader, wrapped_source
from teds_provision.node.wrapped.can_reader import CanReader
from teds_provision.node.wrapped.dbc_message import FrameKey
from teds_provision.node.wrapped.iio_device import ScanElement
from teds_provision.node.wrapped.iio_reader import IioReader
from teds_provision.node.wrapped.latest_values import LatestValues
from teds_provision.node.wrapped.wrapped_source import WrappedSource


def _reader(key: FrameKey, log: list[Any], name: str) -> Any:
    return SimpleNamespace(message=SimpleNamespace(key=key), handle=lambda frame: log.append((name, frame.identifier)))


def test_a_frame_goes_to_the_readers_of_its_identifier_and_of_its_j1939_group() -> None:
    log: list[Any] = []
    readers = [
        _reader(FrameKey(0x100, False), log, "standard"),
        _reader(FrameKey(0x100, True), log, "extended"),
        _reader(FrameKey(0xFEF1, True, True), log, "group"),
        _reader(FrameKey(0x18FEF100, True), log, "whole"),
    ]
    made = CanReader(cast("Any", None), readers, log.append)
    for identifier, extended in ((0x100, False), (0x100, True), (0x18FEF1AA, True), (0x18FEF100, True), (0xFEF1, True)):
        made._route(SensorFrame(identifier, extended, b"", 0.0))
    assert log == [
        ("standard", 0x100), ("extended", 0x100), ("group", 0x18FEF1AA), ("whole", 0x18FEF100), ("group", 0x18FEF100),
    ]  # fmt: skip
    alone = CanReader(cast("Any", None), readers[:2], log.append)
    log.clear()
    alone._route(SensorFrame(0x18FEF1AA, True, b"", 0.0))
    assert log == []


def test_ticks_of_a_node_are_held_against_the_clock_that_dates_arrivals(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def at(moment: float) -> tuple[None, str]:
        asked.append(moment)
        return None, ""

    channel: Any = SimpleNamespace(at=at, channel=SimpleNamespace(name="torque"))
    source = WrappedSource([channel], cast("Any", lambda *_: None))
    monkeypatch.setattr(wrapped_source, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    source.start(cast("Any", SimpleNamespace(now=lambda: 30.0)))
    assert source.at(1, 31.5) is None
    assert source.at(2, 31.5) is None
    assert asked == [1001.5]


@pytest.mark.parametrize(
    ("period", "slow", "waits"),
    [
        (0.5, 0.0, [0.0, 0.5, 0.5]),
        (0.0001, 0.0, [0.0, 0.001, 0.001]),
        (0.5, 0.2, [0.0, 0.3, 0.3]),
        (0.5, 0.8, [0.0, 0.0, 0.0]),
    ],
)
def test_files_are_read_once_a_period_and_lost_time_is_not_made_up_for(
    monkeypatch: pytest.MonkeyPatch, period: float, slow: float, waits: list[float]
) -> None:
    """Each millisecond at most."""
    clock, waited, read = [50.0], list[float](), list[Any]()

    def wait(seconds: float) -> bool:
        waited.append(seconds)
        clock[0] += seconds
        return len(waited) > 2

    def read_file(channel: str, part: str) -> None:
        read.append((channel, part))
        clock[0] += slow

    monkeypatch.setattr(iio_reader, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    rig = SimpleNamespace(
        _device=SimpleNamespace(period=period),
        _stop=SimpleNamespace(wait=wait),
        _parts=[("x", 1)],
        _read_file=read_file,
    )
    IioReader._poll(cast("Any", rig))
    assert waited == pytest.approx(waits)
    assert read == [("x", 1)] * 2


def test_a_file_that_cannot_be_read_says_why_until_it_can(tmp_path: Path) -> None:
    log: list[Any] = []
    part: Any = SimpleNamespace(note_trouble=log.append, put=lambda _, raw: log.append(raw))
    channel: Any = SimpleNamespace(file=tmp_path / "in_temp_raw")
    made: Any = IioReader.__new__(IioReader)
    made._read_file(channel, part)
    (tmp_path / "in_temp_raw").write_text("hot\n")
    made._read_file(channel, part)
    (tmp_path / "in_temp_raw").write_text(" 23.5\n")
    made._read_file(channel, part)
    assert log == [
        "in_temp_raw cannot be read: No such file or directory", "in_temp_raw cannot be read: it holds no number", "",
        23.5,
    ]  # fmt: skip


class _Stop:
    def __init__(self, rounds: int) -> None:
        self.rounds, self.waits = rounds, list[float]()

    def is_set(self) -> bool:
        self.rounds -= 1
        return self.rounds < 0

    def wait(self, seconds: float) -> None:
        self.waits.append(seconds)


def _chunks(
    rounds: int, monkeypatch: pytest.MonkeyPatch, *reads: bytes | OSError
) -> tuple[list[bytes], list[str], _Stop]:
    near, far = os.pipe()
    os.write(far, b"x")  # it can be read
    steps, troubles, stop = list(reads), list[str](), _Stop(rounds)

    def read(_descriptor: int, most: int) -> bytes:
        assert most == 65536
        step = steps.pop(0)
        if isinstance(step, OSError):
            raise step
        return step

    monkeypatch.setattr(iio_reader, "os", SimpleNamespace(read=read))
    rig = SimpleNamespace(_descriptor=near, _stop=stop, _trouble=troubles.append)
    try:
        return list(IioReader._chunks(cast("Any", rig), 4)), troubles, stop
    finally:
        os.close(near)
        os.close(far)


def test_whole_scans_of_a_buffer_come_as_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    found, troubles, _ = _chunks(4, monkeypatch, b"abc", BlockingIOError(), b"defghij", b"kl")
    assert (found, troubles) == ([b"", b"abcdefgh", b"ijkl"], [])


def test_a_buffer_that_fails_is_given_up_and_one_that_ended_is_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    found, troubles, stop = _chunks(3, monkeypatch, b"", b"abcd", OSError(errno.EIO, "Input/output error"))
    assert (found, stop.waits) == ([b"abcd"], [0.2])
    assert troubles == ["the buffer has ended", "the buffer cannot be read: Input/output error"]


def test_the_scans_of_a_buffer_are_a_period_apart_and_the_newest_is_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two elements of 16 and 32 bits: two octets lie between them."""
    scans = [ScanElement(0, "le", False, 16, 16, 0), ScanElement(1, "le", False, 32, 32, 0)]
    came: list[tuple[str, float, int]] = []
    parts: list[Any] = [
        (SimpleNamespace(scan=scan), SimpleNamespace(put=lambda at, raw, name=name: came.append((name, at, raw))))
        for name, scan in zip("xz", scans, strict=True)
    ]
    sizes: list[int] = []

    def chunks(size: int) -> list[bytes]:
        sizes.append(size)
        return [bytes.fromhex("0100 ffff 02000100 0300 ffff 04000000"), bytes.fromhex("0500 ffff 06000000")]

    monkeypatch.setattr(iio_reader, "time", SimpleNamespace(monotonic=lambda: 8.0))
    rig = SimpleNamespace(_parts=parts, _device=SimpleNamespace(period=0.25), _chunks=chunks)
    IioReader._read_buffer(cast("Any", rig))
    assert sizes == [8]
    assert came == [
        ("x", 7.75, 1), ("z", 7.75, 0x10002), ("x", 8.0, 3), ("z", 8.0, 4), ("x", 8.0, 5), ("z", 8.0, 6),
    ]  # fmt: skip


@pytest.mark.parametrize(("period", "kept"), [(1.0, 4), (0.07, 5), (1 / 1024, 308), (1e-5, 4096)])
def test_values_of_the_last_three_tenths_of_a_second_are_kept(period: float, kept: int) -> None:
    channel = description.WrappedChannel("x", "V", bits=8, period=period)
    assert LatestValues(channel)._arrivals.maxlen == kept


def test_a_late_value_has_its_period_in_four_digits_and_what_troubles_the_device() -> None:
    late = LatestValues(description.WrappedChannel("x", "V", bits=8, period=1 / 30), "PDO")
    assert late._late() == "no PDO for 100 ms, 3 periods of 33.33 ms"
    late._trouble = "it is off"
    assert late._late() == "no PDO for 100 ms, 3 periods of 33.33 ms: it is off"


# -- descriptions ------------------------------------------------------------------------------------------------------


def _signal(ids: list[int] | None, selector: str | None) -> Any:
    return SimpleNamespace(multiplexer_ids=ids, multiplexer_signal=selector)


def test_signals_of_another_selector_do_not_lengthen_the_turn() -> None:
    signals = [_signal([0], "A"), _signal([1, 2], "A"), _signal([0, 1, 2, 3, 4], "B"), _signal(None, None)]
    message: Any = SimpleNamespace(signals=signals)
    assert [dbc_message._turns(message, signal) for signal in signals] == [3, 3, 5, 1]


def test_a_signal_whose_scaling_is_not_linear_is_measured_as_a_raw_number() -> None:
    signal: Any = SimpleNamespace(
        name="oil", unit="degC", minimum=-40, maximum=125, scale=0.5, offset=-8, length=8, is_signed=False,
        is_float=False, choices=None, comment="two\n words", multiplexer_ids=None, conversion=SimpleNamespace(),
    )  # fmt: skip
    message: Any = SimpleNamespace(name="Engine", is_multiplexed=lambda: False)
    channel = dbc_message._channel(message, signal, 0.1)
    assert (channel.unit, channel.scale, channel.offset, channel.low, channel.high) == ("count", 1.0, 0.0, None, None)
    assert (channel.note, channel.comment) == (
        "its scaling is not linear, so it is measured as a raw number", "two words"
    )  # fmt: skip
    signal.conversion = SimpleNamespace(scale=0.5, offset=-8)
    channel = dbc_message._channel(message, signal, 0.0)
    assert (channel.unit, channel.scale, channel.offset, channel.low, channel.high) == ("degC", 0.5, -8.0, -40, 125)
    assert channel.note == ("the file states no cycle time of Engine, so 100 ms is assumed (GenMsgCycleTime)")


def test_a_frame_of_a_message_in_messages_has_no_numbers() -> None:
    decoded: list[Any] = [[("inner", {})], {"torque": 7, "state": "text"}]
    message: Any = SimpleNamespace(name="Outer", decode=lambda *_, **__: decoded.pop(0))
    made = dbc_message.DbcMessage(cast("Any", None), message)
    with pytest.raises(BadDataError) as no:
        made.numbers(bytes(8))
    assert no.value.message == "A frame of Outer cannot be decoded."
    assert made.numbers(bytes(8)) == {"torque": 7}


def test_an_eds_file_needs_canopen_and_one_that_cannot_be_read_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cell.eds"
    path.write_text("[1000]")

    def reader(error: Exception) -> Any:
        def import_od(_path: str, *, node_id: int) -> None:
            assert node_id == 1
            raise error

        return SimpleNamespace(import_od=import_od)

    for error, reason in ((ValueError("  bad line\nand more"), "bad line"), (KeyError(), "KeyError"),
                          (ValueError("x" * 300), "x" * 200)):  # fmt: skip
        monkeypatch.setitem(sys.modules, "canopen", reader(error))
        with pytest.raises(BadDataError) as no:
            canopen_device.load(path)
        assert no.value.message == f"{path} is not an EDS file that can be read: {reason}"
        assert no.value.hint == "Check the file."
    monkeypatch.setitem(sys.modules, "canopen", None)
    with pytest.raises(NotFoundError) as none:
        canopen_device.load(path)
    assert none.value.message == "An EDS file needs the package canopen."
    assert "[bench]" in (none.value.hint or "")


@pytest.mark.parametrize(
    ("low", "high", "limits"),
    [
        (0, 0, (None, None)),
        (1, 0, (None, None)),
        (None, 5, (None, None)),
        (0, None, (None, None)),
        (-1, 2, (-1.0, 2.0)),
    ],
)
def test_a_range_of_nothing_states_none(low: int | None, high: int | None, limits: tuple[Any, Any]) -> None:
    assert dbc_message._limits(cast("Any", SimpleNamespace(minimum=low, maximum=high))) == limits


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        (None, 0),
        (SimpleNamespace(default=5), 5),
        (SimpleNamespace(default=5, value=7), 7),
        (SimpleNamespace(default=5, value=None), 5),
        (SimpleNamespace(default=5, value="text"), 5),
        (SimpleNamespace(default=None), 0),
        (SimpleNamespace(default="text", value=0), 0),
    ],
)
def test_the_configured_value_of_a_dcf_goes_before_the_default(variable: Any, value: int) -> None:
    objects: Any = SimpleNamespace(get_variable=lambda index, subindex: variable if (index, subindex) == (1, 2) else 9)
    assert canopen_device._default(objects, 1, 2) == value


def test_objects_of_one_name_are_told_apart_by_their_parents_or_their_index() -> None:
    def variable(name: str, qualname: str, index: int, subindex: int) -> Any:
        return SimpleNamespace(name=name, qualname=qualname, index=index, subindex=subindex)

    found = [
        variable("a", "a", 0x6000, 0), variable("b", "x.b", 0x6401, 1), variable("b", "y.b", 0x6402, 1),
        variable("c", "z.c", 0x6ABC, 1), variable("c", "z.c", 0x6ABC, 2),
    ]  # fmt: skip
    names = [canopen_device._name(each, found) for each in found]
    assert names == ["a", "x.b", "y.b", "z.c 6ABC.1", "z.c 6ABC.2"]


@pytest.mark.parametrize(
    ("name", "cut"),
    [("a" * 121, "a" * 120), ("é" * 61, "é" * 60), ("a" * 119 + "é", "a" * 119), (" a\nb\x07 ", "a b")],
)
def test_a_name_of_a_teds_has_120_octets_and_no_half_letter(name: str, cut: str) -> None:
    assert description._cut(name) == cut


@pytest.mark.parametrize(
    ("scans", "opens", "log"),
    [
        ((1, 1), True, ["open 2", "buffer"]),
        ((1, 1), False, ["open 2", "files"]),
        ((1, None), True, ["files"]),
        ((None, 1), True, ["files"]),
        ((None, None), True, ["files"]),
    ],
)
def test_a_buffer_is_read_if_it_holds_every_channel(scans: tuple[int | None, ...], opens: bool, log: list[str]) -> None:
    seen: list[str] = []

    def open_buffer(channels: list[Any]) -> bool:
        seen.append(f"open {len(channels)}")
        return opens

    made: Any = IioReader.__new__(IioReader)
    made._parts = [(SimpleNamespace(scan=scan), None) for scan in scans]
    made._open_buffer = open_buffer
    made._poll, made._read_buffer = lambda: seen.append("files"), lambda: seen.append("buffer")
    made.start()
    made._thread.join()
    assert seen == log


class SensorsBus:
    """Mock of a bus of sensors: whether it was closed."""

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1


def test_a_lost_bus_is_closed_and_tried_again_ever_later_until_it_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    troubles, said, waits, buses = list[str](), list[str](), list[float](), list[SensorsBus]()
    reader: Any = SimpleNamespace(message=SimpleNamespace(key=FrameKey(0x100, False)), note_trouble=troubles.append)
    made: Any = CanReader(cast("Any", None), [reader], said.append)
    steps: list[Any] = [LinkError("Bus off."), None, *[NoReaderError("No such device.")] * 6, LinkError("Bus off.")]

    def opened() -> SensorsBus:
        if isinstance(steps[0], NoReaderError):
            raise steps.pop(0)
        buses.append(SensorsBus())
        return buses[-1]

    def read(bus: SensorsBus) -> None:
        assert bus is buses[-1]
        if (step := steps.pop(0)) is not None:
            raise step

    class Waits:
        def is_set(self) -> bool:
            return not steps

        def wait(self, seconds: float) -> None:
            waits.append(seconds)

        def set(self) -> None:
            steps.clear()

    made._open, made._read, made._stop = opened, read, Waits()
    made._run()
    assert waits == [1, 1, 2, 4, 8, 16, 30, 30]
    assert said[:2] == [
        f"{why} The values of the wrapped sensors are invalid until the bus is back."
        for why in ("Bus off.", "No such device.")
    ]
    assert troubles[:2] == ["Bus off", "No such device"]
    assert [bus.closed for bus in buses] == [1, 1, 1]
    made._bus = buses[0]
    made.stop()
    made.stop()
    assert (buses[0].closed, made._bus) == (2, None)


def test_what_was_enabled_last_is_disabled_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel refuses a scan element as long as its buffer runs."""
    written: list[tuple[str, str]] = []
    monkeypatch.setattr(Path, "write_text", lambda path, text: written.append((path.name, text)))
    for folder, name in (("scan_elements", "in_x_en"), ("scan_elements", "in_y_en"), ("buffer", "enable")):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).touch()
    device = SimpleNamespace(folder=tmp_path, character=tmp_path, name="accel", period=0.01)

    def refuse(*_: object) -> int:
        raise OSError(errno.EBUSY, "Device or resource busy")

    flags = {name: getattr(os, name) for name in ("O_RDONLY", "O_NONBLOCK", "O_CLOEXEC")}
    monkeypatch.setattr(iio_reader, "os", SimpleNamespace(open=refuse, **flags))
    told: list[str] = []
    made: Any = IioReader.__new__(IioReader)
    made._device, made._notify, made._enabled, made._descriptor = device, told.append, [], -1
    channels: Any = [SimpleNamespace(name="x"), SimpleNamespace(name="y")]
    assert made._open_buffer(channels) is False
    order = [("in_x_en", "1"), ("in_y_en", "1"), ("enable", "1"), ("enable", "0"), ("in_y_en", "0"), ("in_x_en", "0")]
    assert written == order
    assert told == ["The buffer of accel cannot be used (Device or resource busy): its files are read one by one."]
    made._stop, made._thread = SimpleNamespace(set=lambda: None), None
    made._enabled = [tmp_path / "buffer0", tmp_path / "buffer1"]
    made.stop()
    assert written[6:] == [("buffer1", "0"), ("buffer0", "0")]


def test_a_buffer_that_may_not_be_used_leaves_its_elements_as_they_were(tmp_path: Path) -> None:
    told: list[str] = []
    (tmp_path / "scan_elements").mkdir()
    (tmp_path / "buffer0").mkdir()
    for name in ("scan_elements/in_x_en", "scan_elements/in_y_en", "buffer0/enable", "buffer0/length"):
        (tmp_path / name).write_text("0")
    device = SimpleNamespace(folder=tmp_path, character=tmp_path / "iio:device0", name="accel", period=0.01)
    made: Any = IioReader.__new__(IioReader)
    made._device, made._notify, made._enabled, made._descriptor = device, told.append, [], -1
    channels: Any = [SimpleNamespace(name="x"), SimpleNamespace(name="y")]
    assert made._open_buffer(channels) is False, "no character device"
    (tmp_path / "iio:device0").mkdir()
    made._enabled = []
    (tmp_path / "scan_elements/in_y_en").unlink()
    (tmp_path / "scan_elements/in_y_en").mkdir()
    assert made._open_buffer(channels) is False
    assert (tmp_path / "scan_elements/in_x_en").read_text() == "0"
    assert told == ["The buffer of accel cannot be used (Is a directory): its files are read one by one."]
    assert made._enabled == []
