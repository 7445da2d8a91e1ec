"""NDEF messages of NFC exchanges and CAN frames of ISO-TP exchanges (profile: NFC, CAN, repetition)."""

# ruff: noqa: E501 - one row per case, its note in words included
from __future__ import annotations

import queue
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.bus_multiplexer import BroadcastReplies
from teds_provision.links.can.isotp import FUNCTIONAL, Pair, single
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece, Requester, room
from teds_provision.node.nfc.tnep import TnepTag
from teds_provision.protocol.messages.frames import Command, Function, read_teds, security_command
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.protocol.memory import RamFlash

from .recipes import IDENTIFY
from .scene import CAN_ADDRESS, UUID, credentials, flash, key, named_key, octets

STATION_ADDRESS = 0xF1
TRANSACTION = 0x1234
CAN_TRANSACTION = 0x2A
REQUEST = StationAgreement(credentials(), UUID, one_time=key("one_time")).request()


def node(name: str, state: str = "factory", *, max_message: int = 2048) -> Tim:
    """The vectors' node with fixed nonces and one-time keys: octets(name, 0, ...), named_key(name, 0, ...) and so on."""
    count, pairs = iter(range(1000)), iter(range(1000))
    return Tim(
        key("node"),
        RamFlash(flash(state)),
        lambda: 0.0,
        max_message=max_message,
        random=lambda size: octets(name, "c")[:8] if size == 8 else octets(name, next(count), "nonceN")[:size],
        one_time=lambda: named_key(name, next(pairs), "En"),
    )


# -- NFC ---------------------------------------------------------------------------------------------------------------


class Mailbox:
    """The NDEF message of a tag, in memory: what the node puts is queued for the reader."""

    def __init__(self, max_ndef: int) -> None:
        self.max_ndef = max_ndef
        self.written: Callable[[bytes], None] = lambda octets: None
        self.shown: queue.Queue[bytes] = queue.Queue()

    def put(self, octets: bytes) -> None:
        """The node replaces the message; an empty one says "need more time"."""
        if octets:
            self.shown.put(octets)

    def write(self, octets: bytes) -> bytes:
        """The reader writes a message; returns the next one that is not empty."""
        self.written(octets)
        return self.shown.get(timeout=60)


class TagHandler:
    """A Tim as the link server sees it."""

    def __init__(self, tim: Tim) -> None:
        self.tim = tim

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        """Run one command."""
        return self.tim.handle(frame, link=link, tapped=tapped)

    def lost(self, link: str) -> None:
        """The field is gone."""
        self.tim.link_lost(link)

    def identify(self) -> bytes:
        """Identify as it is now."""
        return self.tim.identity().encode()

    def can_address(self) -> int:
        """Present CAN address."""
        return self.tim.flash.can_address


class Tap:
    """One tap: messages written and read, and what each is for."""

    def __init__(self, name: str, note: str, *, max_ndef: int, state: str = "factory") -> None:
        self.entry: dict[str, Any] = {"name": name, "note": note, "state": state, "max_ndef": max_ndef, "steps": []}
        self.mailbox = Mailbox(max_ndef)
        self.tag = TnepTag(self.mailbox, TagHandler(node(name, state)), wt_int=20, n_wait=15)
        self.tag.start()
        initial = self.mailbox.shown.get(timeout=60)
        self.tag.activated()
        initial = self.mailbox.shown.get(timeout=60)
        self._node(initial, "Initial message: the Tp record, then the id record with the payload of Identify.")

    def _node(self, octets: bytes, note: str) -> None:
        self.entry["steps"].append({"by": "node", "note": note, "message": octets.hex()})

    def write(self, octets: bytes, note: str, answer: str) -> bytes:
        """The station writes, the node answers."""
        self.entry["steps"].append({"by": "station", "note": note, "message": octets.hex()})
        reply = self.mailbox.write(octets)
        self._node(reply, answer)
        return reply

    def select(self) -> Tap:
        """Select the service."""
        self.write(message.encode([tnep.select(tnep.SERVICE)]), "Ts record: selects the service.", "Te 00.")
        return self

    def piece(self, piece: Piece, note: str, answer: str) -> Piece:
        """Send one payload record and return the reply."""
        reply = self.write(message.encode([tnep.payload_record(piece.encode())]), note, answer)
        payload = tnep.external(message.decode(reply), tnep.TIM_TYPE)
        assert payload is not None
        return Piece.decode(payload)

    def exchange(self, command: Command, transaction: int) -> Tap:
        """Send one whole command and return its reply, in as many pieces as it takes."""
        frame = command.encode()
        requester = Requester(transaction, frame, room(self.mailbox.max_ndef))
        begin = len(self.entry["steps"])
        while requester.reply is None:
            piece = requester.next()
            note = (
                "Asks for the answer from this offset on: empty body." if not piece.body else "Request, a piece of it."
            )
            taken = self.piece(piece, note, "")
            part = (
                "Te 00 and a part of the answer." if taken.body else "Te 00 and what is held so far: an empty answer."
            )
            self.entry["steps"][-1]["note"] = part
            requester.handle_piece(taken)
        self.entry["steps"][begin] |= {"command": frame.hex(), "reply": requester.reply.hex()}
        return self

    def end(self) -> dict[str, Any]:
        """Deselect and stop."""
        self.write(message.encode([tnep.select(b"")]), "Ts with an empty URI: deselects.", "The initial message again.")
        self.tag.stop()
        return self.entry


