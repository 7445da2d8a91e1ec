"""Rules of reading certificates (DCC), clause by clause: columns, units, uncertainties, names, states, our own ones."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import date

import pytest

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration import Calibration, fit_points
from teds_provision.teds.calibration.files import read_certified
from teds_provision.teds.certificate import CertificateChoice
from teds_provision.teds.dcc.items import UnclearItemError, items_of
from teds_provision.teds.dcc.read import DigitalCertificate, ResultTable, read_certificate
from teds_provision.teds.dcc.shown import ShownCertificate, points_of
from teds_provision.teds.dcc.si_units import parse_si_unit, write_si_unit
from teds_provision.teds.dcc.write import Laboratory, QuantityCondition, read_laboratory, write_certificate
from teds_provision.teds.profile import Profile, load_profile
from teds_provision.teds.units import WrittenUnit, parse_unit

from .certificates import ANGLE, changed

TEXT = ANGLE.decode()
START = TEXT.index('<dcc:list id="channel-1">')
END = TEXT.index("</dcc:data>", START)


def of(inside: str) -> bytes:
    """Return a certificate with other results."""
    return (TEXT[:START] + inside + TEXT[END:]).encode()


def listed(roles: str, values: str, unit: str = r"\degree", more: str = "") -> str:
    return (
        f"<dcc:quantity refType='{roles}'><si:realListXMLList><si:valueXMLList>{values}</si:valueXMLList>"
        f"<si:unitXMLList>{unit}</si:unitXMLList>{more}</si:realListXMLList></dcc:quantity>"
    )


def single(roles: str, value: str, unit: str = r"\degree", more: str = "") -> str:
    return (
        f"<dcc:quantity refType='{roles}'><si:real><si:value>{value}</si:value><si:unit>{unit}</si:unit>{more}"
        "</si:real></dcc:quantity>"
    )


def expanded(uncertainty: str, factor: str = "2") -> str:
    return (
        f"<si:expandedUncXMLList><si:uncertaintyXMLList>{uncertainty}</si:uncertaintyXMLList>"
        f"<si:coverageFactorXMLList>{factor}</si:coverageFactorXMLList></si:expandedUncXMLList>"
    )


def table(*columns: str, name: str = "t") -> str:
    return f"<dcc:list id='{name}'>{''.join(columns)}</dcc:list>"


def read(inside: str) -> DigitalCertificate:
    return read_certificate(of(inside), "c.xml")


def angle(unit: str = "degree", sample: Mapping[str, int] | None = None, **demand: object) -> Profile:
    """Return the angle sensor with a channel in another unit, or of other samples."""
    profile = load_profile("magnetic-angular-position-sensor")
    own = profile.channels[0]
    fields = {**own.fields, "Sample": sample or own.fields["Sample"]}
    calibration = replace(own.calibration, **{"method": "", **demand})  # type: ignore[arg-type]
    return replace(profile, channels=(replace(own, unit=parse_unit(unit), fields=fields, calibration=calibration),))


def calibrated(inside: str, profile: Profile, item: str | None = None) -> Calibration:
    return read_certified(of(inside), "c.xml", profile, CertificateChoice(item=item))[1]


# -- units -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "scale"),
    [
        *((rf"\{name}\metre", "m", 10.0**power) for name, power in {
            "deca": 1, "hecto": 2, "kilo": 3, "mega": 6, "giga": 9, "tera": 12, "peta": 15, "exa": 18, "deci": -1,
            "centi": -2, "milli": -3, "micro": -6, "nano": -9, "pico": -12, "femto": -15, "atto": -18,
        }.items()),
        *((rf"\{name}", unit, scale) for name, unit, scale in (
            ("one", "1", 1), ("percent", "1", 0.01), ("ppm", "1", 1e-6), ("metre", "m", 1), ("kilogram", "kg", 1),
            ("gram", "kg", 1e-3), ("tonne", "kg", 1000), ("second", "s", 1), ("minute", "s", 60), ("hour", "s", 3600),
            ("day", "s", 86400), ("ampere", "A", 1), ("kelvin", "K", 1), ("mole", "mol", 1), ("candela", "cd", 1),
            ("radian", "rad", 1), ("degree", "rad", 0.017453292519943295), ("arcminute", "rad", 2.908882086657216e-4),
            ("arcsecond", "rad", 4.84813681109536e-6), ("hertz", "1/s", 1), ("newton", "N", 1), ("pascal", "Pa", 1),
            ("bar", "Pa", 1e5), ("joule", "N·m", 1), ("watt", "W", 1), ("coulomb", "C", 1), ("volt", "V", 1),
            ("farad", "F", 1), ("ohm", "Ω", 1), ("weber", "Wb", 1), ("tesla", "T", 1), ("henry", "H", 1),
            ("lumen", "lm", 1), ("lux", "lx", 1), ("litre", "m³", 1e-3), ("electronvolt", "N·m", 1.602176634e-19),
            ("becquerel", "1/s", 1), ("siemens", "A/V", 1),
        )),
        (r"\metre\per\milli\second", "m/s", 1000.0),
        (r"\metre\per\second\metre", "m²/s", 1.0),  # a \per is for one factor
        (r"\centi\metre\tothe{2}", "m²", 1e-4),  # a power is that of the prefix too
        (r"\kilogram\per\deci\metre\tothe{3}", "kg/m³", 1000.0),
        (r"\micro\siemens\per\centi\metre", "A/V/m", 1e-4),
        (r"\kelvin\tothe{0.5}", "K**0.5", 1.0),
    ],
)  # fmt: skip
def test_every_unit_of_the_d_si(text: str, unit: str, scale: float) -> None:
    found = parse_si_unit(text)
    assert found.units == parse_unit(unit).units
    assert (found.scale, found.offset) == (pytest.approx(scale, rel=1e-12), 0.0)


@pytest.mark.parametrize(
    ("unit", "written"),
    [
        ("degC", (r"\degreecelsius", 1.0, 0.0)),
        ("K", (r"\kelvin", 1.0, 0.0)),
        ("degF", (r"\kelvin", 5 / 9, 459.67 * 5 / 9)),
        ("degree", (r"\degree", 1.0, 0.0)),
        ("N·m", (r"\newton\metre", 1.0, 0.0)),
        ("mN·m", (r"\milli\newton\metre", 1.0, 0.0)),
        ("kPa", (r"\kilo\pascal", 1.0, 0.0)),
        ("m/s²", (r"\metre\second\tothe{-2}", 1.0, 0.0)),
        ("deg/s", (r"\radian\second\tothe{-1}", 0.017453292519943295, 0.0)),
        ("count", (r"\one", 1.0, 0.0)),
        ("K**0.5", (r"\kelvin\tothe{0.5}", 1.0, 0.0)),
    ],
)
def test_how_a_unit_is_written(unit: str, written: tuple[str, float, float]) -> None:
    assert write_si_unit(parse_unit(unit)) == written


@pytest.mark.parametrize(
    "text",
    [
        *(r"\kelvin\tothe{0.3}", r"\metre\tothe{64}", r"\metre\per\per\second", r"\per\tothe{2}"),
        *(r"\metre\kilo\tothe{2}\second", r"\metre\per\tothe{2}", r"\tothe{2}", r"\kilo\tothe{2}\metre"),
        *(r"\metre\tothe{2}\tothe{2}", r"\kilo\milli\metre", r"\metre\kilo", r"\metre\per", r"\kilo\per\metre", ""),
    ],
)
def test_a_power_that_a_teds_cannot_hold_and_a_sign_without_a_unit_are_refused(text: str) -> None:
    with pytest.raises(BadDataError):
        parse_si_unit(text)


def test_a_unit_has_at_most_256_characters() -> None:
    with pytest.raises(BadDataError) as refused:
        parse_si_unit(r"\metre" + " " * 245 + r"\metre")
    assert refused.value.message == "A unit has at most 256 characters, this one 257."
    assert parse_si_unit(r"\metre" + " " * 244 + r"\metre").units == parse_unit("m²").units
    assert parse_si_unit(" " * 300 + r"\metre").units == parse_unit("m").units, "blanks around it are no part of it"


# -- columns -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("roles", "pairs"),
    [
        (("x_measuredValue", "y_referenceValue"), ["01"]),
        (("x_indicatedValue", "y_referenceValue"), ["01"]),
        (("x_INDICATION", "y_REFERENCEVALUE"), ["01"]),
        (("a measuredValue", "referenceValue b"), ["01"]),
        (("", ""), ["10", "01"]),
        (("", "referenceValue"), ["01"]),
        (("measuredValue", ""), ["01"]),
        (("measuredValue", "referenceValue", ""), ["01"]),
        (("indicatedValue", "referenceValue", ""), ["01"]),
        (("indication", "referenceValue", ""), ["01"]),
        (("measuredValue", "measuredValue", "referenceValue"), ["02", "12"]),
        *(
            (("", "", aside), ["10", "01"])
            for aside in (
                *("x_nominalValue", "x_calibrationValue", "x_correction", "x_uncertainty", "x_residual"),
                *("x_fittedValue", "x_measurementError", "x_error", "x_deviation"),
            )
        ),
    ],
)  # fmt: skip
def test_which_columns_are_indications_and_reference_values(roles: tuple[str, ...], pairs: list[str]) -> None:
    """Each pair: places of the indication and of the reference value."""
    found = items_of(read(table(*(listed(role, f"{place} 9") for place, role in enumerate(roles)))))
    assert [
        f"{item.indicated.values[0]:.0f}{item.reference.values[0]:.0f}" for item in found if item.indicated
    ] == pairs
    assert [item.id for item in found] == (["t"] if len(pairs) == 1 else [f"t.{n}" for n in range(1, len(pairs) + 1)])


def test_columns_of_one_value_or_of_another_length_make_no_points() -> None:
    assert items_of(read(table(listed("measuredValue", "1"), listed("referenceValue", "2")))) == []
    three = listed("measuredValue", "1 2 3")
    assert items_of(read(table(three, listed("referenceValue", "1 2")))) == []


@pytest.mark.parametrize(
    ("quantities", "coefficients"),
    [
        ((single("a_slope", "2"), single("a_intercept", "1")), [1.0, 2.0]),
        ((single("a_slope", "2"),), None),
        ((listed("a_slope", "2 3"), single("a_intercept", "1")), None),
        ((single("a_slope", "2"), listed("a_intercept", "1 4")), None),
        ((listed("a_coefficients", "1 2 3"), single("a_slope", "9"), single("a_intercept", "9")), [1.0, 2.0, 3.0]),
    ],
)
def test_slope_and_intercept_are_one_value_each(quantities: tuple[str, ...], coefficients: list[float] | None) -> None:
    found = items_of(read(table(*quantities)))
    assert [item.to_json()["coefficients"] for item in found] == ([] if coefficients is None else [coefficients])


def test_an_item_of_coefficients_is_titled_and_shown_by_its_unit() -> None:
    (item,) = items_of(read(table(listed("a_coefficients", "1 -2.5 1e-10"))))
    assert item.title == "Points of channel 1: coefficients, °"
    assert points_of(item) == [("c0", "1"), ("c1", "-2.5"), ("c2", "1e-10")]
    (plain,) = items_of(read(table(single("slope", "2", r"\one"), single("intercept", "1", r"\one"))))
    assert plain.title == "Points of channel 1: coefficients, plain numbers"
    assert points_of(plain) == [("c0", "1"), ("c1", "2")]
    found = table(listed("x_coefficients", "1 2")).replace("<dcc:list", "<dcc:list refType='y_beforeAdjustment'")
    (stated,) = items_of(read(found))
    assert stated.title == "Points of channel 1, as found: coefficients, °"


def test_points_that_relate_values_to_another_quantity_do_not_fit() -> None:
    inside = table(listed("measuredValue", "1 2", r"\volt"), listed("referenceValue", "3 4"))
    with pytest.raises(BadDataError) as refused:
        calibrated(inside, angle())
    assert refused.value.message.endswith("(degree): t: it relates the values to V, not to raw numbers.")


def test_of_several_results_without_an_indication_any_is_answered_with_the_key_that_states_one() -> None:
    """Whichever comes first; the others are named with what is wrong with each."""
    other = table(listed("measuredValue", "1 2", r"\one"), listed("referenceValue", "3 4", r"\newton"), name="a")
    plain = table(listed("measuredValue", "1 2", r"\one"), listed("referenceValue", "3 4", r"\one"), name="b")
    for results in (other + plain, plain + other):
        with pytest.raises(BadDataError, match=r"^No result of c\.xml fits channel 1 \(%\): ") as refused:
            calibrated(results, angle("%"))
        assert "b: nothing states which raw number gives an indication" in refused.value.message
        assert refused.value.hint == (
            "Say it in the profile, in %: [channel.1.calibration] indication = [slope, intercept]"
        )
    with pytest.raises(BadDataError) as refused:
        calibrated(other, angle("%"))
    assert refused.value.hint == "See: teds-provision show c.xml"


def test_each_coefficient_must_be_one_of_a_raw_number() -> None:
    wrong = table(single("slope", "2", r"\newton"), single("intercept", "1"))
    with pytest.raises(BadDataError, match="t: its coefficients are not those of a raw number"):
        calibrated(wrong, angle())
    with pytest.raises(BadDataError, match="t: its values are in N"):
        calibrated(table(single("slope", "2", r"\newton"), single("intercept", "1", r"\newton")), angle())


def test_an_item_is_named_by_its_own_id_or_by_that_of_its_table() -> None:
    two = [table(listed("", "400 500", r"\one"), listed("", "1 2"), name=name) for name in "ab"]
    with pytest.raises(UnclearItemError, match=r"2 results of c\.xml fit channel 1: a\.2 .*, b\.2 "):
        calibrated("".join(two), angle())
    for item in ("b", "b.2"):
        assert calibrated("".join(two), angle(), item).points == ((400, 1), (500, 2))
    with pytest.raises(BadDataError, match=r"b\.1: its values are in plain numbers"):
        calibrated("".join(two), angle(), "b.1")


def test_a_table_has_an_id_of_its_own_or_its_number_and_no_id_appears_twice() -> None:
    plain = table(listed("", "1 2"), listed("", "3 4"))
    assert [found.id for found in read(plain + plain.replace(" id='t'", "")).tables] == ["t", "2"]
    with pytest.raises(BadDataError, match=r"^The id 't' appears twice in the certificate\.$"):
        read(plain + plain)


# -- raw values and kinds of units -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "role", "more", "sample", "points"),
    [
        ("degree", "", {}, None, [(10, 1), (20, 2)]),
        ("%", "rawValue", {}, None, [(10, 100), (20, 200)]),
        ("%", "", {}, {"DatModel": 1, "ModLenth": 4, "SigBits": 32}, [(10, 100), (20, 200)]),
        ("%", "", {}, {"DatModel": 2, "ModLenth": 8, "SigBits": 64}, [(10, 100), (20, 200)]),
        ("%", "", {"indication": (10.0, 0.0)}, None, [(100, 100), (200, 200)]),
        ("%", "rawValue", {"indication": (10.0, 0.0)}, None, [(10, 100), (20, 200)]),
        ("%", "", {}, None, None),
        ("count", "rawValue", {}, None, [(10, 1), (20, 2)]),
        ("count", "", {"indication": (0.5, 1.0)}, None, [(18, 1), (38, 2)]),
        ("count", "", {}, None, None),
    ],
)
def test_plain_numbers_are_raw_values_or_indications(
    unit: str,
    role: str,
    more: dict[str, object],
    sample: dict[str, int] | None,
    points: list[tuple[float, float]] | None,
) -> None:
    """Of a channel without a unit, or of a ratio, they are indications unless their type ends in rawValue."""
    columns = table(
        listed(f"measuredValue x_{role}", "10 20", r"\one"),
        listed("referenceValue", "1 2", r"\degree" if unit == "degree" else r"\one"),
    )
    profile = angle(unit, sample, **more)
    if points is None:
        with pytest.raises(BadDataError, match="nothing states which raw number gives an indication"):
            calibrated(columns, profile)
    else:
        assert calibrated(columns, profile).points == tuple(points)


def test_raw_values_of_a_plain_channel_have_the_uncertainty_that_the_curve_makes_of_it() -> None:
    """It counted as one of the calibrated values: 40 raw steps became 40 counts, or 4000 %."""
    columns = table(
        listed("measuredValue x_rawValue", "100 200 300", r"\one", expanded("40")),
        listed("referenceValue", "1 2 5", r"\one", expanded("0.1")),
    )
    assert calibrated(columns, angle("count")).uncertainty == pytest.approx(20 * 3 / 100)
    assert calibrated(columns, angle("%")).uncertainty == pytest.approx(20 * 300 / 100)
    (item,) = items_of(read(columns))
    assert item.to_json()["uncertainty"] == 0.05
    falling = columns.replace("1 2 5", "5 2 1")
    assert calibrated(falling, angle("count")).uncertainty == pytest.approx(20 * 3 / 100), "the steepest part falls"
    percent = table(
        listed("measuredValue x_rawValue", "10000 20000 30000", r"\percent", expanded("4000")),
        listed("referenceValue", "1 2 5", r"\one", expanded("0.1")),
    )
    assert calibrated(percent, angle("count")).points == ((100, 1), (200, 2), (300, 5))
    assert calibrated(percent, angle("count")).uncertainty == pytest.approx(20 * 3 / 100)


def test_points_come_in_the_order_of_their_raw_values() -> None:
    columns = table(listed("measuredValue", "30 10 20", r"\one"), listed("referenceValue", "3 1 2"))
    assert calibrated(columns, angle()).points == ((10, 1), (20, 2), (30, 3))


def test_an_uncertainty_is_a_difference_in_the_channels_unit() -> None:
    """1 K of 2 K with k = 2 is 1.8 degF, and not -457.87 degF."""
    columns = table(
        listed("measuredValue", "10 20", r"\one"), listed("referenceValue", "0 10", r"\degreecelsius", expanded("2"))
    )
    found = calibrated(columns, angle("degF"))
    assert found.uncertainty == pytest.approx(1.8)
    assert [value for _, value in found.points] == pytest.approx([32, 50])


# -- uncertainties -----------------------------------------------------------------------------------------------------


def _stated(path: str, **numbers: str) -> str:
    steps = path.split("/")
    inside = "".join(f"<si:{name}>{number}</si:{name}>" for name, number in numbers.items())
    return "".join(f"<si:{step}>" for step in steps) + inside + "".join(f"</si:{step}>" for step in reversed(steps))


MU = "measurementUncertaintyUnivariate"


@pytest.mark.parametrize(
    ("inside", "uncertainty", "coverage"),
    [
        ("", None, None),
        (_stated("expandedUnc", uncertainty="6", coverageFactor="3"), (2.0,), (3.0,)),
        (_stated("coverageInterval", standardUnc="6"), (6.0,), None),
        (_stated(f"{MU}/expandedMU", valueExpandedMU="6", coverageFactor="3"), (2.0,), (3.0,)),
        (_stated(f"{MU}/standardMU", valueStandardMU="6"), (6.0,), None),
        (_stated(f"{MU}/coverageIntervalMU", valueStandardMU="6"), (6.0,), None),
    ],
)
def test_an_uncertainty_in_each_form_of_the_d_si(
    inside: str, uncertainty: tuple[float, ...] | None, coverage: tuple[float, ...] | None
) -> None:
    (found,) = read(table(single("x", "1", more=inside), name="s")).tables[0].quantities
    assert (found.uncertainties, found.coverage) == (uncertainty, coverage)


def test_of_a_constant_its_standard_uncertainty_is_read() -> None:
    constant = "<si:constant><si:value>1</si:value><si:unit>\\metre</si:unit>{}</si:constant>"
    inside = constant.format("<si:valueStandardMU>0.5</si:valueStandardMU>")
    (found,) = read(table(f"<dcc:quantity>{inside}</dcc:quantity>")).tables[0].quantities
    assert (found.values, found.uncertainties, found.coverage) == ((1.0,), (0.5,), None)


@pytest.mark.parametrize(
    ("inside", "why"),
    [
        (
            single("x", "1", more=2 * _stated("coverageInterval", standardUnc="6")),
            "it states two uncertainties",
        ),
        (single("x", "1 2"), "one value is expected, not 2"),
        (listed("x", "1 2", r"\metre \kelvin"), "the values have different units, which is not read"),
        (listed("x", "1 2 3", more=expanded("1 2")), "there are 2 numbers for 3 values"),
        (listed("x", "1 2 3", more=expanded("1", "2 2")), "there are 2 numbers for 3 values"),
        (single("x", "1").replace("</dcc:quantity>", "<si:constant/></dcc:quantity>"), "it holds two values"),
        (single("x", "1", more=_stated("expandedUnc", uncertainty="6", coverageFactor="0.99")), "at least 1"),
        (single("x", "1", more=_stated("expandedUnc", uncertainty="6")), "coverageFactor is missing"),
    ],
)  # fmt: skip
def test_numbers_that_contradict_each_other_are_refused(inside: str, why: str) -> None:
    with pytest.raises(BadDataError, match=why):
        read(table(inside))


def test_the_same_unit_at_each_value_and_a_factor_at_each_uncertainty_are_read() -> None:
    many = listed("x", "1 2 3", r"\metre \metre \metre", expanded("1 2 3", "2 4 1"))
    (found,) = read(table(many)).tables[0].quantities
    assert (found.unit.text, found.uncertainties, found.coverage) == ("m", (0.5, 0.5, 3.0), (2.0, 4.0, 1.0))
    one = listed("x", "1 2 3", r"\metre", expanded("3", "2 4 1"))
    assert read(table(one)).tables[0].quantities[0].uncertainties == (1.5, 0.75, 3.0)


def test_relative_uncertainties_are_warned_about_once() -> None:
    relative = single("x", "1").replace("</dcc:quantity>", "<dcc:relativeUncertainty/></dcc:quantity>")
    assert read(table(relative, relative)).warnings == (
        "A relative uncertainty of the certificate is not read; state it with the calibrated values.",
    )


def test_of_several_units_side_by_side_one_with_an_uncertainty_is_read() -> None:
    def number(unit: str, more: str = "") -> str:
        return f"<si:real><si:value>1</si:value><si:unit>{unit}</si:unit>{more}</si:real>"

    sure = _stated("coverageInterval", standardUnc="6")
    for numbers, unit in (
        ((number(r"\metre"), number(r"\kelvin", sure)), "K"),
        ((number(r"\metre", sure), number(r"\kelvin", sure)), "m"),
        ((number(r"\furlong", sure), number(r"\kelvin")), "K"),
    ):
        hybrid = f"<dcc:quantity><si:hybrid>{''.join(numbers)}</si:hybrid></dcc:quantity>"
        (found,) = read(table(hybrid)).tables[0].quantities
        assert found.unit.text == unit
    with pytest.raises(BadDataError, match="furlong"):
        read(table(f"<dcc:quantity><si:hybrid>{number(chr(92) + 'furlong')}</si:hybrid></dcc:quantity>"))


# -- rows, states, names ---------------------------------------------------------------------------------------------


def _row(*cells: str) -> str:
    return f"<dcc:list>{''.join(cells)}</dcc:list>"


def test_rows_are_a_table_if_they_are_alike() -> None:
    sure = _stated("coverageInterval", standardUnc="6")
    surer = _stated("coverageInterval", standardUnc="2")

    def columns(*rows: str) -> list[tuple[tuple[float, ...], tuple[float, ...] | None]]:
        found = read(table(*rows, name="rows")).tables
        return [(q.values, q.uncertainties) for part in found if part.id == "rows" for q in part.quantities]

    assert columns(_row(single("a", "1"), single("b", "2")), _row(single("a", "3"), single("b", "4"))) == [
        ((1.0, 3.0), None),
        ((2.0, 4.0), None),
    ]
    assert columns(_row(single("a", "1", more=surer)), _row(single("a", "3", more=sure))) == [((1.0, 3.0), (2.0, 6.0))]
    partly = columns(_row(single("a", "1", more=surer)), _row(single("a", "2", more=sure)), _row(single("a", "3")))
    assert partly == [((1.0, 2.0, 3.0), (6.0,))], "the largest is for all of them"
    assert columns(_row(single("a", "1"))) == [], "one row alone"
    nested = _row(single("a", "1"), _row(single("b", "2")))
    assert columns(nested, nested) == [], "a row that holds a list is a list of its own"
    assert columns(_row(single("a", "1")), _row(single("b", "3"))) == [], "another type"
    assert columns(_row(single("a", "1")), _row(single("a", "3", r"\metre"))) == [], "another unit"
    assert columns(_row(single("a", "1")), _row(listed("a", "3 4"))) == [], "more than one value"


@pytest.mark.parametrize(
    ("old", "new", "state"),
    [
        ("<dcc:list ", "<dcc:list refType='basic_beforeAdjustment' ", "as found"),
        ("<dcc:list ", "<dcc:list refType='x y_afterAdjustment' ", "as left"),
        ("<dcc:list ", "<dcc:list refType='my_lab_afterAdjustment' ", "as left"),
        ("<dcc:list ", "<dcc:list refType='beforeRepair' ", "before repair"),
        ("<dcc:list ", "<dcc:list refType='a_afterAdjustment b_beforeAdjustment' ", "as found"),
        ("<dcc:result>", "<dcc:result refType='a_afterRepair'><dcc:status>other</dcc:status>", "after repair"),
        ("<dcc:result>", "<dcc:result refType='basic_beforeRepair'>", "before repair"),
        ("<dcc:result>", "<dcc:result refType='basic_afterRepair'>", "after repair"),
        ("<dcc:result>", "<dcc:result><dcc:status>beforeAdjustment</dcc:status>", "as found"),
        ("<dcc:result>", "<dcc:result refType='a_afterRepair'><dcc:status>beforeRepair</dcc:status>", "before repair"),
        ("<dcc:result>", "<dcc:result><dcc:status>other</dcc:status>", ""),
    ],
)
def test_the_state_of_a_result_is_its_status_or_a_reference_type(old: str, new: str, state: str) -> None:
    (found,) = read_certificate(changed(ANGLE, (old, new)), "c").tables
    assert found.state == state


def test_a_result_without_a_list_is_a_table_of_its_own_quantities() -> None:
    (found,) = read(single("slope", "2") + single("intercept", "1")).tables
    assert [quantity.values for quantity in found.quantities] == [(2.0,), (1.0,)]
    assert found.name == "Points of channel 1"


def test_a_list_in_a_list_has_its_own_name_or_that_above() -> None:
    inner = _row(listed("a", "1 2"))
    named = inner.replace("<dcc:list>", "<dcc:list><dcc:name><dcc:content>inner</dcc:content></dcc:name>")
    stated = inner.replace("<dcc:list>", "<dcc:list refType='x_beforeAdjustment'>")
    assert [(t.name, t.id, t.state) for t in read(table(inner, named, stated, name="outer")).tables] == [
        ("Points of channel 1", "1", ""),
        ("inner", "2", ""),
        ("Points of channel 1", "3", "as found"),
    ]
    outer = table(stated, name="outer").replace("<dcc:list ", "<dcc:list refType='x_afterAdjustment' ", 1)
    assert [t.state for t in read(outer).tables] == ["as left"], "that of the list around it counts"
    for inside, state in ((inner, None), (stated, "as found")):
        columns = inside.replace("</dcc:list>", listed("b", "3 4") + "</dcc:list>")
        assert {item.to_json()["state"] for item in items_of(read(table(columns, name="outer")))} == {state}


def test_of_a_name_only_what_can_be_printed_is_read() -> None:
    inner = table(listed("a", "1 2")).replace(
        "<dcc:list id='t'>", "<dcc:list><dcc:name><dcc:content>in\u200bn&#xad;e&#x7f;r</dcc:content></dcc:name>"
    )
    assert [found.name for found in read(inner).tables] == ["inner"]


CONTENTS = "<dcc:content{}>D</dcc:content><dcc:content{}>E</dcc:content><dcc:content{}>F</dcc:content>"


@pytest.mark.parametrize(
    ("languages", "used", "name"),
    [
        (("de", "en", "fr"), "en", "E"),
        (("de", "en", "fr"), "fr", "F"),
        (("de", "fr", "fr"), "fr", "E"),  # the first of several
        (("de", "", "fr"), "en", "E"),  # the one without a language
        (("de", "fr", "it"), "en", "D"),  # the first
    ],
)
def test_a_name_is_in_the_language_of_the_certificate_or_without_one_or_the_first(
    languages: tuple[str, ...], used: str, name: str
) -> None:
    contents = CONTENTS.format(*(f" lang='{language}'" if language else "" for language in languages))
    octets = changed(
        ANGLE,
        ("<dcc:content>Bench 2, robot laboratory</dcc:content>", contents),
        ("<dcc:usedLangCodeISO639_1>en<", "<dcc:usedLangCodeISO639_1>de<"),
        ("<dcc:mandatoryLangCodeISO639_1>en<", f"<dcc:mandatoryLangCodeISO639_1>{used}<"),
    )
    assert read_certificate(octets, "c").laboratory == name


def test_english_goes_before_the_mandatory_language_if_the_certificate_uses_it() -> None:
    contents = CONTENTS.format(" lang='de'", " lang='en'", "")
    octets = changed(
        ANGLE,
        ("<dcc:content>Bench 2, robot laboratory</dcc:content>", contents),
        ("<dcc:mandatoryLangCodeISO639_1>en<", "<dcc:mandatoryLangCodeISO639_1>de<"),
    )
    assert read_certificate(octets, "c").laboratory == "E"


def test_facts_of_a_certificate_at_their_edges() -> None:
    def read_with(old: str, new: str) -> DigitalCertificate:
        return read_certificate(changed(ANGLE, (old, new)), "c")

    assert read_with('schemaVersion="3.2.1"', 'schemaVersion="3.1.9"').warnings == (
        "The certificate is of DCC 3.1.9; only 3.2 and 3.3 were tried.",
    )
    for version in ("3.2.0", "3.3.0", "3.3.11"):
        assert read_with('schemaVersion="3.2.1"', f'schemaVersion="{version}"').warnings == ()
    ends = "2026-10-12</dcc:endPerformanceDate>"
    assert read_with(ends, "2026-10-14Z</dcc:endPerformanceDate>").calibrated == date(2026, 10, 14)
    with pytest.raises(BadDataError, match="the calibration ends before it begins"):
        read_with(ends, "2026-10-11</dcc:endPerformanceDate>")
    with pytest.raises(BadDataError, match="it is not one line of at most 200 printable characters"):
        read_with("B2-2026-0042", "9" * 201)
    assert read_with("B2-2026-0042", "9" * 200).number == "9" * 200
    for just in ("2026-10-14", "2026-10-14Z", "2026-10-14+02:00", "2026-10-14-11:30"):
        assert read_with(ends, f"{just}</dcc:endPerformanceDate>").calibrated == date(2026, 10, 14)
    for text in ("20261014", "2026-10-14T00:00:00", "2026-10-14z", "2026-10-14 Z", "2026-10-14+2:00", "2026-10-32"):
        with pytest.raises(BadDataError) as refused:
            read_with(ends, f"{text}</dcc:endPerformanceDate>")
        assert refused.value.message.endswith(f"endPerformanceDate: a date like 2026-10-31 is expected, not {text!r}.")
    with pytest.raises(BadDataError, match=r"^c:\d+: endPerformanceDate: it is empty\.$"):
        read_with(ends, "</dcc:endPerformanceDate>")
    laboratory = "<dcc:content>Bench 2, robot laboratory</dcc:content>"
    for empty in ("", "<dcc:content> </dcc:content>"):
        with pytest.raises(BadDataError, match=r"^c:\d+: contact: its name is empty\.$"):
            read_with(laboratory, empty)
    begins = TEXT.index("<dcc:measurementResults>") + len("<dcc:measurementResults>")
    without = TEXT[:begins] + TEXT[TEXT.index("</dcc:measurementResults>") :]
    with pytest.raises(
        BadDataError, match=r"^c:\d+: digitalCalibrationCertificate: it holds no measurement results\.$"
    ):
        read_certificate(without.encode(), "c")
    other = read_with("<dcc:issuer>manufacturer<", "<dcc:issuer>customer<").devices[0]
    assert (other.serial, other.identifications) == ("", (("customer", "S-1007"),))


def test_a_certificate_is_shown_whole() -> None:
    shown = ShownCertificate.from_certificate(read_certificate(ANGLE, "c.xml"))
    assert [line for line in shown.lines() if line[0] != "sha256"] == [
        ("certificate", "B2-2026-0042"),
        ("laboratory", "Bench 2, robot laboratory, AT"),
        ("calibrated", "2026-10-12, issued 2026-11-26"),
        ("device", "magnetic angle sensor, Example Sensors MA-16, S-1007 (manufacturer)"),
        ("condition", "Ambient temperature: 23.1 °C"),
        ("signature", "not checked"),
    ]
    (item,) = shown.items
    assert item.title == "Points of channel 1: 4 points, Raw value [plain numbers] and Reference value [°]"
    assert points_of(item)[0] == ("400", "2.1")
    raws, values = listed("measuredValue", "400.25 500", r"\one"), listed("referenceValue", "80.0125 90")
    (fine,) = items_of(read(table(raws, values)))
    assert points_of(fine)[0] == ("400.25", "80.0125"), "as the certificate gives them"
    many = " ".join(map(str, range(51)))
    (long,) = items_of(read(table(listed("measuredValue", many, r"\one"), listed("referenceValue", many))))
    rows = points_of(long)
    assert (len(rows), rows[-1][0]) == (len(rows), "…")
    assert int(rows[-1][1].removesuffix(" more")) + len(rows) - 1 == 51


def test_what_a_certificate_does_not_state_leaves_no_gap_in_what_is_shown() -> None:
    bare = re.sub(r"<dcc:model>.*?</dcc:model>", "", TEXT)
    bare = re.sub(r"<dcc:manufacturer>.*?</dcc:manufacturer>", "", bare, flags=re.DOTALL)
    bare = re.sub(r"\s*<dcc:issueDate>.*?</dcc:issueDate>", "", bare)
    shown = dict(ShownCertificate.from_certificate(read_certificate(bare.encode(), "c.xml")).lines())
    assert shown["device"] == "magnetic angle sensor, S-1007 (manufacturer)"
    assert shown["calibrated"] == "2026-10-12"


def test_the_notes_of_a_read_certificate_are_its_warnings_and_what_was_not_checked() -> None:
    old = TEXT.replace('schemaVersion="3.2.1"', 'schemaVersion="3.1.9"').encode()
    certificate = read_certified(old, "c.xml", angle())[1].certificate
    assert certificate is not None
    assert certificate.notes == (
        "The certificate is of DCC 3.1.9; only 3.2 and 3.3 were tried.",
        "The certificate has no signature.",
    )
    assert certificate.signature == "not checked"


def test_a_device_is_shown_with_its_serial_number_as_data() -> None:
    for issuer, serial in (("manufacturer", "S-1007"), ("customer", None)):
        octets = changed(ANGLE, ("<dcc:issuer>manufacturer<", f"<dcc:issuer>{issuer}<"))
        shown = ShownCertificate.from_certificate(read_certificate(octets, "c.xml")).to_json()
        assert shown["devices"] == [
            {
                "name": "magnetic angle sensor",
                "manufacturer": "Example Sensors",
                "model": "MA-16",
                "serial": serial,
                "identifications": [{"issuer": issuer, "value": "S-1007"}],
            }
        ]
        assert (shown["issued"], shown["date"], shown["signature"]) == ("2026-11-26", "2026-10-12", "not checked")
        assert (shown["country"], shown["signed"], shown["not_checked"], shown["warnings"]) == ("AT", False, [], [])
        assert shown["conditions"] == [{"name": "Ambient temperature", "text": "23.1 °C"}]
    undated = re.sub(r"\s*<dcc:issueDate>.*?</dcc:issueDate>", "", TEXT)
    assert ShownCertificate.from_certificate(read_certificate(undated.encode(), "c")).to_json()["issued"] is None


def test_a_condition_without_numbers_is_not_listed() -> None:
    one = "<si:real>\n        <si:value>23.1</si:value>\n        <si:unit>\\degreecelsius</si:unit>\n       </si:real>"
    text = "<dcc:noQuantity><dcc:content>dry</dcc:content></dcc:noQuantity>"
    for inside in (text, "<si:real><si:value>23.1</si:value><si:unit>\\furlong</si:unit></si:real>"):
        assert read_certificate(changed(ANGLE, (one, inside)), "c").conditions == ()


def test_a_condition_is_shown_with_its_first_eight_numbers() -> None:
    one = "<si:real>\n        <si:value>23.1</si:value>\n        <si:unit>\\degreecelsius</si:unit>\n       </si:real>"
    for values, unit, text in (
        ("1 2 3 4 5 6 7 8", r"\pascal", "1 2 3 4 5 6 7 8 Pa"),
        ("1 2 3 4 5 6 7 8 9", r"\pascal", "1 2 3 4 5 6 7 8 … Pa"),
        ("5", r"\one", "5"),
    ):
        many = (
            f"<si:realListXMLList><si:valueXMLList>{values}</si:valueXMLList>"
            f"<si:unitXMLList>{unit}</si:unitXMLList></si:realListXMLList>"
        )
        (condition,) = read_certificate(changed(ANGLE, (one, many)), "c").conditions
        assert condition.text == text


# -- what we write -----------------------------------------------------------------------------------------------------


def written(text: str, laboratory: Laboratory, *, method: str = "linear", node: str = "") -> str:
    return write_certificate(
        fit_points(text, "a.csv", method=method),
        laboratory,
        node=node,
        software="0.3.0.dev2",
        source=b"",
        today=date(2026, 11, 26),
    )


def columns_of(text: str) -> list[tuple[str, list[float], str]]:
    """Return name, numbers and unit of each column."""
    found = re.findall(
        r"<dcc:quantity refType=.*?<dcc:content>(.*?)</dcc:content>.*?<si:valueXMLList>(.*?)</si:valueXMLList>"
        r".*?<si:unitXMLList>(.*?)</si:unitXMLList>",
        text,
        re.DOTALL,
    )
    return [(name, [float(word) for word in words.split()], unit) for name, words, unit in found]


def test_a_difference_of_temperatures_is_written_in_kelvins_without_a_zero() -> None:
    for unit, scale in (("degC", 1.0), ("degF", 5 / 9)):
        text = written(f"raw,value [{unit}]\n0,20\n1,30\n2,36\n", Laboratory())
        columns = {name: (values, stated) for name, values, stated in columns_of(text)}
        residuals, stated = columns["Reference value less fitted curve"]
        assert stated == r"\kelvin"
        assert residuals == pytest.approx([-2 * scale / 3, 4 * scale / 3, -2 * scale / 3], abs=1e-4)
        assert columns["Reference value"][1] == (r"\degreecelsius" if unit == "degC" else r"\kelvin")


def test_an_uncertainty_is_expanded_by_the_laboratorys_factor() -> None:
    points = "# uncertainty: 0.1\nraw,value [N]\n0,0\n1,1\n"
    for factor in (2.0, 2.5):
        text = written(points, replace(Laboratory(), coverage_factor=factor))
        assert f"<si:uncertaintyXMLList>{0.1 * factor:g}</si:uncertaintyXMLList>" in text
        assert f"<si:coverageFactorXMLList>{factor:g}</si:coverageFactorXMLList>" in text
    assert "expandedUnc" not in written("raw,value [N]\n0,0\n1,1\n", Laboratory())


def test_the_device_is_identified_by_its_serial_number_and_the_nodes_uuid() -> None:
    points, serial = "raw,value\n0,0\n1,1\n", replace(Laboratory(), serial="S-9")
    for laboratory, node, known in (
        (serial, "", (("manufacturer", "S-9"),)),
        (serial, "32cd", (("manufacturer", "S-9"), ("other", "32cd"))),
        (Laboratory(), "32cd", (("other", "32cd"),)),
        (Laboratory(), "", (("other", "not stated"),)),
    ):
        text = written(points, laboratory, node=node)
        assert read_certificate(text.encode(), "c").devices[0].identifications == known


@pytest.mark.parametrize(
    ("points", "method", "about", "coefficients"),
    [
        ("0,1\n2,5\n", "linear", "(x)", [1, 2]),
        ("0,0\n2,4\n4,16\n", "polynomial", "(x - 2)", [4, 4, 1]),
        ("0,0\n2,4\n4,16\n", "table", None, []),
    ],
)
def test_the_formula_of_one_segment_is_stated(
    points: str, method: str, about: str | None, coefficients: list[float]
) -> None:
    text = written(f"raw,value [N]\n{points}", Laboratory(), method=method)
    found = re.search(r"y = sum of c_i (\(.*?\))\^i in N, x the raw value: (.*)\.<", text)
    assert (found and found[1]) == about
    numbers = [float(number) for number in re.findall(r"c\d = (\S+?)(?:,|$)", found[2])] if found else []
    assert numbers == pytest.approx(coefficients)


def test_a_certificate_is_of_the_newest_day_of_its_points_and_of_today_without_one() -> None:
    dated = "# date: {}\nraw,value\n0,0\n1,1\n"
    newest = {
        number: replace(fit_points(dated.format(day), "a.csv")[1], channel=number)
        for number, day in ((1, "2026-10-12"), (2, "2026-10-14"))
    }
    text = write_certificate(newest, Laboratory(), node="", software="", source=b"", today=date(2026, 11, 26))
    assert read_certificate(text.encode(), "c").calibrated == date(2026, 10, 14)
    assert "<dcc:release>v0</dcc:release>" in text
    plain = read_certificate(written("0,0\n1,1\n", Laboratory()).encode(), "c")
    assert (plain.calibrated, plain.number) == (date(2026, 11, 26), "teds-provision-2026-11-26-e3b0c44298fc1c14")


@pytest.mark.parametrize(
    ("value", "unit", "number", "written_unit"),
    [
        (23.5, "degC", 23.5, r"\degreecelsius"),
        (68.0, "degF", 293.15, r"\kelvin"),
        (1013.0, "hPa", 1013.0, r"\hecto\pascal"),
        (45.0, "%", 0.45, r"\one"),
    ],
)
def test_a_condition_is_written_in_a_unit_of_the_d_si(
    value: float, unit: str, number: float, written_unit: str
) -> None:
    condition = QuantityCondition("around", value, parse_unit(unit))
    text = written("0,0\n1,1\n", replace(Laboratory(), conditions=(condition,)))
    inside = text[text.index("<dcc:influenceCondition>") : text.index("</dcc:influenceCondition>")]
    assert "<dcc:content>around</dcc:content>" in inside
    (stated,) = re.findall(r"<si:value>(.*?)</si:value>", inside)
    assert float(stated) == pytest.approx(number)
    assert re.findall(r"<si:unit>(.*?)</si:unit>", inside) == [written_unit]


def test_what_the_laboratory_states_of_itself_is_in_its_contact() -> None:
    known = Laboratory(laboratory="Bench 2", email="bench@lab.example", phone="+43 1 2", city="Graz", street="Inn 1")
    text = written("0,0\n1,1\n", replace(known, postcode="8010", country="AT", customer="Works"))
    contact = text[text.index("<dcc:calibrationLaboratory>") : text.index("</dcc:calibrationLaboratory>")]
    stated = re.findall(r"<dcc:(\w+)>([^<\s][^<]*)</dcc:\w+>", contact)
    assert stated == [
        ("content", "Bench 2"),
        ("eMail", "bench@lab.example"),
        ("phone", "+43 1 2"),
        ("city", "Graz"),
        ("countryCode", "AT"),
        ("postCode", "8010"),
        ("street", "Inn 1"),
    ]
    customer = text[text.index("<dcc:customer>") : text.index("</dcc:customer>")]
    assert re.findall(r"<dcc:(\w+)>([^<\s][^<]*)</dcc:\w+>", customer) == [
        ("content", "Works"),
        ("content", "not stated"),
    ]
    by_phone = written("0,0\n1,1\n", Laboratory(phone="+43 1 2"))
    assert ("eMail" in by_phone, "<dcc:phone>+43 1 2<" in by_phone) == (False, True)
    plain = written("0,0\n1,1\n", Laboratory())
    assert ("eMail" in plain, "phone" in plain, "city" in plain, "<dcc:countryCode>ZZ<" in plain) == (False,) * 3 + (
        True,
    )


@pytest.mark.parametrize(("factor", "good"), [("1", True), ("10", True), ("0.99", False), ("10.1", False)])
def test_a_coverage_factor_is_from_1_to_10(factor: str, good: bool) -> None:
    text = f"coverage-factor = {factor}"
    if good:
        assert read_laboratory(text, "l").coverage_factor == float(factor)
    else:
        with pytest.raises(BadDataError, match="a number from 1 to 10"):
            read_laboratory(text, "l")


def test_a_calibration_without_points_is_not_certified() -> None:
    bare = replace(fit_points("0,0\n1,1\n", "a.csv")[1], points=())
    with pytest.raises(BadDataError, match="The calibration of channel 1 has no points to certify"):
        write_certificate({1: bare}, Laboratory(), node="", software="1", source=b"", today=date(2026, 1, 1))


def test_tables_of_a_certificate_are_read_in_their_order() -> None:
    found: tuple[ResultTable, ...] = read(
        table(listed("", "1 2"), name="b") + table(listed("", "3 4"), name="a")
    ).tables
    assert [(part.id, part.quantities[0].values) for part in found] == [("b", (1.0, 2.0)), ("a", (3.0, 4.0))]


@pytest.mark.parametrize(("scale", "offset"), [(0.001, 273.15), (1.0, 100.0), (1.0, -273.15)])
def test_only_degrees_celsius_have_a_name_with_a_zero_of_their_own(scale: float, offset: float) -> None:
    unit = WrittenUnit("odd", parse_unit("K").units, scale, offset)
    assert write_si_unit(unit) == (r"\kelvin", scale, offset)


def test_of_what_is_no_unit_sixty_characters_are_shown() -> None:
    with pytest.raises(BadDataError) as refused:
        parse_si_unit("x" * 61)
    assert refused.value.message == f'"{"x" * 60}" is not a unit of the D-SI.'


def test_a_result_without_a_list_has_its_own_id_and_state() -> None:
    inside = of(single("slope", "2") + single("intercept", "1")).decode()
    for attributes, status, known in (
        (" id='r' refType='x_afterRepair'", "", ("r", "after repair")),
        (" id='r'", "<dcc:status>afterAdjustment</dcc:status>", ("r", "as left")),
    ):
        octets = changed(inside.encode(), ("<dcc:result>", f"<dcc:result{attributes}>{status}"))
        (found,) = read_certificate(octets, "c").tables
        assert (found.id, found.state) == known


def test_a_table_of_an_influence_condition_is_read_before_those_of_the_results() -> None:
    """What was found before an adjustment may stand there; a single number there is a condition and no table."""
    before = table(listed("", "1 2"), listed("", "3 4"), name="found")
    at = TEXT.index("<dcc:data>", TEXT.index("<dcc:influenceCondition")) + len("<dcc:data>")
    octets = (TEXT[:at] + before + TEXT[at:]).encode()
    stated = changed(octets, ("<dcc:influenceCondition>", "<dcc:influenceCondition refType='x_beforeAdjustment'>"))
    tables = read_certificate(stated, "c").tables
    assert [(part.id, part.state) for part in tables] == [("found", "as found"), ("channel-1", "")]
