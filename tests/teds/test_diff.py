"""A diff speaks of gain, newtons and degrees, not of octets."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.teds.calibration import Calibration, CalibrationInput, fit
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.profile import Profile, load_profile, shipped_profiles
from teds_provision.teds.show import seconds
from teds_provision.teds.units import parse_unit

UUID = bytes(10)
FORCE = """\
extends = "tactile-finger-sensor"
[channel.1]
high-limit = 43.75
"""


@pytest.fixture(scope="module")
def finger(tmp_path_factory: pytest.TempPathFactory) -> Profile:
    path: Path = tmp_path_factory.mktemp("profiles") / "finger.toml"
    path.write_text(FORCE)
    return load_profile(path, [shipped_profiles()])


def line(intercept: float, slope: float, **more: object) -> Calibration:
    part = CalibrationInput(1, 1, (0, 65535), (0,))
    return Calibration(1, "linear", (part,), (intercept, slope), unit=parse_unit("N"), **more)  # type: ignore[arg-type]


def texts(changes: list[Change]) -> list[str]:
    return [change.text for change in changes]


def test_the_same_blocks_have_no_difference(finger: Profile) -> None:
    blocks = finger.build(UUID, calibration={1: line(0, 1e-4)}).blocks
    assert diff_blocks(blocks, blocks) == []


def test_a_gain_is_stated_in_percent_and_at_full_scale(finger: Profile) -> None:
    old = finger.build(UUID, calibration={1: line(0, 43.75 / 65535)}).blocks
    new = finger.build(UUID, calibration={1: line(0, 1.008 * 43.75 / 65535)}).blocks
    assert texts(diff_blocks(old, new)) == [
        "channel 1 (taxel 1): gain +0.8 %, at full scale +0.35 N, stated uncertainty 0.2 N."
    ]
    back = diff_blocks(new, old)[0]
    assert back.field == "curve"
    assert "gain -0.794 %, at full scale -0.35 N" in back.text


def test_an_offset_is_stated_at_both_ends_and_without_gain(finger: Profile) -> None:
    old = finger.build(UUID, calibration={1: line(0, 1e-4)}).blocks
    new = finger.build(UUID, calibration={1: line(0.125, 1e-4)}).blocks
    (change,) = diff_blocks(old, new)
    assert "at the low end +0.125 N, at full scale +0.125 N" in change.text
    assert "gain" not in change.text


def test_a_bend_is_reported_at_its_largest_point(finger: Profile) -> None:
    straight = replace(fit([(0, 0.0), (30000, 5.0), (65535, 10.0)], "table", channel=1), unit=parse_unit("N"))
    bent = replace(fit([(0, 0.0), (30000, 5.5), (65535, 10.0)], "table", channel=1), unit=parse_unit("N"))
    (change,) = diff_blocks(
        finger.build(UUID, calibration={1: straight}).blocks, finger.build(UUID, calibration={1: bent}).blocks
    )
    assert "at most +0.5 N (at raw 30000)" in change.text


def test_a_change_of_method_date_and_uncertainty_is_reported(finger: Profile) -> None:
    moment = datetime(2026, 10, 31, 12, tzinfo=UTC)
    yearly = line(0, 1e-4, date=moment, interval=180 * 86400.0, uncertainty=0.1)
    other = replace(
        fit([(0, 0.0), (30000, 3.0), (65535, 6.5535)], "table", channel=1), unit=parse_unit("N"), uncertainty=0.05
    )
    text = " ".join(texts(diff_blocks(*(finger.build(UUID, calibration={1: c}).blocks for c in (yearly, other)))))
    assert "linear -> table of 2 segments" in text
    assert "LstCalDt removed (was 2026-10-31 12:00:00 UTC)" in text
    assert "CalInrvl removed (was 180 days)" in text
    assert "stated uncertainty 0.1 -> 0.05" in text


def test_blocks_added_and_removed_are_reported(finger: Profile) -> None:
    plain, calibrated = finger.build(UUID).blocks, finger.build(UUID, calibration={1: line(0, 1e-4)}).blocks
    assert "channel 1 (taxel 1): calibration added." in texts(diff_blocks(plain, calibrated))
    assert "channel 1 (taxel 1): calibration removed." in texts(diff_blocks(calibrated, plain))
    assert "channel 1 (taxel 1): calibration key none -> supplied." in [
        text.lower().replace("cal_", "") for text in texts(diff_blocks(plain, calibrated))
    ]


def test_fields_of_a_channel_are_stated_in_its_unit() -> None:
    profile = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    channel = profile.channels[0]
    fields = {
        **channel.fields,
        "HiLimit": parse_unit("degree").to_si(180.0),
        "OError": parse_unit("degree").to_si(0.5),
        "SPeriod": 2e-3,
    }
    other = replace(profile, channels=(replace(channel, fields=fields),))
    text = texts(diff_blocks(profile.build(UUID).blocks, other.build(UUID, name="joint 3").blocks))
    assert "node: name magnetic angular position sensor -> joint 3." in text
    assert "channel 1 (angle): high limit 360 ° -> 180 °." in text
    assert "channel 1 (angle): stated uncertainty 1 ° -> 0.5 °." in text
    assert "channel 1 (angle): sampling period 100 µs -> 2 ms." in text
    assert len(text) == 4


def test_fields_added_and_removed_and_repeated_are_reported() -> None:
    meta = [("UUID", UUID), ("OholdOff", 1.0), ("TestTime", 0.0), ("MaxChan", 3)]
    group = ("VGroup", (("GrpType", 0), ("MemList", [1, 2])))
    other = ("VGroup", (("GrpType", 1), ("MemList", [3])))
    old = {(0, 1): teds.compose(1, [*meta, group])}
    new = {(0, 1): teds.compose(1, [*meta, ("SHoldOff", 2.0), group, other])}
    text = texts(diff_blocks(old, new))
    assert "node: slow-access time-out added: 2 s." in text
    assert "node: VGroup 2, MemList added: 3." in text
    assert "node: VGroup 2, MemList removed (was 3)." in texts(diff_blocks(new, old))


def test_the_same_content_in_other_octets_is_reported() -> None:
    fields = [("UUID", UUID), ("OholdOff", 1.0), ("TestTime", 0.0), ("MaxChan", 3)]
    old, new = {(0, 1): teds.compose(1, fields)}, {(0, 1): teds.compose(1, fields, width=2)}
    assert any("other octets" in text or "TEDSID" in text for text in texts(diff_blocks(old, new)))


def test_long_opaque_fields_are_not_printed() -> None:
    old, new = ({(0, 128): teds.compose(128, [("Signature", letter * 88)])} for letter in "AB")
    (change,) = diff_blocks(old, new)
    assert change.text == "node: Signature is another."


blocks = st.dictionaries(
    st.tuples(st.integers(0, 2), st.sampled_from([1, 3, 5, 12, 128, 200])), st.binary(max_size=60), max_size=4
)


@given(blocks, blocks)
def test_any_octets_can_be_compared(old: dict[tuple[int, int], bytes], new: dict[tuple[int, int], bytes]) -> None:
    assert bool(diff_blocks(old, new)) == (old != new)


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1e-4, "100 µs"), (0.5, "500 ms"), (2.0, "2 s"), (0.0, "0 s"), (31536000.0, "365 days"), (86400.0, "86400 s")],
)
def test_times_are_shown_in_the_unit_people_use(value: float, shown: str) -> None:
    assert seconds(value) == shown


RAD, METRE = teds.Units(radians=Fraction(1)), teds.Units(meters=Fraction(1))


def name_teds(text: str) -> bytes:
    return teds.compose(12, {"Format": 0, "TCName": text})


def test_each_field_has_the_word_and_the_unit_that_people_use() -> None:
    def channel(number: int, units: teds.Units, number_of_bits: int) -> bytes:
        fields = [
            ("CalKey", number),
            ("ChanType", 2 * number),
            ("PhyUnits", units),
            ("LowLimit", float(number)),
            ("HiLimit", float(number + 1)),
            ("OError", 0.01 * (number + 1)),
            ("SelfTest", number),
            ("Sample", {"DatModel": 0, "ModLenth": 2, "SigBits": number_of_bits}),
            ("UpdateT", 0.1 * (number + 1)),
            ("SPeriod", 0.1 * (number + 1)),
            ("WarmUpT", 1.0 * (number + 1)),
        ]
        return teds.compose(3, fields)

    old = {(3, 3): channel(0, RAD, 12), (3, 12): name_teds("old")}
    new = {(3, 3): channel(1, METRE, 14), (3, 12): name_teds("new")}
    expected = [
        "calibration key CAL_NONE -> CAL_SUPPLIED",
        "channel type sensor -> event sensor",
        "unit rad -> m",
        "low limit 0 ° -> 1 m",
        "high limit 57.2958 ° -> 2 m",
        "stated uncertainty 0.572958 ° -> 0.02 m",
        "SelfTest none -> provided",
        "Sample, significant bits 12 -> 14",
        "update time 100 ms -> 200 ms",
        "sampling period 100 ms -> 200 ms",
        "warm-up time 1 s -> 2 s",
    ]
    assert texts(diff_blocks(old, new)) == [
        *(f"channel 3 (new): {text}." for text in expected),
        "channel 3 (new): name old -> new.",
    ]
    gone = {(3, 3): new[3, 3]}
    assert texts(diff_blocks(old, gone))[0] == "channel 3 (old): calibration key CAL_NONE -> CAL_SUPPLIED."
    assert texts(diff_blocks(gone, new)) == ["channel 3 (new): name added."]
    first = diff_blocks(old, new)[7]
    assert (first.channel, first.access_code, first.field, first.before, first.after) == (3, 3, "SigBits", "12", "14")


def test_the_node_and_its_blocks_are_compared_in_the_order_of_channels_and_classes() -> None:
    classes = (1, 2, 3, 5, 7, 9, 12, 13, 128, 130, 131, 200)
    words = (
        "Meta-TEDS",
        "MetaIdTEDS",
        "channel description",
        "calibration",
        "end-user TEDS",
        "TransferTEDS",
        "name",
        "PHY TEDS",
        "Security TEDS",
        "Origin TEDS",
        "Certificate TEDS",
        "manufacturer 200",
    )
    blocks = {(1, code): b"" for code in reversed(classes)}
    assert texts(diff_blocks(blocks, {})) == [f"channel 1: {word} removed." for word in words]
    assert texts(diff_blocks({}, {(1, 1): b"", (0, 12): b""})) == ["node: name added.", "channel 1: Meta-TEDS added."]

    def meta(uuid: bytes, number: int) -> dict[tuple[int, int], bytes]:
        times = [("OholdOff", number + 0.0), ("SHoldOff", number + 1.0), ("TestTime", 0.0)]
        return {(0, 1): teds.compose(1, [("UUID", uuid), *times, ("MaxChan", number + 2)])}

    assert texts(diff_blocks(meta(bytes(10), 1), meta(bytes(9) + b"\1", 2))) == [
        "node: UUID 00000000000000000000 -> 00000000000000000001.",
        "node: operation time-out 1 s -> 2 s.",
        "node: slow-access time-out 2 s -> 3 s.",
        "node: number of channels 3 -> 4.",
    ]
    (whole,) = meta(bytes(10), 1).values()
    mended = {(0, 1): whole[:-1] + bytes([whole[-1] ^ 1])}
    assert texts(diff_blocks({(0, 1): whole}, mended)) == ["node: Meta-TEDS: the same content, other octets."]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("a" * 48, "b" * 48, f"node: name {'a' * 48} -> {'b' * 48}."),
        ("a" * 48, "b" * 49, f"node: name {'a' * 48} -> 49 octets."),
        ("a" * 50, "b" * 49, "node: name is another."),
        ("a", "", "node: name a -> nothing."),
    ],
)
def test_a_text_is_printed_up_to_48_letters(old: str, new: str, text: str) -> None:
    assert texts(diff_blocks({(0, 12): name_teds(old)}, {(0, 12): name_teds(new)})) == [text]


@pytest.mark.parametrize(
    ("intercept", "slope", "text"),
    [
        (0.0, 1.00051, "gain +0.051 %"),
        (0.0, 1.0004, "gain +0.04 %"),
        (0.01, 1.0, "at the low end +0.01 N, at full scale +0.01 N"),
        (-0.01, 1.0, "at the low end -0.01 N, at full scale -0.01 N"),
    ],
)
def test_small_changes_of_a_curve_are_stated_to_the_noise(
    finger: Profile, intercept: float, slope: float, text: str
) -> None:
    old, new = (
        finger.build(UUID, calibration={1: line(offset, gain * 43.75 / 65535)}).blocks
        for offset, gain in ((0.0, 1.0), (intercept, slope))
    )
    (change,) = diff_blocks(old, new)
    assert change.text.startswith(f"channel 1 (taxel 1): {text}")
    assert change.text.endswith(", stated uncertainty 0.2 N.")


def curve_of(profile: Profile, old: Calibration, new: Calibration) -> list[str]:
    """Return what a change of the first channel's calibration is called, without its beginning."""
    found = diff_blocks(*(profile.build(UUID, calibration={1: curve}).blocks for curve in (old, new)))
    return [change.text.partition(": ")[2] for change in found]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        # readings go as far as the calibration says that raw values go
        (line(0, 1e-4, raw_range=(0.0, 4095.0)), line(0, 2e-4, raw_range=(0.0, 4095.0)),
         "gain +100 %, at full scale +0.4095 N, stated uncertainty 0.2 N."),
        (line(0, 1e-4), line(0, 2e-4), "gain +100 %, at full scale +6.5535 N, stated uncertainty 0.2 N."),
        # of a gain of zero there is no share
        (line(5, 0), line(0, 1e-4), "at the low end -5 N, at full scale +1.5535 N, stated uncertainty 0.2 N."),
        # below the noise of the ends, above a quarter of it
        (line(0, 10 / 65535), line(5e-6, 10 / 65535), "at most +5e-06 N, stated uncertainty 0.2 N."),
        (line(0, 10 / 65535), line(1e-6, 10 / 65535), "calibration: the same content, other octets."),
    ],
)  # fmt: skip
def test_a_change_of_a_curve_in_whole_words(old: Calibration, new: Calibration, text: str, finger: Profile) -> None:
    assert curve_of(finger, old, new) == [text]


