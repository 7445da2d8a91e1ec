"""Calibration certificates (DCC): what is read, which result calibrates a channel, and what is refused."""

from __future__ import annotations

import math
import os
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError, UsageError
from teds_provision.limits import LIMITS
from teds_provision.teds.calibration import fit_points, load_calibrations
from teds_provision.teds.calibration.files import read_certified
from teds_provision.teds.certificate import CertificateChoice, CertificateReference, read_certificate_reference
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.dcc.items import UnclearItemError, items_of
from teds_provision.teds.dcc.read import DigitalCertificate, read_certificate
from teds_provision.teds.dcc.si_units import parse_si_unit, write_si_unit
from teds_provision.teds.dcc.write import Laboratory, read_laboratory, write_certificate
from teds_provision.teds.profile import Profile, load_profile
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit

from .certificates import ANGLE, EXAMPLES, POINTS, TEMPERATURE, changed

UUID = bytes.fromhex("32cd38647c53bc8b6fbe")
LEFT = CertificateChoice(item="as-left")


@pytest.fixture(scope="module")
def angle() -> Profile:
    return load_profile("magnetic-angular-position-sensor")


@pytest.fixture(scope="module")
def temperature() -> Profile:
    return load_profile("temperature-sensor")


def read(octets: bytes) -> DigitalCertificate:
    return read_certificate(octets, "c.xml")


# -- what is read ------------------------------------------------------------------------------------------------------


def test_a_certificate_is_read_with_its_device_laboratory_conditions_and_tables() -> None:
    known = read(TEMPERATURE)
    assert (known.number, known.laboratory, known.country) == ("T-2026-118", "Thermolab Example", "AT")
    assert (known.calibrated, known.issued) == (date(2026, 9, 30), date(2026, 10, 2))
    (device,) = known.devices
    assert (device.name, device.manufacturer, device.serial) == ("Temperature sensor", "Example Sensors", "S-2044")
    assert [(condition.name, condition.text) for condition in known.conditions] == [("Ambient temperature", "296.2 K")]
    assert [(table.id, table.state) for table in known.tables] == [("as-found", "as found"), ("as-left", "as left")]
    error = known.tables[1].quantities[2]
    assert error.uncertainties == (0.05, 0.05, 0.06), "expanded with k = 2, held as standard uncertainties"
    assert not known.signed
    assert known.warnings == ()


def test_points_of_raw_values_become_the_calibration_and_its_certificate_teds(angle: Profile) -> None:
    path = EXAMPLES / "angle.xml"
    made = load_calibrations(path, angle)[1]
    assert list(made.points) == POINTS
    assert made.uncertainty == pytest.approx(0.2), "U = 0.4 with k = 2"
    assert made.date == datetime(2026, 10, 12, tzinfo=UTC)
    assert made.interval == angle.channels[0].calibration.interval
    blocks = angle.build(UUID, calibration={1: made}).blocks
    reference = read_certificate_reference(blocks[1, AccessCode.CERTIFICATE])
    assert (reference.number, reference.laboratory, reference.date) == (
        "B2-2026-0042",
        "Bench 2, robot laboratory",
        "2026-10-12",
    )
    assert reference.sha256 == read_certificate(path.read_bytes(), str(path)).sha256
    assert Sheet.from_blocks(blocks).calibrations[1].certificate == reference
    without = angle.build(UUID, calibration={1: replace(made, certificate=None)}).blocks
    assert (1, AccessCode.CERTIFICATE) not in without, "a calibration of another origin has no certificate"


def test_indications_in_the_channels_unit_become_raw_numbers_by_the_profile(temperature: Profile) -> None:
    made = read_certified(TEMPERATURE, "c.xml", temperature, LEFT)[1]
    slope, intercept = 1 / 128, -40.0
    wanted = [((273.19 - 273.15 - intercept) / slope, 0.01), ((40.06 + 40) * 128, 40.0), ((80.09 + 40) * 128, 80.02)]
    assert made.points == pytest.approx([pytest.approx(pair) for pair in wanted])
    assert made.uncertainty == pytest.approx(0.06, abs=1e-6), "the largest one"
    plain = replace(temperature, channels=(_without_indication(temperature),))
    with pytest.raises(BadDataError, match="nothing states which raw number gives an indication") as caught:
        read_certified(TEMPERATURE, "c.xml", plain, LEFT)
    assert "indication = [slope, intercept]" in caught.value.hint


