"""What is staged, in which order and pieces, what is too old or too far ahead, and what the store keeps of a write."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import teds
from teds_provision.errors import (
    BadDataError,
    GarbledError,
    NodeRefusedError,
    NodeSilentError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning import write as writing
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.sign import SignOrder, sign_image
from teds_provision.provisioning.write import write
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, MemoryLink, talk

from .test_provision import run


@pytest.fixture
def image(station: Station, board: Board) -> Image:
    return run(station, board).image


def renamed(image: Image, name: str) -> Image:
    return image.with_block((0, 12), teds.compose(12, {"Format": 0, "TCName": name}))


@pytest.mark.parametrize(
    ("sequence", "epoch", "jump", "message"),
    [
        (10, 2, False, "The image has sequence 10; the node is already at 10."),
        (9, 3, False, "The image has sequence 9; the node is already at 10."),
        (11, 2, False, ""),
        (11, 1, False, "The image was signed for key epoch 1; the node is at 2."),
        (11, 3, True, "The image was signed for key epoch 3; the node is at 2."),
        (10 + 65536, 2, False, ""),
        (
            11 + 65536,
            2,
            False,
            "The image has sequence 65547, far ahead of the node's 10: earlier data about this node",
        ),
        (11 + 65536, 2, True, ""),
    ],
)
def test_an_image_is_newer_than_the_nodes_and_of_its_epoch(
    station: Station, sequence: int, epoch: int, jump: bool, message: str
) -> None:
    identity = Identity(bytes(10), NodeState.PROVISIONED, 2, 10, 1024, 0)
    signed: Any = type("Signed", (), {"sequence": sequence, "key_epoch": epoch})
    if not message:
        writing._require_newer(station, bytes(10), signed, identity, jump=jump)
        return
    with pytest.raises(PolicyError) as refused:
        writing._require_newer(station, bytes(10), signed, identity, jump=jump)
    assert refused.value.message.startswith(message)
    again = f"Sign it again for the node as it is now: teds-provision sign {'00' * 10} --read-node"
    assert refused.value.hint.startswith(again)
    assert ("--sequence-jump" in refused.value.hint) == ("far ahead" in message)


@dataclass
class MockNode:
    """Mock of a conversation in a session: takes writes, loses those that ``lost`` counts."""

    max_message: int = 153
    lost: list[bool] = field(default_factory=list)
    alive: bool = True
    written: list[tuple[str, int]] = field(default_factory=list)

    @property
    def identity(self) -> Any:
        return self

    def is_alive(self) -> bool:
        return self.alive

    def request(self, command: Any, what: str) -> bytes:
        if self.lost and self.lost.pop(0):
            raise NodeSilentError("lost")
        self.written.append((what, len(command.payload) - 5))
        return b""


BLOCKS = {(0, 1): bytes(100), (0, 12): bytes(101), SECURITY: bytes(30), (1, 3): bytes(7)}


def stage(station: Station, node: MockNode, skip: set[tuple[int, int]], progress: Any = None) -> int:
    return writing._stage(station, node, Image(bytes(10), BLOCKS), skip, progress)  # type: ignore[arg-type]


def test_teds_go_in_pieces_of_what_the_node_takes_and_the_security_teds_last(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, seen = MockNode(), []
    flushed: list[int] = []
    monkeypatch.setattr(station, "flush", lambda: flushed.append(len(node.written)))
    assert stage(station, node, {(0, 7)}, lambda done, total: seen.append((done, total))) == 238
    assert node.written == [
        ("TEDS 1 of channel 0", 100),
        ("TEDS 12 of channel 0", 100),
        ("TEDS 12 of channel 0", 1),
        ("TEDS 3 of channel 1", 7),
        ("TEDS 128 of channel 0", 30),
    ]
    assert seen == [(100, 238), (200, 238), (201, 238), (208, 238), (238, 238)]
    assert flushed == [4], "the sequence is on the disk before the signature leaves"
    node.written.clear()
    assert stage(station, node, {(0, 1), (1, 3)}) == 131
    assert [what for what, _ in node.written] == ["TEDS 12 of channel 0"] * 2 + ["TEDS 128 of channel 0"]


def test_pieces_shrink_with_each_loss_to_48_octets_and_twenty_losses_are_borne(station: Station) -> None:
    node = MockNode(lost=[True, False, True, True] + [False] * 20)
    assert stage(station, node, set(BLOCKS) - {(0, 1)}) == 100
    assert [octets for _, octets in node.written] == [50, 48, 2]
    node = MockNode(max_message=1053, lost=[True])
    assert stage(station, node, set(BLOCKS) - {(0, 12)}) == 101
    assert [octets for _, octets in node.written] == [50, 50, 1], "half of what was lost, not of what could be sent"
    node = MockNode(lost=[True] * 20)
    assert stage(station, node, set(BLOCKS) - {(1, 3)}) == 7
    with pytest.raises(NodeSilentError):
        stage(station, MockNode(lost=[True] * 21), set(BLOCKS) - {(1, 3)})
    dead = MockNode(lost=[True], alive=False)
    with pytest.raises(NodeSilentError):
        stage(station, dead, set())


def test_what_is_on_the_node_after_a_commit_is_known_unless_there_was_more() -> None:
    image = Image(bytes(10), BLOCKS)
    assert writing._after_commit(image, None) is None
    assert writing._after_commit(image, Image(bytes(10), {(0, 1): b"old"})) is image
    assert writing._after_commit(image, Image(bytes(10), {(9, 9): b"more"})) is None


def test_equal_teds_are_not_sent_again_but_the_security_teds_is(station: Station, image: Image) -> None:
    all_but = set(image.unsigned_blocks())
    assert writing._blocks_there(station, image, image) == all_but
    assert writing._blocks_there(station, image, None) == all_but, "by the last reading"
    assert writing._blocks_there(station, renamed(image, "x"), image) == all_but - {(0, 12)}
    assert writing._blocks_there(station, Image(bytes(9) + b"\1", image.blocks), None) == set()


def test_a_write_is_in_the_store_with_its_facts_and_ends_its_own_draft_alone(
    station: Station, board: Board, image: Image
) -> None:
    station.datasheets.keep_draft(Draft(image.uuid, renamed(image, "new"), "built", "gripper"))
    signed = sign_image(station, SignOrder(image.uuid), None).signed.image
    with talk(board) as node:
        require_session(station, node)
        done = write(station, node, signed, facts={"name": "new"})
        station.flush()
        assert node.proven is not None
        assert (node.proven.sequence, node.proven.state) == (2, NodeState.PROVISIONED)
    assert done.on_node == signed
    assert done.octets == len(signed.blocks[0, 12]) + len(signed.blocks[SECURITY])
    known = station.nodes.get(image.uuid)
    assert known is not None
    assert known.name == "new"
    assert station.datasheets.draft(image.uuid) is None
    line = [entry for entry in station.audit_log.entries() if entry.act == "write"][-1]
    assert (line.uuid, line.outcome, line.detail) == (image.uuid, "done", {"octets": done.octets, "sequence": 2})
    newer = Draft(image.uuid, renamed(image, "newer"), "built", None)
    station.datasheets.keep_draft(newer)
    third = sign_image(station, SignOrder(image.uuid, renamed(signed, "third")), None).signed.image
    with talk(board) as node:
        require_session(station, node)
        assert write(station, node, third).octets > 0
    station.flush()
    kept = station.datasheets.draft(image.uuid)
    assert kept is not None
    assert kept.image == newer.image
    with talk(board) as node:
        require_session(station, node)
        assert write(station, node, third).octets == 0, "all of it is there"
        with pytest.raises(BadDataError, match="The image is not signed"):
            write(
                station,
                node,
                third.with_block(SECURITY, replace(security.decode(third.blocks[SECURITY]), signature=None).encode()),
            )


@dataclass
class LosesCommit(MemoryLink):
    """The reply to the first commit is lost."""

    lost: bool = False

    def exchange(self, frame: bytes) -> bytes:
        before = self.board.state.sequence
        reply = super().exchange(frame)
        if self.board.state.sequence != before and not self.lost:
            self.lost = True
            raise NodeSilentError("The reply was lost.")
        return reply


def test_a_commit_whose_reply_is_lost_is_found_by_reading_the_security_teds(
    station: Station, board: Board, image: Image
) -> None:
    signed = sign_image(station, SignOrder(image.uuid, renamed(image, "next")), None).signed.image
    link = LosesCommit(board, via="can", tapped=False)
    with talk(board, link) as node:
        require_session(station, node)
        assert write(station, node, signed).on_node == signed
    assert link.lost
    assert board.state.sequence == security.decode(signed.blocks[SECURITY]).sequence


def test_what_the_store_has_of_a_node_and_the_node_lost_is_sent_after_all(
    station: Station, board: Board, image: Image
) -> None:
    signed = sign_image(station, SignOrder(image.uuid, renamed(image, "next")), None).signed.image
    gone = next(block for block in image if block not in (SECURITY, (0, 12)))
    kept = {block: octets for block, octets in board.state.blocks.items() if block != gone}
    board.flash.state = replace(board.state, blocks=kept)
    board.power_on()
    with talk(board) as node:
        require_session(station, node)
        assert write(station, node, signed).on_node == signed
    assert board.state.blocks[gone] == image.blocks[gone]


@pytest.mark.parametrize(("ahead", "commits"), [(1, 1), (65536, 1), (65537, 2), (131072, 2), (131073, 3)])
def test_a_sequence_far_ahead_is_reached_in_steps_of_65536(
    station: Station, board: Board, image: Image, monkeypatch: pytest.MonkeyPatch, ahead: int, commits: int
) -> None:
    made: list[int] = []

    def commit(*args: Any) -> int:
        made.append(security.decode(args[2].blocks[SECURITY]).sequence)
        return one(*args)

    one = writing._commit
    monkeypatch.setattr(writing, "_commit", commit)
    keys, present = writing.node_keys_of(image.uuid, image.blocks[SECURITY]), board.state.sequence
    signed = writing.sign(station, keys, image, epoch=1, node_sequence=0, sequence=present + ahead).image
    with talk(board) as node:
        require_session(station, node)
        write(station, node, signed, jump=True)
    assert made == [*(present + 65536 * step for step in range(1, commits)), present + ahead]
    assert board.state.sequence == present + ahead


def test_which_image_is_written(station: Station, image: Image, tmp_path: Path) -> None:
    uuid, other = image.uuid, bytes(9) + b"\1"
    assert writing._wanted(station, uuid, None) == (image, {}), "the name of all of its type became its own"
    file = tmp_path / "image.json"
    file.write_text(renamed(image, "filed").to_json())
    assert writing._wanted(station, uuid, file) == (renamed(image, "filed"), {"name": "filed"})
    draft = renamed(image, "drafted")
    station.datasheets.keep_draft(Draft(uuid, draft, "signed", "gripper"))
    assert writing._wanted(station, uuid, None) == (draft, {"profile": "gripper", "name": "drafted"})
    assert writing._wanted(station, uuid, file)[1] == {"name": "filed"}, "the draft's type is not the file's"
    station.nodes.remember(other, name="drafted")
    with pytest.raises(PolicyError, match=f"Node {other.hex()} already has the name 'drafted'"):
        writing._wanted(station, uuid, None)
    station.nodes.remember(uuid, name="drafted")
    assert writing._wanted(station, uuid, None)[0] == draft, "a name that the node has already is no news"
    with pytest.raises(NotFoundError, match=f"Nothing has been built for node {other.hex()}"):
        writing._wanted(station, other, None)
    with pytest.raises(PolicyError, match=f"The image is for node {uuid.hex()}, not for {other.hex()}"):
        writing._wanted(station, other, file)
    file.write_text(Image(uuid, image.unsigned_blocks()).to_json())
    with pytest.raises(BadDataError, match=r"^The image has no Security TEDS\.$"):
        writing._wanted(station, uuid, file)


class Tried(MockNode):
    """A node whose stagings end like this, one after the other; ``reached``: the lost reply was that of a commit."""

    def __init__(self, *ends: Exception | None, alive: bool = True, reached: bool = False) -> None:
        super().__init__(alive=alive)
        self.ends, self.reached, self.skips = list(ends), reached, list[int]()
        self.opened = 0

    def reopen(self) -> None:
        self.opened += 1


MISMATCH = NodeRefusedError("TEDS does not match its signed digest", reason=Reason.DIGEST_MISMATCH)
FULL = NodeRefusedError("no room", reason=Reason.NO_ROOM)
SILENT, TORN, LOST = NodeSilentError("silent"), GarbledError("torn"), SessionLostError(NodeSilentError("lost"))


@pytest.mark.parametrize(
    ("ends", "facts", "octets", "error", "skips", "opened"),
    [
        ((None,), {}, 7, None, [2], 0),
        # what the store has of the node is out of date: all is sent, in the same session
        ((MISMATCH, None), {}, 7, None, [2, 0], 0),
        ((MISMATCH, MISMATCH), {}, 0, MISMATCH, [2, 0], 0),
        ((FULL,), {}, 0, FULL, [2], 0),
        # a frame is lost on a bus, a node is not
        ((SILENT, None), {}, 7, None, [2, 2], 1),
        ((TORN, None), {}, 7, None, [2, 2], 1),
        ((SILENT,), {"alive": False}, 0, SILENT, [2], 0),
        ((SILENT,), {"reached": True}, 0, None, [2], 1),
        ((LOST, None), {"alive": False}, 7, None, [2, 2], 1),
        ((LOST,), {"alive": False, "reached": True}, 0, None, [2], 1),
        ((SILENT, SILENT, SILENT), {}, 0, SILENT, [2, 2, 2], 2),
        ((LOST, LOST, LOST), {}, 0, LOST.cause, [2, 2, 2], 2),
    ],
)
def test_a_write_that_is_cut_short_starts_over_or_was_done(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[Exception | None, ...],
    facts: dict[str, bool],
    octets: int,
    error: Exception | None,
    skips: list[int],
    opened: int,
) -> None:
    node: Any = Tried(*ends, **facts)
    image = Image(bytes(10), BLOCKS)
    has = Image(bytes(10), {(0, 1): BLOCKS[0, 1], (1, 3): BLOCKS[1, 3], (0, 12): b"another name", SECURITY: b"old"})

    def staged(_station: object, node: Tried, _image: object, skip: set[Any], _progress: object) -> int:
        node.skips.append(len(skip))
        end = node.ends.pop(0)
        if end is not None:
            raise end
        return 7

    monkeypatch.setattr(writing, "_stage_and_commit", staged)
    monkeypatch.setattr(writing, "read_block", lambda node, _block: BLOCKS[SECURITY] if node.reached else b"old")
    if error is None:
        assert writing._commit(station, node, image, has, None) == octets
    else:
        with pytest.raises(type(error)) as raised:
            writing._commit(station, node, image, has, None)
        assert raised.value is error
    assert (node.skips, node.opened, node.ends) == (skips, opened, [])


@pytest.mark.parametrize(
    ("changes", "known", "retyped", "jump", "asked"),
    [
        (("in N",), False, False, False, ["retype in N"]),
        (("in N",), True, False, False, []),
        (("in N",), False, True, False, []),
        ((), False, False, False, []),
        ((), False, False, True, ["jump"]),
    ],
)
def test_what_a_person_is_asked_before_an_image_is_written(
    station: Station,
    image: Image,
    monkeypatch: pytest.MonkeyPatch,
    changes: tuple[str, ...],
    known: bool,
    retyped: bool,
    jump: bool,
    asked: list[str],
) -> None:
    course, visit = list[str](), SimpleNamespace(node=SimpleNamespace(), who=None)

    class Person(Operator):
        def retype(self, uuid: bytes, differences: tuple[str, ...]) -> None:
            course.append(f"retype {differences[0]}")

        def jump(self, question: str) -> None:
            assert question == "This uses up the node's sequence numbers up to that point, permanently. Write it?"
            course.append("jump")

    def written(*_: Any, **how: Any) -> Any:
        assert (how["jump"], how["facts"]) == (jump, {"profile": "gripper"})
        assert (how["low"], how["progress"]) == (person.low_battery, reporter.written)
        course.append("written")
        raise PolicyError("far enough")

    @contextmanager
    def at(*_: Any, **__: Any) -> Iterator[Any]:
        yield visit

    monkeypatch.setattr(writing, "_wanted", lambda *_: (image, {"profile": "gripper"}))
    monkeypatch.setattr(writing, "at_node", at)
    monkeypatch.setattr(writing, "require_session", lambda *_: course.append("session"))
    monkeypatch.setattr(writing, "differences", lambda *_: changes)
    monkeypatch.setattr(writing, "shown_by", lambda *_: {})
    monkeypatch.setattr(writing, "is_remembered", lambda *_, factory: known and not factory)
    monkeypatch.setattr(writing, "write", written)
    person, reporter = Person(), SilentReporter()
    how: dict[str, Any] = {"file": None, "operator": person, "jump": jump, "retyped": retyped}
    with pytest.raises(PolicyError, match="far enough"):
        writing.write_at(station, LinkSettings(), image.uuid.hex(), reporter, **how)
    assert course == (["jump", "session", "written"] if jump else ["session", *asked, "written"])


def test_a_name_that_another_node_has_is_refused_of_a_draft_and_not_of_a_file(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(writing, "own_name", lambda _station, _image, profile: asked.append(profile) or "hand")  # type: ignore[func-returns-value]
    monkeypatch.setattr(writing, "read_image_file", lambda _path: image)
    station.datasheets.keep_draft(Draft(image.uuid, image, "signed", None))
    station.nodes.remember(bytes(9) + b"\1", name="hand")
    station.nodes.remember(image.uuid, profile="gripper")
    with pytest.raises(TedsProvisionError, match="hand"):
        writing._wanted(station, image.uuid, None)
    assert writing._wanted(station, image.uuid, Path("image.json")) == (image, {"name": "hand"})
    assert asked == ["gripper", "gripper"], "the profile of the node, if the draft has none"


def test_what_the_node_has_already_is_kept_as_written_unless_it_is_known(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[Any] = []
    node: Any = SimpleNamespace(proven="proven")
    monkeypatch.setattr(writing, "freshness_floor_of", lambda *given: given[1:])
    monkeypatch.setattr(writing, "keep", lambda *words, **how: kept.append((words[2], how)))
    for known in (True, False):
        monkeypatch.setattr(writing, "is_known", lambda *_, known=known: known)
        done = writing.write(station, node, image, present=SimpleNamespace(image=image))  # type: ignore[arg-type]
        assert (done.octets, done.on_node) == (0, image)
    assert kept == [(image, {"by": "write", "floor": (image.uuid, "proven")})]


@pytest.mark.parametrize(
    ("sequence", "between"),
    [(5, []), (4 + 65536, []), (4 + 65537, [65540]), (4 + 2 * 65536, [65540]), (4 + 2 * 65536 + 1, [65540, 131076])],
)
def test_a_jump_of_the_sequence_goes_in_steps_of_65536(
    station: Station, image: Image, monkeypatch: pytest.MonkeyPatch, sequence: int, between: list[int]
) -> None:
    signed, committed = list[int](), list[Any]()
    at = Identity(image.uuid, NodeState.PROVISIONED, 1, 4) if False else SimpleNamespace(sequence=4, epoch=1)
    node: Any = SimpleNamespace(proven=at, open_counter=b"c")
    monkeypatch.setattr(writing.security, "decode", lambda _octets: SimpleNamespace(signed=True, sequence=sequence))
    for name in ("_require_newer", "require_charge", "read_firmware", "_after_commit", "_conclude", "node_keys_of"):
        monkeypatch.setattr(writing, name, lambda *_, **__: None)
    monkeypatch.setattr(writing, "replace", lambda identity, **_: identity)
    monkeypatch.setattr(writing, "read_image", lambda *_, **__: image)
    monkeypatch.setattr(
        writing, "sign", lambda *_, sequence, **__: (signed.append(sequence), SimpleNamespace(image=sequence))[1]
    )
    monkeypatch.setattr(writing, "_commit", lambda _s, _n, made, has, _p: (committed.append((made, has)), 7)[1])
    other = Image(image.uuid, {SECURITY: b"older"})
    done = writing.write(station, node, image, present=SimpleNamespace(image=other), jump=True)  # type: ignore[arg-type]
    assert (signed, done.octets) == (between, 7 * (len(between) + 1))
    assert committed == list(zip([*between, image], [other, *between], strict=True))
