"""Rules of Open, Sealed and Close. They need a link key, and change nothing that lasts."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Final

from teds_provision.check.plain_rules import absent
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.check.slips import Slip
from teds_provision.errors import LinkError
from teds_provision.links.ports import MultiStationLink
from teds_provision.protocol.announce import LAST_ADDRESS
from teds_provision.protocol.keys import CHALLENGE_OCTETS, POINT_OCTETS, SoftwareKey
from teds_provision.protocol.messages.frames import (
    COMMON,
    IDENTIFY,
    SECURITY_CLASS,
    Command,
    Function,
    Reason,
    decode_reply,
    read_teds,
    security_command,
    write_teds,
)
from teds_provision.protocol.messages.tables import describe_command, describe_reply
from teds_provision.protocol.session import (
    BLOCK_OCTETS,
    LAST_COUNTER,
    OPEN_OCTETS,
    TAG_OCTETS,
    StationSession,
    open_mac,
)
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.teds.image import SECURITY as SECURITY_TEDS

REPLY_HEADER: Final = 3


def _open(payload: bytes) -> Command:
    return security_command(Function.OPEN, payload)


@rule("open-beside", "Sessions", Stage.SESSION)
def open_beside(probe: Probe) -> str:
    """Check that a new Open leaves the session alone until a good frame comes under it; then the old one is over."""
    old = probe.open()
    probe.sealed_good(IDENTIFY)
    new = probe.open()
    good = probe.plain(old.seal(IDENTIFY))
    holds(good.ok, f"Sealed (128.4) in a session beside a half-open Open: success is due, {describe_reply(good)} came.")
    old.unseal(good.payload)
    probe.session = new
    probe.sealed_good(IDENTIFY)
    return demand(probe.plain(old.seal(IDENTIFY)), Reason.BAD_TAG, "Sealed (128.4) in the session that was replaced")


@rule("open-replaced", "Sessions", Stage.SESSION)
def open_replaced(probe: Probe) -> str:
    """Check that a new Open replaces the half-open one: a frame sealed under that one gets 12."""
    old, new = probe.open(), probe.open()
    seen = demand(probe.plain(old.seal(IDENTIFY)), Reason.BAD_TAG, "Sealed (128.4) under an Open that was replaced")
    probe.session = new
    probe.sealed_good(IDENTIFY)
    return seen


@rule("open-checks", "Sessions", Stage.SESSION)
def open_checks(probe: Probe) -> str:
    """Check Open's refusals (length 4, keyId 16, mac 12, in this order, over all octets); none of them uses c up."""
    _opens(probe)
    key, before = probe.link_key, probe.opening_counter()
    point = SoftwareKey.generate().point
    probe.refused(_open(bytes(OPEN_OCTETS - 1)), Reason.BAD_FORM)
    probe.refused(_open(bytes(OPEN_OCTETS)), Reason.UNKNOWN_KEY, "a keyId of zeros")
    probe.refused(
        _open(key_id(key)[:4] + bytes(4) + point + bytes(16)), Reason.UNKNOWN_KEY, "a keyId of which 4 octets are right"
    )
    probe.refused(_open(key_id(key) + point + os.urandom(16)), Reason.BAD_TAG, "a wrong mac")
    mac = open_mac(key, probe.uuid, before, point)
    for at in (0, 7, 8, TAG_OCTETS - 1):
        almost = mac[:at] + bytes([mac[at] ^ 1]) + mac[at + 1 :]
        probe.refused(_open(key_id(key) + point + almost), Reason.BAD_TAG, f"a mac whose octet {at} alone is wrong")
    seen = probe.refused(_open(key_id(key) + bytes(65) + bytes(16)), Reason.BAD_TAG, "a wrong mac over a wrong point")
    holds(probe.opening_counter() == before, "A refused Open changed c.")
    return seen


def _opens(probe: Probe) -> None:
    """Raise NotApplicableError if the node refuses every good Open."""
    if probe.no_session:
        raise NotApplicableError(f"Needs a session, and none opens: {probe.no_session}")


def _half_open(probe: Probe) -> Command:
    """Return a good Open; raises NotApplicableError if the node refuses them."""
    _opens(probe)
    return StationSession(probe.link_key, probe.uuid).open(probe.opening_counter())


