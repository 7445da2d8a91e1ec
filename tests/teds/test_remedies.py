"""What a refusal of the datasheet's readers and writers says to do about it, word for word."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, date, datetime
from pathlib import Path

import pytest

from teds_provision import teds
from teds_provision.errors import TedsProvisionError
from teds_provision.teds import units
from teds_provision.teds.calibration import fit, from_decoded, load_calibrations
from teds_provision.teds.calibration.files import read_certified
from teds_provision.teds.calibration.points import Point, with_point
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.text_lines import compose_lines
from teds_provision.teds.dcc.read import read_certificate
from teds_provision.teds.dcc.si_units import parse_si_unit
from teds_provision.teds.fits import parse_fits, parse_require
from teds_provision.teds.formats.mapped import profile_from_xml
from teds_provision.teds.image import Image
from teds_provision.teds.plot import plot_blocks
from teds_provision.teds.profile import load_profile
from teds_provision.teds.units import parse_unit

from .certificates import ANGLE
from .test_profile import GOOD

XML = b"<d><c/></d>"
CAPTURED = (
    "# node: 00000000000000000001\n# date: 2026-01-01\nchannel, raw, value [N], # spread, # count\n1, 0, 0, 0, 1\n"
)


def undated(folder: Path) -> object:
    path = folder / "c.csv"
    path.write_text("0,0\n65535,360\n")
    profile = load_profile("magnetic-angular-position-sensor")
    return load_calibrations(path, profile, due=datetime(2027, 1, 1, tzinfo=UTC))


def wrong_type(folder: Path) -> object:
    path = folder / "my type.toml"
    path.write_text(GOOD.replace('"N"', '"]["'))
    return load_profile(path)


def captured(text: str, unit: str) -> str:
    point = Point(1, 1.0, 1.0, 0.0, 1)
    return with_point(text, "p.csv", point, node="00000000000000000002", unit=parse_unit(unit), today=date(2026, 1, 2))


def of_another_wire(number: int) -> object:
    values = {**security.OUR_VALUES, number: 9}
    octets = security.SecurityTeds(
        b"\4" + bytes(64), bytes(64), signature=bytes(64), station_key=b"\4" + bytes(64),
        station_key_signature=bytes(64), ca="Works:00", values=values,
    ).encode()  # fmt: skip
    return security.require_our_wire(Image(bytes(10), {(0, AccessCode.SECURITY): octets}))


REMEDIES: list[tuple[Callable[[Path], object], str, str]] = [
    (undated, "c.csv states no date, so it cannot be due on 2027-01-01.", "Add # date: to it."),
    (
        lambda _: read_certified(ANGLE, "c.xml", load_profile("tactile-finger-sensor")),
        "tactile-finger-sensor has 12 channels: say which one c.xml is for.",
        "Put its number before the file: --calibration 1=c.xml",
    ),
    (
        lambda _: fit([(float(raw), 0.0) for raw in range(8001)], "steps", channel=1),
        "A table of 8001 nodes is too large for a TEDS, which holds 8000 at most.",
        "Thin it with a tolerance (# tolerance: 0.05), or fit a polynomial.",
    ),
    (
        lambda _: from_decoded(teds.decode(teds.compose(5, {"OError": 0.5}))),
        "The Calibration TEDS of channel 0 has no inputs and coefficients that are understood here.",
        "Its field numbers are not those of docs/teds.md; the octets are kept as they are.",
    ),
    (
        lambda _: captured("raw, value\n0, 0\n", "N"),
        "p.csv is no file that capture wrote: its columns are others.",
        "Name a new file; the columns are: channel, raw, value [unit], # spread, # count.",
    ),
    (
        lambda _: captured(CAPTURED, "N"),
        "p.csv holds points of node 00000000000000000001, not of 00000000000000000002.",
        "Name another file.",
    ),
    (
        lambda _: captured(CAPTURED.replace("01\n", "02\n", 1), "degree"),
        "p.csv holds values in N; this channel's are in degree.",
        "Name another file.",
    ),
    (
        lambda _: teds.compose(12, {"Colour": 1}),
        "XdcrName has no field 'Colour'.",
        "It has Format, TCName.",
    ),
    (
        lambda _: teds.decode(teds.compose(12, {"Format": 0, "TCName": "a"})[:-1] + b"\0", strict=True),
        "The checksum is FF00, the octets give FF70. (octet 16)",
        "The verdict of this TEDS is frame-bad.",
    ),
    *(
        (
            lambda _, number=number: of_another_wire(number),
            f"The image names {name} 9; {ours} is spoken here.",
            "It is of a time before this wire; nothing of it was released. Read or build the datasheet again.",
        )
        for number, name, ours in (
            (security.PROFILE_VERSION, "ProfileVersion", security.OUR_VALUES[security.PROFILE_VERSION]),
            (security.SESSION_SUITE, "SessionSuite", security.OUR_VALUES[security.SESSION_SUITE]),
            (security.KEY_AGREEMENT, "KeyAgreement", security.OUR_VALUES[security.KEY_AGREEMENT]),
        )
    ),
    (
        lambda _: compose_lines(130, {"a": "x" * 254}),
        "The lines of a TEDS have at most 255 octets, these have 257.",
        "Shorten the longest of them.",
    ),
    (
        lambda _: read_certificate(b"<d/>", "c.xml"),
        "c.xml: this XML is no calibration certificate: its root is 'd'.",
        "A DCC begins with dcc:digitalCalibrationCertificate.",
    ),
    (
        lambda _: parse_si_unit("metre"),
        '"metre" is not a unit of the D-SI.',
        r"A certificate writes units like \degreecelsius, \newton\metre.",
    ),
    *(
        (
            lambda _, text=text: parse_fits(text),
            f"An expression has 1 to 16 terms, this one {count}.",
            'Write it like "angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz".',
        )
        for text, count in ((" , ", 0), ("rate > 1," * 17, 17))
    ),
    (
        lambda _: parse_fits("angle is large"),
        '"angle is large" is no bound.',
        'Write a name, one of >= <= > <, and a value: "rate >= 1 kHz".',
    ),
    (
        lambda _: parse_require("", "r.toml"),
        "r.toml: it asks for nothing.",
        'Write a table such as [angle] with range = ">= 360 deg".',
    ),
    (
        lambda _: parse_require("angle = 3\n", "r.toml"),
        "r.toml: [angle] is no table of bounds.",
        '[angle] with range = ">= 360 deg"',
    ),
    (
        lambda _: parse_require('[angle]\nwidth = "1"\n', "r.toml"),
        'r.toml: [angle]: there is no bound "width".',
        "Known are low, high, range, uncertainty, rate, angle.",
    ),
    (
        lambda _: parse_require('[angle]\nrange = ">= 1 ]["\n', "r.toml"),
        'r.toml: [angle]: "][" is not a unit.',
        'Write it like "degree", "N", "mm", "degC", "m/s²", "mV/V" or "count".',
    ),
    (
        lambda _: profile_from_xml(XML, "channels = 3\n", name="x"),
        "the mapping: unknown key 'channels'.",
        "Known are channel, channel-keys, channel-values, keys, values.",
    ),
    (
        lambda _: profile_from_xml(XML, "", name="x"),
        "the mapping: channel is missing.",
        'Name the elements of channels: channel = "Channel"',
    ),
    (
        lambda _: profile_from_xml(b"<!DOCTYPE d>" + XML, 'channel = "c"\n', name="x"),
        "the XML has a DTD or entities, which are not read.",
        "Remove the DOCTYPE.",
    ),
    (
        lambda folder: plot_blocks({}, folder / "x.pdf"),
        '"x.pdf" is no picture that can be drawn.',
        "Let its name end in .png or .svg.",
    ),
    (
        lambda _: parse_unit("m**64"),
        'The unit "m**64" has the exponent 64 of meters; a TEDS can say halves from -64 to 63.5.',
        'Describe the channel in another unit, or as "arbitrary".',
    ),
]


@pytest.mark.parametrize(("refused_by", "message", "hint"), REMEDIES, ids=[row[1][:40] for row in REMEDIES])
def test_a_refusal_says_what_to_do(
    refused_by: Callable[[Path], object], message: str, hint: str, tmp_path: Path
) -> None:
    with pytest.raises(TedsProvisionError) as refused:
        refused_by(tmp_path)
    assert (refused.value.message.replace(f"{tmp_path}/", ""), refused.value.hint) == (message, hint)


def test_a_wrong_type_is_answered_with_the_command_that_names_every_mistake(tmp_path: Path) -> None:
    with pytest.raises(TedsProvisionError) as refused:
        wrong_type(tmp_path)
    assert refused.value.hint == f"See all of them with: teds-provision profile check '{tmp_path}/my type.toml'"


def test_a_rare_unit_is_answered_with_how_units_look_and_with_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(units, "_registry", lambda: None)
    with pytest.raises(TedsProvisionError) as refused:
        parse_unit("furlong/fortnight")
    start = 'Write it like "degree", "N", "mm", "degC", "m/s²", "mV/V" or "count". A rare unit needs pint. '
    assert refused.value.hint.startswith(start)
