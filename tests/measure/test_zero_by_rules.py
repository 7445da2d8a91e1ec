"""Refusals and warnings of `calibrate zero` and `calibrate capture`; the node is a mock."""

from __future__ import annotations

import math
import struct
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import BadDataError, LinkError, NotFoundError, PolicyError
from teds_provision.measure import capture, zero
from teds_provision.measure.sample_series import SampleSeries, take_samples_of
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.measure.zero import ZeroOrder
from teds_provision.protocol.messages.frames import Command, Function
from teds_provision.protocol.operation.commands import ChannelState, OperationReply, SampleReply
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.teds.calibration import Calibration, ChannelInterpreter, fit
from teds_provision.teds.calibration.model import CalibrationInput
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit
from tests.measure.test_steady import ANGLE, DEGREES, TEMPERATURE, series
from tests.teds.test_interpreter import UUID, changed, sheet_of

CURVE = fit([(1000, 0.0), (3000, 20.0)], "linear", channel=1)
SHEET = sheet_of("tactile-finger-sensor", {1: CURVE})


class Node:
    """A session with a node: ``flags`` of each reply to Sample, then silence; what it was asked."""

    def __init__(self, flags: str = "", states: dict[int, tuple[ChannelState, int]] | None = None) -> None:
        self.flags, self.states = list(flags), states or {}
        self.asked: list[tuple[str, int, bytes]] = []

    def request(self, command: Command, doing: str, **_how: Any) -> bytes:
        self.asked.append((doing, command.channel, command.payload))
        if command.function == Function.OPERATION:
            return OperationReply(True, self.states).encode()
        if doing != "to sample":
            return b""
        if not self.flags:
            raise LinkError("The node does not answer.")
        data = struct.pack(f">{len(command.payload)}H", *(100 * number + len(self.flags) for number in command.payload))
        return SampleReply(5, int(self.flags.pop(0)), data).encode()


def session(node: Node, sheet: Sheet = SHEET) -> VerifiedSession:
    talks: Any = node
    return VerifiedSession(talks, sheet, "5a" * 32, "finger")


def test_a_series_is_sampled_under_a_claim_and_the_sensor_is_let_go() -> None:
    node = Node("000")
    found = take_samples_of(session(node), 1, count=3, seconds=0.0)
    assert found.raw.tolist() == [103, 102, 101]
    assert found.others == {}
    assert [doing for doing, *_ in node.asked[1:]] == ["to sample"] * 3 + ["to let go"]
    assert [payload for doing, _, payload in node.asked if doing == "to sample"] == [b"\1"] * 3
    assert node.asked[-1][1] == 0, "every channel of it"


def test_a_compensated_sensor_is_sampled_together_with_what_its_curve_takes() -> None:
    inputs = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", inputs, (0.0, 0.001, 0.0001, 0.0), unit=parse_unit("N"))
    node = Node("00")
    found = take_samples_of(session(node, sheet_of("tactile-finger-sensor", {1: both})), 1, count=2, seconds=0.0)
    assert (found.raw.tolist(), {number: raw.tolist() for number, raw in found.others.items()}) == (
        [102, 101], {2: [202, 201]},
    )  # fmt: skip
    assert [payload for doing, _, payload in node.asked if doing == "to sample"] == [b"\1\2"] * 2
    assert len([doing for doing, *_ in node.asked if doing not in ("to sample", "to let go")]) == 2, "a claim of each"


def test_a_sample_that_the_node_marks_ends_the_series_and_lets_the_sensor_go() -> None:
    node = Node("01")
    with pytest.raises(PolicyError) as refused:
        take_samples_of(session(node), 1, count=3, seconds=0.0)
    assert refused.value.message == (
        "The node marks the reading of channel 1 as invalid: it is warming up, or has a fault."
    )
    assert refused.value.hint == "See: teds-provision mode UUID"
    assert [doing for doing, *_ in node.asked][-1] == "to let go"
    silent = Node("0")
    with pytest.raises(LinkError):
        take_samples_of(session(silent), 1, count=3, seconds=0.0)
    assert [doing for doing, *_ in silent.asked][-1] == "to let go"


def test_an_actuator_has_no_reading_and_is_not_claimed() -> None:
    node = Node("000")
    trusted = session(node, changed(SHEET, kind=ChannelKind.ACTUATOR))
    label = trusted.channel(1).label
    for call in (lambda: take_samples_of(trusted, 1), lambda: zero._adjustable(trusted, 1)):
        with pytest.raises(BadDataError) as refused:
            call()
        assert refused.value.message == f"Channel {label} of node {UUID.hex()} is an actuator, not a sensor."
    assert node.asked == []