def _without_indication(profile: Profile):  # type: ignore[no-untyped-def]
    channel = profile.channels[0]
    return replace(channel, calibration=replace(channel.calibration, indication=None))


def test_the_date_that_a_person_names_goes_before_the_interval(tmp_path: Path, angle: Profile) -> None:
    due = datetime(2027, 1, 31, tzinfo=UTC)
    assert load_calibrations(EXAMPLES / "angle.xml", angle, due=due)[1].due == due
    csv = tmp_path / "a.csv"
    csv.write_text("# date: 2026-10-12\nraw, value\n0, 0\n65535, 6\n")
    assert load_calibrations(csv, angle, due=due)[1].due == due, "of any calibration file"
    with pytest.raises(BadDataError, match="cannot be due on 2026-01-01"):
        load_calibrations(csv, angle, due=datetime(2026, 1, 1, tzinfo=UTC))
    csv.write_text("raw, value\n0, 0\n65535, 6\n")
    with pytest.raises(BadDataError, match="states no date"):
        load_calibrations(csv, angle, due=due)


# -- which result is meant ---------------------------------------------------------------------------------------------


def test_as_found_beside_as_left_is_never_guessed(temperature: Profile) -> None:
    with pytest.raises(UnclearItemError, match=r"2 results of c\.xml fit channel 1: as-found .*as-left") as caught:
        read_certified(TEMPERATURE, "c.xml", temperature)
    assert [item.id for item in caught.value.items] == ["as-found", "as-left"]
    assert "--item" in caught.value.hint
    found = read_certified(TEMPERATURE, "c.xml", temperature, CertificateChoice(item="as-found"))[1]
    assert found.points[0] == pytest.approx(((0.64 + 40) * 128, 0.02))
    asked: list[str] = []

    def choose(question: str, items: object) -> str:
        asked.append(f"{question}: {items}")
        return "as-left"

    left = read_certified(TEMPERATURE, "c.xml", temperature, CertificateChoice(choose=choose))[1]
    assert left.points[0][1] == 0.01
    assert "as found" in asked[0]
    assert "as left" in asked[0]
    with pytest.raises(UsageError, match="has no item 'later'"):
        read_certified(TEMPERATURE, "c.xml", temperature, CertificateChoice(item="later"))


def test_of_two_quantities_the_one_with_the_channels_unit_is_taken(angle: Profile) -> None:
    other = changed(ANGLE, ("</dcc:results>", _copy_of_the_table(r"\degree", r"\volt", "supply") + "</dcc:results>"))
    assert len(items_of(read(other))) == 2
    assert list(read_certified(other, "c.xml", angle)[1].points) == POINTS
    twice = changed(ANGLE, ("</dcc:results>", _copy_of_the_table("", "", "again") + "</dcc:results>"))
    with pytest.raises(UnclearItemError):
        read_certified(twice, "c.xml", angle)
    none = changed(ANGLE, (r"\degree", r"\volt"))
    with pytest.raises(BadDataError, match=r"No result of c.xml fits channel 1 \(degree\): channel-1: .* in V"):
        read_certified(none, "c.xml", angle)


def _copy_of_the_table(old: str, new: str, name: str) -> str:
    text = ANGLE.decode()
    start, end = text.index("<dcc:result>"), text.index("</dcc:results>")
    return text[start:end].replace("channel-1", name).replace(old, new)


def test_two_indications_of_one_table_are_two_items(angle: Profile) -> None:
    text = ANGLE.decode()
    start = text.index('<dcc:quantity refType="basic_measuredValue')
    end = text.index("</dcc:quantity>", start) + len("</dcc:quantity>")
    second = text[start:end].replace("400 16700", "401 16701").replace("Raw value", "Raw value at 30 K more")
    both = (text[:end] + second + text[end:]).encode()
    with pytest.raises(UnclearItemError, match=r"channel-1\.1 .*channel-1\.2"):
        read_certified(both, "c.xml", angle)
    assert read_certified(both, "c.xml", angle, CertificateChoice(item="channel-1.2"))[1].points[0][0] == 401


