"""Step 1: which node is this, which key does it hold, and can it prove it (Figure 3 of the paper, upper half)."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

from teds_provision import teds
from teds_provision.errors import (
    KeyringUnavailableError,
    NodeRefusedError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
    WrongPassphraseError,
)
from teds_provision.links import LinkSettings, Notice
from teds_provision.protocol.fingerprints import is_whole
from teds_provision.protocol.keys import CHALLENGE_OCTETS, fingerprint, node_key_good, prove_message, verify
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.conversation import Conversation, ShownKey
from teds_provision.provisioning.firmware import keep_firmware, read_firmware
from teds_provision.provisioning.meeting import Arrival, meet_all, watch_nodes
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.readings import keep_shown
from teds_provision.provisioning.teds_read import read_block
from teds_provision.sanitize import printable
from teds_provision.station.firmware import KnownFirmware, firmware_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import Assurance, WhitelistEntry, utc_now
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import SECURITY


@dataclass(frozen=True)
class IdentifiedNode:
    """A node that proved possession of the key that it shows."""

    uuid: bytes
    point: bytes
    key_signature: bytes
    state: NodeState
    tag_uid: bytes | None
    address: int | None
    security_teds: bytes
    whitelisted: WhitelistEntry | None
    recalled: bool = False
    """``security_teds`` was read in a session before, and not now; see :func:`examine`."""

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the node's key."""
        return fingerprint(self.point)


def show_key(node: Conversation) -> ShownKey:
    """Read the key that a node shows, and have the node prove it; raises NotAuthenticError, BadDataError, LinkError."""
    octets = read_block(node, SECURITY)
    shown = security.decode(octets)
    point = shown.node_key
    if not node_key_good(node.uuid, point, shown.node_key_signature):
        raise NotAuthenticError(f"The key that the node presents is not signed for UUID {node.uuid.hex()} (field 102).")
    prove(node, point)
    return ShownKey(point, shown.node_key_signature, octets)


def prove(node: Conversation, point: bytes) -> None:
    """Have the node sign a fresh challenge (128.8); raises NotAuthenticError if it cannot."""
    challenge = os.urandom(CHALLENGE_OCTETS)
    proof = node.request_idempotent(security_command(Function.PROVE, challenge), "to prove its key")
    if not verify(point, prove_message(node.uuid, challenge), proof):
        raise NotAuthenticError(
            f"The node cannot prove that it holds the key {fingerprint(point)[:16]}, which it presents.",
            hint="This may be a copied tag, or two boards with one UUID answer. Do not use it; connect one alone.",
        )


def identify(
    station: Station,
    node: Conversation,
    *,
    expect: Callable[[IdentifiedNode], object] = lambda who: None,
    recall: bool = False,
) -> IdentifiedNode:
    """Read UUID and key, require the proof, and check both against this station's store.

    Raises KeyMismatchError (a known UUID with another key), NotAuthenticError, BadDataError, LinkError. A tap pins the
    key that it brought; over a bus, since any device can use any UUID, only a whitelisted key is kept, and
    ``last_seen`` changes only if the key that signed is known. State, epoch and address of a plain Identify are hints:
    they change nothing in the store, a session does. ``expect`` is called before anything is recorded, and raises if
    another node was meant. ``recall``: see :func:`examine`.
    """
    who = examine(station, node, recall=recall)
    expect(who)
    entry = who.whitelisted
    counts = node.tapped or (entry is not None and entry.fingerprint is not None)
    facts = _facts(station, who, counts=counts) | _charge(node)
    pinned = _pinned_now(station, who) if counts else None
    with station.durable("identify", more_follows=True):
        if facts:
            station.nodes.remember(node.uuid, **facts)
        if pinned is not None:
            who = replace(who, whitelisted=pinned)
            station.pins.put(pinned)
            members = {"fingerprint": pinned.fingerprint, "assurance": pinned.assurance}
            station.audit("whitelist", node.uuid, "pinned", **members)
        if known_key(station, node.uuid) != who.point:
            keep_shown(station, node.uuid, who.security_teds, by="identify")
    return who