@pytest.mark.parametrize(("problem", "why"), [("", "it has none."), ("it is damaged.", "it is damaged.")])
def test_only_a_calibration_has_an_offset_to_change(problem: str, why: str) -> None:
    trusted = session(Node(), changed(SHEET, calibration=None, calibration_problem=problem))
    with pytest.raises(PolicyError) as refused:
        zero._adjustable(trusted, 1)
    label = trusted.channel(1).label
    assert refused.value.message == f"Channel {label} has no calibration with an offset that can be changed: {why}"
    assert refused.value.hint == "Calibrate it first: calibrate capture, then provision with --calibration FILE."
    channel, own = zero._adjustable(session(Node()), 1)
    assert (channel.number, own) == (1, channel.calibration)


def test_a_node_that_another_station_measures_keeps_its_datasheet() -> None:
    for state in (ChannelState.CLAIMED_HERE, ChannelState(0), ChannelState.SAFE):
        zero._require_nobody_else(session(Node(states={1: (state, 0xF1)})))
    other = {1: (ChannelState(0), 0), 2: (ChannelState.CLAIMED_BY_OTHER | ChannelState.SAFE, 0xE7)}
    other[3] = ChannelState.CLAIMED_BY_OTHER, 0xE9
    with pytest.raises(PolicyError) as refused:
        zero._require_nobody_else(session(Node(states=other)))
    assert refused.value.message == f"Node {UUID.hex()} is being measured by another station, source address 0xE7."
    assert refused.value.hint == "End that measurement first. A running ncap of this home releases the node by itself."


def run_of(order: ZeroOrder, draft: object = None) -> Any:
    station = SimpleNamespace(datasheets=SimpleNamespace(draft=lambda _uuid: draft))
    visit: Any = SimpleNamespace(station=station, node=SimpleNamespace(uuid=UUID))
    nothing: Any = None
    return zero._ZeroRun(visit, order, nothing, nothing, dry_run=True)


def test_a_reading_beyond_its_curve_and_a_draft_are_warned_of() -> None:
    one = ChannelInterpreter(SHEET, 1)
    within, beyond = (SampleSeries(one, np.array(raw, dtype=np.uint64), {}) for raw in ([1000, 3000], [2000, 3001]))
    beyond_it = "The reading is outside the calibrated range (raw 1000 to 3000)."
    drafted = "This node has a draft, which does not include this zero offset; to drop it: draft drop UUID."
    for settled, draft, warnings in (
        (within, None, ()), (beyond, None, (beyond_it,)), (within, "draft", (drafted,)),
        (beyond, "draft", (beyond_it, drafted)),
    ):  # fmt: skip
        own = one.channel.calibration
        assert own is not None
        calibrated = replace(own, inputs=(replace(own.inputs[0], boundaries=(1000.0, 3000.0)),))
        channel: Any = SimpleNamespace(
            calibrated=settled.calibrated, extrapolated=max(settled.raw.tolist()) > 3000, interpreter=one
        )
        assert run_of(ZeroOrder(1), draft)._warnings(channel, calibrated) == warnings


@pytest.mark.parametrize(
    ("value", "unit", "low", "high", "uncertainty", "wanted"),
    [
        (None, "degC", 233.15, 400.0, 0.5, 0.0),
        (300.0, None, 233.15, 400.0, 0.5, 26.85),
        (127.35, "degC", 233.15, 400.0, 0.5, 127.35),
        (127.36, "degC", 233.15, 400.0, 0.5, "127.36 degC"),
        (-40.49, "degC", 233.15, 400.0, 0.5, -40.49),
        (-40.51, "degC", 233.15, 400.0, 0.5, "-40.51 degC"),
        (126.86, "degC", 233.15, 400.0, math.nan, "126.86 degC"),
        (126.86, "degC", 233.15, 400.0, -3.0, "126.86 degC"),
        (126.84, "degC", 233.15, 400.0, -3.0, 126.84),
        (500.0, None, 233.15, 400.0, 0.5, "226.85 °C"),
        (500.0, "degC", math.nan, math.nan, 0.5, 500.0),
    ],
)  # fmt: skip
def test_a_zero_may_be_wanted_within_the_limits_and_the_uncertainty(
    value: float | None, unit: str | None, low: float, high: float, uncertainty: float, wanted: float | str
) -> None:
    settled = series(TEMPERATURE, DEGREES, [8000.0], low=low, high=high, uncertainty=uncertainty)
    channel = settled.interpreter.channel
    own = channel.calibration
    assert own is not None
    run = run_of(ZeroOrder(1, value, unit))
    if not isinstance(wanted, str):
        assert run._wanted(channel, own) == pytest.approx(wanted)
        return
    with pytest.raises(PolicyError) as refused:
        run._wanted(channel, own)
    shown = wanted.partition(" ")[2]
    assert refused.value.message == (
        f"{wanted} exceeds the limits of channel 1 (temperature), -40 {shown} to 126.85 {shown}."
    )
    assert refused.value.hint == "Limits come from the signed datasheet and cannot be exceeded."


