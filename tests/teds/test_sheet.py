"""The typed datasheet: what it says of shipped types, and that no octets break it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds import AccessCode, Sheet
from teds_provision.teds.calibration import Calibration, CalibrationInput, fit
from teds_provision.teds.calibration.samples import DataModel, SampleForm
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile import load_profile, shipped_profiles
from teds_provision.teds.sheet import ChannelKind, channel_of
from teds_provision.teds.units import parse_unit

UUID = bytes.fromhex("00112233445566778899")
WHEN = datetime(2026, 3, 1, tzinfo=UTC)


def image_of(name: str, calibration: dict[int, Calibration] | None = None) -> Image:
    built = load_profile(name).build(UUID, calibration=calibration or {}, now=WHEN)
    return Image(UUID, built.blocks)


def line(channel: int = 1, unit: str = "degree", **more: object) -> Calibration:
    part = CalibrationInput(channel, 1, (0.0, 65535.0), (0.0,))
    return Calibration(channel, "linear", (part,), (0.0, 360 / 65536), unit=parse_unit(unit), **more)  # type: ignore[arg-type]


def test_the_magnetic_sensor_reads_as_its_paper_says() -> None:
    sheet = Sheet.from_image(image_of("magnetic-angular-position-sensor"))
    assert sheet.uuid == UUID == sheet.meta.uuid
    assert not sheet.errors
    (channel,) = sheet.channels[:1]
    assert channel.kind is ChannelKind.SENSOR
    assert not channel.actuator
    assert channel.units.radians == Fraction(1)
    assert channel.si_unit == "rad"
    assert channel.low == 0
    assert channel.high == pytest.approx(2 * math.pi)
    assert channel.show(channel.high) == "360 °"
    assert channel.sample is not None
    assert channel.sample.integer
    assert channel.sample.raw_range == (0.0, float(2**channel.sample.bits - 1))
    assert channel.period > 0
    assert channel.calibration is None
    assert channel.calibration_problem == ""


def test_every_shipped_profile_gives_a_sheet_that_says_what_the_profile_says() -> None:
    wrong = []
    for file in sorted(shipped_profiles().glob("*.toml")):
        profile = load_profile(file)
        if profile.abstract:
            continue
        sheet = Sheet.from_image(Image(UUID, profile.build(UUID, now=WHEN).blocks))
        expected = [(c.number, c.name, c.type, c.units, c.raw_range) for c in profile.channels]
        read = [(c.number, c.name, c.kind, c.units, c.sample.raw_range if c.sample else None) for c in sheet.channels]
        if [row[:4] for row in expected] != [row[:4] for row in read] or sheet.errors:
            wrong.append((profile.name, expected, read, sheet.errors))
        if sheet.meta.name != profile.tim_name or sheet.meta.channels != len(profile.channels):
            wrong.append((profile.name, sheet.meta))
    assert not wrong


def test_a_calibration_gives_unit_uncertainty_and_due_date() -> None:
    calibration = line(date=WHEN, interval=365 * 86_400.0, uncertainty=0.5)
    (channel, *_) = Sheet.from_image(image_of("magnetic-angular-position-sensor", {1: calibration})).channels
    assert channel.unit.text == "°"
    assert channel.calibrated_at == WHEN
    assert channel.due == datetime(2027, 3, 1, tzinfo=UTC)
    assert channel.overdue(datetime(2027, 3, 2, tzinfo=UTC))
    assert not channel.overdue(WHEN)
    assert channel.stated_uncertainty == pytest.approx(math.radians(0.5))
    assert channel.uncertainty != channel.stated_uncertainty


def test_a_display_unit_of_another_kind_leaves_the_unit_of_the_datasheet() -> None:
    """A profile of that name may have changed: its unit says nothing of this board, whose calibration does."""
    sheet = Sheet.from_image(image_of("magnetic-angular-position-sensor", {1: line(unit="mrad")}))
    (channel,) = sheet.channels[:1]
    assert channel.shown.text == "mrad"
    assert replace(channel, display="turn").shown.text == "turn"
    for display in ("N", "K", "no such unit"):
        assert replace(channel, display=display).shown == channel.unit, display


def test_a_calibration_that_cannot_be_computed_is_reported_and_left_out() -> None:
    broken = {
        "not finite": line(zero_offset=math.inf),
        "ascend": Calibration(
            1, "linear", (CalibrationInput(1, 1, (0.0, 5.0, 5.0), (0.0, 0.0)),), (0.0, 1.0, 0.0, 1.0)
        ),
        "slope is 0": line(unit="degree").__class__(
            1, "linear", line().inputs, (0.0, 1.0), unit=parse_unit("degree").__class__("x", teds.Units(), 0.0)
        ),
    }
    for words, calibration in broken.items():
        blocks = dict(image_of("magnetic-angular-position-sensor").blocks)
        blocks[1, AccessCode.CALIBRATION] = teds.compose(AccessCode.CALIBRATION, calibration.fields())
        sheet = Sheet.from_blocks(blocks)
        assert sheet.channels[0].calibration is None
        assert words in sheet.channels[0].calibration_problem
        assert "calibration" in {finding.code for finding in sheet.findings}


def test_contradictions_between_teds_are_found() -> None:
    blocks = dict(image_of("tactile-finger-sensor").blocks)
    blocks[2, AccessCode.NAME] = blocks[1, AccessCode.NAME]
    blocks[40, AccessCode.CALIBRATION] = teds.compose(AccessCode.CALIBRATION, line(40).fields())
    blocks[1, AccessCode.CHANNEL], blocks[0, AccessCode.PHY] = blocks[0, AccessCode.META], blocks[1, AccessCode.CHANNEL]
    sheet = Sheet.from_image(Image(bytes(10), blocks))
    found = {(finding.channel, finding.code) for finding in sheet.findings}
    assert {(0, "uuid"), (2, "same-name"), (40, "undescribed"), (1, "class"), (0, "class")} <= found
    assert sheet.channel(40) is None
    assert 40 in sheet.calibrations
    del blocks[3, AccessCode.CHANNEL]
    assert (0, "channels") in {(finding.channel, finding.code) for finding in Sheet.from_blocks(blocks).findings}


def test_the_vectors_of_a_node_are_its_vector_groups_alone() -> None:
    groups = [
        ("CGroup", {"GrpType": 1, "MemList": [1, 2]}),
        *(("VGroup", {"GrpType": 1, "MemList": m}) for m in ([3, 1], [2])),
    ]
    meta = teds.compose(1, [("UUID", UUID), *groups])
    assert Sheet.from_blocks({(0, AccessCode.META): meta}).meta.vectors == ((3, 1), (2,))


def test_the_channels_that_are_counted_are_those_that_are_described() -> None:
    image = image_of("magnetic-angular-position-sensor")
    for stated, message in (
        (1, None),
        (0, "The Meta-TEDS counts 0 channels; 1 are described."),
        (2, "The Meta-TEDS counts 2 channels; 1 are described."),
    ):
        meta = teds.compose(1, {"UUID": UUID, "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": stated})
        findings = Sheet.from_image(Image(UUID, {**image.blocks, (0, AccessCode.META): meta})).findings
        assert [finding.message for finding in findings] == [message] * (message is not None)
        assert {(f.channel, f.access_code, f.severity, f.code) for f in findings} <= {(0, 1, "warning", "channels")}


def test_a_name_finds_its_channel_only_if_it_is_alone() -> None:
    blocks = dict(image_of("tactile-finger-sensor").blocks)
    first = Sheet.from_blocks(blocks).channels[0]
    assert Sheet.from_blocks(blocks).named(first.name) == first
    blocks[2, AccessCode.NAME] = blocks[1, AccessCode.NAME]
    assert Sheet.from_blocks(blocks).named(first.name) is None


def test_a_person_chooses_a_channel_by_a_name_whose_case_counts_only_between_two() -> None:
    sheet = Sheet.from_blocks(image_of("tactile-finger-sensor").blocks)
    first, second, *_ = sheet.channels
    one = replace(sheet, channels=(replace(first, name="Force"), replace(second, name="Angle")))
    assert one.chosen("force", "x") == one.channels[0]
    two = replace(sheet, channels=(replace(first, name="Force"), replace(second, name="force")))
    assert [two.chosen(name, "x") for name in ("Force", "force")] == list(two.channels)
    for name in ("FORCE", "forces"):
        with pytest.raises(BadDataError, match="has no channel"):
            two.chosen(name, "x")


def test_a_uuid_of_16_octets_is_that_of_the_node_if_it_ends_in_the_nodes_10() -> None:
    image = image_of("tactile-finger-sensor")
    for before, after, codes in ((b"\1" * 6, b"", set()), (b"", b"\1" * 6, {"uuid"})):
        meta = teds.compose(AccessCode.META, [("UUID", before + image.uuid + after)], edition=2024)
        sheet = Sheet.from_image(Image(image.uuid, {**image.blocks, (0, AccessCode.META): meta}))
        assert {finding.code for finding in sheet.findings} & {"uuid"} == codes


def test_an_actuator_says_how_it_halts() -> None:
    sheet = Sheet.from_image(image_of("gripper"))
    (actuator, *_) = [channel for channel in sheet.channels if channel.actuator]
    assert actuator.kind is ChannelKind.ACTUATOR
    assert actuator.kind.word == "actuator"
    assert actuator.halt in (1, 2, 3)


def test_an_empty_node_has_an_empty_sheet() -> None:
    sheet = Sheet.from_image(Image(UUID, {}))
    assert (sheet.channels, sheet.findings, sheet.meta.name) == ((), (), "")
    nothing = channel_of(1, {})
    assert not nothing.described
    assert not nothing.has_range
    assert nothing.kind is None
    assert nothing.si_unit == "count"


@pytest.mark.parametrize(
    ("form", "problem"),
    [
        (SampleForm(DataModel.UNSIGNED, 2, 12), ""),
        (SampleForm(DataModel.FLOAT32, 4), ""),
        (SampleForm(DataModel.FLOAT32, 5), "4 are possible"),
        (SampleForm(DataModel.UNSIGNED, 9), "1 to 8"),
        (SampleForm(99, 1), "reserved"),
    ],
)
def test_a_sample_form_says_whether_it_can_be_read(form: SampleForm, problem: str) -> None:
    assert problem in form.problem
    assert bool(form.problem) == bool(problem)


SEEDS = [
    *image_of("tactile-finger-sensor", {1: fit([(0, 0), (60000, 10)], "linear", channel=1)}).blocks.items(),
    *image_of("gripper").blocks.items(),
]


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_no_octets_make_a_sheet_raise(data: st.DataObject) -> None:
    blocks: dict[BlockId, bytes] = {}
    for key, octets in data.draw(st.lists(st.sampled_from(SEEDS), max_size=6, unique_by=lambda pair: pair[0])):
        block = bytearray(unframe(octets))
        for _ in range(data.draw(st.integers(0, 3))):
            at = data.draw(st.integers(0, len(block) - 1))
            block[at] = data.draw(st.sampled_from([0, 1, 2, 3, 4, 127, 128, 255]))
        blocks[key] = data.draw(st.sampled_from([frame(bytes(block)), bytes(block), octets]))
    junk = data.draw(st.lists(st.tuples(st.integers(0, 65535), st.sampled_from([1, 3, 5, 12, 16, 128])), max_size=2))
    for key in junk:
        blocks[key] = data.draw(st.binary(max_size=60))
    sheet = Sheet.from_image(Image(data.draw(st.binary(max_size=16)), blocks))
    for channel in sheet.channels:
        assert channel.unit.text is not None
        assert channel.si_unit
        assert isinstance(channel.show(channel.low), str)
        assert isinstance(channel.show(channel.stated_uncertainty, difference=True), str)
        assert channel.overdue(WHEN) in (True, False)
        assert channel.sample is None or isinstance(channel.sample.name + channel.sample.problem, str)
    json.dumps([finding.message for finding in sheet.findings])


def test_a_finding_of_the_decoder_keeps_its_place_and_its_words() -> None:
    image = image_of("tactile-finger-sensor")
    damaged = image.blocks[2, 12][:-1] + bytes([image.blocks[2, 12][-1] ^ 1])
    sheet = Sheet.from_image(Image(image.uuid, {**image.blocks, (2, 12): damaged}))
    (finding,) = sheet.findings
    assert (finding.channel, finding.access_code, finding.severity, finding.code) == (2, 12, "error", "frame-checksum")
    assert finding.offset == len(damaged) - 2
    assert finding.message.startswith("The checksum is ")


@pytest.mark.parametrize(
    ("form", "problem"),
    [
        (SampleForm(99, 1), "its data model 99 is reserved"),
        (SampleForm(DataModel.FLOAT32, 5), "its samples are Float32 of 5 octets; 4 are possible"),
        (SampleForm(DataModel.UNSIGNED, 0), "its samples are unsigned integer of 0 octets; 1 to 8 are possible"),
        (SampleForm(DataModel.UNSIGNED, 9), "its samples are unsigned integer of 9 octets; 1 to 8 are possible"),
        (SampleForm(DataModel.UNSIGNED, 1), ""),
        (SampleForm(DataModel.UNSIGNED, 8), ""),
    ],
)
def test_why_a_sample_cannot_be_read_in_whole_words(form: SampleForm, problem: str) -> None:
    assert form.problem == problem