def nfc_pieces() -> Iterator[dict[str, Any]]:
    """NDEF messages of whole exchanges by NFC: initial message, selection, payload records and their pieces.

    Each step is one NDEF message, written by the station or shown by the node. "command" and "reply" are the whole
    frames that travel from that step on. The node of kat.json; random octets as nfc_pieces' entries need them.
    """
    yield (
        Tap("identify", "One command and one reply, each in one message.", max_ndef=4160)
        .select()
        .exchange(IDENTIFY, TRANSACTION)
        .end()
    )
    tap = Tap(
        "request-in-two-pieces",
        "maxNdef 200: Request of 265 octets in two pieces (167 and 98), its reply in two (161 and 7).",
        max_ndef=200,
    )
    yield tap.select().exchange(REQUEST, TRANSACTION).end()
    tap = Tap(
        "read-on-a-small-tag",
        "maxNdef 499, as an NHS3152 has: a long record, whose payload length has 4 octets.",
        max_ndef=499,
        state="provisioned",
    )
    yield tap.select().exchange(read_teds(1, 128, 0), TRANSACTION).exchange(read_teds(0, 128, 0), TRANSACTION + 1).end()
    yield _repeated()
    yield _mistakes()


def _repeated() -> dict[str, Any]:
    tap = Tap(
        "repeated",
        "The answer to a whole request was not read: the same message again gets the same octets; nothing is run twice (a Request run twice would give another nonce).",
        max_ndef=4160,
    ).select()
    frame = REQUEST.encode()
    whole = Piece(TRANSACTION, len(frame), 0, frame)
    tap.piece(whole, "Request.", "Its answer.")
    tap.piece(whole, "The same message again.", "The same answer again.")
    tap.piece(
        replace(whole, transaction=TRANSACTION + 1),
        "The same frame under the next transaction is a new request.",
        "Another nonce.",
    )
    return tap.end()


def _mistakes() -> dict[str, Any]:
    tap = Tap("mistakes", "What a node answers to messages out of place.", max_ndef=4160)
    frame = IDENTIFY.encode()
    good = Piece(TRANSACTION, len(frame), 0, frame).encode()
    wrapped = message.encode([tnep.payload_record(good)])
    tap.write(wrapped, "A payload record before the service is selected.", "Te 01, protocol error.")
    tap.write(
        message.encode([tnep.select(b"urn:nfc:sn:handover")]),
        "Selects a service that the node does not have.",
        "The initial message.",
    )
    tap.select()
    torn = good[:8] + bytes([good[8] ^ 1]) + good[9:]
    tap.write(
        message.encode([tnep.payload_record(torn)]),
        "A payload record whose CRC-32 is wrong.",
        "Te 80: the request was garbled; write it again.",
    )
    tap.write(wrapped, "The same, right.", "Te 00 and the answer.")
    return tap.end()


# -- CAN ---------------------------------------------------------------------------------------------------------------


class Wire:
    """A bus in memory: each frame that is sent is noted and given to every listener."""

    def __init__(self) -> None:
        self.steps: list[dict[str, Any]] = []
        self.waiting: list[tuple[str, Frame]] = []

    def sender(self, who: str) -> Callable[[Frame], None]:
        """Return what ``who`` sends with."""
        return lambda frame: self.send(who, frame)

    def send(self, who: str, frame: Frame, note: str = "") -> None:
        """Put one frame on the bus."""
        self.steps.append(
            {
                "by": who,
                "note": note or named(frame.data),
                "id": f"{frame.identifier:08x}",
                "data": frame.data.hex(),
                "fd": frame.fd,
            }
        )
        self.waiting.append((who, frame))

    def next(self) -> tuple[str, Frame] | None:
        """Return the oldest frame that was not given out yet."""
        return self.waiting.pop(0) if self.waiting else None


def named(data: bytes) -> str:
    """Return what an ISO-TP frame is."""
    names = {0: "single frame", 1: "first frame", 2: "consecutive frame", 3: "flow control"}
    kind = data[0] >> 4
    number = f" {data[0] & 0xF}" if kind == 2 else ""
    return names[kind] + number


