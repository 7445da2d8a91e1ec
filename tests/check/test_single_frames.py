"""Rules of single CAN frames, against a node written frame by frame: what each rule sends, takes and finds.

The node answers as ISO 15765-2 and profile.md, "CAN", say, except for what a row changes. Time passes only when
nothing is on the bus.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.check import frame_rules
from teds_provision.check.probe import NotApplicableError, RuleBrokenError
from teds_provision.links.ports import BusFrame
from teds_provision.protocol.messages.frames import Reply
from teds_provision.protocol.messages.identity import Identity, NodeState

HOME, OWN = 0x11, 0xF5
UUID = bytes(range(10))
CRC = bytes.fromhex("456cd746")
GREATEST_CRC = bytes.fromhex("0000000000005c5e3d4e")
"""A UUID whose CRC-32 is FFFFFFFF."""
TEDS = bytes(octet * 7 & 0xFF for octet in range(300))
IDENTITY = Identity(UUID, NodeState.KEYED, 4, 2, 1024, 17).encode()


@dataclass
class Node:
    """A node at 0x11 on a bus in memory. Each member is a rule that a row may change."""

    home: int = HOME
    fd: bool = False
    own: int = OWN
    also_at: dict[int, tuple[int, bytes]] = field(default_factory=dict)
    """Other addresses that are answered: from which address, with which reply to Identify."""
    of_everyone: dict[str, str] = field(default_factory=dict)
    """Answers to functional frames, by the octets of the command."""
    odd: dict[str, str] = field(default_factory=dict)
    """Answers to frames of a wrong length, by their first two octets; a frame in place of the answer to Identify."""
    controls: list[str] = field(default_factory=lambda: ["300000"])
    """Flow controls after a first frame; one more each time a block has come."""
    more: list[str] = field(default_factory=lambda: ["300000"])
    in_sequence: int | None = 0
    """How many requests out of sequence are run all the same; None for all."""
    identify: Callable[[int], bytes] = lambda transaction: bytes([transaction, 1, 0, len(IDENTITY)]) + IDENTITY
    read: Callable[[int], bytes] = lambda transaction: bytes([transaction, 1, 1, 48, 0, 0, 0, 0]) + TEDS
    waits: bool = True
    block: Callable[[int], int] = lambda block: block
    gap: float = 0.05
    lost: tuple[int, int] = (0, 0)
    """A consecutive frame of the node, counted from 1, that does not arrive; in how many replies."""
    announces: list[tuple[int, str]] = field(default_factory=list)
    """For each Announce heard: the answer's address and octets, none if they are empty."""
    now: float = 100.0
    sent: list[str] = field(default_factory=list)
    out: list[BusFrame] = field(default_factory=list)
    _held: bytes = b""
    _due: int = 0
    _number: int = 0
    _block: int = 0
    _torn: bool = False
    _reply: bytes = b""
    _count: int = 0
    _answering: int = HOME

    def __post_init__(self) -> None:
        self.announces = list(self.announces)

    # -- the bus as the rules see it

    def send(self, identifier: int, octets: bytes, *, fd: bool = False) -> None:
        assert fd is self.fd or identifier >> 16 == 0x1CFF
        self.sent.append(f"{identifier:08x} {octets.hex()}")
        if identifier >> 16 == 0x1CFF:
            self._announced()
        elif identifier == 0x18DBFF00 | self.own:
            answer = self.of_everyone.get(octets[4:6].hex())
            if answer:
                self._say(answer)
        else:
            assert identifier & 0x1FFF00FF == 0x18DA0000 | self.own
            self._to(identifier >> 8 & 0xFF, octets)

    def next(self, seconds: float) -> BusFrame | None:
        assert seconds >= 0
        if self.out:
            return self.out.pop(0)
        self.now += seconds
        return None

    # -- the node

    def _put(self, octets: bytes, source: int | None = None, to: int | None = None) -> None:
        target = self.own if to is None else to
        self.out.append(BusFrame(0x18DA0000 | target << 8 | (source or self.home), octets, self.now))

    def _say(self, octets: str) -> None:
        self._put(bytes.fromhex(octets))

    def _to(self, node: int, octets: bytes) -> None:
        if node != self.home and node not in self.also_at:
            return
        kind = octets[0] >> 4
        if octets[:2].hex() in ("1007", "0006"):
            if octets[:2].hex() in self.odd:
                self._say(self.odd[octets[:2].hex()])
        elif kind == 0:
            start, length = (1, octets[0]) if octets[0] else (2, octets[1])
            self._run(octets[start : start + length], node)
        elif kind == 1:
            self._due, self._held, self._number = (octets[0] & 15) << 8 | octets[1], octets[2:], 0
            self._torn, self._block = False, 0
            for control in self.controls:
                self._say(control)
        elif kind == 2:
            self._number += 1
            self._torn |= octets[0] & 15 != self._number & 15
            self._held += octets[1:]
            self._block += 1
            if len(self._held) >= self._due:
                self._ended()
            elif self.controls and (size := bytes.fromhex(self.controls[-1])[1]) and self._block == size:
                self._block = 0
                for control in self.more:
                    self._say(control)
        elif kind == 3:
            self._asked(octets)

    def _ended(self) -> None:
        if self._torn:
            if self.in_sequence == 0:
                return
            if self.in_sequence is not None:
                self.in_sequence -= 1
        self._run(self._held[: self._due], self.home)

    def _run(self, body: bytes, node: int) -> None:
        source, reply = self.home, b""
        if body[3:5] == b"\x80\x07" and "identify" in self.odd:
            self._say(self.odd["identify"])
            return
        if body[3:5] == b"\x80\x07":
            reply = self.identify(body[0])
            if node in self.also_at:
                source, payload = self.also_at[node]
                reply = bytes([body[0]]) + payload
        elif body[3:5] == b"\x01\x02":
            reply = self.read(body[0])
        else:
            reply = bytes([body[0], 0, 0, 1, 3])
        if not reply:
            return
        if len(reply) <= (62 if self.fd else 7):
            self._put((bytes([len(reply)]) if len(reply) < 8 else bytes([0, len(reply)])) + reply, source)
            return
        room = 62 if self.fd else 6
        self._put((0x1000 | len(reply)).to_bytes(2, "big") + reply[:room], source)
        self._reply, self._count, self._answering = reply[room:], 0, source

    def _asked(self, control: bytes) -> None:
        go_on = control[0] == 0x30
        if control[0] == 0x31 and not self.waits:
            go_on, control = True, b"\x30\1\0"
        if control[0] == 0x32:
            self._reply = b""
        if not go_on:
            return
        size, room = self.block(control[1]) or 1000, 63 if self.fd else 7
        while self._reply and size:
            self._count += 1
            number, replies = self.lost
            if self._count == number and replies:
                self.lost = number, replies - 1
            else:
                self._put(bytes([0x20 | self._count & 15]) + self._reply[:room].ljust(room, b"\0"), self._answering)
            self._reply, size = self._reply[room:], size - 1
            self.now += self.gap if control[2] else 0.0

    def _announced(self) -> None:
        if self.announces:
            address, octets = self.announces.pop(0)
            if octets:
                self.out.append(BusFrame(0x1CFF0000 | address, bytes.fromhex(octets), self.now))