def _facts(station: Station, who: IdentifiedNode, *, counts: bool) -> dict[str, object]:
    """Return the facts to record of a node that proved its key; ``counts``: by tap, or under a whitelisted key."""
    facts: dict[str, object] = {"point": who.point} if counts else {}
    known = station.nodes.get(who.uuid)
    if counts or (known is not None and known.point == who.point):
        facts["last_seen"] = utc_now()  # only under the pinned key; with another key it may be another board
    return facts


def _charge(node: Conversation) -> dict[str, object]:
    """Return the charge from the node's initial message, with the time; a hint that is only shown."""
    charging = node.contact.charging
    return {} if charging is None else {"charging": json.dumps({**charging.to_json(), "at": utc_now()})}


def _pinned_now(station: Station, who: IdentifiedNode) -> WhitelistEntry | None:
    """Return the entry with its whole fingerprint, None if it has that already, or the vault stays closed.

    An entry without a fingerprint is pinned by its first tap (profile.md, "Keys and trust"); one with the first digits
    gets the others by the first contact, whatever the link.
    """
    entry = who.whitelisted
    if entry is None or is_whole(entry.fingerprint) or not _opened(station):
        return None
    return replace(entry, fingerprint=who.fingerprint, assurance=entry.assurance if entry.fingerprint else "tap")


def _opened(station: Station) -> bool:
    """Return True if the vault is open, which makes a pin's MAC.

    Without the passphrase, the first agreement will pin.
    """
    with suppress(WrongPassphraseError, KeyringUnavailableError):
        station.unlock()
        return True
    return False


def examine(station: Station, node: Conversation, *, recall: bool = False) -> IdentifiedNode:
    """Return what :func:`identify` finds out, without a change of the store (but for a wrong key in the audit log).

    ``recall``, for a caller that opens a session next: a node with a key held here, whose Security TEDS was read in a
    session before, proves the key that was read then, and its Security TEDS is not read. If it cannot, it is read.
    What the node showed early is not asked for again.
    """
    if node.early is None and recall and (who := _recalled(station, node)) is not None:
        return who
    shown = show_key(node) if node.early is None else node.early.key
    return _examined(station, node, shown.point, shown.signature, shown.security_teds)


def _recalled(station: Station, node: Conversation) -> IdentifiedNode | None:
    """Have a node prove the key of its last reading in a session; None if there is none, or it cannot."""
    with station.reading():
        row, image = station.datasheets.reading(node.uuid), station.datasheets.datasheet(node.uuid)
        held = station.keys.held(node.uuid)
    octets = image.security if image is not None else None
    if not held or octets is None or row is None or not row.in_session or node.identity.state == NodeState.FACTORY:
        return None
    point, signature = row.node_key, row.node_key_signature
    if point is None or signature is None or not node_key_good(node.uuid, point, signature):
        return None
    try:
        prove(node, point)
    except NotAuthenticError:
        return None
    return replace(_examined(station, node, point, signature, octets), recalled=True)


def _examined(station: Station, node: Conversation, point: bytes, signature: bytes, octets: bytes) -> IdentifiedNode:
    with station.reading():
        station.pins.check(node.uuid, point)
        entry = station.pins.entry(node.uuid)
    identity = node.identity
    return IdentifiedNode(
        uuid=node.uuid,
        point=point,
        key_signature=signature,
        state=identity.state,
        tag_uid=node.contact.tag_uid,
        address=node.contact.address,
        security_teds=octets,
        whitelisted=entry,
    )


def known_key(station: Station, uuid: bytes) -> bytes | None:
    """Return P(node) of the Security TEDS last read from this UUID, None if there is none of this profile."""
    row = station.datasheets.reading(uuid)
    return row.node_key if row is not None else None


@dataclass(frozen=True)
class Description:
    """A node's own, unverified description."""

    name: str | None
    channels: int


def describe(node: Conversation) -> Description:
    """Read name and number of channels from Meta-TEDS and XdcrName, if the node has them; nothing is verified."""
    name: str | None = None
    channels = 0
    for block in ((0, AccessCode.META), (0, AccessCode.NAME)):
        try:
            decoded = teds.decode(read_block(node, block))
        except NodeRefusedError:
            continue
        found, count = decoded.get("TCName"), decoded.get("MaxChan")
        name = printable(found) if isinstance(found, str) else name
        channels = count if isinstance(count, int) else channels
    return Description(name, channels)


