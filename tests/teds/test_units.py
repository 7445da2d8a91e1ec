"""Units as people write them become the standard's exponents, and back."""

from __future__ import annotations

import math
import subprocess
import sys
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.teds import units as u
from teds_provision.teds.codec.model import UNIT_PARTS, Units


def exponents(text: str) -> dict[str, Fraction]:
    units = u.parse_units(text)
    return {base: getattr(units, base) for base in UNIT_PARTS if getattr(units, base)}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("degree", {"radians": 1}),
        ("N", {"meters": 1, "kilograms": 1, "seconds": -2}),
        ("mm", {"meters": 1}),
        ("degC", {"kelvins": 1}),
        ("1/s", {"seconds": -1}),
        ("Pa", {"meters": -1, "kilograms": 1, "seconds": -2}),
        ("V", {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -1}),
        ("V/Hz**0.5", {"meters": 2, "kilograms": 1, "seconds": Fraction(-5, 2), "amperes": -1}),
        ("W/sr", {"meters": 2, "kilograms": 1, "seconds": -3, "steradians": -1}),
        ("mlx", {"candelas": 1, "steradians": 1, "meters": -2}),
        ("degC/min", {"kelvins": 1, "seconds": -1}),
        ("g", {"kilograms": 1}),
        ("lbf*ft", {"meters": 2, "kilograms": 1, "seconds": -2}),
    ],
)
def test_written_units_become_si_exponents(text: str, expected: dict[str, Fraction]) -> None:
    assert exponents(text) == expected
    assert u.parse_units(text).interpretation == u.PRODUCT


@pytest.mark.parametrize(
    ("text", "value", "si"),
    [
        ("degree", 180.0, math.pi),
        ("degC", 20.0, 293.15),
        ("degF", 32.0, 273.15),
        ("mm", 5.0, 0.005),
        ("mV/V", 2.0, 0.002),
        ("%", 50.0, 0.5),
        ("rpm", 60.0, 2 * math.pi),
        ("g", 1.0, 0.001),
        ("dBm", 30.0, 0.0),
        ("lbf", 1.0, 4.4482216152605),
        ("um/m", 10.0, 1e-5),
        ("mN/N", 10.0, 1e-2),
        ("kg/m**3", 3.0, 3.0),
    ],
)
def test_values_convert_into_si_and_back(text: str, value: float, si: float) -> None:
    unit = u.parse_unit(text)
    assert unit.to_si(value) == pytest.approx(si, rel=1e-12)
    assert unit.from_si(unit.to_si(value)) == pytest.approx(value, rel=1e-12)


def test_a_temperature_difference_has_no_offset() -> None:
    assert u.parse_unit("degC").difference_to_si(0.5) == 0.5


@pytest.mark.parametrize(
    ("text", "interpretation", "base"),
    [
        ("mm/mm", 1, "meters"),
        ("mV/V", 1, "amperes"),
        ("%", 1, None),
        ("dB", 3, None),
        ("digital", 4, None),
        ("arbitrary", 5, None),
    ],
)
def test_ratios_logs_and_digital_data_have_their_interpretation(
    text: str, interpretation: int, base: str | None
) -> None:
    units = u.parse_units(text)
    assert units.interpretation == interpretation
    assert (base is None) == (Units(interpretation) == units)
    if base:
        assert getattr(units, base) != 0


def test_counts_are_the_plain_product_of_nothing() -> None:
    assert u.parse_units("count") == u.parse_units("1") == Units()


def test_the_table_agrees_with_pint() -> None:
    ours_only = {"rev", "Nm", "mNm", "N m", "gn", "counts", "LSB"}  # pint reads Nm as a textile count, rev not at all
    for text in [*u.TABLE, *u.NAMED]:
        if text in ours_only:
            continue
        by_pint = u._by_pint(text)
        ours = u.parse_unit(text)
        assert (ours.units, ours.scale, ours.offset) == (
            by_pint.units,
            pytest.approx(by_pint.scale),
            pytest.approx(by_pint.offset),
        ), text


@pytest.mark.parametrize(
    "form",
    ["{}*{}", "{}/{}", "{}·{}", "{} {}", "{}**3/{}", "{}^-1/{}", "{}²/{}**2", "1/{}/{}", "K/({}*{})", "{}/{}**0.5"],
)
def test_products_of_the_table_agree_with_pint(form: str) -> None:
    """A stride through all pairs: what is computed here is what the whole of pint says."""
    names = [name for name in [*u.TABLE, *u.NAMED] if name.isalpha() and name not in {"rev", "Nm", "mNm", "gn"}]
    for first, second in zip(names, names[7:] + names[:7], strict=True):
        text = form.format(first, second)
        ours = u._compound(text)
        if ours is None:  # a ratio, a count
            continue
        by_pint = u._by_pint(text)
        assert (ours.units, ours.scale, ours.offset) == (by_pint.units, pytest.approx(by_pint.scale), 0.0), text