def test_an_item_may_be_named_by_its_table_if_one_result_of_it_fits(angle: Profile) -> None:
    text = ANGLE.decode()
    start = text.index('<dcc:quantity refType="basic_measuredValue')
    end = text.index("</dcc:quantity>", start) + len("</dcc:quantity>")
    second = text[start:end].replace("400 16700", "401 16701").replace("Raw value", "Raw value at 30 K more")
    both = (text[:end] + second + text[end:]).encode()
    assert [item.id for item in items_of(read(both))] == ["channel-1.1", "channel-1.2"]
    for named in ("channel-1", "channel-1.1"):
        choice = CertificateChoice(item=named, choose=lambda _question, items: items[0][0])
        assert read_certified(both, "c.xml", angle, choice)[1].points[0][0] == 400
    with pytest.raises(UnclearItemError):
        read_certified(both, "c.xml", angle, CertificateChoice(item="channel-1"))


def test_a_channel_must_be_named_if_the_type_has_several() -> None:
    hand = load_profile("tactile-finger-sensor")
    with pytest.raises(BadDataError, match=r"say which one c\.xml is for") as caught:
        read_certified(ANGLE, "c.xml", hand)
    assert "--calibration 1=c.xml" in caught.value.hint
    force = changed(ANGLE, (r"\degree", r"\newton"))
    made = read_certified(force, "c.xml", hand, CertificateChoice(channel=2))
    assert list(made) == [2]
    with pytest.raises(BadDataError, match=r"^tactile-finger-sensor has channels 1 to 12, not 13\.$"):
        read_certified(force, "c.xml", hand, CertificateChoice(channel=13))
    third = hand.channels[2]
    free = [replace(channel, calibration=replace(channel.calibration, required=False)) for channel in hand.channels]
    one = replace(hand, channels=(*free[:2], replace(third, calibration=replace(third.calibration, required=True))))
    assert list(read_certified(force, "c.xml", one)) == [3], "the only one that requires a calibration"


def test_rows_of_single_values_are_a_table_too(angle: Profile) -> None:
    rows = "".join(
        "<dcc:list>"
        f'<dcc:quantity refType="basic_measuredValue"><si:real><si:value>{raw:g}</si:value><si:unit>\\one</si:unit>'
        "</si:real></dcc:quantity>"
        f'<dcc:quantity refType="basic_referenceValue"><si:real><si:value>{value / 360:.12g}</si:value>'
        r"<si:unit>\radian</si:unit><si:expandedUnc><si:uncertainty>0.02</si:uncertainty>"
        "<si:coverageFactor>2.5</si:coverageFactor><si:coverageProbability>0.99</si:coverageProbability>"
        "</si:expandedUnc></si:real></dcc:quantity></dcc:list>"
        for raw, value in POINTS
    )
    text = ANGLE.decode()
    start, end = text.index('<dcc:list id="channel-1">'), text.index("</dcc:data>", text.index("channel-1"))
    made = read_certified((text[:start] + f'<dcc:list id="rows">{rows}</dcc:list>' + text[end:]).encode(), "c", angle)[
        1
    ]
    assert [raw for raw, _ in made.points] == [raw for raw, _ in POINTS]
    assert made.points[1][1] == pytest.approx(math.degrees(91.6 / 360))
    assert made.uncertainty == pytest.approx(math.degrees(0.008), rel=1e-3)


def test_slope_and_intercept_or_coefficients_are_taken_as_they_are(angle: Profile) -> None:
    text = ANGLE.decode()
    start, end = text.index('<dcc:list id="channel-1">'), text.index("</dcc:data>", text.index("channel-1"))

    def of(inside: str) -> bytes:
        return (text[:start] + inside + text[end:]).encode()

    number = "<dcc:quantity refType='{}'><si:real><si:value>{}</si:value><si:unit>{}</si:unit></si:real></dcc:quantity>"
    line = of(number.format("lab_slope", "0.0001", r"\radian") + number.format("lab_intercept", "0.5", r"\radian"))
    made = read_certified(line, "c", angle)[1]
    assert made.coefficients == pytest.approx((math.degrees(0.5), math.degrees(0.0001)))
    many = of(
        "<dcc:quantity refType='lab_coefficients'><si:realListXMLList><si:valueXMLList>1 0.005 1e-9</si:valueXMLList>"
        r"<si:unitXMLList>\degree</si:unitXMLList></si:realListXMLList></dcc:quantity>"
    )
    assert read_certified(many, "c", angle)[1].coefficients == pytest.approx((1, 0.005, 1e-9))