def _transfer(name: str, note: str, command: Command, *, state: str = "factory", fd: bool = False) -> dict[str, Any]:
    """Send a whole command and its reply between one pair of addresses."""
    wire, tim = Wire(), node(name, state)
    ends = {
        "station": Pair(STATION_ADDRESS, CAN_ADDRESS, wire.sender("station"), fd=fd),
        "node": Pair(CAN_ADDRESS, STATION_ADDRESS, wire.sender("node"), fd=fd),
    }
    frame, reply = command.encode(), b""
    ends["station"].send(bytes([CAN_TRANSACTION]) + frame)
    received = b""
    for _ in range(2000):
        given = wire.next()
        if given is not None:
            ends["node" if given[0] == "station" else "station"].handle_frame(given[1])
        for end in ends.values():
            end.run()
        body = ends["node"].received()
        if body is not None:
            reply = tim.handle(body[1:], link="can:f1", tapped=True)
            ends["node"].send(body[:1] + reply)
        answer = ends["station"].received()
        if answer is not None:
            received = answer
            break
    assert received == bytes([CAN_TRANSACTION]) + reply
    return {
        "name": name, "note": note, "state": state, "fd": fd, "transaction": CAN_TRANSACTION,
        "station_address": STATION_ADDRESS, "node_address": CAN_ADDRESS,
        "command": frame.hex(), "reply": reply.hex(), "steps": wire.steps,
    }  # fmt: skip


def _functional(name: str, note: str, *, fd: bool = False, twins: bool = False) -> dict[str, Any]:
    """Identify asked of everyone; with ``twins`` two nodes answer under one address."""
    wire, tim = Wire(), node(name)
    gathering = BroadcastReplies(STATION_ADDRESS, CAN_TRANSACTION)
    reply = tim.handle(IDENTIFY.encode(), link="can:f1", tapped=True)
    pairs = [Pair(CAN_ADDRESS, STATION_ADDRESS, wire.sender(who), fd=fd) for who in ("node", "other node")[: 1 + twins]]
    body = bytes([CAN_TRANSACTION]) + IDENTIFY.encode()
    wire.send(
        "station",
        Frame(FUNCTIONAL | STATION_ADDRESS, single(body, fd=fd), fd),
        "functional single frame: transaction and Identify",
    )
    wire.next()
    pairs[0].send(bytes([CAN_TRANSACTION]) + reply)
    if twins:
        other = reply[:4] + bytes(10) + reply[14:]
        pairs[1].send(bytes([CAN_TRANSACTION]) + other)
    for _ in range(2000):
        given = wire.next()
        if given is None:
            break
        who, frame = given
        if who != "station":
            flow = gathering.add_frame(frame)
            if flow is not None:
                wire.send("station", flow)
        else:
            for pair in pairs:
                pair.handle_frame(frame)
        for pair in pairs:
            pair.run()
    return {
        "name": name, "note": note, "state": "factory", "fd": fd, "transaction": CAN_TRANSACTION,
        "station_address": STATION_ADDRESS, "node_address": CAN_ADDRESS, "functional": True,
        "command": IDENTIFY.encode().hex(), "reply": reply.hex(), "conflict": twins, "steps": wire.steps,
    }  # fmt: skip


def can_frames() -> Iterator[dict[str, Any]]:
    """CAN frames of whole exchanges: identifiers (29 bit, hex), data with padding, in the order on the bus.

    "command" and "reply" are the frames inside, without the transaction octet. The node answers a functional request
    after a random wait of up to 50 ms.
    """
    yield _functional(
        "functional-identify",
        "Identify asked of everyone: one functional frame, the answer in first and consecutive frames.",
    )
    yield _functional("functional-identify-fd", "The same, asked and answered in CAN FD: each in one frame.", fd=True)
    yield _functional(
        "two-nodes-under-one-address",
        "Two first frames from one source within one functional Identify: a conflict of addresses; their consecutive frames interleave.",
        twins=True,
    )
    yield _transfer("identify", "Identify asked of one address.", IDENTIFY)
    yield _transfer("prove", "Prove.", security_command(Function.PROVE, bytes(range(32))))
    yield _transfer(
        "request",
        "Request: 266 octets, flow control after every 16 consecutive frames. On a node without NFC in factory state.",
        REQUEST,
    )
    yield _transfer("request-fd", "The same in CAN FD with 64 octets a frame.", REQUEST, fd=True)
    yield _transfer(
        "set-can-address",
        "Set CAN address to 21 on a node without NFC in factory state: the reply leaves from the old address.",
        security_command(Function.SET_CAN_ADDRESS, b"\x21"),
    )
    yield _transfer(
        "refusal", "Close outside a session: the reply fits one single frame.", security_command(Function.CLOSE)
    )


FILES = {"nfc_pieces": nfc_pieces, "can_frames": can_frames}
