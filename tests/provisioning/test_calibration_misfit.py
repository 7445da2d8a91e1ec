"""A calibration is kept for the channel that it was made for, and for no other."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, CalibrationMisfitError, NotAuthenticError
from teds_provision.handover.life import plan_takeover, take_over
from teds_provision.provisioning import datasheet_edit
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.datasheet_edit import DatasheetChangedError, plan_sheet, write_sheet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.station import Station
from teds_provision.teds.calibration import Calibration, CalibrationInput, read_calibrations
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.channel import Channel, ChannelKind
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.guard import misfit
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit
from tests.bench import Board, talk

ANGLE = "magnetic-angular-position-sensor"
DEGREES = "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n"


def provisioned(station: Station, board: Board, order: BuildOrder) -> ProvisionResult:
    with talk(board) as node:
        return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())


@pytest.fixture
def calibrated(station: Station, board: Board, tmp_path: Path) -> Path:
    """Return a board that is a calibrated angle sensor."""
    path = tmp_path / "angle.csv"
    path.write_text(DEGREES)
    provisioned(station, board, BuildOrder(ANGLE, path))
    return path


@pytest.mark.parametrize("profile", ["temperature-sensor", "gripper", "load-cell"])
def test_degrees_are_never_published_as_something_else(
    station: Station, board: Board, calibrated: Path, profile: str
) -> None:
    before = board.state
    with pytest.raises(CalibrationMisfitError, match="channel 1") as refused:
        provisioned(station, board, BuildOrder(profile, retype=True))
    assert (refused.value.exit_code, refused.value.code) == (6, "calibration-misfit")
    assert "--no-calibration" in refused.value.hint
    with pytest.raises(CalibrationMisfitError):
        build(station, board.uuid, BuildOrder(profile, retype=True))
    assert board.state == before, "nothing is written"


def test_without_the_calibration_the_new_type_is_built(station: Station, board: Board, calibrated: Path) -> None:
    built = build(station, board.uuid, BuildOrder("load-cell", drop_calibration=True, retype=True))
    assert (1, AccessCode.CALIBRATION) not in built.image.blocks


def test_that_the_calibration_is_taken_away_is_said_of_a_datasheet_without_one(
    station: Station, board: Board, calibrated: Path
) -> None:
    had = station.datasheets.datasheet(board.uuid)
    assert had is not None
    bare = Image(board.uuid, {place: octets for place, octets in had.blocks.items() if place[1] != 5})
    away = ("channel 1: the calibration that the node has is taken away",)
    assert guard(station, bare, had, None, expected=("overdue",)) == away
    assert guard(station, bare, had, None, expected=("removed",)) == ()
    assert guard(station, bare, bare, None) == guard(station, bare, None, None) == ()


def test_the_same_type_keeps_it(station: Station, board: Board, calibrated: Path) -> None:
    built = build(station, board.uuid, BuildOrder(ANGLE, name="slew"))
    assert (1, AccessCode.CALIBRATION) in built.image.blocks
    assert any("keeps its calibration" in text for text in built.warnings)


def test_points_beyond_the_raw_range_are_kept_by_the_type_that_took_them(
    station: Station, board: Board, tmp_path: Path
) -> None:
    path = tmp_path / "force.csv"
    path.write_text("# date: 2026-10-01\nraw,value [N]\n0,-1000\n16777215,1000\n")
    assert provisioned(station, board, BuildOrder("load-cell", path)).verified.verdict == "authentic"
    built = build(station, board.uuid, BuildOrder("load-cell", name="left cell"))
    assert (1, AccessCode.CALIBRATION) in built.image.blocks


def test_a_draft_that_was_never_written_is_kept_for_its_own_type_alone(
    station: Station, board: Board, calibrated: Path
) -> None:
    build(station, board.uuid, BuildOrder(ANGLE, calibrated))
    with pytest.raises(CalibrationMisfitError):
        build(station, board.uuid, BuildOrder("load-cell", retype=True))


def test_a_spare_of_the_same_type_takes_the_calibration_with_its_unit(
    station: Station, board: Board, calibrated: Path
) -> None:
    spare = Board(uuid=bytes.fromhex("5eed0000000000000001"))
    provisioned(station, spare, BuildOrder(ANGLE))
    take_over(station, plan_takeover(station, board.uuid, spare.uuid, copy_calibration=True), None)
    draft = station.datasheets.draft(spare.uuid)
    assert draft is not None
    channel = Sheet.from_image(draft.image).channel(1)
    assert channel is not None
    assert channel.calibration is not None
    assert channel.calibration.unit.text == "°"
    assert channel.value_problem == ""


def test_a_datasheet_by_document_does_not_carry_a_calibration_to_another_unit(
    station: Station, board: Board, calibrated: Path
) -> None:
    """As PUT /teds writes it: the board's calibration beside a channel that is another one."""
    with talk(board) as node:
        blocks = dict(station.datasheets.datasheet(board.uuid).unsigned_blocks())  # type: ignore[union-attr]
        blocks[1, AccessCode.CHANNEL] = load_profile("load-cell").build(board.uuid).blocks[1, AccessCode.CHANNEL]
        with pytest.raises(WrongBoardError, match="in rad, not in N"):
            write_sheet(station, node, blocks, SilentReporter())
        with pytest.raises(CalibrationMisfitError):
            write_sheet(station, node, blocks, SilentReporter(), retype=True)
        del blocks[1, AccessCode.CALIBRATION]
        with pytest.raises(WrongBoardError):
            plan_sheet(station, node, blocks)
        assert plan_sheet(station, node, blocks, retype=True).changes
    assert station.datasheets.draft(board.uuid) is None, "nothing was begun"


