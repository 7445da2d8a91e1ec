"""Rules of single CAN frames: addresses, functional requests, ISO-TP as it is written, Announce. Nothing is kept.

The check acts as a base station at an unused address, and sends and receives single frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.links.can.isotp import (
    CONTINUE,
    FUNCTIONAL,
    OVERFLOW,
    WAIT,
    addresses,
    consecutive_frames,
    first_frame,
    gap_seconds,
    padded,
    physical_id,
    read_single,
    single,
)
from teds_provision.links.ports import BusFrame, BusFrames
from teds_provision.protocol.announce import ANNOUNCE, LAST_ADDRESS, Announce, is_announce, uuid_crc
from teds_provision.protocol.messages.firmware import ABOUT
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Command,
    Function,
    Reason,
    decode_reply,
    read_teds,
    security_command,
    write_teds,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.messages.tables import describe_command
from teds_provision.teds.image import SECURITY

_FIRST, _CONSECUTIVE, _FLOW = 1, 2, 3
_QUIET: Final = 0.3
"""Seconds in which a node that answers has answered: a functional Identify waits at most 0.05 s of them."""
_ANSWER: Final = 1.0
_BLOCK: Final = 3
_GAP_MS: Final = 50
_LEAST_SHARE: Final = 0.6
"""Of the gap that was asked for, so much has to be seen: arrivals are dated late, never early."""
_LONG: Final = {False: 60, True: 200}
"""Octets of a request that takes several consecutive frames, in classic CAN and in CAN FD, and fits one block."""
_TRIES: Final = 3
_GREATEST: Final = 0xFFFFFFFF


class _Stranger:
    """A base station that sends each frame of ISO-TP by itself, and so can send what no other sends."""

    def __init__(self, frames: BusFrames, node: int, own: int) -> None:
        self._frames, self.node, self.own, self.fd = frames, node, own, frames.fd
        self._transaction = 0

    def transaction(self) -> int:
        """Return a fresh transaction number."""
        self._transaction = self._transaction % 255 + 1
        return self._transaction

    def send(self, data: bytes, *, node: int | None = None) -> None:
        """Send one frame to the node, or to another address."""
        self._frames.send(physical_id(node or self.node, self.own), padded(data, fd=self.fd), fd=self.fd)

    def send_functional(self, data: bytes) -> None:
        """Send one functional frame."""
        self._frames.send(FUNCTIONAL | self.own, data, fd=self.fd)

    def flow(self, status: int, block: int = 0, gap: int = 0) -> None:
        """Send a flow control frame."""
        self.send(bytes([status, block, gap]))

    def next(self, seconds: float, kind: int | None = None) -> BusFrame | None:
        """Return the next frame to this station, of this kind if given; None after ``seconds``."""
        until = time.monotonic() + seconds
        while (frame := self._frames.next(max(0.0, until - time.monotonic()))) is not None:
            ends = addresses(frame.identifier)
            mine = ends is not None and ends[0] == self.own and bool(frame.octets)
            if mine and kind in (None, frame.octets[0] >> 4):
                return frame
        return None

    def began(self, body: bytes) -> tuple[int, float]:
        """Send the first frame of a long request; block size and gap (s) of the node's flow control."""
        self.send(first_frame(body, fd=self.fd)[0])
        return self._asked()

    def _asked(self) -> tuple[int, float]:
        for _ in range(10):
            control = self.next(_ANSWER, _FLOW)
            if control is None or len(control.octets) < 3:
                raise RuleBrokenError("The first frame of a long request got no flow control.")
            if control.octets[0] != WAIT:
                return control.octets[1], gap_seconds(control.octets[2])
        raise RuleBrokenError("The first frame of a long request got ten flow controls with Wait.")

    def request(self, body: bytes, bend: Callable[[int, bytes], bytes] = lambda _, data: data) -> None:
        """Send a request, up to where the node asks for no more.

        ``bend`` changes a consecutive frame, counted from 1.
        """
        if len(body) <= (62 if self.fd else 7):
            self.send(single(body, fd=self.fd))
            return
        block, gap = self.began(body)
        rest = list(consecutive_frames(first_frame(body, fd=self.fd)[1], fd=self.fd))
        for number, data in enumerate(rest, 1):
            self.send(bend(number, data))
            time.sleep(gap)
            if block and number % block == 0 and number < len(rest) and self.next(_QUIET, _FLOW) is None:
                return

    def reply(self, seconds: float = _ANSWER) -> bytes | None:
        """Return a whole reply, transaction first; None if none begins."""
        frame = self.next(seconds)
        if frame is None or frame.octets[0] >> 4 not in (0, _FIRST):
            return None
        return read_single(frame.octets) or self.rest_of(frame)

    def rest_of(self, first: BusFrame) -> bytes:
        """Have the rest of a reply sent at once; raises RuleBrokenError if it is torn."""
        length, octets = (first.octets[0] & 0xF) << 8 | first.octets[1], first.octets[2:]
        self.flow(CONTINUE)
        while len(octets) < length:
            frame = self.next(_ANSWER, _CONSECUTIVE)
            holds(frame is not None, f"A reply of {length} octets ended after {len(octets)}.")
            assert frame is not None
            octets += frame.octets[1:]
        return octets[:length]

    def end(self) -> None:
        """Have a reply that has begun end here."""
        self.flow(OVERFLOW)


