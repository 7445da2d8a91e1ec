"""Step 3: agree on a link key, or find that one is agreed (profile.md, "Key agreement").

Steps that a lost message left half done are found and finished here.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace

from teds_provision.errors import (
    BadDataError,
    GarbledError,
    KeyMismatchError,
    LinkError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
)
from teds_provision.links import LINKS, LinkSettings
from teds_provision.links.opening import without_source
from teds_provision.protocol.datasheet import signature_good, station_signature_good
from teds_provision.protocol.fingerprints import is_whole
from teds_provision.protocol.keys import CHALLENGE_OCTETS, fingerprint, reset_message, verify
from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.wire_agreement import AgreedKey, StationAgreement, TranscriptMismatchError, fit_to_agree
from teds_provision.provisioning.conversation import OTHER_OWNER_REMEDY, Conversation, SessionLostError
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.teds_read import read_block, read_identity
from teds_provision.provisioning.visit import at_node
from teds_provision.station.station import NodeKey, Station
from teds_provision.station.store.records import KeyRecord, WhitelistEntry, utc_now
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

_BEGINNINGS = 5

TakeOver = Callable[[str, PolicyError], object]
"""Asks before another station of the owner is locked out of a node; raises if the answer is no.

It gets the question, and the error for one that cannot be asked.
"""


@dataclass(frozen=True)
class AgreeResult:
    """The key of the open session; ``fresh``: this run agreed on it; ``listed``: and put the node onto the whitelist.

    The entry was durable with the pending key, before its Confirm was sent.
    """

    epoch: int
    key_id: str
    fresh: bool
    listed: bool = False


def open_session(station: Station, node: Conversation, *, word: bool = False) -> NodeKey | None:
    """Open a session under the first key that the node knows, newest pending first; None if it knows none.

    The key that worked becomes the active one and the others are deleted, but for a newer one whose Confirm may still
    be on its way (:meth:`NodeKeys.outdated`): nothing else ever deletes a key. ``word``: an operator confirmed that
    this node may be used although its key came back from a backup. Raises PolicyError for a node that was moved away,
    or whose key came from a backup and that is neither tapped nor confirmed; LinkError.
    """
    station.policy.require_not_given_away(node.uuid)
    if not (node.tapped or word):
        station.policy.require_not_restored(node.uuid)
    known = station.nodes.get(node.uuid)
    statics = (station.point, *([known.point] if known is not None and known.point is not None else []))
    for held in station.keys.unwrapped(node.uuid):
        try:
            node.open(held.key, statics=statics)
        except NodeRefusedError as refusal:
            if refusal.reason in (Reason.UNKNOWN_KEY, Reason.WRONG_STATE):
                continue
            raise
        except NotAuthenticError:
            continue
        return _take_up(station, node, held)
    return None


def _take_up(station: Station, node: Conversation, held: NodeKey) -> NodeKey:
    """Make a key the active one after a good Open under it.

    Epoch and sequence from a bundle are unverified until here: those that the node reports in the session replace them.
    """
    uuid, record = node.uuid, held.record
    station.nodes.met_at(uuid, without_source(node.contact.bus))
    identity = read_identity(node) if record.state == "pending" and record.source == "import" else None
    if _is_taken_up(station, record):
        return held
    with station.durable("agree"):
        if identity is not None and identity.epoch != record.epoch:
            station.audit("key", uuid, "epoch corrected", key_id=record.key_id, said=record.epoch, epoch=identity.epoch)
            record = station.keys.correct_epoch(record, identity.epoch)
        station.pins.settled(uuid)
        # Signatures made without the node need its present epoch.
        station.nodes.remember(
            uuid, epoch=record.epoch, **({} if identity is None else {"sequence": identity.sequence})
        )
        if record.state == "pending" or station.keys.outdated(record):
            _activate(station, record)
    return NodeKey(record, held.key)


def _is_taken_up(station: Station, record: KeyRecord) -> bool:
    """Return True if the key is the active one already, no other of its time is left, and its epoch is known."""
    if record.state == "pending" or station.pins.is_unsettled(record.uuid) or station.keys.outdated(record):
        return False
    known = station.nodes.get(record.uuid)
    return known is not None and known.epoch == record.epoch


def _activate(station: Station, record: KeyRecord) -> None:
    uuid = record.uuid
    station.keys.promote(uuid, record.key_id)
    if record.state == "pending" and record.source == "agreement":
        # A pending key from a backup may have been used and shared since (model/README.md, OLD_PENDING).
        if not station.keys.restored(uuid):
            station.keys.rotated(uuid)
        pinned = station.pins.pinned(uuid)
        if is_whole(pinned):
            station.plant.record_event("agreed", uuid, fingerprint=pinned, epoch=record.epoch, key_id=record.key_id)
    elif record.state == "pending":
        station.keys.end_removal_mark(record)
    station.audit("key", uuid, "active", key_id=record.key_id, epoch=record.epoch)


def session_if_keyed(station: Station, node: Conversation) -> NodeKey | None:
    """Open a session as :func:`open_session` does; if a handover requires a new key, continue under that new key.

    None for a node whose keys this station does not hold, or gave away.
    """
    if station.policy.tombstone(node.uuid) is not None:
        return None
    held = open_session(station, node)
    entry = station.pins.entry(node.uuid)
    due = station.keys.rotates_now(node.uuid) and entry is not None and entry.fingerprint is not None
    if held is None or not due or entry is None:
        return held
    try:
        _agree_anew(station, node, entry, station.keys.ca_of(node.uuid), read_block(node, SECURITY))
    except SessionLostError as lost:
        raise lost.cause from lost
    return next(iter(station.keys.unwrapped(node.uuid)))


def require_session(station: Station, node: Conversation) -> NodeKey:
    """Open a session or raise why there is none: given away, no key held (PolicyError), or the node has another."""
    station.policy.require_not_given_away(node.uuid)
    held = session_if_keyed(station, node)
    if held is not None:
        return held
    if not station.keys.held(node.uuid):
        raise PolicyError(
            f"This station holds no key of node {node.uuid.hex()}.",
            hint=f"Tap it and agree on one: teds-provision agree {node.uuid.hex()}",
        )
    raise unknown_key(station, node)


def unknown_key(station: Station, node: Conversation) -> PolicyError:
    """Return the error if every key held here was answered with "unknown key" (16), which any device can send.

    The operator decides what that means, never the tool (profile, section 2).
    """
    uuid = node.uuid.hex()
    another = _shows_another_key(station, node)
    if another is not None:
        return another
    elsewhere = agreed_elsewhere(station, node)
    text = "it answers that it knows none of the keys held here"
    if elsewhere and _signed_for_another_ca(station, node.uuid, _shown_security(node)):
        return PolicyError(f"No session with node {uuid}: {text}; {elsewhere}.", hint=OTHER_OWNER_REMEDY)
    if elsewhere:
        return PolicyError(
            f"No session with node {uuid}: {text}; {elsewhere}.",
            hint=f"Use it at that station, or have the key handed over. To take it over, tap it: agree {uuid} --rotate",
        )
    return PolicyError(
        f"No session with node {uuid}: {text}. That answer is unsigned and proves nothing.",
        hint=f"Try it on the reader. If it was reset or its key was rotated elsewhere, tap it: agree {uuid} --rotate",
    )


def agreed_elsewhere(station: Station, node: Conversation) -> str:
    """Return a node's hint, outside a session, of a key that another station agreed on, in words; empty for none.

    The epoch is that of a plain Identify. The other station is known only from a datasheet that this station trusts,
    and the new owner may not have signed one yet.
    """
    held = max((record.epoch for record in station.keys.keys_of(node.uuid)), default=0)
    offered = node.identity.epoch
    if offered <= held:
        return ""
    how = "keyed elsewhere by tap or rotated by another holder (unverified)"  # a plain Identify does not show which
    hint = f"it reports key epoch {offered}, after {held} here: {how}"
    octets = _shown_security(node)
    try:
        shown = security.decode(octets)
    except BadDataError:
        return hint
    if shown.station_key not in (None, station.point) and signature_good(shown, octets, node.uuid):
        names = {record.point: record.name for record in station.policy.trusted("station")}
        digits = fingerprint(shown.station_key)[:16]
        if shown.station_key in names:
            return f"{hint}; its datasheet is signed by {names[shown.station_key]} ({digits})"
        if any(station_signature_good(shown, ca) for ca in station.policy.trusted_cas(node.uuid)):
            return f"{hint}; its datasheet is signed by station {digits}, which your CA certified"
    return f"{hint}; which station did so will show once it signs the datasheet"


def _shows_another_key(station: Station, node: Conversation) -> KeyMismatchError | None:
    """Return the error if the node shows another identity key than the pinned one: a copy with the same UUID."""
    try:
        shown = security.decode(_shown_security(node))
        if shown.node_key is not None:
            station.pins.check(node.uuid, shown.node_key)
    except BadDataError:
        return None
    except KeyMismatchError as mismatch:
        return mismatch
    return None


def _shown_security(node: Conversation) -> bytes:
    """Return the Security TEDS that a node shows outside a session; empty if it shows none."""
    try:
        return read_block(node, SECURITY)
    except (BadDataError, NodeRefusedError, LinkError):
        return b""


def _signed_for_another_ca(station: Station, uuid: bytes, teds: bytes) -> bool:
    """Return True if the datasheet is signed by a station that the CA to agree under here did not certify.

    A node accepts datasheets and keys from stations of the CA that it keeps only, so it would refuse an agreement (14).
    """
    try:
        shown = security.decode(teds)
    except BadDataError:
        return False
    signed = shown.station_key is not None and signature_good(shown, teds, uuid)
    return signed and not station_signature_good(shown, station.keys.ca_of(uuid))


def require_own_ca(station: Station, uuid: bytes, state: NodeState, teds: bytes) -> None:
    """Raise PolicyError for a node without a key of ours whose datasheet another owner's station signed.

    It is read outside a session: that may refuse, never permit. Checked before a person is asked anything, and before
    the node is whitelisted.
    """
    keyed = state != NodeState.FACTORY and not station.keys.held(uuid)
    if not keyed or not _signed_for_another_ca(station, uuid, teds):
        return
    signer = security.decode(teds).station_key
    assert signer is not None
    raise PolicyError(
        f"Node {uuid.hex()} belongs to another owner's CA: station {fingerprint(signer)[:16]} signed its datasheet.",
        hint=OTHER_OWNER_REMEDY,
    )


def agree(
    station: Station,
    node: Conversation,
    who: IdentifiedNode,
    *,
    rotate: bool = False,
    newcomer: WhitelistEntry | None = None,
    take_over: TakeOver | None = None,
) -> AgreeResult:
    """End with a session open under an agreed key: the present one, or a new one.

    ``rotate`` requests a new one: inside a session if a key is known, else by tap. ``take_over`` is asked, with a
    question, before a node that has a key gets one without a session under a key of ours: the holder of the present one
    is locked out (Figure 5 of the paper). None: ``rotate`` itself is the confirmation. ``newcomer`` is the whitelist
    entry that is made together with the first key: a board of another owner refuses, and is never whitelisted. On a
    link that loses messages an agreement is repeated, five times at most. Raises NotWhitelistedError, KeyMismatchError,
    PolicyError, NodeRefusedError, NotAuthenticError, LinkError; after any interruption, the same call carries on.
    """
    again, word = 0, _TakeoverConsent(rotate, take_over)
    while True:
        try:
            return _agree(station, node, who, rotate=rotate, newcomer=newcomer, word=word, again=again > 0)
        except (NodeSilentError, GarbledError):
            again += 1
            if again == _BEGINNINGS or not node.is_alive():
                raise
            node.forget()


def _agree(
    station: Station,
    node: Conversation,
    who: IdentifiedNode,
    *,
    rotate: bool,
    newcomer: WhitelistEntry | None,
    word: _TakeoverConsent,
    again: bool,
) -> AgreeResult:
    new = who.state == NodeState.FACTORY
    # another owner's node: whitelisting would not help
    if not new and newcomer is None and station.pins.entry(node.uuid) is None:
        require_own_ca(station, node.uuid, who.state, who.security_teds)
    with station.reading():
        returning = _may_return(station, who)
        entry = newcomer
        if entry is None or station.pins.entry(node.uuid) is not None:
            entry = station.policy.require_whitelisted(node.uuid, returning=returning)
    demanded = rotate and not again
    # After a run that was just cut, the node may have the new key, even if it reported factory state before.
    held = open_session(station, node, word=rotate) if not new or again else None
    if held is not None:
        if newcomer is not None:  # the session proves the node, so whitelist it at once
            with station.durable("agree"):
                _enlist(station, newcomer)
        if demanded or station.keys.rotates_now(node.uuid):
            return _new_key(station, node, who, entry, returning=returning, demanded=True)
        return AgreeResult(held.record.epoch, held.record.key_id, fresh=again)
    if not new:
        require_own_ca(station, node.uuid, who.state, who.security_teds)
        word.require(station, node)
    return _new_key(station, node, who, entry, returning=returning, demanded=demanded)


@dataclass
class _TakeoverConsent:
    """A person's word that a node with another station's key is to get one of ours; asked for once in a run."""

    rotate: bool
    take_over: TakeOver | None
    given: bool = False

    def require(self, station: Station, node: Conversation) -> None:
        """Raise PolicyError, or the question's error, if it is not confirmed."""
        if self.given:
            return
        if station.keys.held(node.uuid) and not self.rotate:
            raise unknown_key(station, node)
        if self.take_over is not None:
            uuid = node.uuid.hex()
            self.take_over(
                f"Node {uuid} has a key that this station does not hold. Take the node over and lock"
                " out the current holder?",
                must_take_over(station, node.uuid),
            )
        elif not self.rotate:
            raise must_take_over(station, node.uuid)
        self.given = True


