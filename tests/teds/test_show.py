"""Putting TEDS into words: units, dates, UUIDs, and never an exception, whatever the octets."""

import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.teds import show
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.codec.model import TimeInstance, Units
from teds_provision.teds.formats import TedsBlock, read_blocks
from teds_provision.teds.show import describe, hexadecimal, instant, seconds, shown_to_json, signed_block, span

VECTORS = sorted((Path(__file__).parent.parent / "vectors" / "ieee1451").glob("*.hex"))
NOW = datetime(2026, 1, 1, tzinfo=UTC)
KELVIN = Units(kelvins=1)
PASCAL = Units(kilograms=1, meters=-1, seconds=-2)


def shown_of(code, fields, **more):
    return describe(TedsBlock(None, code, teds.compose(code, fields)), now=NOW, **more)


def texts(shown):
    pending, out = list(shown.fields), {}
    while pending:
        field = pending.pop()
        out[field.name] = field.text
        pending += field.children
    return out


def test_limits_are_in_the_unit_that_people_use_and_a_difference_leaves_the_offset_out():
    text = texts(shown_of(3, {"PhyUnits": KELVIN, "LowLimit": 273.15, "HiLimit": 373.15, "OError": 0.5}))
    assert (text["LowLimit"], text["HiLimit"], text["OError"]) == ("0 °C", "100 °C", "0.5 °C")


def test_times_are_in_a_unit_that_suits():
    assert [seconds(value) for value in (0.0, 2.5e-8, 1e-4, 0.05, 1.0, 90.0, float("nan"))] == [
        "0 s",
        "25 ns",
        "100 µs",
        "50 ms",
        "1 s",
        "90 s",
        "not available",
    ]
    assert span(TimeInstance(31_536_000)) == "365 days"
    assert instant(TimeInstance(0)) == "not set (0)"
    assert instant(TimeInstance(1_700_000_000)) == "2023-11-14 22:13:20 UTC"
    assert instant(TimeInstance(86_400, 0, True)) == "1969-12-31 00:00:00 UTC"
    assert "since 1970" in instant(TimeInstance(2**47))


def test_long_octets_are_cut_for_people():
    assert hexadecimal(b"") == "(empty)"
    assert hexadecimal(bytes(100)).endswith("… (100 octets)")


