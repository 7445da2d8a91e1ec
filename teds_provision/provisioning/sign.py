"""Step 5: sign a datasheet, or find that the signature is still valid (profile.md, "The Security TEDS")."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from teds_provision.errors import BadDataError, FrozenError, NotFoundError, PolicyError, TedsProvisionError
from teds_provision.protocol.datasheet import (
    SignedNodeKey,
    can_be_stored,
    digests,
    passes_own_check,
    sign_datasheet,
    signature_good,
    unsigned_datasheet,
)
from teds_provision.protocol.keys import fingerprint, node_key_good
from teds_provision.provisioning.conversation import Conversation
from teds_provision.station.station import Station
from teds_provision.station.store import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image

LAST_SEQUENCE = 0xFFFFFFFF


@dataclass(frozen=True)
class SignResult:
    """A signed image, and whether its signature is the one that already existed."""

    image: Image
    sequence: int
    reused: bool

    @property
    def signature(self) -> bytes:
        """Field 100, 64 octets."""
        signature = security.decode(self.image.blocks[SECURITY]).signature
        assert signature is not None, "a signed image holds field 100"
        return signature


def node_keys_of(uuid: bytes, security_teds: bytes) -> SignedNodeKey:
    """Return fields 101 and 102 of a Security TEDS; raises BadDataError if 102 is not over this UUID."""
    shown = security.decode(security_teds)
    if not node_key_good(uuid, shown.node_key, shown.node_key_signature):
        raise BadDataError(f"The Security TEDS of {uuid.hex()} belongs to another node (field 102).")
    return SignedNodeKey(uuid, shown.node_key, shown.node_key_signature)


def known_node_keys(station: Station, uuid: bytes, image: Image | None = None) -> SignedNodeKey:
    """Return the node's key and its signature, from the image at hand or the last reading; raises NotFoundError."""
    for source in (image, known_image(station, uuid)):
        if source is not None and source.security is not None:
            keys = node_keys_of(uuid, source.security)
            station.pins.check(uuid, keys.key)
            return keys
    row = station.datasheets.reading(uuid)
    if row is not None and row.node_key is not None and row.node_key_signature is not None:
        if not node_key_good(uuid, row.node_key, row.node_key_signature):
            raise BadDataError(f"The Security TEDS of {uuid.hex()} belongs to another node (field 102).")
        station.pins.check(uuid, row.node_key)
        return SignedNodeKey(uuid, row.node_key, row.node_key_signature)
    raise NotFoundError(
        f"The key of node {uuid.hex()} is not known yet.",
        hint="Identify it first: teds-provision identify",
    )


def known_image(station: Station, uuid: bytes) -> Image | None:
    """Return the image of a node when it was last read, None if it never was."""
    return station.datasheets.datasheet(uuid)


def unsigned_security(station: Station, keys: SignedNodeKey, image: Image) -> bytes:
    """Return the Security TEDS of a built image: everything but the signature, with present sequence and epoch."""
    node = station.nodes.get(keys.uuid)
    return unsigned_datasheet(
        keys,
        station.point,
        station.identity.signature_under(station.keys.ca_of(keys.uuid)),
        digests(image.blocks),
        ca=security.ca_hint(station.name, fingerprint(station.keys.ca_of(keys.uuid))),
        sequence=node.sequence if node else 0,
        key_epoch=node.epoch if node else 0,
    ).encode()


