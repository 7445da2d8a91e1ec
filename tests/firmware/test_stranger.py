"""A stranger's station against the node in C: two at once, a bus with whims, power that fails, a reader that jerks."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from tests.firmware.memory_node import MemoryNode
from tests.firmware.stranger import (
    MS,
    NEVER,
    SECOND,
    Bus,
    Frame,
    Key,
    NoReplyError,
    Owner,
    RefusalError,
    Station,
    Whims,
    run,
)
from tests.firmware.stranger import meta as meta_of
from tests.firmware.stranger import name as name_of

pytestmark = pytest.mark.system
UUID = bytes.fromhex("0123456789abcdef0123")
Blocks = dict[tuple[int, int], bytes]


def blocks(text: str) -> Blocks:
    return {(0, 1): meta_of(UUID), (1, 12): name_of(text)}


@dataclass
class Board:
    """A node whose power comes back a tenth of a second after it failed; what is dead sends nothing."""

    bus: Bus
    unit: int = 8
    up_at: int = 0
    deaths: int = 0

    def __post_init__(self) -> None:
        dice = random.Random(self.bus.seed)
        self.node = MemoryNode(
            lambda kind, size: b"\x01" + dice.randbytes(size - 1) if kind in "io" else dice.randbytes(size),
            self.bus.seconds,
            uuid=UUID,
            unit=self.unit,
        )
        assert self.node.start() == 0
        self.bus.nodes.append(self)

    def _is_up(self) -> bool:
        if not self.node.dead:
            return True
        if not self.up_at:
            self.up_at, self.deaths = self.bus.now + 100 * MS, self.deaths + 1
        if self.bus.now < self.up_at:
            return False
        self.node.cut(0, torn=False)
        assert self.node.start() == 0
        self.up_at = 0
        return True

    def poll(self) -> int:
        if not self._is_up():
            return self.up_at
        return self.node.poll()

    def next_frame(self) -> Frame | None:
        frame = self.node.next_frame() if self._is_up() else None
        return frame if self._is_up() else None

    def take_frame(self, identifier: int, data: bytes, *, fd: bool = False) -> None:
        if self._is_up():
            self.node.take_frame(identifier, data, fd=fd)


@dataclass
class Scene:
    """A bus, a node of nobody, its owner at F1."""

    seed: int
    fd: bool = False
    unit: int = 8

    def __post_init__(self) -> None:
        self.bus = Bus(self.seed)
        self.dice = random.Random(self.seed)
        self.board = Board(self.bus, self.unit)
        self.ca = Key(self.dice)
        self.address = self.board.node.can_address
        self.owner = self.station(0xF1)

    def station(self, source: int) -> Owner:
        return Owner(Station(self.bus, source, self.address, self.fd), self.dice, self.ca)


@pytest.fixture
def scenes() -> Iterator[Callable[..., Scene]]:
    made: list[Scene] = []

    def make(*args: object, **more: object) -> Scene:
        made.append(Scene(*args, **more))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for scene in made:
        assert not scene.board.node.misused
        scene.board.node.close()


def pause(bus: Bus, ns: int) -> Iterator[None]:
    until = bus.now + ns
    while bus.now < until:
        yield


def stubborn(owner: Owner, *deeds: Callable[[], Iterator[None]], tries: int = 40) -> Iterator[None]:
    """Open, and do all of it in the session; from the start again where a reply was lost, or the node was busy."""
    for _ in range(tries):
        try:
            yield from owner.open()
            for deed in deeds:
                yield from deed()
            yield from owner.sealed(5)
            return
        except NoReplyError:
            pass
        except RefusalError as refused:
            if refused.reason not in (2, 7, 12, 17):
                raise
            if refused.reason == 17:
                yield from pause(owner.station.bus, owner.dice.randrange(SECOND))
    raise AssertionError("it never went through")


def owned(owner: Owner) -> Iterator[None]:
    """A first agreement, however often its frames are lost."""
    for _ in range(20):
        try:
            yield from owner.agree()
            return
        except NoReplyError:
            try:
                yield from owner.open()
                return
            except (NoReplyError, RefusalError):
                continue
        except RefusalError as refused:
            if refused.reason == 3:  # it was heard: the node has a key
                return
            raise
    raise AssertionError("it never went through")


WHIMS = {
    "a good bus": Whims(),
    "frames are lost": Whims(lost=4),
    "frames come twice": Whims(doubled=80),
    "frames come late": Whims(late=4),
    "all of it": Whims(lost=2, doubled=30, late=2),
}


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
@pytest.mark.parametrize("whims", WHIMS)
def test_two_stations_with_one_key_write_at_once(scenes: Callable[..., Scene], whims: str, fd: bool) -> None:
    """Each its own datasheet; a third asks what anybody may. At the end one of the two lies there, whole."""
    for seed in range(4):
        meet(scenes(seed, fd), WHIMS[whims])


def meet(scene: Scene, whims: Whims) -> None:
    first = scene.owner
    scene.bus.whims = whims
    run(scene.bus, owned(first))
    second, third = scene.station(0xF2), scene.station(0xF3)
    run(scene.bus, stubborn(first))  # which of its keys counts
    second.uuid, second.keys = first.uuid, list(first.keys)
    answers: list[int] = []

    def asks() -> Iterator[None]:
        for _ in range(6):
            for ask in (third.identify, lambda: third.read(0, 128), lambda: third.plain(8, bytes(32))):
                try:
                    yield from ask()
                    answers.append(0)
                except NoReplyError:
                    pass
            for function, payload in ((1, bytes(259)), (4, bytes(40)), (5, b""), (9, bytes(32))):
                try:
                    yield from third.plain(function, payload)
                except RefusalError as refused:
                    answers.append(refused.reason)
                except NoReplyError:
                    pass

    sheets = blocks("first"), blocks("second")
    run(
        scene.bus,
        stubborn(first, lambda: first.write(sheets[0])),
        stubborn(second, lambda: second.write(sheets[1])),
        asks(),
    )
    assert set(answers) <= {0, 2, 3}
    assert answers.count(0) >= 3
    held = scene.board.node.blocks()
    last, sheet = (first, sheets[0]) if held[0, 128] == first.wrote else (second, sheets[1])
    run(scene.bus, stubborn(last, lambda: last.check(sheet)))
    assert scene.board.node.identity().state == 2


# -- power that fails --------------------------------------------------------------------------------------------------


def everyone(scene: Scene) -> int:
    """Ask who is where; the one node's address."""
    scene.bus.whims = Whims()
    scene.owner.station.replies.clear()
    heard: list[int] = []
    listener = Listener(scene.bus, heard)
    scene.bus.stations.append(listener)  # type: ignore[arg-type]
    scene.bus.send((0x18DBFFF4, b"\x07\x2a\0\0\x80\x07\0\0", False), listener)
    run(scene.bus, pause(scene.bus, 400 * MS))
    scene.bus.stations.remove(listener)  # type: ignore[arg-type]
    assert len(set(heard)) == 1
    return heard[0]


