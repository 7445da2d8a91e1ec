"""Verification before the commit: Update TEDS of access code 128, in their order (profile.md, "Writing to flash")."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace

from teds_provision.protocol import datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import Verify, verify
from teds_provision.protocol.messages.frames import Reason, Refused
from teds_provision.teds.codec import security
from teds_provision.teds.codec.model import AccessCode
from teds_provision.teds.codec.security import NotCanonical, SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId


def _demand(holds: bool, reason: Reason) -> None:
    if not holds:
        raise Refused(reason)


def verified_commit(flash: Flash, staged: Mapping[BlockId, bytes], verify: Verify = verify) -> Flash:
    """Return the state that the commit of ``staged`` leads to; raises Refused with the first check that fails."""
    for block, teds in staged.items():
        _demand(datasheet.passes_own_check(block, teds), Reason.BAD_FORM)
    try:
        signed = security.decode(staged[SECURITY])
    except NotCanonical:
        raise Refused(Reason.BAD_FORM) from None
    _demand(signed.signed, Reason.BAD_FORM)
    _demand(datasheet.own_values(signed), Reason.BAD_FORM)
    own = (flash.node_key, flash.node_key_signature)
    _demand((signed.node_key, signed.node_key_signature) == own, Reason.BAD_SIGNATURE)
    _demand(datasheet.station_signature_good(signed, flash.ca or b"", verify), Reason.BAD_SIGNATURE)
    _demand(datasheet.signature_good(signed, staged[SECURITY], flash.uuid, verify), Reason.BAD_SIGNATURE)
    blocks = _listed_blocks(flash, staged, signed)
    for (_, access_code), teds in blocks.items():
        _demand(access_code != AccessCode.META or datasheet.meta_names(teds, flash.uuid), Reason.WRONG_UUID)
    ahead = signed.sequence - flash.sequence
    _demand(0 < ahead <= datasheet.SEQUENCE_WINDOW, Reason.STALE_SEQUENCE)
    _demand(signed.key_epoch == flash.epoch, Reason.WRONG_EPOCH)
    kept = {block: teds for block, teds in flash.blocks.items() if block in flash.read_only and block not in blocks}
    stored = {**kept, **blocks, SECURITY: staged[SECURITY]}
    return replace(flash, blocks=stored, sequence=signed.sequence, provisioned=True)


def _listed_blocks(flash: Flash, staged: Mapping[BlockId, bytes], signed: SecurityTeds) -> dict[BlockId, bytes]:
    blocks: dict[BlockId, bytes] = {}
    for block, digest in signed.signed_blocks.items():
        teds = staged[block] if block in staged else flash.teds(block)
        if teds is None or hashlib.sha256(teds).digest() != digest:
            raise Refused(Reason.DIGEST_MISMATCH)
        blocks[block] = teds
    _demand(staged.keys() - {SECURITY} <= blocks.keys(), Reason.DIGEST_MISMATCH)
    return blocks
