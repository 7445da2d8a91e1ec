"""Findings say where, what was asked and what stands there; warnings leave the verdict alone."""

from __future__ import annotations

import math
import struct
import tracemalloc
from fractions import Fraction

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec import decode as decode_module
from teds_provision.teds.codec.frame import frame, raw_tuple
from teds_provision.teds.codec.model import Edition
from tests.protocol.operation.kat import KAT
from tests.teds.vectors import octets_of

CHANNEL = {
    "CalKey": 0,
    "ChanType": 0,
    "PhyUnits": teds.Units(kelvins=1),
    "LowLimit": 1.0,
    "HiLimit": 2.0,
    "OError": 0.5,
    "SelfTest": 0,
    "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 32},
}


EDITIONS: tuple[Edition, ...] = (2007, 2024)


def block(access_code: int, *parts: bytes) -> bytes:
    return frame(bytes([3, 4, 0, access_code, 1, 1]) + b"".join(parts))


def codes(octets: bytes) -> dict[str, str]:
    return {finding.code: finding.severity for finding in teds.decode(octets).findings}


def only(octets: bytes, code: str) -> teds.Finding:
    found = [finding for finding in teds.decode(octets).findings if finding.code == code]
    assert len(found) == 1
    return found[0]


def test_a_wrong_checksum_says_both() -> None:
    finding = only(octets_of("n07_bad_checksum"), "frame-checksum")
    assert (finding.offset, finding.asked, finding.found) == (27, "FAF5", "FAF4")


def test_a_wrong_length_says_both() -> None:
    finding = only(octets_of("n07_bad_length"), "frame-length")
    assert (finding.offset, finding.field, finding.asked, finding.found) == (0, "Length", "25", "26")


def test_octets_behind_the_checksum_are_named_and_the_teds_is_read() -> None:
    octets = octets_of("x07_name") + b"\xff" * 7
    decoded = teds.decode(octets)
    assert decoded.verdict == "frame-bad"
    assert decoded.get("TCName") == "boiler-inlet"
    assert only(octets, "frame-trailing").offset == 29
    assert teds.recompose(decoded) == octets_of("x07_name")


def test_a_tuple_that_runs_over_is_named() -> None:
    finding = only(octets_of("n07_overrun"), "not-closed")
    assert (finding.offset, finding.asked, finding.found) == (13, "5", "40")


def test_swapped_limits_are_an_error() -> None:
    octets = teds.compose(3, {**CHANNEL, "LowLimit": 3.0})
    assert teds.decode(octets).verdict == "content-nonconformant"
    finding = only(octets, "limits")
    assert finding.field == "LowLimit"
    assert octets[finding.offset] == 13


def test_not_available_is_a_warning() -> None:
    octets = teds.compose(3, {**CHANNEL, "OError": float("nan")})
    assert bytes.fromhex("0f047fffffff") in octets
    assert teds.decode(octets).verdict == "clean"
    assert only(octets, "not-available").field == "OError"


def test_infinity_is_a_warning() -> None:
    assert codes(teds.compose(3, {**CHANNEL, "HiLimit": float("inf")}))["infinite"] == "warning"


@pytest.mark.parametrize(
    ("field", "value", "severity"),
    [("ChanType", 9, "error"), ("SelfTest", 7, "error"), ("CalKey", 2, "warning"), ("DataXmit", 99, "warning")],
)
def test_illegal_values_are_errors_if_the_table_is_sure(field: str, value: int, severity: str) -> None:
    octets = teds.compose(3, {**CHANNEL, field: value})
    assert only(octets, "enumeration").severity == severity


def test_sample_that_does_not_fit_its_model() -> None:
    sample = {"DatModel": 1, "ModLenth": 2, "SigBits": 16}
    assert codes(teds.compose(3, {**CHANNEL, "Sample": sample}))["sample"] == "warning"
    sample = {"DatModel": 0, "ModLenth": 1, "SigBits": 12}
    assert only(teds.compose(3, {**CHANNEL, "Sample": sample}), "sample").field == "SigBits"


@pytest.mark.parametrize(
    ("modes", "default", "good"),
    [
        (0x1F, 16, True),
        (0x08, 8, True),
        (1, 5, True),
        (0x10, 1, True),
        (1, 16, False),
        (0x10, 8, False),
        (1, 0, False),
        (0x1F, 0, False),
        (0x1F, 6, False),  # two bits
        (0x1F, 24, False),
        (0x3F, 32, False),  # a bit of the mask that is no mode
    ],
)
def test_default_mode_is_a_bit_of_the_mask_or_a_number(modes: int, default: int, good: bool) -> None:
    octets = teds.compose(3, {**CHANNEL, "Sampling": {"SampMode": modes, "SDefault": default}})
    assert ("sampling" not in codes(octets)) == good


