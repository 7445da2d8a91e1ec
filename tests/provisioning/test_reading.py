"""What a node may make a station read before anything is known of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, GarbledError, NodeRefusedError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Command, Reason, Reply, refusal
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning import read as read_module
from teds_provision.provisioning import teds_read
from teds_provision.provisioning.conversation import refused
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.teds_read import LARGEST_SECURITY, read_block
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, MemoryLink, talk

REFUSED = refusal(Reason.NO_SUCH_TEDS).encode()


@pytest.mark.parametrize(("block", "most"), [(SECURITY, LARGEST_SECURITY), ((0, 1), 1 << 20)])
def test_a_teds_that_claims_to_be_endless_is_not_read(board: Board, block: tuple[int, int], most: int) -> None:
    def claim(count: int, _reply: bytes) -> bytes:
        return Reply(True, (0).to_bytes(4, "big") + most.to_bytes(4, "big")).encode()

    link = MemoryLink(board, tamper=claim)
    with pytest.raises(GarbledError, match=f"at most {most} are read"):  # outside a session anyone can say so: 5, not 8
        read_block(talk(board, link), block)
    assert link.count == 1


def test_the_largest_security_teds_is_read_octet_by_octet(board: Board) -> None:
    teds = frame(bytes(LARGEST_SECURITY - 6))

    class DrippingLink(MemoryLink):
        """A node that gives an octet at a time."""

        def exchange(self, frame: bytes) -> bytes:
            at, self.count = self.count, self.count + 1
            return Reply(True, at.to_bytes(4, "big") + teds[at : at + 1]).encode()

    link = DrippingLink(board)
    assert read_block(talk(board, link), SECURITY) == teds
    assert link.count == len(teds)


def test_noise_on_a_plain_read_is_read_again_and_a_teds_that_is_bad_stays_bad(board: Board) -> None:
    def noise(count: int, reply: bytes) -> bytes:
        return reply[:-1] + bytes([reply[-1] ^ 1]) if count == 1 else reply

    good = read_block(talk(board, MemoryLink(board)), SECURITY)
    noisy = MemoryLink(board, tamper=noise)
    assert read_block(talk(board, noisy), SECURITY) == good
    assert noisy.count > MemoryLink(board).count + 1

    bad = MemoryLink(board, tamper=lambda _count, reply: reply[:-1] + bytes([reply[-1] ^ 1]))
    assert read_block(talk(board, bad), SECURITY) == good[:-1] + bytes([good[-1] ^ 1])

    restless = MemoryLink(board, tamper=lambda count, reply: reply[:-1] + bytes([reply[-1] ^ count]))
    with pytest.raises(GarbledError, match="noisy"):
        read_block(talk(board, restless), SECURITY)


def test_an_unauthenticated_refusal_is_asked_for_again(board: Board) -> None:
    """Noise made another question of a frame: the fault bench saw exit 6 at 2 % of corrupted frames."""
    good = read_block(talk(board, MemoryLink(board)), SECURITY)
    disturbed = MemoryLink(board, tamper=lambda count, reply: REFUSED if count < 3 else reply)
    assert read_block(talk(board, disturbed), SECURITY) == good

    steady = MemoryLink(board, tamper=lambda _count, _reply: REFUSED)
    with pytest.raises(NodeRefusedError, match="no such TEDS"):
        read_block(talk(board, steady), SECURITY)
    assert steady.count == 3


def test_an_unexpected_offset_is_asked_again_outside_a_session(board: Board) -> None:
    """A reply to the command before, whose process was killed, ended the next one (5) on a busy machine."""
    good = read_block(talk(board, MemoryLink(board)), SECURITY)

    def stale(count: int, reply: bytes) -> bytes:
        return Reply(True, (99).to_bytes(4, "big") + b"else").encode() if count < 3 else reply

    assert read_block(talk(board, MemoryLink(board, tamper=stale)), SECURITY) == good
    steady = MemoryLink(board, tamper=lambda _count, _reply: stale(1, b""))
    with pytest.raises(GarbledError, match="different offset"):
        read_block(talk(board, steady), SECURITY)
    assert steady.count == 3


class Lister:
    """Mock of a conversation with a node in its session: hands out TEDS as it is told, and notes what it is asked."""

    def __init__(self, answers: dict[tuple[int, int], bytes | NodeRefusedError]) -> None:
        self.uuid, self.sealed = bytes(10), True
        self.asked: list[str] = []
        self.answers = answers
        self.proven: Identity | None = None
        self.identity_reply = Identity(bytes(10), NodeState.KEYED, 1, 0, 1024, 0).encode()

    def request_idempotent(self, command: Command, what: str) -> bytes:
        self.asked.append(what)
        if what == "to list its TEDS":
            return b"".join(channel.to_bytes(2, "big") + bytes([code]) for channel, code in self.answers)
        if what == "to identify itself":
            return self.identity_reply
        channel, code = command.channel, command.payload[0]
        answer = self.answers[channel, code]
        if isinstance(answer, NodeRefusedError):
            raise answer
        offset = int.from_bytes(command.payload[1:5], "big")
        return offset.to_bytes(4, "big") + answer[offset : offset + 1000]


NAME, LONG = frame(bytes.fromhex("0304000c0101040100050161")), frame(bytes(2500))


def test_every_listed_teds_is_read_but_one_that_is_gone_meanwhile() -> None:
    node = Lister({(0, 1): LONG, (0, 12): NAME, (1, 3): refused(18, "x", sealed=True)})
    found = teds_read.read_image(node)  # type: ignore[arg-type]
    assert found.blocks == {(0, 1): LONG, (0, 12): NAME}
    assert node.asked.count("to read TEDS 1 of channel 0") == 3
    known = teds_read.read_image(node, listed=[(0, 12), (0, 128)], initial=b"known")  # type: ignore[arg-type]
    assert known.blocks == {(0, 12): NAME, (0, 128): b"known"}
    assert node.asked.count("to list its TEDS") == 1
    node.answers[1, 3] = refused(2, "x", sealed=True)
    with pytest.raises(NodeRefusedError):
        teds_read.read_image(node)  # type: ignore[arg-type]


def test_an_image_has_four_mebibytes_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = iter([4 << 20, 0, (4 << 20) - 3, 3, 1])
    monkeypatch.setattr(teds_read, "read_block", lambda *_args, **_more: bytes(next(sizes)))
    node = Lister({})
    teds_read.read_image(node, listed=[(0, 1), (0, 2)])  # type: ignore[arg-type]
    with pytest.raises(BadDataError, match=r"^The node lists more than 4 MiB of TEDS\.$"):
        teds_read.read_image(node, listed=[(0, 1), (0, 2), (0, 3)])  # type: ignore[arg-type]


class Paced:
    """Mock of a link that can ask for frames apart; ``gaps`` are those of each request."""

    def __init__(self) -> None:
        self.gap, self.gaps = 0, list[int]()


def in_between(answers: dict[tuple[int, int], bytes], link: Paced, wrong: int = 0) -> tuple[Image | None, int]:
    """Read in between; return the image and how often others had their turn. ``wrong`` is added to offsets."""
    node = Lister(dict(answers))

    def request(command: Command, what: str) -> bytes:
        link.gaps.append(link.gap)
        reply = node.request_idempotent(command, what)
        listed = what == "to list its TEDS"
        return reply if listed else (int.from_bytes(reply[:4], "big") + wrong).to_bytes(4, "big") + reply[4:]

    node.request, node.contact = request, SimpleNamespace(link=link)  # type: ignore[attr-defined]
    reading, turns = teds_read.read_in_between(node, gap=7), 0  # type: ignore[arg-type]
    while True:
        try:
            next(reading)
            turns += 1
        except StopIteration as done:
            return done.value, turns


def test_read_in_between_each_request_has_its_turn_and_its_gap() -> None:
    link = Paced()
    image, turns = in_between({(0, 1): LONG, (0, 12): NAME, (1, 3): b"abc"}, link)
    assert image is not None
    assert image.blocks == {(0, 1): LONG, (0, 12): NAME, (1, 3): b"abc"}
    assert turns == len(link.gaps) - 1 == 3 + 1 + 2, "List is asked at once; an end is an empty segment"
    assert (set(link.gaps), link.gap) == ({7}, 0)


@pytest.mark.parametrize(("block", "most"), [(SECURITY, LARGEST_SECURITY), ((0, 1), 1 << 20), ((1, 128), 1 << 20)])
def test_read_in_between_a_teds_of_too_many_octets_or_from_another_offset_is_refused(
    block: tuple[int, int], most: int
) -> None:
    link = Paced()
    image, _ = in_between({block: (most - 4).to_bytes(4, "big")}, link)
    assert image is not None
    assert image.blocks[block] == (most - 4).to_bytes(4, "big"), "as many octets as there are"
    with pytest.raises(BadDataError, match=f"claims {most + 1} octets, which is too many"):
        in_between({block: (most - 3).to_bytes(4, "big")}, link)
    with pytest.raises(GarbledError, match="from a different offset"):
        in_between({block: NAME}, link, wrong=1)
    assert link.gap == 0


def test_read_in_between_an_image_has_four_mebibytes_at_most_with_what_is_claimed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(teds_read, "LARGEST_IMAGE", len(NAME) + 100)
    image, _ = in_between({(0, 1): NAME, (0, 12): (96).to_bytes(4, "big")}, Paced())
    assert image is not None
    with pytest.raises(BadDataError, match="too many"):
        in_between({(0, 1): NAME, (0, 12): (97).to_bytes(4, "big")}, Paced())


def test_an_identify_of_another_node_is_noise_and_one_in_a_session_is_kept() -> None:
    node = Lister({})
    own = teds_read.read_identity(node)  # type: ignore[arg-type]
    assert node.proven == own
    node.sealed, node.proven = False, None
    teds_read.read_identity(node)  # type: ignore[arg-type]
    assert node.proven is None
    node.identity_reply = Identity(bytes(9) + b"\1", NodeState.KEYED, 1, 0, 1024, 0).encode()
    with pytest.raises(GarbledError, match=f"gave its UUID as {'00' * 10} before and gives {'00' * 9}01 now"):
        teds_read.read_identity(node)  # type: ignore[arg-type]


def test_a_node_is_asked_once_which_of_its_teds_is_fixed() -> None:
    asked: list[tuple[int, int]] = []

    def ask(block: tuple[int, int]) -> bool:
        asked.append(block)
        return block[1] == 130

    blocks = {(0, 12): b"a", (0, 130): b"b", (0, 128): b"c"}
    found = teds_read.NodeSnapshot(Image(bytes(10), blocks), Identity(bytes(10), NodeState.KEYED, 1, 0, 1024, 0), ask)
    assert not found.is_read_only((0, 128)), "the Security TEDS never is"
    assert not found.is_read_only((5, 5))
    assert asked == []
    assert found.fixed_beside({(0, 12)}) == {(0, 130): b"b"}
    assert asked == [(0, 130)]
    assert found.fixed_beside({(0, 130)}) == {}
    assert found.fixed_beside({}) == {(0, 130): b"b"}
    assert not found.is_fixed
    assert sorted(asked) == [(0, 12), (0, 130)]
    alone = Image(bytes(10), {(0, 130): b"b", (0, 128): b"c"})
    assert teds_read.NodeSnapshot(alone, found.identity, ask).is_fixed


@pytest.mark.parametrize(("state", "security"), [(NodeState.KEYED, b"known"), (NodeState.PROVISIONED, NAME)])
def test_the_security_teds_of_a_node_that_was_written_is_read_in_its_session(state: NodeState, security: bytes) -> None:
    node = Lister({(0, 128): NAME})
    node.identity_reply = Identity(bytes(10), state, 1, 0, 1024, 0).encode()
    assert teds_read.take_snapshot(node, initial=b"known").image.security == security  # type: ignore[arg-type]
    assert node.asked[0] == "to identify itself"
    teds_read.take_snapshot(node)  # type: ignore[arg-type]
    assert node.asked.count("to identify itself") == 1, "it has proved it in this session"


def test_the_time_of_a_whole_image_is_bounded_not_that_of_each_teds(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float | None] = []

    def read_block(_node: object, _block: object, *, until: float | None = None) -> bytes:
        limits.append(until)
        return b"teds"

    monkeypatch.setattr(teds_read, "read_block", read_block)
    monkeypatch.setattr(teds_read, "time", SimpleNamespace(monotonic=iter((1000.0, 1500.0)).__next__))
    teds_read.read_image(Lister({}), listed=[(0, 1), (0, 2), (0, 3)])  # type: ignore[arg-type]
    assert limits == [1300.0] * 3


UUID = bytes(10)


@pytest.mark.parametrize("sealed", [True, False])
def test_only_what_is_read_in_a_session_is_kept(monkeypatch: pytest.MonkeyPatch, sealed: bool) -> None:
    kept: list[Any] = []
    node = SimpleNamespace(open_counter=b"c", sealed=sealed, proven="proven")

    @contextmanager
    def at_node(*_: object, **__: object) -> Iterator[Any]:
        yield SimpleNamespace(node=node, who=SimpleNamespace(point=b"point"))

    for name, found in {
        "at_node": at_node, "open_or_say_why": lambda *_: "", "read_image": lambda _node: "image",
        "provenance_check": lambda *_: SimpleNamespace(result="passed"),
        "freshness_floor_of": lambda *given: given[1:],
        "keep": lambda *words, **how: kept.append((words[1:], how)),
    }.items():  # fmt: skip
        monkeypatch.setattr(read_module, name, found)
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(resolve=lambda _text: UUID), durable=lambda _why: nullcontext()
    )
    report = read_module.read_at(station, LinkSettings(), "finger", SilentReporter())
    assert (report.image, report.error) == ("image", None)  # type: ignore[comparison-overlap]
    how = {"by": "read", "floor": (UUID, "proven"), "c": b"c"}
    assert kept == ([((node, "image"), how)] if sealed else [])