@pytest.mark.parametrize(
    ("raw", "reference", "uncertainty"),
    [
        ("200", "0.4", 100 * 90.3 / 16420),  # the steepest part is the second one
        ("20 400 20 20", "0.4", 200 * 90.3 / 16420),
        ("2", "0.4", 0.2),
        ("2", "0.1 0.8 0.1 0.1", 0.4),
    ],
)
def test_the_largest_uncertainty_counts_that_of_raw_values_by_the_steepest_part(
    raw: str, reference: str, uncertainty: float, angle: Profile
) -> None:
    """Of expanded ones with k = 2."""
    inside = (
        f"<si:expandedUncXMLList><si:uncertaintyXMLList>{raw}</si:uncertaintyXMLList>"
        "<si:coverageFactorXMLList>2</si:coverageFactorXMLList>"
        "<si:coverageProbabilityXMLList>0.95</si:coverageProbabilityXMLList></si:expandedUncXMLList>"
    )
    text = ANGLE.decode()
    end = text.index("</si:realListXMLList>", text.index("400 16700"))
    octets = (text[:end] + inside + text[end:]).replace(">0.4<", f">{reference}<").encode()
    assert read_certified(octets, "c", angle)[1].uncertainty == pytest.approx(uncertainty, rel=1e-6)


def test_a_channel_of_floats_takes_indications_in_its_unit_as_values_in_si_units(temperature: Profile) -> None:
    plain = _without_indication(temperature)
    floats = replace(plain, fields={**plain.fields, "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 32}})
    made = read_certified(TEMPERATURE, "c.xml", replace(temperature, channels=(floats,)), LEFT)[1]
    assert [raw for raw, _ in made.points] == [273.19, 313.21, 353.24]
    found = CertificateChoice(item="as-found")
    made = read_certified(TEMPERATURE, "c.xml", replace(temperature, channels=(floats,)), found)[1]
    assert [raw for raw, _ in made.points] == pytest.approx([273.79, 313.86, 353.98])


# -- units -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "ours"),
    [
        (r"\kilo\newton", "kN"),
        (r"\newton\metre", "N·m"),
        (r"\metre\second\tothe{-2}", "m/s²"),
        (r"\metre\per\second\tothe{2}", "m/s²"),
        (r"\kilogram\metre\tothe{2}\ampere\tothe{-2}\second\tothe{-3}", "Ω"),
        (r"\hecto\pascal", "hPa"),
        (r"\degreecelsius", "degC"),
        (r"\milli\volt", "mV"),
        (r"\radian\per\second", "rad/s"),
        (r"\one", "1"),
    ],
)
def test_units_of_the_d_si_are_ours(text: str, ours: str) -> None:
    unit, known = parse_si_unit(text), parse_unit(ours)
    assert (unit.units, unit.offset) == (known.units, known.offset)
    assert unit.scale == pytest.approx(known.scale)
    name, scale, offset = write_si_unit(known)
    back = parse_si_unit(name)
    assert back.to_si(3 * scale + offset) == pytest.approx(known.to_si(3)), "and back"


@pytest.mark.parametrize(
    "text", ["", "m", r"\per", r"\kilo", r"\kilo\kilo\metre", r"\tothe{2}", r"\parsec", "\\metre x"]
)
def test_what_is_no_unit_is_refused(text: str) -> None:
    with pytest.raises(BadDataError):
        parse_si_unit(text)


# -- what is refused ---------------------------------------------------------------------------------------------------

_BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("octets", "why"),
    [
        (b"", "not XML"),
        (b"<a", "not XML"),
        (b"<a/>", "no calibration certificate"),
        (changed(ANGLE, ("<dcc:digital", f"{_BOMB}<dcc:digital")), "DTD or an entity"),
        (b"<!DOCTYPE a SYSTEM 'file:///etc/passwd'><a/>", "DTD or an entity"),
        (ANGLE.decode().replace("UTF-8", "UTF-16").encode("utf-16"), "UTF-8"),
        (b'<?xml version="1.0" encoding="UTF-7"?>+ADw-a+AD4-', "UTF-8"),
        (b"<a>" * 100 + b"</a>" * 100, "nests deeper than"),
        (b"<a" + b" b='1'" * (LIMITS.xml_attributes + 1) + b"/>", "attributes in c.xml"),
        (b" " * (LIMITS.certificate + 1), "octets; at most"),
        (changed(ANGLE, ("3.2.1", "2.4.0")), "schemaVersion '2.4.0' is not known"),
        (changed(ANGLE, ("16700", "1e999")), "'1e999' is not a number"),
        (changed(ANGLE, ("16700", "9" * 400)), "is not a number"),
        (changed(ANGLE, ("16700", "NaN")), "'NaN' is not a number"),
        (changed(ANGLE, ("400 16700", "400 " * 10_001)), "values; at most"),
        (changed(ANGLE, (">2<", ">0<")), "a coverage factor is at least 1"),
        (changed(ANGLE, (">0.4<", ">-0.4<")), "an uncertainty is not negative"),
        (changed(ANGLE, (r"\degree", r"\furlong")), "is not a unit of the D-SI that is known here"),
        (changed(ANGLE, ("2026-10-12</dcc:end", "2026-13-12</dcc:end")), "a date like"),
        (
            changed(ANGLE, ("<dcc:uniqueIdentifier>B2-2026-0042</dcc:uniqueIdentifier>", "")),
            "uniqueIdentifier is missing",
        ),
        (changed(ANGLE, ("</dcc:coreData>", "</dcc:coreData><dcc:coreData/>")), "coreData: it appears twice"),
    ],
)
def test_a_hostile_or_broken_certificate_is_refused_with_its_place(octets: bytes, why: str, angle: Profile) -> None:
    with pytest.raises(BadDataError, match=r"c\.xml") as caught:
        read_certified(octets, "c.xml", angle)
    assert why in caught.value.message