def _probe(node: Node, **more: Any) -> Any:
    @contextmanager
    def single_frames() -> Iterator[Node]:
        yield node

    def free_source(number: int) -> int:
        assert number == 3
        return OWN

    members: dict[str, Any] = {
        "framed": SimpleNamespace(single_frames=single_frames),
        "contact": SimpleNamespace(address=node.home),
        "free_source": free_source,
        "uuid": UUID,
        "teds": lambda block: {(0, 128): TEDS}[block],
        "identity": lambda: Identity.decode(IDENTITY),
        "plain": lambda command: Reply(True, b""),
        "moves": [],
        "session": "open",
    }
    members["move"] = members["moves"].append
    return SimpleNamespace(**members | more)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[Node], None]:
    nodes: list[Node] = []

    def sleep(seconds: float) -> None:
        nodes[-1].now += seconds

    fake = SimpleNamespace(monotonic=lambda: nodes[-1].now, sleep=sleep)
    monkeypatch.setattr(frame_rules, "time", fake)
    return nodes.append


def _found(rule: str, node: Node, clock: Callable[[Node], None], **more: Any) -> str:
    clock(node)
    return str(getattr(frame_rules, rule)(_probe(node, **more)))


OTHER = bytes([1, 0, len(IDENTITY)]) + Identity(bytes(10), NodeState.KEYED, 4, 2, 1024, 17).encode()
SAME = bytes([1, 0, len(IDENTITY)]) + IDENTITY