def test_without_a_stated_uncertainty_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "sure.toml").write_text(FORCE + "uncertainty = 0.0\n")
    sure = load_profile(tmp_path / "sure.toml", [shipped_profiles()])
    assert curve_of(sure, line(0, 1e-4), line(0, 2e-4)) == ["gain +100 %, at full scale +6.5535 N."]


def test_a_change_of_an_actuator_is_in_raw_numbers_at_values_and_names_no_uncertainty() -> None:
    gripper = load_profile("gripper", [shipped_profiles()])

    def table(middle: float) -> Calibration:
        points = [(0, 0.0), (middle, 60.0), (4095, 110.0)]
        return replace(fit(points, "table", channel=1, actuator=True), unit=parse_unit("mm"))

    (text,) = curve_of(gripper, table(2000), table(2100))
    assert text.endswith("at most +100 raw (at 60).")


def test_a_change_of_temperatures_is_a_difference() -> None:
    sensor = load_profile("temperature-sensor", [shipped_profiles()])

    def from_(low: float) -> Calibration:
        curve = fit([(0, low), (21120, 125.0)], "linear", channel=1)
        return replace(curve, unit=parse_unit("degC"), raw_range=(0.0, 21120.0))

    (text,) = curve_of(sensor, from_(-40.0), from_(-30.0))
    assert text == "gain -6.06 %, at the low end +10 °C, stated uncertainty 0.5 °C."


