"""Step 6: stage every TEDS, commit, read back, compare (profile.md, "Writing to flash").

First the charge of the node is checked (``charge.py``).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from types import MappingProxyType

from teds_provision.errors import (
    BadDataError,
    GarbledError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
)
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SEQUENCE_WINDOW
from teds_provision.protocol.messages.frames import Reason, update_teds, write_teds
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.board_type import differences, is_remembered, shown_by
from teds_provision.provisioning.build import own_name, profile_files_digest, require_free_name
from teds_provision.provisioning.charge import Low, require_charge, wait_for_charge
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.firmware import keep_firmware, read_firmware
from teds_provision.provisioning.image_file import read_image_file
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.readings import is_known, keep, keep_read
from teds_provision.provisioning.sign import node_keys_of, sign
from teds_provision.provisioning.teds_read import NodeSnapshot, read_block, read_identity, read_image
from teds_provision.provisioning.verify import freshness_floor_of
from teds_provision.provisioning.visit import at_node
from teds_provision.station.firmware import FirmwareReading
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId, Image

WRITE_OVERHEAD = 53
_STARTS = 3
_LOSSES = 20
_SMALLEST_PIECE = 48

Progress = Callable[[int, int], None]
"""``progress(octets written, octets to write)``."""


@dataclass(frozen=True)
class WriteResult:
    """Result of a write: octets staged (0 if the node had it all), seconds, and what was read back."""

    octets: int
    seconds: float
    on_node: Image


def write(
    station: Station,
    node: Conversation,
    image: Image,
    *,
    present: NodeSnapshot | None = None,
    progress: Progress | None = None,
    facts: Mapping[str, object] = MappingProxyType({}),
    jump: bool = False,
    low: Low = wait_for_charge,
) -> WriteResult:
    """Bring a signed image onto the node, inside the open session, and prove by reading that it is there.

    ``present`` is the node's content as read in this session: equal blocks are not sent again. ``facts`` are recorded
    of the node once it is written. Raises NodeRefusedError with the node's reason, PolicyError if the image is older
    than what the node has, or so far ahead that more than one step of 65,536 would be needed without a confirmation
    (``jump``): that irreversibly uses up the sequence of the node; if ``low`` rejects the node's charge.
    NotAuthenticError if the read-back differs.
    """
    started = time.monotonic()
    signed = security.decode(image.blocks[SECURITY])
    if not signed.signed:
        raise BadDataError("The image is not signed.", hint="Sign it first: teds-provision sign UUID")
    has = present.image if present is not None else None
    if (has.security if has is not None else read_block(node, SECURITY)) == image.security:
        has = has or read_image(node)
        if all(has.blocks.get(block) == image.blocks[block] for block in image):
            if not is_known(station, node, has):
                floor = freshness_floor_of(station, image.uuid, node.proven or read_identity(node))
                with station.durable("write", more_follows=True):
                    keep(station, node, has, by="write", floor=floor)
            return WriteResult(0, time.monotonic() - started, has)
    identity, firmware = node.proven or read_identity(node), read_firmware(node)
    _require_newer(station, image.uuid, signed, identity, jump=jump)
    require_charge(node, low)
    octets = 0
    for step in range(identity.sequence + SEQUENCE_WINDOW, signed.sequence, SEQUENCE_WINDOW):
        keys = node_keys_of(image.uuid, image.blocks[SECURITY])
        between = sign(station, keys, image, epoch=identity.epoch, node_sequence=0, sequence=step).image
        octets += _commit(station, node, between, has, progress)
        has = between
    octets += _commit(station, node, image, has, progress)
    node.proven = replace(identity, sequence=signed.sequence, state=NodeState.PROVISIONED)
    c = node.open_counter
    back = read_image(node, listed=_after_commit(image, has if present is not None else None))
    _conclude(station, node, image, back, facts, c=c, octets=octets, sequence=signed.sequence, firmware=firmware)
    return WriteResult(octets, time.monotonic() - started, back)


def _after_commit(image: Image, read: Image | None) -> Iterable[BlockId] | None:
    """Return the TEDS that a node has after the commit of ``image``; None if it has to be asked.

    ``read`` is what it was read to have before, in the same session. Only a commit changes that: it puts in what the
    image has, and nothing was there that the image has not. The Security TEDS, which is read back, is another one if
    another station committed meanwhile.
    """
    if read is None or read.blocks.keys() - image.blocks.keys():
        return None
    return image


def _report_written(station: Station, image: Image, known: NodeRecord, sequence: int) -> None:
    """Report to the plant which datasheet the node has now, and its origin."""
    octets = image.security
    if station.plant.joined is not None and octets is not None:
        station.plant.record_event(
            "written",
            image.uuid,
            epoch=security.decode(octets).key_epoch,
            sequence=sequence,
            teds_sha256=hashlib.sha256(octets).hexdigest(),
            profile=PurePath(known.profile).name if known.profile else None,  # the name of a file, without its path
            profile_sha256=profile_files_digest(station, known),
            due=known.due,
        )


def _conclude(
    station: Station,
    node: Conversation,
    image: Image,
    back: Image,
    facts: Mapping[str, object],
    *,
    c: bytes | None,
    octets: int,
    sequence: int,
    firmware: FirmwareReading | None,
) -> None:
    """Record what was read back; raises NotAuthenticError if it is not what was written."""
    differing = [block for block in image if back.blocks.get(block) != image.blocks[block]]

    identity, profile = node.proven, facts.get("profile")
    named = profile if isinstance(profile, str) else None
    c = (c or node.open_counter) if node.sealed else None

    def record() -> None:  # does not use the node, so the next message may already be on its way
        with station.durable("write", more_follows=True):
            keep_read(
                station, back, c, by="write", floor=freshness_floor_of(station, image.uuid, identity), profile=named
            )
            if differing:
                station.audit("write", image.uuid, "read-back differs", block=list(differing[0]))
            else:
                known = station.nodes.remember(image.uuid, **facts)
                keep_firmware(station, image.uuid, firmware, signed=True)
                _report_written(station, image, known, sequence)
                # The draft is on the node now, so drop it; a newer draft remains.
                draft = station.datasheets.draft(image.uuid)
                if draft is not None and draft.image.unsigned_blocks() == image.unsigned_blocks():
                    station.datasheets.drop_draft(image.uuid)
                station.audit("write", image.uuid, "done", octets=octets, sequence=sequence)

    station.run_in_background(record)  # meanwhile, the next verification asks the node to prove its key
    if differing:
        channel, access_code = differing[0]
        raise NotAuthenticError(
            f"TEDS {access_code} of channel {channel} reads back differently from what was written.",
            hint="Try again. If the error persists, the board's flash is defective.",
        )


def _again(station: Station, uuid: bytes) -> str:
    """Return how this station gets the image signed for the node as it is now."""
    roster = station.plant.roster
    if roster is not None and not roster.has(station.fingerprint, "sign"):
        return f"Have it signed again: teds-provision sign {uuid.hex()} --by OFFICE --job ID"
    return f"Sign it again for the node as it is now: teds-provision sign {uuid.hex()} --read-node"


def _require_newer(station: Station, uuid: bytes, signed: SecurityTeds, identity: Identity, *, jump: bool) -> None:
    if signed.sequence <= identity.sequence:
        raise PolicyError(
            f"The image has sequence {signed.sequence}; the node is already at {identity.sequence}.",
            hint=_again(station, uuid),
        )
    if signed.key_epoch != identity.epoch:
        raise PolicyError(
            f"The image was signed for key epoch {signed.key_epoch}; the node is at {identity.epoch}.",
            hint=_again(station, uuid),
        )
    if signed.sequence > identity.sequence + SEQUENCE_WINDOW and not jump:
        raise PolicyError(
            f"The image has sequence {signed.sequence}, far ahead of the node's {identity.sequence}: earlier"
            " data about this node may have been forged.",
            hint=f"{_again(station, uuid)}. Or, if you know why: write UUID --sequence-jump --yes",
        )


def _commit(station: Station, node: Conversation, image: Image, has: Image | None, progress: Progress | None) -> int:
    """Stage what is not there yet and commit; starts over if the session (and the staging with it) is lost."""
    skip = _blocks_there(station, image, has)
    for _ in range(_STARTS - 1):
        try:
            return _stage_and_commit(station, node, image, skip, progress)
        except NodeRefusedError as refusal:
            if refusal.reason != Reason.DIGEST_MISMATCH or not skip:
                raise
            skip = set()  # the stored image of the node is out of date: send all blocks
            continue
        except (NodeSilentError, GarbledError):
            if not node.is_alive():
                raise
        except SessionLostError:
            pass  # the new session below shows whether only the reply was lost
        if _is_there(node, image):
            return 0
    try:
        return _stage_and_commit(station, node, image, skip, progress)
    except SessionLostError as lost:
        raise lost.cause from lost


def _stage_and_commit(
    station: Station, node: Conversation, image: Image, skip: set[BlockId], progress: Progress | None
) -> int:
    octets = _stage(station, node, image, skip, progress)
    node.request(update_teds(*SECURITY), "the commit")
    return octets


def _blocks_there(station: Station, image: Image, has: Image | None) -> set[BlockId]:
    """Return the blocks that need not be sent; the Security TEDS is always sent, as it is what is committed."""
    has = has or station.datasheets.datasheet(image.uuid)
    if has is None:
        return set()
    return {block for block in image if block != SECURITY and has.blocks.get(block) == image.blocks[block]}


def _is_there(node: Conversation, image: Image) -> bool:
    """Return True, in a new session, if the commit happened and only its reply was lost."""
    node.reopen()
    return read_block(node, SECURITY) == image.security


def _stage(station: Station, node: Conversation, image: Image, skip: set[BlockId], progress: Progress | None) -> int:
    """Write every block but those of ``skip`` into the node's staging; return the octets written.

    The Security TEDS is the last (profile.md, "Writing to flash"): a node that cannot rewind may count on it, and the
    others are sent while the sequence is written to the disk, for which the signature waits. If frames are lost the
    pieces shrink: on a bad link, short ones arrive while long ones never do.
    """
    piece = node.identity.max_message - WRITE_OVERHEAD
    blocks = [block for block in sorted(image, key=lambda block: block == SECURITY) if block not in skip]
    total = sum(len(image.blocks[block]) for block in blocks)
    done, losses = 0, 0
    for channel, access_code in blocks:
        teds = image.blocks[channel, access_code]
        offset = 0
        if (channel, access_code) == SECURITY:
            station.flush()
        while offset < len(teds):
            part = teds[offset : offset + piece]
            try:
                node.request(write_teds(channel, access_code, offset, part), f"TEDS {access_code} of channel {channel}")
            except (NodeSilentError, GarbledError):
                losses += 1
                if losses > _LOSSES or not node.is_alive():
                    raise
                piece = max(_SMALLEST_PIECE, min(piece, len(part)) // 2)
                continue
            offset += len(part)
            done += len(part)
            if progress is not None:
                progress(done, total)
    return done


@dataclass(frozen=True)
class WriteReport:
    """Result of ``write``; for a dry run ``written`` is None and ``image`` what would be written."""

    image: Image
    written: WriteResult | None


def _wanted(station: Station, uuid: bytes, file: Path | None) -> tuple[Image, dict[str, object]]:
    """Return the signed image to write to a node, and the facts to record once it is written."""
    draft = station.datasheets.draft(uuid)
    profile = draft.profile if draft is not None else None
    facts: dict[str, object] = {}
    if file is not None:
        wanted: Image | None = read_image_file(file)
    elif draft is not None:
        wanted = draft.image
        facts = {"profile": profile} if profile is not None else {}
    else:
        wanted = station.datasheets.datasheet(uuid)
    if wanted is None:
        raise NotFoundError(
            f"Nothing has been built for node {uuid.hex()}.", hint="build and sign it first, or give --image."
        )
    record = station.nodes.get(uuid)
    before = record.profile if profile is None and record is not None else profile
    name = own_name(station, wanted, before)
    if name is not None:
        facts["name"] = name
    if name is not None and draft is not None and file is None and (record is None or record.name != name):
        require_free_name(station, uuid, name)
    if wanted.uuid != uuid:
        raise PolicyError(f"The image is for node {wanted.uuid.hex()}, not for {uuid.hex()}.")
    if wanted.security is None:
        raise BadDataError("The image has no Security TEDS.", hint=f"Sign it first: teds-provision sign {uuid.hex()}")
    return wanted, facts


def plan_write(station: Station, node: str, file: Path | None) -> WriteReport:
    """Return what :func:`write_at` would write, for a dry run; raises what it does before it meets the node."""
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    return WriteReport(_wanted(station, uuid, file)[0], None)


def write_at(
    station: Station,
    links: LinkSettings,
    node: str,
    reporter: Reporter,
    *,
    file: Path | None,
    operator: Operator,
    jump: bool = False,
    retyped: bool = False,
) -> WriteReport:
    """Write a signed image to the node that ``node`` names: of a file, else the draft, else its last reading.

    ``operator`` is asked before a node with a low battery is written, and before a board becomes one of another type
    than it claims, unless it was ``retyped`` by an option. ``jump``: a sequence far ahead of the node's is written.
    Raises NotFoundError (nothing built), BadDataError (not signed), PolicyError (another node's image), as ``write``
    does.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    wanted, facts = _wanted(station, uuid, file)
    if jump:
        operator.jump("This uses up the node's sequence numbers up to that point, permanently. Write it?")
    with at_node(station, links.after_agreeing(), uuid, reporter, writes="write") as visit:
        require_session(station, visit.node)
        if not retyped:
            channels = {channel for channel, _ in wanted}
            changes = differences(shown_by(visit.node, channels), wanted)
            profile = facts.get("profile")
            known = isinstance(profile, str) and is_remembered(station, uuid, profile, factory=False)
            if changes and not known:
                operator.retype(uuid, changes)
        written = write(
            station,
            visit.node,
            wanted,
            progress=reporter.written,
            facts=facts,
            jump=jump,
            low=operator.low_battery,
        )
        return WriteReport(wanted, written)