GOOD = [
    ("can_other_address", {}, "silent when 18, 81, 145 are asked"),
    ("can_other_address", {"home": 239}, "silent when 1, 175, 111 are asked"),
    ("can_other_address", {"also_at": {0x12: (0x12, OTHER)}}, "silent when 18, 81, 145 are asked"),
    ("can_functional", {}, "List, Open and Close of everyone get no reply"),
    (
        "can_lengths",
        {},
        "ignored: a first frame of 7 octets, a classic single frame with its length in the second octet",
    ),
    ("can_sequence", {}, "a request out of sequence gets no reply, the next one does"),
    ("can_sequence", {"fd": True}, "a request out of sequence gets no reply, the next one does"),
    ("can_sequence", {"in_sequence": 2}, "a request out of sequence gets no reply, the next one does"),
    (
        "can_sequence",
        {"controls": ["310000"] * 9 + ["300000"]},
        "a request out of sequence gets no reply, the next one does",
    ),
    ("can_sequence", {"controls": ["300200"]}, "a request out of sequence gets no reply, the next one does"),
    (
        "can_sequence",
        {"controls": ["300200"], "more": []},
        "a request out of sequence gets no reply, the next one does",
    ),
    ("can_flow_obeyed", {}, "waits; blocks of 3, 50 ms between frames at STmin 50"),
    ("can_flow_obeyed", {"gap": 0.0301}, "waits; blocks of 3, 30 ms between frames at STmin 50"),
    ("can_flow_obeyed", {"gap": 0.2}, "waits; blocks of 3, 200 ms between frames at STmin 50"),
    ("can_flow_obeyed", {"lost": (2, 2)}, "waits; blocks of 3, 50 ms between frames at STmin 50"),
    ("can_flow_obeyed", {"lost": (9, 2)}, "waits; blocks of 3, 50 ms between frames at STmin 50"),
    (
        "can_flow_obeyed",
        {"read": lambda transaction: bytes([transaction, 1, 0, 104, 0, 0, 0, 0]) + TEDS[:100]},
        "waits; blocks of 3, 50 ms between frames at STmin 50",
    ),
    ("can_pressed", {"announces": [(0xF511, "0101456cd7460000")]}, "neither moves nor announces"),
    ("can_announce", {"announces": [(HOME, f"0101{CRC.hex()}0000")]}, "announces CRC 456cd746, keyed"),
    ("can_announce", {"announces": [(HOME, f"0101{CRC.hex()}ffff")]}, "announces CRC 456cd746, keyed"),
    (
        "can_announce",
        {"announces": [(0, ""), (0, ""), (HOME, f"0101{CRC.hex()}0000")]},
        "announces CRC 456cd746, keyed",
    ),
    (
        "can_announce",
        {"announces": [(0x44, "0101000000010000"), (HOME, f"0101{CRC.hex()}0000")]},
        "announces CRC 456cd746, keyed",
    ),
    ("can_pressed", {}, "neither moves nor announces"),
    ("can_pressed", {"announces": [(0x44, "0101000000010000")]}, "neither moves nor announces"),
]


@pytest.mark.parametrize(("rule", "knobs", "seen"), GOOD)
def test_what_a_good_node_may_do_breaks_no_rule_of_frames(
    rule: str, knobs: dict[str, Any], seen: str, clock: Callable[[Node], None]
) -> None:
    assert _found(rule, Node(**knobs), clock) == seen


