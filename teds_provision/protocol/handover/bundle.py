"""The handover bundle: node keys from one base station to others. Pure: no store, no files.

The format is that of profile.md, "Handover between base stations".

:func:`seal_bundle` makes one, :func:`open_bundle` checks all that can be checked without a store, :func:`peek_bundle`
reads what stands in the clear. What remains for whoever holds the store: a known UUID with another node key, an epoch
that would go back, an id that was seen before, a node on the deny list, a receiver that is not yet certified.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from teds_provision.errors import BadData, NotAuthentic, PolicyRefused
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.contents import Bundle, BundledNode, check_rules, from_json, payload_pieces
from teds_provision.protocol.handover.jose import FindKey
from teds_provision.protocol.handover.payload import time_text
from teds_provision.protocol.handover.revocation import Revocation, open_revocations
from teds_provision.protocol.handover.sealing import Sealing, Source, Unsealed, as_file, read_envelope, unseal
from teds_provision.protocol.keys import PrivateKey, fingerprint, is_point, station_key_message, verify

TYPE = "teds-handover+jws"
CONTENT_TYPE = "JWS"
MAX_BUNDLE_OCTETS = 64 * 1024 * 1024
"""More is not read: about 80,000 nodes. Look at the size of a file before reading it."""
_MAX_PAYLOAD_OCTETS = (MAX_BUNDLE_OCTETS - 128 * 1024) // 16 * 9
"""What fits into one: base64url of base64url, after headers of at most 256 recipients."""
CLOCK_TOLERANCE = timedelta(minutes=10)
"""How far a sender's clock may be ahead."""


@dataclass(frozen=True)
class OpenedBundle:
    """A bundle that passed every check but those of the store.

    ``station_signature`` is the CA's over this station's key, None where the bundle brings none; ``revocations`` are
    those of trusted signers, ``unknown_revocations`` counts the others; ``sha256`` is over the octets of the file,
    ``signed_sha256`` over the JWS in it, which nobody on the way can change: receipts name that.
    """

    bundle: Bundle
    sender_key: bytes
    sha256: str
    station_signature: bytes | None
    revocations: tuple[Revocation, ...]
    unknown_revocations: int
    signed_sha256: str


@dataclass(frozen=True)
class BundleHeader:
    """What a bundle shows without a key. Nothing here is authenticated. ``recipients`` are fingerprints, or ""."""

    algorithm: str
    encryption: str
    content_type: str
    recipients: tuple[str, ...]
    octets: int
    sha256: str


def seal_bundle(payload: Bundle, sender: PrivateKey, recipients: Sequence[bytes]) -> bytes:
    """Like :func:`sealing`, whole: the octets of the file."""
    made = sealing(payload, payload.nodes, len(payload.nodes), sender, recipients)
    return b"".join([*made.body(), made.end()])


def sealing(
    payload: Bundle, nodes: Iterable[BundledNode], count: int, sender: PrivateKey, recipients: Sequence[bytes]
) -> Sealing:
    """Sign with ``sender`` and seal to the points ``recipients``; ``count`` nodes come one by one, not in ``payload``.

    Its ``signed_sha256``, the digest of what was signed, is what the receipt will name.

    Raises BadData or PolicyRefused where the payload breaks a rule that :func:`open_bundle` would hold against it.
    """
    if any(not is_point(point) for point in recipients):
        raise BadData("A recipient's key is not a P-256 point.")
    if payload.sender != fingerprint(sender.point):
        raise BadData("The bundle names another sender than the key that signs it.")
    if sorted(payload.to) != sorted(map(fingerprint, recipients)):
        raise BadData("The bundle names other recipients than the keys that it is sealed to.")
    check_rules(payload)
    for point in recipients:
        _station_signature(payload, point)
    pieces = payload_pieces(payload, nodes, count)
    return Sealing(_within(pieces, count), sender, recipients, typ=TYPE, cty=CONTENT_TYPE)


def _within(pieces: Iterable[bytes], count: int) -> Iterator[bytes]:
    """Pieces of a payload; raises BadData where the bundle becomes longer than a reader takes."""
    octets = 0
    for piece in pieces:
        octets += len(piece)
        if octets > _MAX_PAYLOAD_OCTETS:
            raise BadData(f"{count} nodes are too many for one bundle.", hint="Export them in groups.")
        yield piece


def open_bundle(
    source: Source,
    recipient: PrivateKey,
    trusted: FindKey,
    now: datetime | None,
    *,
    max_octets: int = MAX_BUNDLE_OCTETS,
) -> OpenedBundle:
    """Open a bundle for ``recipient``; ``trusted`` gives the point of a trusted station by its fingerprint.

    Without ``now`` its times are left to :func:`check_times`: one that was taken in before gives its receipt again.

    Raises PolicyRefused (not for this station, expired, dated in the future, algorithm), NotAuthentic (unknown sender,
    signature, tag, SIG104, kid of a key) or BadData (form, ranges, count, an UUID twice).
    """
    bundle, opened = _opened(source, recipient, trusted, max_octets)
    if fingerprint(recipient.point) not in bundle.to:
        raise PolicyRefused("The bundle does not name this station as a receiver, though it is sealed to it.")
    if now is not None:
        check_times(bundle, now)
    revocations, unknown = open_revocations(bundle.revoked, trusted)
    return OpenedBundle(
        bundle,
        opened.signer,
        opened.sha256,
        _station_signature(bundle, recipient.point),
        revocations,
        unknown,
        opened.signed_sha256,
    )


def check_times(bundle: Bundle, now: datetime) -> None:
    """Raise PolicyRefused for a bundle that has expired, or that was made in the future."""
    if bundle.created > now + CLOCK_TOLERANCE:
        raise PolicyRefused(
            f"The bundle was made in the future ({time_text(bundle.created)}).", hint="Compare both stations' clocks."
        )
    if now >= bundle.expires:
        raise PolicyRefused(
            f"The bundle expired at {time_text(bundle.expires)}.", hint="Ask the sender to export it again."
        )


def peek_bundle(source: Source) -> BundleHeader:
    """Read the header and the recipients of a bundle without any key; raises BadData."""
    envelope = read_envelope(as_file(source), MAX_BUNDLE_OCTETS)
    header = jose.header_of(envelope.document)
    return BundleHeader(
        header.algorithm,
        header.encryption,
        header.content_type,
        header.recipients,
        envelope.octets,
        envelope.sha256,
    )


def _opened(source: Source, recipient: PrivateKey, trusted: FindKey, max_octets: int) -> tuple[Bundle, Unsealed]:
    """Unseal, verify and read; each form of the payload is let go as soon as the next one is there."""
    opened = unseal(source, recipient, trusted, typ=TYPE, cty=CONTENT_TYPE, max_octets=max_octets)
    bundle = from_json(opened.payload)
    if bundle.sender != opened.kid:
        raise NotAuthentic("The bundle names another sender than the one who signed it.")
    return bundle, opened


def _station_signature(bundle: Bundle, station: bytes) -> bytes | None:
    """SIG104 over ``station``, verified; None where there is none."""
    signature = bundle.station_signatures.get(fingerprint(station))
    if signature is not None and not verify(bundle.ca, station_key_message(station), signature):
        raise NotAuthentic("The CA's signature over the receiver's key does not verify under the bundle's CA.")
    return signature
