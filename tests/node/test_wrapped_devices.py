"""Wrapped CANopen and IIO devices.

The CANopen device is python-canopen's own LocalNode in another process. The IIO devices are FIXTURES: folders that look
like sysfs, and a FIFO in place of the character device, as this machine has no such hardware.
"""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotFoundError, PolicyError, UsageError
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.wrapped import canopen_device, iio_device
from teds_provision.node.wrapped.canopen_reader import CanopenReader, DeviceReader
from teds_provision.node.wrapped.iio_device import ScanElement
from teds_provision.node.wrapped.iio_reader import IioReader, layout, raw_of
from teds_provision.node.wrapped.latest_values import LatestValues
from teds_provision.node.wrapped.reading import describe
from teds_provision.node.wrapped.running import SensorPlace, WrappedRun, require_match
from teds_provision.teds.image import Image
from teds_provision.teds.origin import Origin
from teds_provision.teds.sheet import Sheet
from tests.e2e.desk import ROOT
from tests.pace import until
from tests.places import free_bus

EDS = ROOT / "examples" / "bench" / "cell.eds"
UUID = bytes(range(10))


def shown(values: LatestValues) -> float | str:
    """The value now in the channel's unit, or why there is none."""
    reading, why = values.at(time.monotonic())
    if why or reading is None or reading.raw is None:
        return why
    form, channel = values.channel.sample, values.channel
    return channel.value(reading.raw - form.shift) if form.raw else channel.written.from_si(reading.raw)


# -- CANopen -----------------------------------------------------------------------------------------------------------


class Device:
    """A CANopen torque cell in a process of its own."""

    def __init__(self, bus: str) -> None:
        group, port = bus.removeprefix("udp_multicast:").split("?port=")
        words = [sys.executable, str(Path(__file__).parent / "canopen_player.py"), group, port, str(EDS), "5"]
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.answer()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def send(self, **what: object) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()
        self.answer()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def bus() -> str:
    return free_bus()


@pytest.fixture
def device(bus: str) -> Iterator[Device]:
    made = Device(bus)
    yield made
    made.close()


def test_an_eds_gives_channels_with_range_factor_and_period() -> None:
    sensor = describe(f"eds:{EDS}")
    torque, temperature = sensor.channels
    assert (torque.name, torque.unit, torque.scale, torque.limits, torque.period) == (
        "torque",
        "N·m",
        0.1,
        (-200, 200),
        0.5,
    )
    assert torque.sample.raw
    assert (temperature.name, temperature.unit, temperature.is_float, temperature.period) == (
        "temperature",
        "degC",
        True,
        0.1,
    )
    assert "no event timer" in temperature.note
    assert (sensor.origin.kind, sensor.origin.name) == ("eds", "Torque cell")
    sheet = Sheet.from_image(Image(UUID, sensor.blocks(UUID)))
    assert not sheet.errors
    assert [(c.has_range, math.isfinite(c.uncertainty)) for c in sheet.channels] == [(True, False), (False, False)]