def must_take_over(station: Station, uuid: bytes) -> PolicyError:
    """Return the error if a node has another station's key, and a take-over was not confirmed."""
    listed = station.pins.entry(uuid) is not None
    first = "" if listed else "identify --add, then "
    return PolicyError(
        f"Node {uuid.hex()} has a key that this station does not hold; a new key would lock out the current holder.",
        hint=f"Have the key handed over (export-keys there), or take the node over at a tap:"
        f" {first}agree {uuid.hex()} --rotate --yes",
    )


def _new_key(
    station: Station, node: Conversation, who: IdentifiedNode, entry: WhitelistEntry, *, returning: bool, demanded: bool
) -> AgreeResult:
    """Agree on a key; if none is ``demanded``, one that a new node has stored after all is as good."""
    new = who.state == NodeState.FACTORY
    if new:
        station.policy.require_undisputed(node.uuid)
        station.plant.require_role(
            "line", "cannot key new nodes", "Key it on a station that has this role, then have it handed over"
        )
    pinned = _pin_for(entry, node, who)
    ca = station.ca if new else station.keys.ca_of(node.uuid)
    try:
        # Without a session, the Security TEDS read during identification counts: on this link, just now.
        teds = read_block(node, SECURITY) if node.sealed or who.recalled else who.security_teds
        return _agree_anew(station, node, pinned, ca, teds, returning=returning, only_new=new and not demanded)
    except NodeRefusedError as refusal:
        # The node may have answered Identify while it was still storing the key of a run that was cut.
        late = refusal.reason == Reason.NOT_PERMITTED and new and not demanded
        held = open_session(station, node) if late else None
        if held is None:
            raise
        return AgreeResult(held.record.epoch, held.record.key_id, fresh=True)
    except SessionLostError as lost:
        raise lost.cause from lost


