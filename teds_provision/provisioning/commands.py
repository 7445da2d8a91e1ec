"""Each command at a node as one call: unlock, wait for the node, take its lock, identify, then the steps.

The callers (command line, API) pass plain texts: no session, lock or link is theirs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from teds_provision.errors import (
    BadDataError,
    GarbledError,
    NodeRefusedError,
    NodeSilentError,
    NotFoundError,
    NotWhitelistedError,
    PolicyError,
    TedsProvisionError,
    UnprovenError,
    UsageError,
)
from teds_provision.links import LINKS, LinkSettings, Notice
from teds_provision.links.ports import MultiStationLink
from teds_provision.protocol.datasheet import SEQUENCE_WINDOW, SignedNodeKey
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.agree import (
    AgreeResult,
    ResetReceipt,
    TakeOver,
    agree,
    open_session,
    require_session,
    reset_node,
)
from teds_provision.provisioning.board_type import differences, is_remembered, shown_by
from teds_provision.provisioning.build import own_name, require_free_name
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.conversation import HEARD, Conversation, SessionLostError
from teds_provision.provisioning.firmware import keep_firmware, locate, read_firmware
from teds_provision.provisioning.identify import IdentifiedNode, describe, identify
from teds_provision.provisioning.image_file import (
    VerifyReport,
    concluded,
    node_or_image,
    read_image_file,
    verify_image_alone,
)
from teds_provision.provisioning.meeting import Arrival, meet, meet_everyone, watch_nodes
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.provision import add_to_whitelist, key_board
from teds_provision.provisioning.readings import keep
from teds_provision.provisioning.sign import SignResult, known_image, known_node_keys, require_not_measured, sign
from teds_provision.provisioning.teds_read import NodeSnapshot, read_identity, read_image, take_snapshot
from teds_provision.provisioning.verify import freshness_floor_of, session_check, unproven
from teds_provision.provisioning.verify_node import open_or_say_why, provenance_check, verify_at_node
from teds_provision.provisioning.write import WriteResult, write
from teds_provision.shapes.verdict import Verification
from teds_provision.station.firmware import KnownFirmware, firmware_of
from teds_provision.station.station import Station
from teds_provision.station.store import DatasheetRecord, Draft
from teds_provision.teds.codec import security
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.image import SECURITY, Image

Unlock = Literal["always", "if held", "never"]


@dataclass(frozen=True)
class NodeVisit:
    """A node that was met and proved its identity key, for as long as the meeting lasts."""

    station: Station
    node: Conversation
    who: IdentifiedNode
    released: bool = False  # the running `ncap` measured the node and let it go

    def session(self) -> None:
        """Open a session under the key that is held; raises PolicyError if there is none."""
        require_session(self.station, self.node)


@contextmanager
def at_node(
    station: Station,
    links: LinkSettings,
    uuid: bytes,
    reporter: Reporter,
    *,
    unlock: Unlock = "if held",
    writes: str = "",
) -> Iterator[NodeVisit]:
    """Meet node ``uuid`` on the chosen link and have it prove its key.

    The vault is opened before any wait: always, if a key of this node is held, or never. Another command of this
    station that works on the same node is waited for. ``writes`` is the command that writes to the node: a running
    `ncap` of this home that measures it releases it meanwhile. Raises NoReaderError, NoNodeError after
    ``links.timeout`` seconds, KeyMismatchError, NotAuthenticError, LinkError; PolicyError if the node is not released.
    """

    def before() -> None:
        if unlock != "never":
            station.unlock(None if unlock == "always" else uuid)

    with (
        meet(station, links, uuid, reporter, before=before) as node,
        station.node_lock(uuid),
        station.released(uuid, writes) if writes else nullcontext() as released,
    ):
        yield NodeVisit(station, node, identify(station, node, recall=unlock != "never"), bool(released))


# -- identify: the node on the reader or those on the bus, once or as they come ----------------------------------------


@dataclass(frozen=True)
class ProvenNode:
    """A node that proved its key; ``identity`` is its plain Identify, a hint, and so is that its button was pressed."""

    who: IdentifiedNode
    identity: Identity
    whitelisted: bool
    channels: int
    name: str | None
    charging: dict[str, object] | None = None
    ble: str | None = None
    firmware: KnownFirmware | None = None
    pressed: bool = False


def identify_at(
    station: Station,
    links: LinkSettings,
    reporter: Reporter,
    *,
    add: bool = False,
    watch: bool = False,
    stop: threading.Event | None = None,
) -> Iterator[Arrival[ProvenNode]]:
    """Identify the present node, or (``watch``) each that comes until ``stop``; ``add`` whitelists proven ones.

    With ``watch`` an error ends one node only. Without it that is so if another node was identified, and it is reported
    as a notice; else the first error is raised.
    """
    if add:
        station.unlock()  # before a node is there: the vault makes a pin's MAC
    if watch:
        yield from watch_nodes(links, lambda node: _identified(station, node, add), reporter, stop or threading.Event())
        return
    first: TedsProvisionError | None = None
    proven: list[tuple[Conversation, ProvenNode]] = []
    with meet_everyone(links, reporter) as nodes:
        for node, found in _side_by_side(nodes, lambda node: _identified(station, node, add)):
            if isinstance(found, ProvenNode):
                proven.append((node, found))
                continue
            first = first or found
            if len(nodes) > 1:
                text = f"Node {node.uuid.hex()} was not identified: {found.message}"
                reporter.notice(Notice("unfinished", text, uuid=node.uuid))
        # a button counts until the last node was identified, and another one pressed with it takes its mark away
        marked = [replace(found, pressed=node.contact.pressed()) for node, found in proven]
    yield from (Arrival(found.who.uuid, links.places[0], 0.0, found) for found in marked)
    if first is not None and not marked:
        raise first


def _side_by_side(
    nodes: list[Conversation], work: Callable[[Conversation], ProvenNode]
) -> Iterator[tuple[Conversation, ProvenNode | TedsProvisionError]]:
    """Yield the result of each node, in their order: as many at a time as the link allows, as a mute one takes 40 s."""

    def one(node: Conversation) -> ProvenNode | TedsProvisionError:
        try:
            return work(node)
        except TedsProvisionError as error:
            return error

    max_parallel = min(len(nodes), *(node.contact.link.capabilities.max_parallel for node in nodes))
    if max_parallel < 2:
        yield from ((node, one(node)) for node in nodes)
        return
    team = ParallelWork(nodes, one, at_once=max_parallel, name="node")
    ended: dict[int, ProvenNode | TedsProvisionError] = {}
    try:
        for done in team.results():
            ended[id(done.item)] = done.result()
            while nodes and id(nodes[0]) in ended:
                node, nodes = nodes[0], nodes[1:]
                yield node, ended[id(node)]
    finally:  # after a Ctrl-C there is no wait: the bus is closed next
        team.drop_waiting()


def _identified(station: Station, node: Conversation, add: bool) -> ProvenNode:
    who = identify(station, node)
    described, firmware = describe(node), read_firmware(node, once=True)
    entry = who.whitelisted
    if entry is None and add:
        entry = add_to_whitelist(station, node, who)
    known = station.nodes.get(who.uuid)
    name = (known.name if known else None) or described.name
    facts: dict[str, object] = {}
    read = station.datasheets.reading(who.uuid)
    if read is None or not read.is_datasheet:  # nothing is verified here: it fills in what is not known better
        facts["channels"] = described.channels
        if name is not None and station.nodes.all_named(name) in ([], [who.uuid]):
            facts["name"] = name
    with station.durable("identify"):
        station.nodes.remember(who.uuid, **facts)
        keep_firmware(station, who.uuid, firmware)
        station.audit("identify", who.uuid, "proven", fingerprint=who.fingerprint)
    charging = node.contact.charging.to_json() if node.contact.charging else None
    ble = node.contact.ble.text if node.contact.ble else None
    runs = firmware_of(station, who.uuid, firmware)
    return ProvenNode(who, node.identity, entry is not None, described.channels, name, charging, ble, runs)


def key_board_at(
    station: Station,
    links: LinkSettings,
    node: str | None,
    reporter: Reporter,
    *,
    operator: Operator,
) -> bytes:
    """Identify, whitelist and key the board that ``node`` names (None: the one that is there); return its UUID."""
    wanted = None if node is None else station.nodes.resolve(node)
    with meet(station, links, wanted, reporter, before=station.unlock) as there:
        return key_board(station, there, operator=operator, reporter=reporter).uuid


# -- agree, address ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AgreeReport:
    """Result of ``agree``; for a dry run ``agreed`` is None, and ``plan`` describes it."""

    uuid: bytes
    agreed: AgreeResult | None
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
) -> AgreeReport:
    """Agree on a key with the node that ``node`` names (UUID, prefix, name), or rotate it; see :func:`agree`.

    ``confirm`` is asked if the key came back from a backup and the node is not tapped, and before a node is taken over
    from another station; it raises for a no.
    """
    uuid = station.nodes.resolve(node)
    try:
        station.policy.require_whitelisted(uuid)
    except NotWhitelistedError:  # if another owner's CA refuses a take-over, to whitelist the node is of no use
        if dry_run or not rotate:
            raise
    if dry_run:
        held = tuple(f"{record.state} key of epoch {record.epoch}" for record in station.keys.keys_of(uuid))
        return AgreeReport(uuid, None, ("rotate" if rotate else "keep") if held else "agree on a first key", held)
    if confirm and station.keys.restored(uuid) and rotate and not LINKS[links.via].capabilities.tapped:
        confirm(f"Node {uuid.hex()} is {station.keys.rotation_due(uuid)}. Is it still this station's?")
    links = replace(links, via_chosen=True)  # a first key is agreed on by a tap, unless a bus is named
    take_over: TakeOver | None = None if confirm is None else lambda question, _refusal: confirm(question)
    with at_node(station, links, uuid, reporter, unlock="always", writes="agree") as visit:
        return AgreeReport(uuid, agree(station, visit.node, visit.who, rotate=rotate, take_over=take_over))


@dataclass(frozen=True)
class AddressReport:
    """A node's CAN address; ``changed`` None for a dry run."""

    uuid: bytes
    changed: bool | None