def test_the_largest_certificates_that_are_read_cost_seconds(angle: Profile) -> None:
    """Many columns were paired each with each: thousands of millions of pairs of a file of 8 MiB."""
    text = ANGLE.decode()
    start, end = text.index('<dcc:list id="channel-1">'), text.index("</dcc:list>", text.index("channel-1"))
    column = (
        "<dcc:quantity><si:realListXMLList><si:valueXMLList>1 2</si:valueXMLList><si:unitXMLList>\\one</si:unitXMLList>"
        "</si:realListXMLList></dcc:quantity>"
    )
    whole = f'{text[:start]}<dcc:list id="channel-1">{column * 3_000}{text[end:]}'.encode()
    began = time.process_time()
    with pytest.raises(BadDataError, match="pairs of columns"):
        read_certified(whole, "c.xml", angle)
    assert time.process_time() - began < 10
    rows = f"<dcc:list>{column.replace('1 2', '1')}{column.replace('1 2', '2')}</dcc:list>" * 1_500
    assert read_certificate(f"{text[:start]}<dcc:list>{rows}{text[end:]}".encode(), "c.xml").tables
    assert time.process_time() - began < 10


def test_columns_of_unequal_length_make_no_points(angle: Profile) -> None:
    with pytest.raises(BadDataError, match="holds no table of indications and reference values"):
        read_certified(changed(ANGLE, ("400 16700 33120 49400", "400 16700")), "c.xml", angle)


def test_a_number_too_long_for_a_teds_is_refused_and_a_long_name_is_cut(angle: Profile) -> None:
    long = changed(ANGLE, ("Bench 2, robot laboratory", "Laboratorium für Größen " * 8))
    certificate = read_certified(long, "c.xml", angle)[1].certificate
    assert certificate is not None
    held = read_certificate_reference(certificate.encode())
    assert held.laboratory.endswith("…")
    assert held.laboratory.startswith("Laboratorium für")
    assert held.encode() == certificate.encode()
    with pytest.raises(BadDataError):
        read_certified(changed(ANGLE, ("B2-2026-0042", "9" * 180)), "c.xml", angle)
    with pytest.raises(BadDataError, match="form of the profile"):
        read_certificate_reference(CertificateReference("a", "b", "soon", "c").encode())


