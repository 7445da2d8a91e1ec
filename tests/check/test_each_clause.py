"""Each clause of a rule finds the one reply that breaks it: replies of a good node are bent, one at a time.

A rule that looks at several things finds the fault of ``faults.py`` by one of them. Here every rule of a whole run is
tried again for each row, with one reply bent as the rule sees it, from the state in which the good run found the node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from teds_provision.check import measuring_rules, plain_rules
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError
from teds_provision.check.rule import Rule, RuleResult
from teds_provision.check.run import _Run
from teds_provision.errors import NotAuthenticError
from teds_provision.protocol.messages.frames import Attribute, Command, Reply, TedsStatus
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.datagram import DatagramSealer, stream_key
from teds_provision.protocol.operation.stream_commands import StreamKind, SubscribeCommand
from teds_provision.protocol.session import StationSession
from teds_provision.station.station import Station
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from . import bends, nodes
from .faulty import FaultyBus

Change = Callable[[Any], Any]
Row = tuple[str, str, int, Change | int, str]
"""A rule; the command, ``teds`` (the Security TEDS as it is read) or ``messages``; which of its replies (1 on,
or -1 for the last); how its payload comes now, or the reason of a refusal; words of what is found."""


@dataclass(frozen=True)
class _OwnPoint:
    """The node's identity key in place of a one-time key."""

    place: int

    def __call__(self, payload: bytes) -> bytes:
        return payload[: self.place] + self.point + payload[self.place + 65 :]

    point: ClassVar[bytes] = b""


@dataclass(frozen=True)
class _AsBefore:
    """The same octets as in the reply of the Request before."""

    begin: int
    end: int
    before: ClassVar[bytes] = b""

    def __call__(self, payload: bytes) -> bytes:
        return payload[: self.begin] + self.before[self.begin : self.end] + payload[self.end :]


def _identity(**members: Any) -> Change:
    """Return a change of Identify; a number is added."""

    def change(payload: bytes) -> bytes:
        now = Identity.decode(payload)
        new: dict[str, Any] = {
            name: value if isinstance(value, (NodeState, bytes)) else getattr(now, name) + value
            for name, value in members.items()
        }
        return replace(now, **new).encode()

    return change


def _status(flip: int = 0, **more: int) -> Change:
    def change(payload: bytes) -> bytes:
        now = TedsStatus.decode(payload)
        added = {name: getattr(now, name) + number for name, number in more.items()}
        return replace(now, attributes=now.attributes ^ flip, **added).encode()

    return change


def _at(place: int, octets: bytes) -> Change:
    return lambda payload: payload[:place] + octets + payload[place + len(octets) :]


def _xor(place: int, mask: int) -> Change:
    return lambda payload: _at(place, bytes([payload[place] ^ mask]))(payload)


def _sheet(change: Callable[[security.SecurityTeds], security.SecurityTeds]) -> Change:
    return lambda teds: change(security.decode(teds)).encode()


def _longer(payload: bytes) -> bytes:
    return payload + b"\0"


def _shorter(payload: bytes) -> bytes:
    return payload[:-1]


def _turned(payload: bytes) -> bytes:
    return payload[3:6] + payload[:3] + payload[6:]


def _without_can(payload: bytes) -> bytes:
    return replace(Identity.decode(payload), can_address=0).encode()


def _without_security(payload: bytes) -> bytes:
    blocks = [payload[at : at + 3] for at in range(0, len(payload), 3)]
    return b"".join(block for block in blocks if block != b"\0\0\x80")


def _listed(block: bytes) -> Change:
    return lambda payload: payload + block


def _states_without(bit: int) -> Change:
    return lambda payload: bytes(octet & ~bit if at % 3 == 2 else octet for at, octet in enumerate(payload))