@pytest.mark.parametrize("way", ["to two", "to one"])
def test_curves_of_another_number_of_inputs_are_compared_field_by_field(way: str, finger: Profile) -> None:
    parts = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    two = Calibration(1, "polynomial", parts, (0, 1e-9, 1e-4, 0), unit=parse_unit("N"))
    pair = (line(0, 1e-4), two) if way == "to two" else (two, line(0, 1e-4))
    texts_ = curve_of(finger, *pair)
    assert "Coefs 0, 0.0001 -> 0, 1e-09, 0.0001, 0." in texts_ or "Coefs 0, 1e-09, 0.0001, 0 -> 0, 0.0001." in texts_
    assert ("CalInput 2, ChanNum added: 2." if way == "to two" else "CalInput 2, ChanNum removed (was 2).") in texts_


def test_a_field_without_a_name_is_called_by_its_number() -> None:
    meta = {"UUID": UUID, "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 3}
    old, new = ({(0, 1): teds.compose(1, {**meta, "200": octets})} for octets in (b"\xaa", b"\xbb"))
    assert texts(diff_blocks(old, new)) == ["node: field 200 aa -> bb."]


def text_based(*texts: tuple[str, object]) -> bytes:
    return teds.compose(11, [("Text", {"LangCode": language, "Text": text}) for language, text in texts])


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ([("en", "<a/>")], [("en", "<b/>")], "node: text <a/> -> <b/>."),
        ([("en", "<a/>"), ("de", "Öl")], [("en", "<a/>"), ("de", "Eis")], "node: text 2 Öl -> Eis."),
        ([("en", "<a/>")], [("en", "<a/>"), ("de", "Öl")], "node: text 2 added: Öl."),
        ([("en", "<a/>"), ("de", "Öl")], [("en", "<a/>")], "node: text 2 removed (was Öl)."),
        ([("en", b"\xff\x00")], [("en", b"\xfe\x00")], "node: text ff00 -> fe00."),
        ([("en", b"\xff" * 17)], [("en", b"\xfe" * 17)], "node: text is another."),
    ],
)
def test_texts_are_compared_as_text(old: list[tuple[str, object]], new: list[tuple[str, object]], text: str) -> None:
    changes = diff_blocks({(0, 11): text_based(*old)}, {(0, 11): text_based(*new)})
    assert [change.text for change in changes if change.field == "text"] == [text]