@rule("open-once", "Sessions", Stage.SESSION)
def open_once(probe: Probe) -> str:
    """Check that a mac is good once: c grows by 1, and the same Open again gets 12."""
    counter, command = probe.opening_counter(), _half_open(probe)
    probe.good(command)
    grown = (int.from_bytes(counter, "big") + 1) % (1 << 64)
    now = probe.opening_counter()
    little = (int.from_bytes(counter, "little") + 1) % (1 << 64)
    if now != grown.to_bytes(8, "big"):
        slip = Slip("counter-little-endian", "c is counted as a little-endian number")
        fits = now == little.to_bytes(8, "little")
        raise RuleBrokenError(
            f"c went from {counter.hex()} to {now.hex()} with a good mac; + 1 is due.", slip if fits else None
        )
    return demand(probe.plain(command), Reason.BAD_TAG, "Open (128.3) a second time")


@rule("open-point", "Sessions", Stage.SESSION)
def open_point(probe: Probe) -> str:
    """Check that a good mac over a point off the curve, or over a static key, gets 15 and uses c up."""
    _opens(probe)
    points = {"Es off the curve": b"\x04" + bytes(64), "Es the node's own point": probe.node_key}
    if probe.okm and probe.credentials is not None:  # if another station agreed on the key, its point is unknown here
        points["Es equal to P(station)"] = probe.credentials.key.point
    for why, point in points.items():
        before = probe.opening_counter()
        mac = open_mac(probe.link_key, probe.uuid, before, point)
        seen = probe.refused(_open(key_id(probe.link_key) + point + mac), Reason.BAD_POINT, why)
        holds(probe.opening_counter() != before, f"Open (128.3), {why}: its mac was good, and c did not grow.")
    return seen


@rule("open-one-time", "Sessions", Stage.SESSION)
def open_one_time(probe: Probe) -> str:
    """Check that the node's one-time key serves one Open."""
    seen = []
    for _ in range(2):
        seen.append(probe.good(_half_open(probe))[:POINT_OCTETS])
    holds(seen[0] != seen[1], "Open (128.3): two Opens were answered with the same one-time key En.")
    holds(probe.node_key not in seen, "Open (128.3): En is the node's identity key; a one-time key is due.")
    return "two Opens, two one-time keys"


@rule("sealed-last-counter", "Sessions", Stage.SESSION)
def sealed_last_counter(probe: Probe) -> str:
    """Check that counter 2^32 - 1 is served, and ends the session."""
    session = probe.open()
    session.unseal(probe.good(session.seal(IDENTIFY, counter=LAST_COUNTER)).ljust(36, b"\0"))
    probe.session = None
    return demand(probe.plain(session.seal(IDENTIFY, counter=LAST_COUNTER)), Reason.WRONG_STATE, "Sealed after it")


@rule("sealed-counter", "Sessions", Stage.SESSION)
def sealed_counter(probe: Probe) -> str:
    """Check that gaps are accepted; a used counter, a lower one and 0 get 13; the session remains open."""
    session = probe.open()
    last = session.seal(IDENTIFY, counter=9)
    session.unseal(probe.good(last).ljust(36, b"\0"))
    demand(probe.plain(last), Reason.REPLAY, "Sealed (128.4), the same frame a second time")
    for counter in (8, 0):
        demand(
            probe.plain(session.seal(IDENTIFY, counter=counter)), Reason.REPLAY, f"Sealed (128.4), counter {counter}"
        )
    demand(probe.plain(session.seal(security_command(Function.LIST), counter=9)), Reason.REPLAY, "Sealed, 9 again")
    probe.sealed_good(IDENTIFY)
    first = probe.open().seal(IDENTIFY, counter=0)
    demand(probe.plain(first), Reason.REPLAY, "Sealed (128.4), counter 0 as the first of a session")
    probe.sealed_good(IDENTIFY)
    return "13 for the same frame, for 8, 0, and for another command under 9"


@rule("sealed-tag", "Sessions", Stage.SESSION)
def sealed_tag(probe: Probe) -> str:
    """Check that a short frame gets 4, a wrong tag 12, and that a bad frame ends nothing."""
    session = probe.open()
    probe.sealed_good(IDENTIFY)
    probe.refused(security_command(Function.SEALED, bytes(35)), Reason.BAD_FORM)
    good = session.seal(IDENTIFY)
    for at in (-TAG_OCTETS, -1):
        bad = bytearray(good.payload)
        bad[at] ^= 1
        seen = probe.refused(
            security_command(Function.SEALED, bytes(bad)), Reason.BAD_TAG, f"octet {at + TAG_OCTETS} of the tag wrong"
        )
    session.unseal(probe.good(good))
    return seen