ROWS: list[Row] = [
    ("refusal-form", "128.99", 1, bytes, "128.99: status 1 and 1 octets"),
    ("stranger-ends-nothing", "128.4", 1, _xor(30, 1), "The tag of a sealed reply is wrong."),
    ("identify", "128.7", 1, _identity(uuid=bytes(10)), "the node was found as"),
    ("prove", "128.8", 1, _longer, "64 octets are due, 65 came"),
    ("list-ascending", "128.11", 1, _without_security, "leaves out the Security TEDS"),
    ("list-ascending", "128.11", 1, _listed(b"\xff\xff\xff"), "names what no node may hold"),
    ("query-present", "1.1", 1, _status(Attribute.NOT_AVAILABLE), "NotAvail, but List has it"),
    ("query-present", "1.1", 1, _status(Attribute.MANUFACTURER), "MfgrDefine is"),
    ("query-present", "1.1", 1, _status(status=1), "status 1, 0 is due"),
    ("query-present", "1.1", 1, _shorter, "Query (1.1) of"),
    ("read-end", "1.2", -1, _longer, "1 octets came"),
    ("node-key", "teds", 1, _sheet(lambda s: replace(s, node_key=b"\4" + bytes(64))), "Field 101 is no point"),
    (
        "node-key", "teds", 1, _sheet(lambda s: replace(s, node_key_signature=bends.high(s.node_key_signature))),
        "s is in the upper half",
    ),
    ("security-state", "128.7", 1, _identity(sequence=1), "Field 106 is"),
    ("security-state", "128.7", 1, _identity(state=NodeState.PROVISIONED), "signed: False"),
    ("factory-reset", "128.7", -1, _identity(epoch=1), "in factory state changed Identify"),
    ("agreement-epoch", "128.7", -1, _identity(sequence=1), "Request changed the reply to Identify"),
    ("agreement-fresh", "128.1", 2, _OwnPoint(20), "En is the node's identity key"),
    ("open-one-time", "128.3", -1, _OwnPoint(0), "En is the node's identity key"),
    ("confirm-checks", "128.7", -1, _identity(epoch=1), "although no Confirm was good"),
    ("about", "128.21", 1, _xor(1, 0x40), "bits 6 and 7 of the flags are 0"),
    ("about", "128.21", 1, 3, "success is due, refusal 3 came"),
    ("about-keyed", "128.21", 1, 3, "success is due, refusal 3 came"),
    ("about-in-session", "128.21", 1, 2, "in a session: success is due"),
    ("agreement", "128.7", -1, _identity(state=NodeState.FACTORY), "still reports factory state"),
    ("agreement", "128.7", -1, _identity(epoch=1), "was offered"),
    ("agreement", "128.7", -1, _identity(sequence=1), "Confirm took the sequence"),
    ("open", "128.7", -1, _identity(sequence=1), "replies differently in the session"),
    ("open-checks", "128.3", -1, _xor(7, 1), "A refused Open changed c."),
    ("repetition-everyone", "128.7", -1, 3, "success is due"),
    ("address-moves", "128.7", 2, _identity(can_address=1), "Identify says"),
    ("address-moves", "128.10", 2, 2, "success is due, refusal 2 came"),
    ("address-checks", "128.7", -1, _identity(can_address=1), "A refused Set CAN address changed Identify."),
    ("address-back", "128.7", -1, _identity(can_address=1), "After Set CAN address"),
    ("update-checks", "128.11", -1, _listed(b"\0\xff\x11"), "staged and not committed"),
    ("staged-unseen", "1.1", 2, _status(size=1), "which is staged, not committed"),
    ("staged-unseen", "1.1", 3, _status(size=1), "alone stored it"),
    ("staging-ends", "1.4", 1, _status(size=1), "of a staged TEDS: size"),
    ("staging-shared", "1.4", -1, _status(size=1), "after another session's Write"),
    ("commit", "teds", -1, _xor(20, 1), "After the commit Read gives another"),
    ("commit", "128.11", -1, lambda payload: payload[:-3], "holds other TEDS than were signed"),
    ("commit", "128.7", -1, _identity(sequence=1), "Sequence went from"),
    ("commit-extra", "teds", -1, _xor(20, 1), "255 Read gives another"),
    ("operate-values", "4.1", 1, 6, "refusal 6"),
    ("operate-values", "128.12", 5, _longer, "are due"),
    ("operate-expires", "128.19", 1, _states_without(2), "is not claimed here"),
    ("operate-expires", "128.19", -1, _at(0, b"\1"), "the node measures, and no channel is claimed"),
    ("stream-messages", "128.14", 1, 21, "refusal 21"),
    ("stream-messages", "128.14", 1, _shorter, "Subscribe (128.14)"),
    ("stream-messages", "128.14", 1, _xor(3, 1), "are announced"),
    ("stream-messages", "128.14", 1, _xor(3, 16), "are announced"),
    ("stream-messages", "messages", 1, lambda came: came[:-1], "2 data messages within"),
    ("stream-messages", "messages", 2, lambda came: came[::-1], "came after one with"),
    ("stream-messages", "messages", 3, lambda came: [*came, b"\xff" * 15], "a data message left after its reply"),
    ("drive-replay", "128.20", 1, _xor(1, 2), "run 3; 1 is due"),
    ("drive-replay", "128.20", 1, _xor(3, 1), "are announced"),
    ("drive-replay", "128.20", 1, _xor(3, 64), "are announced"),
    ("drive-replay", "128.16", 3, _at(30, b"\xff" * 4), "none had a good tag"),
    ("drive-replay", "128.16", 3, _at(30, bytes([0, 0, 0, 6])), "says 6"),
    ("drive-replay", "128.16", 4, _at(30, bytes([0, 0, 0, 4])), "was taken after counter 7; Clock (128.16) says 4"),
    ("drive-replay", "128.19", -1, _states_without(32), "bit 5 is not set"),
    ("trigger-token", "128.16", 2, _at(16, bytes(8)), "gives no mark"),
    ("trigger-token", "128.16", 3, _xor(23, 1), "the mark went from"),
    ("trigger-token", "128.16", 1, _shorter, "Clock (128.16)"),
    ("confirm-ends-sessions", "128.7", -2, _identity(epoch=1), "After Confirm the epoch is not"),
    ("rotation-keeps", "128.7", -1, _identity(sequence=1), "Confirm took the sequence"),
    ("rotation-keeps", "128.7", -1, _identity(state=NodeState.KEYED), "provisioned became keyed"),
    ("rotation-keeps", "1.2", 3, lambda payload: payload[:-1] + bytes([payload[-1] ^ 1]), "its TEDS are not"),
    ("reset", "128.7", 2, _identity(state=NodeState.KEYED), "After Reset the node is keyed"),
    ("identify", "128.7", 1, _shorter, "Identify (128.7): "),
    ("list-ascending", "128.11", 1, _turned, "does not ascend, or names one twice"),
    ("list-ascending", "128.11", 1, lambda payload: payload + payload[-3:], "does not ascend, or names one twice"),
    ("list-ascending", "128.11", 1, _longer, "octets are no multiple of 3."),
    ("query-absent", "1.1", 1, _status(Attribute.NOT_AVAILABLE), "NotAvail is due"),
    ("query-absent", "1.1", 1, _status(size=1), "NotAvail is due"),
    ("read-end", "1.2", -1, _xor(3, 1), "and 0 octets came"),
    ("security-state", "128.7", 1, _identity(epoch=1), "Identify says epoch"),
    ("about", "128.21", 1, lambda payload: payload[:20], "About (128.21): "),
    ("agreement-tags", "128.1", 2, _longer, "Request (128.1): 165 octets are due, 166 came."),
    ("agreement-tags", "128.1", 2, _at(20, b"\4" + bytes(64)), "Request (128.1): "),
    ("agreement-tags", "128.1", 2, _xor(85, 1), "Request (128.1): tagN is wrong."),
    ("agreement-tags", "128.1", 2, _xor(101, 1), "tagN is right, sigN does not verify under field 101."),
    ("agreement-tags", "128.1", 2, lambda p: p[:101] + bends.high(p[101:]), "s of sigN is in the upper half"),
    ("agreement-epoch", "128.1", 2, _xor(19, 1), "A known slip fits: the stored epoch is offered"),
    ("agreement-epoch", "128.1", 2, _at(16, b"\5\0\0\0"), "the epoch in the reply is little-endian"),
    ("agreement-low-s", "128.1", -1, lambda p: p[:101] + bends.high(p[101:]), "s of sigN is in the upper half"),
    ("agreement-fresh", "128.1", 4, _AsBefore(0, 16), "answered with the same nonceN."),
    ("agreement-fresh", "128.1", 4, _AsBefore(20, 85), "answered with the same one-time key En."),
    ("agreement-fresh", "128.1", 4, _OwnPoint(20), "En is the node's identity key"),
    ("open", "128.3", 1, _longer, "c has 9 octets, 8 are due."),
    ("open", "128.3", 2, _longer, "Open (128.3): "),
    ("open", "128.3", 2, _xor(70, 1), "Open (128.3): "),
    ("sealed-residues", "1.2", 3, _xor(0, 1), "sealed, an inner reply of"),
    ("address-moves", "128.7", 1, _without_can, "The board has no CAN, and so no address to move."),
    ("commit-uuid", "1.1", 1, _status(Attribute.READ_ONLY), "The Meta-TEDS of this node is read-only."),
    ("commit-values", "128.7", -1, _identity(sequence=1), "(field 110 with 9), and changed the node."),
    ("commit-values", "128.11", -1, lambda payload: payload[:-3], "(field 110 with 9), and changed the node."),
    ("commit-values", "teds", -1, _xor(20, 1), "(field 110 with 9), and changed the node."),
    ("commit", "128.7", -1, _identity(state=NodeState.KEYED), "provisioned is due."),
    ("reset", "128.7", 2, _identity(epoch=1), "Reset took epoch"),
    ("reset", "128.7", 2, _identity(sequence=1), "Reset took epoch"),
    ("reset", "128.11", -1, lambda payload: payload[:-3], "the other TEDS of the node are not what they were."),
    ("reset", "128.9", 2, _xor(0, 1), "the proof does not verify under field 101 at this epoch."),
    ("reset-forgets", "128.7", 1, _identity(state=NodeState.KEYED), "The node was not reset."),
    ("operate-expires", "128.19", 1, lambda _: b"", "Operation (128.19): "),
    ("drive-replay", "128.16", 1, _shorter, "Clock (128.16): "),
    ("drive-replay", "4.1", 1, 6, "Operate (4.1) of channel 4, sealed, lease 30: "),
]  # fmt: skip


