"""Rules of Write, Update, the commit, and Reset with a key."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Callable
from dataclasses import replace

from teds_provision.check import slips
from teds_provision.check.agreement_rules import StrangerStation, request, require_reset_proof, tapped_or_bus
from teds_provision.check.plain_rules import absent, security_state
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, holds
from teds_provision.check.rule import Stage, rule
from teds_provision.check.slips import Slip
from teds_provision.protocol.datasheet import digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.keys import (
    CHALLENGE_OCTETS,
    GROUP_ORDER,
    SoftwareKey,
    fingerprint,
)
from teds_provision.protocol.messages.frames import (
    COMMON,
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
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.messages.tables import describe_command, describe_reply
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.codec.security import OUR_VALUES, SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId

_MOST_WRITTEN = 32768
"""MaxTEDSSize up to which a TEDS of that size is staged for trying."""
_ALPHABET = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
_CODES = (*range(1, 18), 131)
"""Access codes of TEDS that any board may be given."""
_HEAD = 53
"""Octets of a Write that are not TEDS: of maxMessage so many less may be written at once."""


def _example(block: BlockId) -> bytes:
    """Return a TEDS that passes its own check: TEDSID of this access code, and one tuple."""
    return frame(bytes([3, 4, 0, block[1], 1, 1, 0x80, 2, 0xCA, 0xFE]))


@rule("write-checks", "Writing to flash", Stage.SESSION)
def write_checks(probe: Probe) -> str:
    """Check that a payload below 5 octets gets 4, beyond the staged length 4, of a TEDS never held 18: no effect."""
    block = absent(probe)
    probe.sealed_refused(Command(block[0], COMMON, TedsFunction.WRITE, bytes([block[1], 0, 0, 0])), Reason.BAD_FORM)
    probe.sealed_refused(write_teds(*block, 1, b"\0"), Reason.BAD_FORM, "offset 1, nothing staged")
    seen = probe.sealed_refused(write_teds(0, 99, 0, b"\0"), Reason.NO_SUCH_TEDS, "access code 99")
    probe.close()
    return seen


@rule("write-keeps", "Writing to flash", Stage.SESSION)
def write_keeps(probe: Probe) -> str:
    """Check that a refused Write changes no staging.

    An empty one at 0 stages an empty image, which fails its own check.
    """
    block = absent(probe)
    good = _example(block)
    probe.sealed_good(write_teds(*block, 0, good))
    probe.sealed_refused(write_teds(*block, len(good) + 1, b"\0"), Reason.BAD_FORM, "an offset beyond what is staged")
    staged = TedsStatus.decode(probe.sealed_good(update_teds(*block)))
    holds(staged.size == len(good), f"Update (1.4): size {staged.size} after a refused Write; {len(good)} is due.")
    probe.sealed_good(write_teds(*block, 0, b""))
    seen = probe.sealed_refused(update_teds(*block), Reason.BAD_FORM, "an empty image is staged")
    probe.close()
    return seen


@rule("update-checks", "Writing to flash", Stage.SESSION)
def update_checks(probe: Probe) -> str:
    """Check that a staged image with wrong checksum, or another class in its TEDSID, gets 4.

    128 while others are staged 2.
    """
    block = absent(probe)
    good = _example(block)
    for wrong, why in ((good[:-1] + bytes([good[-1] ^ 1]), "checksum"), (_example((0, 130)), "class of the TEDSID")):
        probe.sealed_good(write_teds(*block, 0, wrong))
        probe.sealed_refused(update_teds(*block), Reason.BAD_FORM, f"{why} wrong")
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.WRONG_STATE, "another TEDS staged, 128 not")
    holds(block not in probe.listed(), f"List (128.11) names {block}, which is staged and not committed.")
    probe.close()
    return seen


@rule("update-codes", "Writing to flash", Stage.SESSION)
def update_codes(probe: Probe) -> str:
    """Check that a staged TEDS with a wrong checksum gets 4, for every access code: Calibration and text alike."""
    listed = set(probe.listed())
    for code in _CODES:
        channel = next(channel for channel in range(255, 0, -1) if (channel, code) not in listed)
        good = _example((channel, code))
        probe.sealed_good(write_teds(channel, code, 0, good[:-1] + bytes([good[-1] ^ 1])))
        seen = probe.sealed_refused(update_teds(channel, code), Reason.BAD_FORM, f"access code {code}, checksum wrong")
    probe.close()
    return seen


@rule("staged-unseen", "Writing to flash", Stage.SESSION)
def staged_unseen(probe: Probe) -> str:
    """Check that staging is invisible: neither Read nor Query gives it, and Update of it alone commits nothing."""
    block = absent(probe)
    before = probe.sealed_good(query_teds(*block))
    probe.sealed_good(write_teds(*block, 0, _example(block)))
    probe.sealed_refused(read_teds(*block, 0), Reason.NO_SUCH_TEDS, f"{block} staged, not committed")
    holds(
        probe.sealed_good(query_teds(*block)) == before, f"Query (1.1) gives {block}, which is staged, not committed."
    )
    probe.sealed_good(update_teds(*block))
    probe.close()
    probe.sealed_refused(read_teds(*block, 0), Reason.NO_SUCH_TEDS, f"after Update of {block} alone, without 128")
    text = f"Update (1.4) of {block} alone stored it: no datasheet covers it."
    holds(probe.sealed_good(query_teds(*block)) == before, text)
    probe.close()
    return f"{block} is not there before a datasheet is committed"


@rule("write-read-only", "Writing to flash", Stage.SESSION)
def write_read_only(probe: Probe) -> str:
    """Check that a TEDS that Query calls read-only cannot be written: 3."""
    for block in probe.listed():
        if TedsStatus.decode(probe.good(query_teds(*block))).attributes & Attribute.READ_ONLY:
            seen = probe.sealed_refused(write_teds(*block, 0, b"\0"), Reason.NOT_PERMITTED, f"{block} is read-only")
            probe.close()
            return seen
    raise NotApplicableError("No TEDS of this board is read-only: build its firmware with one, as Origin (130).")


@rule("write-drops", "Writing to flash", Stage.SESSION)
def write_drops(probe: Probe) -> str:
    """Check that Write drops the octets after those written; more than MaxTEDSSize gets 10."""
    block = absent(probe)
    good = _example(block)
    probe.sealed_good(write_teds(*block, 0, good))
    probe.sealed_good(write_teds(*block, 0, good[:6]))
    probe.sealed_refused(update_teds(*block), Reason.BAD_FORM, "its end was dropped")
    most = TedsStatus.decode(probe.good(query_teds(*block))).max_size
    if most > _MOST_WRITTEN:
        probe.close()
        return f"MaxTEDSSize {most} was not tried"
    room = probe.max_message - _HEAD
    for offset in range(0, most, room):
        probe.sealed_good(write_teds(*block, offset, bytes(min(room, most - offset))))
    seen = probe.sealed_refused(write_teds(*block, most, b"\0"), Reason.TOO_LARGE, f"octet {most + 1}")
    probe.close()
    return seen


@rule("staging-ends", "Sessions", Stage.SESSION)
def staging_ends(probe: Probe) -> str:
    """Check that staged TEDS end with the session: Update then answers like Query."""
    block = absent(probe)
    probe.sealed_good(write_teds(*block, 0, _example(block)))
    staged = TedsStatus.decode(probe.sealed_good(update_teds(*block)))
    holds(staged.size == len(_example(block)), f"Update (1.4) of a staged TEDS: size {staged.size}.")
    probe.close()
    asked, updated = probe.good(query_teds(*block)), probe.sealed_good(update_teds(*block))
    holds(asked == updated, "Update (1.4) of what was staged in an earlier session does not answer like Query.")
    probe.close()
    return "a new session begins with nothing staged"


@rule("staging-shared", "Writing to flash", Stage.SESSION)
def staging_shared(probe: Probe) -> str:
    """Check that there is one staging area: while a session uses it, Write and Update in another get 17.

    17 comes after 4 and 18, and what is staged stays; it goes when its session ends.
    """
    other, block = probe.from_station(1), absent(probe)
    good = _example(block)
    probe.sealed_good(write_teds(*block, 0, good))
    other.sealed_refused(write_teds(*block, 1, b"\0"), Reason.BAD_FORM, "another session, offset 1 with nothing staged")
    other.sealed_refused(write_teds(0, 99, 0, b"\0"), Reason.NO_SUCH_TEDS, "another session, access code 99")
    other.sealed_refused(write_teds(*block, 0, good), Reason.BUSY, "something staged in another session")
    seen = other.sealed_refused(update_teds(*block), Reason.BUSY, "something staged in another session")
    staged = TedsStatus.decode(probe.sealed_good(update_teds(*block)))
    holds(
        staged.size == len(good),
        f"What was staged has {staged.size} octets after another session's Write; {len(good)} are due.",
    )
    probe.close()
    other.sealed_good(write_teds(*block, 0, good))
    other.close()
    return seen


# -- the commit --------------------------------------------------------------------------------------------------------


def stored_blocks(probe: Probe) -> dict[BlockId, bytes]:
    """Read every TEDS that the node lists except the Security TEDS."""
    return {block: probe.teds(block) for block in probe.listed() if block != SECURITY}


def _sheet(probe: Probe, listed: dict[BlockId, bytes]) -> SecurityTeds:
    """Return the next good Security TEDS over these blocks, unsigned."""
    identity, station = probe.identity(), probe.station
    return unsigned_datasheet(
        probe.node_keys,
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


def commit_blocks(probe: Probe, blocks: dict[BlockId, bytes], *, write: dict[BlockId, bytes]) -> None:
    """Commit a datasheet over these TEDS, of which ``write`` are new; raises RuleBrokenError if it is refused."""
    octets = _signed(probe, _sheet(probe, blocks))
    for block, teds in write.items():
        _write(probe, block, teds)
    _write(probe, SECURITY, octets)
    probe.sealed_good(update_teds(*SECURITY))
    holds(probe.teds(SECURITY) == octets, "After the commit Read gives another Security TEDS.")


Change = Callable[[SecurityTeds], SecurityTeds]


def _refused_commit(probe: Probe, reason: Reason, why: str, change: Change) -> str:
    """Commit a datasheet that is wrong in one thing, over what is stored; what came."""
    return _refused_over(probe, reason, why, _signed(probe, change(_sheet(probe, stored_blocks(probe)))))


def _refused_over(probe: Probe, reason: Reason, why: str, octets: bytes) -> str:
    """Commit this Security TEDS with what is staged; what came, when the node is as it was before."""
    before = probe.identity(), probe.teds(SECURITY), probe.listed()
    _write(probe, SECURITY, octets)
    try:
        seen = probe.sealed_refused(update_teds(*SECURITY), reason, why)
    except RuleBrokenError:
        # the node accepted a wrong TEDS: write a good one, so that the other rules can run
        if probe.teds(SECURITY) == octets:
            _write(probe, SECURITY, _signed(probe, _sheet(probe, stored_blocks(probe))))
            probe.sealed(update_teds(*SECURITY))
            probe.close()
        raise
    probe.close()
    after = probe.identity(), probe.teds(SECURITY), probe.listed()
    holds(after == before, f"Update (1.4) of 128 was refused ({why}), and changed the node.")
    return seen


@rule("commit-signatures", "Writing to flash", Stage.COMMIT)
def commit_signatures(probe: Probe) -> str:
    """Check that another node's 101, 104 of another CA, and a wrong field 100 get 5."""
    other = SoftwareKey.generate()
    _refused_commit(probe, Reason.BAD_SIGNATURE, "101 of another node", lambda s: replace(s, node_key=other.point))
    forged = other.sign(b"no station key")
    _refused_commit(probe, Reason.BAD_SIGNATURE, "104 wrong", lambda s: replace(s, station_key_signature=forged))
    _refused_commit(probe, Reason.BAD_SIGNATURE, "102 wrong", lambda s: replace(s, node_key_signature=forged))
    octets = _sheet(probe, stored_blocks(probe)).with_signature(other.sign(b"another datasheet")).encode()
    _write(probe, SECURITY, octets)
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.BAD_SIGNATURE, "100 wrong")
    probe.close()
    return seen


