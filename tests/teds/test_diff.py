"""A diff speaks of gain, newtons and degrees, not of octets."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.teds.calibration import Calibration, CalibrationInput, fit
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
