"""Nodes that have their keys and break the rules of what they send, many in one process: a thread for each.

Usage: python -m tests.strangers.troublemaker FILE …, as :mod:`tests.strangers.node`; ``fault`` names one of
:data:`TROUBLES`, "" for none. ``others`` in a file are UUIDs that two of them give themselves.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.strangers.crypto import message
from tests.strangers.node import Node, RefusalError, Session, Stream
from tests.strangers.wire import pieces

SECOND = 10**9
LATER = 15  # messages of a stream until a trouble begins that comes later
Sent = tuple[Session, int, Stream, bytes]


class Troublemaker(Node):
    """One trouble; all else is as the contract has it."""

    def __init__(self, given: dict[str, Any]) -> None:
        super().__init__(given)
        self.others = [bytes.fromhex(other) for other in given.get("others", ())]
        self.sent = 0
        self.stopped_streams: list[tuple[Session, int, Stream, int]] = []
        self.trouble = TROUBLES.get(self.fault)

    def body(self, stream: Stream, instants: int, tick: int | None = None, spread: int | None = None) -> bytes:
        """Flags, tick and values of so many instants of the message that the stream's counter stands at."""
        assert stream.start is not None
        first = stream.start + stream.counter * stream.n * stream.period
        out = b"\0" + ((first if tick is None else tick) % 2**64).to_bytes(8, "big") * bool(stream.kind)
        for i in range(instants):
            for channel in stream.channels:
                out += self.raw(channel, first + i * (stream.period if spread is None else spread))
        return out

    def send_data(self, session: Session, number: int, octets: bytes, stream: Stream) -> None:
        self.sent += 1
        if self.trouble is None:
            self.put(session, number, octets, stream)
        else:
            self.trouble(self, (session, number, stream, octets))

    def put(self, session: Session, number: int, octets: bytes, stream: Stream) -> None:
        super().send_data(session, number, octets, stream)

    def resealed(self, sent: Sent, counter: int, plain: bytes) -> None:
        """Another counter or plaintext under the key of the run."""
        session, number, stream, _ = sent
        self.put(session, number, message(stream.key, counter, plain), stream)

    def stop(self, session: Session, payload: bytes) -> bytes:
        stream = session.streams.get(payload[0]) if payload else None
        out = super().stop(session, payload)
        if stream is not None and self.fault == "goes on after Stop":
            self.stopped_streams.append((session, payload[0], stream, self.tick() + SECOND))
        return out

    def subscribe(self, session: Session, payload: bytes) -> bytes:
        out = super().subscribe(session, payload)
        if self.fault == "data before the reply":
            stream = session.streams[payload[0]]
            for counter in range(3):
                self.put(session, payload[0], message(stream.key, counter, bytes(stream.length - 12)), stream)
        return out

    def clock(self, session: Session, payload: bytes) -> bytes:
        if self.fault == "Clock is refused later" and self.sent > LATER:
            raise RefusalError(22)
        return super().clock(session, payload)

    def hello(self, payload: bytes) -> bytes:
        out = super().hello(payload)
        return out[:1] + self.others[0] + out[11:] if self.fault == "says it is another node" else out

    def loop(self) -> None:
        self.announce()
        while True:
            self.wire.turn(0.01)
            self.pump()
            now = self.tick()
            for session, number, stream, until in self.stopped_streams:
                if now < until:
                    self.due(session, number, stream, now)
            if self.fault == "announces itself as others":
                for uuid in self.others:
                    crc = zlib.crc32(uuid).to_bytes(4, "big")
                    self.wire.put(0x1CFF0000 | self.address, bytes([1, 2]) + crc + bytes(2))


# -- what is done to each message --------------------------------------------------------------------------------------


def longer(node: Troublemaker, sent: Sent) -> None:
    session, number, stream, octets = sent
    node.put(session, number, octets + bytes(8), stream)