def test_of_two_pdos_with_one_object_the_first_gives_its_period(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last of 512 PDOs and the last of its 64 places count too."""
    stated = {
        (0x1800, 5): 100, (0x1A00, 1): 0x20000110, (0x1A00, 2): 0x2001FF08,
        (0x1801, 5): 20, (0x1A01, 1): 0x20000110, (0x1A01, 3): 0x20020008,
        (0x1BFF, 64): 0x20030008, (0x1C00, 1): 0x20040008,
    }  # fmt: skip
    monkeypatch.setattr(canopen_device, "_default", lambda _, index, place: stated.get((index, place), 0))
    objects: Any = {index for index, _ in stated}
    assert canopen_device._sent_objects(objects) == {
        (0x2000, 1): 0.1, (0x2001, 0xFF): 0.1, (0x2002, 0): 0.02, (0x2003, 0): 0.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("product", "title"),
    [
        (None, "left cell"),
        ("", "left cell"),
        ("  Torque\n cell ", "Torque cell"),
        ("Cell " * 13, ("Cell " * 13).strip()),
    ],
)
def test_a_device_has_the_name_of_its_product_or_that_of_its_file(product: str | None, title: str) -> None:
    octets, objects = canopen_device.load(EDS)
    objects.device_information.product_name = product
    sensor = canopen_device.described(Path("left cell.eds"), octets, objects)
    assert (sensor.title, sensor.origin.name) == (title, title[:60])


@pytest.mark.link
def test_pdos_are_mapped_as_the_device_says_and_the_rest_is_asked_for(bus: str, device: Device) -> None:
    messages: list[str] = []
    reader = DeviceReader(EDS, 5, messages.append)
    torque, temperature = reader.values
    running = CanopenReader(parse_spec(bus), [reader], messages.append)
    running.start()
    try:
        device.send(torque=1234, temperature=36.5)
        until(lambda: shown(torque) == pytest.approx(123.4))
        until(lambda: shown(temperature) == pytest.approx(36.5))
        device.send(torque=-2001)
        until(lambda: shown(torque) == "-200.1 N·m is outside -200 to 200 N·m")
        device.send(silent=True)
        until(lambda: shown(torque) == "no PDO for 1500 ms, 3 periods of 500 ms")
        assert shown(temperature) == pytest.approx(36.5)
        assert messages == []
    finally:
        running.stop()


@pytest.mark.link
def test_a_device_that_is_not_there_is_looked_for_until_it_comes(bus: str) -> None:
    messages: list[str] = []
    reader = DeviceReader(EDS, 5, messages.append)
    running = CanopenReader(parse_spec(bus), [reader], messages.append)
    running.start()
    try:
        until(lambda: bool(messages))
        assert messages[0].startswith("CANopen device 5: its PDO mapping cannot be read")
        assert "cannot be read" in str(shown(reader.values[0]))
        late = Device(bus)
        try:
            late.send(torque=10)
            until(lambda: shown(reader.values[0]) == pytest.approx(1.0))
        finally:
            late.close()
    finally:
        running.stop()


def test_options_of_a_canopen_run(bus: str) -> None:
    origin = describe(f"eds:{EDS}").origin
    require_match(SensorPlace(f"canopen:{EDS}", bus, (5, 6)), [origin, origin], ["a", "b"])
    for node_ids in ((), (5,), (5, 6, 7)):
        with pytest.raises(UsageError, match="--node-id"):
            require_match(SensorPlace(f"canopen:{EDS}", bus, node_ids), [origin, origin], ["a", "b"])


@pytest.mark.parametrize(
    ("second", "why"),
    [
        (None, "Node b wraps no sensor."),
        (Origin("iio", "adc"), "Node b wraps a sensor of kind iio, which --source canopen does not read."),
    ],
)
def test_every_node_of_a_run_wraps_a_sensor_of_its_kind(second: Origin | None, why: str) -> None:
    place = SensorPlace(f"canopen:{EDS}", "socketcan:can0", (5, 6))
    with pytest.raises(UsageError) as no:
        require_match(place, [describe(f"eds:{EDS}").origin, second], ["a", "b"])
    assert no.value.message == why


@given(st.binary(max_size=300), st.integers(0, 60))
def test_an_eds_ends_in_a_description_or_in_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, octets: bytes, share: int
) -> None:
    path = tmp_path_factory.mktemp("eds") / "any.eds"
    known = EDS.read_bytes()
    path.write_bytes(known[: len(known) * share // 60] + octets)
    with suppress(BadDataError):
        canopen_device.read(path).blocks(UUID)


# -- IIO: fixtures -----------------------------------------------------------------------------------------------------


@pytest.fixture
def sysfs(tmp_path: Path) -> Callable[..., Path]:
    """FIXTURE: a folder that looks like an IIO device in sysfs, under a root of its own."""

    def make(device: str = "iio:device0", /, **files: str) -> Path:
        folder = tmp_path / "sys" / "bus" / "iio" / "devices" / device
        for file, text in files.items():
            path = folder / file.replace("__", "/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n")
        (tmp_path / "dev").mkdir(exist_ok=True)
        return folder

    return make


PRESSURE = {
    "name": "bmp280",
    "in_pressure_input": "101.325",
    "in_temp_input": "23500",
    "in_voltage0_raw": "512",
    "in_voltage_scale": "3.222656250",
    "in_voltage0_offset": "-12",
    "sampling_frequency": "20.0",
}


def test_iio_channels_have_scale_offset_unit_and_frequency(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    sysfs(**PRESSURE)
    for text in (
        f"iio:device0?root={tmp_path}",
        f"bmp280?root={tmp_path}",
        str(tmp_path / "sys/bus/iio/devices/iio:device0"),
    ):
        sensor = describe(f"iio:{text}")
        assert (sensor.origin.kind, sensor.origin.name, sensor.origin.sha256) == ("iio", "bmp280", "")
        assert {c.name: (c.unit, c.period) for c in sensor.channels} == {
            "pressure": ("kPa", 0.05),
            "temp": ("degC", 0.05),
            "voltage0": ("mV", 0.05),
        }
    assert not Sheet.from_image(Image(UUID, sensor.blocks(UUID))).errors


def test_iio_facts_of_a_channel_go_before_those_of_its_type(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    sysfs(
        label="desk",
        in_accel_x_raw="0",
        in_accel_y_raw="0",
        in_accel_x_scale="0.5",
        in_accel_scale="0.25",
        in_voltage1_raw="0",
        in_voltage1_scale="2",
        in_voltage_scale="4",
        in_voltage1_offset="-3",
        in_voltage_offset="-7",
        in_temp_raw="7",
        in_temp_input="21500",
        in_smell_raw="1",
    )
    sensor = describe(f"iio:desk?root={tmp_path}")
    assert sensor.title == "desk", "a device is found by its label"
    found = {channel.name: channel for channel in sensor.channels}
    assert {name: (c.scale, c.offset) for name, c in found.items()} == {
        "accel_x": (0.5, 0.0),
        "accel_y": (0.25, 0.0),
        "voltage1": (2.0, -6.0),
        "temp": (0.001, 0.0),
        "smell": (1.0, 0.0),
    }
    assert found["temp"].is_float, "of both files, the one that holds a value"
    assert {c.period for c in sensor.channels} == {0.1}
    why = "the device states no sampling frequency, so 100 ms is assumed"
    assert found["temp"].note == why
    assert found["smell"].note == f"the type smell has no unit here: values are plain numbers; {why}"
    assert found["smell"].unit == "count"


@pytest.mark.parametrize(
    ("files", "title"),
    [({"name": "adc", "label": "desk"}, "adc"), ({"label": "desk"}, "desk"), ({}, "iio:device3")],
)
def test_a_device_is_called_by_its_name_then_its_label_then_its_folder(
    sysfs: Callable[..., Path], tmp_path: Path, files: dict[str, str], title: str
) -> None:
    folder = sysfs("iio:device3", in_voltage0_raw="1", **files)
    found = iio_device.find(f"{folder}?root={tmp_path}")
    assert (found.name, found.character) == (title, tmp_path / "dev" / "iio:device3")


@pytest.mark.parametrize(
    ("kind", "unit", "value"),
    [
        ("voltage", "mV", 500.0), ("altvoltage", "mV", 500.0), ("current", "mA", 500.0), ("power", "mW", 500.0),
        ("temp", "degC", 0.5), ("accel", "m/s²", 500.0), ("gravity", "m/s²", 500.0), ("anglvel", "rad/s", 500.0),
        ("angl", "rad", 500.0), ("incli", "degree", 500.0), ("rot", "degree", 500.0), ("magn", "T", 0.05),
        ("pressure", "kPa", 500.0), ("humidityrelative", "%", 0.5), ("positionrelative", "%", 0.5),
        ("illuminance", "lx", 500.0), ("distance", "m", 500.0), ("velocity", "m/s", 500.0),
        ("resistance", "Ω", 500.0), ("capacitance", "nF", 500.0), ("energy", "J", 500.0),
        ("concentration", "%", 500.0), ("electricalconductivity", "S/m", 500.0),
    ],
)  # fmt: skip
def test_the_unit_of_each_type_of_iio(
    sysfs: Callable[..., Path], tmp_path: Path, kind: str, unit: str, value: float
) -> None:
    """Documentation/ABI/testing/sysfs-bus-iio: milli °C, gauss, milli percent; the rest as it is."""
    sysfs(name="one", **{f"in_{kind}_raw": "0", f"in_{kind}_scale": "2"})
    (channel,) = describe(f"iio:one?root={tmp_path}").channels
    assert (channel.unit, channel.value(250)) == (unit, pytest.approx(value))
    assert (channel.bits, channel.signed, channel.is_float) == (32, True, False), "what sysfs gives as text"


def test_what_is_a_channel_of_an_iio_device_and_in_which_order(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    scans = {
        "scan_elements__in_voltage2_index": "0", "scan_elements__in_voltage2_type": "le:u12/16>>4",
        "scan_elements__in_voltage1_index": "1", "scan_elements__in_voltage1_type": "be:s24/32X2>>8",
        "scan_elements__in_voltage0_index": "2", "scan_elements__in_voltage0_type": "le:u13/16>>4",
        "scan_elements__in_accel_x_index": "two", "scan_elements__in_accel_x_type": "le:u12/16>>4",
        "scan_elements__in_accel_y_index": "3", "scan_elements__in_accel_y_type": "le:u12/24",
    }  # fmt: skip
    raws = ("voltage0", "voltage1", "voltage2", "voltage0-voltage1", "accel_x", "accel_y")
    others = {"in_voltage0_calibbias": "1", "in_temp_label": "board", "out_voltage0_raw": "1", "in_voltage0_scale": "1"}
    sysfs(name="adc", **{f"in_{name}_raw": "0" for name in raws}, **others, **scans)
    found = iio_device.find(f"adc?root={tmp_path}")
    assert [(channel.name, channel.scan) for channel in found.channels] == [
        ("voltage2", ScanElement(0, "le", False, 12, 16, 4)),
        ("voltage1", ScanElement(1, "be", True, 24, 32, 8)),
        ("accel_x", None),
        ("accel_y", None),
        ("voltage0-voltage1", None),
        ("voltage0", None),
    ], "those of the buffer by their place, then the others by name; a scan that cannot be is none"
    assert found.character == tmp_path / "dev" / "iio:device0"
    described = found.describe().channels
    assert [(part.bits, part.signed) for part in described[:3]] == [(12, False), (24, True), (32, True)]


def test_an_iio_device_that_is_not_there_names_those_that_are(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    sysfs("iio:device1", in_temp_raw="0")
    sysfs("iio:device0", name="adc", in_temp_raw="0")
    with pytest.raises(NotFoundError) as refused:
        iio_device.find(f"dac?root={tmp_path}")
    assert refused.value.hint == "There are: iio:device0 (adc), iio:device1 (no name)."
    assert iio_device.find(f"iio:device1?root={tmp_path}").name == "iio:device1", "without a name that of its folder"
    with pytest.raises(NotFoundError, match="There is no IIO device in"):
        iio_device.find(f"{tmp_path}/none")


@pytest.mark.parametrize(
    ("files", "period", "stated"),
    [
        ({"sampling_frequency": "0"}, 0.1, False),
        ({"sampling_frequency": "10000"}, 1e-4, True),
        ({"sampling_frequency": "10001"}, 0.1, False),
        ({"in_voltage_sampling_frequency": "8"}, 0.125, True),
        ({"in_voltage_sampling_frequency": "8", "sampling_frequency": "4"}, 0.25, True),
    ],
)
def test_an_iio_device_is_sampled_at_the_frequency_that_it_states(
    sysfs: Callable[..., Path], tmp_path: Path, files: dict[str, str], period: float, stated: bool
) -> None:
    sysfs(name="adc", in_voltage_raw="0", **files)
    (channel,) = describe(f"iio:adc?root={tmp_path}").channels
    assert channel.period == period
    assert (channel.note == "") is stated


def test_another_device_of_that_name_is_not_read_for_the_node(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    sysfs(**PRESSURE)
    place, origin = SensorPlace(f"iio:bmp280?root={tmp_path}"), describe(f"iio:bmp280?root={tmp_path}").origin
    with pytest.raises(PolicyError, match="not the file that the node was made from") as no:
        WrappedRun(place, [replace(origin, name="bmp388")], lambda _: lambda *_: None, print)
    assert no.value.hint == "Give the file that it was made from, or create a new node: node create DIR --from …"


def test_iio_files_are_read_one_by_one_and_one_that_fails_says_why(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    folder = sysfs(**PRESSURE)
    run = WrappedRun(
        SensorPlace(f"iio:bmp280?root={tmp_path}"),
        [describe(f"iio:bmp280?root={tmp_path}").origin],
        lambda _: lambda *_: None,
        print,
    )
    reader = run._reader
    assert isinstance(reader, IioReader)
    by_name = {part.channel.name: part for part in reader.values}
    run.start()
    try:
        until(lambda: shown(by_name["voltage0"]) == pytest.approx((512 - 12) * 3.22265625))
        until(lambda: shown(by_name["temp"]) == pytest.approx(23.5))
        until(lambda: shown(by_name["pressure"]) == pytest.approx(101.325))
        (folder / "in_temp_input").write_text("warm\n")
        until(lambda: "in_temp_input cannot be read: it holds no number" in str(shown(by_name["temp"])))
        until(lambda: shown(by_name["pressure"]) == pytest.approx(101.325))
    finally:
        run.stop()


ACCELEROMETER = {
    "name": "adxl355",
    "in_accel_x_raw": "0",
    "in_accel_z_raw": "0",
    "in_accel_scale": "0.000038245",
    "sampling_frequency": "5",
    "scan_elements__in_accel_x_en": "0",
    "scan_elements__in_accel_x_index": "0",
    "scan_elements__in_accel_x_type": "be:s20/32>>12",
    "scan_elements__in_accel_z_en": "0",
    "scan_elements__in_accel_z_index": "2",
    "scan_elements__in_accel_z_type": "le:s16/16>>0",
    "buffer__enable": "0",
    "buffer__length": "2",
}


def test_iio_scans_come_from_the_buffer(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    folder = sysfs(**ACCELEROMETER)
    fifo = tmp_path / "dev" / "iio:device0"
    os.mkfifo(fifo)
    reader = IioReader(iio_device.find(f"adxl355?root={tmp_path}"), print)
    x, z = reader.values
    stop = threading.Event()

    def write() -> None:
        with fifo.open("wb", buffering=0) as out:
            while not stop.wait(0.05):
                out.write((-1000 << 12 & 0xFFFFFFFF).to_bytes(4, "big") + struct.pack("<h2x", 500))

    reader.start()
    try:
        assert (folder / "buffer" / "enable").read_text() == "1"
        assert (folder / "scan_elements" / "in_accel_z_en").read_text() == "1"
        writer = threading.Thread(target=write)
        writer.start()
        until(lambda: shown(x) == pytest.approx(-1000 * 0.000038245))
        until(lambda: shown(z) == pytest.approx(500 * 0.000038245))
        stop.set()
        writer.join()
        until(lambda: "the buffer has ended" in str(shown(x)))
    finally:
        stop.set()
        reader.stop()
    assert (folder / "buffer" / "enable").read_text() == "0"


def test_a_buffer_that_may_not_be_used_is_left_alone(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    folder = sysfs(**ACCELEROMETER)
    (tmp_path / "dev" / "iio:device0").mkdir()  # cannot be read by any user
    (folder / "buffer" / "length").unlink()
    (folder / "buffer" / "length").mkdir()
    messages: list[str] = []
    reader = IioReader(iio_device.find(f"adxl355?root={tmp_path}"), messages.append)
    (folder / "in_accel_x_raw").write_text("1000\n")
    reader.start()
    try:
        until(lambda: shown(reader.values[0]) == pytest.approx(1000 * 0.000038245))
    finally:
        reader.stop()
    assert "its files are read one by one" in messages[0]
    assert (folder / "scan_elements" / "in_accel_x_en").read_text() == "0"


@given(
    st.sampled_from(["be", "le"]),
    st.booleans(),
    st.sampled_from([8, 16, 32, 64]),
    st.data(),
)
def test_an_element_of_a_scan_gives_back_its_number(
    order: str, signed: bool, storage: int, data: st.DataObject
) -> None:
    bits = data.draw(st.integers(1, storage))
    shift = data.draw(st.integers(0, storage - bits))
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    number = data.draw(st.integers(low, high))
    noise = data.draw(st.integers(0, (1 << shift) - 1))
    octets = ((number & (1 << bits) - 1) << shift | noise).to_bytes(storage // 8, "big" if order == "be" else "little")
    assert raw_of(ScanElement(0, order, signed, bits, storage, shift), octets) == number


def test_a_scan_is_aligned_as_the_kernel_does_it() -> None:
    def element(storage: int) -> ScanElement:
        return ScanElement(0, "le", True, storage, storage, 0)

    assert layout([element(16), element(16), element(16), element(64)]) == ([0, 2, 4, 8], 16)
    assert layout([element(32), element(16)]) == ([0, 4], 8)
    assert layout([element(8)]) == ([0], 1)


def test_iio_devices_that_cannot_be_wrapped(sysfs: Callable[..., Path], tmp_path: Path) -> None:
    sysfs(**PRESSURE)
    with pytest.raises(NotFoundError, match="no IIO device 'adxl'"):
        describe(f"iio:adxl?root={tmp_path}")
    with pytest.raises(UsageError, match="unknown key"):
        describe(f"iio:bmp280?path={tmp_path}")
    sysfs("iio:device1", name="empty")
    with pytest.raises(BadDataError, match="no channels"):
        describe(f"iio:empty?root={tmp_path}")
    sysfs("iio:device2", name="broken", in_temp_raw="1", in_temp_scale="a lot")
    with pytest.raises(BadDataError, match="in_temp_scale holds 'a lot'"):
        describe(f"iio:broken?root={tmp_path}")
    for text in ("", " ", "nan", "1e999"):
        with pytest.raises(BadDataError, match="which is not a number"):
            iio_device._number(Path("in_temp_scale"), text)
    assert iio_device._number(Path("in_temp_scale"), "0.5 x") == 0.5
    (tmp_path / "huge").write_text("1" * 100_000)
    assert [iio_device._text(tmp_path / name) for name in ("huge", "none")] == ["", ""]
    origin = describe(f"iio:bmp280?root={tmp_path}").origin
    for place in (SensorPlace("iio:bmp280", "socketcan:can0"), SensorPlace("iio:bmp280", None, (1,))):
        with pytest.raises(UsageError):
            require_match(place, [origin], ["a"])
    with pytest.raises(UsageError, match="one node only"):
        require_match(SensorPlace("iio:bmp280"), [origin, origin], ["a", "b"])


def edited(folder: Path, *changes: tuple[str, str]) -> Path:
    """Return the example's EDS with the last occurrence of each text replaced."""
    text = EDS.read_text()
    for old, new in changes:
        before, found, after = text.rpartition(old)
        assert found, old
        text = f"{before}{new}{after}"
    path = folder / "cell.eds"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("code", "bits", "signed"),
    [
        ("0x0001", 1, False), ("0x0002", 8, True), ("0x0003", 16, True), ("0x0004", 32, True), ("0x0005", 8, False),
        ("0x0006", 16, False), ("0x0007", 32, False), ("0x0008", 32, None), ("0x0010", 24, True), ("0x0011", 64, None),
        ("0x0012", 40, True), ("0x0013", 48, True), ("0x0014", 56, True), ("0x0015", 64, True), ("0x0016", 24, False),
        ("0x0018", 40, False), ("0x0019", 48, False), ("0x001A", 56, False), ("0x001B", 64, False),
    ],
)  # fmt: skip
def test_a_canopen_object_has_the_bits_of_its_data_type(
    tmp_path: Path, code: str, bits: int, signed: bool | None
) -> None:
    path = edited(tmp_path, ("DataType=0x0008", f"DataType={code}"))
    found = canopen_device.read(path).channels[1]
    assert (found.bits, found.is_float) == (bits, signed is None)
    assert found.signed is bool(signed)


