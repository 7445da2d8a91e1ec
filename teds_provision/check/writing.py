"""Rules of Write, Update, the commit, and Reset with a key."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

from teds_provision.check.outcome import NotApplicable
from teds_provision.check.probe import Probe, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.check.teds_rules import absent
from teds_provision.protocol.datasheet import NodeKeys, digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.keys import SoftwareKey, fingerprint, normalise_signature, reset_message, verify
from teds_provision.protocol.messages.frames import (
    COMMON,
    Command,
    Function,
    Reason,
    TedsFunction,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId

_HEAD = 53
"""Octets of a Write that are not TEDS: of maxMessage so many less may be written at once."""


def _example(block: BlockId) -> bytes:
    """A TEDS that passes its own check: TEDSID of this access code, and one tuple."""
    return frame(bytes([3, 4, 0, block[1], 1, 1, 0x80, 2, 0xCA, 0xFE]))


@rule("write-checks", "Writing to flash", Stage.SESSION)
def write_checks(probe: Probe) -> str:
    """Payload shorter than 5 octets 4; beyond what is staged 4; never held 18. Nothing of it lasts."""
    block = absent(probe)
    probe.sealed_refused(Command(block[0], COMMON, TedsFunction.WRITE, bytes([block[1], 0, 0, 0])), Reason.BAD_FORM)
    probe.sealed_refused(write_teds(*block, 1, b"\0"), Reason.BAD_FORM, "offset 1, nothing staged")
    seen = probe.sealed_refused(write_teds(0, 99, 0, b"\0"), Reason.NO_SUCH_TEDS, "access code 99")
    probe.close()
    return seen


@rule("update-checks", "Writing to flash", Stage.SESSION)
def update_checks(probe: Probe) -> str:
    """A staged image with wrong checksum, or another class in its TEDSID, gets 4; 128 while others are staged 2."""
    block = absent(probe)
    good = _example(block)
    for wrong, why in ((good[:-1] + bytes([good[-1] ^ 1]), "checksum"), (_example((0, 130)), "class of the TEDSID")):
        probe.sealed_good(write_teds(*block, 0, wrong))
        probe.sealed_refused(update_teds(*block), Reason.BAD_FORM, f"{why} wrong")
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.WRONG_STATE, "another TEDS staged, 128 not")
    holds(block not in probe.listed(), f"List (128.11) names {block}, which is staged and not committed.")
    probe.close()
    return seen


# -- the commit --------------------------------------------------------------------------------------------------------


def _stored(probe: Probe) -> dict[BlockId, bytes]:
    return {block: probe.teds(block) for block in probe.listed() if block != SECURITY}


def _sheet(probe: Probe, listed: dict[BlockId, bytes]) -> SecurityTeds:
    """What the next good Security TEDS over these blocks says, unsigned."""
    identity, shown, station = probe.identity(), probe.security(), probe.station
    return unsigned_datasheet(
        NodeKeys(probe.uuid, shown.node_key, shown.node_key_signature),
        station.key.point,
        station.station_signature,
        digests(listed),
        ca=security.ca_hint("node check", fingerprint(station.ca)),
        last_modified=bytes(8),
        sequence=identity.sequence + 1,
        key_epoch=identity.epoch,
    )


def _write(probe: Probe, block: BlockId, octets: bytes) -> None:
    room = probe.max_message - _HEAD
    for offset in range(0, len(octets), room):
        probe.sealed_good(write_teds(*block, offset, octets[offset : offset + room]))


def _signed(probe: Probe, sheet: SecurityTeds) -> bytes:
    return sign_datasheet(sheet, probe.uuid, probe.station)


Change = Callable[[SecurityTeds], SecurityTeds]


def _refused_commit(probe: Probe, reason: Reason, why: str, change: Change) -> str:
    """Commit a datasheet that is wrong in one thing, over what is stored; what came."""
    _write(probe, SECURITY, _signed(probe, change(_sheet(probe, _stored(probe)))))
    seen = probe.sealed_refused(update_teds(*SECURITY), reason, why)
    probe.close()
    return seen


@rule("commit-signatures", "Writing to flash", Stage.COMMIT)
def commit_signatures(probe: Probe) -> str:
    """Another's 101, 104 of another CA, and a wrong field 100 get 5."""
    other = SoftwareKey.generate()
    _refused_commit(probe, Reason.BAD_SIGNATURE, "101 of another node", lambda s: replace(s, node_key=other.point))
    forged = other.sign(b"no station key")
    _refused_commit(probe, Reason.BAD_SIGNATURE, "104 wrong", lambda s: replace(s, station_key_signature=forged))
    octets = _sheet(probe, _stored(probe)).with_signature(other.sign(b"another datasheet")).encode()
    _write(probe, SECURITY, octets)
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.BAD_SIGNATURE, "100 wrong")
    probe.close()
    return seen