def set_address_at(
    station: Station, links: LinkSettings, node: str, address: int, reporter: Reporter, *, dry_run: bool = False
) -> AddressReport:
    """Give the node that ``node`` names another CAN address; see :func:`set_address`."""
    uuid = station.nodes.resolve(node)
    if dry_run:
        return AddressReport(uuid, None)
    with at_node(station, links, uuid, reporter, writes="address") as visit:
        return AddressReport(uuid, set_address(station, visit.node, address))


def set_address(station: Station, node: Conversation, address: int) -> bool:
    """Give the node another CAN address, 1 to 239, durably; False if it has it already.

    Its reply still leaves from the old address; the node is met at the new one from then on. A board that moves at once
    loses that reply: if none comes over the bus, the new address is asked before the error blames the wiring. Raises
    NodeRefusedError (3: neither tapped nor in a session; 17: written less than 10 s ago), KeyMismatchError, LinkError,
    UsageError for a node without CAN.
    """
    if not node.identity.can_address:
        raise UsageError("This node has no CAN, so it has no CAN address.", hint="Nothing needs to be set.")
    if node.identity.can_address == address:
        return False
    open_session(station, node)
    try:
        node.request(security_command(Function.SET_CAN_ADDRESS, bytes([address])), "the new CAN address")
    except SessionLostError as lost:
        raise lost.cause from lost
    except (NodeSilentError, GarbledError):
        if not _is_at(node, address):
            raise
    if node.contact.address is not None:
        node.forget()  # a link is one pair of addresses: this session ended with the old one
    elif node.sealed and read_identity(node).can_address != address:
        raise GarbledError("The node accepted the new CAN address but still reports the old one.")
    with station.durable("address"):
        station.nodes.remember(node.uuid, can_address=address)
        station.audit("address", node.uuid, "done", address=address)
    return True


