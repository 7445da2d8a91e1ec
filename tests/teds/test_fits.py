"""Whether a datasheet suffices for a task."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.teds import Sheet
from teds_provision.teds.calibration import fit
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.fits import Fit, judge, met, parse_fits, parse_require
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.units import parse_unit

NOW = datetime(2026, 11, 21, tzinfo=UTC)


def angle(**more: object) -> Sheet:
    line = replace(
        fit([(0, 0.0), (65535, 360.0)], "linear", channel=1),
        unit=parse_unit("degree"),
        date=datetime(2026, 1, 1, tzinfo=UTC),
        interval=365.0 * 86_400,
        uncertainty=1.0,
    )
    built = load_profile("magnetic-angular-position-sensor").build(bytes(10), calibration={1: line})
    sheet = Sheet.from_image(Image(bytes(10), built.blocks))
    return replace(sheet, channels=(replace(sheet.channels[0], **more),))  # type: ignore[arg-type]


def only(text: str, sheet: Sheet, now: datetime | None = None) -> Fit:
    (found,) = judge(parse_fits(text), sheet, now)
    return found


def test_the_papers_sensor_fits_the_papers_task() -> None:
    found = only("angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz", angle())
    assert found.result == "passed", found.why
    assert "360" in found.why
    assert "10000 Hz" in found.why


@pytest.mark.parametrize(
    ("text", "result", "words"),
    [
        ("angle >= 360 deg", "passed", ""),
        ("angle >= 6.28 rad", "passed", ""),
        ("angle >= 400 deg", "passed", ""),  # a full turn reaches every angle
        ("range >= 400 deg", "failed", "range is 360 °, asked is >= 400 deg"),
        ("uncertainty <= 0.5 deg", "failed", "uncertainty is 1 °"),
        ("uncertainty <= 0.3 %", "passed", "0.278 %"),
        ("uncertainty <= 0.2 %", "failed", "0.278 %"),
        ("rate >= 1 MHz", "failed", "asked is >= 1 MHz"),
        ("high >= 360 deg, low <= 0 deg", "passed", ""),
        ("low <= -10 deg", "failed", "low is 0 °"),
        ("force >= 1 N", "failed", "no channel gives force"),
    ],
)
def test_each_bound_is_judged_in_its_unit(text: str, result: str, words: str) -> None:
    found = only(text, angle())
    assert (found.result, words in found.why) == (result, True), found.why


@pytest.mark.parametrize(
    ("text", "result", "why"),
    [
        ("range >= 5 N", "failed", "range is in °, asked is >= 5 N."),
        ("high >= 6 degC", "failed", "high is in °, asked is >= 6 degC."),
        ("low <= 1 kg", "failed", "low is in °, asked is <= 1 kg."),
        ("uncertainty <= 1 V", "failed", "uncertainty is in °, asked is <= 1 V."),
        ("range >= 5 count", "failed", "range is in °, asked is >= 5 count."),
        ("range >= 50 %", "failed", "range is in °, asked is >= 50 %."),
        ("range >= 5 rad, high <= 7 N", "failed", "high is in °, asked is <= 7 N."),
        ("uncertainty <= 1 %, rate >= 1 Hz", "passed", "uncertainty 0.278 %, rate 10000 Hz."),
        ("range >= 6.28", "passed", "range 360 °."),
        ("range >= 6.29", "failed", "range is 360 °, asked is >= 6.29."),
    ],
)
def test_a_bound_in_a_unit_of_another_kind_is_not_met(text: str, result: str, why: str) -> None:
    """5 N were compared with 6.28 rad, and an angle sensor passed. A number without a unit is in SI."""
    found = only(text, angle())
    assert (found.result, found.why) == (result, why)


def test_a_named_channel_of_another_kind_does_not_meet_its_bound() -> None:
    (required,) = parse_require('["the shaft"]\nrange = ">= 5 N"\n', "r")
    (found,) = judge(required, angle(name="the shaft"))
    assert (found.result, met(required, (found,))) == ("failed", False)


def test_a_part_of_a_turn_reaches_no_further_than_its_limits() -> None:
    half = angle(low=-math.pi / 2, high=math.pi / 2)
    assert only("angle >= 90 deg", half).result == "passed"
    assert only("angle >= 91 deg", half).result == "failed"
    assert only("angle <= -90 deg", half).result == "passed"
    assert only("angle <= -91 deg", half).result == "failed"


def test_what_the_datasheet_does_not_state_is_skipped_and_says_what() -> None:
    found = only("angle >= 360 deg, rate >= 1 Hz", angle(timing=replace(angle().channels[0].timing, period=math.nan)))
    assert found.result == "skipped"
    assert found.why == "rate is not stated."


def test_an_overdue_calibration_promises_no_uncertainty_and_without_one_there_are_no_values() -> None:
    late = datetime(2027, 6, 1, tzinfo=UTC)
    assert only("uncertainty <= 1 deg", angle(), NOW).result == "passed"
    assert "due on 2027-01-01" in only("uncertainty <= 1 deg", angle(), late).why
    why = only("uncertainty <= 0.001 deg", angle(calibration=None)).why
    assert why.startswith("Channel 1 has no calibration: raw values cannot be turned into °; uncertainty is ")
    assert not why.endswith("..")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "1 to 16 terms"),
        ("rate >= 1 Hz," * 17, "1 to 16 terms"),
        ("angel >= 360 deg", '"angel" is no quantity'),
        ("angle = 360 deg", "is no bound"),
        ("angle >= many deg", "is no bound"),
        ("angle >= 1e999 deg", "too large"),
        ("angle >= 360 N", "does not measure this"),
        ("rate >= 5 deg", "does not measure this"),
        ("angle >= 1 deg, force >= 1 N", "one quantity"),
        ("angle >= 9**9**9 m", "is not a unit"),
        ("x" * 2000, "1000"),
    ],
)
def test_an_expression_that_means_nothing_is_refused_by_name(text: str, words: str) -> None:
    with pytest.raises(BadDataError) as caught:
        parse_fits(text)
    assert words in caught.value.message


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("angle >= 360 N", "rad"),
        ("force >= 3 m", "N"),
        ("temperature >= 3 m", "K"),
        ("angle >= 1 deg, rate >= 5 deg", "1/s"),
        ("angle >= 1 deg, uncertainty <= 1 N", "rad"),
        ("rate >= 5 m", "1/s"),
    ],
)
def test_a_unit_of_another_kind_is_answered_with_one_that_fits(text: str, unit: str) -> None:
    with pytest.raises(BadDataError) as caught:
        parse_fits(text)
    assert caught.value.hint == f"Write it in {unit}, or in another unit of the same kind."


@given(st.text(max_size=80) | st.text("anglerate><= 0123456789.,dNHzk%-", max_size=60))
def test_no_expression_raises_anything_else(text: str) -> None:
    try:
        requirement = parse_fits(text)
    except BadDataError:
        return
    assert judge(requirement, angle())


REQUIRE = """
[angle]
range = ">= 360 deg"
uncertainty = "1 deg"
rate = "1 kHz"