@rule("sealed-padding", "Sessions", Stage.SESSION)
def sealed_padding(probe: Probe) -> str:
    """Check that a frame with a good tag and bad PKCS #7 padding gets 12 and ends nothing."""
    session, frame = probe.open(), IDENTIFY.encode()
    probe.sealed_good(IDENTIFY)
    room = 16 - len(frame)
    for padding in (bytes(room), b"\0" * (room - 1) + bytes([room]), bytes([17]) * room):
        seen = demand(probe.plain(session.seal_padded(frame + padding)), Reason.BAD_TAG, f"padding {padding.hex()}")
    probe.sealed_good(IDENTIFY)
    return seen


@rule("sealed-residues", "Sessions", Stage.SESSION)
def sealed_residues(probe: Probe) -> str:
    """Check that a sealed reply is padded right for every length: inner replies of all 16 residues of the block."""
    whole = probe.teds(SECURITY_TEDS)
    for octets in range(BLOCK_OCTETS):
        came = probe.sealed_good(read_teds(*SECURITY_TEDS, len(whole) - octets))
        due = (len(whole) - octets).to_bytes(4, "big") + whole[len(whole) - octets :]
        inner = REPLY_HEADER + len(due)
        holds(
            came == due, f"Read (1.2), sealed, an inner reply of {inner} octets: {came.hex()} came, {due.hex()} is due."
        )
    return "inner replies of 16 lengths, padding and content right"


@rule("sealed-command-residues", "Sessions", Stage.SESSION)
def sealed_command_residues(probe: Probe) -> str:
    """Check that a sealed command is accepted for every length: inner commands of all 16 residues of the block."""
    block = absent(probe)
    for octets in range(BLOCK_OCTETS):
        probe.sealed_good(write_teds(*block, 0, bytes(octets)))
    probe.close()
    return "inner commands of 16 lengths"


@rule("sealed-only-sealed", "Which command when", Stage.SESSION)
def sealed_only_sealed(probe: Probe) -> str:
    """Open and Sealed inside a session get 3; unknown functions 1."""
    for function in (Function.OPEN, Function.SEALED):
        probe.sealed_refused(security_command(function), Reason.NOT_PERMITTED)
    probe.sealed_refused(Command(0, SECURITY_CLASS, 99), Reason.UNKNOWN_COMMAND)
    return probe.sealed_refused(Command(0, COMMON, 99), Reason.UNKNOWN_COMMAND)


# -- several stations --------------------------------------------------------------------------------------------------


@rule("two-sessions", "Sessions", Stage.SESSION)
def two_sessions(probe: Probe) -> str:
    """Check that a node has room for two sessions, one for each link, with separate counters."""
    other = probe.from_station(1)
    for _ in range(2):
        probe.sealed_good(IDENTIFY)
        other.sealed_good(IDENTIFY)
    other.close()
    seen = probe.sealed_good(IDENTIFY)
    probe.close()
    return f"two stations in turn, then the first alone ({len(seen)} octets)"


@rule("stranger-ends-nothing", "Repetition", Stage.SESSION)
def stranger_ends_nothing(probe: Probe) -> str:
    """Check that plain requests of a third station end no session of the two others: it has a separate stored reply."""
    other, stranger = probe.from_station(1), probe.from_station(2)
    probe.sealed_good(IDENTIFY)
    other.sealed_good(IDENTIFY)
    asked = (IDENTIFY, security_command(Function.LIST), security_command(Function.PROVE, os.urandom(CHALLENGE_OCTETS)))
    for command in asked:
        stranger.good(command)
        for station in (probe, other):
            assert station.session is not None
            came = station.plain(station.session.seal(IDENTIFY))
            text = (
                f"{describe_command(command)}, plain, from a third station: after it a sealed reply is due, "
                f"{describe_reply(came)} came."
            )
            holds(came.ok, text)
            station.session.unseal(came.payload)
    other.close()
    probe.close()
    return "Identify, List and Prove of a third station; both sessions go on"