@rule("commit-high-s", "Notation", Stage.COMMIT)
def commit_high_s(probe: Probe) -> str:
    """Check that a field 100 whose s is in the upper half gets 5."""
    sheet = _sheet(probe, stored_blocks(probe))
    good = security.decode(_signed(probe, sheet)).signature
    assert good is not None
    twisted = good[:32] + (GROUP_ORDER - int.from_bytes(good[32:], "big")).to_bytes(32, "big")
    octets = sheet.with_signature(twisted).encode()
    return _refused_over(probe, Reason.BAD_SIGNATURE, "100 with a high s", octets)


@rule("commit-form", "Writing to flash", Stage.COMMIT)
def commit_form(probe: Probe) -> str:
    """Check that a Security TEDS that is not canonical, or not signed, gets 4."""
    octets = _signed(probe, _sheet(probe, stored_blocks(probe)))
    twice = frame(octets[4:-2] + b"\x6e\x01\x01")  # field 110 a second time
    for wrong, why in ((twice, "110 twice"), (security_of_the_node(probe), "not signed")):
        _write(probe, SECURITY, wrong)
        seen = probe.sealed_refused(update_teds(*SECURITY), Reason.BAD_FORM, why)
        probe.close()
    return seen


@rule("commit-utf8", "The Security TEDS", Stage.COMMIT)
def commit_utf8(probe: Probe) -> str:
    """Check that a field 5 that is not UTF-8 gets 4 even if signed: a lone octet, a surrogate, an overlong form."""
    for wrong in (b"bench\xff:", b"\xed\xa0\x80:", b"\xc0\xaf:"):
        block = _unsigned_block(probe)
        at = _place(block, 5)
        changed = block[: at - 2] + bytes([5, len(wrong)]) + wrong + block[at + block[at - 1] :]
        seen = _refused_over(probe, Reason.BAD_FORM, f"field 5 {wrong.hex()}", _signed_block(probe, changed))
    return seen


