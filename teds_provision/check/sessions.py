"""Rules of Open, Sealed and Close. They need a link key, and change nothing that lasts."""

from __future__ import annotations

import os

from teds_provision.check.outcome import NotApplicable
from teds_provision.check.probe import Probe, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.links.ports import Repeats
from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.keys import POINT_OCTETS, SoftwareKey
from teds_provision.protocol.messages.frames import (
    COMMON,
    IDENTIFY,
    SECURITY,
    Command,
    Function,
    Reason,
    decode_reply,
    security_command,
)
from teds_provision.protocol.messages.words import named, told
from teds_provision.protocol.session import LAST_COUNTER, OPEN_OCTETS, StationSession, open_mac


def _ask(probe: Probe) -> bytes:
    counter = probe.good(security_command(Function.OPEN))
    holds(len(counter) == 8, f"Open (128.3) without payload: c has {len(counter)} octets, 8 are due.")
    return counter


def _open(payload: bytes) -> Command:
    return security_command(Function.OPEN, payload)


@rule("open-checks", "Sessions", Stage.SESSION)
def open_checks(probe: Probe) -> str:
    """Length, keyId, mac: 4, 16, 12, in this order, and none of them uses c up."""
    key, before = probe.link_key, _ask(probe)
    point = SoftwareKey.generate().point
    probe.refused(_open(bytes(OPEN_OCTETS - 1)), Reason.BAD_FORM)
    probe.refused(_open(bytes(OPEN_OCTETS)), Reason.UNKNOWN_KEY, "a keyId of zeros")
    wrong = key_id(key) + point + os.urandom(16)
    probe.refused(_open(wrong), Reason.BAD_TAG, "a wrong mac")
    seen = probe.refused(_open(key_id(key) + bytes(65) + bytes(16)), Reason.BAD_TAG, "a wrong mac over a wrong point")
    holds(_ask(probe) == before, "A refused Open changed c.")
    return seen


@rule("open-once", "Sessions", Stage.SESSION)
def open_once(probe: Probe) -> str:
    """A mac is good once: c grows by 1, and the same Open again gets 12."""
    counter = _ask(probe)
    command = StationSession(probe.link_key, probe.uuid).open(counter)
    probe.good(command)
    grown = (int.from_bytes(counter, "big") + 1) % (1 << 64)
    holds(_ask(probe) == grown.to_bytes(8, "big"), "c did not grow by 1 with a good mac.")
    return demand(probe.plain(command), Reason.BAD_TAG, "Open (128.3) a second time")


@rule("open-point", "Sessions", Stage.SESSION)
def open_point(probe: Probe) -> str:
    """A good mac over a point off the curve gets 15."""
    point = b"\x04" + bytes(64)
    mac = open_mac(probe.link_key, probe.uuid, _ask(probe), point)
    return probe.refused(_open(key_id(probe.link_key) + point + mac), Reason.BAD_POINT, "Es off the curve")


@rule("open-tag", "Sessions", Stage.SESSION)
def open_tag(probe: Probe) -> str:
    """En is a point, the tag shows that the node holds the key, and a sealed command gets a sealed reply."""
    probe.open()
    inside, outside = probe.sealed_good(IDENTIFY), probe.good(IDENTIFY)
    holds(inside == outside, "Identify says another thing in the session than outside it.")
    return "a good tag; Identify the same inside and outside"


@rule("open-one-time", "Sessions", Stage.SESSION)
def open_one_time(probe: Probe) -> str:
    """A one-time key of the node is for one Open."""
    seen = []
    for _ in range(2):
        session = StationSession(probe.link_key, probe.uuid)
        seen.append(probe.good(session.open(_ask(probe)))[:POINT_OCTETS])
    holds(seen[0] != seen[1], "Open (128.3): two Opens were answered with the same one-time key En.")
    return "two Opens, two one-time keys"


@rule("open-beside", "Sessions", Stage.SESSION)
def open_beside(probe: Probe) -> str:
    """A new Open leaves the session alone until a good frame comes under it; then the old one is over."""
    old = probe.open()
    probe.sealed_good(IDENTIFY)
    new = probe.open()
    good = probe.plain(old.seal(IDENTIFY))
    holds(good.ok, f"Sealed (128.4) in a session beside a half-open Open: success is due, {told(good)} came.")
    old.unseal(good.payload)
    probe.session = new
    probe.sealed_good(IDENTIFY)
    return demand(probe.plain(old.seal(IDENTIFY)), Reason.BAD_TAG, "Sealed (128.4) in the session that was replaced")


@rule("open-replaced", "Sessions", Stage.SESSION)
def open_replaced(probe: Probe) -> str:
    """A new Open replaces the half-open one: what is sealed under that gets 12."""
    old, new = probe.open(), probe.open()
    seen = demand(probe.plain(old.seal(IDENTIFY)), Reason.BAD_TAG, "Sealed (128.4) under an Open that was replaced")
    probe.session = new
    probe.sealed_good(IDENTIFY)
    return seen