["Joint 3"]
low = "0 deg"
"""


def test_a_sheet_of_requirements_names_quantities_and_channels() -> None:
    by_quantity, by_name = parse_require(REQUIRE, "task.toml")
    assert (by_quantity.quantity, by_name.channel) == ("angle", "Joint 3")
    assert [term.text for term in by_quantity.terms] == ["range >= 360 deg", "uncertainty <= 1 deg", "rate >= 1 kHz"]
    assert met(by_quantity, judge(by_quantity, angle()))
    assert not met(by_name, judge(by_name, angle()))
    for low, result in ((-0.2, True), (0.0, True), (0.2, False)):  # without an operator a range reaches down to it
        sheet = angle(name="Joint 3", low=low)
        assert met(by_name, judge(by_name, sheet)) is result


def test_of_channels_of_one_name_each_one_has_to_meet_what_is_asked_and_of_a_quantity_one() -> None:
    by_quantity, by_name = parse_require(REQUIRE, "task.toml")
    good, bad = (angle(name="Joint 3", low=low, high=low + 2 * math.pi * share).channels[0]
                 for low, share in ((0.0, 1), (0.2, 0.5)))  # fmt: skip
    for channels in ((good, bad), (bad, good)):
        sheet = replace(angle(), channels=channels)
        assert met(by_quantity, judge(by_quantity, sheet))
        assert not met(by_name, judge(by_name, sheet))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "asks for nothing"),
        ("angle = 3", "no table of bounds"),
        ("[angle]\nwidth = '3 deg'", 'no bound "width"'),
        ("[angle]\nrange = 3", "is a text"),
        ("[angle]\nrange = '3 N'", "does not measure this"),
        ("[angle", "task.toml is not valid TOML"),
        ("a." * 40 + "a = 1", "more than 32 parts"),
    ],
)
def test_a_sheet_of_requirements_that_means_nothing_names_the_place(text: str, words: str) -> None:
    with pytest.raises(BadDataError) as caught:
        parse_require(text, "task.toml")
    assert words in caught.value.message
    assert caught.value.message.startswith("task.toml")


def test_every_quantity_has_the_unit_of_its_kind() -> None:
    known = {
        "angle": "rad",
        "angular-velocity": "rad/s",
        "angular-rate": "rad/s",
        "angular-acceleration": "rad/s²",
        "length": "m",
        "distance": "m",
        "position": "m",
        "displacement": "m",
        "area": "m²",
        "volume": "m³",
        "velocity": "m/s",
        "speed": "m/s",
        "acceleration": "m/s²",
        "flow": "m³/s",
        "mass": "kg",
        "density": "kg/m³",
        "time": "s",
        "frequency": "Hz",
        "current": "A",
        "temperature": "K",
        "force": "N",
        "torque": "N·m",
        "moment": "N·m",
        "energy": "J",
        "stiffness": "N/m",
        "pressure": "Pa",
        "power": "W",
        "voltage": "V",
        "resistance": "Ω",
        "capacitance": "F",
        "inductance": "H",
        "magnetic-field": "T",
        "charge": "C",
        "illuminance": "lx",
    }
    for quantity, unit in known.items():
        (term,) = parse_fits(f"{quantity.replace('-', ' ').upper()} >= 2 {unit}").terms
        assert (term.what, term.value) == (quantity, 2.0)
        with pytest.raises(BadDataError, match="does not measure this"):
            parse_fits(f"{quantity} >= 2 mol")
    with pytest.raises(BadDataError, match="no quantity that is known"):
        parse_fits("luck >= 2")


@pytest.mark.parametrize(
    ("text", "result", "why"),
    [
        ("range > 359 deg", "passed", "range 360 °."),
        ("range > 360 deg", "failed", "range is 360 °, asked is > 360 deg."),
        ("range >= 360 deg", "passed", "range 360 °."),
        ("range < 360 deg", "failed", "range is 360 °, asked is < 360 deg."),
        ("range < 361 deg", "passed", "range 360 °."),
        ("uncertainty < 1 deg", "failed", "uncertainty is 1 °, asked is < 1 deg."),
        ("uncertainty <= 1 deg", "passed", "uncertainty 1 °."),
        ("uncertainty <= 0.2 %", "failed", "uncertainty is 0.278 %, asked is <= 0.2 %."),
        ("rate >= 10 kHz, range >= 1 rad", "passed", "rate 10000 Hz, range 360 °."),
        (
            "rate > 10001 Hz, range >= 7 rad",
            "failed",
            "rate is 10000 Hz, asked is > 10001 Hz; range is 360 °, asked is >= 7 rad.",
        ),
        ("low >= 0 deg, high <= 360 deg", "passed", "low 0 °, high 360 °."),
        ("low > 0 deg", "failed", "low is 0 °, asked is > 0 deg."),
        ("high < 360 deg", "failed", "high is 360 °, asked is < 360 deg."),
        ("angle <= 0 deg, angle >= 360 deg", "passed", "angle 0 °, angle 360 °."),
        ("angle > 400 deg", "passed", "angle 360 °."),
        ("angle < -1 deg", "failed", "angle is 0 °, asked is < -1 deg."),
        ("force >= 1 N", "failed", "no channel gives force."),
    ],
)
def test_a_result_in_whole_words(text: str, result: str, why: str) -> None:
    sheet = angle()
    known = replace(sheet.channels[0], timing=replace(sheet.channels[0].timing, period=1e-4))
    found = only(text, replace(sheet, channels=(known,)))
    assert (found.result, found.why) == (result, why)


def test_a_limit_that_is_just_a_value_is_neither_above_nor_below_it() -> None:
    """Float32 writes 0.7 as 0.69999999 and 0.1 as 0.10000000149."""
    floats = {"units": parse_unit("N").units, "calibration": None, "sample": SampleForm(1, 4)}
    sheet = angle(**floats, low=0.10000000149011612, high=0.699999988079071)
    for text, result in (
        ("high < 0.7 N", "failed"),
        ("high >= 0.7 N", "passed"),
        ("low > 0.1 N", "failed"),
        ("low <= 0.1 N", "passed"),
        ("high < 0.70001 N", "passed"),
        ("low > 0.09999 N", "passed"),
    ):
        assert only(text, sheet).result == result, text


def test_what_is_not_stated_is_skipped_unless_something_else_is_short() -> None:
    bare = angle(low=math.nan, uncertainty=math.nan, calibration=None, units=parse_unit("m").units, sample=None)
    found = only("range >= 1 m, uncertainty <= 1 mm", bare)
    assert found.result == "failed"
    assert found.why == (
        "The datasheet does not say how a sample of channel 1 is coded; range is not stated; uncertainty is not stated."
    )
    silent = angle(low=math.nan)
    assert only("range >= 1 deg, low <= 0 deg, angle >= 360 deg", silent) == Fit(
        1, "angle", "skipped", "range is not stated; low is not stated."
    )
    for period in (0.0, -1.0):
        odd = angle(timing=replace(angle().channels[0].timing, period=period))
        assert [only(f"rate {sign} 1 Hz", odd).result for sign in (">=", "<=")] == ["skipped", "skipped"]
    late = datetime(2027, 1, 2, tzinfo=UTC)
    assert only("angle >= 360 deg", angle(), late).result == "passed", "only an uncertainty ends with its calibration"


def test_a_difference_of_temperatures_is_shown_without_the_zero_of_the_unit() -> None:
    celsius = load_profile("temperature-sensor")
    line = replace(fit([(0, -40.0), (21120, 125.0)], "linear", channel=1), unit=parse_unit("degC"), uncertainty=0.5)
    sheet = Sheet.from_image(Image(bytes(10), celsius.build(bytes(10), calibration={1: line}).blocks))
    for asked, why in (
        ("uncertainty <= 0.25 K", "uncertainty is 0.5 °C, asked is <= 0.25 K."),
        ("uncertainty <= 0.25 degC", "uncertainty is 0.5 °C, asked is <= 0.25 degC."),
        ("range >= 200 K", "range is 165 °C, asked is >= 200 K."),
        ("high >= 400 K", "high is 125 °C, asked is >= 400 K."),
    ):
        assert (only(asked, sheet).result, only(asked, sheet).why) == ("failed", why)


def test_which_channels_count_and_how_many_have_to_meet_it() -> None:
    asked = parse_fits("rate >= 1 Hz")
    good, bad = Fit(1, "a", "passed", ""), Fit(2, "b", "failed", "")
    assert [met(asked, fits) for fits in ([], [good, bad], [bad], [Fit(None, "", "passed", "")])] == [
        False,
        True,
        False,
        False,
    ]
    named = replace(asked, channel="a")
    assert [met(named, fits) for fits in ([good, bad], [good, good], [])] == [False, True, False]
    assert (asked.subject, named.subject, replace(asked, quantity="force").subject) == (
        "a channel",
        'the channel "a"',
        "force",
    )


def test_a_table_of_requirements_in_its_defaults() -> None:
    text = '[force]\nlow = "-1 N"\nhigh = "5 N"\nrange = "6 N"\nuncertainty = "< 1 %"\nforce = "2 N"\nrate = "2 Hz"\n'
    (asked,) = parse_require(text, "task.toml")
    assert [term.text for term in asked.terms] == [
        "low <= -1 N",
        "high >= 5 N",
        "range >= 6 N",
        "uncertainty < 1 %",
        "force >= 2 N",
        "rate >= 2 Hz",
    ]
    with pytest.raises(BadDataError, match=r"^task\.toml: \[Joint 3\]: there is no bound \"force\"\.$"):
        parse_require('["Joint 3"]\nforce = "1 N"\n', "task.toml")


@pytest.mark.parametrize("ends", [(math.nan, 1.0), (0.0, math.nan), (1.0, 1.0), (2.0, 1.0), (-math.inf, math.inf)])
def test_a_share_of_a_range_that_is_none_is_not_stated(ends: tuple[float, float]) -> None:
    """The uncertainty in SI units counted as the share: 0.0175 rad met 20 %, and was shown as 1.75 %."""
    sheet = angle(low=ends[0], high=ends[1])
    found = only("uncertainty <= 20 %", sheet)
    assert (found.result, found.why) == ("skipped", "uncertainty is not stated.")
    assert only("uncertainty <= 1 deg", sheet).result == "passed"
