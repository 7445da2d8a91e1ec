"""Rules for any state that change nothing: frames, refusals, permissions, Identify, Prove, and the TEDS of a node."""

from __future__ import annotations

import os
from itertools import product
from typing import Final

from teds_provision.check import slips
from teds_provision.check.probe import Probe, RuleBrokenError, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.errors import BadDataError, GarbledError
from teds_provision.protocol.datasheet import can_be_stored, own_values
from teds_provision.protocol.keys import (
    CHALLENGE_OCTETS,
    GROUP_ORDER,
    is_point,
    node_key_message,
    normalise_signature,
    prove_message,
    verify,
)
from teds_provision.protocol.messages.frames import (
    COMMAND_HEADER,
    COMMON,
    SECURITY_CLASS,
    Attribute,
    Command,
    Function,
    Reason,
    TedsFunction,
    TedsStatus,
    query_teds,
    read_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.identity import LEAST_MESSAGE, MOST_MESSAGE, NodeState
from teds_provision.teds.codec.frame import unframe
from teds_provision.teds.image import SECURITY as SECURITY_TEDS
from teds_provision.teds.image import BlockId

_TEXTS = frozenset({2, 4, 6, 10, 11, 14, 15})
"""Access codes of text-based TEDS (profile.md, "Command frames")."""
_NEVER: tuple[BlockId, ...] = ((0, 0), (0, 18), (0, 127), (0, 136), (256, 1))
_PROOFS: Final = 12
"""Signatures that are looked at for a high s: a node that does not care gives one in two."""
_MEASURING: Final = range(Function.SAMPLE, Function.DRIVE + 1)


@rule("identify", "Identify, Prove, List", Stage.PLAIN)
def identify(probe: Probe) -> str:
    """Check that Identify has 23 octets, version 1, every value in its range, and the UUID of the search."""
    found = probe.identity()
    holds(found.uuid == probe.uuid, f"Identify names {found.uuid.hex()}; the node was found as {probe.uuid.hex()}.")
    return f"{found.state.name.lower()}, epoch {found.epoch}, sequence {found.sequence}, {found.max_message} octets"


@rule("max-message", "Command frames", Stage.PLAIN)
def max_message(probe: Probe) -> str:
    """Check that MaxMessage is 512 to 4094; a frame of that many octets is handled, one octet more gets 10."""
    most = probe.max_message
    holds(LEAST_MESSAGE <= most <= MOST_MESSAGE, f"Identify announces maxMessage {most}; 512 to 4094 are allowed.")
    unknown = Command(0, SECURITY_CLASS, 99, bytes(most - COMMAND_HEADER))
    seen = probe.refused(unknown, Reason.UNKNOWN_COMMAND, "a frame of maxMessage octets")
    if most < MOST_MESSAGE:
        longer = Command(0, SECURITY_CLASS, 99, bytes(most + 1 - COMMAND_HEADER))
        seen = probe.refused(longer, Reason.TOO_LARGE, "one octet longer than maxMessage")
    return seen


@rule("prove", "Identify, Prove, List", Stage.PLAIN)
def prove(probe: Probe) -> str:
    """Check that the signature over a fresh challenge verifies under field 101."""
    challenge = os.urandom(CHALLENGE_OCTETS)
    proof = probe.good(security_command(Function.PROVE, challenge))
    holds(len(proof) == 64, f"Prove (128.8): 64 octets are due, {len(proof)} came.")
    node = probe.security().node_key
    if not verify(node, prove_message(probe.uuid, challenge), normalise_signature(proof)):
        slip = slips.of_prove(probe.uuid, node, challenge, proof)
        raise RuleBrokenError("Prove (128.8): the signature does not verify under field 101.", slip)
    return "64 octets, good under field 101"


@rule("prove-low-s", "Notation", Stage.PLAIN)
def prove_low_s(probe: Probe) -> str:
    """Check that the node signs with s in the lower half."""
    return low_s(probe, Function.PROVE, "Prove (128.8)")


def low_s(probe: Probe, function: Function, what: str) -> str:
    """Ask for a signature over a challenge, again and again: s is in the lower half each time."""
    for _ in range(_PROOFS):
        proof = probe.good(security_command(function, os.urandom(CHALLENGE_OCTETS)))
        s = int.from_bytes(proof[32:], "big")
        holds(0 < s <= GROUP_ORDER // 2, f"{what}: s is in the upper half of the group order; n - s is due then.")
    return f"{_PROOFS} signatures with low s"


@rule("prove-length", "Command frames", Stage.PLAIN)
def prove_length(probe: Probe) -> str:
    """Check that a challenge has 32 octets."""
    for octets in (0, 31, 33):
        seen = probe.refused(security_command(Function.PROVE, bytes(octets)), Reason.BAD_FORM)
    return seen


@rule("no-payload", "Command frames", Stage.PLAIN)
def no_payload(probe: Probe) -> str:
    """Identify and List have no payload."""
    for function in (Function.IDENTIFY, Function.LIST):
        seen = probe.refused(security_command(function, b"\0"), Reason.BAD_FORM, "one octet of payload")
    return seen


@rule("frame-length", "Which command when", Stage.PLAIN)
def frame_length(probe: Probe) -> str:
    """Check that a frame too short for its header, or with a wrong length, gets 4 and is not run."""
    whole = query_teds(0, 128).encode()
    for octets, what in ((whole[:4], "a frame of 4 octets"), (whole[:-1], "length 1, no payload")):
        demand(probe.octets(octets, what), Reason.BAD_FORM, what)
    what = "length 2, one octet of payload"
    return demand(probe.octets(whole[:5] + b"\x02" + whole[6:], what), Reason.BAD_FORM, what)


@rule("refusal-form", "Command frames", Stage.PLAIN)
def refusal_form(probe: Probe) -> str:
    """Check that a refusal is status 0 and one octet of reason."""
    for command in (Command(0, SECURITY_CLASS, 99), security_command(Function.CLOSE), query_teds(0, 99)):
        reply = probe.plain(command)
        form = not reply.ok and len(reply.payload) == 1
        holds(
            form, f"{command.command_class}.{command.function}: status {int(reply.ok)} and {len(reply.payload)} octets"
        )
    return "status 0 and one octet of reason"


@rule("unknown-command", "Which command when", Stage.PLAIN)
def unknown_command(probe: Probe) -> str:
    """Check that unknown functions of class 128, and class 128 on another channel than 0, get 1."""
    for command in (
        Command(0, SECURITY_CLASS, 6),
        Command(0, SECURITY_CLASS, 99),
        Command(1, SECURITY_CLASS, Function.IDENTIFY),
    ):
        seen = probe.refused(command, Reason.UNKNOWN_COMMAND, f"channel {command.channel}")
    return seen


@rule("write-needs-session", "Which command when", Stage.PLAIN)
def write_needs_session(probe: Probe) -> str:
    """Write and Update outside a session get 3."""
    probe.refused(write_teds(0, 12, 0, b"\0\0"), Reason.NOT_PERMITTED)
    return probe.refused(update_teds(0, 12), Reason.NOT_PERMITTED)


@rule("close-needs-session", "Which command when", Stage.PLAIN)
def close_needs_session(probe: Probe) -> str:
    """Check that a plain Close gets 3."""
    return probe.refused(security_command(Function.CLOSE), Reason.NOT_PERMITTED)


@rule("operation-needs-session", "Which command when", Stage.PLAIN)
def operation_needs_session(probe: Probe) -> str:
    """Check that other classes, unknown functions of class 1, and 128.12 to 128.20 get 3 outside a session."""
    outside = [Command(1, 3, 1, b"\0"), Command(0, 5, 1), Command(0, COMMON, 99)]
    for command in outside + [Command(0, SECURITY_CLASS, function) for function in _MEASURING]:
        seen = probe.refused(command, Reason.NOT_PERMITTED)
    return seen


@rule("state-before-length", "Which command when", Stage.PLAIN)
def state_before_length(probe: Probe) -> str:
    """Check that state and permission are checked before lengths."""
    probe.refused(security_command(Function.CLOSE, b"\0"), Reason.NOT_PERMITTED)
    return probe.refused(Command(0, COMMON, TedsFunction.WRITE), Reason.NOT_PERMITTED)


# -- the TEDS of a node ------------------------------------------------------------------------------------------------


def _status(probe: Probe, block: BlockId) -> TedsStatus:
    try:
        return TedsStatus.decode(probe.good(query_teds(*block)))
    except GarbledError as error:
        raise RuleBrokenError(f"Query (1.1) of {block}: {error.message}") from None


def absent(probe: Probe) -> BlockId:
    """Return a TEDS that the node could hold and does not."""
    listed = set(probe.listed())
    return next(block for block in product(range(255, -1, -1), range(17, 0, -1)) if block not in listed)


@rule("list-ascending", "Identify, Prove, List", Stage.PLAIN)
def list_ascending(probe: Probe) -> str:
    """Check that List has every TEDS once, ascending as octet strings, the Security TEDS too, no impossible one."""
    listed = probe.listed()
    holds(listed == sorted(set(listed)), f"List (128.11) does not ascend, or names one twice: {listed}")
    holds(SECURITY_TEDS in listed, "List (128.11) leaves out the Security TEDS (channel 0, access code 128).")
    strange = [block for block in listed if not can_be_stored(block)]
    holds(not strange, f"List (128.11) names what no node may hold: {strange}")
    return f"{len(listed)} TEDS, ascending"


@rule("teds-checksum", "The Security TEDS", Stage.PLAIN)
def teds_checksum(probe: Probe) -> str:
    """Check Length and Checksum of every TEDS."""
    listed = probe.listed()
    for channel, code in listed:
        try:
            unframe(probe.teds((channel, code)))
        except BadDataError as error:
            raise RuleBrokenError(f"TEDS {code} of channel {channel}: {error.message}") from None
    return f"Length and Checksum of {len(listed)} TEDS"


@rule("query-present", "Command frames", Stage.PLAIN)
def query_present(probe: Probe) -> str:
    """Check that Query has Read's size and the TEDS's checksum; NotAvail not set, TextTEDS and MfgrDefine right."""
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
    """Check that Query of an absent TEDS that the node could hold has NotAvail, size 0, checksum 0."""
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
    """Check that Read from the end on, or past it, returns the size as offset, and no octets."""
    size = len(probe.teds(SECURITY_TEDS))
    for offset in (size, size + 1, 0xFFFFFFFF):
        payload = probe.good(read_teds(*SECURITY_TEDS, offset))
        right = payload == size.to_bytes(4, "big")
        holds(
            right, f"Read (1.2) at {offset} of {size} octets: {payload[:4].hex()} and {len(payload) - 4} octets came."
        )
    return f"offset {size} and no octets"


@rule("security-canonical", "The Security TEDS", Stage.PLAIN)
def security_canonical(probe: Probe) -> str:
    """Check that the Security TEDS has canonical form, and the values of this profile."""
    shown = probe.security()
    holds(own_values(shown), "Security TEDS: fields 1 to 4, 105, 109, 110 are not those of this profile.")
    return "signed" if shown.signed else "initial"


@rule("node-key", "The Security TEDS", Stage.PLAIN)
def node_key(probe: Probe) -> str:
    """Check that field 101 is a point, and 102 its own signature over UUID and point, with low s."""
    shown = probe.security()
    holds(is_point(shown.node_key), "Field 101 is no point on P-256.")
    message = node_key_message(probe.uuid, shown.node_key)
    if not verify(shown.node_key, message, normalise_signature(shown.node_key_signature)):
        slip = slips.of_node_key(probe.uuid, shown.node_key, shown.node_key_signature)
        raise RuleBrokenError("Field 102 does not verify under 101 over this UUID.", slip)
    low = shown.node_key_signature == normalise_signature(shown.node_key_signature)
    holds(low, "Field 102: s is in the upper half of the group order.")
    return "102 good under 101 for this UUID"


@rule("security-state", "The Security TEDS", Stage.PLAIN)
def security_state(probe: Probe) -> str:
    """Check that the security state is initial until the first commit and signed after it, and agrees with Identify."""
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
