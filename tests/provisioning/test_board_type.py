"""When a board is of another type, sentence by sentence, and which names its channels keep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import teds
from teds_provision.errors import NodeRefusedError
from teds_provision.provisioning import board_type
from teds_provision.provisioning.board_type import (
    WrongBoardError,
    differences,
    further,
    invalid_readings,
    is_remembered,
    misfit,
    require_board_type,
    topic_warnings,
)
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.codec.model import Units
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.profile.load import shipped_profiles
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit

UUID = bytes.fromhex("8d4d9da65281f7000000")
FORCE, VOLT, AMPERE, RADIAN = (parse_unit(text).units for text in ("N", "V", "A", "rad"))


def channel(kind: int | None = 0, units: Units | None = FORCE, model: int = 0, octets: int = 2) -> bytes:
    fields: dict[str, object] = {"Sample": {"DatModel": model, "ModLenth": octets, "SigBits": 8}}
    fields |= {"ChanType": kind} if kind is not None else {}
    return teds.compose(3, fields | ({"PhyUnits": units} if units is not None else {}))


def sheet(*channels: bytes, calibrated: bool = False) -> dict[BlockId, bytes]:
    found = {(number, 3): octets for number, octets in enumerate(channels, 1)}
    return found | ({(1, 5): b"x"} if calibrated else {})


def changes(has: dict[BlockId, bytes], wanted: dict[BlockId, bytes], **more: tuple[int, ...]) -> tuple[str, ...]:
    return differences(has, Image(UUID, wanted), **more)


@pytest.mark.parametrize(
    ("has", "wanted", "texts"),
    [
        (channel(), channel(), ()),
        (channel(1), channel(0), ("Channel 1 is an actuator, not a sensor.",)),
        (channel(0), channel(2), ("Channel 1 is a sensor, not an event sensor.",)),
        (channel(units=RADIAN), channel(), ("Channel 1 is in rad, not in N.",)),
        (channel(units=None), channel(), ()),
        (channel(), channel(units=None), ()),
        (channel(units=replace(FORCE, extension=7)), channel(), ()),
        (
            channel(octets=3),
            channel(),
            ("Channel 1 gives values of unsigned integer, 3 octets, not values of unsigned integer, 2 octets.",),
        ),
        (channel(model=1, octets=4), channel(), ("Channel 1 gives values of Float32",)),
        (
            channel(model=1, octets=4),
            channel(octets=4),
            ("Channel 1 gives values of Float32, 4 octets, not values of unsigned integer, 4 octets.",),
        ),
        (channel(None), channel(1), ()),  # it does not say
        (channel(1), channel(None), ()),
        (channel(1, RADIAN), channel(0), ("Channel 1 is an actuator, not a sensor.", "Channel 1 is in rad, not in N.")),
        (channel(units=VOLT), channel(), ("Channel 1 is in V, not in N.",)),
    ],
)
def test_what_a_board_says_of_itself_is_held_against_what_it_would_be_given(
    has: bytes, wanted: bytes, texts: tuple[str, ...]
) -> None:
    found = changes(sheet(has), sheet(wanted))
    assert len(found) == len(texts)
    assert all(text.startswith(start) for text, start in zip(found, texts, strict=True)), found


def test_a_raw_unit_is_no_claim_of_a_channel_that_gets_a_calibration() -> None:
    for units in (VOLT, AMPERE, Units(), Units(4), Units(1), replace(VOLT, extension=3)):
        assert changes(sheet(channel(units=units)), sheet(channel(), calibrated=True)) == ()
        assert changes(sheet(channel(units=units)), sheet(channel()), calibrated=(1,)) == ()
        assert len(changes(sheet(channel(units=units)), sheet(channel()), calibrated=(2,))) == 1
    assert len(changes(sheet(channel(units=RADIAN)), sheet(channel(), calibrated=True))) == 1


def test_a_channel_that_is_missing_is_a_difference_and_one_more_is_none() -> None:
    one, two = sheet(channel()), sheet(channel(), channel())
    assert changes(one, two) == ("Channel 2 is missing.",)
    assert changes(two, one) == ()
    assert further(two, Image(UUID, one)) == ("The board has more channels than the profile: 2.",)
    assert further(one, Image(UUID, two)) == further({}, Image(UUID, one)) == ()
    assert changes({(0, 12): b"x"}, two) == changes({}, two) == (), "a board without channels makes no claim"


def test_a_board_of_another_type_is_refused_by_its_first_difference() -> None:
    for more, text in (((), "one"), (("two.", "three."), "one (and 2 more)")):
        with pytest.raises(WrongBoardError) as refused:
            require_board_type(UUID, ("one.", *more))
        assert refused.value.message == f"Board {UUID.hex()} is of a different type: {text}. Nothing was written."
        assert refused.value.differences == ("one.", *more)


def test_a_datasheet_is_of_a_type_with_exactly_its_channels_and_units() -> None:
    profile = load_profile("gripper")
    built = dict(profile.build(UUID).blocks)
    assert misfit(Image(UUID, built), profile) == ""
    numbers = [part.number for part in profile.channels]
    last = max(numbers)
    fewer = {place: octets for place, octets in built.items() if place[0] != last}
    shown = ", ".join(map(str, numbers))
    assert misfit(Image(UUID, fewer), profile) == f"Its channels are {', '.join(map(str, numbers[:-1]))}, not {shown}."
    assert misfit(Image(UUID, {}), profile) == f"Its channels are none, not {shown}."
    more = {**built, (last + 1, 3): built[last, 3]}
    assert misfit(Image(UUID, more), profile).endswith(f", {last + 1}, not {shown}.")


def test_a_datasheet_of_a_type_states_its_units_and_not_only_calibrations(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text((shipped_profiles() / "load-cell.toml").read_text())
    profile = load_profile(str(tmp_path / "own.toml"))
    (one,) = profile.channels
    built = dict(profile.build(UUID).blocks)
    own = Sheet.from_image(Image(UUID, built)).channels[0]
    form = own.sample
    assert form is not None
    for units, why in (
        (own.units, ""),
        (replace(own.units, extension=9), ""),
        (None, "Channel 1 is in count, not in N."),
        (RADIAN, "Channel 1 is in rad, not in N."),
        (VOLT, "Channel 1 is in V, not in N."),  # a raw unit: no difference of a board, but no datasheet of this type
    ):
        block = channel(int(own.kind or 0), units, form.model, form.octets)
        assert misfit(Image(UUID, {**built, (1, 3): block}), profile) == why, units
    assert one.calibration.required
    beside = {**built, (2, 5): b"a calibration of a channel that nothing describes"}
    assert misfit(Image(UUID, beside), profile) == ""


def test_a_chosen_name_of_a_board_that_says_nothing_is_held_against_what_it_had(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    had = Image(UUID, sheet(channel()))
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: had)
    monkeypatch.setattr(type(station.measurements), "names_of", lambda *_: {1: "grip"})
    wanted, same = (Image(UUID, sheet(channel(units=units))) for units in (RADIAN, FORCE))
    for has in (None, Image(UUID, {}), Image(UUID, {(0, 12): b"x"})):
        (warning,) = topic_warnings(station, has, wanted)
        assert warning.startswith(
            "The chosen topic name 'grip' stays with channel 1, which was in N and is in rad now."
        )
        assert topic_warnings(station, has, same) == ()
    assert topic_warnings(station, Image(UUID, sheet(channel(units=RADIAN))), wanted) == (), "what it has goes before"


@pytest.mark.parametrize(
    ("profiles", "wanted", "factory", "known"),
    [
        (("gripper",), "gripper", False, True),
        (("gripper",), "load-cell", False, False),
        (("gripper",), "load-cell", True, True),  # ours, after a reset
        ((None, "gripper"), "gripper", False, True),  # the newest whose profile is known
        (("load-cell", "gripper"), "gripper", False, False),
        (("load-cell", "gripper"), "load-cell", False, True),
    ],
)
def test_a_board_is_remembered_as_what_it_was_last_written_to_be(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    profiles: tuple[str, ...],
    wanted: str,
    factory: bool,
    known: bool,
) -> None:
    history = [SimpleNamespace(profile=profile) for profile in profiles]
    station.nodes.remember(UUID, profile=wanted)  # by a build, or a bundle: what was written counts
    monkeypatch.setattr(type(station.datasheets), "history", lambda *_: history)
    assert is_remembered(station, UUID, wanted, factory=factory) == known


def test_a_chosen_name_that_will_mean_something_else_is_warned_about(station: Station) -> None:
    wanted = Image(UUID, sheet(channel(units=RADIAN), channel()))
    has = Image(UUID, sheet(channel(), channel(), channel()))
    assert topic_warnings(station, has, wanted) == ()
    names = {0: "arm", 1: "grip", 2: "same", 3: "gone", 4: "never"}
    station.measurements.names_of = lambda _uuid: names  # type: ignore[method-assign,assignment]
    cure = "To change it: names set 8d4d9da6"
    assert topic_warnings(station, has, wanted) == (
        f"The chosen topic name 'grip' stays with channel 1, which was in N and is in rad now. {cure} 1 NAME",
        f"The chosen topic name 'gone' stays with channel 3, which the new datasheet does not have. {cure} 3 NAME",
    )
    assert topic_warnings(station, Image(UUID, {}), wanted) == (), "nothing is known of what it had"
    extended = Image(UUID, sheet(channel(units=replace(FORCE, extension=9))))
    names = {1: "grip"}
    assert topic_warnings(station, has, extended) == ()


def test_which_board_is_remembered_as_one_of_its_type(station: Station) -> None:
    def known(wanted: str | None, *, factory: bool = False) -> bool:
        return is_remembered(station, UUID, wanted, factory=factory)

    assert not known("gripper")
    assert not known(None)
    assert not known("gripper", factory=True)
    station.nodes.remember(UUID, profile="gripper")
    assert known("gripper"), "it came in a bundle"
    assert known(None)
    assert not known("load-cell")
    station.datasheets.keep_draft(Draft(UUID, Image(UUID, {}), "built", "gripper"))
    assert not known("gripper"), "it was merely built"
    station.datasheets.drop_draft(UUID)
    assert known("gripper")


def test_the_words_of_invalid_readings() -> None:
    assert invalid_readings(["1"]) == "The reading of channel 1 is invalid."
    assert invalid_readings(["1", "3"]) == "The readings of channels 1, 3 are invalid."


@pytest.mark.parametrize(
    ("case", "gives"),
    [("valid", True), ("not valid", False), ("refused", False), ("refused at the sample", False), ("no form", False)],
)
def test_a_sensor_gives_a_value_if_its_own_says_so_and_is_let_go_in_any_case(
    monkeypatch: pytest.MonkeyPatch, case: str, gives: bool
) -> None:
    course: list[str] = []

    def request(_command: object, doing: str) -> bytes:
        course.append(doing)
        if case == "refused at the sample" and doing == "to sample":
            raise NodeRefusedError("It is busy.", reason=17)
        return b""

    def operate(_node: object, number: int, digest: bytes, *, lease: int) -> None:
        course.append(f"operate {number}")
        if case == "refused":
            raise NodeRefusedError("It is busy.", reason=17)

    monkeypatch.setattr(board_type, "operate", operate)
    monkeypatch.setattr(board_type.SampleReply, "decode", lambda *_: SimpleNamespace(valid=case == "valid"))
    sample = None if case == "no form" else SimpleNamespace(octets=2)
    channel: Any = SimpleNamespace(number=3, sample=sample)
    assert board_type._gives_value(cast(Any, SimpleNamespace(request=request)), channel, b"digest") is gives
    asked = {"refused": ["operate 3", "to let go"], "no form": []}
    assert course == asked.get(case, ["operate 3", "to sample", "to let go"])
