"""Each command at a node as one call: resolve, unlock, meet, identify, and the step itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from teds_provision.errors import BadData, NodeRefused, NotFound, PolicyRefused, TedsProvisionError, Unproven
from teds_provision.links import LINKS, LinkSettings
from teds_provision.station.station import Station
from teds_provision.steps.address import set_address
from teds_provision.steps.agree import Agreed, agree
from teds_provision.steps.board_type import Retype, differences, is_remembered, refuse, shown_by
from teds_provision.steps.build_order import guard, own_name
from teds_provision.steps.read import read_identity, read_image
from teds_provision.steps.reading import keep
from teds_provision.steps.reset import ResetReceipt, reset_node
from teds_provision.steps.sign import known_image
from teds_provision.steps.verify import Verified, known_of, require_authentic, session, unproven, verify_image
from teds_provision.steps.verify_node import look_at_node, open_or_say_why, vouched
from teds_provision.steps.visits.visit import at_node, node_or_image, read_image_file
from teds_provision.steps.write import Low, Written, wait_for_charge, write
from teds_provision.talk.conversation import HEARD
from teds_provision.talk.progress import Reporter
from teds_provision.teds.image import Image


@dataclass(frozen=True)
class AgreeDone:
    """What ``agree`` did; for a dry run ``agreed`` is None, and ``plan`` says what it would do."""

    uuid: bytes
    agreed: Agreed | None
    plan: str = ""
    held: tuple[str, ...] = ()


def agree_at(
    station: Station,
    links: LinkSettings,
    node: str,
    reporter: Reporter,
    *,
    rotate: bool = False,
    dry_run: bool = False,
    confirm: Callable[[str], object] | None = None,
) -> AgreeDone:
    """Agree on a key with the node that ``node`` names (UUID, prefix, name), or rotate it; see :func:`agree`.

    ``confirm`` is asked where the key came back from a backup and nobody taps the node, and before a node is taken
    over from another station; it raises for a no.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    if dry_run:
        held = tuple(f"{record.state} key of epoch {record.epoch}" for record in station.keys.of(uuid))
        return AgreeDone(uuid, None, ("rotate" if rotate else "keep") if held else "agree on a first key", held)
    if confirm and station.keys.restored(uuid) and rotate and not LINKS[links.via].capabilities.tapped:
        confirm(f"Node {uuid.hex()} is {station.keys.rotation_due(uuid)}. Is it still this station's?")
    with at_node(station, links, uuid, reporter, unlock="always") as visit:
        return AgreeDone(uuid, agree(station, visit.node, visit.who, rotate=rotate, take_over=confirm))


@dataclass(frozen=True)
class AddressDone:
    """A node's CAN address; ``changed`` None for a dry run."""

    uuid: bytes
    changed: bool | None


def set_address_at(
    station: Station, links: LinkSettings, node: str, address: int, reporter: Reporter, *, dry_run: bool = False
) -> AddressDone:
    """Give the node that ``node`` names another CAN address; see :func:`set_address`."""
    uuid = station.nodes.resolve(node)
    if dry_run:
        return AddressDone(uuid, None)
    with at_node(station, links, uuid, reporter) as visit:
        return AddressDone(uuid, set_address(station, visit.node, address))


@dataclass(frozen=True)
class ReadDone:
    """Every TEDS of a node; ``error`` is Unproven where a key is held here and nothing shows who said it."""

    image: Image
    error: Unproven | None


def read_at(station: Station, links: LinkSettings, node: str, reporter: Reporter) -> ReadDone:
    """Read every TEDS of the node that ``node`` names, in a session where this station holds its key."""
    uuid = station.nodes.resolve(node)
    with at_node(station, links.after_agreeing(), uuid, reporter) as visit:
        why = open_or_say_why(station, visit.node)
        c = visit.node.c
        image = read_image(visit.node)
        check = vouched(visit.node, visit.who.point, why)
        if visit.node.sealed:
            known = known_of(station, uuid, visit.node.proven or read_identity(visit.node))
            with station.durable("read"):
                keep(station, visit.node, image, by="read", known=known, c=c)
        return ReadDone(image, unproven(uuid, check.why) if check.result == "failed" else None)


def reset_at(station: Station, links: LinkSettings, uuid: bytes, reporter: Reporter) -> ResetReceipt:
    """Reset a node; see :func:`reset_node`."""
    with at_node(station, links, uuid, reporter) as visit:
        return reset_node(station, visit.node, visit.who)