CLAIM = "An Announce of CRC ffffffff from the node's own CAN address 17: "
PRESSED = "An Announce of a pressed button from the node's own CAN address 17: "
BROKEN = [
    (
        "can_other_address",
        {"also_at": {0x51: (HOME, SAME)}},
        "Identify (128.7) to CAN address 81: the node at 17 answers, from address 17.",
    ),
    (
        "can_other_address",
        {"also_at": {0x12: (0x12, SAME)}},
        "Identify (128.7) to CAN address 18: the node at 17 answers, from address 18.",
    ),
    (
        "can_other_address",
        {"also_at": {0x91: (0x44, OTHER), 0x44: (0x44, OTHER)}},
        "Identify (128.7) to CAN address 145: the node at 17 answers, from address 68.",
    ),
    (
        "can_other_address",
        {"also_at": {0x12: (0x12, bytes([0, 0, 1, 3]))}},
        "Identify (128.7) to CAN address 18: the node at 17 answers, from address 18.",
    ),
    (
        "can_functional",
        {"of_everyone": {"800b": "060100000103cccc"}},
        "List (128.11), 0 octets, functional: 060100000103cccc came; only Identify is answered.",
    ),
    (
        "can_functional",
        {"of_everyone": {"8003": "1108030100000e00", "8005": "0504000000cccccc"}},
        "Open (128.3), 0 octets, functional: 1108030100000e00 came; only Identify is answered.",
    ),
    (
        "can_functional",
        {"of_everyone": {"8005": "0504000000cccccc"}},
        "Close (128.5), 0 octets, functional: 0504000000cccccc came; only Identify is answered.",
    ),
    (
        "can_functional",
        {"of_everyone": {"8005": "0505000000cccccc"}},
        "List (128.11), 0 octets, functional: 0505000000cccccc came; only Identify is answered.",
    ),
    (
        "can_lengths",
        {"odd": {"1007": "300000"}},
        "a first frame of 7 octets: 300000 came; it is to be ignored.",
    ),
    (
        "can_lengths",
        {"odd": {"0006": "07010100170101"}},
        "a classic single frame with its length in the second octet: 07010100170101 came; it is to be ignored.",
    ),
    (
        "can_sequence",
        {"in_sequence": None},
        "Write (1.3), 53 octets, outside a session, its second consecutive frame numbered 10 in place of 2: "
        "a reply came; a frame is missing, and the message ends.",
    ),
    ("can_sequence", {"identify": lambda _: b""}, "Identify (128.7) after a request out of sequence: no reply."),
    (
        "can_sequence",
        {"identify": lambda transaction: bytes([transaction - 1]) + SAME},
        "Identify (128.7) after a request out of sequence: no reply.",
    ),
    (
        "can_sequence",
        {"odd": {"identify": "2101010000000000"}},
        "Identify (128.7) after a request out of sequence: no reply.",
    ),
    ("can_sequence", {"controls": []}, "The first frame of a long request got no flow control."),
    ("can_sequence", {"controls": ["3000"]}, "The first frame of a long request got no flow control."),
    (
        "can_sequence",
        {"controls": ["310000"] * 10},
        "The first frame of a long request got ten flow controls with Wait.",
    ),
    ("can_flow_obeyed", {"read": lambda _: b""}, "Read (1.2) of the Security TEDS: no first frame of a reply."),
    (
        "can_flow_obeyed",
        {"waits": False},
        "A frame of the reply came after a flow control with Wait.",
    ),
    (
        "can_flow_obeyed",
        {"block": lambda _: 2},
        "Block size 3 was asked for, 2 frames came. A WAIT before it may have ended the reply.",
    ),
    (
        "can_flow_obeyed",
        {"block": lambda asked: 4 if asked else 0},
        "Block size 3 was asked for; more frames came without a flow control.",
    ),
    (
        "can_flow_obeyed",
        {"gap": 0.0299},
        "STmin 50 ms was asked for: 3 frames took 60 ms, 100 are due.",
    ),
    (
        "can_flow_obeyed",
        {"lost": (2, 3)},
        "Block size 3 was asked for, 2 frames came. A WAIT before it may have ended the reply.",
    ),
    ("can_flow_obeyed", {"lost": (9, 3)}, "A reply of 308 octets ended after 307."),
    (
        "can_flow_obeyed",
        {"read": lambda transaction: bytes([transaction, 1, 1, 48, 0, 0, 0, 0]) + TEDS[:299] + b"?"},
        "Read (1.2) of the Security TEDS, in blocks: another reply came than in one piece.",
    ),
    (
        "can_flow_obeyed",
        {"read": lambda transaction: bytes([transaction + 1, 1, 1, 48, 0, 0, 0, 0]) + TEDS},
        "Read (1.2) of the Security TEDS, in blocks: another reply came than in one piece.",
    ),
    (
        "can_announce",
        {},
        CLAIM + "the node announced nothing within 1 s, 3 times.",
    ),
    (
        "can_announce",
        {"announces": [(0x44, "0101000000010000")] * 3},
        CLAIM + "the node announced nothing within 1 s, 3 times.",
    ),
    (
        "can_announce",
        {"announces": [(0x12, f"0101{CRC.hex()}0000")]},
        CLAIM + "the node moved to 18. Its CRC 456cd746 is smaller, so it stays.",
    ),
    (
        "can_announce",
        {"announces": [(HOME, "0101456cd7470000")]},
        CLAIM + "it announces 0101456cd7470000; 0101456cd7460000 is due.",
    ),
    (
        "can_announce",
        {"announces": [(HOME, "0102456cd7460000")]},
        CLAIM + "it announces 0102456cd7460000; 0101456cd7460000 is due.",
    ),
    (
        "can_announce",
        {"announces": [(HOME, "0101456cd746")]},
        CLAIM + "it announces 0101456cd746; 0101456cd7460000 is due.",
    ),
    (
        "can_pressed",
        {"announces": [(HOME, "0101456cd7460000")]},
        PRESSED + "the node takes it for a claim, and announces.",
    ),
    (
        "can_pressed",
        {"announces": [(0x12, "0101456cd7460000")]},
        PRESSED + "the node takes it for a claim, and announces.",
    ),
]


