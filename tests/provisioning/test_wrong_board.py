"""What a board says of its own type is held against what it would be given, and its hardware is asked at the end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError, NodeSilentError, PolicyError
from teds_provision.links import Contact, LinkSettings
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import Board as Hardware
from teds_provision.node.node_template import create
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.operation.commands import OPERATION, ChannelState, OperationReply
from teds_provision.provisioning import board_type
from teds_provision.provisioning.agree import require_session, reset_node
from teds_provision.provisioning.batch import BatchRun, ProvisionRequest
from teds_provision.provisioning.board_type import WrongBoardError, check_hardware, differences, is_remembered, operate
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.teds_read import read_image
from teds_provision.station.station import Station
from teds_provision.teds.image import Image
from teds_provision.teds.profile.load import load_profile
from teds_provision.teds.sheet import Sheet
from tests.answers import Answers
from tests.bench import Board, on_reader, talk
from tests.e2e.desk import ANGLE
from tests.measure.rig import CALIBRATIONS

GRIPPER, FORCE = "gripper", "load-cell"


def virtual(folder: Path, profile: str) -> VirtualNode:
    """Return a factory board with the hardware, and the unsigned datasheet, of a type."""
    create(folder, profile=profile)

    def board(file: FlashFile) -> Hardware:
        return Hardware(Sheet.from_image(Image(file.load().uuid, file.hardware)))

    return VirtualNode(folder, board=board)


@pytest.fixture
def angle(tmp_path: Path) -> VirtualNode:
    """Return a factory angle sensor."""
    return virtual(tmp_path / "angle", ANGLE)


def order(tmp_path: Path, profile: str | None, **more: bool) -> BuildOrder:
    if profile not in CALIBRATIONS:
        return BuildOrder(profile, **more)
    file = tmp_path / f"{profile}.csv"
    file.write_text(CALIBRATIONS[profile])
    return BuildOrder(profile, calibration=file, **more)


def given(station: Station, contact: Contact, what: BuildOrder, **answers: Callable[..., object]) -> ProvisionResult:
    with Conversation(contact, notice=lambda _notice: None) as node:
        return provision(station, node, what, operator=Answers(**answers), reporter=SilentReporter())


def test_a_factory_board_of_another_type_is_refused_before_it_becomes_ours(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    """A factory angle sensor tapped for a load cell's row of the sheet had passed, 100 %."""
    with pytest.raises(WrongBoardError, match="is in rad, not in N") as caught:
        given(station, on_reader(angle), order(tmp_path, FORCE))
    assert (caught.value.code, caught.value.exit_code) == ("wrong-board", 6)
    assert angle.tim.flash.state == NodeState.FACTORY
    assert station.pins.entry(angle.tim.flash.uuid) is None, "it was not whitelisted, and no key was agreed on"
    done = given(station, on_reader(angle), order(tmp_path, ANGLE))
    assert done.verified.verdict == "authentic"


@pytest.mark.parametrize("named", ["gripper", "load-cell"])
def test_a_finished_board_does_not_silently_become_another_one(
    station: Station, angle: VirtualNode, tmp_path: Path, named: str
) -> None:
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    before = angle.tim.flash
    with pytest.raises(WrongBoardError):
        given(station, on_reader(angle), order(tmp_path, named))
    assert angle.tim.flash == before
    with pytest.raises(WrongBoardError):
        build(station, before.uuid, order(tmp_path, named))
    assert station.datasheets.draft(before.uuid) is None