def _is_at(node: Conversation, address: int) -> bool:
    """Return True if this node answers at the new address; its answer is a hint, as every address is."""
    link = node.contact.link
    there = link.there(address) if isinstance(link, MultiStationLink) else None
    return there is not None and there.uuid == node.uuid


# -- read, reset, verify, write ----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ReadReport:
    """Every TEDS of a node; ``error`` is UnprovenError if a key is held here and their origin is unproven."""

    image: Image
    error: UnprovenError | None


def read_at(station: Station, links: LinkSettings, node: str, reporter: Reporter) -> ReadReport:
    """Read every TEDS of the node that ``node`` names, in a session if this station holds its key."""
    uuid = station.nodes.resolve(node)
    with at_node(station, links.after_agreeing(), uuid, reporter) as visit:
        why = open_or_say_why(station, visit.node)
        c = visit.node.open_counter
        image = read_image(visit.node)
        check = provenance_check(visit.node, visit.who.point, why)
        if visit.node.sealed:
            known = freshness_floor_of(station, uuid, visit.node.proven or read_identity(visit.node))
            with station.durable("read"):
                keep(station, visit.node, image, by="read", known=known, c=c)
        return ReadReport(image, unproven(uuid, check.why) if check.result == "failed" else None)


def reset_at(station: Station, links: LinkSettings, uuid: bytes, reporter: Reporter) -> ResetReceipt:
    """Reset a node; see :func:`reset_node`."""
    with at_node(station, links, uuid, reporter, writes="reset") as visit:
        return reset_node(station, visit.node, visit.who)


