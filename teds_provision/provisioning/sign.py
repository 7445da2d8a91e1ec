"""Step 5: sign a datasheet, or find that the signature is still valid (profile.md, "The Security TEDS")."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from teds_provision.errors import BadDataError, FrozenError, NotFoundError, PolicyError, TedsProvisionError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import (
    SEQUENCE_WINDOW,
    SignedNodeKey,
    can_be_stored,
    digests,
    passes_own_check,
    sign_datasheet,
    signature_good,
    unsigned_datasheet,
)
from teds_provision.protocol.keys import fingerprint, node_key_good
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.image_file import node_or_image
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.teds_read import NodeSnapshot, take_snapshot
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.diff import diff_blocks
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
    for source in (image, station.datasheets.datasheet(uuid)):
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
    TEDS and ``earlier`` those that were signed but perhaps never written: if one is exactly the same by the same
    signer, it is given back. ``sequence`` forces one (steps over more than 65536). ``keep_draft``: the signed image is
    kept, with its ``profile``, until it is written. The new sequence is durable in the store before the signature
    is returned; a signature that was lost with its process was never used, so its number may be used again. ``unit``:
    the job and the unit that an office signs for, which its pages state too. ``write_follows``: in a run only the
    node gets it, from :func:`~teds_provision.provisioning.write.write`, which waits for the disk before the signature
    leaves.
    ``before`` is called before a new signature is made; what it raises leaves the sequence as it is.
    """
    for block, teds in image.unsigned_blocks().items():
        if not can_be_stored(block) or not passes_own_check(block, teds):
            raise BadDataError(f"TEDS {block[1]} of channel {block[0]} is damaged: Length, checksum or class is wrong.")
    if sequence is None:
        # An equal datasheet is not signed again, so that a repeated run does not change the node. A signature that
        # never reached the node can be used if its sequence is above the node's; the node refuses others.
        for octets in filter(None, (on_node, *earlier)):
            number = _sequence_if_the_same(station, keys, image, octets, epoch)
            if number is not None and (octets == on_node or number > node_sequence):
                return SignResult(image.with_block(SECURITY, octets), number, reused=True)
    before()
    station.plant.require_role(
        "sign", "cannot sign datasheets", "Have a station sign it that has this role: sign --by OFFICE"
    )
    credentials = station.credentials(keys.uuid)  # may ask for the passphrase, so not within the transaction
    with station.durable("sign", more_follows=write_follows):
        known = station.nodes.get(keys.uuid)
        # The store has signatures that never reached the node, and the node may have some by other stations.
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


@dataclass(frozen=True)
class SignOrder:
    """Order to sign ``image`` (None: the draft of ``uuid``); ``accept_calibration`` as at build; or only the plan."""

    uuid: bytes
    image: Image | None = None
    accept_calibration: str | None = None
    dry_run: bool = False


@dataclass(frozen=True)
class SignReport:
    """The signed image (for a dry run: of the plan, unsigned), and what changes, a sentence each."""

    signed: SignResult
    changes: tuple[str, ...]


def sign_at(
    station: Station,
    links: LinkSettings,
    what: str,
    reporter: Reporter,
    *,
    read_node: bool = False,
    accept_calibration: str | None = None,
    dry_run: bool = False,
    output: Path | None = None,
) -> SignReport:
    """Sign the draft of the node that ``what`` names, or an image file; ``read_node``: against the node itself.

    ``output`` is where the caller will write the image: an image file needs one. Raises UsageError, and what
    :func:`sign_image` raises.
    """
    found = node_or_image(station, what)
    image = found if isinstance(found, Image) else None
    if image is not None and output is None and not dry_run:
        raise UsageError("Signing an image file requires an output file.", hint="Add --output IMAGE.")
    uuid = image.uuid if image is not None else station.nodes.resolve(what)
    order = SignOrder(uuid, image, accept_calibration, dry_run)
    if not dry_run:
        station.policy.require_whitelisted(uuid)
        station.unlock()
    if not read_node:
        return sign_image(station, order, None)
    with meet(station, links.after_agreeing(), uuid, reporter) as node, station.node_lock(uuid):
        return sign_image(station, order, node)