def _enlist(station: Station, entry: WhitelistEntry) -> None:
    """Put a node onto the whitelist, unless another process did so meanwhile."""
    present = station.pins.entry(entry.uuid)
    if present == entry or (present is not None and entry.fingerprint is None):
        return
    station.pins.put(entry)
    if present is None:
        facts = {"fingerprint": entry.fingerprint, "assurance": entry.assurance}
        station.audit("whitelist", entry.uuid, "added", **facts)


def _may_return(station: Station, who: IdentifiedNode) -> bool:
    """Return True if a node whose move was closed by its receipt may be keyed here again, if it proves to be reset."""
    if who.state != NodeState.FACTORY:
        return False
    uuid = who.uuid
    tombstone = station.policy.tombstone(uuid)
    row = station.handovers.get(tombstone.handover_id, "out") if tombstone is not None else None
    return row is not None and row.state == "closed" and not station.keys.held(uuid)


def _pin_for(entry: WhitelistEntry, node: Conversation, who: IdentifiedNode) -> WhitelistEntry:
    """Return the entry with its fingerprint, pinned now if this contact may pin.

    A contact pins by a tap, or over the bus of a new CAN node.
    """
    if entry.fingerprint is not None:
        return entry
    if node.tapped:
        return replace(entry, fingerprint=who.fingerprint, assurance="tap")
    if who.state == NodeState.FACTORY and node.wired:
        return replace(entry, fingerprint=who.fingerprint, assurance="bus")
    raise PolicyError(
        f"Node {node.uuid.hex()} is whitelisted by UUID only; its key can only be pinned by tap.",
        hint="Tap it once (--via nfc), or add the fingerprint: whitelist add UUID --fingerprint F.",
    )