@dataclass
class Listener:
    """Hears answers to F4 and takes none up."""

    bus: Bus
    heard: list[int]
    due: int = NEVER

    def take(self, frame: Frame) -> None:
        if frame[0] & 0x1FFFFF00 == 0x18DAF400:
            self.heard.append(frame[0] & 0xFF)

    def work(self) -> None:
        """Nothing."""


def rotates(owner: Owner) -> Iterator[None]:
    """In a session, as over a bus it must be."""
    yield from owner.open()
    yield from owner.agree(owner.sealed)


def rewrites(owner: Owner) -> Iterator[None]:
    yield from owner.open()
    yield from owner.write(blocks("another"))


def resets(owner: Owner) -> Iterator[None]:
    yield from owner.open()
    yield from owner.sealed(9, bytes(32))


def moves(owner: Owner) -> Iterator[None]:
    yield from owner.open()
    yield from owner.sealed(10, b"\x55")


def tried(deed: Iterator[None], outcome: list[bool]) -> Iterator[None]:
    """Whether its last command had a good reply."""
    try:
        yield from deed
        outcome.append(True)
    except (NoReplyError, RefusalError):
        outcome.append(False)


@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
@pytest.mark.parametrize("deed", [rotates, rewrites, resets, moves])
def test_power_fails_while_a_station_changes_the_node(
    scenes: Callable[..., Scene], deed: Callable[[Owner], Iterator[None]], torn: bool
) -> None:
    """Over the bus: what the station may conclude from a reply that did not come is enough to go on with the node."""
    scene: Scene = scenes(7, unit=32)
    owner, node, bus = scene.owner, scene.board.node, scene.bus
    run(bus, owned(owner), pause(bus, SECOND))
    run(bus, stubborn(owner, lambda: owner.write(blocks("one"))))
    run(bus, pause(bus, SECOND))
    image, keys, uuid, wrote = node.image, list(owner.keys), owner.uuid, owner.wrote
    went = set()
    for step in range(1, 200):
        node.image = image
        assert node.start() == 0
        bus.now += 60 * SECOND
        scene.board.deaths = 0
        owner = scene.station(0xF1 + step % 5)
        bus.stations[:] = [owner.station]
        owner.keys, owner.uuid, owner.wrote = list(keys), uuid, wrote
        node.cut(step, torn=torn)
        outcome: list[bool] = []
        run(bus, tried(deed(owner), outcome), pause(bus, 2 * SECOND))
        cut = scene.board.deaths > 0
        node.cut(0, torn=False)
        address = everyone(scene)
        owner.station.target = address
        run(bus, owner.identify())
        if deed is resets and owner.state == 0:
            is_new = True
            assert node.blocks()[1, 12] == blocks("one")[1, 12]
        else:
            run(bus, owner.open(), pause(bus, MS))
            run(bus, owner.read(0, 128, owner.sealed))
            held = owner.teds
            is_new = {
                rotates: owner.keys != keys,
                rewrites: held != wrote,
                resets: False,
                moves: address == 0x55,
            }[deed]
            owner.wrote = held
            run(bus, owner.check(blocks("another" if deed is rewrites and is_new else "one")))
        if outcome == [True]:
            assert is_new, f"step {step}: a good reply, and the old state"
        went.add(is_new)
        if deed in (rotates, resets) and is_new:
            assert keys[0] not in node.image, f"step {step}: the old key lies in flash"
        if not cut:
            assert is_new
            break
    else:
        pytest.fail("it never came to its end")
    assert went == {True, False}