def sign_image(station: Station, order: SignOrder, node: Conversation | None) -> SignReport:
    """Sign the draft or image of one node; with ``node`` against what it has, in a session, else as last known.

    An image file that was built at another station has the node's epoch and sequence in its Security TEDS, as that
    station knew them; this station's values count if they are newer.

    Without a draft the node's last reading is signed: nothing to do, if it is still valid. Raises NotFoundError
    (nothing built, key unknown), BadDataError, PolicyError (guard), NotWhitelistedError.
    """
    uuid = order.uuid
    station.policy.require_whitelisted(uuid)
    draft = station.datasheets.draft(uuid)
    known = station.datasheets.datasheet(uuid)
    image = order.image or (draft.image if draft is not None else known)
    if image is None or not image.unsigned_blocks():
        raise NotFoundError(
            f"Nothing has been built for node {uuid.hex()}.", hint=f"To build it: teds-provision build {uuid.hex()}"
        )
    present = _last_known(station, uuid, known, order.image) if node is None else _read_now(station, node, order)
    image, has = present.completing(image), present.image
    keys = known_node_keys(station, uuid, has or image)
    guard(station, image, has, order.accept_calibration, record=not order.dry_run)
    changes = diff_blocks(has.unsigned_blocks() if has else {}, image.unsigned_blocks())
    changed = tuple(change.text for change in changes)
    if order.dry_run:
        return SignReport(SignResult(image, present.sequence, reused=False), changed)
    signed = sign(
        station,
        keys,
        image,
        epoch=present.epoch,
        node_sequence=present.sequence,
        on_node=present.security_for(image),
        earlier=_signed_before(image, draft),
    )
    _keep(station, order, signed, draft)
    return SignReport(signed, changed)


@dataclass(frozen=True)
class _PresentTeds:
    """TEDS of the node: as last known, or (``found``) as read now."""

    image: Image | None
    epoch: int
    sequence: int
    found: NodeSnapshot | None = None

    def completing(self, image: Image) -> Image:
        """Return the image with the read-only blocks of the node that it leaves out, which stay and are signed."""
        if self.found is None:
            return image
        return Image(self.found.image.uuid, {**image.blocks, **self.found.fixed_beside(image.blocks)})

    def security_for(self, image: Image) -> bytes | None:
        """Return the node's Security TEDS, if its signature may be used again for ``image``.

        Not if the node was read to hold something else than it was signed for: it takes ``image`` only under a newer
        sequence.
        """
        if self.image is None or (self.found is not None and self.image.unsigned_blocks() != image.unsigned_blocks()):
            return None
        return self.image.security


def _last_known(station: Station, uuid: bytes, known: Image | None, file: Image | None) -> _PresentTeds:
    """Return the store's facts about the node, or the image file's if they are newer.

    A file is unverified, so it does not use up the sequence of a known node: for a step larger than a node accepts at
    once, it has to be read (``--read-node``).
    """
    record = station.nodes.get(uuid)
    epoch, sequence = station.keys.active_epoch(uuid) or (record.epoch if record else 0), _sequence_of(known)
    if file is None or SECURITY not in file.blocks:
        return _PresentTeds(known, epoch, sequence)
    brought = security.decode(file.blocks[SECURITY])
    epoch = max(epoch, brought.key_epoch)
    if brought.signed and brought.station_key == station.point:
        return _PresentTeds(known, epoch, sequence)  # the sequence was given here, so the signature may still be used
    highest = max(sequence, record.sequence if record else 0)
    if highest and brought.sequence > highest + SEQUENCE_WINDOW:
        raise PolicyError(
            f"The image has sequence {brought.sequence}; the last one known here is {highest}.",
            hint="That number is unverified. Check it against the node: sign IMAGE --read-node",
        )
    return _PresentTeds(known, epoch, max(sequence, brought.sequence))


def _read_now(station: Station, node: Conversation, order: SignOrder) -> _PresentTeds:
    if not order.dry_run:  # opening a session may settle or rotate keys
        require_session(station, node)
    found = take_snapshot(node)
    return _PresentTeds(found.image, found.identity.epoch, found.identity.sequence, found)


def _keep(station: Station, order: SignOrder, signed: SignResult, draft: Draft | None) -> None:
    """Keep what was built here, or signed again, until it is written; with the profile that it was built from.

    An image file that was not built here stays the caller's.
    """
    uuid = order.uuid
    built_here = draft is not None and draft.image.unsigned_blocks() == signed.image.unsigned_blocks()
    if not built_here and (order.image is not None or signed.reused):
        return
    record = station.nodes.get(uuid)
    profile = draft.profile if draft is not None else record.profile if record is not None else None
    with station.durable("sign"):
        station.datasheets.keep_draft(Draft(uuid, signed.image, "signed", profile))


def _sequence_of(has: Image | None) -> int:
    """Return the sequence of the datasheet that the node was last read to have."""
    octets = has.blocks.get(SECURITY) if has is not None else None
    return security.decode(octets).sequence if octets is not None else 0


def _signed_before(image: Image, draft: Draft | None) -> list[bytes]:
    """Return the Security TEDS of the image at hand and of the draft: either signature may still be valid."""
    images = [image] if draft is None else [image, draft.image]
    return [found.blocks[SECURITY] for found in images if SECURITY in found.blocks]