def test_out_of_order_and_repeated_fields_are_warnings() -> None:
    octets = block(12, raw_tuple(5, b"x"), raw_tuple(4, b"\0"), raw_tuple(4, b"\0"))
    assert codes(octets) == {"order": "warning", "repeated": "warning"}
    assert teds.decode(octets).verdict == "clean"


def test_missing_fields_are_warnings() -> None:
    assert {f.field for f in teds.decode(block(1)).findings} == {"UUID", "OholdOff", "TestTime", "MaxChan"}
    assert teds.decode(block(1)).verdict == "clean"


def test_both_numberings_of_the_name_are_read() -> None:
    octets = block(12, raw_tuple(10, b"\0"), raw_tuple(11, b"pump"))
    decoded = teds.decode(octets)
    assert (decoded.get("Format"), decoded.get("TCName")) == (0, "pump")
    assert decoded.verdict == "clean"
    assert codes(octets) == {"numbering": "warning"}
    assert teds.recompose(decoded) == octets


def test_a_name_that_is_no_utf8_keeps_its_octets() -> None:
    octets = block(12, raw_tuple(4, b"\0"), raw_tuple(5, b"\xff\xfe"))
    assert teds.decode(octets).get("TCName") == b"\xff\xfe"
    assert codes(octets) == {"text": "warning"}


def test_an_unknown_field_is_an_error_in_a_class_that_is_known_and_none_elsewhere() -> None:
    assert codes(block(1, raw_tuple(99, b"\1")))["unknown"] == "error"
    assert codes(block(5, raw_tuple(99, b"\1")))["unknown"] == "note"
    assert codes(block(8, raw_tuple(99, b"\1"))) == {"unverified": "note"}
    assert codes(block(1, raw_tuple(200, b"\1")))["manufacturer"] == "note"


def test_an_extension_octet_of_80_means_none() -> None:
    with_80 = octets_of("w24_ubi_chan")
    assert with_80[4 + 7 + 6 + 2 + 10] == 0x80
    units = teds.decode(with_80).get("PhyUnits")
    assert isinstance(units, teds.Units)
    assert units.extension == 0
    assert teds.recompose(teds.decode(with_80)) == with_80


PACKED = "00 80 80 84 82 7a 7e 80 80 80"
"""Volt: m² kg s⁻³ A⁻¹."""


@pytest.mark.parametrize(
    ("spelling", "extension"),
    [
        (PACKED, 0),
        (f"{PACKED} 00", 0),
        (f"{PACKED} 80", 0),
        (f"{PACKED} 0f", 15),
        (f"{PACKED} 81", 0x81),
        ("320100 350184 360182 37017a 38017e", 0),
        ("320100 350184 360182 37017a 38017e 3c0100", 0),
        ("320100 350184 360182 37017a 38017e 3c0180", 0),
        ("38017e 37017a 3c010f 360182 350184 320100", 15),
    ],
)
@pytest.mark.parametrize("edition", EDITIONS)
def test_units_are_read_in_each_spelling_in_both_fields_and_editions(
    spelling: str, extension: int, edition: Edition
) -> None:
    units = bytes.fromhex(spelling)
    volt = teds.Units(meters=2, kilograms=1, seconds=-3, amperes=-1, extension=extension)
    head = bytes.fromhex("030400030101" if edition == 2007 else "030500ff030201")
    decoded = teds.decode(frame(head + raw_tuple(12, units) + raw_tuple(19, raw_tuple(46, units))))
    assert decoded.edition == edition
    assert decoded.get("PhyUnits") == volt
    [data_set] = [field for field in decoded.fields if field.name == "DataSet"]
    assert [(child.name, child.value) for child in data_set.children] == [("SUnits", volt)]


@pytest.mark.parametrize(
    ("edition", "extension", "spelling"),
    [
        (2007, 0, "320101 390181"),
        (2007, 15, "320101 390181 3c010f"),
        (2024, 0, "01 80 80 80 80 80 80 81 80 80 00"),
        (2024, 15, "01 80 80 80 80 80 80 81 80 80 0f"),
    ],
)
def test_units_are_written_as_tuples_without_what_is_absent_or_packed_with_all(
    edition: Edition, extension: int, spelling: str
) -> None:
    units = teds.Units(1, kelvins=Fraction(1, 2), extension=extension)
    octets = teds.compose(3, {"PhyUnits": units, "DataSet": {"SUnits": units}}, edition=edition)
    raw = bytes.fromhex(spelling)
    assert raw_tuple(12, raw) in octets
    assert raw_tuple(19, raw_tuple(46, raw)) in octets


