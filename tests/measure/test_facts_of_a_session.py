"""What is said of the values of a session: whose frame, name and standard deviation, and nothing that is unsigned."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.units import parse_unit
from tests.measure.test_topic_actuators import SHEET

NONE: Any = None
OPENING, OTHER = SHEET.channels[:2]


def of_type(frame: str, unit: str, deviation: float | None) -> Any:
    """Return a channel of a profile, as far as facts need it."""
    written = parse_unit(unit)
    demand = SimpleNamespace(standard_deviation=deviation)
    return SimpleNamespace(frame=frame, unit=written, units=written.units, calibration=demand)


def session(**more: Any) -> VerifiedSession:
    return VerifiedSession(NONE, SHEET, "ab" * 32, "left hand", **more)


@pytest.mark.parametrize(
    ("frames", "profile", "frame"),
    [
        ({1: "tip", 0: "base"}, "{node}_tool", "tip"),
        ({0: "base"}, "{node}_tool", "base"),
        ({2: "elsewhere"}, "{node}_tool", "{node}_tool"),
        ({}, "{node}_tool", "{node}_tool"),
        ({}, "", ""),
        ({}, None, ""),
    ],
)
def test_a_frame_is_that_of_the_channel_else_of_the_node_else_of_the_profile_else_none(
    frames: dict[int, str], profile: str | None, frame: str
) -> None:
    profiles = {} if profile is None else {1: of_type(profile, "mm", None)}
    assert session(frames=frames, profiles=profiles).facts(OPENING, 0.1).frame == frame


@pytest.mark.parametrize(
    ("unit", "stated", "deviation"), [("mm", 0.5, 0.0005), ("m", 0.5, 0.5), ("N", 0.5, None), ("mm", None, None)]
)
def test_a_standard_deviation_of_the_profile_is_in_si_and_of_the_datasheets_unit_alone(
    unit: str, stated: float | None, deviation: float | None
) -> None:
    found = session(profiles={1: of_type("", unit, stated)}).facts(OPENING, 0.1).deviation
    assert found == (None if deviation is None else pytest.approx(deviation))


def test_what_is_not_signed_says_nothing_of_its_own_but_the_names_of_its_channels() -> None:
    more: dict[str, Any] = {"frames": {1: "tip"}, "profiles": {1: of_type("", "mm", 0.5)}}
    signed = session(**more).facts(OPENING, 0.1)
    siblings = tuple((channel.number, channel.name) for channel in SHEET.channels)
    assert (signed.node, signed.fingerprint, signed.kind, signed.unit) == ("left hand", "ab" * 32, "actuator", "m")
    assert (signed.low, signed.high, signed.siblings) == (0.0, pytest.approx(0.11), siblings)
    bare = session(unsigned=True, **more).facts(OPENING, 0.1)
    assert (bare.node, bare.name, bare.kind, bare.siblings) == ("left hand", OPENING.name, "actuator", siblings)
    assert (bare.unsigned, bare.unit, bare.units, bare.fingerprint, bare.frame) == (True, "", None, "", "")
    assert (bare.low, bare.high, bare.uncertainty, bare.deviation, bare.calibration) == (None,) * 5
    unproven = session(unverified=True, **more).facts(OPENING, 0.1)
    assert (unproven.node, unproven.fingerprint, unproven.frame) == (SHEET.meta.name, "", "")
    assert (unproven.unverified, unproven.unsigned, unproven.unit, unproven.deviation) == (True, False, "m", None)


def test_an_event_has_no_period() -> None:
    assert session().facts(OTHER, 0.1).period == 0.1
    assert session().facts(replace(OTHER, kind=ChannelKind.EVENT_SENSOR), 0.1).period is None