class _Bench:
    """Counts replies by command, and bends one of them."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.count, self.bent, self.at = Counter[str](), "", 0
        self.change: Change | int = 0
        plain, sealed, teds = Probe.plain, Probe._sealed, Probe.teds

        def plainly(probe: Probe, command: Command) -> Reply:
            return self.answer(command, plain(probe, command))

        def in_session(probe: Probe, session: StationSession, command: Command) -> Reply:
            return self.answer(command, sealed(probe, session, command))

        def read(probe: Probe, block: tuple[int, int]) -> bytes:
            octets = teds(probe, block)
            change = self.due("teds") if block == SECURITY else None
            return bytes(change(octets)) if callable(change) else octets

        messages = measuring_rules._messages

        def heard(*args: Any, **more: Any) -> list[bytes]:
            came, change = messages(*args, **more), self.due("messages")
            return list(change(came)) if callable(change) else came

        patch.setattr(measuring_rules, "_messages", heard)
        patch.setattr(Probe, "plain", plainly)
        patch.setattr(Probe, "_sealed", in_session)
        patch.setattr(Probe, "teds", read)

    def due(self, name: str) -> Change | int | None:
        self.count[name] += 1
        return self.change if (name, self.count[name]) == (self.bent, self.at) else None

    def answer(self, command: Command, reply: Reply) -> Reply:
        change = self.due(f"{command.command_class}.{command.function}")
        if (command.command_class, command.function) == (128, 1) and reply.ok and change is None:
            _AsBefore.before = reply.payload
        if change is None:
            return reply
        return Reply(True, change(reply.payload)) if callable(change) else Reply(False, bytes([change]))


def _found(station: Station, patch: pytest.MonkeyPatch, rows: list[Row], over: str) -> dict[Row, str]:
    """Return what each row's rule finds, "" if it is not tried or finds nothing."""
    board = nodes.made(over)
    patch.setattr(_OwnPoint, "point", board.key.point)
    found, bench = dict.fromkeys(rows, ""), _Bench(patch)
    line = FaultyBus(board)
    tried = _Run._tried

    def restore(probe: Probe, kept: dict[str, Any], state: Any) -> None:
        board.flash.state = state
        board.power_on()
        for each in line.lines.values():
            each.repetition.forget()
        vars(probe).update(kept, session=None)
        line.address = line._pair = probe.contact.address or line.address

    def of_rule(run: _Run, rule: Rule) -> RuleResult:
        probe, mine = run._probe, [row for row in rows if row[0] == rule.name]
        before, state = dict(vars(probe)), board.flash.state
        bench.count.clear()
        bench.bent = ""
        result, count = tried(run, rule), bench.count.copy()
        after, later = dict(vars(probe)), board.flash.state
        for row in mine:
            _, bench.bent, at, bench.change, _ = row
            bench.at = at if at > 0 else count[bench.bent] + 1 + at
            bench.count.clear()
            restore(probe, before, state)
            try:
                rule.run(probe)
            except (RuleBrokenError, NotApplicableError) as broken:
                found[row] = str(broken)
            except NotAuthenticError as wrong:
                found[row] = wrong.message
            bench.bent = ""
        if mine:
            restore(probe, after, later)
        return result

    patch.setattr(_Run, "_tried", of_rule)
    report = nodes.checked(station, patch, board, over=over, line=line)
    assert report.lost is None
    assert nodes.failed(report) == {}
    return found