# -- what we write -----------------------------------------------------------------------------------------------------

NS = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
CSV = (EXAMPLES / "angle.csv").read_text()


def written(text: str = CSV, laboratory: Laboratory | None = None) -> str:
    known = read_laboratory((EXAMPLES / "laboratory.toml").read_text(), "l") if laboratory is None else laboratory
    fitted = fit_points(text, "a.csv", method="linear")
    return write_certificate(fitted, known, node="", software="1", source=text.encode(), today=date(2026, 11, 26))


def points_read_by_a_stranger(text: str, table: str) -> list[tuple[float, float]]:
    """Points of a certificate, read with the standard library and the schema's own names alone."""
    root = ET.fromstring(text)
    (found,) = (node for node in root.iterfind(".//dcc:list", NS) if node.get("id") == table)
    columns = {
        role: [float(word) for word in (node.findtext(".//si:valueXMLList", namespaces=NS) or "").split()]
        for node in found.iterfind("dcc:quantity", NS)
        for role in (node.get("refType") or "").split()
    }
    return list(zip(columns["basic_measuredValue"], columns["basic_referenceValue"], strict=True))


def test_a_stranger_and_we_read_the_same_points_from_our_certificate(angle: Profile) -> None:
    text = written()
    assert points_read_by_a_stranger(text, "channel-1") == POINTS
    assert list(read_certified(text.encode(), "c.xml", angle)[1].points) == POINTS
    known = read(text.encode())
    assert (known.number, known.devices[0].serial) == ("B2-2026-0042", "S-1007")
    assert [condition.text for condition in known.conditions] == ["23.1 °C"]


def test_the_example_is_what_the_command_writes() -> None:
    lines = [line for line in written().splitlines() if "issueDate" not in line and "release" not in line]
    kept = [line for line in ANGLE.decode().splitlines() if "issueDate" not in line and "release" not in line]
    assert lines == kept


def test_what_was_not_stated_is_written_as_not_stated() -> None:
    known = read(written(laboratory=Laboratory()).encode())
    assert (known.laboratory, known.country) == ("not stated", "ZZ")
    assert known.number.startswith("teds-provision-2026-10-12-")
    assert Laboratory().missing == ("laboratory", "country", "person", "customer", "certificate")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("labor = 1", 'Did you mean "laboratory"'),
        ("laboratory = ''", "a text of one line"),
        ("country = 'Austria'", "ISO 3166-1"),
        ("coverage-factor = 0", "a number from 1 to 10"),
        ("condition = 3", "tables"),
        ("[[condition]]\nname = 'x'", "name, value and unit"),
    ],
)
def test_a_mistake_in_the_laboratorys_file_is_named(text: str, why: str) -> None:
    with pytest.raises(BadDataError, match=why):
        read_laboratory(text, "lab.toml")


SCHEMAS = os.environ.get("DCC_SCHEMAS")


@pytest.mark.skipif(not SCHEMAS, reason="PTB's schemas are not shipped: set DCC_SCHEMAS to their folder")
def test_our_certificates_are_valid_by_the_schema() -> None:
    """The folder holds dcc_3_2_1.xsd, dsi_2_1_0.xsd and xmldsig.xsd (docs/calibration.md says where they are)."""
    from lxml import etree

    folder = Path(SCHEMAS or "")

    class ShippedSchemas(etree.Resolver):  # type: ignore[misc]
        def resolve(self, url: str, _: object, context: object) -> object:
            name = "xmldsig.xsd" if "xmldsig" in url else "dsi_2_1_0.xsd" if "SI_Format" in url else None
            return None if name is None else self.resolve_filename(str(folder / name), context)

    parser = etree.XMLParser(no_network=True)
    parser.resolvers.add(ShippedSchemas())
    schema = etree.XMLSchema(etree.parse(str(folder / "dcc_3_2_1.xsd"), parser))
    for text in (written(), written(laboratory=Laboratory()), ANGLE.decode()):
        assert schema.validate(etree.fromstring(text.encode())), schema.error_log
