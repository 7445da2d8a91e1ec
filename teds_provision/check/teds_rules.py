"""Rules about the TEDS of a node, in any state: List, Query, Read, and the Security TEDS. They change nothing."""

from __future__ import annotations

from itertools import product

from teds_provision.check.outcome import RuleBroken
from teds_provision.check.probe import Probe, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.errors import BadData, Garbled
from teds_provision.protocol.datasheet import can_be_stored, own_values
from teds_provision.protocol.keys import is_point, node_key_message, normalise_signature, verify
from teds_provision.protocol.messages.frames import (
    COMMON,
    Attribute,
    Command,
    Reason,
    TedsFunction,
    TedsStatus,
    query_teds,
    read_teds,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.codec.frame import unframe
from teds_provision.teds.image import SECURITY, BlockId

_TEXTS = frozenset({2, 4, 6, 10, 11, 14, 15})
"""Access codes of text-based TEDS (profile.md, "Command frames")."""
_NEVER: tuple[BlockId, ...] = ((0, 0), (0, 18), (0, 127), (0, 136), (256, 1))


def _status(probe: Probe, block: BlockId) -> TedsStatus:
    try:
        return TedsStatus.decode(probe.good(query_teds(*block)))
    except Garbled as error:
        raise RuleBroken(f"Query (1.1) of {block}: {error.message}") from None


def absent(probe: Probe) -> BlockId:
    """A TEDS that could be held and is not."""
    listed = set(probe.listed())
    return next(block for block in product(range(255, -1, -1), range(17, 0, -1)) if block not in listed)


@rule("list-ascending", "Identify, Prove, List", Stage.PLAIN)
def list_ascending(probe: Probe) -> str:
    """Every TEDS once, ascending as octet strings, the Security TEDS too, none that could never be held."""
    listed = probe.listed()
    holds(listed == sorted(set(listed)), f"List (128.11) does not ascend, or names one twice: {listed}")
    holds(SECURITY in listed, "List (128.11) leaves out the Security TEDS (channel 0, access code 128).")
    strange = [block for block in listed if not can_be_stored(block)]
    holds(not strange, f"List (128.11) names what no node may hold: {strange}")
    return f"{len(listed)} TEDS, ascending"


@rule("teds-checksum", "The Security TEDS", Stage.PLAIN)
def teds_checksum(probe: Probe) -> str:
    """Length and Checksum of every TEDS are right."""
    listed = probe.listed()
    for channel, code in listed:
        try:
            unframe(probe.teds((channel, code)))
        except BadData as error:
            raise RuleBroken(f"TEDS {code} of channel {channel}: {error.message}") from None
    return f"Length and Checksum of {len(listed)} TEDS"


@rule("query-present", "Command frames", Stage.PLAIN)
def query_present(probe: Probe) -> str:
    """Size is what Read hands out, the checksum that of the TEDS; NotAvail not set, TextTEDS and MfgrDefine right."""
    listed = probe.listed()
    for block in listed:
        status, octets = _status(probe, block), probe.teds(block)
        holds(
            status.size == len(octets), f"Query (1.1) of {block}: size {status.size}; Read gives {len(octets)} octets."
        )
        right = int.from_bytes(octets[-2:], "big")
        holds(status.checksum == right, f"Query (1.1) of {block}: checksum {status.checksum:04x}, TEDS {right:04x}.")
        holds(not status.attributes & Attribute.NOT_AVAILABLE, f"Query (1.1) of {block}: NotAvail, but List has it.")
        manufacturer = bool(status.attributes & Attribute.MANUFACTURER)
        holds(manufacturer == (block[1] >= 128), f"Query (1.1) of {block}: MfgrDefine is {int(manufacturer)}.")
        text = bool(status.attributes & Attribute.TEXT)
        holds(text == (block[1] in _TEXTS), f"Query (1.1) of {block}: TextTEDS is {int(text)}.")
        holds(status.status == 0, f"Query (1.1) of {block}: status {status.status}, 0 is due.")
    return f"size, checksum and attributes of {len(listed)} TEDS"


@rule("query-absent", "Command frames", Stage.PLAIN)
def query_absent(probe: Probe) -> str:
    """NotAvail, size 0, checksum 0 for what could be held and is not there."""
    block = absent(probe)
    status = _status(probe, block)
    right = status.attributes & Attribute.NOT_AVAILABLE and (status.size, status.checksum, status.status) == (0, 0, 0)
    holds(
        bool(right), f"Query (1.1) of {block}: attributes {status.attributes:02x}, size {status.size}; NotAvail is due."
    )
    return f"{block}: NotAvail, size 0, checksum 0"


@rule("read-absent", "Command frames", Stage.PLAIN)
def read_absent(probe: Probe) -> str:
    """Read of an absent TEDS gets 18."""
    block = absent(probe)
    return probe.refused(read_teds(*block, 0), Reason.NO_SUCH_TEDS, str(block))


@rule("never-held", "Command frames", Stage.PLAIN)
def never_held(probe: Probe) -> str:
    """Query and Read of what no node may hold get 18."""
    for block in _NEVER:
        probe.refused(query_teds(*block), Reason.NO_SUCH_TEDS, str(block))
        seen = probe.refused(read_teds(*block, 0), Reason.NO_SUCH_TEDS, str(block))
    return seen


@rule("query-length", "Command frames", Stage.PLAIN)
def query_length(probe: Probe) -> str:
    """Query has one octet of payload, Read five."""
    probe.refused(Command(0, COMMON, TedsFunction.QUERY, b"\x80\0"), Reason.BAD_FORM)
    return probe.refused(Command(0, COMMON, TedsFunction.READ, b"\x80\0\0\0"), Reason.BAD_FORM)


@rule("read-end", "Command frames", Stage.PLAIN)
def read_end(probe: Probe) -> str:
    """From the end on, or past it: the size as offset, and no octets."""
    size = len(probe.teds(SECURITY))
    for offset in (size, size + 1, 0xFFFFFFFF):
        payload = probe.good(read_teds(*SECURITY, offset))
        right = payload == size.to_bytes(4, "big")
        holds(
            right, f"Read (1.2) at {offset} of {size} octets: {payload[:4].hex()} and {len(payload) - 4} octets came."
        )
    return f"offset {size} and no octets"


@rule("security-canonical", "The Security TEDS", Stage.PLAIN)
def security_canonical(probe: Probe) -> str:
    """Canonical form, and the values of this profile."""
    shown = probe.security()
    holds(own_values(shown), "Security TEDS: fields 1 to 4, 105, 109, 110 are not those of this profile.")
    return "signed" if shown.signed else "initial"


@rule("node-key", "The Security TEDS", Stage.PLAIN)
def node_key(probe: Probe) -> str:
    """Field 101 is a point, and 102 its own signature over UUID and point, with low s."""
    shown = probe.security()
    holds(is_point(shown.node_key), "Field 101 is no point on P-256.")
    message = node_key_message(probe.uuid, shown.node_key)
    good = verify(shown.node_key, message, normalise_signature(shown.node_key_signature))
    holds(good, "Field 102 does not verify under 101 over this UUID.")
    low = shown.node_key_signature == normalise_signature(shown.node_key_signature)
    holds(low, "Field 102: s is in the upper half of the group order.")
    return "102 good under 101 for this UUID"


@rule("security-state", "The Security TEDS", Stage.PLAIN)
def security_state(probe: Probe) -> str:
    """Initial until the first commit, signed after it; sequence and epoch agree with Identify."""
    identity, shown = probe.identity(), probe.security()
    provisioned = identity.state == NodeState.PROVISIONED
    holds(
        shown.signed == provisioned,
        f"The node is {identity.state.name.lower()}, its Security TEDS signed: {shown.signed}.",
    )
    holds(shown.sequence == identity.sequence, f"Field 106 is {shown.sequence}, Identify says {identity.sequence}.")
    right = shown.key_epoch <= identity.epoch if provisioned else shown.key_epoch == identity.epoch
    holds(right, f"Field 107 is {shown.key_epoch}, Identify says epoch {identity.epoch}.")
    return f"sequence {shown.sequence}, epoch {shown.key_epoch}"