@rule("commit-base64", "The Security TEDS", Stage.COMMIT)
def commit_base64(probe: Probe) -> str:
    """Check that fields 100 to 104 are base64 with spare bits zero and no other letters, else 4, even if signed."""
    for field in (100, 101, 103, 104):
        block = _unsigned_block(probe)
        if field == 100:
            whole = _signed_block(probe, block)
            block = whole[4:-2]
        at = _place(block, field)
        text = block[at : at + 88]
        last = 85 if text.endswith(b"==") else 86
        spare = _ALPHABET[_ALPHABET.index(text[last]) + 1]
        for octet, where, why in ((spare, last, "spare bits not zero"), (0x0A, 40, "a line feed in it")):
            wrong = text[:where] + bytes([octet]) + text[where + 1 :]
            changed = block[:at] + wrong + block[at + 88 :]
            octets = frame(changed) if field == 100 else _signed_block(probe, changed)
            seen = _refused_over(probe, Reason.BAD_FORM, f"field {field}, {why}", octets)
    return seen


@rule("commit-extra", "The Security TEDS", Stage.COMMIT)
def commit_extra(probe: Probe) -> str:
    """Check that fields 111 to 255 are skipped, but signed: one changed after signing gets 5."""
    extra = {111: b"\x01", 200: b"of a later profile", 255: b""}
    good = _signed(probe, replace(_sheet(probe, stored_blocks(probe)), extra=extra))
    at = good.index(b"of a later profile")
    changed = frame(good[4:at] + b"OF" + good[at + 2 : -2])
    _refused_over(probe, Reason.BAD_SIGNATURE, "field 200 changed after signing", changed)
    _write(probe, SECURITY, good)
    probe.sealed_good(update_teds(*SECURITY))
    holds(probe.teds(SECURITY) == good, "After the commit of fields 111, 200 and 255 Read gives another Security TEDS.")
    probe.close()
    return "fields 111, 200 and 255 taken, read back, and covered"