@pytest.mark.parametrize("missing", [None, math.nan, -math.nan])
def test_what_is_not_available_is_written_as_the_one_nan_of_the_teds(missing: float | None) -> None:
    assert bytes.fromhex("0d04 7fffffff") in teds.compose(3, {**CHANNEL, "LowLimit": missing})
    assert bytes.fromhex("2608 7fffffff 3f800000") in teds.compose(3, {**CHANNEL, "DAngles": [missing, 1.0]})
    assert bytes.fromhex("8108 3f800000 7fffffff") in teds.compose(5, {"Coefs": [1.0, missing]})


def test_free_form_end_user_data_is_kept() -> None:
    octets = block(7, b"Calibrated by hand, see the binder in room 4")
    decoded = teds.decode(octets)
    assert decoded.verdict == "clean"
    assert decoded.text == (b"Calibrated by hand, see the binder in room 4",)
    assert teds.recompose(decoded) == octets


def test_a_class_without_a_table_keeps_its_tuples_raw() -> None:
    for access_code in (8, 9, 17, 99, 129, 255):
        decoded = teds.decode(block(access_code, raw_tuple(10, b"\1\2"), raw_tuple(250, b"")))
        assert [(field.type, field.name, field.raw) for field in decoded.fields[1:]] == [
            (10, "", b"\1\2"),
            (250, "", b""),
        ]
        assert decoded.verdict == "clean"


@pytest.mark.parametrize("octets", [b"", b"\0", b"\3", b"\3\4", b"\0\0\0\2\0\0", b"\xff" * 64, b"\0" * 64])
def test_erased_and_empty_memory_is_no_teds(octets: bytes) -> None:
    assert teds.decode(octets).verdict not in {"clean", "block-clean"}


@pytest.mark.parametrize("width", [0, 5, 255])
def test_an_unknown_tuple_width_is_an_error(width: int) -> None:
    octets = frame(bytes([3, 4, 0, 12, 1, width, 4, 1, 0]))
    assert codes(octets)["tuple-width"] == "error"


def test_errors_count_even_behind_a_flood_of_notes() -> None:
    flood = b"".join(raw_tuple(200, b"") for _ in range(5000))
    decoded = teds.decode(frame(bytes.fromhex("030400010101") + flood + raw_tuple(99, b"")))
    assert decoded.verdict == "content-nonconformant"
    assert len(decoded.findings) < 3000


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"\xc8\x00" * 4_000_000, marks=pytest.mark.slow),
        b"\x0e\x00" * 4_000_000,
        b"\x81\x04" + struct.pack(">f", 1.0),
        pytest.param(bytes(9_000_000), marks=pytest.mark.slow),
        b"\x0c\xfe" + b"\x32\x00" * 127,
    ],
)
def test_hostile_octets_cost_memory_in_bounds(content: bytes) -> None:
    octets = frame(bytes.fromhex("030400010101") + content)
    tracemalloc.start()
    teds.decode(octets)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * len(octets) + 64_000_000


def test_too_many_octets_are_not_walked() -> None:
    decoded = teds.decode(bytes.fromhex("030400010101") + bytes(17 << 20))
    assert decoded.verdict == "malformed"
    assert decoded.fields == ()


def test_strict_names_the_octet() -> None:
    with pytest.raises(BadDataError, match="octet 27"):
        teds.decode(octets_of("n07_bad_checksum"), strict=True)


@pytest.mark.parametrize("access_code", [0, 16, 17, 18, 127])
def test_classes_that_the_edition_does_not_have_are_noted(access_code: int) -> None:
    assert codes(block(access_code))["class"] == "note"


@pytest.mark.parametrize("version", [3, 4, 5])
def test_a_bare_block_of_a_later_version_is_a_block(version: int) -> None:
    decoded = teds.decode(bytes([3, 5, 0, 255, 3, version, 1, 10, 1, 0]))
    assert not decoded.framed
    assert decoded.get("CalKey") == 0