@pytest.mark.parametrize("text", ["N/mm", "kg/m**3", "W/(m*K)", "1/K", "degC/min", "m/s³"])
def test_products_need_no_pint(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(u, "_registry", lambda: None)
    assert u.parse_unit(text).units.interpretation == u.PRODUCT


def test_a_rare_unit_without_pint_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(u, "_registry", lambda: None)
    with pytest.raises(BadDataError, match="without the package pint") as caught:
        u.parse_unit("furlong/fortnight")
    assert "[units]" in caught.value.hint


@pytest.mark.parametrize("text", ["newtn", "degree celsius of", "", "3 +", "USD", "m**0.3", "m/", "]["])
def test_what_is_no_unit_is_refused_with_its_text_and_a_cure(text: str) -> None:
    with pytest.raises(BadDataError) as caught:
        u.parse_unit(text)
    assert f'"{text}"' in caught.value.message
    assert caught.value.hint


@pytest.mark.parametrize(
    ("text", "symbol"),
    [
        ("radian", "rad"),
        ("radians/s", "rad/s"),
        ("Degrees", "degree"),
        ("Celsius", "degC"),
        ("newton", "N"),
        ("newton-meters", "N*m"),
        ("metres", "m"),
        ("kilonewton", "kN"),
        ("hertz", "Hz"),
        ("m/second^2", "m/s^2"),
    ],
)
def test_the_symbol_of_a_unit_in_words_is_suggested(text: str, symbol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(u, "_registry", lambda: None)  # as without the extra
    u.parse_unit.cache_clear()
    with pytest.raises(BadDataError) as caught:
        u.parse_unit(text)
    assert caught.value.hint.startswith(f'Did you mean "{symbol}"?')
    assert u.parse_unit(symbol).units
    u.parse_unit.cache_clear()


def test_a_near_miss_is_suggested() -> None:
    with pytest.raises(BadDataError) as caught:
        u.parse_unit("degre")
    assert '"degree"' in caught.value.hint


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("degree", "rad"),
        ("N", "N"),
        ("m/s²", "m/s²"),
        ("degC", "K"),
        ("kPa", "Pa"),
        ("Nm", "N·m"),
        ("N/mm", "N/m"),
        ("kg/m**2", "kg/m²"),
        ("1/K", "1/K"),
        ("W/(m*K)", "m·kg/(s³·K)"),
        ("count", ""),
        ("mm/mm", "m/m"),
        ("%", "ratio"),
        ("V/Hz**0.5", "m²·kg/(s^2.5·A)"),
        ("dBm", "log10(W)"),
    ],
)
def test_exponents_are_shown_as_people_write_them(text: str, shown: str) -> None:
    assert u.format_units(u.parse_units(text)) == shown


@given(
    st.builds(
        Units,
        st.integers(0, 255),
        *[st.integers(-128, 127).map(lambda n: Fraction(n, 2))] * 9,
        st.integers(0, 255),
    )
)
def test_every_possible_unit_can_be_shown(units: Units) -> None:
    assert isinstance(u.format_units(units), str)
    value, text = u.in_display_units(1.0, units)
    assert math.isfinite(value)
    assert isinstance(text, str)


def test_values_are_shown_in_the_unit_the_person_prefers_if_it_fits() -> None:
    rad = u.parse_units("degree")
    assert u.in_display_units(math.pi, rad) == (pytest.approx(180.0), "°")
    assert u.in_display_units(math.pi, rad, "turn") == (pytest.approx(0.5), "turn")
    assert u.in_display_units(math.pi, rad, "N") == (pytest.approx(180.0), "°")
    assert u.in_display_units(3.5, u.parse_units("N")) == (3.5, "N")
    assert u.format_value(0.5, u.display_unit(u.parse_units("K")), difference=True) == "0.5 °C"
    assert u.format_value(math.nan, u.display_unit(rad)) == "not available"


@pytest.mark.parametrize(
    ("written", "seconds"),
    [
        ("100 us", 1e-4),
        (0.5, 0.5),
        ("10 kHz", 1e-4),
        ("2 min", 120.0),
        ("1 year", 31_556_952.0),
        ("365 d", 365 * 86400.0),
        ("3", 3.0),
    ],
)
def test_times_are_read_as_written(written: object, seconds: float) -> None:
    assert u.parse_seconds(written) == pytest.approx(seconds)


@pytest.mark.parametrize("written", ["soon", "3 N", "0 Hz", [], True, None, ""])
def test_what_is_no_time_is_refused(written: object) -> None:
    with pytest.raises(BadDataError):
        u.parse_seconds(written)


def test_everyday_units_do_not_load_pint() -> None:
    code = "import sys; from teds_provision.teds.units import parse_unit as p\n"
    code += "p('degree'), p('N'); print('pint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