def _unsigned_block(probe: Probe) -> bytes:
    """Return the data block of the next good Security TEDS, without field 100."""
    return _sheet(probe, stored_blocks(probe)).block()


def _signed_block(probe: Probe, block: bytes, message: bytes = b"") -> bytes:
    """Return the framed TEDS of a data block whose field 100 signs it unchanged, or signs ``message``."""
    message = message or b"TEDS1 datasheet\0" + probe.uuid + block
    signature = base64.b64encode(probe.station.key.sign(message))
    at = _place(block, 101) - 2
    return frame(block[:at] + bytes([100, 88]) + signature + block[at:])


def _place(block: bytes, field: int) -> int:
    """Return the offset of a field's value in a data block."""
    at = 0
    while block[at] != field or at == 0:  # the first tuple is always the TEDSID, whatever its type
        at += 2 + block[at + 1]
    return at + 2


def security_of_the_node(probe: Probe) -> bytes:
    """Return the initial Security TEDS of the node; raises NotApplicableError if it has a signed one."""
    if probe.security().signed:
        raise NotApplicableError("The node has a signed Security TEDS already.")
    return probe.teds(SECURITY)


@rule("commit-digests", "Writing to flash", Stage.COMMIT)
def commit_digests(probe: Probe) -> str:
    """Check that a listed TEDS that is absent, and a staged one that is not listed, get 6."""
    block = absent(probe)
    stored = stored_blocks(probe)
    _write(probe, SECURITY, _signed(probe, _sheet(probe, stored | {block: _example(block)})))
    probe.sealed_refused(update_teds(*SECURITY), Reason.DIGEST_MISMATCH, "one listed, not there")
    _write(probe, block, _example(block))
    _write(probe, SECURITY, _signed(probe, _sheet(probe, stored)))
    seen = probe.sealed_refused(update_teds(*SECURITY), Reason.DIGEST_MISMATCH, "one staged, not listed")
    probe.close()
    return seen