@rule("commit-form", "Writing to flash", Stage.COMMIT)
def commit_form(probe: Probe) -> str:
    """A Security TEDS that is not canonical, or not signed, gets 4."""
    octets = _signed(probe, _sheet(probe, _stored(probe)))
    twice = frame(octets[4:-2] + b"\x6e\x01\x01")  # field 110 a second time
    for wrong, why in ((twice, "110 twice"), (security_of_the_node(probe), "not signed")):
        _write(probe, SECURITY, wrong)
        seen = probe.sealed_refused(update_teds(*SECURITY), Reason.BAD_FORM, why)
        probe.close()
    return seen


def security_of_the_node(probe: Probe) -> bytes:
    """The initial Security TEDS of the node; raises NotApplicable where it has a signed one."""
    if probe.security().signed:
        raise NotApplicable("The node has a signed Security TEDS already.")
    return probe.teds(SECURITY)


@rule("commit-digests", "Writing to flash", Stage.COMMIT)
def commit_digests(probe: Probe) -> str:
    """A listed TEDS that is not there, and a staged one that is not listed, get 6."""
    block = absent(probe)
    stored = _stored(probe)
    _write(probe, SECURITY, _signed(probe, _sheet(probe, stored | {block: _example(block)})))
    probe.sealed_refused(update_teds(*SECURITY), Reason.DIGEST_MISMATCH, "one listed, not there")
    _write(probe, block, _example(block))
    _write(probe, SECURITY, _signed(probe, _sheet(probe, stored)))
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.DIGEST_MISMATCH, "one staged, not listed")
    probe.close()
    return seen


@rule("commit-sequence", "Writing to flash", Stage.COMMIT)
def commit_sequence(probe: Probe) -> str:
    """A sequence that is not greater, or greater by more than 65536, gets 7."""
    _refused_commit(probe, Reason.STALE_SEQUENCE, "the stored sequence", lambda s: replace(s, sequence=s.sequence - 1))
    return _refused_commit(
        probe, Reason.STALE_SEQUENCE, "65537 ahead", lambda s: replace(s, sequence=s.sequence + 65536)
    )


@rule("commit-epoch", "Writing to flash", Stage.COMMIT)
def commit_epoch(probe: Probe) -> str:
    """A KeyEpoch other than the node's gets 8, after the sequence."""
    return _refused_commit(probe, Reason.WRONG_EPOCH, "an epoch ahead", lambda s: replace(s, key_epoch=s.key_epoch + 1))


@rule("commit", "Writing to flash", Stage.COMMIT)
def commit(probe: Probe) -> str:
    """A good one is taken whole and read back; the next, without the TEDS of the test, removes it again."""
    block, stored, before = absent(probe), _stored(probe), probe.identity()
    for blocks in (stored | {block: _example(block)}, stored):
        octets = _signed(probe, _sheet(probe, blocks))
        for each in set(blocks) - set(stored):
            _write(probe, each, blocks[each])
        _write(probe, SECURITY, octets)
        probe.sealed_good(update_teds(*SECURITY))
        holds(probe.teds(SECURITY) == octets, "After the commit Read gives another Security TEDS.")
        holds(_stored(probe) == blocks, "After the commit the node holds other TEDS than were signed.")
    after = probe.require(NodeState.PROVISIONED)
    holds(
        after.sequence == before.sequence + 2,
        f"Sequence went from {before.sequence} to {after.sequence} with two commits.",
    )
    probe.close()
    return f"two commits, sequence {after.sequence}, read back"


# -- the way back ------------------------------------------------------------------------------------------------------


@rule("reset", "Reset", Stage.RESET)
def reset(probe: Probe) -> str:
    """In a session Reset erases key and trust and proves it; epoch and sequence stay, sessions end."""
    before, challenge = probe.identity(), os.urandom(32)
    proof = probe.sealed_good(security_command(Function.RESET, challenge))
    probe.session = None
    point = probe.security().node_key
    right = len(proof) == 64 and verify(
        point, reset_message(probe.uuid, before.epoch, challenge), normalise_signature(proof)
    )
    holds(right, "Reset (128.9): the proof does not verify under field 101 at this epoch.")
    after = probe.identity()
    holds(after.state == NodeState.FACTORY, f"After Reset the node is {after.state.name.lower()}.")
    kept = (after.epoch, after.sequence) == (before.epoch, before.sequence)
    holds(
        kept, f"Reset took epoch {before.epoch} and sequence {before.sequence} to {after.epoch} and {after.sequence}."
    )
    holds(not probe.security().signed, "After Reset the node still shows a signed Security TEDS.")
    return f"factory, epoch {after.epoch} and sequence {after.sequence} kept"
