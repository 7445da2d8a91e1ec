"""The datasheet that a board brought: shown, judged as a profile is, and signed by a yes alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError, PolicyError, TedsProvisionError, UsageError
from teds_provision.measure.matching import NodeMatch, survey
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import Board as Hardware
from teds_provision.node.virtual import VirtualNode
from teds_provision.provisioning import adoption
from teds_provision.provisioning.adoption import (
    FactoryDatasheet,
    NotAdoptedError,
    read_factory_datasheet,
    refuse_adoption,
    require_a_reason,
)
from teds_provision.provisioning.agree import require_session, reset_node
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import NOTHING, SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station
from teds_provision.teds.calibration import read_calibrations
from teds_provision.teds.codec.frame import frame, raw_tuple, unframe
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile.load import load_profile
from teds_provision.teds.sheet import Sheet
from tests.answers import Answers
from tests.bench import on_reader
from tests.e2e.desk import ANGLE

UUID = bytes.fromhex("0badc0de5281f7000000")
ADOPT = BuildOrder(adopt=True)


def factory(uuid: bytes = UUID, name: str = "joint", slope: float = 359.9) -> dict[BlockId, bytes]:
    """Return what a good maker puts on an angle sensor: its own calibrated datasheet, signed by nobody."""
    profile = load_profile(ANGLE)
    points = f"# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,{slope}\n"
    return dict(profile.build(uuid, calibration=read_calibrations(points, "x.csv", profile), name=name).blocks)


def board(folder: Path, blocks: Mapping[BlockId, bytes], uuid: bytes = UUID) -> VirtualNode:
    FlashFile.create(folder, uuid=uuid, name="", max_message=2048, blocks=blocks).release()
    good = factory(uuid)
    return VirtualNode(folder, board=lambda _file: Hardware(Sheet.from_image(Image(uuid, good))))


def adopted(
    station: Station, node: VirtualNode, order: BuildOrder = ADOPT, raises: TedsProvisionError | None = None
) -> tuple[ProvisionResult, list[FactoryDatasheet]]:
    shown: list[FactoryDatasheet] = []

    def ask(brought: FactoryDatasheet) -> None:
        shown.append(brought)
        if raises is not None:
            raise raises

    with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
        done = provision(station, talk, order, operator=Answers(adopt=ask), reporter=SilentReporter())
    return done, shown


def test_a_board_with_a_good_datasheet_is_in_service_after_a_tap_and_one_yes(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory())
    done, [shown] = adopted(station, node)
    assert done.verified.verdict == "authentic"
    assert done.image.unsigned_blocks() == factory(), "not an octet of it changed"
    assert (shown.name, shown.errors, shown.warnings) == ("joint", (), ())
    assert [(channel.number, channel.name) for channel in shown.channels] == [(1, "angle")]
    assert station.nodes.resolve("joint") == UUID
    again, asked = adopted(station, node)
    assert not asked
    assert {step.result for step in again.steps if step.name in ("build", "sign", "write")} == {NOTHING}


def test_without_a_yes_it_stays_as_it_was(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory())
    with pytest.raises(PolicyError, match="no thanks"):
        adopted(station, node, raises=PolicyError("no thanks"))
    with (
        Conversation(on_reader(node), notice=lambda _notice: None) as talk,
        pytest.raises(NotAdoptedError, match="not approved for signing yet"),
    ):
        provision(station, talk, ADOPT, operator=AcceptingOperator(), reporter=SilentReporter())
    assert node.tim.flash.sequence == 0
    done, _ = adopted(station, node)
    assert done.verified.verdict == "authentic"


def test_an_adopted_node_is_recognised_as_the_type_that_its_datasheet_fits(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory())
    adopted(station, node)
    found = survey(station, NodeMatch.parse(f"type:{ANGLE}"))
    assert (found.matching, found.others) == ((UUID.hex(),), {})
    other = survey(station, NodeMatch.parse("type:gripper"))
    assert other.matching == ()
    assert other.others[UUID.hex()] == (
        "its type is unknown, and its datasheet does not fit gripper: its channels are 1, not 1, 2, 3"
    )
    cell = survey(station, NodeMatch.parse("type:load-cell")).others[UUID.hex()]
    assert "channel 1 is in rad, not in N" in cell, cell
    assert survey(station, NodeMatch.parse("type:no-such")).others[UUID.hex()].endswith("there is no profile no-such")


def test_another_name_goes_before_its_own(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory())
    done, [shown] = adopted(station, node, BuildOrder(adopt=True, name="elbow"))
    assert shown.name == Sheet.from_image(done.image).meta.name == "elbow"
    assert station.nodes.resolve("elbow") == UUID
    adopted(station, node, BuildOrder(adopt=True, name="wrist"))
    assert station.nodes.resolve("wrist") == UUID


def test_an_adopted_node_that_was_reset_is_asked_about_again(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory())
    adopted(station, node)
    with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
        who = identify(station, talk)
        require_session(station, talk)
        reset_node(station, talk, who)
    done, shown = adopted(station, node)
    assert len(shown) == 1
    assert done.verified.verdict == "authentic"


def test_what_the_guard_finds_needs_a_reason_and_that_is_logged(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", factory(slope=800.0))  # goes round more than twice
    with pytest.raises(NotAdoptedError, match="refused") as refused:
        adopted(station, node)
    assert refused.value.datasheet.errors
    assert "--accept-calibration" in refused.value.hint
    done, [shown] = adopted(station, node, BuildOrder(adopt=True, accept_calibration="two turns are right here"))
    assert shown.errors
    assert done.verified.verdict == "authentic"


def test_a_reason_is_logged_once_it_counts_and_not_for_a_dry_run(station: Station) -> None:
    image = Image(UUID, factory(slope=800.0))
    for record, entries in ((False, []), (True, ["two turns are right here"])):
        warnings = guard(station, image, None, "two turns are right here", record=record)
        assert len(warnings) == 1
        assert [
            entry.detail["why"] for entry in station.audit_log.entries() if entry.act == "accept-calibration"
        ] == entries
    with pytest.raises(PolicyError, match="The calibration is refused"):
        guard(station, image, None, None, record=False)


def named(blocks: dict[BlockId, bytes], channel: int, name: str) -> dict[BlockId, bytes]:
    return {**blocks, (channel, 12): teds.compose(12, {"Format": 0, "TCName": name})}


def with_tuple(blocks: dict[BlockId, bytes], block: BlockId, kind: int, value: bytes) -> dict[BlockId, bytes]:
    return {**blocks, block: frame(unframe(blocks[block]) + raw_tuple(kind, value))}


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        (named(factory(), 0, "joint\x1b[31m"), "unprintable"),
        (named(factory(), 1, "angle\u202egnp"), "unprintable"),
        (named(factory(), 1, "a\nb"), "unprintable"),
        (named(factory(), 0, "x" * 121), "more than 120 octets"),
        (named(factory(), 0, "ä" * 61), "more than 120 octets"),
        (
            {**factory(), (0, 10): teds.compose(10, [("Text", {"LangCode": "en", "Text": "<x>\x1b]0;pwned</x>"})])},
            "text",
        ),
        (factory(bytes.fromhex("0badc0de5281f7000001")), "belongs to node 0badc0de5281f7000001"),
        ({(0, 12): teds.compose(12, {"Format": 0, "TCName": "x"})}, "no TransducerChannel TEDS"),
        ({}, "no TransducerChannel TEDS"),
    ],
    ids=[
        "escape code",
        "reversed text",
        "two lines",
        "long",
        "long in UTF-8",
        "text",
        "another node",
        "no channel",
        "nothing",
    ],
)
def test_a_hostile_datasheet_is_never_signed(
    station: Station, tmp_path: Path, blocks: dict[BlockId, bytes], message: str
) -> None:
    node = board(tmp_path / "n", blocks)
    for order in (ADOPT, BuildOrder(adopt=True, accept_calibration="because")):
        with pytest.raises(BadDataError, match=message):
            adopted(station, node, order)
    assert node.tim.flash.sequence == 0


def test_a_name_with_slashes_is_a_name_and_no_path(station: Station, tmp_path: Path) -> None:
    done, [shown] = adopted(station, board(tmp_path / "n", named(factory(), 0, "../../etc/x")))
    assert shown.name == "../../etc/x"
    assert done.verified.verdict == "authentic"


@pytest.mark.parametrize("name", ["elbow", "4711abcd", "0x4711AB"], ids=["a name", "a UUID", "digits of a UUID"])
def test_another_nodes_name_needs_another_one(station: Station, tmp_path: Path, name: str) -> None:
    other = bytes.fromhex("4711abcd5281f7000000")
    with station.durable("test"):
        station.nodes.remember(other, name="elbow")
    node = board(tmp_path / "n", named(factory(), 0, name))
    with pytest.raises(PolicyError, match=f"node {other.hex()} already has that name") as refused:
        adopted(station, node)
    assert "--name" in refused.value.hint
    done, _ = adopted(station, node, BuildOrder(adopt=True, name="mine"))
    assert done.verified.verdict == "authentic"


def test_a_node_may_call_itself_by_its_own_digits(station: Station, tmp_path: Path) -> None:
    node = board(tmp_path / "n", named(factory(), 0, UUID.hex()[:8]))
    done, _ = adopted(station, node)
    assert done.verified.verdict == "authentic"
    with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
        reset_node(station, talk, identify(station, talk))
    done, _ = adopted(station, node)
    assert done.verified.verdict == "authentic", "this station knows it by now"


def test_two_hundred_channels_are_shown_and_signed(station: Station, tmp_path: Path) -> None:
    blocks = factory()
    many = {**blocks, **{(n, 3): blocks[1, 3] for n in range(2, 201)}}
    done, [shown] = adopted(station, board(tmp_path / "n", many), BuildOrder(adopt=True, accept_calibration="so it is"))
    assert len(shown.channels) == 200
    assert done.verified.verdict == "authentic"


def test_adopt_and_a_profile_exclude_each_other(station: Station, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--adopt"):
        adopted(station, board(tmp_path / "n", factory()), BuildOrder(ANGLE, adopt=True))


def test_what_is_judged_of_a_datasheet_that_was_brought_in_whole_words(station: Station) -> None:
    good = read_factory_datasheet(station, Image(UUID, factory()))
    assert (good.name, len(good.channels), good.errors, good.findings) == ("joint", 1, (), [])
    two_turns = read_factory_datasheet(station, Image(UUID, factory(slope=800.0)))
    assert [finding["severity"] for finding in two_turns.findings] == ["error"]
    assert two_turns.findings[0]["message"].startswith("channel 1: ")
    bare = {place: octets for place, octets in factory().items() if place[1] != 5}
    warned = read_factory_datasheet(station, Image(UUID, bare))
    assert warned.errors == ()
    assert "Channel 1 has no calibration: raw values cannot be turned into °." in warned.warnings
    hand = read_factory_datasheet(station, Image(UUID, dict(load_profile("gripper").build(UUID).blocks)))
    raw = [channel.number for channel in hand.channels if channel.value_problem]
    sensors = [channel.number for channel in hand.channels if channel.value_problem and not channel.actuator]
    assert raw != sensors, "an actuator without a calibration takes raw numbers, which is no fault"
    assert [text.split()[1] for text in hand.warnings if "has no calibration" in text] == [str(n) for n in sensors]
    renamed = read_factory_datasheet(station, Image(UUID, named(factory(), 0, "x" * 121)), name="mine")
    assert renamed.name == "mine", "the name that is replaced is not judged"
    full = read_factory_datasheet(station, Image(UUID, named(factory(), 1, "ä" * 60)))
    assert full.channels[0].name == "ä" * 60
    assert (0, 128) not in read_factory_datasheet(station, Image(UUID, {**factory(), (0, 128): b"x"})).image.blocks


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        (
            {**factory(), (0, 12): factory()[0, 12][:-1] + b"\0"},
            "TEDS 12 of channel 0 is damaged, or is one that no node",
        ),
        ({**factory(), (1, 12): factory()[1, 3]}, "TEDS 12 of channel 1 is damaged, or is one that no node can store"),
        (named(factory(), 0, "x" * 121), "the name in its XdcrName has more than 120 octets"),
        (named(factory(), 1, "x" * 121), "the name in its XdcrName of channel 1 has more than 120 octets"),
        (named(factory(), 1, "a\tb"), "TCName in its XdcrName of channel 1 contains unprintable characters"),
        (
            {**factory(), (0, 12): teds.compose(12, [("Format", 0), ("TCName", b"\xff")])},
            "the name in its XdcrName is no text",
        ),
        (
            {**factory(), (1, 4): teds.compose(4, [("Text", {"LangCode": "en", "Text": "<a>\x07</a>"})])},
            "a text in its ChanIdTEDS of channel 1 contains unprintable characters",
        ),
        (factory(bytes.fromhex("0badc0de5281f7000001")), "it belongs to node 0badc0de5281f7000001"),
    ],
)
def test_why_a_datasheet_that_was_brought_is_not_signed_in_whole_words(
    station: Station, blocks: dict[BlockId, bytes], message: str
) -> None:
    with pytest.raises(BadDataError) as refused:
        read_factory_datasheet(station, Image(UUID, blocks))
    assert refused.value.message.startswith(f"The datasheet that node {UUID.hex()} brought cannot be signed: {message}")
    assert refused.value.hint == "Write your own: provision --profile P."


def test_texts_of_several_lines_are_text_and_a_channel_may_lack_a_name(station: Station) -> None:
    text = teds.compose(4, [("Text", {"LangCode": "en", "Text": "<a>\n\t\r</a>"})])
    read_factory_datasheet(station, Image(UUID, {**factory(), (1, 4): text}))
    none = {place: octets for place, octets in factory().items() if place[1] != 12}
    assert read_factory_datasheet(station, Image(UUID, none)).name == ""
    with pytest.raises(BadDataError, match=r"has no datasheet of its own: no TransducerChannel TEDS\.$") as refused:
        read_factory_datasheet(station, Image(UUID, {(0, 1): factory()[0, 1]}))
    assert refused.value.hint == "To write one: provision --profile P."


@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("471", True),
        ("4711", False),
        ("0x4711", False),
        ("4711ABCD", False),
        ("0X4711", False),
        ("4712", True),
        ("0badc", True),
        ("xyz4711", True),
    ],
)
def test_four_digits_of_another_nodes_uuid_are_its_name(station: Station, name: str, free: bool) -> None:
    station.nodes.remember(bytes.fromhex("4711abcd5281f7000000"), name="elbow")
    station.nodes.remember(UUID, name="joint")
    image = Image(UUID, named(factory(), 0, name))
    if free:
        assert read_factory_datasheet(station, image).name == name
        return
    with pytest.raises(
        PolicyError, match=f"calls itself '{name}', but node 4711abcd5281f7000000 already has that name"
    ):
        read_factory_datasheet(station, image)


def test_a_reason_is_asked_for_by_the_first_error_and_kept_with_all_of_them(station: Station) -> None:
    brought = FactoryDatasheet(Image(UUID, {}), "x", (), ("one.", "two."), ("warned",))
    with pytest.raises(NotAdoptedError) as refused:
        require_a_reason(station, brought, None)
    assert refused.value.message == "The board's own datasheet is refused: one (and 1 more)."
    assert refused.value.datasheet is brought
    require_a_reason(station, brought, "because")
    (line,) = [line for line in station.audit_log.entries() if line.act == "accept-datasheet"]
    assert (line.uuid, line.outcome, line.detail) == (
        UUID,
        "accepted",
        {"why": "because", "findings": ["one.", "two."]},
    )
    require_a_reason(station, FactoryDatasheet(Image(UUID, {}), "x", (), (), ("warned",)), "because")
    assert len([line for line in station.audit_log.entries() if line.act == "accept-datasheet"]) == 1
    assert brought.findings == [
        {"severity": "error", "message": "one."},
        {"severity": "error", "message": "two."},
        {"severity": "warning", "message": "warned"},
    ]
    with pytest.raises(NotAdoptedError, match="brought its own datasheet, which is not approved for signing yet"):
        refuse_adoption(brought)


@pytest.mark.parametrize(("code", "lines"), [(130, True), (131, True), (12, False), (3, False)])
def test_only_origin_and_certificate_have_several_lines(code: int, lines: bool) -> None:
    assert adoption._is_shown("one\ntwo\n", (0, code)) is lines
    assert adoption._is_shown("one two", (0, code))
    assert not adoption._is_shown("one\x1btwo", (0, code))


def test_what_is_wrong_with_a_datasheet_is_named_once(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adoption, "_wrong_with", lambda *_: (["one", "one", "two\x1b"], ["same", "same"]))
    image = Image(bytes(10), dict(load_profile("gripper").build(bytes(10)).blocks))
    found = read_factory_datasheet(station, image)
    assert (len(found.errors), found.errors[0], found.warnings) == (2, "one", ("same",))
    assert "\x1b" not in found.errors[1]