def sign(
    station: Station,
    keys: SignedNodeKey,
    image: Image,
    *,
    epoch: int,
    node_sequence: int,
    on_node: bytes | None = None,
    earlier: Sequence[bytes] = (),
    sequence: int | None = None,
    keep_draft: bool = False,
    profile: str | None = None,
    unit: tuple[str, int] | None = None,
    write_follows: bool = False,
    before: Callable[[], object] = lambda: None,
) -> SignResult:
    """Sign ``image`` for key epoch ``epoch``.

    ``node_sequence`` is the node's, as read in a session (or last known). ``on_node`` is the node's present Security
    TEDS and ``earlier`` those that were signed but perhaps never written: where one says exactly the same by the same
    signer, it is given back. ``sequence`` forces one (steps over more than 65536). ``keep_draft``: the signed image is
    kept, with its ``profile``, until it is written. The new sequence is durable in the store before the signature is
    given to anyone: one that was lost with its process was never seen, and its number may be used again. ``unit``: the
    job and the unit that an office signs for, which its pages say too. ``write_follows``: in a run only the
    node gets it, from :func:`~teds_provision.provisioning.write.write`, which waits for the disk before the signature
    leaves.
    ``before`` is called before a new signature is made; what it raises leaves the sequence as it is.
    """
    for block, teds in image.unsigned_blocks().items():
        if not can_be_stored(block) or not passes_own_check(block, teds):
            raise BadDataError(f"TEDS {block[1]} of channel {block[0]} is damaged: Length, checksum or class is wrong.")
    if sequence is None:
        # What says the same is not signed anew, so a run that is repeated leaves the node as it is. A signature that
        # never arrived is good while its sequence is above the node's: the node takes no other.
        for octets in filter(None, (on_node, *earlier)):
            number = _sequence_if_the_same(station, keys, image, octets, epoch)
            if number is not None and (octets == on_node or number > node_sequence):
                return SignResult(image.with_block(SECURITY, octets), number, reused=True)
    before()
    station.plant.require_role(
        "sign", "cannot sign datasheets", "Have a station sign it that has this role: sign --by OFFICE"
    )
    credentials = station.credentials(keys.uuid)  # may ask for the passphrase: not while the store is held
    with station.durable("sign", more_follows=write_follows):
        known = station.nodes.get(keys.uuid)
        # The store knows of signatures that never reached the node, the node of those by other stations.
        number = max(node_sequence, known.sequence if known else 0) + 1 if sequence is None else sequence
        if number > LAST_SEQUENCE:
            raise PolicyError("This node has no sequence numbers left.")
        unsigned = unsigned_datasheet(
            keys,
            credentials.key.point,
            credentials.station_signature,
            digests(image.blocks),
            ca=security.ca_hint(station.name, fingerprint(credentials.ca)),
            last_modified=_now(),
            sequence=number,
            key_epoch=epoch,
        )
        made = image.with_block(SECURITY, sign_datasheet(unsigned, keys.uuid, credentials))
        station.nodes.remember(keys.uuid, sequence=number)
        if keep_draft:
            station.datasheets.keep_draft(Draft(keys.uuid, made, "signed", profile))
        digest = hashlib.sha256(made.blocks[SECURITY]).hexdigest()
        of_unit = {} if unit is None else dict(zip(("job", "unit"), unit, strict=True))
        station.plant.record_event("signed", keys.uuid, epoch=epoch, sequence=number, teds_sha256=digest, **of_unit)
        station.audit("sign", keys.uuid, "done", sequence=number, epoch=epoch, teds=image.digest())
    if write_follows:
        station.run_in_background(station.flush)
    return SignResult(made, number, reused=False)


def require_not_measured(
    station: Station, node: Conversation, *, released: bool = False, undone: str = "Nothing was signed or written."
) -> None:
    """Raise FrozenError if a command of this station measures the node: it would refuse what is about to be signed.

    ``released``: the running `ncap` measured the node and let it go. A write at the reader ends the claims of sensors.
    """
    holder = None if released or node.tapped else station.measurements.holder(node.uuid)
    if holder is not None:
        raise FrozenError(
            f"Node {node.uuid.hex()} is being measured by {holder}. {undone}",
            hint="End that measurement first.",
        )


def _sequence_if_the_same(station: Station, keys: SignedNodeKey, image: Image, octets: bytes, epoch: int) -> int | None:
    """Return the sequence of a Security TEDS that matches this image: content, epoch and signer unchanged."""
    try:
        found = security.decode(octets)
    except BadDataError:
        return None
    ca = station.keys.ca_of(keys.uuid)
    same = (
        found.signed
        and (found.node_key, found.node_key_signature) == (keys.key, keys.signature)
        and (found.station_key, found.station_key_signature) == (station.point, station.identity.signature_under(ca))
        and found.ca == security.ca_hint(station.name, fingerprint(ca))
        and found.key_epoch == epoch
        and found.signed_blocks == digests(image.blocks)
        and signature_good(found, octets, keys.uuid)
    )
    return found.sequence if same else None


def _now() -> bytes:
    """Return the TimeInstance of now: u32 s, u32 ns, UTC; raises TedsProvisionError if no u32 holds it."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    if not 0 <= seconds < 1 << 32:
        raise TedsProvisionError("This machine's clock is wrong.", hint="Set it; see: teds-provision doctor")
    return seconds.to_bytes(4, "big") + nanoseconds.to_bytes(4, "big")
