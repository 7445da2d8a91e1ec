"""What is said of the values of a session: whose frame, name and standard deviation, and nothing that is unsigned."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotAuthenticError
from teds_provision.measure import verified_session
from teds_provision.measure.clock import Exchange
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.protocol.operation.stream_commands import ClockReply
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
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


VERDICTS = ("authentic", "unsigned", "not authentic", "not trusted", "unproven")


@pytest.mark.parametrize("allowed", [True, False])
@pytest.mark.parametrize("verdict", VERDICTS)
def test_only_an_unsigned_datasheet_is_let_through_as_unsigned_and_only_if_that_is_allowed(
    verdict: str, allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed or untrusted one never is."""
    refused: list[str] = []

    def require(verified: Any) -> None:
        if verified.verdict != "authentic":
            refused.append(verified.verdict)
            raise NotAuthenticError("It is not.")

    monkeypatch.setattr(verified_session, "require_authentic", require)
    monkeypatch.setattr(verified_session, "shown_units", lambda *_: {})
    monkeypatch.setattr(verified_session, "channel_profiles", lambda *_: {})
    uuid = bytes(10)
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(get=lambda _: None),
        measurements=SimpleNamespace(frames={(uuid, 0): "base", (uuid, 2): "tip", (bytes([1]) * 10, 1): "other"}),
    )
    image = Image(uuid, load_profile("gripper").build(uuid).blocks)
    looked: Any = SimpleNamespace(image=image, verified=SimpleNamespace(verdict=verdict), kept=True)
    node: Any = SimpleNamespace(uuid=uuid)
    if verdict == "authentic" or (verdict == "unsigned" and allowed):
        found = verified_session.trusted_from(station, node, looked, unsigned=allowed)
        assert (found.unsigned, found.kept, found.name) == (verdict == "unsigned", True, "")
        assert found.frames == {0: "base", 2: "tip"}
        assert found.fingerprint == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
        assert refused == []
    else:
        with pytest.raises(NotAuthenticError):
            verified_session.trusted_from(station, node, looked, unsigned=allowed)
        assert refused == [verdict]


@pytest.mark.parametrize(
    ("left", "came", "asked", "answered"),
    [
        (10.25, 10.5, 10_250_000_000, 10_500_000_000),
        (0.0, 0.0, 1_000, 2_000),  # the link noticed neither
        (10.5, 10.25, 1_000, 2_000),
        (None, None, 1_000, 2_000),  # a link that notes no times
    ],
)
def test_the_times_of_a_clock_exchange_are_the_links_if_it_has_both(
    left: float | None, came: float | None, asked: int, answered: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ours hold the time for sealing and opening too."""
    moments = iter([1_000, 2_000])
    monkeypatch.setattr(verified_session, "time", SimpleNamespace(monotonic_ns=lambda: next(moments)))
    link: Any = SimpleNamespace() if left is None else SimpleNamespace(left=99.0, came=99.5)

    def request(_command: object, _doing: str) -> bytes:
        if left is not None:
            assert (link.left, link.came) == (0.0, 0.0), "those of the exchange before do not count"
            link.left, link.came = left, came
        return ClockReply(5, 6, 0, 1, 20, 0xFFFFFFFF).encode()

    node: Any = SimpleNamespace(contact=SimpleNamespace(link=link), request=request)
    reply, exchange = verified_session.ask_clock(node)
    assert (reply.received, reply.sent) == (5, 6)
    assert exchange == Exchange(asked, answered, 5, 6, 1, 20)