@pytest.mark.parametrize(("rule", "knobs", "words"), BROKEN)
def test_a_rule_of_frames_finds_what_breaks_it(
    rule: str, knobs: dict[str, Any], words: str, clock: Callable[[Node], None]
) -> None:
    with pytest.raises(RuleBrokenError) as broken:
        _found(rule, Node(**knobs), clock)
    assert str(broken.value) == words


ALWAYS_FIRST = "The CRC-32 of this UUID is the greatest: no other claim loses against it."
READ = "18da11f5 100c010000010200", "18da11f5 21058000000000cc"
SENT: list[tuple[str, dict[str, Any], list[str], float]] = [
    (
        "can_other_address",
        {},
        ["18da12f5 0701000080070000", "18da51f5 0702000080070000", "18da91f5 0703000080070000"],
        0.9,
    ),
    (
        "can_other_address",
        {"also_at": {0x12: (0x12, OTHER)}},
        [
            "18da12f5 0701000080070000",
            "18da12f5 300000cccccccccc",
            "18da51f5 0702000080070000",
            "18da91f5 0703000080070000",
        ],
        0.6,
    ),
    (
        "can_functional",
        {},
        [
            "18dbfff5 07010000800b0000",
            "18dbfff5 0702000080150000",
            "18dbfff5 0703000080030000",
            "18dbfff5 0704000080050000",
        ],
        0.3,
    ),
    (
        "can_functional",
        {"of_everyone": {"8003": "1013030100000e00", "8005": "0504000000cccccc"}},
        [
            "18dbfff5 07010000800b0000",
            "18dbfff5 0702000080150000",
            "18dbfff5 0703000080030000",
            "18dbfff5 0704000080050000",
            "18da11f5 320000cccccccccc",
            "18da11f5 320000cccccccccc",
        ],
        0.3,
    ),
    ("can_lengths", {}, ["18da11f5 1007010000800700", "18da11f5 0006010000800700"], 0.6),
    (
        "can_sequence",
        {"controls": ["310000", "30020a"]},
        [
            "18da11f5 103c010000010300",
            "18da11f5 21350c0000000000",
            "18da11f5 2a00000000000000",
            "18da11f5 2300000000000000",
            "18da11f5 2400000000000000",
            "18da11f5 2500000000000000",
            "18da11f5 2600000000000000",
            "18da11f5 2700000000000000",
            "18da11f5 280000000000cccc",
            "18da11f5 0702000080070000",
            "18da11f5 300000cccccccccc",
        ],
        0.38,
    ),
    (
        "can_sequence",
        {"controls": ["300200"], "more": []},
        [
            "18da11f5 103c010000010300",
            "18da11f5 21350c0000000000",
            "18da11f5 2a00000000000000",
            "18da11f5 0702000080070000",
            "18da11f5 300000cccccccccc",
        ],
        0.6,
    ),
    (
        "can_sequence",
        {"fd": True},
        [
            "18da11f5 10c8010000010300c10c" + "00" * 54,
            "18da11f5 21" + "00" * 63,
            "18da11f5 2a" + "00" * 63,
            "18da11f5 23" + "00" * 12 + "cccccc",
            "18da11f5 0702000080070000",
        ],
        0.3,
    ),
    (
        "can_flow_obeyed",
        {},
        [*READ, "18da11f5 310000cccccccccc", "18da11f5 300332cccccccccc", "18da11f5 300000cccccccccc"],
        0.75,
    ),
    (
        "can_flow_obeyed",
        {"gap": 0.02},
        [*READ, "18da11f5 310000cccccccccc", "18da11f5 300332cccccccccc", "18da11f5 320000cccccccccc"] * 3,
        1.08,
    ),
    ("can_announce", {"announces": [(0, ""), (HOME, f"0101{CRC.hex()}0000")]}, ["1cff0011 0101ffffffff0000"] * 2, 1.0),
    ("can_announce", {}, ["1cff0011 0101ffffffff0000"] * 3, 3.0),
    ("can_pressed", {}, ["1cff0011 0100ffffffff0100"], 1.0),
]