def test_a_datasheet_by_document_keeps_a_draft_that_was_not_written(
    station: Station, board: Board, calibrated: Path
) -> None:
    blocks = dict(station.datasheets.datasheet(board.uuid).unsigned_blocks())  # type: ignore[union-attr]
    build(station, board.uuid, BuildOrder(ANGLE, name="trial"))
    draft = station.datasheets.draft(board.uuid)
    del blocks[1, AccessCode.CALIBRATION]
    with talk(board) as node:
        done = write_sheet(station, node, blocks, SilentReporter())
    assert any("draft drop" in warning for warning in done.plan.warnings)
    assert station.datasheets.draft(board.uuid) == draft


def test_a_datasheet_without_a_uuid_is_for_any_node_and_is_compared_with_what_was_read(
    station: Station, board: Board, calibrated: Path
) -> None:
    stored = station.datasheets.datasheet(board.uuid)
    assert stored is not None
    blocks = dict(stored.unsigned_blocks())
    blocks[0, AccessCode.META] = load_profile(ANGLE).build(bytes(10)).blocks[0, AccessCode.META]
    with talk(board) as node:
        digest = plan_sheet(station, node, blocks).present.image.digest()
        plan_sheet(station, node, blocks, expected=("00" * 32, digest))
        for expected in (("00" * 32,), ()):
            with pytest.raises(DatasheetChangedError, match="has changed since it was read"):
                plan_sheet(station, node, blocks, expected=expected)


