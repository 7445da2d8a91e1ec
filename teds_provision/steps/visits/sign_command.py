"""The ``sign`` command's work: which image, against what the node has, guarded, with the changes in physical terms."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from teds_provision.errors import NotFound, PolicyRefused, UsageFailure
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SEQUENCE_WINDOW
from teds_provision.station.station import Station
from teds_provision.steps.agree import require_session
from teds_provision.steps.build_order import guard
from teds_provision.steps.read import survey
from teds_provision.steps.sign import Signed, known_image, known_node_keys, sign
from teds_provision.steps.visits.visit import node_or_image
from teds_provision.store import Draft
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.meeting import meet
from teds_provision.talk.progress import Reporter
from teds_provision.teds.codec import security
from teds_provision.teds.diff import diff_blocks
from teds_provision.teds.image import SECURITY, BlockId, Image


@dataclass(frozen=True)
class SignOrder:
    """What to sign: ``image`` (None: the draft of ``uuid``); ``accept_calibration`` as at build; or only the plan."""

    uuid: bytes
    image: Image | None = None
    accept_calibration: str | None = None
    dry_run: bool = False


@dataclass(frozen=True)
class SignDone:
    """The signed image (for a dry run: of the plan, unsigned), and what changes, a sentence each."""

    signed: Signed
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
) -> SignDone:
    """Sign the draft of the node that ``what`` names, or an image file; ``read_node``: against the node itself.

    ``output`` is where the caller will write the image: an image file needs one. Raises UsageFailure, and what
    :func:`sign_image` raises.
    """
    found = node_or_image(station, what)
    image = found if isinstance(found, Image) else None
    if image is not None and output is None and not dry_run:
        raise UsageFailure("Signing an image file needs a place for the result.", hint="Add --output IMAGE.")
    uuid = image.uuid if image is not None else station.nodes.resolve(what)
    order = SignOrder(uuid, image, accept_calibration, dry_run)
    if not dry_run:
        station.policy.require_whitelisted(uuid)
        station.unlock()
    if not read_node:
        return sign_image(station, order, None)
    with meet(station, links.after_agreeing(), uuid, reporter) as node, station.turn(uuid):
        return sign_image(station, order, node)


def sign_image(station: Station, order: SignOrder, node: Conversation | None) -> SignDone:
    """Sign the draft or image of one node; with ``node`` against what it has, in a session, else as last known.

    An image file that was built at another station brings the node's epoch and sequence in its Security TEDS, as that
    station knew them; what this one knows counts where it is newer.

    Where nothing lies ready, what the node was last read to have is signed: nothing to do, if it still holds. Raises
    NotFound (nothing built, key unknown), BadData, PolicyRefused (guard), NotWhitelisted.
    """
    uuid = order.uuid
    station.policy.require_whitelisted(uuid)
    draft = station.nodes.draft(uuid)
    known = known_image(station, uuid)
    image = order.image or (draft.image if draft is not None else known)
    if image is None or not image.unsigned_blocks():
        raise NotFound(f"Nothing is built for node {uuid.hex()}.", hint=f"Build it: teds-provision build {uuid.hex()}")
    present = _last_known(station, uuid, known, order.image) if node is None else _read_now(station, node, order)
    image, has = present.completing(image), present.image
    keys = known_node_keys(station, uuid, has or image)
    guard(station, image, has, order.accept_calibration, record=not order.dry_run)
    changes = diff_blocks(has.unsigned_blocks() if has else {}, image.unsigned_blocks())
    told = tuple(change.text for change in changes)
    if order.dry_run:
        return SignDone(Signed(image, present.sequence, reused=False), told)
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
    return SignDone(signed, told)


@dataclass(frozen=True)
class _Present:
    """What the node has: as last known, or (``read``) as it was read now. ``read_only`` blocks cannot be replaced."""

    image: Image | None
    epoch: int
    sequence: int
    read_only: Collection[BlockId] = ()
    read: bool = False

    def completing(self, image: Image) -> Image:
        """The image with the read-only blocks of the node that it leaves out: they stay on the node and are signed."""
        if self.image is None:
            return image
        keep = {block: self.image.blocks[block] for block in self.read_only if block not in image.blocks}
        return Image(self.image.uuid, {**image.blocks, **keep})

    def security_for(self, image: Image) -> bytes | None:
        """The node's Security TEDS, where its signature may be used again for ``image``.

        Not where the node was read to hold something else than it was signed for: it takes ``image`` only under a
        newer sequence.
        """
        if self.image is None or (self.read and self.image.unsigned_blocks() != image.unsigned_blocks()):
            return None
        return self.image.security


def _last_known(station: Station, uuid: bytes, known: Image | None, file: Image | None) -> _Present:
    """What the store knows of the node, or the image file that came, where it says more.

    A file is hearsay, so it does not use up the sequence of a node that this station knows: more than a node would take
    at once, it has to be read (``--read-node``).
    """
    record = station.nodes.get(uuid)
    epoch, sequence = station.keys.active_epoch(uuid) or (record.epoch if record else 0), _sequence_of(known)
    if file is None or SECURITY not in file.blocks:
        return _Present(known, epoch, sequence)
    brought = security.decode(file.blocks[SECURITY])
    epoch = max(epoch, brought.key_epoch)
    if brought.signed and brought.station_key == station.point:
        return _Present(known, epoch, sequence)  # this very sequence was given here: the signature may still hold
    highest = max(sequence, record.sequence if record else 0)
    if highest and brought.sequence > highest + SEQUENCE_WINDOW:
        raise PolicyRefused(
            f"The image says sequence {brought.sequence}; the last one known here is {highest}.",
            hint="Nobody vouches for that. Meet the node: sign IMAGE --read-node",
        )
    return _Present(known, epoch, max(sequence, brought.sequence))


def _read_now(station: Station, node: Conversation, order: SignOrder) -> _Present:
    if not order.dry_run:  # opening a session may settle or rotate keys
        require_session(station, node)
    found = survey(node)
    return _Present(found.image, found.identity.epoch, found.identity.sequence, found.read_only, read=True)


def _keep(station: Station, order: SignOrder, signed: Signed, draft: Draft | None) -> None:
    """Keep what was built here, or signed anew, until it is written; with the profile that it was built from.

    An image file that was not built here stays the caller's.
    """
    uuid = order.uuid
    built_here = draft is not None and draft.image.unsigned_blocks() == signed.image.unsigned_blocks()
    if not built_here and (order.image is not None or signed.reused):
        return
    record = station.nodes.get(uuid)
    profile = draft.profile if draft is not None else record.profile if record is not None else None
    with station.durable("sign"):
        station.nodes.keep_draft(Draft(uuid, signed.image, "signed", profile))


def _sequence_of(has: Image | None) -> int:
    """Sequence of the datasheet that the node was last read to have."""
    octets = has.blocks.get(SECURITY) if has is not None else None
    return security.decode(octets).sequence if octets is not None else 0


def _signed_before(image: Image, draft: Draft | None) -> list[bytes]:
    """Security TEDS of the image at hand and of the draft: either may hold the signature that still says the same."""
    images = [image] if draft is None else [image, draft.image]
    return [found.blocks[SECURITY] for found in images if SECURITY in found.blocks]