def sample(model: int, octets: int, bits: int | None) -> dict[str, object]:
    form = {"DatModel": model, "ModLenth": octets}
    return {"Sample": form if bits is None else {**form, "SigBits": bits}}


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"PhyUnits": teds.Units(4)}, None),
        ({"PhyUnits": teds.Units(5)}, None),
        ({"PhyUnits": teds.Units(4, extension=15)}, None),
        ({"PhyUnits": teds.Units(4, kelvins=1)}, "units"),
        ({"PhyUnits": teds.Units(5, radians=1)}, "units"),
        ({"PhyUnits": teds.Units(3, kelvins=1)}, None),
        ({"PhyUnits": teds.Units()}, None),
        ({"LowLimit": 2.0, "HiLimit": 2.0}, None),
        ({"LowLimit": 2.5, "HiLimit": 2.0}, "limits"),
        ({"OError": 0.0}, None),
        ({"OError": -0.5}, "negative"),
        (sample(0, 8, 64), None),
        (sample(0, 9, 64), "sample"),
        (sample(0, 2, 17), "sample"),
        (sample(1, 4, 32), None),
        (sample(1, 8, 32), "sample"),
        (sample(2, 8, 64), None),
        (sample(2, 4, 64), "sample"),
        (sample(3, 2, 17), "sample"),
        (sample(4, 2, 99), None),
        (sample(5, 8, 64), "sample"),
        (sample(5, 9, 72), None),
        (sample(5, 9, 73), "sample"),
        (sample(5, 255, 2040), None),
        (sample(6, 8, 64), "sample"),
        (sample(6, 9, 73), "sample"),
        (sample(6, 255, 2040), None),
        (sample(7, 8, 64), None),
        (sample(7, 4, 32), "sample"),
        (sample(0, 2, None), "missing"),
    ],
)
def test_values_at_the_edge_of_the_tables(changes: dict[str, object], code: str | None) -> None:
    """Digital data and arbitrary have no exponents; octets of each data model, significant bits in them."""
    for edition in EDITIONS:  # units spelled as tuples, and packed
        octets = teds.compose(3, {**CHANNEL, "Sampling": {"SampMode": 1}, **changes}, edition=edition)
        assert set(codes(octets)) == ({code} if code else set())


@pytest.mark.parametrize(("nanoseconds", "late"), [(0, False), (999_999_999, False), (1_000_000_000, True)])
def test_a_time_has_less_than_a_second_of_nanoseconds(nanoseconds: int, late: bool) -> None:
    instant = (1).to_bytes(4, "big") + nanoseconds.to_bytes(4, "big")
    assert ("time" in codes(block(5, raw_tuple(10, instant)))) == late


@pytest.mark.parametrize("framed", [True, False], ids=["framed", "bare"])
def test_a_security_teds_of_ours_is_judged_framed_and_bare(framed: bool) -> None:
    octets = bytes.fromhex(KAT["security_teds"])
    assert codes(octets if framed else octets[4:-2]) == {}
    at = octets.index(b"\x69\x01", 4)  # field 105, ProfileVersion
    twice = octets[4 : at + 3] + octets[at:-2]
    assert codes(frame(twice) if framed else twice)["not-canonical"] == "error"


def test_the_largest_teds_and_the_most_tuples_are_read_and_one_more_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    block = bytes.fromhex("0304000c0101") + bytes.fromhex("c80101") * 4
    monkeypatch.setattr(decode_module, "MAX_OCTETS", len(block))
    monkeypatch.setattr(decode_module, "MAX_TUPLES", 5)
    whole = teds.decode(block)
    assert (whole.verdict, len(whole.fields)) == ("block-clean", 5)
    monkeypatch.setattr(decode_module, "MAX_TUPLES", 4)
    (found,) = [finding for finding in teds.decode(block).findings if finding.code == "too-many"]
    assert (found.message, found.offset) == ("There are more than 4 tuples; the rest is not read.", len(block) - 3)
    monkeypatch.setattr(decode_module, "MAX_OCTETS", len(block) - 1)
    refused = teds.decode(block)
    assert refused.verdict == "malformed"
    assert refused.findings[0].message == f"This has {len(block)} octets; {len(block) - 1} are read at most."


def test_beyond_the_most_findings_only_what_decides_the_verdict_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decode_module, "MAX_FINDINGS", 2)
    strange = bytes.fromhex("030400030101") + bytes.fromhex("0500") * 4
    decoded = teds.decode(strange + bytes.fromhex("0509"))
    assert decoded.verdict == "malformed"
    assert "not-closed" in {finding.code for finding in decoded.findings}
    misplaced = bytes.fromhex("030400030101") + bytes.fromhex("280100") * 4
    found = teds.decode(misplaced)
    assert [f.code for f in found.findings if f.severity == "error"] == ["top-level", "top-level"]
    assert sum(f.severity != "error" for f in found.findings) == 2, "and as many warnings and notes"
    mixed = teds.decode(misplaced + bytes.fromhex("2800") * 3 + bytes.fromhex("9600") * 5)
    assert [f.severity == "error" for f in mixed.findings].count(False) == 2, "however many errors are left out"
    assert "not-closed" in {f.code for f in teds.decode(misplaced + b"\x28\x09").findings}


def test_fields_are_the_manufacturers_from_128_on_and_never_in_a_security_teds() -> None:
    for kind, code in ((127, "unknown"), (128, "manufacturer"), (255, "manufacturer")):
        found = codes(block(1, raw_tuple(kind, b"\1")))
        assert {"unknown", "manufacturer"} & set(found) == {code}, kind
    found = codes(block(128, raw_tuple(200, b"\1")))
    assert ("manufacturer" in found, found["unknown"]) == (False, "note")
