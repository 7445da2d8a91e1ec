"""What compose writes to the octet, and how it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import frame, unframe
from tests.teds.vectors import octets_of

META = {"UUID": "94A964323E81FA8003E8", "OholdOff": 0.5, "TestTime": 5, "MaxChan": 2}
KELVIN = {
    "CalKey": "CAL_NONE",
    "ChanType": "sensor",
    "PhyUnits": teds.Units(kelvins=Fraction(1)),
    "LowLimit": 233.15,
    "HiLimit": 398.15,
    "OError": 0.5,
    "SelfTest": "provided",
    "Sample": {"DatModel": "Float32", "ModLenth": 4, "SigBits": 24},
    "UpdateT": 0.1,
    "RSetupT": 25e-6,
    "SPeriod": 0.1,
    "WarmUpT": 30,
    "RDelayT": 25e-6,
    "TestTime": 5,
    "Sampling": {"SampMode": 1, "SDefault": 1},
}


def test_worked_meta() -> None:
    assert teds.compose(1, META) == octets_of("x07_meta")
    group = {"GrpType": 1, "MemList": [1, 2, 3]}
    assert teds.compose(1, {**META, "MaxChan": 3, "VGroup": group}) == octets_of("x07_meta_vgroup")
    assert teds.compose(1, [("VGroup", group), *{**META, "MaxChan": 3}.items()]) == octets_of("x07_meta_vgroup")
    assert teds.compose(1, {**META, "MaxChan": 3, "VGroup": [group]}) == octets_of("x07_meta_vgroup")


def test_worked_channel_in_both_editions() -> None:
    assert teds.compose(3, KELVIN) == octets_of("x07_chan_temp_nested")
    assert teds.compose(3, KELVIN, edition=2024) == octets_of("x24_chan_temp")


def test_worked_names() -> None:
    name = {"Format": 0, "TCName": "boiler-inlet"}
    assert teds.compose(12, name) == octets_of("x07_name")
    assert teds.compose(12, name, width=2) == octets_of("x07_chan_tuple2")
    assert teds.compose(12, {"TCName": "TPM 36 UBI", "Format": "user defined"}, edition=2024) == octets_of(
        "w24_ubi_name"
    )


def test_worked_calibration_and_level() -> None:
    calibration = {
        "LstCalDt": 0x6955B900,
        "CalInrvl": 365 * 86400,
        "SIConvrt": {"Slope": 1, "Intercept": 273.15},
        "LowLimit": -40,
        "HiLimit": 125,
        "OError": 0.2,
    }
    assert teds.compose(5, calibration) == octets_of("p07_cal_provisional")
    assert teds.compose(16, {"Level": "E", "NumOfStandards": 1}, edition=2024) == octets_of("x24_security")


def test_pascal_in_both_spellings() -> None:
    pascal = {"meters": -1, "kilograms": 1, "seconds": -2}
    nested = teds.compose(3, {**KELVIN, "PhyUnits": pascal})
    packed = teds.compose(3, {**KELVIN, "PhyUnits": pascal}, edition=2024)
    assert bytes.fromhex("0c0c32010035017e360182" + "37017c") in nested
    assert bytes.fromhex("0c0b0080807e827c8080808000") in packed


def test_half_powers() -> None:
    noise = teds.Units(meters=Fraction(1, 2), seconds=Fraction(-3, 2))
    assert teds.decode(teds.compose(3, {**KELVIN, "PhyUnits": noise})).get("PhyUnits") == noise


def test_width_grows_only_if_it_must() -> None:
    assert unframe(teds.compose(5, {"Coefs": [1.0] * 63}))[5] == 1
    assert unframe(teds.compose(5, {"Coefs": [1.0] * 64}))[5] == 2
    long = teds.compose(5, {"Coefs": [0.5] * 1000})
    assert teds.decode(long).get("Coefs") == (0.5,) * 1000
    with pytest.raises(BadDataError, match="Field 129"):
        teds.compose(5, {"Coefs": [1.0] * 64}, width=1)
    with pytest.raises(BadDataError) as refused:
        teds.compose(5, {"Coefs": [1.0] * 20000})
    assert refused.value.message.startswith("Field 129 of CalTEDS has 80000 octets and does not fit tuples of 2 length")
    assert refused.value.hint == "Give a greater width, up to 4."
    assert len(teds.compose(5, {"Coefs": [1.0] * 20000}, width=3)) > 80000


def test_repeated_inputs_keep_their_order() -> None:
    inputs = [("CalInput", {"ChanNum": number, "Degree": 1}) for number in (2, 1, 3)]
    decoded = teds.decode(teds.compose(5, [("ZeroOffset", 0.5), *inputs]))
    assert [field.name for field in decoded.fields] == ["TEDSID", *["CalInput"] * 3, "ZeroOffset"]
    assert [field.children[0].value for field in decoded.fields[1:4]] == [2, 1, 3]


def test_unknown_fields_by_number() -> None:
    decoded = teds.decode(teds.compose(1, {**META, "200": b"\1\2"}))
    assert decoded.fields[-1].raw == b"\1\2"


def test_numpy_arrays_are_arrays() -> None:
    numpy = pytest.importorskip("numpy")
    octets = teds.compose(5, {"Coefs": numpy.array([1.0, 2.5])})
    assert teds.decode(octets).get("Coefs") == (1.0, 2.5)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({**META, "MaxChan": 70000}, "MaxChan goes from 0 to 65535, 70000 does not fit"),
        ({**META, "MaxChan": 65536}, "MaxChan goes from 0 to 65535, 65536 does not fit"),
        ({**META, "VGroup": {"GrpType": 256, "MemList": [1]}}, "GrpType goes from 0 to 255, 256 does not fit"),
        ({**META, "MaxChan": -1}, "MaxChan"),
        ({**META, "MaxChan": 1.5}, "MaxChan"),
        ({**META, "MaxChan": "two"}, "MaxChan"),
        ({**META, "OholdOff": "soon"}, "OholdOff"),
        ({**META, "OholdOff": 1e39}, "OholdOff"),
        ({**META, "UUID": bytes(16)}, "UUID"),
        ({**META, "UUID": "no hex"}, "UUID"),
        ({**META, "VGroup": 3}, "VGroup"),
        ({**META, "VGroup": {"GrpType": 1, "MemList": 5}}, "MemList"),
        ({**META, "VGroup": {"GrpType": 1, "MemList": [1, 70000]}}, "MemList"),
        ({**META, "VGroup": {"Members": [1]}}, "Members"),
        ({**META, "Colour": 1}, "Colour"),
        ({**META, "3": b"\0"}, "3"),
        ({**META, "200": 7}, "200"),
        ([*META.items(), ("MaxChan", 3)], "MaxChan"),
        ("MaxChan", "1"),
        ({**META, "TEDSID": b"\0"}, "TEDSID"),
        ({**META, "TEDSID": {"family": 256}}, "family"),
    ],
)
def test_refusals_name_the_field(fields: object, named: str) -> None:
    with pytest.raises(BadDataError, match=named):
        teds.compose(1, fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("numbers", [[], [1], [1, 2, 3]])
def test_a_pair_has_two_numbers(numbers: list[float]) -> None:
    with pytest.raises(BadDataError) as refused:
        teds.compose(3, {**KELVIN, "DAngles": numbers})
    assert refused.value.message == f"DAngles has two numbers, not {len(numbers)}."
    assert teds.decode(teds.compose(3, {**KELVIN, "DAngles": [1, 2]})).get("DAngles") == (1.0, 2.0)


@pytest.mark.parametrize(("value", "shown"), [(7, "7"), (None, "None"), ([0], "[0]")])
def test_a_uuid_is_octets_or_hex_digits(value: object, shown: str) -> None:
    with pytest.raises(BadDataError) as refused:
        teds.compose(1, {**META, "UUID": value})
    assert refused.value.message == f"UUID is octets, not {shown}."


@pytest.mark.parametrize(
    ("extension", "stated"), [("", 0), ("00", 0), ("80", 0), ("05", 5)], ids=["none", "0", "128", "5"]
)
def test_units_may_be_given_packed(extension: str, stated: int) -> None:
    """Interpretation, nine exponents as 128 + twice each, and an extension, which some write as 0x80 for none."""
    octets = bytes.fromhex("0080807e827c80808080" + extension)
    written = teds.decode(teds.compose(3, {**KELVIN, "PhyUnits": octets})).get("PhyUnits")
    assert written == teds.Units(meters=Fraction(-1), kilograms=Fraction(1), seconds=Fraction(-2), extension=stated)


@pytest.mark.parametrize(
    "units",
    [
        3,
        "K",
        {"kelvin": 1},
        {"kelvins": "x"},
        {"kelvins": None},
        {"kelvins": [1]},
        {"kelvins": math.inf},
        {"kelvins": math.nan},
        {"kelvins": "1/0"},
        {"meters": 100},
        {"meters": 0.3},
        {"interpretation": 300},
        b"\0" * 3,
        b"\6" + b"\x80" * 9,
    ],
)
def test_units_that_cannot_be_expressed(units: object) -> None:
    with pytest.raises(BadDataError, match="PhyUnits"):
        teds.compose(3, {**KELVIN, "PhyUnits": units})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "today", 1 << 40, teds.TimeInstance(0, 1 << 31)])
def test_times_that_cannot_be_expressed(value: object) -> None:
    with pytest.raises(BadDataError, match="LstCalDt"):
        teds.compose(5, {"LstCalDt": value})


def test_no_time_at_all_has_no_sign() -> None:
    octets = teds.compose(5, {"LstCalDt": 0})
    assert bytes.fromhex("0a08 00000000 00000000") in octets
    assert teds.decode(octets).get("LstCalDt") == teds.TimeInstance(0, 0, False)


def test_field_3_of_a_security_teds_is_no_tedsid() -> None:
    """Only there does type 3 also follow the TEDSID (security-teds.md): the encryption."""
    octets = teds.compose(128, {"UsedSecScheme": 4, "3": b"\1"})
    assert teds.decode(octets).get("UsedEncAlg") == 1
    with pytest.raises(BadDataError, match="has no field '3'"):
        teds.compose(3, {**KELVIN, "3": b"\1"})


def test_negative_times() -> None:
    octets = teds.compose(5, {"LstCalDt": -1.5})
    assert teds.decode(octets).get("LstCalDt") == teds.TimeInstance(1, 500_000_000, True)
    with pytest.raises(BadDataError, match="LstCalDt"):
        teds.compose(5, {"LstCalDt": -1.5}, edition=2024)
    length = teds.compose(5, {"CalInrvl": -1.5}, edition=2024)  # a duration has one form in both editions
    assert teds.decode(length).get("CalInrvl") == teds.TimeInstance(1, 500_000_000, True)


@pytest.mark.parametrize(
    ("access_code", "options"), [(0, {}), (256, {}), (1, {"edition": 2010}), (1, {"width": 5}), (1, {"width": 0})]
)
def test_impossible_requests(access_code: int, options: dict[str, int]) -> None:
    with pytest.raises(BadDataError):
        teds.compose(access_code, META, **options)  # type: ignore[arg-type]


def test_tedsid_may_be_given() -> None:
    octets = teds.compose(1, {**META, "UUID": bytes(16), "TEDSID": {"family": 99, "subfamily": 1}}, edition=2024)
    assert teds.decode(octets).get("TEDSID") == (99, 1, 1, 2, 1)


def test_a_tedsid_with_a_width_that_is_none_gives_tuples_of_one_length_octet_again() -> None:
    for width in (0, 5, 255):
        octets = frame(bytes.fromhex(f"0304000c01{width:02x} 040100 050161"))
        assert teds.recompose(teds.decode(octets)) == octets, width


def test_octets_in_a_structure_that_form_no_tuple_are_kept() -> None:
    octets = frame(bytes.fromhex("030400030101 1204 280100 29"))
    assert teds.decode(octets).get("DatModel") == 0
    assert teds.recompose(teds.decode(octets)) == octets


def test_a_tuple_of_one_length_octet_has_at_most_255_octets() -> None:
    for length, width in ((255, 1), (256, 2), (65535, 2)):
        octets = teds.compose(1, {**META, "200": bytes(length)})
        assert teds.decode(octets).fields[-1].raw == bytes(length)
        assert octets[9] == width, length
    for length, width in ((256, 1), (65536, 2), (65536, None)):
        with pytest.raises(BadDataError, match=f"Field 200 of MetaTEDS has {length} octets and does not fit"):
            teds.compose(1, {**META, "200": bytes(length)}, width=width)


def test_of_two_fields_of_one_name_the_first_counts_depth_first() -> None:
    inner = teds.Field(2, "x", 1, b"\1", 0)
    fields = (teds.Field(1, "a", None, b"", 0, (inner,)), teds.Field(3, "x", 2, b"\2", 0))
    decoded = replace(teds.decode(octets_of("x07_meta")), fields=fields)
    assert (decoded.field("x"), decoded.get("x"), decoded.field("y")) == (inner, 1, None)


def test_numpy_numbers_are_numbers() -> None:
    numpy = pytest.importorskip("numpy")
    fields = {**META, "MaxChan": numpy.uint16(2), "OholdOff": numpy.float32(0.5)}
    assert teds.compose(1, fields) == octets_of("x07_meta")
    with pytest.raises(BadDataError, match="MaxChan"):
        teds.compose(1, {**META, "MaxChan": numpy.float64(2)})


@pytest.mark.parametrize(("value", "shown"), [("12", "'12'"), (b"12", "b'12'"), (5, "5")])
def test_a_pair_is_a_list_of_numbers_and_no_text(value: object, shown: str) -> None:
    with pytest.raises(BadDataError) as refused:
        teds.compose(3, {**KELVIN, "DAngles": value})
    assert refused.value.message == f"DAngles is a list of numbers, not {shown}."