@rule("session-bound", "Sessions", Stage.SESSION)
def session_bound(probe: Probe) -> str:
    """Check that a session, and a half-open Open, belong to one pair of addresses: from another one Sealed gets 2."""
    other = probe.from_station(1)
    for what in ("of a half-open Open", "of a session"):
        if what == "of a half-open Open":
            probe.open()
        assert probe.session is not None
        sealed = probe.session.seal(IDENTIFY)
        seen = demand(other.plain(sealed), Reason.WRONG_STATE, f"Sealed (128.4) {what}, from another station's address")
        probe.session.unseal(probe.good(sealed).ljust(36, b"\0"))
    probe.close()
    return seen


# -- repetition --------------------------------------------------------------------------------------------------------


class _RepeatedIdentify:
    """A sealed Identify whose reply the node is to keep."""

    def __init__(self, probe: Probe) -> None:
        self._probe, self._line = probe, probe.resending
        self._frame = probe.open().seal(IDENTIFY).encode()
        self._words = f"{describe_command(IDENTIFY)}, for repeating"
        self.first = self._noted(probe.line.exchange, "")

    def _noted(self, send: Callable[[bytes], bytes], more: str) -> bytes:
        contact, words = self._probe.contact, self._words + more
        contact.note("out", self._frame, words, sealed=True, opened=IDENTIFY.encode())
        reply = send(self._frame)
        contact.note("in", reply, f"reply to {words}", sealed=True)
        return reply

    def again(self, after: str = "") -> None:
        """Raise RuleBrokenError unless the stored reply comes."""
        second = self._noted(self._line.resend, ", again")
        came = describe_reply(decode_reply(second))
        text = f"Sealed (128.4) repeated{after}: the stored reply is due, {came} came."
        holds(second == self.first, text)


@rule("repetition", "Repetition", Stage.SESSION)
def repetition(probe: Probe) -> str:
    """Check that a request with the same octets and transaction gets the stored reply and is not run again."""
    sent = _RepeatedIdentify(probe)
    sent.again()
    sent.again()
    return f"the stored {len(sent.first)} octets, twice"


@rule("repetition-open", "Repetition", Stage.SESSION)
def repetition_open(probe: Probe) -> str:
    """Check that a repeated Open gets the stored reply: it runs once, c grows by 1, and the session opens."""
    _opens(probe)
    line, counter = probe.resending, probe.opening_counter()
    session = StationSession(probe.link_key, probe.uuid)
    frame = session.open(counter).encode()
    first = probe.octets(frame, "Open (128.3), for repeating")
    again = decode_reply(line.resend(frame))
    holds(again == first, f"Open (128.3) repeated: the stored reply is due, {describe_reply(again)} came.")
    session.accept(first.payload)
    probe.session = session
    probe.sealed_good(IDENTIFY)
    probe.close()
    return "the stored reply, and a session under it"


@rule("repetition-everyone", "Repetition", Stage.SESSION)
def repetition_everyone(probe: Probe) -> str:
    """Check that a functional Identify neither uses nor replaces the stored reply, and ends no session."""
    bus, sent = probe.bus, _RepeatedIdentify(probe)
    holds(bool(bus.identify_functional()), "Identify (128.7), functional: no reply.")
    sent.again(" after a functional Identify")
    probe.sealed_good(IDENTIFY)
    return "the stored reply, after a functional Identify"


@rule("repetition-two", "Repetition", Stage.SESSION)
def repetition_two(probe: Probe) -> str:
    """Check that the node has room for the stored replies of two links."""
    other = probe.from_station(1)
    first, second = _RepeatedIdentify(probe), _RepeatedIdentify(other)
    first.again(" after another station's request")
    second.again()
    other.close()
    return "the stored replies of two stations"


# -- the CAN address ---------------------------------------------------------------------------------------------------

_ADDRESS_SECONDS: Final = 10.0


def _set_address(address: int) -> Command:
    return security_command(Function.SET_CAN_ADDRESS, bytes([address]))