def verify_at(
    station: Station,
    links: LinkSettings,
    what: str,
    reporter: Reporter,
    *,
    accept_calibration: str | None = None,
    accept_firmware: bool = False,
    node: bool = False,
) -> VerifyReport:
    """Check the image file, or the node, that ``what`` names; with ``node`` a node's name goes first.

    ``accept_firmware``: the calibration holds with the firmware that runs now. ``error``: NotAuthenticError (4),
    UnprovenError (5), or PolicyError (6) for a calibration that would hurt.
    """
    found = node_or_image(station, what, node=node)
    if isinstance(found, Image):
        return verify_image_alone(station, found, accept_calibration)
    firmware: KnownFirmware | None = None
    in_session = False
    try:
        with at_node(station, links.after_agreeing(), found, reporter) as visit:
            try:
                looked = verify_at_node(station, visit.node, visit.who)
                firmware = _firmware_at(station, visit.node, accept=accept_firmware)
            finally:
                in_session = visit.node.sealed
        image, verified = looked.image, looked.verified
    except NodeRefusedError as refusal:  # outside a session anyone may have sent it: it decides nothing
        if in_session or not station.keys.held(found) or station.policy.tombstone(found) is not None:
            raise
        station.audit("verify", found, "unproven", why=refusal.message)
        why = refusal.message.removeprefix(HEARD).rstrip(".")
        image, verified = Image(found, {}), Verification(found, (session_check("", why),))
    return concluded(station, image, verified, accept_calibration, firmware)


def _firmware_at(station: Station, node: Conversation, *, accept: bool) -> KnownFirmware | None:
    """Return a node's firmware; ``accept`` makes it the one that its calibration was made with, in a session only."""
    reading = read_firmware(node)
    if accept and reading is not None and reading.sealed:
        with station.durable("verify"):
            keep_firmware(station, node.uuid, reading, signed=True)
            version = None if reading.report is None else reading.report.version_text
            station.audit("firmware", node.uuid, "accepted", version=version)
    return firmware_of(station, node.uuid, reading)


@dataclass(frozen=True)
class LocatedNode:
    """A board that blinks."""

    uuid: bytes
    name: str | None


def locate_at(
    station: Station,
    links: LinkSettings,
    nodes: Sequence[str],
    seconds: int,
    reporter: Reporter,
    *,
    ask_name: Callable[[bytes, str], str] | None = None,
) -> Iterator[LocatedNode | tuple[bytes, TedsProvisionError]]:
    """Make one node after the other blink for so many seconds, 0: stop.

    In a session, if its key is held; else only a node in factory state does. ``ask_name`` is called with UUID and name
    while it blinks, and returns the name that it gets from now on (empty: it keeps the one it has). Yields an error in
    place of a node that did not blink.
    """
    for text in nodes:
        uuid = station.nodes.resolve(text)
        try:
            with at_node(station, links.after_agreeing(), uuid, reporter) as visit:
                locate_here(station, visit.node, seconds)
                known = station.nodes.get(uuid)
                name = known.name if known is not None else None
                if ask_name is not None:
                    name = _named(station, uuid, name, ask_name(uuid, name or ""))
                    locate_here(station, visit.node, 0)
                yield LocatedNode(uuid, name)
        except TedsProvisionError as error:
            yield uuid, error


def _named(station: Station, uuid: bytes, before: str | None, name: str) -> str | None:
    """Keep the name that a person gave a node; raises PolicyError if another node has it."""
    if not name or name == before:
        return before
    require_free_name(station, uuid, name)
    with station.durable("name"):
        station.nodes.remember(uuid, name=name)
        station.audit("name", uuid, "done", name=name)
    return name


def locate_here(station: Station, node: Conversation, seconds: int) -> None:
    """Make a node that was met blink, in a session if it has a key; raises PolicyError, NodeRefusedError, LinkError."""
    try:
        if node.identity.state != NodeState.FACTORY and not node.sealed:
            require_session(station, node)
        locate(node, seconds)
    except SessionLostError as lost:
        raise lost.cause from lost


def locate_measured(node: Conversation, seconds: int) -> None:
    """Make a node blink in the session in which it is measured; raises NodeRefusedError, LinkError.

    No session is opened if that one is lost: its measurement opens the next one, and subscribes in it.
    """
    try:
        locate(node, seconds)
    except SessionLostError as lost:
        raise lost.cause from lost


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
        wanted = known_image(station, uuid)
    if wanted is None:
        raise NotFoundError(
            f"Nothing has been built for node {uuid.hex()}.", hint="build and sign it first, or give --image."
        )
    name = own_name(station, wanted, profile)
    if name is not None:
        facts["name"] = name
    record = station.nodes.get(uuid)
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
        visit.session()
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