def _agree_anew(
    station: Station,
    node: Conversation,
    entry: WhitelistEntry,
    ca: bytes,
    teds: bytes,
    *,
    returning: bool = False,
    only_new: bool = False,
) -> AgreeResult:
    """Request, Confirm, Open; ``ca`` is the one that the node keeps, or will keep from now on.

    ``teds`` is the node's Security TEDS as it was read on this link, in the session if there is one. ``returning``
    nodes were given away: only an initial Security TEDS that is covered by the signature proves that they were reset
    since. ``only_new``: a take-over was not confirmed. Identify, which called it new, is a hint.
    """
    uuid = node.uuid
    try:
        agreed = _request(station, node, entry, ca, teds)
    except TranscriptMismatchError:  # the TEDS changed since it was read, or the reply was disturbed: try once more
        again = read_block(node, SECURITY)
        if fit_to_agree(again, uuid, entry.fingerprint).node_key != fit_to_agree(teds, uuid, None).node_key:
            raise NotAuthenticError(
                "The node presented two different keys.",
                hint="Either two boards are answering, or the tag is a copy. Check before you continue.",
            ) from None
        agreed = _request(station, node, entry, ca, again)
    key_id = agreed.key_id.hex()
    if returning and not agreed.unsigned:
        station.policy.require_not_given_away(uuid)
    if only_new and not agreed.unsigned:
        raise must_take_over(station, uuid)
    with station.durable("agree"):
        if returning:
            station.policy.take_back([uuid])
            station.audit("handover", uuid, "came back after a reset")
        station.keys.add_pending(uuid, key=agreed.key, key_id=agreed.key_id, epoch=agreed.epoch)
        station.keys.set_ca_of(uuid, ca)
        _enlist(station, entry)
        station.audit("agree", uuid, "pending", key_id=key_id, epoch=agreed.epoch, via=node.contact.link.via)
    node.request(agreed.confirm, "the key confirmation")
    node.forget()
    node.open(agreed.key, statics=(station.point, agreed.node))
    identity = read_identity(node)
    if identity.epoch != agreed.epoch:  # the node would refuse a datasheet for the other epoch
        raise NotAuthenticError(
            f"The node offered key epoch {agreed.epoch} but reports {identity.epoch} in its session.",
            hint="Its firmware counts epochs incorrectly; node check shows the rule.",
        )
    place = without_source(node.contact.bus)

    def record() -> None:
        with station.durable("agree", more_follows=True):
            station.keys.promote(uuid, key_id)
            station.plant.record_event(
                "agreed", uuid, fingerprint=fingerprint(agreed.node), epoch=agreed.epoch, key_id=key_id
            )
            station.nodes.met_at(uuid, place)
            station.nodes.remember(
                uuid,
                epoch=agreed.epoch,
                point=agreed.node,
                sequence=identity.sequence,
                state=int(identity.state),
                can_address=identity.can_address,
                last_seen=utc_now(),
            )
            station.keys.rotated(uuid)
            station.pins.settled(uuid)
            station.audit("agree", uuid, "done", key_id=key_id, epoch=agreed.epoch)

    station.run_in_background(record)  # the pending key also opens sessions, so the next reads need not wait for this
    return AgreeResult(agreed.epoch, key_id, fresh=True, listed=True)