def test_an_angle_over_a_full_turn_has_no_limit_and_is_shown_within_its_turn() -> None:
    settled = series(ANGLE, "# date: 2026-10-01\nraw,value [degree]\n0,0\n65536,360\n", [8000.0])
    channel = settled.interpreter.channel
    own = channel.calibration
    assert own is not None
    assert run_of(ZeroOrder(1, 500.0, "degree"))._wanted(channel, own) == pytest.approx(500.0)
    for degrees, si in ((90.0, math.pi / 2), (450.0, math.pi / 2), (-90.0, 1.5 * math.pi), (-1e-9, 0.0), (0.0, 0.0)):
        assert zero._si(channel, own, degrees) == pytest.approx(si, abs=1e-12)
    near = -2e-6 * 360  # more than what Float32 rounds: it stays below the whole turn
    assert zero._si(channel, own, near) == pytest.approx(math.tau * (1 - 2e-6))
    straight = series(TEMPERATURE, DEGREES, [8000.0]).interpreter.channel
    assert straight.calibration is not None
    assert zero._si(straight, straight.calibration, -300.0) == pytest.approx(-26.85)


def test_raw_values_that_are_no_numbers_give_neither_point_nor_reading() -> None:
    floats = {"sample": SampleForm(1, 4), "dtype": "float32"}
    for bad in (math.nan, math.inf):
        settled = series(TEMPERATURE, None, [1.0, bad], **floats)
        with pytest.raises(PolicyError, match=r"^Channel 1 delivers raw values that are not numbers\.$"):
            capture._point(settled, 300.0)
    impossible = series(TEMPERATURE, DEGREES, [8000.0, 4096.0], sample=SampleForm(0, 2, 12))
    with pytest.raises(PolicyError, match=r"^Channel 1 delivers raw values that its type does not allow\.$"):
        impossible.calibrated()
    assert series(TEMPERATURE, DEGREES, [4095.0], sample=SampleForm(0, 2, 12)).calibrated().tolist() == pytest.approx(
        [-8.0078125]
    )


@pytest.mark.parametrize("does", ["capture", "zero"])
def test_a_session_that_is_lost_meanwhile_is_reported_by_its_cause_and_nothing_is_written(
    does: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cause = LinkError("The node does not answer.")
    held: list[Any] = []

    @contextmanager
    def own(_station: Any, links: Any, command: str, *, shared: bool) -> Any:
        held.append((links, command, shared))
        yield "own"

    @contextmanager
    def at_node(_station: Any, links: Any, uuid: bytes, _reporter: Any, **how: Any) -> Any:
        held.append((links, uuid, how))
        yield SimpleNamespace(node="node", station=station)

    def lost(*_words: Any, **_how: Any) -> None:
        raise SessionLostError(cause)

    required: list[bytes] = []
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(resolve=lambda _name: UUID), policy=SimpleNamespace(require_whitelisted=required.append)
    )
    links: Any = SimpleNamespace(after_agreeing=lambda: "links")
    reporter: Any = SimpleNamespace()
    module = capture if does == "capture" else zero
    monkeypatch.setattr(module, "own_source_address", own)
    monkeypatch.setattr(module, "at_node", at_node)
    monkeypatch.setattr(capture, "open_trusted", lost)
    monkeypatch.setattr(zero, "require_session", lost)
    file = tmp_path / "c.csv"
    call = {
        "capture": lambda: capture.capture_at(station, links, "finger", 1, 5.0, file, reporter),
        "zero": lambda: zero.zero_at(station, links, "finger", ZeroOrder(1), reporter),
    }[does]
    with pytest.raises(LinkError) as failed:
        call()
    assert failed.value is cause
    assert held == [
        ("links", f"calibrate {does} {UUID.hex()}", False),
        ("own", UUID, {} if does == "capture" else {"unlock": "always", "writes": "calibrate zero"}),
    ]
    assert required == ([] if does == "capture" else [UUID])
    assert list(tmp_path.iterdir()) == []
    if does == "zero":
        held.clear()
        with pytest.raises(LinkError):
            zero.zero_at(station, links, "finger", ZeroOrder(1), reporter, dry_run=True)
        assert held[1][2] == {"unlock": "always", "writes": ""}, "a plan asks no other process to let the node go"
    else:
        with pytest.raises(NotFoundError, match=r"^There is no folder .*none\.$"):
            capture.capture_at(station, links, "finger", 1, 5.0, tmp_path / "none" / "c.csv", reporter)


@pytest.mark.parametrize(
    ("values", "possible"),
    [([1.0, 2.0], [True, False]), ([1.0, math.inf], [True, True]), ([math.nan, 1.0], [True, True])],
)
def test_one_raw_value_that_cannot_be_spoils_a_series(values: list[float], possible: list[bool]) -> None:
    interpreter: Any = SimpleNamespace(
        calibrated=lambda _raw, _others: (np.array(values), np.array(possible), None),
        channel=SimpleNamespace(number=7),
    )
    with pytest.raises(PolicyError, match=r"^Channel 7 delivers raw values that its type does not allow\.$"):
        SampleSeries(interpreter, np.array([1, 2], dtype=np.uint64), {}).calibrated()