# -- sign: which image, against what the node has; guarded, with the changes in physical terms -------------------------


@dataclass(frozen=True)
class SignOrder:
    """What to sign: ``image`` (None: the draft of ``uuid``); ``accept_calibration`` as at build; or only the plan."""

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
    known = known_image(station, uuid)
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
    """What the node has: as last known, or (``found``) as it was read now."""

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
        return _PresentTeds(known, epoch, sequence)  # this very sequence was given here: the signature may still hold
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
    """Sequence of the datasheet that the node was last read to have."""
    octets = has.blocks.get(SECURITY) if has is not None else None
    return security.decode(octets).sequence if octets is not None else 0


def _signed_before(image: Image, draft: Draft | None) -> list[bytes]:
    """Return the Security TEDS of the image at hand and of the draft: either signature may still be valid."""
    images = [image] if draft is None else [image, draft.image]
    return [found.blocks[SECURITY] for found in images if SECURITY in found.blocks]


# -- drafts and history: what was built and never written, and the datasheets that a node had --------------------------


@dataclass(frozen=True)
class DroppedDraft:
    """A draft that was dropped, or would be; None if there was none."""

    uuid: bytes
    draft: Draft | None


def drop_draft(station: Station, node: str, *, dry_run: bool = False) -> DroppedDraft:
    """Drop what was built for the node that ``node`` names and never written."""
    uuid = station.nodes.resolve(node)
    draft = station.datasheets.draft(uuid)
    if draft is not None and not dry_run:
        with station.durable("draft"):
            station.datasheets.drop_draft(uuid)
            station.audit("draft", uuid, "dropped", stage=draft.stage, profile=draft.profile)
    return DroppedDraft(uuid, draft)


def history_of(station: Station, node: str) -> tuple[bytes, list[DatasheetRecord]]:
    """Return the datasheets of the node that ``node`` names, newest first."""
    uuid = station.nodes.resolve(node)
    return uuid, station.datasheets.history(uuid)


@dataclass(frozen=True)
class RestoredDatasheet:
    """An older datasheet, signed again and written; for a dry run ``written`` is None."""

    uuid: bytes
    sequence: int
    changes: tuple[Change, ...]
    written: WriteResult | None


def _record_of(station: Station, uuid: bytes, sequence: int) -> DatasheetRecord:
    known = station.datasheets.history(uuid)
    for record in known:
        if record.sequence == sequence:
            return record
    listed = ", ".join(str(record.sequence) for record in known) or "none"
    raise NotFoundError(
        f"Node {uuid.hex()} never had a datasheet with sequence {sequence}.", hint=f"Known are: {listed}."
    )


def restore_datasheet(
    station: Station, links: LinkSettings, node: str, sequence: int, reporter: Reporter, *, dry_run: bool = False
) -> RestoredDatasheet:
    """Write a datasheet that the node had under ``sequence``, signed again; its content counts, not its number.

    Raises NotFoundError (no such datasheet), PolicyError, and what ``write`` raises.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    record = _record_of(station, uuid, sequence)
    if dry_run:
        now = station.datasheets.datasheet(uuid)
        before = now.unsigned_blocks() if now is not None else {}
        return RestoredDatasheet(uuid, sequence, tuple(diff_blocks(before, record.image.unsigned_blocks())), None)
    with at_node(station, links.after_agreeing(), uuid, reporter, unlock="always", writes="write") as visit:
        visit.session()
        present = take_snapshot(visit.node)
        blocks = record.image.unsigned_blocks()
        same = {block for block, teds in blocks.items() if present.image.blocks.get(block) == teds}
        image = Image(uuid, {**blocks, **present.fixed_beside(same)})
        guard(station, image, present.image, f"datasheet of sequence {sequence} brought back")
        changes = tuple(diff_blocks(present.image.unsigned_blocks(), image.unsigned_blocks()))
        signed = sign(
            station,
            SignedNodeKey(uuid, visit.who.point, visit.who.key_signature),
            image,
            epoch=present.identity.epoch,
            node_sequence=present.identity.sequence,
            on_node=present.image.security if not changes else None,
            keep_draft=True,
            profile=record.profile,
            before=lambda: require_not_measured(station, visit.node, released=visit.released),
        )
        facts = {"profile": record.profile} if record.profile is not None else {}
        written = write(station, visit.node, signed.image, present=present, progress=reporter.written, facts=facts)
        return RestoredDatasheet(uuid, signed.sequence, changes, written)