def _thrice(one: Callable[[], str]) -> str:
    """Try what a lost frame, or a busy host, would spoil as well: broken is what is broken each time."""
    for left in reversed(range(_TRIES)):
        try:
            return one()
        except RuleBrokenError:
            if not left:
                raise
    raise AssertionError


@contextmanager
def _stranger(probe: Probe) -> Iterator[_Stranger]:
    """Connect a third base station beside those of the other rules; raises NotApplicableError if there is no bus."""
    link, own = probe.framed, probe.free_source(3)
    assert probe.contact.address is not None
    with link.single_frames() as frames:
        yield _Stranger(frames, probe.contact.address, own)


def _body(transaction: int, command: Command, octets: int = 0) -> bytes:
    return bytes([transaction]) + command.encode().ljust(octets, b"\0")


def _long_write(fd: bool) -> Command:
    """Return a Write that is longer than one frame; outside a session it is refused with 3."""
    return write_teds(0, 12, 0, bytes(_LONG[fd] - 12))


@rule("can-other-address", "CAN", Stage.PLAIN)
def can_other_address(probe: Probe) -> str:
    """Check that the node does not answer a frame for another address."""
    with _stranger(probe) as stranger:
        home = stranger.node
        tried = (home % LAST_ADDRESS + 1, (home - 1 ^ 0x40) % LAST_ADDRESS + 1, (home - 1 ^ 0x80) % LAST_ADDRESS + 1)
        for address in tried:
            body = _body(stranger.transaction(), IDENTIFY)
            stranger.send(single(body, fd=stranger.fd), node=address)
            frame = stranger.next(_QUIET)
            if frame is None:
                continue
            source = frame.identifier & 0xFF
            stranger.node = source  # which the flow control goes to
            came = read_single(frame.octets) or stranger.rest_of(frame)
            reply = decode_reply(came[1:])
            other = reply.ok and Identity.decode(reply.payload).uuid != probe.uuid
            text = f"Identify (128.7) to CAN address {address}: the node at {home} answers, from address {source}."
            holds(other and source == address, text)
    return f"silent when {', '.join(map(str, tried))} are asked"


@rule("can-functional", "CAN", Stage.PLAIN)
def can_functional(probe: Probe) -> str:
    """Check that only Identify is answered when broadcast: other commands get no reply, not even a refusal."""
    asked = (security_command(Function.LIST), ABOUT, security_command(Function.OPEN), security_command(Function.CLOSE))
    with _stranger(probe) as stranger:
        for command in asked:
            stranger.send_functional(single(_body(stranger.transaction(), command), fd=stranger.fd))
        frame = stranger.next(_QUIET)
        if frame is not None:
            stranger.end()
            while stranger.next(_QUIET) is not None:  # the replies to the other commands
                stranger.end()
            number = (frame.octets[1] if frame.octets[0] >> 4 == 0 else frame.octets[2]) - 1
            command = asked[number] if number < len(asked) else asked[0]
            raise RuleBrokenError(
                f"{describe_command(command)}, functional: {frame.octets.hex()} came; only Identify is answered."
            )
    return "List, Open and Close of everyone get no reply"


