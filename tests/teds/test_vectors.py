"""Every string of the vectors' index: its verdict, its problems, and what stands in it."""

from __future__ import annotations

from fractions import Fraction

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError
from tests.teds.vectors import ALL, CLEAN, TEDS, octets_of

GOOD = {"clean", "block-clean", "message"}


def test_the_index_is_whole() -> None:
    assert len(ALL) >= 67
    assert {entry["verdict"] for entry in ALL.values()} == set(teds.Conformity)
    assert all(len(octets_of(name)) == entry["octets"] for name, entry in ALL.items())


@pytest.mark.parametrize("name", ALL)
def test_verdict_is_that_of_the_index(name: str) -> None:
    assert teds.decode(octets_of(name)).verdict == ALL[name]["verdict"]


@pytest.mark.parametrize("name", TEDS)
def test_every_problem_of_the_index_is_an_error_finding(name: str) -> None:
    errors = [finding for finding in teds.decode(octets_of(name)).findings if finding.severity == "error"]
    assert len(errors) >= len(ALL[name]["problems"])
    assert bool(errors) == bool(ALL[name]["problems"])


@pytest.mark.parametrize("name", TEDS)
def test_form_and_edition_are_recognised_from_the_octets(name: str) -> None:
    decoded = teds.decode(octets_of(name))
    assert decoded.framed == (ALL[name]["form"] == "full")
    has_tedsid = name not in {"n07_no_tedsid", "f07_wanberg_chan_txt", "f07_wanberg_phy_txt"}
    assert decoded.edition == (int(ALL[name]["era"]) if has_tedsid else None)


@pytest.mark.parametrize("name", TEDS)
def test_missing_fields_and_old_versions_are_seen_but_are_no_errors(name: str) -> None:
    findings = teds.decode(octets_of(name)).findings
    for remark in ALL[name]["observations"]:
        if remark.startswith("missing: "):
            missing = {f.field for f in findings if f.code == "missing" and f.severity == "warning"}
            assert set(remark[9:].split(", ")) <= missing
        if remark.startswith("version 0"):
            assert any(f.code == "version" and f.severity == "note" for f in findings)
        if "looks like swapped octets" in remark:
            field = remark.split("=")[0]
            assert any(f.code == "swapped" and f.field == field for f in findings)
        if remark.startswith("a field type occurs more than once"):
            assert any(f.code == "repeated" for f in findings) or teds.decode(octets_of(name)).access_code is None


@pytest.mark.parametrize("name", TEDS)
def test_strict_raises_if_and_only_if_there_are_errors(name: str) -> None:
    if ALL[name]["verdict"] in GOOD:
        assert teds.decode(octets_of(name), strict=True).verdict in GOOD
    else:
        with pytest.raises(BadDataError) as caught:
            teds.decode(octets_of(name), strict=True)
        assert ALL[name]["verdict"] in caught.value.hint


@pytest.mark.parametrize("name", CLEAN)
def test_every_changed_octet_of_a_clean_teds_is_caught(name: str) -> None:
    octets = octets_of(name)
    for at in range(len(octets)):
        for other in (octets[at] ^ 0x01, octets[at] ^ 0x80, octets[at] ^ 0xFF, (octets[at] + 1) & 0xFF, 0x00, 0xFF):
            if other == octets[at]:
                continue
            damaged = octets[:at] + bytes([other]) + octets[at + 1 :]
            decoded = teds.decode(damaged)
            assert decoded.verdict not in GOOD, (at, other)
            assert any(f.code in {"frame-length", "frame-checksum", "frame-trailing"} for f in decoded.findings)


@pytest.mark.parametrize("name", CLEAN)
def test_every_cut_of_a_clean_teds_is_caught(name: str) -> None:
    octets = octets_of(name)
    for end in range(len(octets)):
        assert teds.decode(octets[:end]).verdict not in {"clean", "block-clean"}


def test_ubi_meta() -> None:
    decoded = teds.decode(octets_of("w24_ubi_meta"))
    assert decoded.get("UUID") == bytes.fromhex("86258A0B72F612D68707E8054911DCF0")
    assert decoded.get("OholdOff") == pytest.approx(1.2)
    assert decoded.get("SHoldOff") == pytest.approx(1.4)
    assert decoded.get("TestTime") == pytest.approx(5.2)
    assert decoded.get("MaxChan") == 1


def test_vector_group_of_three_channels() -> None:
    group = teds.decode(octets_of("x07_meta_vgroup")).field("VGroup")
    assert group is not None
    assert {child.name: child.value for child in group.children} == {"GrpType": 1, "MemList": (1, 2, 3)}


@pytest.mark.parametrize("name", ["x07_chan_temp_nested", "x07_chan_temp_packed", "x24_chan_temp", "w24_ubi_chan"])
def test_three_spellings_of_kelvin_are_one_value(name: str) -> None:
    assert teds.decode(octets_of(name)).get("PhyUnits") == teds.Units(kelvins=Fraction(1))


def test_ten_octets_without_extension_are_units_too() -> None:
    volt = teds.decode(octets_of("b07_mcpeixoto_chan_led")).get("PhyUnits")
    assert volt == teds.Units(meters=Fraction(2), kilograms=Fraction(1), seconds=Fraction(-3), amperes=Fraction(-1))


def test_sub_structures_of_a_channel() -> None:
    decoded = teds.decode(octets_of("f07_epos_chan_temp2"))
    data_set = decoded.field("DataSet")
    assert data_set is not None
    assert [(child.name, child.value) for child in data_set.children] == [
        ("Repeats", 10),
        ("SOrigin", 0.0),
        ("StepSize", 10.0),
        ("SUnits", teds.Units(seconds=Fraction(1))),
        ("PreTrigg", 0),
    ]


def test_wider_tuples_after_the_tedsid() -> None:
    decoded = teds.decode(octets_of("x07_chan_tuple2"))
    assert decoded.get("TCName") == "boiler-inlet"
    assert decoded.get("TEDSID") == (0, 12, 1, 2)


def test_calibration_from_memory_is_marked_unverified() -> None:
    decoded = teds.decode(octets_of("p07_cal_provisional"))
    assert decoded.get("LstCalDt") == teds.TimeInstance(0x6955B900)
    assert decoded.get("CalInrvl") == teds.TimeInstance(365 * 86400)
    assert decoded.get("Intercept") == pytest.approx(273.15)
    assert [finding.code for finding in decoded.findings] == ["unverified"]


def test_security_level_of_2024() -> None:
    decoded = teds.decode(octets_of("x24_security"))
    assert (decoded.get("Level"), decoded.get("NumOfStandards")) == ("E", 1)


def test_phy_of_a_radio() -> None:
    decoded = teds.decode(octets_of("x07_phy"))
    assert decoded.get("Radio") == 255
    assert decoded.get("MaxBPS") == 115200
    assert decoded.get("TEDSID") == (5, 13, 1, 1)
