"""The signed receipt of a handover: it reports the outcome of a bundle to its sender.

Compact JWS, ``typ`` ``teds-receipt+jws``. ``from`` is the station that took the keys in and signs, ``to`` the one that
sent the bundle: a receipt is a separate message.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.limits import check_size
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.strict_json import Members, dump, load_object, time_text
from teds_provision.protocol.keys import PrivateKey, fingerprint

FORMAT = "teds-receipt/1"
TYPE = "teds-receipt+jws"
MAX_RECEIPT_OCTETS = 64 * 1024 * 1024


@dataclass(frozen=True)
class RefusedNode:
    """A node (UUID, 10 octets) that was not taken in, and why."""

    uuid: bytes
    why: str


@dataclass(frozen=True)
class Receipt:
    """``id`` and ``bundle_sha256`` are those of the bundle; ``sender`` signs, ``to`` sent the bundle (fingerprints)."""

    id: str
    bundle_sha256: str
    sender: str
    to: str
    imported: tuple[bytes, ...]
    refused: tuple[RefusedNode, ...]
    created: datetime


def seal_receipt(receipt: Receipt, signer: PrivateKey) -> bytes:
    """Sign a receipt; return the octets of the file. Raises BadDataError if ``sender`` is not the signer."""
    if receipt.sender != fingerprint(signer.point):
        raise BadDataError("The receipt names another sender than the key that signs it.")
    members = {
        "format": FORMAT,
        "id": receipt.id,
        "bundle_sha256": receipt.bundle_sha256,
        "from": receipt.sender,
        "to": receipt.to,
        "imported": [uuid.hex() for uuid in receipt.imported],
        "refused": [{"uuid": node.uuid.hex(), "why": node.why} for node in receipt.refused],
        "created": time_text(receipt.created),
    }
    return jose.sign_compact(dump(members), signer, typ=TYPE)


def open_receipt(octets: bytes, trusted: Callable[[str], bytes | None]) -> Receipt:
    """Check a receipt; whether it answers a bundle of ours is for the caller to compare (id, digest, to).

    White space around it (an editor's last line) does no harm. Raises NotAuthenticError, PolicyError or BadDataError.
    """
    check_size(len(octets), MAX_RECEIPT_OCTETS, "the receipt")
    verified = jose.verify_compact(octets.strip(), trusted, typ=TYPE, max_octets=MAX_RECEIPT_OCTETS)
    members = Members(load_object(verified.payload, "The receipt"), "The receipt")
    if members.get("format") != FORMAT:
        raise BadDataError(f"The receipt's format is not {FORMAT}.")
    receipt = Receipt(
        id=members.random_id("id"),
        bundle_sha256=members.sha256("bundle_sha256"),
        sender=members.sha256("from"),
        to=members.sha256("to"),
        imported=tuple(Members({"uuid": uuid}, "The receipt").uuid("uuid") for uuid in members.list_of("imported")),
        refused=tuple(_refused(node) for node in members.list_of("refused")),
        created=members.time("created"),
    )
    if receipt.sender != verified.kid:
        raise NotAuthenticError("The receipt names another sender than the one who signed it.")
    uuids = [*receipt.imported, *(node.uuid for node in receipt.refused)]
    if len(set(uuids)) != len(uuids):
        raise BadDataError("The receipt names an UUID twice.")
    return receipt


def _refused(value: object) -> RefusedNode:
    members = Members(value, "A refused node of the receipt")
    return RefusedNode(members.uuid("uuid"), members.text("why"))
