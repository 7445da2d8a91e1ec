"""The guard refuses what has hurt robots before, and lets through what is right."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.teds.calibration import Calibration, CalibrationInput, fit, read_calibrations
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.curve import Curve, CurveChannel, channel_of, curve_of
from teds_provision.teds.guard import GuardFinding, check_calibration
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile import Profile, load_profile, shipped_profiles
from teds_provision.teds.units import parse_unit
from tests.pace import costs_at_most

UUID = bytes(10)
Blocks = dict[BlockId, bytes]


@pytest.fixture(scope="module")
def magnetic() -> Profile:
    return load_profile("magnetic-angular-position-sensor", [shipped_profiles()])


@pytest.fixture(scope="module")
def tactile() -> Profile:
    return load_profile("tactile-finger-sensor", [shipped_profiles()])


def angle_table(points: int = 1025, *, gain: float = 1.0) -> Calibration:
    raw = np.linspace(0, 65535, points)
    value = gain * 360 * raw / 65535 + 0.4 * np.sin(raw / 65535 * 2 * np.pi)
    table = fit(list(zip(raw.tolist(), value.tolist(), strict=True)), "table", channel=1)
    return replace(table, unit=parse_unit("degree"))


def force_line(intercept: float = 0.0, slope: float = 10 / 65535, **more: object) -> Calibration:
    part = CalibrationInput(1, 1, (0, 65535), (0,))
    return Calibration(1, "linear", (part,), (intercept, slope), unit=parse_unit("N"), **more)  # type: ignore[arg-type]


def built(profile: Profile, calibration: Calibration, channel: int = 1) -> Blocks:
    return profile.build(UUID, calibration={channel: calibration}).blocks


def codes(findings: list[GuardFinding], severity: str = "error") -> set[str]:
    return {finding.code for finding in findings if finding.severity == severity}


def text(findings: list[GuardFinding], code: str) -> str:
    return next(finding.message for finding in findings if finding.code == code)


def test_a_right_calibration_has_no_finding(magnetic: Profile, tactile: Profile) -> None:
    blocks = built(magnetic, angle_table())
    assert check_calibration(blocks, blocks, magnetic) == []
    assert check_calibration(blocks) == []
    line = built(tactile, force_line())
    assert check_calibration(line, line, tactile) == []


def test_every_shipped_profile_takes_a_straight_line_over_its_range() -> None:
    for name in ("load-cell", "temperature-sensor", "accelerometer", "gripper", "tactile-finger-sensor"):
        profile = load_profile(name, [shipped_profiles()])
        calibrations = {}
        for channel in profile.channels:
            low, high = channel.unit.from_si(channel.low_limit), channel.unit.from_si(channel.high_limit)
            assert channel.raw_range is not None
            pairs = f"{channel.raw_range[0]},{low}\n{channel.raw_range[1]},{high}\n"
            calibrations |= read_calibrations(
                f"# channel: {channel.number}\n# method: linear\n{pairs}", "x.csv", profile
            )
        blocks = profile.build(UUID, calibration=calibrations).blocks
        assert check_calibration(blocks, blocks, profile, calibrations=calibrations) == [], name
        assert check_calibration(blocks) == [], name


# --- erased words


@pytest.mark.parametrize("word", [b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\x7f\x80\x00\x00", b"\x00\x00\xff\xff"])
def test_an_erased_word_among_the_coefficients_is_refused(word: bytes, magnetic: Profile) -> None:
    blocks = built(magnetic, angle_table())
    block = bytearray(unframe(blocks[1, 5]))
    at = block.index(struct.pack(">f", angle_table().coefficients[200]))
    block[at : at + 4] = word
    findings = check_calibration({**blocks, (1, 5): frame(bytes(block))}, blocks, magnetic)
    assert codes(findings) == {"erased"}
    assert "coefficient 201 of 2048 (segment 101)" in text(findings, "erased")


@pytest.mark.parametrize("octets", [b"\xff" * 300, bytes(300), b""])
def test_erased_flash_instead_of_a_teds_is_refused(octets: bytes, magnetic: Profile) -> None:
    blocks = built(magnetic, angle_table())
    assert codes(check_calibration({**blocks, (1, 5): octets}, None, magnetic)) == {"erased"}


def test_all_zero_coefficients_are_refused(tactile: Profile) -> None:
    findings = check_calibration(built(tactile, force_line(0.0, 0.0)), None, tactile)
    assert "erased" in codes(findings)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"zero_offset": math.nan}, "zero offset 1 of 1"),
        ({"inputs": (CalibrationInput(1, 1, (0, math.inf), (0,)),)}, "boundary 2 of 2"),
        ({"inputs": (CalibrationInput(1, 1, (0, 65535), (math.nan,)),)}, "offset 1 of 1"),
        ({"low_limit": -math.inf}, "limit 1 of 1"),
        ({"low_limit": 0.0, "high_limit": math.inf}, "limit 2 of 2"),
        ({"uncertainty": math.inf}, "limit 1 of 1"),
    ],
)
def test_an_erased_limit_or_offset_is_refused(changes: dict[str, Any], word: str, tactile: Profile) -> None:
    findings = check_calibration(built(tactile, replace(force_line(), **changes)), None, tactile)
    assert codes(findings) == {"erased"}
    assert text(findings, "erased").startswith(word)


def test_a_damaged_teds_is_refused(magnetic: Profile) -> None:
    blocks = built(magnetic, angle_table(5))
    octets = bytearray(blocks[1, 5])
    octets[20] ^= 1
    assert codes(check_calibration({**blocks, (1, 5): bytes(octets)}, None, magnetic)) == {"unreadable"}
    content = bytearray(teds.compose(5, [*angle_table(5).fields(), ("200", b"")]))
    content[-4:-2] = b"\x03\x00"  # a second type 3: its content is wrong too, and still it would be understood
    decoded = teds.decode(bytes(content))
    assert decoded.verdict == "frame-and-content-bad"
    assert codes(check_calibration({**blocks, (1, 5): bytes(content)}, None, magnetic)) == {"unreadable"}


def test_coefficients_that_do_not_fit_their_segments_are_refused(tactile: Profile) -> None:
    blocks = built(tactile, force_line())
    fields = [pair for pair in force_line().fields() if pair[0] != "Coefs"]
    for coefficients in ((1.0,), ()):
        octets = teds.compose(5, [*fields, ("Coefs", coefficients)])
        assert codes(check_calibration({**blocks, (1, 5): octets}, None, tactile)) == {"inconsistent"}


def test_boundaries_that_do_not_ascend_are_refused(tactile: Profile) -> None:
    part = CalibrationInput(1, 1, (0, 40000, 30000), (0, 40000))
    line = Calibration(1, "table", (part,), (0.0, 1e-4, 4.0, 1e-4), unit=parse_unit("N"))
    assert codes(check_calibration(built(tactile, line), None, tactile)) == {"inconsistent"}
    second = CalibrationInput(2, 1, (40000, 30000), (0,))
    both = Calibration(
        1, "polynomial", (CalibrationInput(1, 1, (0, 65535), (0,)), second), (0.0, 0.0, 1e-4, 0.0), unit=parse_unit("N")
    )
    findings = check_calibration(built(tactile, both), None, tactile)
    assert [finding.message for finding in findings] == ["the segment boundaries of input 2 do not ascend"]


def test_a_calibration_of_another_kind_is_not_judged_but_reported(tactile: Profile) -> None:
    blocks = built(tactile, force_line())
    findings = check_calibration({**blocks, (1, 5): teds.compose(5, [("LinOnly", (0.0, 1.0))])}, None, tactile)
    assert (codes(findings), codes(findings, "warning")) == (set(), {"unknown"})


# --- sign, slope, gain and offset


def test_a_reversed_slope_is_refused_against_what_the_node_has(tactile: Profile) -> None:
    reversed_line = force_line(10.0, -10 / 65535)
    findings = check_calibration(built(tactile, reversed_line), built(tactile, force_line()))
    assert codes(findings) == {"reversed"}
    assert "falls by 10 N from raw 0 to raw 65535; with what the node has now it rose by 10 N" in text(
        findings, "reversed"
    )


def test_a_slope_that_the_uncertainty_hides_is_not_reversed(tactile: Profile) -> None:
    steep, faint = built(tactile, force_line()), built(tactile, force_line(5, -0.004 / 65535))
    for new, old in ((faint, steep), (steep, faint)):
        assert "reversed" not in codes(check_calibration(new, old))


def test_a_reversed_slope_is_refused_against_the_profile_alone(tactile: Profile) -> None:
    findings = check_calibration(built(tactile, force_line(10.0, -10 / 65535)), None, tactile)
    assert codes(findings) == {"reversed"}


def test_a_curve_whose_ends_differ_by_rounding_alone_is_not_reversed(tactile: Profile) -> None:
    table = replace(fit([(0, 0.0), (30000, 5.0), (65535, -1e-7)], "table", channel=1), unit=parse_unit("N"))
    assert codes(check_calibration(built(tactile, table), None, tactile)) == {"not-monotone"}


def test_a_reversed_slope_is_refused_by_what_the_teds_itself_carries(tactile: Profile) -> None:
    text_ = "# channel: 1\n# method: linear\n0,10\n65535,0\n"
    calibration = read_calibrations(text_, "x.csv", tactile)[1]
    assert codes(check_calibration(built(tactile, calibration))) == {"reversed"}


def test_what_the_teds_carries_counts_beside_a_profile_that_does_not_name_the_channel(tactile: Profile) -> None:
    turned = built(tactile, force_line(10, -10 / 65535, monotone="increasing"))
    assert "reversed" in codes(check_calibration(turned, profile=replace(tactile, channels=())))


def test_a_reversed_sign_is_refused(tactile: Profile) -> None:
    findings = check_calibration(built(tactile, force_line(-0.05, -10 / 65535)), built(tactile, force_line(0.05)))
    assert {"reversed", "limits"} <= codes(findings)


def test_gain_and_offset_exchanged_are_refused() -> None:
    profile = load_profile("load-cell", [shipped_profiles()])
    part = CalibrationInput(1, 1, (4_194_304, 12_582_912), (8_388_608,))
    right = Calibration(1, "linear", (part,), (0.3, 500 / 4_194_304), unit=parse_unit("N"))
    wrong = replace(right, coefficients=right.coefficients[::-1])
    findings = check_calibration(built(profile, wrong), built(profile, right), profile)
    assert "swapped" in codes(findings)
    again = check_calibration(built(profile, right), built(profile, right), profile)
    assert codes(again) == set()


def test_gain_and_offset_exchanged_in_a_whole_table_are_refused(magnetic: Profile) -> None:
    right = angle_table(17)
    flipped = [right.coefficients[n ^ 1] for n in range(len(right.coefficients))]
    findings = check_calibration(built(magnetic, replace(right, coefficients=tuple(flipped))), built(magnetic, right))
    assert "swapped" in codes(findings)


def test_a_gain_of_zero_is_refused(tactile: Profile) -> None:
    assert codes(check_calibration(built(tactile, force_line(5.0, 0.0)), None, tactile)) == {"flat"}


# --- monotone


def bent_table() -> Calibration:
    table = angle_table(1025)
    points = [(raw, value - (3.0 if 30000 < raw < 30100 else 0.0)) for raw, value in table.points]
    return replace(fit(points, "table", channel=1), unit=parse_unit("degree"))


def test_a_table_that_must_be_monotone_and_is_not_is_refused(magnetic: Profile) -> None:
    findings = check_calibration(built(magnetic, bent_table()), None, magnetic)
    assert codes(findings) == {"not-monotone"}
    assert "its type says that it must be increasing" in text(findings, "not-monotone")
    assert "°" in text(findings, "not-monotone")


def test_from_the_teds_alone_what_the_node_has_now_says_what_is_expected(magnetic: Profile) -> None:
    findings = check_calibration(built(magnetic, bent_table()), built(magnetic, angle_table()))
    assert codes(findings) == {"not-monotone"}
    alone = check_calibration(built(magnetic, bent_table()))
    assert (codes(alone), codes(alone, "warning")) == (set(), {"not-monotone"})
    carried = check_calibration(built(magnetic, replace(bent_table(), monotone="increasing")))
    assert codes(carried) == {"not-monotone"}


def test_a_polynomial_that_turns_back_outside_its_points_is_refused(tactile: Profile) -> None:
    points = [(raw, 10 * (raw / 40000) ** 0.5) for raw in range(0, 40001, 2000)]
    cubic = replace(fit(points, "polynomial", channel=1, degree=2), unit=parse_unit("N"))
    findings = check_calibration(built(tactile, cubic), None, tactile)
    assert codes(findings) & {"not-monotone", "reversed"}


# --- limits and residuals


def test_results_beyond_the_limits_are_refused_over_the_whole_raw_range(tactile: Profile) -> None:
    findings = check_calibration(built(tactile, force_line(0.0, 12 / 65535)), None, tactile)
    assert codes(findings) == {"limits"}
    assert text(findings, "limits") == (
        "raw 65535 gives 12 N, 2 N above the high limit of 10 N; the stated uncertainty is 0.2 N"
    )
    inside = check_calibration(built(tactile, force_line(0.0, 10.19 / 65535)), None, tactile)
    assert codes(inside) == set()


def test_extrapolation_counts_and_the_way_out_is_named(tactile: Profile, tmp_path: Path) -> None:
    narrow = replace(fit([(20000, 0.0), (50000, 10.0)], "linear", channel=1), unit=parse_unit("N"))
    findings = check_calibration(built(tactile, narrow), None, tactile)
    assert codes(findings) == {"limits"}
    assert "covers raw 20000 to 50000" in text(findings, "limits")
    assert "raw-range" in text(findings, "limits")
    path = tmp_path / "finger.toml"
    path.write_text('extends = "tactile-finger-sensor"\n[channel.1-12.calibration]\nraw-range = [20000, 50000]\n')
    finger = load_profile(path, [shipped_profiles()])
    blocks = built(finger, replace(narrow, raw_range=(20000, 50000)))
    assert check_calibration(blocks, None, finger) == []
    assert check_calibration(blocks) == []


def test_the_significant_bits_set_the_raw_range() -> None:
    profile = load_profile("gripper", [shipped_profiles()])
    line = replace(fit([(0, 0.0), (4095, 110.0)], "linear", channel=2), unit=parse_unit("mm"))
    assert check_calibration(built(profile, line, 2), None, profile) == []


@pytest.mark.parametrize("raw_range", [(-65535, 131070), (131070, 140000)], ids=["wider", "beside"])
def test_a_raw_range_of_the_teds_is_no_wider_than_its_data_model(
    raw_range: tuple[float, float], tactile: Profile
) -> None:
    """What the converter cannot give is not held against the limits: the curve would be beyond them there."""
    blocks = built(tactile, force_line(raw_range=raw_range))
    assert check_calibration(blocks) == []
    too_steep = built(tactile, force_line(0.0, 12 / 65535, raw_range=raw_range))
    assert text(check_calibration(too_steep), "limits").startswith("raw 65535 gives 12 N")


def test_an_adjusted_zero_of_a_full_turn_is_not_beyond_its_limits(magnetic: Profile) -> None:
    blocks = built(magnetic, replace(angle_table(), zero_offset=45.0))
    assert check_calibration(blocks, None, magnetic) == []
    doubled = built(magnetic, replace(angle_table(gain=2.0), zero_offset=45.0))
    assert codes(check_calibration(doubled, None, magnetic)) == {"limits"}


def test_a_turn_of_the_scale_is_stated_by_the_shorter_way(magnetic: Profile) -> None:
    before = built(magnetic, angle_table())
    near = built(magnetic, replace(angle_table(), zero_offset=355.0))
    assert check_calibration(near, before, magnetic) == [], "5 degrees back"
    far = check_calibration(built(magnetic, replace(angle_table(), zero_offset=200.0)), before, magnetic)
    assert codes(far, "warning") == {"changed"}
    assert "by up to 160 °" in text(far, "changed")


def test_an_actuator_must_stay_within_its_raw_range() -> None:
    profile = load_profile("gripper", [shipped_profiles()])
    good = replace(fit([(0, 0.0), (4095, 110.0)], "linear", channel=1, actuator=True), unit=parse_unit("mm"))
    assert check_calibration(built(profile, good), None, profile) == []
    bad = replace(fit([(0, 0.0), (8190, 110.0)], "linear", channel=1, actuator=True), unit=parse_unit("mm"))
    findings = check_calibration(built(profile, bad), None, profile)
    assert codes(findings) == {"limits"}
    assert "110 mm gives raw 8190" in text(findings, "limits")


def test_a_fit_whose_residual_exceeds_the_uncertainty_is_refused(tactile: Profile) -> None:
    points = "0,0\n32768,5.45\n65535,10\n"
    calibrations = read_calibrations(f"# channel: 1\n# method: linear\n{points}", "x.csv", tactile)
    blocks = tactile.build(UUID, calibration=calibrations).blocks
    with_points = check_calibration(blocks, None, tactile, calibrations=calibrations)
    assert codes(with_points) == {"residual"}
    assert "misses its point at raw 32768" in text(with_points, "residual")
    assert codes(check_calibration(blocks)) == {"residual"}


def test_a_change_in_degrees_celsius_is_a_difference() -> None:
    """A fall by 150 degrees is no fall to 150 degrees below absolute zero."""
    profile = load_profile("temperature-sensor", [shipped_profiles()])
    ends = "raw,value [degC]\n0,{}\n21120,{}\n"
    rising, falling = (
        profile.build(UUID, calibration=read_calibrations(ends.format(*pair), "x.csv", profile)).blocks
        for pair in ((-40, 120), (110, -40))
    )
    assert text(check_calibration(falling, rising), "reversed") == (
        "the result falls by 150 °C from raw 0 to raw 21120; its type says that it must be increasing"
    )


def test_the_uncertainty_of_a_calibration_in_degrees_celsius_is_a_difference() -> None:
    profile = load_profile("temperature-sensor", [shipped_profiles()])
    for stated, found in ((0.4, set()), (0.6, {"residual"})):
        text_ = f"# uncertainty: {stated}\nraw,value [degC]\n0,-40\n21120,125\n"
        calibrations = read_calibrations(text_, "x.csv", profile)
        blocks = profile.build(UUID, calibration=calibrations).blocks
        assert codes(check_calibration(blocks, None, profile)) == found


def test_every_channel_is_judged_and_every_lost_calibration_is_reported(tactile: Profile) -> None:
    lines = {1: force_line(), 2: replace(force_line(), channel=2), 3: replace(force_line(), channel=3)}
    lines = {number: replace(line, inputs=(replace(line.inputs[0], channel=number),)) for number, line in lines.items()}
    full = tactile.build(UUID, calibration=lines).blocks
    bare = tactile.build(UUID, calibration={1: lines[1]}).blocks
    assert [(f.channel, f.code) for f in check_calibration(bare, full, tactile)] == [(2, "removed"), (3, "removed")]
    flat = {number: replace(line, coefficients=(5.0, 0.0)) for number, line in lines.items()}
    bad = tactile.build(UUID, calibration=flat).blocks
    found = check_calibration(bad, None, tactile)
    assert [(f.channel, f.code) for f in found] == [(1, "flat"), (2, "flat"), (3, "flat")]


def test_a_jump_in_a_table_is_refused(magnetic: Profile) -> None:
    table = angle_table(101)
    coefficients = list(table.coefficients)
    coefficients[2 * 50] += 2.5
    findings = check_calibration(built(magnetic, replace(table, coefficients=tuple(coefficients))))
    assert "jump" in codes(findings)


@pytest.mark.parametrize(("share", "found"), [(0.98, False), (1.02, True)])
def test_a_jump_is_refused_from_the_stated_uncertainty_on(share: float, found: bool, magnetic: Profile) -> None:
    table = angle_table(101)
    tolerance = channel_of(1, built(magnetic, table), magnetic).tolerance
    coefficients = list(table.coefficients)
    coefficients[0] += share * math.degrees(tolerance)  # of the first segment: it jumps at its end alone
    blocks = built(magnetic, replace(table, coefficients=tuple(coefficients)))
    assert ("jump" in codes(check_calibration(blocks))) == found


@pytest.mark.parametrize(("step", "found"), [(0.4, False), (0.6, True)])
def test_a_jump_of_an_actuator_counts_from_half_a_raw_value_on(step: float, found: bool) -> None:
    """What rounds to the same set point is no jump."""
    profile = load_profile("gripper", [shipped_profiles()])
    points = [(0.0, 0.0), (2000.0, 55.0), (4000.0, 110.0)]
    good = replace(fit(points, "table", channel=1, actuator=True), unit=parse_unit("mm"))
    start, *others = good.coefficients
    blocks = built(profile, replace(good, coefficients=(start + step, *others)))
    assert ("jump" in codes(check_calibration(blocks, None, profile))) == found


def test_a_large_change_and_a_lost_calibration_are_reported(tactile: Profile) -> None:
    findings = check_calibration(built(tactile, force_line(0.0, 8 / 65535)), built(tactile, force_line()), tactile)
    assert (codes(findings), codes(findings, "warning")) == (set(), {"changed"})
    assert "up to 2 N (20 % of the range)" in text(findings, "changed")
    gone = check_calibration(tactile.build(UUID).blocks, built(tactile, force_line()), tactile)
    assert codes(gone, "warning") == {"removed"}
    assert codes(check_calibration({}, built(tactile, force_line())), "warning") == {"removed"}


def test_an_overdue_calibration_is_reported_if_the_time_is_given(tactile: Profile) -> None:
    line = force_line(date=datetime(2024, 1, 1, tzinfo=UTC), interval=86400.0 * 365)
    blocks = built(tactile, line)
    assert check_calibration(blocks, None, tactile) == []
    found = check_calibration(blocks, None, tactile, now=datetime(2026, 1, 1, tzinfo=UTC))
    assert codes(found, "warning") == {"overdue"}


@pytest.mark.parametrize(("boundaries", "apart"), [(8, 8000), (4000, 15)])
def test_of_several_inputs_the_samples_stay_as_few_as_their_grid_allows(boundaries: int, apart: int) -> None:
    """Both sides of each boundary are looked at, or of an even share of them: a grid grows with their product."""
    edges = tuple(float(apart * number) for number in range(boundaries))
    segments = boundaries - 1
    parts = (CalibrationInput(1, 0, edges, edges[:-1]), CalibrationInput(2, 0, (0.0, 65535.0), (0.0,)))
    grid = Calibration(1, "steps", parts, tuple(float(number) for number in range(segments)), unit=parse_unit("N"))
    channels = {
        number: CurveChannel(number, grid.unit.units, 0.0, 1e9, 0.1, (0.0, 65535.0), False, True) for number in (1, 2)
    }
    curve = curve_of(grid, channels[1], channels)
    own = curve.axes[0]
    assert own[0] == 0.0
    assert own[-1] == 65535.0
    assert len(own) <= 500 + 2 * min(boundaries, 500)
    steps = {float(edge) for edge in edges} & set(own.tolist())
    assert len(steps) >= (boundaries if boundaries == 8 else 300)


@pytest.mark.parametrize("kept", ["CalInput", "Coefs", None], ids=str)
def test_a_calibration_that_the_node_has_and_no_one_understands_is_not_compared(
    kept: str | None, tactile: Profile
) -> None:
    """The new one is judged alone: a slope the other way is no reversal of something unknown."""
    falling, rising = force_line(10.0, -10 / 65535), force_line()
    old = built(tactile, rising)
    numbers = {field.type for field in teds.decode(old[1, 5]).fields if field.name in {"CalInput", "Coefs", kept}}
    numbers -= {field.type for field in teds.decode(old[1, 5]).fields if field.name == kept}
    block = b"".join(
        raw_tuple(part.type, part.value) for part in tuples(unframe(old[1, 5])) if part.type not in numbers
    )
    new = built(tactile, falling)
    assert codes(check_calibration(new, old)) == {"reversed"}
    assert codes(check_calibration(new, {**old, (1, 5): frame(block)})) == set()


def test_a_node_that_was_of_another_type_is_not_compared(tactile: Profile, magnetic: Profile) -> None:
    falling = replace(angle_table(), coefficients=tuple(-value for value in angle_table().coefficients))
    assert check_calibration(built(tactile, force_line()), built(magnetic, falling), tactile) == []


def test_a_channel_without_limits_is_reported(tactile: Profile) -> None:
    blocks = {key: octets for key, octets in built(tactile, force_line()).items() if key == (1, 5)}
    assert codes(check_calibration(blocks), "warning") == {"unlimited"}


# --- several inputs


def test_a_calibration_of_two_inputs_is_judged_over_both(tactile: Profile) -> None:
    temperature = CalibrationInput(2, 1, (0, 65535), (0,))
    force = CalibrationInput(1, 1, (0, 65535), (0,))
    gain = 10 / 65535
    right = Calibration(1, "polynomial", (force, temperature), (0.0, 0.0, gain, 0.0), unit=parse_unit("N"))
    assert check_calibration(built(tactile, right), None, tactile) == []
    wrong = replace(right, coefficients=(0.0, 0.0, gain, -2 * gain / 65535))
    findings = check_calibration(built(tactile, wrong), None, tactile)
    assert codes(findings) & {"not-monotone", "limits", "reversed"}
    assert "channel 2 at raw" in " ".join(finding.message for finding in findings)


# --- never anything else


@settings(max_examples=150)
@given(data=st.data())
def test_no_octets_of_a_calibration_raise(data: st.DataObject) -> None:
    profile = load_profile("tactile-finger-sensor", [shipped_profiles()])
    blocks = built(profile, force_line())
    block = bytearray(unframe(blocks[1, 5]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(6, len(block) - 1))
        block[at] = data.draw(st.integers(0, 255))
    findings = check_calibration({**blocks, (1, 5): frame(bytes(block))}, blocks, profile)
    assert all(finding.message[-1] != "." for finding in findings)


def test_a_table_of_4000_points_is_judged_in_a_blink(magnetic: Profile) -> None:
    blocks = built(magnetic, angle_table(4000))
    check_calibration(blocks, blocks, magnetic)
    with costs_at_most(1.0):
        assert check_calibration(blocks, blocks, magnetic) == []


def said(
    new: Blocks, old: Blocks | None = None, profile: Profile | None = None, **more: Any
) -> list[tuple[str, str, str]]:
    found = check_calibration(new, old, profile, **more)
    assert {finding.channel for finding in found} <= {1}
    return [(finding.severity, finding.code, finding.message) for finding in found]


def test_each_finding_in_whole_words(tactile: Profile) -> None:
    good, bare = built(tactile, force_line()), tactile.build(UUID).blocks
    falling = built(tactile, force_line(10.0, -10 / 65535))
    falls = "the result falls by 10 N from raw 0 to raw 65535"
    assert said(built(tactile, force_line(5.0, 0.0)), None, tactile) == [
        ("error", "flat", "every reading becomes 5 N: the gain is zero")
    ]
    assert said(falling, good) == [("error", "reversed", f"{falls}; with what the node has now it rose by 10 N")]
    assert said(falling, None, tactile) == [("error", "reversed", f"{falls}; its type says that it must be increasing")]
    assert said(built(tactile, force_line(-1.0)), None, tactile) == [
        ("error", "limits", "raw 0 gives -1 N, 1 N below the low limit of 0 N; the stated uncertainty is 0.2 N")
    ]
    assert said(built(tactile, force_line(uncertainty=0.5)), None, tactile) == [
        ("error", "residual", "the calibration is good to 0.5 N only; the stated uncertainty is 0.2 N")
    ]
    assert said(built(tactile, force_line(uncertainty=0.2)), None, tactile) == []
    assert said(built(tactile, force_line(0.0, 8 / 65535)), good, tactile) == [
        (
            "warning",
            "changed",
            "against what the node has now it differs by up to 2 N (20 % of the range), at raw 65535",
        )
    ]
    assert said(built(tactile, force_line(0.0, 9.05 / 65535)), good, tactile) == [], "a tenth of the range"
    assert said(bare, good, tactile) == [("warning", "removed", "the calibration that the node has is taken away")]
    zeros = replace(force_line(), coefficients=(0.0, 0.0))
    assert said(built(tactile, zeros), None, tactile) == [
        ("error", "erased", "all coefficients are zero: every reading would become the same value")
    ]
    late = force_line(date=datetime(2020, 1, 1, tzinfo=UTC), interval=86400.0)
    assert said(built(tactile, late), now=datetime(2026, 1, 1, tzinfo=UTC)) == [
        ("warning", "overdue", "the calibration of 2020-01-01 was due again on 2020-01-02, 2191 days ago")
    ]
    assert said(built(tactile, late)) == []


def test_a_table_that_jumps_says_where_and_errors_come_first(tactile: Profile) -> None:
    table = replace(fit([(0, 0.0), (30000, 4.5), (65535, 10.0)], "table", channel=1), unit=parse_unit("N"))
    first, *others = table.coefficients
    jumping = built(tactile, replace(table, coefficients=(first + 0.3, *others)))
    fall = "the result falls by 0.29985 N from raw 29999 to 30000"
    jump = ("error", "jump", "the table jumps by 0.3 N at 30000, between its segments 1 and 2")
    assert said(jumping, None, tactile) == [
        ("error", "not-monotone", f"{fall}; its type says that it must be increasing"),
        jump,
    ]
    assert said(jumping, built(tactile, table)) == [
        ("error", "not-monotone", f"{fall}; what the node has now is monotone"),
        jump,
    ]
    assert said(jumping) == [jump, ("warning", "not-monotone", f"{fall}; nothing here says whether it may")]


def test_an_exchange_of_gain_and_offset_is_named_as_such_alone() -> None:
    profile = load_profile("load-cell", [shipped_profiles()])
    part = CalibrationInput(1, 1, (4_194_304, 12_582_912), (8_388_608,))
    right = Calibration(1, "linear", (part,), (0.3, 500 / 4_194_304), unit=parse_unit("N"))
    found = said(built(profile, replace(right, coefficients=right.coefficients[::-1])), built(profile, right))
    assert found[0] == ("error", "swapped", "gain and offset are exchanged against what the node has now")
    assert {code for _, code, _ in found} == {"swapped", "limits"}
    covers = (
        "(the calibration covers raw 4194304 to 12582912; say raw-range in the profile if the channel gives no others)"
    )
    assert all(message.endswith(covers) for _, code, message in found if code == "limits")


@pytest.mark.parametrize(
    ("results", "noise"),
    [([0.5, -2.0, 1.0], 1.9073486328125e-06), ([1.0, math.nan, math.inf], 9.5367431640625e-07), ([math.nan], 0.0)],
)
def test_differences_below_eight_steps_of_a_float32_are_noise(results: list[float], noise: float) -> None:
    """One step is 2^-23 of the largest result."""
    curve: Any = SimpleNamespace(result=np.array(results))
    assert Curve.noise.fget(curve) == noise  # type: ignore[attr-defined]


def test_gain_and_offset_that_were_alike_before_are_not_exchanged(tactile: Profile) -> None:
    """To a quarter: else such a calibration could never be written again."""
    part = CalibrationInput(1, 1, (0, 9), (0,))
    alike = Calibration(1, "linear", (part,), (1.0, 1.1), unit=parse_unit("N"))
    before, after = built(tactile, alike), built(tactile, replace(alike, coefficients=(1.1, 1.0)))
    for new in (before, after):
        assert "swapped" not in codes(check_calibration(new, before, tactile))


def test_a_change_is_a_share_of_the_range_from_its_low_to_its_high_limit() -> None:
    """Of 200 N between -100 and 100 N."""
    profile = load_profile("load-cell", [shipped_profiles()])
    low, high = profile.channels[0].low_limit, profile.channels[0].high_limit
    assert low == -high < 0
    part = CalibrationInput(1, 1, (0, 16777215), (0,))
    line = Calibration(1, "linear", (part,), (low, (high - low) / 16777215), unit=parse_unit("N"))
    found = check_calibration(built(profile, replace(line, zero_offset=0.3 * high)), built(profile, line))
    assert "(15 % of the range)" in text(found, "changed")


def test_a_result_that_rises_where_it_must_fall_says_so(tactile: Profile) -> None:
    falling = force_line(10.0, -10 / 65535, monotone="decreasing")
    assert said(built(tactile, falling)) == []
    (rises,) = said(built(tactile, force_line(monotone="decreasing")))
    assert rises == (
        "error",
        "reversed",
        "the result rises by 10 N from raw 0 to raw 65535; its type says that it must be decreasing",
    )
    table = replace(fit([(0, 10.0), (30000, 5.5), (65535, 0.0)], "table", channel=1), unit=parse_unit("N"))
    first, slope, *others = table.coefficients
    bent = replace(table, coefficients=(first - 0.15, slope, *others), monotone="decreasing")
    (wrong,) = said(built(tactile, bent))
    assert wrong[:2] == ("error", "not-monotone")
    assert wrong[2].startswith("the result rises by 0.149")


def test_coefficients_without_points_have_no_residuals(tactile: Profile) -> None:
    calibrations = {1: force_line(uncertainty=0.1)}
    assert said(built(tactile, calibrations[1]), None, tactile, calibrations=calibrations) == []


@pytest.mark.parametrize(
    ("direction", "inputs", "step"),
    [("decreasing", 3.0, 5.0), ("increasing", 2.0, -1.0), ("either", 2.0, -1.0)],
)
def test_the_largest_step_the_wrong_way(direction: str, inputs: float, step: float) -> None:
    results = np.array([0.0, 1.0, 0.5, -0.5, 4.5])
    curve: Any = SimpleNamespace(steps=np.diff(results), axes=(np.arange(5.0),), net=4.5)
    assert Curve.worst_step(curve, direction) == ((inputs,), step)


def test_a_set_point_and_a_channel_of_no_width_have_no_share_of_a_range_to_change_by(tactile: Profile) -> None:
    gripper = load_profile("gripper", [shipped_profiles()])
    before, after = (read_calibrations(f"# channel: 1\n0,0\n{end},110\n", "x.csv", gripper) for end in (4095, 2000))
    old = gripper.build(UUID, calibration=before).blocks
    found = check_calibration(gripper.build(UUID, calibration=after).blocks, old, gripper)
    assert codes(found, "warning") == set()
    flat = teds.compose(3, {"PhyUnits": parse_unit("N").units, "LowLimit": 5.0, "HiLimit": 5.0})
    old, new = ({**built(tactile, force_line(zero)), (1, 3): flat} for zero in (0.0, 3.0))
    assert "changed" not in codes(check_calibration(new, old), "warning")


@pytest.mark.parametrize("ends", [(5.0, 5.0), (0.0, math.inf), (math.nan, 9.0), None], ids=str)
def test_a_channel_without_a_range_of_raw_values_gives_what_its_calibration_covers(
    ends: tuple[float, float] | None, tactile: Profile
) -> None:
    channel = replace(channel_of(1, built(tactile, force_line()), tactile), raw=ends)
    (axis,) = curve_of(force_line(), channel, {}, dense=True).axes
    assert (axis[0], axis[-1]) == (0.0, 65535.0)


def test_a_curve_that_must_be_monotone_either_way_says_so(magnetic: Profile) -> None:
    either = built(magnetic, replace(bent_table(), monotone="either"))
    assert text(check_calibration(either), "not-monotone").endswith("; its type says that it must be monotone")
    bent = built(magnetic, bent_table())
    again = check_calibration(bent, bent)
    assert (codes(again), codes(again, "warning")) == (set(), {"not-monotone"})
    assert text(again, "not-monotone").endswith("; nothing here says whether it may")


def test_a_fall_of_degrees_celsius_inside_a_curve_is_a_difference() -> None:
    profile = load_profile("temperature-sensor", [shipped_profiles()])
    table = fit([(0, -40.0), (10000, 40.0), (21120, 120.0)], "table", channel=1)
    first, *others = table.coefficients
    jumping = replace(table, unit=parse_unit("degC"), coefficients=(first + 2.0, *others))
    assert text(check_calibration(built(profile, jumping), None, profile), "not-monotone") == (
        "the result falls by 1.992 °C from raw 9999 to 10000; its type says that it must be increasing"
    )


def test_every_number_of_a_calibration_of_two_inputs_is_looked_at(tactile: Profile) -> None:
    first, second = CalibrationInput(1, 1, (0, 1, 2, 3), (0, 1, 2)), CalibrationInput(2, 0, (0, 9), (0,))
    line = Calibration(1, "polynomial", (first, second), (0.0, 1.0, 1.0, 1.0, 2.0, 1.0), unit=parse_unit("N"))
    for changes, word in (
        ({"coefficients": (0.0, 1.0, math.nan, 1.0, 2.0, 1.0)}, "coefficient 3 of 6 (segment 2)"),
        ({"inputs": (first, replace(second, boundaries=(0.0, math.inf)))}, "boundary 2 of 2"),
        ({"inputs": (first, replace(second, offsets=(math.nan,)))}, "offset 1 of 1"),
        ({"low_limit": 0.0, "high_limit": 9.0, "uncertainty": math.inf}, "limit 3 of 3"),
    ):
        findings = check_calibration(built(tactile, replace(line, **changes)), None, tactile)
        assert text(findings, "erased").startswith(word), word


@pytest.mark.parametrize("name", ["low_limit", "high_limit", "uncertainty"])
def test_a_limit_that_is_not_available_is_no_erased_one(name: str, tactile: Profile) -> None:
    blocks = built(tactile, replace(force_line(), **{name: math.nan}))  # type: ignore[arg-type]
    assert "erased" not in codes(check_calibration(blocks, None, tactile))


@pytest.mark.parametrize(
    ("ends", "found"),
    [
        ((0.0, 4095.4), None),
        ((-0.4, 4095.0), None),
        ((0.0, 4100.0), "110 mm gives raw 4100, raw 5.00005 above the highest raw value of raw 4095"),
        ((-100.0, 4095.0), "0 mm gives raw -100, raw 100 below the lowest raw value of raw 0"),
    ],
)
def test_a_set_point_may_be_half_a_raw_value_beyond_the_range(ends: tuple[float, float], found: str | None) -> None:
    profile = load_profile("gripper", [shipped_profiles()])
    points = [(ends[0], 0.0), (ends[1], 110.0)]
    line = replace(fit(points, "linear", channel=1, actuator=True), unit=parse_unit("mm"))
    findings = check_calibration(built(profile, line), None, profile)
    assert [finding.message for finding in findings if finding.code == "limits"] == ([] if found is None else [found])


def test_a_calibration_over_more_than_a_turn_says_so(magnetic: Profile) -> None:
    doubled = built(magnetic, angle_table(gain=2.0))
    assert "above the end of the turn that the channel spans of 360 °" in text(
        check_calibration(doubled, None, magnetic), "limits"
    )