@rule("can-lengths", "CAN", Stage.PLAIN)
def can_lengths(probe: Probe) -> str:
    """Check that frames of lengths that ISO 15765-2 does not allow are ignored: no flow control, no reply.

    A first frame of what one frame would hold (FF_DLmin), and a classic single frame with the length of CAN FD.
    """
    with _stranger(probe) as stranger:
        body = _body(stranger.transaction(), IDENTIFY)
        wrong = {
            "a first frame of 7 octets": b"\x10\x07" + body[:6],
            "a classic single frame with its length in the second octet": b"\x00\x06" + body[:6],
        }
        for what, data in wrong.items():
            stranger.send(data)
            frame = stranger.next(_QUIET)
            holds(frame is None, f"{what}: {frame.octets.hex() if frame else ''} came; it is to be ignored.")
    return f"ignored: {', '.join(wrong)}"


@rule("can-sequence", "CAN", Stage.PLAIN)
def can_sequence(probe: Probe) -> str:
    """Check that a consecutive frame out of sequence ends the message (ISO 15765-2): it is not run and not answered."""
    return _thrice(lambda: _torn_request(probe))


def _torn_request(probe: Probe) -> str:
    with _stranger(probe) as stranger:
        torn, whole = stranger.transaction(), stranger.transaction()
        write = _long_write(stranger.fd)

        def other_number(number: int, data: bytes) -> bytes:
            return bytes([data[0] ^ 0x8]) + data[1:] if number == 2 else data

        stranger.request(_body(torn, write), other_number)
        text = (
            f"{describe_command(write)}, outside a session, its second consecutive frame numbered 10 in place of 2: "
            f"a reply came; a frame is missing, and the message ends."
        )
        holds(stranger.next(_QUIET) is None, text)
        stranger.request(_body(whole, IDENTIFY))
        reply = stranger.reply()
        right = reply is not None and reply[0] == whole
        holds(right, "Identify (128.7) after a request out of sequence: no reply.")
    return "a request out of sequence gets no reply, the next one does"


@rule("can-flow-obeyed", "CAN", Stage.PLAIN)
def can_flow_obeyed(probe: Probe) -> str:
    """Check that the node obeys flow control: it waits on WAIT, and keeps to block size and gap."""
    due = probe.teds(SECURITY)
    return _thrice(lambda: _reply_in_blocks(probe, due))


def _reply_in_blocks(probe: Probe, due: bytes) -> str:
    with _stranger(probe) as stranger:
        transaction = stranger.transaction()
        stranger.request(_body(transaction, read_teds(*SECURITY, 0)))
        first = stranger.next(_ANSWER, _FIRST)
        if first is None:
            raise RuleBrokenError("Read (1.2) of the Security TEDS: no first frame of a reply.")
        stranger.flow(WAIT)
        early = stranger.next(_QUIET)
        _obeyed(stranger, early is None, "A frame of the reply came after a flow control with Wait.")
        stranger.flow(CONTINUE, _BLOCK, _GAP_MS)
        came = [frame for _ in range(_BLOCK) if (frame := stranger.next(_ANSWER, _CONSECUTIVE)) is not None]
        _obeyed(
            stranger,
            len(came) == _BLOCK,
            f"Block size {_BLOCK} was asked for, {len(came)} frames came. A WAIT before it may have ended the reply.",
        )
        took = came[-1].at - came[0].at
        asked = (_BLOCK - 1) * _GAP_MS / 1000
        _obeyed(
            stranger,
            took >= _LEAST_SHARE * asked,
            f"STmin {_GAP_MS} ms was asked for: {_BLOCK} frames took {took * 1000:.0f} ms, {asked * 1000:.0f} are due.",
        )
        beyond = stranger.next(_QUIET, _CONSECUTIVE)
        _obeyed(
            stranger, beyond is None, f"Block size {_BLOCK} was asked for; more frames came without a flow control."
        )
        held = b"".join(frame.octets[1:] for frame in came)
        whole = stranger.rest_of(first._replace(octets=first.octets + held))
        text = "Read (1.2) of the Security TEDS, in blocks: another reply came than in one piece."
        holds(whole[0] == transaction and whole[8:] == due[: len(whole) - 8], text)
    return f"waits; blocks of {_BLOCK}, {took * 1000 / (_BLOCK - 1):.0f} ms between frames at STmin {_GAP_MS}"