@rule("address-moves", "Command frames", Stage.SESSION)
def address_moves(probe: Probe) -> str:
    """Check that Set CAN address is answered from the old address and applies at once; a second within 10 s gets 17.

    Setting the present address writes nothing and is not limited; 4 is checked before 17.
    """
    home = probe.identity().can_address
    if not home:
        raise NotApplicableError("The board has no CAN, and so no address to move.")
    probe.sealed_good(_set_address(home))
    target = _free_address(probe, home)
    probe.home_address = home
    session = _moved(probe, home, target)
    now = probe.identity().can_address
    holds(now == target, f"After Set CAN address {target} Identify says {now}.")
    if isinstance(probe.contact.link, MultiStationLink):  # with another address pair, this is another link
        came = probe.plain(session.seal(IDENTIFY))
        probe.session = None
        demand(came, Reason.WRONG_STATE, "Sealed (128.4) in the session of the old address, sent to the new one")
    again = probe.sealed(_set_address(home))
    if again.ok:
        probe.move(home)
        probe.session = None
    demand(again, Reason.BUSY, "Set CAN address (128.10), sealed, a second write within 10 s")
    probe.sealed_refused(_set_address(0), Reason.BAD_FORM, "address 0 within 10 s")
    probe.sealed_good(_set_address(target))
    if isinstance(probe.contact.link, MultiStationLink):
        there = probe.contact.link.identify_at(home)
        holds(there is None, f"After Set CAN address a node still answers at {home}.")
    return f"from {home} to {target}; 17 for another one within 10 s"


def _free_address(probe: Probe, home: int) -> int:
    link = probe.contact.link
    for step in range(1, LAST_ADDRESS):
        address = (home - 1 + 53 * step) % LAST_ADDRESS + 1
        if not isinstance(link, MultiStationLink) or link.identify_at(address) is None:
            return address
    raise NotApplicableError("Every CAN address is in use here: disconnect other boards.")


def _moved(probe: Probe, home: int, target: int) -> StationSession:
    """Set the address, and address the node there from now on; return the session that did it."""
    session = probe.session or probe.open()
    try:
        reply = probe.sealed(_set_address(target))
        if reply.reason == Reason.BUSY:  # another station set the address just before this run
            probe.pause(_ADDRESS_SECONDS)
            reply = probe.sealed(_set_address(target))
    except (RuleBrokenError, LinkError):
        if not isinstance(probe.contact.link, MultiStationLink):
            raise
        there = probe.contact.link.identify_at(target)
        if there is None or there.uuid != probe.uuid:
            raise
        probe.session = None
        probe.move(target)
        slip = Slip(
            "address-before-reply",
            "the node takes its new address before the whole reply has left from the old one",
        )
        text = f"Set CAN address (128.10) {target}: the node is there now, and its reply never came from {home}."
        raise RuleBrokenError(text, slip) from None
    holds(reply.ok, f"Set CAN address (128.10) {target}, sealed: success is due, {describe_reply(reply)} came.")
    probe.move(target)
    return session


@rule("address-checks", "Command frames", Stage.SESSION)
def address_checks(probe: Probe) -> str:
    """Set CAN address takes one octet, 1 to 239; anything else gets 4 and changes nothing. Without CAN it gets 1."""
    before = probe.identity()
    if not before.can_address:
        return probe.sealed_refused(_set_address(1), Reason.UNKNOWN_COMMAND, "address 1, of a node without CAN")
    for payload in (b"", b"\0", bytes([240]), b"\x01\x02"):
        seen = probe.sealed_refused(security_command(Function.SET_CAN_ADDRESS, payload), Reason.BAD_FORM, payload.hex())
    holds(probe.identity() == before, "A refused Set CAN address changed Identify.")
    return seen


@rule("close", "Sessions", Stage.SESSION)
def close(probe: Probe) -> str:
    """Close ends the session: what was sealed in it gets 2 afterwards."""
    session = probe.open()
    probe.sealed_good(security_command(Function.CLOSE))
    probe.session = None
    return demand(probe.plain(session.seal(IDENTIFY)), Reason.WRONG_STATE, "Sealed (128.4) after Close")


@rule("address-back", "Command frames", Stage.SESSION)
def address_back(probe: Probe) -> str:
    """Check that another address is accepted 10 s after a write of the address."""
    home = probe.home_address
    if not home or probe.identity().can_address == home:
        raise NotApplicableError("The rule address-moves moved no address.")
    probe.pause(max(0.0, probe.moved_at + _ADDRESS_SECONDS + 0.5 - probe.now()))
    _moved(probe, probe.identity().can_address, home)
    now = probe.identity().can_address
    holds(now == home, f"After Set CAN address {home} Identify says {now}.")
    probe.session, probe.home_address = None, 0
    return f"back at {home}"