def _request(station: Station, node: Conversation, entry: WhitelistEntry, ca: bytes, teds: bytes) -> AgreedKey:
    """Send one Request with a one-time key, and check its reply; neither side keeps anything yet."""
    fit_to_agree(teds, node.uuid, entry.fingerprint)
    agreement = StationAgreement(station.identity.credentials(ca), node.uuid)
    reply = node.request_retry_once(
        agreement.request(), "the key agreement"
    )  # the node keeps the agreement in RAM until the next Request
    with station.reading():
        epoch = station.pins.epoch_to_exceed(node.uuid, entry.fingerprint)
    return agreement.accept(reply, teds, pinned=entry.fingerprint, epoch=epoch)


# -- reset: back to factory state, signed by the node (profile.md, "Reset") --------------------------------------------


@dataclass(frozen=True)
class ResetReceipt:
    """SIG(node, "TEDS1 reset" ‖ 00 ‖ UUID ‖ epoch ‖ challenge): the node's proof that it is in factory state."""

    epoch: int
    challenge: bytes
    proof: bytes


def reset_node(station: Station, node: Conversation, who: IdentifiedNode) -> ResetReceipt:
    """Reset in a session; a node that is in factory state already gives the same proof plainly.

    The keys held for it are deleted only after the proof was verified. Raises PolicyError without a key,
    NotAuthenticError if the proof is wrong.
    """
    if who.state != NodeState.FACTORY:
        require_session(station, node)
    receipt = proof_of_reset(node, who.point)
    with station.durable("reset"):
        station.keys.remove(who.uuid)
        station.nodes.remember(who.uuid, state=int(NodeState.FACTORY), retired=None)
        station.datasheets.forget_reading(who.uuid)
        facts = {"challenge": receipt.challenge.hex(), "proof": receipt.proof.hex()}
        station.plant.record_event("reset", who.uuid, epoch=receipt.epoch, point=who.point.hex(), **facts)
        station.audit("reset", who.uuid, "done", epoch=receipt.epoch, **facts)
    return receipt


