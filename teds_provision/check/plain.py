"""Rules for any state that change nothing: frames, refusals, permissions, Identify, Prove."""

from __future__ import annotations

import os
from typing import Final

from teds_provision.check.probe import Probe, demand, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.protocol.keys import GROUP_ORDER, normalise_signature, prove_message, verify
from teds_provision.protocol.messages.frames import (
    COMMON,
    SECURITY,
    Command,
    Function,
    Reason,
    TedsFunction,
    query_teds,
    security_command,
    update_teds,
    write_teds,
)

_PROOFS: Final = 12
"""Signatures that are looked at for a high s: a node that does not care gives one in two."""
_MEASURING: Final = range(Function.SAMPLE, Function.DRIVE + 1)


@rule("identify", "Identify, Prove, List", Stage.PLAIN)
def identify(probe: Probe) -> str:
    """23 octets, version 1, every value in its range; the UUID under which it was found."""
    found = probe.identity()
    holds(found.uuid == probe.uuid, f"Identify names {found.uuid.hex()}; the node was found as {probe.uuid.hex()}.")
    return f"{found.state.name.lower()}, epoch {found.epoch}, sequence {found.sequence}, {found.max_message} octets"


@rule("prove", "Identify, Prove, List", Stage.PLAIN)
def prove(probe: Probe) -> str:
    """The signature over a fresh challenge verifies under field 101."""
    challenge = os.urandom(32)
    proof = probe.good(security_command(Function.PROVE, challenge))
    holds(len(proof) == 64, f"Prove (128.8): 64 octets are due, {len(proof)} came.")
    good = verify(probe.security().node_key, prove_message(probe.uuid, challenge), normalise_signature(proof))
    holds(good, "Prove (128.8): the signature does not verify under field 101.")
    return "64 octets, good under field 101"


@rule("prove-low-s", "Notation", Stage.PLAIN)
def prove_low_s(probe: Probe) -> str:
    """Whoever signs puts s into the lower half."""
    for _ in range(_PROOFS):
        proof = probe.good(security_command(Function.PROVE, os.urandom(32)))
        s = int.from_bytes(proof[32:], "big")
        holds(0 < s <= GROUP_ORDER // 2, "Prove (128.8): s is in the upper half of the group order.")
    return f"{_PROOFS} signatures with low s"


@rule("prove-length", "Command frames", Stage.PLAIN)
def prove_length(probe: Probe) -> str:
    """A challenge has 32 octets."""
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
    """A frame too short for its header, or whose length is wrong."""
    whole = query_teds(0, 128).encode()
    for octets, what in ((whole[:4], "a frame of 4 octets"), (whole[:-1], "length 1, no payload")):
        demand(probe.octets(octets, what), Reason.BAD_FORM, what)
    what = "length 2, one octet of payload"
    return demand(probe.octets(whole[:5] + b"\x02" + whole[6:], what), Reason.BAD_FORM, what)


@rule("refusal-form", "Command frames", Stage.PLAIN)
def refusal_form(probe: Probe) -> str:
    """A refusal is status 0 and one octet of reason."""
    for command in (Command(0, SECURITY, 99), security_command(Function.CLOSE), query_teds(0, 99)):
        reply = probe.plain(command)
        form = not reply.ok and len(reply.payload) == 1
        holds(
            form, f"{command.command_class}.{command.function}: status {int(reply.ok)} and {len(reply.payload)} octets"
        )
    return "status 0 and one octet of reason"


@rule("unknown-command", "Which command when", Stage.PLAIN)
def unknown_command(probe: Probe) -> str:
    """Functions of class 128 that nobody knows, and class 128 elsewhere than on channel 0, get 1."""
    for command in (Command(0, SECURITY, 6), Command(0, SECURITY, 99), Command(1, SECURITY, Function.IDENTIFY)):
        seen = probe.refused(command, Reason.UNKNOWN_COMMAND, f"channel {command.channel}")
    return seen


@rule("write-needs-session", "Which command when", Stage.PLAIN)
def write_needs_session(probe: Probe) -> str:
    """Write and Update outside a session get 3."""
    probe.refused(write_teds(0, 12, 0, b"\0\0"), Reason.NOT_PERMITTED)
    return probe.refused(update_teds(0, 12), Reason.NOT_PERMITTED)


@rule("close-needs-session", "Which command when", Stage.PLAIN)
def close_needs_session(probe: Probe) -> str:
    """A plain Close gets 3."""
    return probe.refused(security_command(Function.CLOSE), Reason.NOT_PERMITTED)


@rule("operation-needs-session", "Which command when", Stage.PLAIN)
def operation_needs_session(probe: Probe) -> str:
    """Every other class, unknown functions of class 1, and 128.12 to 128.20 get 3 outside a session."""
    outside = [Command(1, 3, 1, b"\0"), Command(0, 5, 1), Command(0, COMMON, 99)]
    for command in outside + [Command(0, SECURITY, function) for function in _MEASURING]:
        seen = probe.refused(command, Reason.NOT_PERMITTED)
    return seen


@rule("state-before-length", "Which command when", Stage.PLAIN)
def state_before_length(probe: Probe) -> str:
    """State and permission are looked at before lengths."""
    probe.refused(security_command(Function.CLOSE, b"\0"), Reason.NOT_PERMITTED)
    return probe.refused(Command(0, COMMON, TedsFunction.WRITE), Reason.NOT_PERMITTED)