@dataclass(frozen=True)
class VerifyDone:
    """All checks of a node or an image, warnings, and the error that the verification ends with, None for none."""

    verified: Verified
    warnings: tuple[str, ...]
    error: TedsProvisionError | None


def verify_at(
    station: Station,
    links: LinkSettings,
    what: str,
    reporter: Reporter,
    *,
    accept_calibration: str | None = None,
    node: bool = False,
) -> VerifyDone:
    """Check the image file, or the node, that ``what`` names; with ``node`` a node's name goes first.

    ``error``: NotAuthentic (4), Unproven (5), or PolicyRefused (6) for a calibration that would hurt.
    """
    found = node_or_image(station, what, node=node)
    if isinstance(found, Image):
        image, verified = found, Verified(found.uuid, tuple(verify_image(station, found)), scope="image")
    else:
        in_session = False
        try:
            with at_node(station, links.after_agreeing(), found, reporter) as visit:
                try:
                    looked = look_at_node(station, visit.node, visit.who)
                finally:
                    in_session = visit.node.sealed
            image, verified = looked.image, looked.verified
        except NodeRefused as refusal:  # outside a session anyone may have sent it: it decides nothing
            if in_session or not station.keys.held(found) or station.policy.tombstone(found) is not None:
                raise
            station.audit("verify", found, "unproven", why=refusal.message)
            why = refusal.message.removeprefix(HEARD).rstrip(".")
            image, verified = Image(found, {}), Verified(found, (session("", why),))
    try:
        require_authentic(verified)
        return VerifyDone(verified, guard(station, image, None, accept_calibration), None)
    except TedsProvisionError as error:
        return VerifyDone(verified, (), error)


@dataclass(frozen=True)
class WriteDone:
    """What ``write`` did; for a dry run ``written`` is None and ``image`` what would be written."""

    image: Image
    written: Written | None


def _wanted(station: Station, uuid: bytes, file: Path | None) -> tuple[Image, dict[str, object]]:
    """The signed image to write to a node, and what is remembered of the node once it is written."""
    draft = station.nodes.draft(uuid)
    profile = draft.profile if draft is not None else None
    facts: dict[str, object] = {}
    if file is not None:
        wanted: Image | None = read_image_file(file)
    elif draft is not None:
        wanted = draft.image
        facts = {"profile": profile} if profile is not None else {}
    else:
        wanted = known_image(station, uuid)
    if wanted is None:
        raise NotFound(f"Nothing is built for node {uuid.hex()}.", hint="build and sign it first, or give --image.")
    name = own_name(station, wanted, profile)
    if name is not None:
        facts["name"] = name
    if wanted.uuid != uuid:
        raise PolicyRefused(f"The image is for node {wanted.uuid.hex()}, not for {uuid.hex()}.")
    if wanted.security is None:
        raise BadData("The image holds no Security TEDS.", hint=f"Sign it first: teds-provision sign {uuid.hex()}")
    return wanted, facts


def write_at(
    station: Station,
    links: LinkSettings,
    node: str,
    reporter: Reporter,
    *,
    file: Path | None,
    dry_run: bool = False,
    jump: Callable[[str], object] | None = None,
    low: Low = wait_for_charge,
    retype: Retype | None = None,
    retyped: bool = False,
) -> WriteDone:
    """Write a signed image to the node that ``node`` names: of a file, else the draft, else what it was read to have.

    ``jump`` is asked before a sequence far ahead of the node's is written, and raises for a no; None: it is refused;
    ``low`` before a node with a low battery is written; ``retype`` before a board becomes one of another type than it
    says it is (None: that is refused), unless it was ``retyped`` by a word.
    Raises NotFound (nothing built), BadData (not signed), PolicyRefused (another node's image), as ``write`` does.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    wanted, facts = _wanted(station, uuid, file)
    if dry_run:
        return WriteDone(wanted, None)
    if jump is not None:
        jump("The sequence of this node is then used up that far, for good. Write it?")
    with at_node(station, links.after_agreeing(), uuid, reporter) as visit:
        visit.session()
        if not retyped:
            channels = {channel for channel, _ in wanted}
            told = differences(shown_by(visit.node, channels), wanted)
            profile = facts.get("profile")
            known = isinstance(profile, str) and is_remembered(station, uuid, profile, factory=False)
            if told and not known:
                (retype or refuse)(uuid, told)
        far = jump is not None
        written = write(station, visit.node, wanted, progress=reporter.written, facts=facts, jump=far, low=low)
        return WriteDone(wanted, written)