@pytest.mark.parametrize(("rule", "knobs", "sent", "seconds"), SENT)
def test_a_rule_of_frames_sends_these_and_waits_so_long(
    rule: str, knobs: dict[str, Any], sent: list[str], seconds: float, clock: Callable[[Node], None]
) -> None:
    node = Node(**knobs)
    with suppress(RuleBrokenError):
        _found(rule, node, clock)
    assert node.sent == sent
    assert node.now - 100 == pytest.approx(seconds, abs=1e-6)


def test_a_node_that_moved_is_asked_at_its_new_address_and_its_session_is_over(
    clock: Callable[[Node], None],
) -> None:
    node = Node(announces=[(0x12, f"0101{CRC.hex()}0000")])
    clock(node)
    probe = _probe(node)
    with pytest.raises(RuleBrokenError):
        frame_rules.can_announce(probe)
    assert (probe.moves, probe.session) == ([0x12], None)


@pytest.mark.parametrize(
    ("rule", "more", "why"),
    [
        ("can_announce", {"uuid": GREATEST_CRC}, ALWAYS_FIRST),
        ("can_pressed", {"uuid": GREATEST_CRC}, ALWAYS_FIRST),
        (
            "can_pressed",
            {"plain": lambda command: Reply(False, b"\1")},
            "The node is from before pressed buttons were announced (128.21 gets 1).",
        ),
    ],
)
def test_a_claim_that_shows_nothing_is_not_tried(
    rule: str, more: dict[str, Any], why: str, clock: Callable[[Node], None]
) -> None:
    node = Node()
    with pytest.raises(NotApplicableError) as no:
        _found(rule, node, clock, **more)
    assert (str(no.value), node.sent) == (why, [])


def test_frames_for_other_stations_of_other_nodes_and_without_octets_are_passed_over(
    clock: Callable[[Node], None],
) -> None:
    """Frames other than the node's replies: an Announce, data, a reply to another base station, an empty frame."""
    node = Node()
    noise = [
        BusFrame(0x1CFF0044, bytes.fromhex("0101000000010000"), 0.0),
        BusFrame(0x18DAF611, bytes.fromhex("2101020304050607"), 0.0),
        BusFrame(0x18DBFFF5, bytes.fromhex("2101020304050607"), 0.0),
        BusFrame(0x18DAF511, b"", 0.0),
    ]
    put = node._put

    def beside(octets: bytes, *where: Any) -> None:
        node.out.extend(noise)
        if octets[0] >> 4 == 2:
            put(b"\x30\0\0")
        put(octets, *where)

    node._put = beside  # type: ignore[method-assign, assignment]
    assert _found("can_flow_obeyed", node, clock) == "waits; blocks of 3, 50 ms between frames at STmin 50"
    node.out.extend(noise)
    assert _found("can_functional", node, clock) == "List, Open and Close of everyone get no reply"


def test_a_stranger_counts_its_requests_and_writes_one_frame_while_one_is_enough() -> None:
    """Transactions are 1 to 255 in turn; 7 octets fit a classic single frame, 62 one of CAN FD."""
    node = Node(controls=[])
    stranger = frame_rules._Stranger(node, HOME, OWN)
    assert [stranger.transaction() for _ in range(256)] == [*range(1, 256), 1]
    for fd, octets in ((False, 7), (True, 62)):
        node.fd = stranger.fd = fd
        stranger.request(bytes(octets))
        with pytest.raises(RuleBrokenError, match="no flow control"):
            stranger.request(bytes(octets + 1))
    assert [frame[9:13] for frame in node.sent] == ["0700", "1008", "003e", "103f"]