# -- a reader that jerks -----------------------------------------------------------------------------------------------


def record(marks: int, kind: bytes, payload: bytes) -> bytes:
    """An NDEF record: ``marks`` begins (80), ends (40) and the type's name format."""
    if len(payload) < 256:
        return bytes((marks | 0x10, len(kind), len(payload))) + kind + payload
    return bytes((marks, len(kind))) + len(payload).to_bytes(4, "big") + kind + payload


@dataclass
class Reader:
    """The exchange of :class:`Station`, over the NDEF message of a tag; pieces of ``room`` octets."""

    bus: Bus
    node: MemoryNode
    room: int
    reply: bytes = b""
    transaction: int = 0
    taps: int = 0
    here: bool = False
    dice: random.Random = field(default_factory=lambda: random.Random(3))

    def tap(self) -> None:
        """The node is put down (again), and its service selected."""
        self.node.nfc_field(False)
        self.node.nfc_field(True)
        self.taps += 1
        self.here = True
        service = b"urn:nfc:xsn:teds-provision:tim"
        assert b"\xd1" not in self.node.nfc_message()[:1]
        reply = self.node.nfc_write(record(0xC1, b"Ts", bytes((len(service),)) + service))
        assert reply == record(0xC1, b"Te", b"\0")

    def piece(self, total: int, offset: int, body: bytes, *, more: bool) -> tuple[int, bytes]:
        """Offset and body of what the tag shows for it; a message may be written twice."""
        head = bytes((1, 2 if more else 0)) + self.transaction.to_bytes(2, "big")
        head += total.to_bytes(2, "big") + offset.to_bytes(2, "big")
        octets = record(0xC4, b"teds-provision:tim", head + zlib.crc32(head + body).to_bytes(4, "big") + body)
        shown = self.node.nfc_write(octets)
        if self.dice.random() < 0.1:
            assert self.node.nfc_write(octets) == shown
        assert shown.startswith(b"\x91\x02\x01Te\0"), shown.hex()
        at = shown.index(b"teds-provision:tim") + 18
        payload = shown[at:]
        assert payload[1] & 1
        assert payload[2:4] == self.transaction.to_bytes(2, "big")
        assert zlib.crc32(payload[:8] + payload[12:]) == int.from_bytes(payload[8:12], "big")
        self.total = int.from_bytes(payload[4:6], "big")
        return int.from_bytes(payload[6:8], "big"), payload[12:]

    def exchange(self, frame: bytes) -> Iterator[None]:
        """Send a command and return its reply; raise NoReplyError if the node was lifted in between."""
        yield
        self.bus.now += 5 * MS
        if not self.here or self.dice.random() < 0.08:
            self.tap()
            raise NoReplyError("lifted")
        self.transaction = self.transaction + 1 & 0xFFFF
        at, size = 0, self.dice.randrange(60, self.room)
        while True:
            body = frame[at : at + size]
            if self.dice.random() < 0.05:
                self.tap()
                raise NoReplyError("lifted")
            offset, answer = self.piece(len(frame), at, body, more=at + len(body) < len(frame))
            at += len(body)
            if at >= len(frame):
                break
            assert (offset, answer) == (at, b"")
        whole = answer
        assert offset == 0
        while len(whole) < self.total:
            offset, answer = self.piece(self.total, len(whole), b"", more=False)
            assert offset == len(whole)
            assert answer
            whole += answer
        self.reply = whole


@pytest.mark.parametrize("max_ndef", [200, 284, 499, 4160])
def test_a_reader_that_jerks_provisions_it_all_the_same(max_ndef: int) -> None:
    bus, dice = Bus(max_ndef), random.Random(max_ndef)
    node = MemoryNode(
        lambda kind, size: b"\x01" + dice.randbytes(size - 1) if kind in "io" else dice.randbytes(size),
        bus.seconds,
        uuid=UUID,
    )
    node.has_nfc(max_ndef=max_ndef)
    assert node.start() == 0
    reader = Reader(bus, node, room=min(max_ndef - 6 - 12 - 24, 900))
    owner = Owner(reader, dice, Key(dice))  # type: ignore[arg-type]
    reader.tap()
    for text in ("one", "two"):
        while True:
            try:
                list(owner.agree())
                break
            except NoReplyError:
                continue
        list(stubborn(owner, lambda text=text: owner.write(blocks(text)), lambda text=text: owner.check(blocks(text))))
    assert reader.taps > 3
    assert node.blocks()[1, 12] == name_of("two")
    assert node.identity().state == 2
    node.close()
