"""Units as people write them become the standard's exponents, and back."""

from __future__ import annotations

import math
import re
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
    assert u.parse_units("count") == u.parse_units("1") == u.parse_units("1/1") == Units()


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
    u.parse_unit.cache_clear()  # what pint has parsed before would be found
    monkeypatch.setattr(u, "_registry", lambda: None)
    assert u.parse_unit(text).units.interpretation == u.PRODUCT


@pytest.mark.parametrize(
    "text", ["W/(m", "W/(m*", "W/()", "W/( )", "/(m)", "W/(m/", "W/m)", "/m", "*m", "m*", "W//m", "W/(m*K)*s"]
)
def test_half_a_product_is_no_unit(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    u.parse_unit.cache_clear()
    monkeypatch.setattr(u, "_registry", lambda: None)
    with pytest.raises(BadDataError) as refused:
        u.parse_unit(text)
    assert refused.value.message.startswith(f'"{text}" is not a unit')


@pytest.mark.parametrize("text", ["dB/m", "m*dB", "bit/s", "ratio*m", "strain/s", "N/percent"])
def test_what_is_no_product_of_si_units_is_no_factor(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """A ratio, a level or a number of bits in a product would leave its kind out."""
    u.parse_unit.cache_clear()
    monkeypatch.setattr(u, "_registry", lambda: None)
    with pytest.raises(
        BadDataError, match=f'^"{re.escape(text)}" is not a unit that is known without the package pint'
    ):
        u.parse_unit(text)
    u.parse_unit.cache_clear()


def test_a_unit_of_a_kind_that_the_si_has_not_is_named() -> None:
    with pytest.raises(BadDataError) as refused:
        u.parse_unit("pixel/s")
    assert refused.value.message == 'The unit "pixel/s" holds pixel, which the SI units of a TEDS cannot say.'
    assert refused.value.hint == ('Use "arbitrary" for what has no SI unit, "count" for a number, "digital" for bits.')


def test_a_symbol_is_only_suggested_with_a_power_that_a_teds_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(u, "_registry", lambda: None)
    for text, hint in (("newtons^32", 'Did you mean "N^32"? Write it'), ("newtons^99", "Write it")):
        u.parse_unit.cache_clear()
        with pytest.raises(BadDataError) as refused:
            u.parse_unit(text)
        assert refused.value.hint.startswith(hint)
    u.parse_unit.cache_clear()


@pytest.mark.parametrize("text", ["metre/fortnight", "newton of", "hertz + newton", "metre**0.3"])
def test_what_would_be_no_unit_in_symbols_either_is_not_suggested(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(u, "_registry", lambda: None)
    u.parse_unit.cache_clear()
    with pytest.raises(BadDataError) as refused:
        u.parse_unit(text)
    assert not re.search(r'Did you mean "(m/fortnight|N of|Hz \+ N|m\*\*0\.3)"', refused.value.hint)
    u.parse_unit.cache_clear()


def test_without_the_package_pint_its_units_are_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pint", None)
    assert u._registry.__wrapped__() is None, "past its cache: to load pint again would take a second"


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


@pytest.mark.parametrize(
    ("written", "message", "hint"),
    [
        *(
            (written, f"{written!r} is not a time.", 'Write a number of seconds, or a text like "100 us" or "1 year".')
            for written in ("soon", [], True, None, "")
        ),
        ("3 N", '"3 N" is not a time: N is no unit of time.', 'Write it like "100 us", "5 s" or "10 kHz".'),
        ("0 Hz", '"0 Hz" is not a time: Hz is no unit of time.', 'Write it like "100 us", "5 s" or "10 kHz".'),
    ],
)
def test_what_is_no_time_is_refused_with_a_cure(written: object, message: str, hint: str) -> None:
    with pytest.raises(BadDataError) as refused:
        u.parse_seconds(written)
    assert (refused.value.message, refused.value.hint) == (message, hint)


def test_a_unit_has_at_most_64_characters() -> None:
    assert u.parse_unit("m" + " " * 62 + "m").units == u.parse_unit("m²").units
    with pytest.raises(BadDataError) as refused:
        u.parse_unit("m" + " " * 63 + "m")
    assert refused.value.message == "A unit has at most 64 characters, this one 65."


def test_everyday_units_do_not_load_pint() -> None:
    code = "import sys; from teds_provision.teds.units import parse_unit as p\n"
    code += "p('degree'), p('N'); print('pint' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


@pytest.mark.parametrize(
    ("texts", "interpretation", "bases", "scale", "offset"),
    [
        ("1 count counts LSB", 0, "", 1.0, 0.0),
        ("digital bit bits boolean state", 4, "", 1.0, 0.0),
        ("arbitrary a.u. arb", 5, "", 1.0, 0.0),
        ("% percent", 1, "", 0.01, 0.0),
        ("ratio", 1, "", 1.0, 0.0),
        ("ppm", 1, "", 1e-6, 0.0),
        ("strain m/m mm/mm", 1, "meters", 1.0, 0.0),
        ("microstrain ustrain µε um/m µm/m", 1, "meters", 1e-6, 0.0),
        ("dB decibel", 3, "", 0.1, 0.0),
    ],
)
def test_what_is_no_product_of_si_units(
    texts: str, interpretation: int, bases: str, scale: float, offset: float
) -> None:
    for text in texts.split():
        unit = u.parse_unit(text)
        assert unit.units == Units(interpretation, **dict.fromkeys(bases.split(), Fraction(1))), text  # type: ignore[arg-type]
        assert (unit.scale, unit.offset) == (pytest.approx(scale), offset), text
    volts = {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -1}
    assert u.parse_unit("mV/V").units == Units(1, **{base: Fraction(n) for base, n in volts.items()})
    assert (u.parse_unit("mV/V").scale, u.parse_unit("dBm").to_si(0.0)) == (pytest.approx(1e-3), -3.0)


@pytest.mark.parametrize(
    ("names", "seconds"),
    [
        ("d day days", 86_400),
        ("week weeks", 604_800),
        ("month months", 2_629_746),
        ("year years", 31_556_952),
        ("h hour hours", 3600),
        ("min minute minutes", 60),
        ("s second seconds", 1),
        ("ms", 1e-3),
        ("us µs", 1e-6),
        ("ns", 1e-9),
    ],
)
def test_every_name_of_a_time(names: str, seconds: float) -> None:
    """A year has 365.2425 days, a month a twelfth of them."""
    for name in names.split():
        assert u.parse_seconds(f"3 {name}") == pytest.approx(3 * seconds), name


def test_exponents_of_a_teds_are_halves_from_64_below_to_63_and_a_half_above() -> None:
    for text, exponent in (("m**63.5", Fraction(127, 2)), ("m**-64", Fraction(-64)), ("m^0.5", Fraction(1, 2))):
        assert exponents(text) == {"meters": exponent}
    for text in ("m**64", "m**-64.5", "m**63.5*m"):
        with pytest.raises(BadDataError, match=r"a TEDS can say halves from -64 to 63\.5"):
            u.parse_unit(text)


@pytest.mark.parametrize(
    ("scale", "offset", "name"),
    [
        (1.0, 0.0, "K"),
        (1.0, 273.15, "°C"),
        (5 / 9, 459.67 * 5 / 9, "°F"),
        (2.0, 0.0, "(× 2 K)"),
        (2.0, 1.5, "(× 2 K + 1.5)"),
        (1.0, 273.0, "(× 1 K + 273)"),
        (5 / 9, 0.0, "(× 0.5555556 K)"),
        (1.0 + 1e-7, 273.15, "°C"),
        (1.0 + 1e-5, 273.15, "(× 1.00001 K + 273.15)"),
    ],
)
def test_a_conversion_has_its_usual_name_or_is_called_after_its_scale(scale: float, offset: float, name: str) -> None:
    assert u.recognize(u.parse_units("K"), scale, offset).text == name


def test_a_difference_is_shown_without_an_offset_and_keeps_its_sign() -> None:
    kelvin = u.display_unit(u.parse_units("K"))
    assert [u.format_value(value, kelvin, difference=True) for value in (2.0, -2.0)] == ["2 °C", "-2 °C"]
    falling = u.WrittenUnit("x", u.parse_units("K"), -2.0, 5.0)
    assert [u.format_value(value, falling, difference=True) for value in (2.0, -2.0)] == ["1 x", "-1 x"]
    assert u.format_value(123.456789, falling, digits=3) == "-59.2 x"