def proof_of_reset(node: Conversation, point: bytes) -> ResetReceipt:
    """Send Reset: in a session it resets, in factory state it changes nothing; either way the node signs its state.

    A node that has a key refuses it plainly (NodeRefusedError). Raises NotAuthenticError if the signature is wrong.
    """
    epoch = read_identity(node).epoch
    challenge = os.urandom(CHALLENGE_OCTETS)
    command = security_command(Function.RESET, challenge)
    try:
        proof = node.request(command, "the reset")
    except SessionLostError:  # the reply and the session were lost; in factory state the node sends the proof again
        node.forget()
        proof = node.request_plain(command, "the proof of its reset")
    node.forget()
    if not verify(point, reset_message(node.uuid, epoch, challenge), proof):
        raise NotAuthenticError("The node's reset receipt is not valid; its keys are kept here.")
    return ResetReceipt(epoch, challenge, proof)


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
    except NotWhitelistedError:  # another owner's CA may refuse the take-over, and then whitelisting would not help
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


def reset_at(station: Station, links: LinkSettings, uuid: bytes, reporter: Reporter) -> ResetReceipt:
    """Reset a node; see :func:`reset_node`."""
    with at_node(station, links, uuid, reporter, writes="reset") as visit:
        return reset_node(station, visit.node, visit.who)
