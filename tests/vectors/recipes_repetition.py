"""Repetition on a link: which requests are run and which get the stored reply (profile: repetition)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.frames import Command, Function, decode_reply, security_command
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement

from .recipes import CHALLENGE, IDENTIFY, changed_request
from .scene import KAT, UUID, K, Scene, credentials, key, named_key


class Line(Scene):
    """A scene on one link, whose node keeps its last request and reply."""

    def __init__(self, name: str, note: str, state: str = "keyed") -> None:
        super().__init__(name, note, state)
        self.kept = Repetition()

    def send(self, transaction: int, command: Command, note: str, *, functional: bool = False) -> bytes:
        """Return a request under a transaction number; written down with whether the node ran it."""
        frame, ran = command.encode(), []

        def run(octets: bytes) -> bytes:
            ran.append(octets)
            return self._tim.handle(octets, link="nfc", tapped=True)

        self._drawn = {}
        reply = run(frame) if functional else self.kept.answer(transaction, frame, run, now=self.now)
        step = {"note": note, "at": self.now, "transaction": transaction, "functional": functional, **self._drawn}
        step |= {"command": frame.hex(), "reply": reply.hex(), "run": bool(ran)}
        answer = decode_reply(reply)
        if answer.reason is not None:
            step["reason"] = answer.reason
        self.steps.append(step)
        return reply

    def lose(self, note: str) -> None:
        """The field or the bus is lost."""
        self.kept.forget()
        self.event("link_lost", note, link="nfc")


def _session(name: str, note: str) -> tuple[Line, Command]:
    """Return a line with a session open, and its first Sealed."""
    line = Line(name, note)
    session = StationSession(K, UUID, one_time=named_key(name, "Es"))
    counter = decode_reply(line.send(0, session.request_counter(), "Open without payload asks for c.")).payload
    reply = line.send(1, session.open(counter), "Open.")
    session.accept(decode_reply(reply).payload)
    return line, session.seal(security_command(Function.LIST))


def repetition() -> Iterator[Scene]:
    """Repetition on one link (a tapped one): steps with transaction numbers, and whether the node runs the command.

    Transaction numbers are u8 here, so that they fit CAN; on NFC they are u16.
    """
    line, sealed = _session("sealed", "A Sealed whose reply was lost: the stored octets, not a replay.")
    line.send(2, sealed, "Counter 1.")
    line.send(2, sealed, "Equal octet for octet: the stored reply.")
    line.later(14.0).send(2, sealed, "14 s later: still.")
    line.send(3, sealed, "Another transaction: run, and so a replay: 13.")
    line.send(3, sealed, "That reply is the stored one now.")
    yield line

    line = Line("open", "An Open whose reply was lost: the stored octets. Anew it would get 12.")
    session = StationSession(K, UUID, one_time=named_key("open", "Es"))
    opening = session.open(
        decode_reply(line.send(1, session.request_counter(), "Open without payload asks for c.")).payload
    )
    line.send(2, opening, "Open.")
    line.send(2, opening, "Equal octet for octet: the stored reply, the same En.")
    line.send(3, opening, "Another transaction: run: 12.")
    yield line

    line, sealed = _session("after-20-s", "The stored reply is kept for 20 s.")
    line.send(2, sealed, "Counter 1.")
    line.later(20.0).send(2, sealed, "20 s later: run: 13.")
    yield line

    line, sealed = _session(
        "identify-between",
        "A plain Identify between a Sealed and its repetition replaces the stored reply.",
    )
    line.send(2, sealed, "Counter 1.")
    line.send(3, IDENTIFY, "Identify.")
    line.send(2, sealed, "Run: 13.")
    yield line

    line, sealed = _session("functional-between", "A functional Identify neither uses nor replaces the stored reply.")
    line.send(2, sealed, "Counter 1.")
    line.send(2, IDENTIFY, "A functional Identify, by chance under the same transaction.", functional=True)
    line.send(2, sealed, "The stored reply.")
    yield line

    line, sealed = _session("link-lost", "The stored reply goes with the link, and so does the session.")
    line.send(2, sealed, "Counter 1.")
    line.lose("The node leaves the field.")
    line.send(2, sealed, "Run: no session, 2.")
    yield line

    line = Line("agreement", "Request and Confirm are not run twice either.", "factory")
    first = line.send(1, changed_request(), "Request.")
    line.send(1, changed_request(), "The same: the same nonce.")
    line.send(2, security_command(Function.CONFIRM, _tag(first)), "Confirm.")
    line.send(
        2, security_command(Function.CONFIRM, _tag(first)), "The same: good again, though nothing is pending any more."
    )
    line.send(3, security_command(Function.CONFIRM, _tag(first)), "Another transaction: run: 2.")
    yield line

    line = Line("always-run", "Identify, Prove, List, Query and Read outside Sealed are run anew each time.", "keyed")
    prove = security_command(Function.PROVE, CHALLENGE)
    for command in (IDENTIFY, prove, security_command(Function.LIST)):
        line.send(1, command, "Run.")
        line.send(1, command, "Equal, and run again.")
    address = security_command(Function.SET_CAN_ADDRESS, b"\x21")
    line.send(2, address, "Set CAN address: run.")
    line.send(2, address, "Equal: the stored reply.")
    line.later(10.0).send(2, replace(address, payload=b"\x22"), "The same transaction, another body: run.")
    yield line


def _tag(reply: bytes) -> bytes:
    """TagS that answers this reply to the vectors' Request."""
    agreement = StationAgreement(credentials(), UUID, one_time=key("one_time"))
    teds = bytes.fromhex(KAT["initial_security_teds"])
    agreed = agreement.accept(decode_reply(reply).payload, teds, pinned=fingerprint(key("node").point), epoch=0)
    return agreed.confirm.payload


FILES = {"repetition": repetition}