def shorter(node: Troublemaker, sent: Sent) -> None:
    session, number, stream, octets = sent
    node.put(session, number, octets[: len(octets) // 2], stream)


def twice_the_instants(node: Troublemaker, sent: Sent) -> None:
    """Sealed as it should be, with a good tag."""
    node.resealed(sent, sent[2].counter, node.body(sent[2], 6 * sent[2].n))


def no_instants(node: Troublemaker, sent: Sent) -> None:
    node.resealed(sent, sent[2].counter, b"\0")


def empty_frames(node: Troublemaker, sent: Sent) -> None:
    session, number, stream, octets = sent
    identifier = 0x1CFF0000 | ((session.station & 7) * 32 + number * 8) << 8 | node.address
    for size in (0, 1, 4):
        node.wire.put(identifier, bytes(size), node.fd)
    node.put(session, number, octets, stream)


def begins_again(node: Troublemaker, sent: Sent) -> None:
    """From the sixteenth message on the counter is 0 again: other values under nonces that were used before."""
    counter = sent[2].counter
    node.resealed(sent, counter if counter < LATER else counter - LATER, node.body(sent[2], sent[2].n))


def stands_still(node: Troublemaker, sent: Sent) -> None:
    node.resealed(sent, min(sent[2].counter, LATER), node.body(sent[2], sent[2].n))


def counts_down(node: Troublemaker, sent: Sent) -> None:
    counter = sent[2].counter
    node.resealed(sent, counter if counter < LATER else max(0, 2 * LATER - counter), node.body(sent[2], sent[2].n))


def leaps(node: Troublemaker, sent: Sent) -> None:
    """Every fifth message has a counter of a thousand messages later."""
    counter = sent[2].counter
    node.resealed(sent, counter + 1000 * (counter % 5 == 4), node.body(sent[2], sent[2].n))


def of_another_stream(node: Troublemaker, sent: Sent) -> None:
    session, number, stream, octets = sent
    node.put(session, (number + 1) % 4, octets, stream)


def to_another_station(node: Troublemaker, sent: Sent) -> None:
    session, number, _, octets = sent
    for segment, data in pieces(octets, node.fd):
        identifier = 0x1CFF0000 | ((session.station % 7 + 1) * 32 + number * 8 + segment) << 8 | node.address
        node.wire.put(identifier, data, node.fd)


def from_another_node(node: Troublemaker, sent: Sent) -> None:
    """Under the address of the node before it, whose stream is heard too."""
    session, number, _, octets = sent
    for segment, data in pieces(octets, node.fd):
        identifier = 0x1CFF0000 | ((session.station & 7) * 32 + number * 8 + segment) << 8 | (node.address - 1)
        node.wire.put(identifier, data, node.fd)


def claims_go(node: Troublemaker, sent: Sent) -> None:
    """Now and then it loses its claims, and says nothing."""
    session, number, stream, octets = sent
    node.put(session, number, octets, stream)
    if stream.counter == LATER:
        node.let_go(session, list(session.claims))


def datasheet_goes(node: Troublemaker, sent: Sent) -> None:
    """Its datasheet is another one under a session that streams, then the claims are gone."""
    session, number, stream, octets = sent
    node.put(session, number, octets, stream)
    if stream.counter == LATER:
        signed = node.teds[0, 128]
        node.teds[0, 128] = signed[:-8] + bytes([signed[-8] ^ 1]) + signed[-7:]
        node.let_go(session, list(session.claims))


def ticks(change: Callable[[int, int], int]) -> Callable[[Troublemaker, Sent], None]:
    """Streams that run free, whose ticks the node writes: ``change`` of tick and counter."""

    def trouble(node: Troublemaker, sent: Sent) -> None:
        session, number, stream, octets = sent
        if not stream.kind:
            node.put(session, number, octets, stream)
            return
        assert stream.start is not None
        tick = stream.start + stream.counter * stream.n * stream.period
        node.resealed(sent, stream.counter, node.body(stream, stream.n, change(tick, stream.counter)))

    return trouble


TROUBLES: dict[str, Callable[[Troublemaker, Sent], None] | None] = {
    "": None,
    "longer": longer,
    "shorter": shorter,
    "twice the instants": twice_the_instants,
    "no instants": no_instants,
    "empty frames": empty_frames,
    "begins again": begins_again,
    "stands still": stands_still,
    "counts down": counts_down,
    "leaps": leaps,
    "of another stream": of_another_stream,
    "to another station": to_another_station,
    "from another node": from_another_node,
    "claims go": claims_go,
    "datasheet goes": datasheet_goes,
    "goes on after Stop": None,
    "data before the reply": None,
    "Clock is refused later": None,
    "says it is another node": None,
    "announces itself as others": None,
    "ticks jump ahead": ticks(lambda tick, counter: tick + 2**31 * (counter % 4 == 3)),
    "ticks jump back": ticks(lambda tick, counter: tick - 2**31 * (counter % 4 == 3)),
    "ticks of 32 bits": ticks(lambda tick, _counter: tick % 2**32 // 8),
    "every second tick is the one before": ticks(lambda tick, counter: tick - 150_000_000 * (counter % 2)),
    "ticks at the end": ticks(lambda _tick, counter: 2**64 - 1 - counter),
}


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    nodes = [Troublemaker(json.loads(Path(name).read_text())) for name in sys.argv[1:]]
    for node in nodes:
        assert node.fault in TROUBLES, node.fault
        threading.Thread(target=node.loop, daemon=True).start()
    print(json.dumps({"ready": True}), flush=True)
    while True:
        time.sleep(60)


if __name__ == "__main__":
    main()
