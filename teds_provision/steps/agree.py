"""Step 3: agree on a link key, or find that one is agreed (profile section 3). Lost messages heal here."""

from __future__ import annotations

from dataclasses import dataclass, replace

from teds_provision.errors import Garbled, NodeRefused, NodeSilent, NotAuthentic, PolicyRefused
from teds_provision.protocol.agreement import StationAgreement
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import NodeKey, Station
from teds_provision.steps.identify import Identified
from teds_provision.steps.read import read_identity
from teds_provision.store import WhitelistEntry
from teds_provision.talk.conversation import Conversation, SessionLost

_BEGINNINGS = 5


@dataclass(frozen=True)
class Agreed:
    """The key that a session is open under now; ``fresh`` says whether this run agreed on it."""

    epoch: int
    key_id: str
    fresh: bool


def open_session(station: Station, node: Conversation, *, word: bool = False) -> NodeKey | None:
    """Open a session under the first key that the node knows, newest pending first; None where it knows none.

    The key that worked becomes the active one and the others go, but for a newer one whose Confirm may still be on its
    way (:meth:`NodeKeys.outdated`): that is the only thing that ever deletes a key.
    ``word``: a person said that this node may be used although its key came back from a backup. Raises PolicyRefused
    for a node that was moved away, or that is neither tapped nor vouched for then; LinkFailure.
    """
    station.policy.require_not_given_away(node.uuid)
    if not (node.tapped or word):
        station.policy.require_not_restored(node.uuid)
    for held in station.keys.unwrapped(node.uuid):
        try:
            node.open(held.key)
        except NodeRefused as refusal:
            if refusal.reason in (Reason.UNKNOWN_KEY, Reason.WRONG_STATE):
                continue
            raise
        except NotAuthentic:
            continue
        return _take_up(station, node, held)
    return None


def _take_up(station: Station, node: Conversation, held: NodeKey) -> NodeKey:
    """Make a key the active one after a good Open under it.

    Epoch and sequence of a bundle are hearsay until here: the node's own words in this session replace them.
    """
    uuid, record = node.uuid, held.record
    fresh = record.state == "pending"
    told = read_identity(node) if fresh and record.source == "import" else None
    known = station.nodes.get(uuid)
    settled = known is not None and known.epoch == record.epoch and not station.pins.is_unsettled(uuid)
    if settled and not fresh and not station.keys.outdated(record):
        return held
    with station.durable("agree"):
        if told is not None and told.epoch != record.epoch:
            station.audit("key", uuid, "epoch corrected", key_id=record.key_id, said=record.epoch, epoch=told.epoch)
            record = station.keys.correct_epoch(record, told.epoch)
        station.pins.settled(uuid)
        # what is signed without the node is for this epoch
        station.nodes.remember(uuid, epoch=record.epoch, **({} if told is None else {"sequence": told.sequence}))
        if fresh or station.keys.outdated(record):
            station.keys.promote(uuid, record.key_id)
            # a pending key out of a backup may have been used and shared since (model/README.md, OLD_PENDING)
            if fresh and record.source == "agreement" and not station.keys.restored(uuid):
                station.keys.rotated(uuid)
            station.audit("key", uuid, "active", key_id=record.key_id, epoch=record.epoch)
    return NodeKey(record, held.key)


def session_if_keyed(station: Station, node: Conversation) -> NodeKey | None:
    """Open a session as :func:`open_session` does; where a handover demands a new key, go on under that new key.

    None for a node whose keys this station does not hold, or gave away.
    """
    if station.policy.tombstone(node.uuid) is not None:
        return None
    held = open_session(station, node)
    entry = station.pins.entry(node.uuid)
    due = station.keys.rotation_due(node.uuid) is not None and entry is not None and entry.fingerprint is not None
    if held is None or not due or entry is None:
        return held
    try:
        _agree_anew(station, node, entry, station.keys.ca_of(node.uuid))
    except SessionLost as lost:
        raise lost.cause from lost
    return next(iter(station.keys.unwrapped(node.uuid)))


def require_session(station: Station, node: Conversation) -> NodeKey:
    """Open a session or say why there is none: given away, no key held (PolicyRefused), or the node has another."""
    station.policy.require_not_given_away(node.uuid)
    held = session_if_keyed(station, node)
    if held is not None:
        return held
    if not station.keys.held(node.uuid):
        raise PolicyRefused(
            f"This station holds no key of node {node.uuid.hex()}.",
            hint=f"Tap it and agree on one: teds-provision agree {node.uuid.hex()}",
        )
    raise unknown_key(node.uuid)


def unknown_key(uuid: bytes) -> PolicyRefused:
    """The error for a node that knows none of the keys held here: the operator decides, never the tool."""
    return PolicyRefused(
        f"Node {uuid.hex()} knows none of the keys that this station holds for it.",
        hint=f"Another station may have rotated it, or it was reset. To take it: tap it, agree {uuid.hex()} --rotate.",
    )


def agree(
    station: Station,
    node: Conversation,
    who: Identified,
    *,
    rotate: bool = False,
    newcomer: WhitelistEntry | None = None,
) -> Agreed:
    """End with a session open under an agreed key: the present one, or a new one.

    ``rotate`` demands a new one, by a person's word: inside a session where a key is known, else by tap.
    ``newcomer`` is the whitelist entry that is made together with the first key: a board of another owner refuses, and
    never comes onto the list. On a link that loses messages an agreement begins anew, five times at most.
    Raises NotWhitelisted, OtherKey, PolicyRefused, NodeRefused, NotAuthentic, LinkFailure; whatever is cut, the same
    call carries on.
    """
    again = 0
    while True:
        try:
            return _agree(station, node, who, rotate=rotate, newcomer=newcomer, again=again > 0)
        except (NodeSilent, Garbled):
            again += 1
            if again == _BEGINNINGS or not node.lives():
                raise
            node.forget()