def test_two_canopen_objects_of_one_name_and_a_factor_below_0(tmp_path: Path) -> None:
    path = edited(tmp_path, ("ParameterName=temperature", "ParameterName=torque"), ("Factor=0.1", "Factor=-0.2"))
    first, second = canopen_device.read(path).channels
    assert (first.name, second.name) == ("Values.torque 6000.1", "Values.torque 6000.2")
    assert (first.scale, first.limits) == (-0.2, (-400.0, 400.0))
    path = edited(tmp_path, ("Factor=0.1", "Factor=-0.2"), ("HighLimit=2000", "HighLimit=500"))
    assert canopen_device.read(path).channels[0].limits == (-100.0, 400.0)


def test_an_event_timer_of_0_states_no_period(tmp_path: Path) -> None:
    torque = canopen_device.read(edited(tmp_path, ("DefaultValue=500", "DefaultValue=0"))).channels[0]
    assert (torque.period, "states no event timer for it, so 100 ms is assumed" in torque.note) == (0.1, True)


@pytest.mark.parametrize(
    ("access", "mapping", "measured"),
    [("ro", 1, True), ("rwr", 1, True), ("rw", 1, False), ("rww", 1, False), ("wo", 1, False), ("ro", 0, False)],
)
def test_an_object_in_no_pdo_is_measured_if_it_could_be_in_one_and_is_only_read(
    tmp_path: Path, access: str, mapping: int, measured: bool
) -> None:
    path = edited(tmp_path, ("AccessType=ro\nPDOMapping=1", f"AccessType={access}\nPDOMapping={mapping}"))
    names = [channel.name for channel in canopen_device.read(path).channels]
    assert names == (["torque", "temperature"] if measured else ["torque"])


def test_what_a_device_sends_by_default_is_measured_regardless_of_who_may_write_it(tmp_path: Path) -> None:
    path = tmp_path / "cell.eds"
    text = EDS.read_text()
    before, torque, after = text.partition("ParameterName=torque")
    path.write_text(before + torque + after.replace("AccessType=ro", "AccessType=rw", 1))
    assert [channel.name for channel in canopen_device.read(path).channels] == ["torque", "temperature"]
    path.write_text(path.read_text().replace("DefaultValue=0x60000110", "DefaultValue=0x60000210"))
    assert [channel.name for channel in canopen_device.read(path).channels] == ["temperature"]