@pytest.mark.parametrize("side", ["old", "new"])
def test_readings_beyond_every_number_are_stated_as_such(side: str, finger: Profile) -> None:
    """Each part of the curve fits a Float32; at raw 65535 the whole is larger than any float."""
    part = CalibrationInput(1, 70, (0, 65535), (0,))
    steep = Calibration(1, "polynomial", (part,), (*[0.0] * 70, 3e38), unit=parse_unit("N"))
    good = finger.build(UUID, calibration={1: line(0, 1e-4)}).blocks
    bad = finger.build(UUID, calibration={1: steep}).blocks
    changes = diff_blocks(*((bad, good) if side == "old" else (good, bad)))
    assert next(change.text for change in changes if change.field == "curve").startswith(
        "channel 1 (taxel 1): the readings are no numbers, "
    )


def test_fields_of_a_calibration_that_leave_every_reading_as_it_is_are_no_change_of_its_curve(finger: Profile) -> None:
    """A node of the middle of a straight line may be left out: that is no other calibration."""
    two = finger.build(UUID, calibration={1: replace(fit([(0, 0), (65535, 10)], "table", channel=1))}).blocks
    parts = CalibrationInput(1, 1, (0, 65535), (32768,))
    moved = Calibration(1, "table", (parts,), (10 * 32768 / 65535, 10 / 65535))
    changes = diff_blocks(two, finger.build(UUID, calibration={1: moved}).blocks)
    assert texts(changes) == ["channel 1 (taxel 1): calibration: the same content, other octets."]


def test_a_calibration_that_cannot_be_computed_is_compared_field_by_field(finger: Profile) -> None:
    good = finger.build(UUID, calibration={1: line(0, 1e-4)}).blocks
    (coefficients,) = [field for field in teds.decode(good[1, 5]).fields if field.name == "Coefs"]
    kept = [part for part in tuples(unframe(good[1, 5])) if part.type != coefficients.type]
    bad = {**good, (1, 5): frame(b"".join(raw_tuple(part.type, part.value) for part in kept))}
    (change,) = diff_blocks(good, bad)
    assert (change.field, change.after) == ("Coefs", "")
    assert change.text == "channel 1 (taxel 1): Coefs removed (was 0, 0.0001)."