def _agree(
    station: Station,
    node: Conversation,
    who: Identified,
    *,
    rotate: bool,
    newcomer: WhitelistEntry | None,
    again: bool,
) -> Agreed:
    new = who.state == NodeState.FACTORY
    returning = new and _may_return(station, node.uuid)
    listed = newcomer is not None and station.pins.entry(node.uuid) is None
    entry = newcomer if listed else station.policy.require_whitelisted(node.uuid, returning=returning)
    assert entry is not None
    # of a run that was just cut short the node may have the new key, whatever it said before
    held = open_session(station, node, word=rotate) if not new or again else None
    if held is not None and newcomer is not None:
        with station.durable("agree"):
            _enlist(station, newcomer)
    rotate = (rotate and not again) or (held is not None and station.keys.rotation_due(node.uuid) is not None)
    if held is not None and not rotate:
        return Agreed(held.record.epoch, held.record.key_id, fresh=again)
    if held is None and not new and station.keys.held(node.uuid) and not (rotate or again):
        raise unknown_key(node.uuid)
    pinned = _pin_for(entry, node, who)
    ca = station.ca if new else station.keys.ca_of(node.uuid)
    try:
        return _agree_anew(station, node, pinned, ca, returning=returning)
    except NodeRefused as refusal:
        # Identify may have been answered while the node was still storing the key of a run that was cut off
        late = refusal.reason == Reason.NOT_PERMITTED and new and not rotate
        held = open_session(station, node) if late else None
        if held is None:
            raise
        return Agreed(held.record.epoch, held.record.key_id, fresh=True)
    except SessionLost as lost:
        raise lost.cause from lost


def _enlist(station: Station, entry: WhitelistEntry) -> None:
    """Put a node onto the whitelist, unless another process did so meanwhile."""
    present = station.pins.entry(entry.uuid)
    if present == entry or (present is not None and entry.fingerprint is None):
        return
    station.pins.put(entry)
    if present is None:
        told = {"fingerprint": entry.fingerprint, "assurance": entry.assurance}
        station.audit("whitelist", entry.uuid, "added", **told)


def _may_return(station: Station, uuid: bytes) -> bool:
    """Whether a node whose move was closed by its receipt may be keyed here again, should it prove to be reset."""
    tombstone = station.policy.tombstone(uuid)
    row = station.handovers.get(tombstone.handover_id, "out") if tombstone is not None else None
    return row is not None and row.state == "closed" and not station.keys.held(uuid)


def _pin_for(entry: WhitelistEntry, node: Conversation, who: Identified) -> WhitelistEntry:
    """The entry with its fingerprint, pinned now where this contact may pin: tapped, or the bus of a new CAN node."""
    if entry.fingerprint is not None:
        return entry
    if node.tapped:
        return replace(entry, fingerprint=who.fingerprint, assurance="tap")
    if who.state == NodeState.FACTORY:
        return replace(entry, fingerprint=who.fingerprint, assurance="bus")
    raise PolicyRefused(
        f"The whitelist knows node {node.uuid.hex()} by UUID alone; only a tap can pin its key.",
        hint="Tap it once (--via nfc), or add the fingerprint: whitelist add UUID --fingerprint F.",
    )


def _agree_anew(
    station: Station, node: Conversation, entry: WhitelistEntry, ca: bytes, *, returning: bool = False
) -> Agreed:
    """Request, Confirm, Open; ``ca`` is the one that the node keeps, or shall keep from now on.

    ``returning`` nodes were given away: only a signed-for initial Security TEDS shows that they were reset since.
    """
    uuid = node.uuid
    agreement = StationAgreement(
        replace(station.credentials(), ca=ca, station_signature=station.identity.signature_under(ca)), uuid
    )
    reply = node.send(agreement.request(), "the key agreement")
    epoch = station.pins.epoch_to_exceed(uuid, entry.fingerprint)
    agreed = agreement.accept(reply, pinned=entry.fingerprint, epoch=epoch)
    key_id = agreed.key_id.hex()
    if returning and not agreed.unsigned:
        station.policy.require_not_given_away(uuid)
    with station.durable("agree"):
        if returning:
            station.policy.take_back([uuid])
            station.audit("handover", uuid, "came back after a reset")
        station.keys.add_pending(uuid, key=agreed.key, key_id=agreed.key_id, epoch=agreed.epoch)
        station.keys.set_ca_of(uuid, ca)
        _enlist(station, entry)
        station.audit("agree", uuid, "pending", key_id=key_id, epoch=agreed.epoch, via=node.contact.link.via)
    node.send(agreed.confirm, "the key confirmation")
    node.forget()
    node.open(agreed.key)
    identity = read_identity(node)
    with station.durable("agree"):
        station.keys.promote(uuid, key_id)
        station.nodes.remember(
            uuid,
            epoch=agreed.epoch,
            point=agreed.node,
            sequence=identity.sequence,
            state=int(identity.state),
            can_address=identity.can_address,
        )
        station.keys.rotated(uuid)
        station.pins.settled(uuid)
        station.audit("agree", uuid, "done", key_id=key_id, epoch=agreed.epoch)
    return Agreed(agreed.epoch, key_id, fresh=True)