@rule("sealed-last-counter", "Sessions", Stage.SESSION)
def sealed_last_counter(probe: Probe) -> str:
    """Counter 2^32 - 1 is served, and ends the session."""
    session = probe.open()
    session.unseal(probe.good(session.seal(IDENTIFY, counter=LAST_COUNTER)).ljust(36, b"\0"))
    probe.session = None
    return demand(probe.plain(session.seal(IDENTIFY, counter=LAST_COUNTER)), Reason.WRONG_STATE, "Sealed after it")


@rule("sealed-counter", "Sessions", Stage.SESSION)
def sealed_counter(probe: Probe) -> str:
    """Gaps are fine; a counter that was used, a lower one and 0 get 13; the session goes on."""
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
    return "13 for the same frame, for 8, 0, and for another command under 9"


@rule("sealed-tag", "Sessions", Stage.SESSION)
def sealed_tag(probe: Probe) -> str:
    """Too short gets 4, a wrong tag 12; a bad frame ends nothing."""
    session = probe.open()
    probe.sealed_good(IDENTIFY)
    probe.refused(security_command(Function.SEALED, bytes(35)), Reason.BAD_FORM)
    good = session.seal(IDENTIFY)
    bad = good.payload[:-1] + bytes([good.payload[-1] ^ 1])
    seen = probe.refused(security_command(Function.SEALED, bad), Reason.BAD_TAG, "one bit of the tag wrong")
    session.unseal(probe.good(good))
    return seen


@rule("sealed-padding", "Sessions", Stage.SESSION)
def sealed_padding(probe: Probe) -> str:
    """A frame whose tag is good and whose PKCS #7 padding is not gets 12; it ends nothing."""
    session, frame = probe.open(), IDENTIFY.encode()
    probe.sealed_good(IDENTIFY)
    room = 16 - len(frame)
    for padding in (bytes(room), b"\0" * (room - 1) + bytes([room]), bytes([17]) * room):
        seen = demand(probe.plain(session.seal_padded(frame + padding)), Reason.BAD_TAG, f"padding {padding.hex()}")
    probe.sealed_good(IDENTIFY)
    return seen


@rule("sealed-only-sealed", "Which command when", Stage.SESSION)
def sealed_only_sealed(probe: Probe) -> str:
    """Open and Sealed inside a session get 3; unknown functions 1."""
    for function in (Function.OPEN, Function.SEALED):
        probe.sealed_refused(security_command(function), Reason.NOT_PERMITTED)
    probe.sealed_refused(Command(0, SECURITY, 99), Reason.UNKNOWN_COMMAND)
    return probe.sealed_refused(Command(0, COMMON, 99), Reason.UNKNOWN_COMMAND)


@rule("address-checks", "Command frames", Stage.SESSION)
def address_checks(probe: Probe) -> str:
    """Set CAN address takes one octet, 1 to 239; anything else gets 4 and changes nothing."""
    before = probe.identity()
    for payload in (b"", b"\0", bytes([240]), b"\x01\x02"):
        seen = probe.sealed_refused(security_command(Function.SET_CAN_ADDRESS, payload), Reason.BAD_FORM, payload.hex())
    holds(probe.identity() == before, "A refused Set CAN address changed Identify.")
    return seen


@rule("repetition", "Repetition", Stage.SESSION)
def repetition(probe: Probe) -> str:
    """A request that is equal octet for octet, transaction and body, gets the stored reply and is not run again."""
    link = probe.contact.link
    if not isinstance(link, Repeats):
        raise NotApplicable("This link cannot send a request again.")
    frame = probe.open().seal(IDENTIFY).encode()
    contact, words = probe.contact, f"{named(IDENTIFY)}, for repeating"
    contact.note("out", frame, words, sealed=True, opened=IDENTIFY.encode())
    first = link.exchange(frame)
    contact.note("in", first, f"reply to {words}", sealed=True)
    for _ in range(2):
        contact.note("out", frame, f"{words}, again", sealed=True, opened=IDENTIFY.encode())
        second = link.again(frame)
        contact.note("in", second, f"reply to {words}, again", sealed=True)
        holds(second == first, f"Sealed (128.4) repeated: the stored reply is due, {told(decode_reply(second))} came.")
    return f"the stored {len(first)} octets, twice"


@rule("close", "Sessions", Stage.SESSION)
def close(probe: Probe) -> str:
    """Close ends the session: what was sealed in it gets 2 afterwards."""
    session = probe.open()
    probe.sealed_good(security_command(Function.CLOSE))
    probe.session = None
    return demand(probe.plain(session.seal(IDENTIFY)), Reason.WRONG_STATE, "Sealed (128.4) after Close")