def test_a_uuid_of_2007_is_unpacked():
    fields = {"UUID": bytes.fromhex("8D4D9DA65281F7000000"), "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1}
    summary = dict(shown_of(1, fields).summary)
    assert summary["made at"] == "30.2719° N, 120.1272° E"
    assert summary["made in"].startswith("2012-01-01")


def test_a_uuid_with_a_time_beyond_its_year_shows_the_year_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = SimpleNamespace(plausible=True, degrees=(-30.5, -120.25), moment=None, year=2012, manufacturer=0)
    monkeypatch.setattr(show, "unpack_uuid", lambda _octets: parts)
    summary = dict(shown_of(1, {"UUID": bytes(10), "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1}).summary)
    assert summary["made in"] == "2012"
    assert summary["made at"] == "30.5000° S, 120.2500° W"
    assert "maker's number" not in summary


def test_calibration_limits_are_in_the_calibrated_unit_if_the_channel_is_given():
    channel = teds.compose(3, {"PhyUnits": Units(radians=1), "LowLimit": 0.0, "HiLimit": 6.2831855})
    degree = 0.017453292
    calibration = teds.compose(
        5,
        [
            ("LstCalDt", TimeInstance(1_577_836_800)),
            ("CalInrvl", TimeInstance(31_536_000)),
            ("SIConvrt", {"Slope": degree, "Intercept": 0.0}),
            ("LowLimit", 0.0),
            ("HiLimit", 360.0),
            ("CalInput", {"ChanNum": 1, "ChanKey": 0, "Degree": 1, "Boundaries": (0.0, 100.0), "Offsets": (0.0,)}),
            ("Coefs", (0.0, 3.6)),
            ("Method", 0),
        ],
    )
    beside = {(1, 3): channel, (1, 5): calibration}
    shown = describe(TedsBlock(1, 5, calibration), beside, now=NOW)
    assert texts(shown)["HiLimit"] == "360 °"
    summary = dict(shown.summary)
    assert summary["method"] == "linear: 1 segment of degree 1"
    assert summary["due"] == "2020-12-31 (overdue)"


def test_calibration_limits_in_another_unit_than_the_channel_has():
    channel = teds.compose(3, {"PhyUnits": PASCAL, "LowLimit": 0.0, "HiLimit": 2e6})
    calibration = teds.compose(
        5,
        [
            ("LstCalDt", TimeInstance(1_577_836_800)),
            ("CalInrvl", TimeInstance(31_536_000)),
            ("SIConvrt", {"Slope": 1e5, "Intercept": 0.0}),
            ("LowLimit", 0.0),
            ("HiLimit", 16.0),
            ("CalInput", {"ChanNum": 1, "ChanKey": 0, "Degree": 1, "Boundaries": (0.0, 100.0), "Offsets": (0.0,)}),
            ("Coefs", (0.0, 0.16)),
            ("Method", 0),
        ],
    )
    text = texts(describe(TedsBlock(1, 5, calibration), {(1, 3): channel, (1, 5): calibration}, now=NOW))
    assert (text["LowLimit"], text["HiLimit"]) == ("0 bar", "16 bar")


def test_a_place_that_the_tedsid_denies_is_named():
    name = teds.compose(12, {"Format": 0, "TCName": "a"})
    assert describe(TedsBlock(2, 3, name)).title == "channel 2 · ChanTEDS (3), though its TEDSID says 12"


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
def test_every_given_string_can_be_put_into_words_and_json(path):
    for block in read_blocks(path.read_bytes()):
        shown = describe(block)
        assert json.loads(json.dumps(shown_to_json(shown), allow_nan=False))["verdict"] == shown.decoded.verdict


@given(st.sampled_from(VECTORS), st.data())
def test_damage_never_raises(path, data):
    octets = bytearray(read_blocks(path.read_bytes())[0].octets)
    for _ in range(data.draw(st.integers(1, 4))):
        octets[data.draw(st.integers(0, len(octets) - 1))] = data.draw(st.integers(0, 255))
    code = data.draw(st.none() | st.integers(0, 255))
    beside = {(1, code or 0): bytes(octets), (1, 3): bytes(octets)}
    json.dumps(shown_to_json(describe(TedsBlock(1, code, bytes(octets)), beside, now=NOW)), allow_nan=False)


@given(st.integers(1, 255), st.binary(max_size=120), st.sampled_from([2007, 2024]))
def test_any_content_of_any_class_never_raises(code, content, edition):
    head = bytes([3, 4, 0, code, 1, 1]) if edition == 2007 else bytes([3, 5, 0, 255, code, 2, 1])
    octets = frame(head + content)
    json.dumps(shown_to_json(describe(TedsBlock(None, code, octets), {(0, code): octets}, now=NOW)), allow_nan=False)


def rows_of(shown):
    pending, out = list(shown.fields), []
    while pending:
        field = pending.pop(0)
        out.append((field.type, field.name, field.text, field.meaning))
        pending = [*field.children, *pending]
    return out


def test_a_whole_channel_of_temperatures_in_words():
    kelvin = teds.Units(kelvins=1)
    fields = [
        ("CalKey", 4),
        ("ChanType", 2),
        ("PhyUnits", kelvin),
        ("LowLimit", 233.15),
        ("HiLimit", 373.15),
        ("OError", 0.5),
        ("SelfTest", 9),
        ("Sample", {"DatModel": 1, "ModLenth": 4, "SigBits": 32}),
        ("DataSet", {"Repeats": 10, "SOrigin": 300.0, "StepSize": 5.0, "SUnits": kelvin, "PreTrigg": 0}),
        ("UpdateT", 1e-4),
        ("SPeriod", float("nan")),
        ("WarmUpT", 172_800.0),
        ("RDelayT", 172_799.0),
        ("Sampling", {"SampMode": 0b10011, "SDefault": 2}),
        ("DataXmit", 200),
    ]
    shown = shown_of(3, fields)
    assert rows_of(shown) == [
        (3, "TEDSID", "00 03 01 01", ""),
        (10, "CalKey", "4", "TIM_CAL_SUPPLIED"),
        (11, "ChanType", "2", "event sensor"),
        (12, "PhyUnits", "K", ""),
        (13, "LowLimit", "-40 °C", ""),
        (14, "HiLimit", "100 °C", ""),
        (15, "OError", "0.5 °C", ""),
        (16, "SelfTest", "9", "reserved"),
        (18, "Sample", "", ""),
        (40, "DatModel", "1", "Float32"),
        (41, "ModLenth", "4", ""),
        (42, "SigBits", "32", ""),
        (19, "DataSet", "", ""),
        (43, "Repeats", "10", ""),
        (44, "SOrigin", "26.85 °C", ""),
        (45, "StepSize", "5 °C", ""),
        (46, "SUnits", "K", ""),
        (47, "PreTrigg", "0", ""),
        (20, "UpdateT", "100 µs", ""),
        (23, "SPeriod", "not available", ""),
        (24, "WarmUpT", "2 days", ""),
        (25, "RDelayT", "172799 s", ""),
        (31, "Sampling", "", ""),
        (48, "SampMode", "19", "trigger, free-running, immediate"),
        (49, "SDefault", "2", ""),
        (32, "DataXmit", "200", "manufacturer's own"),
    ]
    assert shown.summary == (("range", "-40 °C to 100 °C, uncertainty 0.5 °C"),)
    without = shown_of(3, [(name, float("nan") if name == "OError" else value) for name, value in fields])
    assert without.summary == (("range", "-40 °C to 100 °C"),)
    tree = shown_to_json(shown)
    assert [(part["type"], part["offset"]) for part in tree["fields"][8]["fields"]] == [
        (43, 59),
        (44, 63),
        (45, 69),
        (46, 75),
        (47, 83),
    ]
    assert tree["fields"][1] == {
        "type": 11,
        "name": "ChanType",
        "kind": "integer",
        "value": 2,
        "offset": 13,
        "text": "2",
        "meaning": "event sensor",
    }
    assert (tree["edition"], tree["verdict"], tree["summary"]) == (
        2007,
        "content-nonconformant",
        [{"label": "range", "text": "-40 °C to 100 °C, uncertainty 0.5 °C"}],
    )


def test_a_calibration_that_is_due_is_overdue_from_its_day_and_has_each_input_in_words():
    def calibration(segments):
        return [
            ("LstCalDt", TimeInstance(1_577_836_800)),
            ("CalInrvl", TimeInstance(31_536_000)),
            ("SIConvrt", {"Slope": 1.0, "Intercept": 0.0}),
            ("LowLimit", float("nan")),
            (
                "CalInput",
                {
                    "ChanNum": 1,
                    "ChanKey": 0,
                    "Degree": 1,
                    "Boundaries": segments,
                    "Offsets": (0.0,) * (len(segments) - 1),
                },
            ),
            ("Coefs", tuple(float(number) for number in range(2 * (len(segments) - 1)))),
            ("Method", 0),
        ]

    for segments, method, coefficients in (
        ((0.0, 1.0), "linear: 1 segment of degree 1", "0, 1"),
        (tuple(float(n) for n in range(6)), "linear: 5 segments of degree 1", "0, 1, 2, 3, 4, 5, 6, 7, … (10)"),
    ):
        octets = teds.compose(5, calibration(segments))
        at = datetime(2020, 12, 30, 23, 59, tzinfo=UTC)
        channel = teds.compose(3, {"PhyUnits": Units(radians=1)})
        shown = describe(TedsBlock(1, 5, octets), {(1, 3): channel}, now=at)
        assert shown.summary == (("method", method), ("calibrated", "2020-01-01"), ("due", "2020-12-31"))
        assert texts(shown)["Coefs"] == coefficients
        assert texts(shown)["LowLimit"] == "not available"
        assert texts(shown)["CalInrvl"] == "365 days"


def test_octets_and_times_at_the_edges_of_their_words():
    assert hexadecimal(bytes(24)) == "00" * 24
    assert hexadecimal(bytes(25)) == "00" * 24 + "… (25 octets)"
    assert seconds(0.9999995) == "1 s"
    assert seconds(-0.002) == "-2 ms"
    assert seconds(172_800.0) == "2 days"
    assert span(TimeInstance(1, 500_000_000)) == "1.5 s"
    assert span(TimeInstance(86_400, 0, True)) == "-86400 s"
    assert instant(TimeInstance(0, 5)) == "1970-01-01 00:00:00 UTC"
    assert instant(TimeInstance(2**47, 0, True)) == "-140737488355328 s since 1970"


def test_a_block_that_a_signature_covers_is_the_same_absent_or_another():
    name = teds.compose(12, {"Format": 0, "TCName": "a"})
    raw = b"\0\0\x0c" + hashlib.sha256(name).digest()
    head = f"channel 0 XdcrName {hashlib.sha256(name).hexdigest()[:16]}…"
    assert signed_block(raw, {(0, 12): name}) == f"{head} (same)"
    assert signed_block(raw, {(0, 12): name + b"x"}) == f"{head} (OTHER DIGEST)"
    assert signed_block(raw, {(0, 1): b"", (1, 12): name}) == f"{head} (absent)"
    assert signed_block(raw, {(0, 1): b""}) == head, "of one TEDS alone nothing is missing"


def test_words_for_codes_keys_and_what_is_not_known():
    fields = [("CalKey", 127), ("ChanType", 0), ("PhyUnits", KELVIN), ("DataXmit", 128), ("EdgeRpt", 4)]
    octets = teds.compose(3, fields)
    named = {name: (text, meaning) for _, name, text, meaning in rows_of(shown_of(3, fields))}
    assert named["CalKey"] == ("127", "reserved")
    assert named["DataXmit"] == ("128", "manufacturer's own")
    assert named["EdgeRpt"] == ("4", "reserved")
    strange = describe(TedsBlock(None, 3, frame(unframe(octets) + bytes([200, 2, 0xAB, 0xCD]))), now=NOW)
    assert rows_of(strange)[-1] == (200, "type 200", "abcd", "")
    assert strange.summary == (), "without limits there is no range"


def test_a_range_without_a_unit_is_not_guessed():
    shown = shown_of(3, [("CalKey", 0), ("ChanType", 0), ("LowLimit", 0.0), ("HiLimit", 5.0), ("OError", 0.5)])
    assert shown.summary == ()
    assert texts(shown)["HiLimit"] == "5"


def test_a_foreign_security_teds_in_words():
    key = bytes.fromhex("04" + "11" * 64)
    shown = shown_of(
        128,
        [("UsedSecScheme", 1), ("UsedVerAlg", 2), ("UsedEncAlg", 3), ("UsedHashAlg", 0), ("Signature", b"\x01" * 64),
         ("NodePublicKey", key), ("BaseStationPublicKey", b"\x22" * 20)],
    )  # fmt: skip
    assert rows_of(shown)[1:] == [
        (1, "UsedSecScheme", "1", "AsVerification"),
        (2, "UsedVerAlg", "2", "ECDSA"),
        (3, "UsedEncAlg", "3", "DES"),
        (4, "UsedHashAlg", "0", "MD5"),
        (100, "Signature", "signature, 64 octets as raw: 0101010101010101…", ""),
        (101, "NodePublicKey", "P-256 key, fingerprint f0b9315a0459dab7 (raw)", ""),
        (103, "BaseStationPublicKey", "no P-256 key, 20 octets as raw: 2222222222222222…", ""),
    ]
    assert [field.weak for field in shown.fields][1:] == [False, False, True, True, False, False, False]
    assert [part.get("weak") for part in shown_to_json(shown)["fields"]] == [None, None, True, True, None, None, None]
    assert shown.summary[0] == ("kind", "another vendor's Security TEDS (no field 105): shown, never trusted")
    assert ("signature", "claims to be signed; check with: verify") in shown.summary


def test_a_finding_as_json_has_what_is_known_of_it():
    octets = teds.compose(3, {"PhyUnits": KELVIN, "LowLimit": 5.0, "HiLimit": 1.0})
    found = {entry["code"]: entry for entry in shown_to_json(describe(TedsBlock(None, 3, octets), now=NOW))["findings"]}
    assert found["limits"].keys() >= {"severity", "offset", "code", "message"}
    assert found["limits"]["severity"] == "error"
    assert "" not in found["limits"].values()
    assert None not in found["limits"].values()
    missing = found["missing"]
    assert missing["field"]


def test_a_calibration_without_its_place_is_shown_as_that_of_channel_1():
    channel = teds.compose(3, {"PhyUnits": PASCAL, "LowLimit": 0.0, "HiLimit": 2e6})
    calibration = teds.compose(
        5,
        [("LowLimit", 0.0), ("HiLimit", 16.0),
         ("CalInput", {"ChanNum": 1, "ChanKey": 0, "Degree": 1, "Boundaries": (0.0, 100.0), "Offsets": (0.0,)}),
         ("Coefs", (0.0, 0.16))],
    )  # fmt: skip
    beside = {(1, 3): channel}
    for place, text in ((None, "16 Pa"), (1, "16 Pa"), (2, "16")):
        assert texts(describe(TedsBlock(place, 5, calibration), beside, now=NOW))["HiLimit"] == text


def test_a_security_teds_of_ours_in_words():
    point = b"\x04" + bytes(range(64))
    signed = security.SecurityTeds(
        point, bytes(64), signature=bytes(64), station_key=point, station_key_signature=bytes(64), ca="Works:00",
        sequence=0, key_epoch=3,
    ).encode()  # fmt: skip
    summary = dict(describe(TedsBlock(0, 128, signed), {(0, 128): signed}, now=NOW).summary)
    assert (summary["sequence"], summary["key epoch"]) == ("0", "3")
    assert not {"kind", "form"} & set(summary)
    block = unframe(signed)
    swapped = frame(block[:6] + block[9:12] + block[6:9] + block[12:])
    shown = dict(describe(TedsBlock(0, 128, swapped), {(0, 128): swapped}, now=NOW).summary)
    assert shown["form"].startswith("not canonical, so never authentic: ")
    assert "form" not in dict(describe(TedsBlock(0, 128, swapped), now=NOW).summary), "a TEDS alone is shown as it is"