def _obeyed(stranger: _Stranger, right: bool, text: str) -> None:
    """Raise RuleBrokenError with this text if it is not right, and leave no reply half sent."""
    if not right:
        stranger.end()
        raise RuleBrokenError(text)


def _require_lesser(own: int) -> None:
    """Raise NotApplicableError if this CRC-32 is the greatest: the node would take the claim for its own Announce."""
    if own == _GREATEST:
        raise NotApplicableError("The CRC-32 of this UUID is the greatest: no other claim loses against it.")


@rule("can-announce", "CAN", Stage.PLAIN)
def can_announce(probe: Probe) -> str:
    """Check that the node keeps its address after an Announce with a greater CRC, and repeats its own Announce."""
    own, state = uuid_crc(probe.uuid), probe.identity().state
    _require_lesser(own)
    link = probe.framed
    assert probe.contact.address is not None
    home = probe.contact.address
    with link.single_frames() as frames:
        for _ in range(_TRIES):
            frames.send(ANNOUNCE | home, Announce(home, state, _GREATEST).encode())
            frame = _announced(frames, home, own)
            if frame is not None:
                break
    what = f"An Announce of CRC {_GREATEST:08x} from the node's own CAN address {home}"
    holds(frame is not None, f"{what}: the node announced nothing within {_ANSWER:g} s, {_TRIES} times.")
    assert frame is not None
    address = frame.identifier & 0xFF
    if address != home:
        probe.move(address)
        probe.session = None
        raise RuleBrokenError(f"{what}: the node moved to {address}. Its CRC {own:08x} is smaller, so it stays.")
    right = Announce(home, state, own).encode()
    same = frame.octets[:6] == right[:6] and len(frame.octets) == len(right)  # octets after the CRC are optional
    holds(same, f"{what}: it announces {frame.octets.hex()}; {right.hex()} is due.")
    return f"announces CRC {own:08x}, {state.name.lower()}"


@rule("can-pressed", "CAN", Stage.PLAIN)
def can_pressed(probe: Probe) -> str:
    """Check that an Announce of a pressed button claims nothing: the node neither moves nor announces."""
    link, own, home = probe.framed, uuid_crc(probe.uuid), probe.contact.address
    assert home is not None
    _require_lesser(own)
    if probe.plain(ABOUT).reason == Reason.UNKNOWN_COMMAND:
        raise NotApplicableError("The node is from before pressed buttons were announced (128.21 gets 1).")
    with link.single_frames() as frames:
        frames.send(ANNOUNCE | home, Announce(home, NodeState.FACTORY, _GREATEST, pressed=True).encode())
        frame = _announced(frames, home, own)
    what = f"An Announce of a pressed button from the node's own CAN address {home}"
    holds(frame is None, f"{what}: the node takes it for a claim, and announces.")
    return "neither moves nor announces"


def _announced(frames: BusFrames, home: int, own: int) -> BusFrame | None:
    """Return the Announce from the node's address, or of its CRC from another address; None if there is none."""
    until = time.monotonic() + _ANSWER
    while (frame := frames.next(max(0.0, until - time.monotonic()))) is not None:
        mine = frame.identifier & 0xFF == home or own.to_bytes(4, "big") in frame.octets
        if is_announce(frame.identifier) and mine:
            return frame
    return None
