"""Wrapped CAN messages: what is measured is what cantools decodes, and what is not valid says why."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
import time
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace

import can
import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.links.can.sensor_bus import SensorFrame
from teds_provision.links.can.spec import parse_spec
from teds_provision.node import node_template
from teds_provision.node.hardware.board import Board
from teds_provision.node.sources.base import Reading
from teds_provision.node.wrapped import dbc_message, latest_values
from teds_provision.node.wrapped.can_reader import CanReader, MessageReader
from teds_provision.node.wrapped.dbc_message import DbcMessage, j1939_state, pgn_of
from teds_provision.node.wrapped.description import WrappedChannel, facts, written_unit
from teds_provision.node.wrapped.latest_values import LatestValues
from teds_provision.node.wrapped.reading import describe
from teds_provision.node.wrapped.running import SensorPlace, WrappedRun, require_match
from teds_provision.node.wrapped.wrapped_source import WrappedSource
from teds_provision.teds.calibration import evaluate, load_calibrations
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.certificate import CertificateChoice
from teds_provision.teds.guard import check_calibration
from teds_provision.teds.image import Image
from teds_provision.teds.origin import ORIGIN, origin_of
from teds_provision.teds.profile.load import parse_profile
from teds_provision.teds.sheet import Sheet
from tests.e2e.desk import ROOT
from tests.pace import until
from tests.places import free_bus

DBC = ROOT / "examples" / "bench" / "torque.dbc"
UUID = bytes(range(10))
MISSING = Reading(missing=True)
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'


def reader(message: str, messages: list[str] | None = None) -> MessageReader:
    return MessageReader(dbc_message.read(DBC, message), (messages if messages is not None else []).append)


def written(folder: Path, signals: str, more: str = "") -> DbcMessage:
    path = folder / "one.dbc"
    path.write_text(f"{HEAD}BO_ 100 One: 8 A\n{signals}\n{more}\n")
    return dbc_message.read(path)


def sheet_of(sensor: object) -> Sheet:
    return Sheet.from_image(Image(UUID, sensor.blocks(UUID)))  # type: ignore[attr-defined]


@st.composite
def signals(draw: st.DrawFn) -> str:
    """Return one signal somewhere in eight octets; little-endian, any width, factor and offset."""
    bits = draw(st.integers(1, 64))
    start = draw(st.integers(0, 64 - bits))
    scale = draw(st.sampled_from(["1", "0.01", "0.0625", "-0.5", "0.001", "3.7e-05", "250"]))
    offset = draw(st.sampled_from(["0", "-40", "273.15", "-1000", "1e6"]))
    sign = draw(st.sampled_from("+-"))
    limits = draw(st.sampled_from(["[0|0]", "[-100|100]", "[0|12.5]"]))
    unit = draw(st.sampled_from(["Nm", "degC", "rpm", "", "V", "km/h"]))
    return f' SG_ x : {start}|{bits}@1{sign} ({scale},{offset}) {limits} "{unit}" A'


@given(signals(), st.binary(min_size=8, max_size=8))
def test_a_station_reads_what_cantools_decodes_and_nothing_outside_the_range(
    tmp_path_factory: pytest.TempPathFactory, signal: str, data: bytes
) -> None:
    folder = tmp_path_factory.mktemp("dbc")
    message = written(folder, signal)
    sensor = message.sensor
    oracle = cantools.database.load_string(f"{HEAD}BO_ 100 One: 8 A\n{signal}\n", "dbc").messages[0]
    expected = float(oracle.decode(data)["x"])
    values = LatestValues(sensor.channels[0])
    values.put(1.0, message.numbers(data)["x"])
    reading, why = values.at(1.0)
    stated = oracle.signals[0]
    low, high = (-math.inf, math.inf) if stated.minimum is None else (float(stated.minimum), float(stated.maximum))
    assert reading is not None
    if why and low - 1e-6 <= expected <= high + 1e-6:
        assert math.isclose(expected, low, rel_tol=1e-6) or math.isclose(expected, high, rel_tol=1e-6)
        return
    assert ("is outside" in why) == (not low - 1e-6 <= expected <= high + 1e-6)
    sheet = sheet_of(sensor)
    board = Board(sheet, source=WrappedSource([values], lambda *_: None))
    try:
        octets = board.converters[1].octets(reading)
    except BadDataError:
        assert sensor.channels[0].bits == 64  # no bit to spare: the mark of the whole message says it
        return
    interpreter = ChannelInterpreter(sheet, 1)
    shown = interpreter.decode(octets)
    if why:
        assert not shown.valid[0]
        return
    assert shown.valid[0], interpreter.why_invalid(shown.raw)
    got = (interpreter.unit.to_si(float(shown.value[0])) - sensor.channels[0].written.offset) / (
        sensor.channels[0].written.scale
    )
    step = abs(float(stated.scale))
    assert abs(got - expected) < max(step / 2, abs(expected) * 1e-9)


@given(st.binary(max_size=400))
def test_a_file_ends_in_a_description_or_in_an_error_of_ours(
    tmp_path_factory: pytest.TempPathFactory, octets: bytes
) -> None:
    path = tmp_path_factory.mktemp("dbc") / "any.dbc"
    for content in (octets, DBC.read_bytes()[: 40 * len(octets) // 10] + octets):
        path.write_bytes(content)
        with suppress(BadDataError, UsageError):
            dbc_message.read(path).sensor.blocks(UUID)


def test_the_example_has_units_ranges_tables_and_a_calibration_that_the_guard_likes() -> None:
    sensor = describe(f"dbc:{DBC}", "Torque")
    blocks = sensor.blocks(UUID)
    sheet = Sheet.from_image(Image(UUID, blocks))
    assert not sheet.errors
    assert [(c.name, c.unit.text, c.period) for c in sheet.channels] == [
        ("torque", "N·m", pytest.approx(0.01)),
        ("speed", "rpm", pytest.approx(0.01)),
        ("temperature", "°C", pytest.approx(0.01)),
        ("state", "", pytest.approx(0.01)),
    ]
    assert [finding for finding in check_calibration(blocks) if finding.severity == "error"] == []
    assert b'<Value raw="2">overload</Value>' in blocks[4, 4]
    assert b"clockwise is positive" in blocks[1, 4]
    assert sheet.channels[3].value_table == {0: "starting", 1: "measuring", 2: "overload", 3: "fault"}
    assert sheet.channels[0].value_table == {}
    origin = origin_of(blocks)
    assert origin is not None
    assert (origin.kind, origin.name, origin.text) == ("dbc", "Torque", "CAN message Torque (dbc)")


def test_multiplexed_signals_come_in_turns_and_are_late_by_their_own_period() -> None:
    supply = reader("Supply")
    by_name = {part.channel.name: part for part in supply.values}
    assert {name: part.channel.period for name, part in by_name.items()} == pytest.approx(
        {"group": 0.05, "voltage": 0.1, "current": 0.1}
    )
    supply.handle(SensorFrame(292, False, bytes.fromhex("00c05d0000000000"), 10.0))
    supply.handle(SensorFrame(292, False, bytes.fromhex("01000020c1000000"), 10.05))
    assert by_name["voltage"].at(10.06)[0] is not None
    current, _ = by_name["current"].at(10.06)
    assert current is not None
    assert current.raw == -10.0  # Float32 in A: its own value
    assert by_name["voltage"].at(10.29)[0] is not None
    assert by_name["voltage"].at(10.31) == (MISSING, "no frame for 300 ms, 3 periods of 100 ms")


def test_a_j1939_message_is_matched_by_its_group_from_one_address() -> None:
    messages: list[str] = []
    shaft = reader("Shaft", messages)
    assert shaft.message.key == (pgn_of(0x18FEF121), True, True)
    assert pgn_of(0x18EA2133) == pgn_of(0x18EA0033) == 0xEA00
    shaft.handle(SensorFrame(0x18FEF121, True, bytes.fromhex("4038c8ffffffffff"), 5.0))
    speed, load = shaft.values
    assert speed.channel.value(0x3840) == 1800
    assert speed.at(5.0)[0] is not None
    shaft.handle(SensorFrame(0x18FEF122, True, bytes.fromhex("0000ffffffffffff"), 5.01))
    assert messages == ["Shaft also comes from the source address 0x22; only 0x21 is read."]
    assert load.last is not None
    assert load.last.raw == 0xC8
    shaft.handle(SensorFrame(0x18FEF121, True, bytes.fromhex("fffffeffffffffff"), 5.02))
    assert speed.at(5.02) == (MISSING, "the device reports it as not available")
    assert load.at(5.02) == (MISSING, "the device reports an error")
    shaft.handle(SensorFrame(0x18FEF122, True, bytes.fromhex("4038c8ffffffffff"), 9.0))  # the first one is silent
    assert speed.at(9.0)[0] is not None


def test_the_first_j1939_address_is_read_for_as_long_as_it_sends_and_others_are_reported_once() -> None:
    """It is silent after three periods of 20 ms, counted from its last frame."""
    messages: list[str] = []
    shaft = reader("Shaft", messages)
    speed = shaft.values[0]
    octets = bytes.fromhex("4038c8ffffffffff")
    for at in (5.0, 5.05, 5.1):
        shaft.handle(SensorFrame(0x18FEF121, True, octets, at))
    for address, at in ((0x22, 5.12), (0x23, 5.158)):
        shaft.handle(SensorFrame(0x18FEF100 | address, True, octets, at))
    assert speed.last is not None
    assert speed.last.at == 5.1
    assert len(messages) == 1
    shaft.handle(SensorFrame(0x18FEF122, True, octets, 5.162))
    shaft.handle(SensorFrame(0x18FEF121, True, octets, 5.17))
    assert speed.last.at == 5.162


@pytest.mark.parametrize(
    ("bits", "error", "absent", "highest"),
    [
        (8, 0xFE, 0xFF, 0xFD),
        (16, 0xFE00, 0xFFFF, 0xFDFF),
        (24, 0xFE1234, 0xFF0000, 0xFDFFFF),
        (32, 0xFEFFFFFF, 0xFF000000, 0xFDFFFFFF),
    ],
)
def test_the_highest_octet_of_a_j1939_parameter_tells_whether_it_has_a_value(
    bits: int, error: int, absent: int, highest: int
) -> None:
    assert j1939_state(bits, error) == "the device reports an error"
    assert j1939_state(bits, absent) == "the device reports it as not available"
    assert j1939_state(bits, highest) == ""
    assert j1939_state(bits - 1, (1 << bits - 1) - 1) == "", "other sizes have no such values"


@pytest.mark.parametrize(("cycle", "noted"), [(0, True), (50, False)])
def test_a_message_without_a_cycle_time_has_100_ms_and_a_note(tmp_path: Path, cycle: int, noted: bool) -> None:
    stated = f'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_ "GenMsgCycleTime" BO_ 100 {cycle};'
    found = [written(tmp_path, ' SG_ x : 0|8@1+ (1,0) [0|0] "V" A', stated).sensor]
    if noted:
        found.append(written(tmp_path, ' SG_ x : 0|8@1+ (1,0) [0|0] "V" A').sensor)
    note = "x: the file states no cycle time of One, so 100 ms is assumed (GenMsgCycleTime)."
    for sensor in found:
        assert sensor.channels[0].period == (0.1 if noted else 0.05)
        assert sensor.notes == ((note,) if noted else ())


@pytest.mark.parametrize(
    ("comment", "title"),
    [("", "One"), ("Torque cell", "Torque cell"), ("Cell\n of the left arm", "Cell"), ("x" * 61, "x" * 60)],
)
def test_people_call_a_message_by_the_first_line_of_its_comment(tmp_path: Path, comment: str, title: str) -> None:
    sensor = written(tmp_path, ' SG_ x : 0|8@1+ (1,0) [0|0] "V" A', f'CM_ BO_ 100 "{comment}";').sensor
    assert (sensor.title, sensor.origin.name) == (title, "One")


def test_a_file_of_windows_tools_has_its_units_too(tmp_path: Path) -> None:
    path = tmp_path / "one.dbc"
    text = f'{HEAD}BO_ 100 One: 8 A\n SG_ x : 0|8@1+ (1,0) [0|0] "°C" A\n'
    for encoding in ("cp1252", "utf-8"):
        path.write_bytes(text.encode(encoding))
        assert dbc_message.read(path).sensor.channels[0].unit == "degC", encoding


def test_reasons_and_their_order() -> None:
    torque = reader("Torque")
    values = torque.values[0]
    assert values.at(1.0) == (None, "no frame has come yet")
    torque.handle(SensorFrame(291, False, bytes.fromhex("e803000000000000"), 1.0))
    assert values.at(0.999) == (None, "no frame has come yet"), "a sample takes nothing younger than its tick"
    torque.handle(SensorFrame(291, False, bytes.fromhex("214e000000000000"), 1.01))
    reading, _ = values.at(1.005)
    assert reading is not None
    assert reading.raw == 1000 + 32768
    assert values.at(1.02) == (MISSING, "200.01 N·m is outside -200 to 200 N·m")
    assert values.at(1.05)[1].startswith("no frame for 30 ms")
    values.note_trouble("the bus is gone")
    assert values.at(1.05)[1].endswith(": the bus is gone")


@pytest.mark.parametrize(("passed", "late"), [(0.03, False), (0.039, False), (0.041, True)])
def test_a_value_is_late_once_a_frame_would_have_been_read(
    monkeypatch: pytest.MonkeyPatch, passed: float, late: bool
) -> None:
    """A frame may have come that the thread which reads had no time for yet."""
    values = reader("Torque").values[0]
    values.put(1.0, 1000.0)
    monkeypatch.setattr(latest_values, "time", SimpleNamespace(monotonic=lambda: 1.0 + passed))
    assert (values.at(1.031)[0] is None) is late


def test_a_frame_that_cannot_be_decoded_is_counted_and_changes_nothing() -> None:
    messages: list[str] = []
    supply = reader("Supply", messages)
    supply.handle(SensorFrame(292, False, bytes.fromhex("05"), 1.0))
    supply.handle(SensorFrame(292, False, bytes.fromhex("00c05d"), 1.0))
    assert (supply.frames, supply.bad, len(messages)) == (0, 2, 1)
    assert "Supply cannot be decoded" in messages[0]
    assert all(part.last is None for part in supply.values)
    for _ in range(1997):
        supply.handle(SensorFrame(292, False, bytes.fromhex("05"), 1.0))
    assert [message.partition(" (")[2] for message in messages[1:]] == ["1000 so far)"], "then each thousandth"


def test_a_frame_with_a_multiplexer_value_that_the_file_does_not_name_has_the_other_signals() -> None:
    """Files often name only some turns: the signals that every frame carries were invalid in all other turns."""
    messages: list[str] = []
    supply = reader("Supply", messages)
    by_name = {part.channel.name: part for part in supply.values}
    supply.handle(SensorFrame(292, False, bytes.fromhex("00c05d0000000000"), 1.0))
    supply.handle(SensorFrame(292, False, bytes.fromhex("0500000000000000"), 1.05))
    assert (supply.frames, supply.bad, messages) == (2, 0, [])
    group, voltage = by_name["group"].at(1.06)[0], by_name["voltage"].at(1.06)[0]
    assert group is not None
    assert voltage is not None
    assert (group.raw, voltage.raw, by_name["current"].last) == (5, 0x5DC0, None)


def test_a_channel_reports_when_it_becomes_invalid_and_valid_again() -> None:
    events: list[tuple[int, str, str]] = []
    values = reader("Torque").values
    source = WrappedSource(values, lambda *event: events.append(event))
    assert source.at(1, 1.0) is None
    assert source.at(1, 1.1) is None
    values[0].put(1.1, 5)
    assert source.at(1, 1.11) is not None
    assert source.at(1, 9.0) is None
    values[0].note_trouble("the bus is gone")
    assert source.at(1, 9.1) is None, "a new reason alone is no news"
    assert [(channel, name, bool(why)) for channel, name, why in events] == [
        (1, "torque", True),
        (1, "torque", False),
        (1, "torque", True),
    ]


def test_that_a_channel_is_valid_from_the_start_is_no_news() -> None:
    events: list[tuple[int, str, str]] = []
    values = reader("Torque").values
    source = WrappedSource(values, lambda *event: events.append(event))
    values[0].put(1.0, 5)
    assert source.at(1, 1.0) is not None
    assert events == []


def test_what_cannot_be_wrapped_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has 3 messages: Torque, Supply, Shaft"):
        describe(f"dbc:{DBC}")
    with pytest.raises(NotFoundError, match="no message 'Brake'"):
        describe(f"dbc:{DBC}", "Brake")
    with pytest.raises(NotFoundError):
        describe(f"dbc:{tmp_path}/none.dbc")
    for text in ("dbc:", "usb:x", "torque.dbc"):
        with pytest.raises(UsageError, match="names no sensor"):
            describe(text)
    with pytest.raises(UsageError, match="message of a DBC file"):
        describe("iio:device0", "Torque")


def test_units_of_files_and_what_is_doubtful() -> None:
    assert [written_unit(text)[0] for text in ("Nm", "N m", "m/s2", "Deg C", "%RH", "", "1/min")] == [
        "N·m",
        "N·m",
        "m/s²",
        "degC",
        "%",
        "count",
        "1/min",
    ]
    assert written_unit("nm") == ("nm", ""), "nanometres, no torque"
    assert "degC" in written_unit("C")[1]
    assert written_unit("G")[0] == "count"
    assert written_unit("smoots") == ("count", "the unit 'smoots' is unknown: values are plain numbers")


def test_a_raw_number_that_float32_cannot_calibrate_travels_as_its_value() -> None:
    wide = WrappedChannel("x", "V", 0.001, 0.0, bits=32)
    assert (wide.sample.model, wide.sample.raw) == ("float64", False)
    far = WrappedChannel("x", "V", 0.001, 1_000_000.3, bits=16)
    assert far.sample.model == "float64"
    near = WrappedChannel("x", "V", 0.001, 0.0, bits=16, signed=True)
    assert near.sample == (near.sample.__class__)("unsigned", 3, 16, True, 32768, (-32.768, 0.001))


def test_the_profile_of_a_sensor_has_numbers_as_people_write_them(tmp_path: Path) -> None:
    """A limit that its Float32 in kelvins would exclude is moved, and ended in fourteen digits."""
    signals = (
        ' SG_ t : 0|8@1+ (1,-40) [-40|125] "degC" A\n'
        ' SG_ p : 8|16@1- (0.1,0) [0|0] "count" A\n'
        ' SG_ q : 24|7@1+ (0.7,0) [0|0] "V" A\n'
        ' SG_ cold : 32|8@1+ (-0.1,-30) [-55.3|-30] "degC" A'
    )
    text = written(tmp_path, signals, 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;\nBA_ "GenMsgCycleTime" BO_ 100 7;')
    lines = text.sensor.profile_text("x").splitlines()
    found = [line for line in lines if line.startswith(("low-limit", "high-limit", "indication", "update-time"))]
    assert found == [
        "low-limit = -40.0",
        "high-limit = 125.00002",
        "update-time = 0.007",
        "indication = [1.0, -40.0]",
        "low-limit = -3276.8",
        "high-limit = 3276.7002",
        "update-time = 0.007",
        "indication = [0.1, -3276.8]",
        "low-limit = 0.0",
        "high-limit = 88.9",
        "update-time = 0.007",
        "indication = [0.7, 0.0]",
        "low-limit = -55.30001",
        "high-limit = -29.99999",
        "update-time = 0.007",
        "indication = [-0.1, -30.0]",
    ]
    counts = facts(text.sensor.channels[1])
    assert (counts["low"], counts["high"], counts["period"]) == (-3276.8, 3276.7, 0.007)


def test_three_signals_in_turns_have_three_times_the_period_of_the_message(tmp_path: Path) -> None:
    signals = ' SG_ g M : 0|4@1+ (1,0) [0|15] "" A\n' + "".join(
        f' SG_ v{turn} m{turn} : 8|16@1+ (1,0) [0|9] "V" A\n' for turn in range(3)
    )
    assert [part.period for part in written(tmp_path, signals).sensor.channels] == [0.1, 0.3, 0.3, 0.3]


@given(
    st.decimals("-1e6", "1e6", places=3, allow_nan=False),
    st.decimals("0.001", "1e6", places=3, allow_nan=False),
    st.sampled_from(["degC", "degF", "km/h", "rpm", "%", "N·m", "mV"]),
)
def test_a_station_takes_the_value_at_the_limit_that_a_file_states(low: Decimal, span: Decimal, unit: str) -> None:
    channel = WrappedChannel("x", unit, 0.1, is_float=True, bits=64, low=float(low), high=float(low + span))
    held = [struct.unpack(">f", struct.pack(">f", channel.written.to_si(end)))[0] for end in channel.held_limits]
    stated = [channel.written.to_si(end) for end in channel.limits]
    for inside, outside in zip(stated, held, strict=True):
        assert math.isclose(inside, outside, rel_tol=2e-7, abs_tol=1e-9)
    assert held[0] <= stated[0] < stated[1] <= held[1]
    for end in channel.held_limits:
        assert len(repr(end).strip("-0").partition("e")[0].replace(".", "").strip("0")) <= 11, end


def test_a_wrapped_node_is_run_from_its_own_file_only(tmp_path: Path) -> None:
    made = node_template.create(tmp_path / "n", sensor=describe(f"dbc:{DBC}", "Torque"))
    flash = made.load()
    assert flash.read_only == {ORIGIN}
    origin = origin_of(flash.blocks)
    assert origin is not None
    changed = tmp_path / "changed.dbc"
    changed.write_text(DBC.read_text().replace("0.01,0", "0.02,0"))
    bus = "udp_multicast:239.1.2.3"
    with pytest.raises(Exception, match="not the file that the node was made from"):
        WrappedRun(SensorPlace(f"dbc:{changed}", bus), [origin], lambda _: lambda *_: None, print)
    place = SensorPlace(f"dbc:{DBC}", bus)
    require_match(place, [origin], ["n"])
    for wrong, origins in (
        (SensorPlace(f"dbc:{DBC}"), [origin]),
        (SensorPlace("dbc:", bus), [origin]),
        (SensorPlace(f"canopen:{DBC}", bus, (5,)), [origin]),
        (SensorPlace(f"dbc:{DBC}", bus, (5,)), [origin]),
        (place, [None]),
    ):
        with pytest.raises(UsageError):
            require_match(wrong, origins, ["n"])


def test_j1939_groups_of_the_profile_need_a_bus_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "ours.dbc"
    path.write_text(DBC.read_text().replace("2566844926", str(0x80000000 + 0x1CFF00FE)))
    origin = describe(f"dbc:{path}", "Shaft").origin
    bus = "udp_multicast:239.1.2.3?port=4000"
    with pytest.raises(UsageError, match="identifiers of the nodes' own frames: Shaft"):
        WrappedRun(SensorPlace(f"dbc:{path}", bus, (), bus), [origin], lambda _: lambda *_: None, print)
    WrappedRun(SensorPlace(f"dbc:{path}", bus, (), f"{bus}1"), [origin], lambda _: lambda *_: None, print)


def test_describing_needs_the_extra_and_nothing_else_loads_it() -> None:
    code = (
        "import sys\n"
        "from teds_provision.node.wrapped import running, reading\n"
        "assert not {'cantools', 'canopen', 'can', 'numpy'} & set(sys.modules), sorted(sys.modules)\n"
        "sys.modules['cantools'] = None\n"
        "from teds_provision.errors import NotFoundError\n"
        "try:\n"
        f"    reading.describe('dbc:{DBC}', 'Torque')\n"
        "except NotFoundError as error:\n"
        "    print(error.message, error.hint)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "needs the package cantools" in done.stdout
    assert "[bench]" in done.stdout


def test_a_certificate_of_a_wrapped_sensor_corrects_what_its_frames_indicate() -> None:
    """The certificate relates torque on the bus to torque; the profile states which raw number the bus value is."""
    profile = parse_profile(dbc_message.read(DBC, "Torque").sensor.profile_text("torque"), "torque")
    path = DBC.with_suffix(".xml")
    made = load_calibrations(path, profile, CertificateChoice(channel=1))[1]
    for raw in (-20000, 0, 5000, 20000):  # of the frame; a sample adds half the range
        given = raw * 0.01
        value = float(evaluate(made, raw + 32768).value)
        assert value == pytest.approx(given * 200 / 200.7, abs=0.3), "the lever's torque, not the bus's"
    assert made.points[0] == pytest.approx((-20060 + 32768, -200))
    assert made.uncertainty == pytest.approx(0.2)
    assert made.certificate is not None
    assert made.certificate.number == "M-2026-0311"


@pytest.mark.link
def test_a_bus_that_is_lost_makes_values_invalid_and_is_opened_again() -> None:
    messages: list[str] = []
    torque, bus = reader("Torque"), free_bus()
    running = CanReader(parse_spec(bus), [torque], messages.append)
    running.start()
    group, port = bus.removeprefix("udp_multicast:").split("?port=")
    frame = can.Message(arbitration_id=291, is_extended_id=False, data=bytes(8))

    def arrives() -> bool:
        before = torque.frames
        sender.send(frame)
        time.sleep(0.02)
        return torque.frames > before

    try:
        with can.Bus(interface="udp_multicast", channel=group, port=int(port), hop_limit=0, fd=False) as sender:
            until(arrives)
            assert running._bus is not None
            running._bus._bus.shutdown()  # as an adapter that is pulled out
            until(lambda: bool(messages))
            assert "invalid until the bus is back" in messages[0]
            assert "cannot be read" in torque.values[0].at(time.monotonic() + 10)[1]
            until(arrives)
            assert "cannot be read" not in torque.values[0].at(time.monotonic() + 10)[1]
    finally:
        running.stop()


def test_filters_let_the_wanted_frames_through() -> None:
    """What SocketCAN is given: an identifier, or for J1939 the group alone, and of a group with a destination any."""
    assert dbc_message.FrameKey(291, False).filter == (291, 0x7FF, False)
    assert dbc_message.FrameKey(0x1ABCDEF0, True).filter == (0x1ABCDEF0, 0x1FFFFFFF, True)
    for identifier, other in ((0x18FEF121, 0x0CFEF1FE), (0x18EA2133, 0x1CEAFF01)):
        number, mask, extended = dbc_message.FrameKey(pgn_of(identifier), True, True).filter
        assert extended
        assert identifier & mask == number & mask == other & mask
        assert 0x18FEF221 & mask != number & mask


def test_another_message_that_overlaps_itself_does_not_hinder_and_its_own_does(tmp_path: Path) -> None:
    path = tmp_path / "two.dbc"
    signal = ' SG_ x : 0|16@1+ (1,0) [0|0] "" A\n'
    path.write_text(f"{HEAD}BO_ 100 Good: 8 A\n{signal}\nBO_ 101 Bad: 8 A\n{signal}{signal.replace(' x ', ' y ')}\n")
    assert [channel.name for channel in dbc_message.read(path, "Good").sensor.channels] == ["x"]
    with pytest.raises(BadDataError, match=r"message Bad cannot be decoded: The signals"):
        dbc_message.read(path, "Bad")


@pytest.mark.parametrize(
    ("identifier", "clashes"),
    [
        (0x18DA05F4, True),  # requests and replies of a node
        (0x1CDB00F4, True),  # a question to all nodes
        (0x0CEF05F4, True),  # set points
        (0x1CFF2021, True),  # an Announce
        (0x18FFFF21, True),
        (0x18FE6E21, False),
        (0x18EE0521, False),
        (0x18F00421, False),
    ],
)
def test_a_message_whose_group_is_one_of_the_nodes_own_is_named(tmp_path: Path, identifier: int, clashes: bool) -> None:
    path = tmp_path / "two.dbc"
    signal = ' SG_ x : 0|16@1+ (1,0) [0|0] "" A\n'
    path.write_text(f"{HEAD}BO_ 100 One: 8 A\n{signal}\nBO_ {identifier | 1 << 31} Other: 8 A\n{signal}\n")
    assert dbc_message.read(path, "One").clashing == (("Other",) if clashes else ())


@pytest.mark.parametrize("text", ["a", '\\"'])
def test_a_text_without_end_takes_no_memory(tmp_path: Path, text: str) -> None:
    """cantools takes 220 octets for each character of it: a gigabyte for a file of 5 MB."""
    path = tmp_path / "endless.dbc"
    path.write_text('VERSION "' + text * (dbc_message.LONGEST_TEXT + 1))
    with pytest.raises(BadDataError, match="quotation mark"):
        dbc_message.read(path, "M")
    path.write_bytes(b" " * (dbc_message.MOST_OCTETS + 1))
    with pytest.raises(BadDataError, match="too large"):
        dbc_message.read(path, "M")


@pytest.mark.parametrize(("high", "raw"), [("0", 400), ("120", 1600)])
def test_a_value_at_the_limit_is_valid_whatever_its_float32_is(tmp_path: Path, high: str, raw: int) -> None:
    """0 °C and 120 °C are no Float32 in kelvin; rounded inward, the limit excluded itself."""
    message = written(tmp_path, f' SG_ x : 0|12@1+ (0.1,-40) [-40|{high}] "degC" A')
    sheet = sheet_of(message.sensor)
    numbers = message.numbers(raw.to_bytes(2, "little") + bytes(6))
    values = LatestValues(message.sensor.channels[0])
    values.put(1.0, numbers["x"])
    reading, why = values.at(1.0)
    assert reading is not None
    assert not why
    interpreter = ChannelInterpreter(sheet, 1)
    shown = interpreter.decode(
        Board(sheet, source=WrappedSource([values], lambda *_: None)).converters[1].octets(reading)
    )
    assert shown.valid[0], interpreter.why_invalid(shown.raw)