@rule("commit-digest", "Writing to flash", Stage.COMMIT)
def commit_digest(probe: Probe) -> str:
    """Check that a staged TEDS with another digest than the listed one gets 6."""
    block = absent(probe)
    listed = stored_blocks(probe) | {block: frame(bytes([3, 4, 0, block[1], 1, 1, 0x80, 2, 0xBE, 0xEF]))}
    _write(probe, block, _example(block))
    octets = _signed(probe, _sheet(probe, listed))
    return _refused_over(probe, Reason.DIGEST_MISMATCH, "another digest", octets)


@rule("commit-own-check", "Writing to flash", Stage.COMMIT)
def commit_own_check(probe: Probe) -> str:
    """Check that a staged image that does not pass its own check gets 4, regardless of the signature."""
    block = absent(probe)
    wrong = _example(block)[:-1] + bytes([_example(block)[-1] ^ 1])
    _write(probe, block, wrong)
    octets = _signed(probe, _sheet(probe, stored_blocks(probe) | {block: wrong}))
    return _refused_over(probe, Reason.BAD_FORM, "checksum of a staged TEDS", octets)


@rule("commit-values", "Writing to flash", Stage.COMMIT)
def commit_values(probe: Probe) -> str:
    """Check that other values in fields 1 to 4, 105, 109 and 110 than this profile's get 4, even if signed."""
    for field in OUR_VALUES:

        def other(sheet: SecurityTeds, field: int = field) -> SecurityTeds:
            return replace(sheet, values={**sheet.values, field: 9})

        seen = _refused_commit(probe, Reason.BAD_FORM, f"field {field} with 9", other)
    return seen