def test_a_datasheet_by_document_that_cannot_be_written_or_is_not_authentic_in_the_end(
    station: Station, board: Board, calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = dict(station.datasheets.datasheet(board.uuid).unsigned_blocks())  # type: ignore[union-attr]
    stranger = load_profile(ANGLE).build(bytes([7]) * 10).blocks
    with talk(board) as node:
        for place, octets, words in (
            ((1, AccessCode.CHANNEL), blocks[1, AccessCode.CHANNEL][:-1] + b"\0", "TEDS 3 of channel 1 is damaged, or"),
            ((0, AccessCode.META), stranger[0, AccessCode.META], f"belongs to node {'07' * 10}, not to"),
        ):
            with pytest.raises(BadDataError, match=words):
                plan_sheet(station, node, {**blocks, place: octets})
        altered = Verification(board.uuid, (Check("signature", "failed", "it was altered"),))
        seen: list[Any] = []
        judged = SimpleNamespace(verified=altered)
        monkeypatch.setattr(datasheet_edit, "judge_and_keep", lambda *_, by: (seen.append(by), judged)[1])
        with pytest.raises(NotAuthenticError, match="it was altered"):
            write_sheet(station, node, blocks, SilentReporter())
    assert seen == ["write"]


def angle() -> tuple[Calibration, Channel]:
    profile = load_profile(ANGLE)
    made = read_calibrations(DEGREES, "angle.csv", profile)
    sheet = Sheet.from_blocks(profile.build(bytes(10), calibration=made).blocks)
    return sheet.calibrations[1], sheet.channels[0]


def test_what_is_compared() -> None:
    calibration, had = angle()
    form = had.sample
    assert form is not None
    assert misfit(calibration, had, had, load_profile(ANGLE).channel(1)) == ""
    assert misfit(calibration, had, replace(had, name="other", uncertainty=0.1), None) == ""
    for change, words in (
        ({"kind": ChannelKind.ACTUATOR}, "another type of channel (sensor, not actuator)"),
        ({"kind": ChannelKind.EVENT_SENSOR}, "event sensor"),
        ({"units": parse_unit("m").units}, "values in rad, and these are in m"),
        ({"sample": replace(form, model=3)}, "fraction"),
        ({"sample": SampleForm(0, 4)}, "4 octets"),
        ({"sample": replace(form, bits=12)}, "covers raw 0 to 65535"),
        ({"high": math.radians(90)}, "beyond the high limit"),
        ({"low": math.radians(10)}, "beyond the low limit"),
        ({"described": False}, "no such channel"),
    ):
        assert words in misfit(calibration, had, replace(had, **change), None), change  # type: ignore[arg-type]
    narrow = replace(had, sample=replace(form, bits=12))
    assert "gives raw 0 to 65535" in misfit(calibration, narrow, had, None)
    assert misfit(calibration, replace(had, described=False), had, None) == "nothing says for what channel it was made"


def test_samples_that_nothing_describes_are_compared_as_far_as_they_can_be() -> None:
    calibration, had = angle()
    unknown, floats = replace(had, sample=None), replace(had, sample=SampleForm(1, 4))
    for before, now, why in (
        (unknown, had, "nothing says how a sample is coded"),
        (had, unknown, "nothing says how a sample is coded"),
        (unknown, unknown, ""),
        (floats, floats, ""),  # floats have no range of raw values
    ):
        assert misfit(calibration, before, now, None) == why
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    without = replace(own.calibration, raw_range=None, method="")
    plain = {**own.fields, "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 24}}
    for raw, why in ((None, ""), ((0.0, 65535.0), "it was made for another range of raw values")):
        of = replace(own, fields=plain, calibration=replace(without, raw_range=raw))
        assert misfit(calibration, floats, floats, of) == why
    ranged = replace(calibration, raw_range=(0.0, 65535.0))
    of = replace(own, fields=plain, calibration=without)
    assert misfit(ranged, floats, floats, of) == "it was made for another range of raw values"


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        ((-100.0, 80000.0), ""),
        ((-5.0, 70000.0), ""),  # narrower than before, and yet wider than the points
        ((0.0, 65535.0), ""),
        ((0.0, 65534.0), ""),  # one raw value is a rounding
        ((1.0, 65535.0), ""),
        ((0.0, 65533.0), "it covers raw 0 to 65535, and this channel gives raw 0 to 65533"),
        ((2.0, 65535.0), "it covers raw 0 to 65535, and this channel gives raw 2 to 65535"),
        ((-102.0, 80000.0), "it was made for raw -100 to 80000, and this channel gives raw -102 to 80000"),
        ((-100.0, 80002.0), "it was made for raw -100 to 80000, and this channel gives raw -100 to 80002"),
    ],
)
def test_points_beyond_another_range_of_raw_values_do_not_fit(raw: tuple[float, float], why: str) -> None:
    calibration, had = angle()
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    of = replace(own, calibration=replace(own.calibration, raw_range=raw, method=""))
    assert misfit(replace(calibration, raw_range=(-100.0, 80000.0)), had, had, of) == why


def test_the_range_that_a_calibration_states_goes_before_that_of_its_samples() -> None:
    calibration, had = angle()
    assert misfit(replace(calibration, raw_range=(0.0, 60000.0)), had, had, None) == ""
    assert misfit(calibration, replace(had, kind=None), had, None) == (
        "it was made for another type of channel (unknown, not sensor)"
    )


@pytest.mark.parametrize(("high", "fits"), [(1_000_000.4375, True), (1_000_000.5, False), (999_999.5625, True)])
def test_of_samples_of_floats_a_range_is_the_same_within_four_steps_of_a_float32(high: float, fits: bool) -> None:
    """Four steps of a Float32 at a million are 0.477; whole numbers have one more."""
    calibration, had = angle()
    floats = replace(had, sample=SampleForm(1, 4))
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    fields = {**own.fields, "Sample": {"DatModel": 1, "ModLenth": 4, "SigBits": 24}}
    of = replace(own, fields=fields, calibration=replace(own.calibration, raw_range=(0.0, high), method=""))
    why = misfit(replace(calibration, raw_range=(0.0, 1e6)), floats, floats, of)
    assert (why == "") is fits
    if not fits:
        assert why.startswith("it was made for raw 0 to 1000000, and this channel gives raw 0 to 1000000.5")