def test_each_clause_of_a_rule_finds_the_reply_that_breaks_it(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = _found(station, monkeypatch, ROWS, "measuring can")
    assert [(row[:3], row[4], why) for row, why in found.items() if row[4] not in why or not why] == []


def test_a_data_message_of_the_test_pattern_has_its_flag_and_the_sample_of_its_counter() -> None:
    key = bytes(range(32))
    asked = SubscribeCommand(0, StreamKind.PERIODIC, 1, 0, 10**6, 0, (3,), test_pattern=True)

    def look(flags: int, sample: str) -> None:
        message = DatagramSealer(stream_key(key, 2)).seal(300, bytes([flags]) + bytes.fromhex(sample))
        measuring_rules._right_message(key, 2, message, asked, 2)

    look(0x80, "012f")
    for flags, sample, words in ((0x01, "012f", "sets bit 7"), (0x80, "0130", "0130; the test pattern has 012f")):
        with pytest.raises(RuleBrokenError, match=words):
            look(flags, sample)


@pytest.mark.parametrize(("octets", "allowed"), [(511, False), (512, True), (4094, True), (4095, False)])
def test_a_board_takes_512_to_4094_octets(octets: int, allowed: bool) -> None:
    probe: Any = SimpleNamespace(max_message=octets, refused=lambda *_: "refusal")
    if allowed:
        assert plain_rules.max_message(probe) == "refusal"
        return
    with pytest.raises(RuleBrokenError, match=f"maxMessage {octets}; 512 to 4094 are allowed"):
        plain_rules.max_message(probe)