@rule("commit-uuid", "Writing to flash", Stage.COMMIT)
def commit_uuid(probe: Probe) -> str:
    """Check that a Meta-TEDS of the 2007 form that names another UUID gets 9."""
    meta = (0, 1)
    if TedsStatus.decode(probe.good(query_teds(*meta))).attributes & Attribute.READ_ONLY:
        raise NotApplicableError("The Meta-TEDS of this node is read-only.")
    other = bytes(octet ^ 0x55 for octet in probe.uuid)
    octets = frame(bytes([3, 4, 0, 1, 1, 1, 4, 10]) + other)
    _write(probe, meta, octets)
    listed = stored_blocks(probe) | {meta: octets}
    return _refused_over(probe, Reason.WRONG_UUID, "another UUID", _signed(probe, _sheet(probe, listed)))


@rule("commit-sequence", "Writing to flash", Stage.COMMIT)
def commit_sequence(probe: Probe) -> str:
    """Check that a sequence that is not greater, or greater by more than 65536, gets 7."""
    _refused_commit(probe, Reason.STALE_SEQUENCE, "the stored sequence", lambda s: replace(s, sequence=s.sequence - 1))
    return _refused_commit(
        probe, Reason.STALE_SEQUENCE, "65537 ahead", lambda s: replace(s, sequence=s.sequence + 65536)
    )


@rule("commit-epoch", "Writing to flash", Stage.COMMIT)
def commit_epoch(probe: Probe) -> str:
    """Check that a KeyEpoch other than the node's, later or earlier, gets 8, after the sequence."""
    _refused_commit(probe, Reason.WRONG_EPOCH, "an epoch ahead", lambda s: replace(s, key_epoch=s.key_epoch + 1))
    return _refused_commit(
        probe, Reason.WRONG_EPOCH, "an epoch behind", lambda s: replace(s, key_epoch=max(0, s.key_epoch - 1))
    )


@rule("commit", "Writing to flash", Stage.COMMIT)
def commit(probe: Probe) -> str:
    """Check that a good datasheet is committed whole and read back.

    The next, without the TEDS of the test, removes it.
    """
    block, stored, before = absent(probe), stored_blocks(probe), probe.identity()
    for blocks in (stored | {block: _example(block)}, stored):
        octets = _signed(probe, _sheet(probe, blocks))
        for block_id in set(blocks) - set(stored):
            _write(probe, block_id, blocks[block_id])
        _write(probe, SECURITY, octets)
        reply = probe.sealed(update_teds(*SECURITY))
        if not reply.ok:
            slip = _slip_of_commit(probe, reply.reason, blocks)
            raise RuleBrokenError(
                f"{describe_command(update_teds(*SECURITY))}, sealed: success is due, {describe_reply(reply)} came.",
                slip,
            )
        holds(probe.teds(SECURITY) == octets, "After the commit Read gives another Security TEDS.")
        holds(stored_blocks(probe) == blocks, "After the commit the node holds other TEDS than were signed.")
    after = probe.identity()
    text = f"After a commit Identify says {after.state.name.lower()}; provisioned is due."
    holds(after.state == NodeState.PROVISIONED, text)
    holds(
        after.sequence == before.sequence + 2,
        f"Sequence went from {before.sequence} to {after.sequence} with two commits.",
    )
    probe.close()
    return f"two commits, sequence {after.sequence}, read back"