def new_whitelist_entry(station: Station, node: Conversation, who: IdentifiedNode) -> WhitelistEntry:
    """Return the whitelist entry of an identified node, pinned to its key by tap, or by the bus of a new node.

    A node that already has a key is not pinned over a bus, since any device can use any UUID; its first tap pins it.
    Over the air nothing is pinned. Changes nothing. Raises PolicyError (revoked), KeyMismatchError.
    """
    new = who.state == NodeState.FACTORY and node.wired
    assurance: Assurance = "tap" if node.tapped else "bus" if new else "uuid"
    with station.reading():
        revoked = station.policy.revocation(who.uuid)
        if revoked is not None:
            raise PolicyError(f"Node {who.uuid.hex()} was revoked: {revoked.why}.", hint="It was not whitelisted.")
        station.pins.check(who.uuid, who.point)
    return WhitelistEntry(who.uuid, who.fingerprint if node.tapped or new else None, assurance=assurance)


def add_to_whitelist(station: Station, node: Conversation, who: IdentifiedNode) -> WhitelistEntry:
    """Whitelist a node by :func:`new_whitelist_entry`; an entry that another process made meanwhile stays."""
    entry = new_whitelist_entry(station, node, who)
    with station.durable("whitelist"):
        present = station.pins.entry(who.uuid)
        if present is not None:
            return present
        station.pins.put(entry)
        if entry.fingerprint is not None:
            station.nodes.remember(who.uuid, point=who.point)
        station.audit("whitelist", who.uuid, "added", fingerprint=entry.fingerprint, assurance=entry.assurance)
    return entry


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
    dry_run: bool = False,
) -> Iterator[Arrival[ProvenNode]]:
    """Identify the present node, or (``watch``) each that comes until ``stop``; ``add`` whitelists proven ones.

    ``dry_run`` records nothing, and raises what ``add`` would raise.

    With ``watch`` an error ends one node only. Without it that is so if another node was identified, and it is reported
    as a notice; else the first error is raised.
    """
    if add and not dry_run:
        station.unlock()  # before the wait for a node: the MAC of a pin needs the vault

    def work(node: Conversation) -> ProvenNode:
        return _identified(station, node, add=add, dry_run=dry_run)

    if watch:
        yield from watch_nodes(links, work, reporter, stop or threading.Event())
        return
    first: TedsProvisionError | None = None
    proven: list[tuple[Conversation, ProvenNode]] = []
    with meet_all(links, reporter) as nodes:
        for node, found in _side_by_side(nodes, work):
            if isinstance(found, ProvenNode):
                proven.append((node, found))
                continue
            first = first or found
            if len(nodes) > 1:
                text = f"Node {node.uuid.hex()} was not identified: {found.message}"
                reporter.notice(Notice("unfinished", text, uuid=node.uuid))
        # Read the buttons last: a second pressed node makes the mark ambiguous, and then no node has it.
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
    finally:  # after Ctrl-C do not wait: the bus is closed next
        team.drop_waiting()


def _identified(station: Station, node: Conversation, *, add: bool, dry_run: bool) -> ProvenNode:
    who = examine(station, node) if dry_run else identify(station, node)
    described, firmware = describe(node), read_firmware(node, once=True)
    entry = who.whitelisted
    if entry is None and add and dry_run:
        new_whitelist_entry(station, node, who)
    elif entry is None and add:
        entry = add_to_whitelist(station, node, who)
    known = station.nodes.get(who.uuid)
    name = (known.name if known else None) or described.name
    facts: dict[str, object] = {}
    read = station.datasheets.reading(who.uuid)
    if read is None or not read.is_datasheet:  # unverified, so only used if nothing better is known
        facts["channels"] = described.channels
        if name is not None and station.nodes.all_named(name) in ([], [who.uuid]):
            facts["name"] = name
    if not dry_run:
        with station.durable("identify"):
            station.nodes.remember(who.uuid, **facts)
            keep_firmware(station, who.uuid, firmware)
            station.audit("identify", who.uuid, "proven", fingerprint=who.fingerprint)
    charging = node.contact.charging.to_json() if node.contact.charging else None
    ble = node.contact.ble.text if node.contact.ble else None
    runs = firmware_of(station, who.uuid, firmware)
    return ProvenNode(who, node.identity, entry is not None, described.channels, name, charging, ble, runs)