def test_with_retype_it_becomes_one_and_the_hardware_has_the_last_word(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    with pytest.raises(WrongBoardError, match=r"Channel 1 .* of the board does not match this datasheet"):
        given(station, on_reader(angle), order(tmp_path, GRIPPER, retype=True))


def test_a_chosen_topic_name_of_another_quantity_is_warned_about(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    """What was called crane/slew stayed crane/slew, in newtons."""
    uuid = angle.tim.flash.uuid
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    assert given(station, on_reader(angle), order(tmp_path, ANGLE)).warnings == ()
    station.measurements.rename(uuid, 1, "crane/slew")
    same = build(station, uuid, order(tmp_path, ANGLE), keep_draft=False)
    assert not any("topic" in warning for warning in same.warnings)
    built = build(station, uuid, BuildOrder(FORCE, retype=True, drop_calibration=True), keep_draft=False)
    [warning] = [warning for warning in built.warnings if "topic" in warning]
    assert warning.startswith(
        "The chosen topic name 'crane/slew' stays with channel 1, which was in rad and is in N now."
    )
    assert warning.endswith(f"names set {uuid.hex()[:8]} 1 NAME")


def test_at_a_terminal_a_yes_to_the_differences_is_enough(station: Station, angle: VirtualNode, tmp_path: Path) -> None:
    asked: list[tuple[str, ...]] = []
    with pytest.raises(WrongBoardError, match="does not match"):
        given(
            station, on_reader(angle), order(tmp_path, GRIPPER), retype=lambda _uuid, question: asked.append(question)
        )
    assert len(asked) == 1, "once, not before and after the key agreement"
    assert any("is a sensor, not an actuator" in text for text in asked[0])


def test_what_was_merely_built_for_a_board_makes_it_no_board_of_that_type(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    uuid = angle.tim.flash.uuid
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        identify(station, node)
    build(station, uuid, BuildOrder(FORCE))
    with pytest.raises(WrongBoardError):
        given(station, on_reader(angle), BuildOrder())


def test_what_was_built_for_a_board_counts_no_more_where_its_profile_is_known(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    """The profile may be that of what was built; without it, it is that of a node that came in a bundle."""
    uuid = angle.tim.flash.uuid
    with station.durable("test"):
        station.nodes.remember(uuid, profile=FORCE)
    assert is_remembered(station, uuid, FORCE, factory=False)
    assert is_remembered(station, uuid, None, factory=False)
    assert not is_remembered(station, uuid, ANGLE, factory=False)
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        identify(station, node)
    build(station, uuid, BuildOrder(FORCE))
    assert not is_remembered(station, uuid, FORCE, factory=False)


def test_our_own_board_after_a_reset_is_no_retype(station: Station, angle: VirtualNode, tmp_path: Path) -> None:
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        reset_node(station, node, identify(station, node))
    done = given(station, on_reader(angle), order(tmp_path, ANGLE))
    assert done.verified.verdict == "authentic"


def test_a_board_without_a_datasheet_says_nothing(station: Station, board: Board) -> None:
    done = given(station, talk(board).contact, BuildOrder(FORCE))
    assert done.verified.verdict == "authentic"
    assert [step.result for step in done.steps if step.name == "check"] == ["skipped"], "it does not measure"


def test_every_pair_of_types_that_differ_is_distinguished_and_each_fits_itself(station: Station) -> None:
    names = [ANGLE, GRIPPER, FORCE, "temperature-sensor"]
    made = {name: load_profile(name) for name in names}
    built = {name: dict(made[name].build(bytes(10)).blocks) for name in names}
    for text in names:
        for other in names:
            found = differences(built[text], made[other])
            assert bool(found) == (text != other), (text, other, found)
            assert bool(differences(built[text], Image(bytes(10), built[other]))) == (text != other)


def test_a_raw_unit_is_not_mentioned_if_a_calibration_is_requested(tmp_path: Path) -> None:
    profile = load_profile(ANGLE)
    raw = dict(profile.build(bytes(10)).blocks)
    text = (Path("profiles") / f"{ANGLE}.toml").read_text()
    volts = tmp_path / "volts.toml"
    volts.write_text(text.replace('unit = "degree"', 'unit = "V"').replace('unit = "rad"', 'unit = "V"'))
    wanted = load_profile(str(volts))
    if wanted.channels[0].unit == profile.channels[0].unit:
        pytest.skip("the profile names its unit in other words")
    own = dict(wanted.build(bytes(10)).blocks)
    assert differences(own, profile, calibrated=(1,)) == ()
    assert differences(raw, wanted, calibrated=(1,)), "a unit that says something is held against it"


# -- the check at the end --------------------------------------------------------------------------------------------


def test_the_check_shows_one_real_reading_and_claims_nothing(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    done = given(station, on_reader(angle), order(tmp_path, ANGLE))
    assert [step.name for step in done.steps][-1] == "check"
    assert done.steps[-1].result == "done"
    (sample,) = done.samples
    assert (sample["channel"], sample["unit"], sample["valid"]) == (1, "rad", True)
    assert 0 <= sample["value"] < 6.2832
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        require_session(station, node)
        reply = OperationReply.decode(node.request(OPERATION, "to tell its mode"))
    assert (reply.measuring, reply.channels[1]) == (False, (ChannelState(0), 0)), "nothing is claimed"


def test_reason_6_and_23_of_operate_have_words_of_their_own(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        require_session(station, node)
        with pytest.raises(
            NodeRefusedError, match=r"does not match its datasheet on channel 1.*\(reason 6\)"
        ) as caught:
            operate(node, 1, bytes(16), lease=5)
        assert caught.value.reason == Reason.DIGEST_MISMATCH
        assert "TEDS does not match its signed digest" not in caught.value.message
        borne = check_hardware(node, read_image(node))
        assert borne.channels == {1: True}


def test_a_session_that_the_node_lost_before_the_check_is_opened_again(
    station: Station, angle: VirtualNode, tmp_path: Path
) -> None:
    """Another one may be opened from this station's address at any time; exit 1, a bug, was the end of that."""
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        require_session(station, node)
        image = read_image(node)
        angle.lost("nfc")
        assert check_hardware(node, image).channels == {1: True}


def test_a_node_that_keeps_no_session_is_reported_and_is_no_bug(
    station: Station, angle: VirtualNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given(station, on_reader(angle), order(tmp_path, ANGLE))
    with Conversation(on_reader(angle), notice=lambda _notice: None) as node:
        require_session(station, node)
        image = read_image(node)
        opens = node.open

        def lost_at_once(key: bytes) -> None:
            opens(key)
            angle.lost("nfc")

        monkeypatch.setattr(node, "open", lost_at_once)
        angle.lost("nfc")
        with pytest.raises(NodeRefusedError, match="reason 2"):
            check_hardware(node, image)


# -- sheets ----------------------------------------------------------------------------------------------------------


def test_a_row_of_a_sheet_waits_for_its_own_board(station: Station, angle: VirtualNode, tmp_path: Path) -> None:
    sheet = tmp_path / "boards.csv"
    sheet.write_text("uuid,name,profile\n,cell,load-cell\n")
    boards = BatchRun(station, LinkSettings("nfc"), ProvisionRequest(None, BuildOrder(), sheet=sheet), SilentReporter())
    asked = AcceptingOperator()
    from teds_provision.provisioning.batch_sheet import BoardResult as Ended

    def tap(contact: Contact) -> Ended:
        with Conversation(contact, notice=lambda _notice: None) as node:
            try:
                done = boards._provision(node, asked)
            except PolicyError as error:
                return Ended(node.uuid, 1.0, None, error, boards._rows.pop(node.uuid).number)
            return Ended(node.uuid, 1.0, done, None, boards._rows.pop(node.uuid).number)

    wrong = tap(on_reader(angle))
    boards._note(wrong)
    assert isinstance(wrong.error, WrongBoardError)
    assert [row.number for row in boards.progress.open] == [1]  # type: ignore[union-attr]
    right = tap(on_reader(virtual(tmp_path / "force", FORCE)))
    boards._note(right)
    assert (right.row, right.result) == (1, "passed")
    assert boards.totals().passed == 1


def test_a_board_of_the_bus_that_failed_gives_its_row_back_to_the_next_board(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sheet = tmp_path / "boards.csv"
    sheet.write_text("uuid,name,profile\n,cell,load-cell\n")
    boards = BatchRun(station, LinkSettings("can"), ProvisionRequest(None, BuildOrder(), sheet=sheet), SilentReporter())

    def takes_a_row(node: Conversation, _operator: Any, _reporter: Any = None) -> None:
        boards._for(SimpleNamespace(uuid=node.uuid, fingerprint="ab" * 32))  # type: ignore[arg-type]
        raise NodeSilentError("It does not answer any more.")

    monkeypatch.setattr(boards, "_provision", takes_a_row)
    for number in (1, 2):
        board = virtual(tmp_path / f"board{number}", FORCE)
        done = boards._board(on_reader(board), "bus", AcceptingOperator())
        assert done is not None
        assert isinstance(done.error, NodeSilentError)
        assert (done.row, boards._rows) == (1, {})
        boards._note(done)


def test_channels_without_a_valid_reading_are_counted_in_the_warning() -> None:
    assert board_type.invalid_readings(["2"]) == "The reading of channel 2 is invalid."
    assert board_type.invalid_readings(["2", "3"]) == "The readings of channels 2, 3 are invalid."