def _slip_of_commit(probe: Probe, reason: int | None, blocks: dict[BlockId, bytes]) -> Slip | None:
    """Return the slip by which a node that refuses a good datasheet with 5 or 6 verifies it; each is tried in turn.

    None if it accepts the right one now, or one that no slip explains: then none of these is the fault.
    """
    probe.close()
    stored = stored_blocks(probe)
    new = {block: teds for block, teds in blocks.items() if block not in stored}

    def takes(octets: bytes) -> bool:
        for block, teds in new.items():
            _write(probe, block, teds)
        _write(probe, SECURITY, octets)
        taken = probe.sealed(update_teds(*SECURITY)).ok
        probe.close()
        return taken

    def listing(listed: dict[BlockId, bytes]) -> bytes:
        return _signed(probe, replace(_sheet(probe, blocks), signed_blocks=dict(sorted(listed.items()))))

    tries: list[tuple[Slip, bytes]] = []
    nonsense = b""
    if reason == Reason.BAD_SIGNATURE:
        block = _sheet(probe, blocks).block()
        tries = [(slip, _signed_block(probe, block, message)) for slip, message in slips.datasheets(probe.uuid, block)]
        nonsense = _signed_block(probe, block, b"no datasheet")
    if reason == Reason.DIGEST_MISMATCH and blocks:  # with no blocks, all slips below give the correct datasheet
        cuts = {
            "digest-of-data-block": (slice(4, -2), "the digests of field 108 are over data blocks only"),
            "digest-without-length": (slice(4, None), "the digests of field 108 leave out Length"),
            "digest-without-checksum": (slice(0, -2), "the digests of field 108 leave out Checksum"),
        }
        for name, (part, words) in cuts.items():
            listed = {block: hashlib.sha256(teds[part]).digest() for block, teds in blocks.items()}
            tries.append((Slip(name, words + "; they are from Length to Checksum"), listing(listed)))
        nonsense = listing({block: bytes(32) for block in blocks})
    if not tries or takes(_signed(probe, _sheet(probe, blocks))) or takes(nonsense):
        return None
    return next((slip for slip, octets in tries if takes(octets)), None)


# -- the way back ------------------------------------------------------------------------------------------------------


@rule("reset", "Reset", Stage.RESET)
def reset(probe: Probe) -> str:
    """Check that Reset in a session erases key and trust, with proof; epoch and sequence stay, sessions end."""
    before, stored, challenge = probe.identity(), stored_blocks(probe), os.urandom(CHALLENGE_OCTETS)
    probe.sealed_refused(security_command(Function.RESET, challenge[1:]), Reason.BAD_FORM, "a challenge of 31 octets")
    proof = probe.sealed_good(security_command(Function.RESET, challenge))
    probe.session = None
    require_reset_proof(probe, before.epoch, challenge, proof)
    after = probe.identity()
    holds(after.state == NodeState.FACTORY, f"After Reset the node is {after.state.name.lower()}.")
    kept = (after.epoch, after.sequence) == (before.epoch, before.sequence)
    holds(
        kept, f"Reset took epoch {before.epoch} and sequence {before.sequence} to {after.epoch} and {after.sequence}."
    )
    holds(not probe.security().signed, "After Reset the node still shows a signed Security TEDS.")
    holds(stored_blocks(probe) == stored, "After Reset the other TEDS of the node are not what they were.")
    security_state(probe)
    return f"factory, epoch {after.epoch} and sequence {after.sequence} kept"


@rule("reset-forgets", "Reset", Stage.RESET)
def reset_forgets(probe: Probe) -> str:
    """Check that after a reset the first owner wins again: a Request with another CA is answered, nothing is sealed."""
    tapped_or_bus(probe)
    if probe.identity().state != NodeState.FACTORY:
        raise NotApplicableError("The node was not reset.")
    probe.refused(security_command(Function.SEALED, bytes(36)), Reason.WRONG_STATE)
    probe.good(request(StrangerStation.make().request()))
    return "a Request of another owner is answered"