def test_an_actuator_may_have_fewer_raw_values_than_before() -> None:
    """Its points are values that are set; the guard looks whether their raw numbers can be given."""
    calibration, had = angle()
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    of = replace(own, calibration=replace(own.calibration, raw_range=(10_000.0, 60_000.0), method=""))
    assert misfit(calibration, had, had, of).startswith("it covers raw 0 to 65535")
    acting = replace(had, kind=ChannelKind.ACTUATOR)
    assert misfit(replace(calibration, actuator=True), acting, acting, of) == ""


def test_of_several_inputs_the_channels_own_one_is_held_against_its_raw_values() -> None:
    _, had = angle()
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    of = replace(own, calibration=replace(own.calibration, raw_range=(0.0, 1000.0), method=""))
    for ends, why in (
        ((0.0, 100.0), ""),
        ((0.0, 2000.0), "it covers raw 0 to 2000, and this channel gives raw 0 to 1000"),
    ):
        parts = (CalibrationInput(2, 1, (0.0, 65535.0), (0.0,)), CalibrationInput(1, 1, ends, (0.0,)))
        two = Calibration(1, "polynomial", parts, (0.0, 1.0, 0.0, 0.0), unit=parse_unit("degree"))
        assert misfit(two, had, had, of) == why
        assert misfit(two, had, replace(had, high=0.1), None) == "", "its points are not known: the guard has them all"


@pytest.mark.parametrize(("below", "fits"), [(0.0, True), (1.6e-4, True), (2.05e-4, False), (25.0, False)])
def test_points_in_degrees_celsius_are_held_against_new_limits_to_four_steps_of_a_float32(
    below: float, fits: bool
) -> None:
    """Four steps of a Float32 at 398.15 K are 0.00019 K."""
    profile = load_profile("temperature-sensor")
    made = read_calibrations("raw,value [degC]\n0,-40\n21120,125\n", "t.csv", profile)
    had = Sheet.from_blocks(profile.build(bytes(10), calibration=made).blocks).channels[0]
    sure = replace(had, uncertainty=0.0)
    why = misfit(made[1], sure, replace(sure, high=398.15 - below), None)
    assert (why == "") is fits
    if below == 25.0:
        assert why == "its point of 125 °C is beyond the high limit of 100 °C"


def test_a_method_that_the_type_asks_for_is_compared() -> None:
    calibration, had = angle()
    own = load_profile(ANGLE).channel(1)
    assert own is not None
    asks = replace(own, calibration=replace(own.calibration, method="linear"))
    assert calibration.method != "linear" or misfit(calibration, had, had, asks) == ""
    other = replace(own, calibration=replace(own.calibration, method="steps"))
    assert "expects the method steps" in misfit(calibration, had, had, other)


def actuator() -> tuple[Calibration, Channel]:
    profile = load_profile("gripper")
    made = read_calibrations("# channel: 1\n# date: 2026-10-01\n0,0\n4095,110\n", "gripper.csv", profile)
    sheet = Sheet.from_blocks(profile.build(bytes(10), calibration=made).blocks)
    return sheet.calibrations[1], sheet.channels[0]


def test_points_are_held_against_limits_that_changed_and_within_the_uncertainty() -> None:
    """The highest point is 359.9 degrees."""
    calibration, had = angle()
    degrees = math.radians
    for change, words in (
        ({"low": -1.0, "high": degrees(90)}, "its point of 359.9 ° is beyond the high limit of 90 °"),
        ({"low": degrees(2), "high": degrees(400)}, "its point of 0 ° is beyond the low limit of 2 °"),
        ({"low": -degrees(180), "high": degrees(180)}, ""),  # a full turn: values wrap
        ({"high": degrees(359.5), "uncertainty": degrees(0.5)}, ""),
        ({"high": degrees(359.5), "uncertainty": degrees(0.3)}, "its point of 359.9 ° is beyond the high limit"),
        ({"high": degrees(359.5), "uncertainty": math.nan}, "its point of 359.9 ° is beyond the high limit"),
        ({"high": math.nan}, ""),
    ):
        assert misfit(calibration, had, replace(had, **change), None)[: len(words) or 99] == words, change  # type: ignore[arg-type]
    narrow = replace(had, high=degrees(90))
    assert misfit(calibration, narrow, narrow, None) == "", "limits that stay are the guard's"
    moves, motor = actuator()
    assert misfit(moves, motor, replace(motor, low=-1.0), None) == ""
    assert misfit(moves, motor, replace(motor, high=0.1), None) == (
        "its point of 110 mm is beyond the high limit of 100 mm"
    )
