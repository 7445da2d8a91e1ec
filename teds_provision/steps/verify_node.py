"""Step 7 at a node: whether the session, or the node's own signature, vouches for what was read, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256

from teds_provision.errors import LinkFailure, NodeRefused, NotAuthentic
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.station.station import Station
from teds_provision.steps.agree import agreed_elsewhere, session_if_keyed
from teds_provision.steps.identify import Identified, prove
from teds_provision.steps.read import read_block, read_identity, read_image
from teds_provision.steps.reset import proof_of_reset
from teds_provision.steps.verify import Check, Verified, known_of, possession, session, verify_image
from teds_provision.store import utc_now
from teds_provision.talk.conversation import HEARD, Conversation
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.image import SECURITY, Image


@dataclass(frozen=True)
class Looked:
    """A node's TEDS, and what they are worth; ``read`` False: they are those that were kept from an earlier reading."""

    image: Image
    verified: Verified
    read: bool = True


def look_at_node(station: Station, node: Conversation, who: Identified) -> Looked:
    """Open a session where a key is held, read every TEDS and judge them; raises LinkFailure and what a read raises.

    One in which the node answers nothing but that it is busy is as good as none: then all is read without it.
    """
    why = open_or_say_why(station, node)
    try:
        image = read_image(node)
    except NodeRefused as refusal:
        if not (node.sealed and refusal.message.startswith(HEARD)):
            raise
        node.forget()
        why, image = _said(refusal), read_image(node)
    return Looked(image, verify_node(station, node, image, who.point, why=why))


def look_in_session(station: Station, node: Conversation) -> Looked:
    """Judge the TEDS of a node in the session that is open. Raises LinkFailure, NodeRefused; records nothing.

    Where its Security TEDS is octet for octet the one that was kept, the rest need not be read again: it names the
    digest of every other TEDS. Everything is judged anew all the same: trust, bans and pins may have changed since.
    """
    identity = read_identity(node)
    octets = read_block(node, SECURITY)
    kept = station.nodes.datasheet(node.uuid)
    known = kept is not None and kept.security == octets
    image = kept if kept is not None and known else read_image(node)
    checks = verify_image(station, image, known=known_of(station, node.uuid, identity))
    checks.append(session("opened under the key that is held here", ""))
    return Looked(image, Verified(node.uuid, tuple(checks)), read=not known)


def open_or_say_why(station: Station, node: Conversation) -> str:
    """Open a session where a key is held; why there is none although one is held, else an empty text.

    Raises LinkFailure, and NodeRefused for a refusal in the session.
    """
    try:
        held = session_if_keyed(station, node)
    except NodeRefused as refusal:
        if node.sealed:
            raise
        return _said(refusal)
    if held is None and station.keys.held(node.uuid) and station.policy.tombstone(node.uuid) is None:
        elsewhere = agreed_elsewhere(station, node)
        return "the node opens no session under any key that is held here" + (elsewhere and f"; {elsewhere}")
    return ""


def _said(refusal: NodeRefused) -> str:
    return refusal.message.removeprefix(HEARD).rstrip(".")


def verify_node(station: Station, node: Conversation, image: Image, point: bytes, *, why: str = "") -> Verified:
    """Check what was read off a node, have it prove its key, and record the verdict. Raises only for the link.

    ``why`` says why there is no session although a key is held: then nothing of what was read is recorded.
    """
    identity = (node.proven or read_identity(node)) if node.sealed else None
    with station.reading():
        checks: list[Check] = verify_image(station, image, known=known_of(station, node.uuid, identity))
    checks.append(possession(lambda: prove(node, point)))
    checks.append(vouched(node, point, why))
    verified = Verified(node.uuid, tuple(checks))
    if verified.verdict == "unproven" or checks[-1].result == "failed":
        station.audit("verify", node.uuid, verified.verdict, why=why)
        return verified
    facts = _facts(image, verified, identity)
    with station.durable("verify"):
        worth = identity is not None and verified.verdict != "not authentic"  # else what it had stays known
        if worth and station.nodes.datasheet(node.uuid) != image:
            station.nodes.keep_datasheet(image)
        station.nodes.remember(node.uuid, **facts)
        station.audit("verify", node.uuid, verified.verdict)
    return verified


def _facts(image: Image, verified: Verified, identity: Identity | None) -> dict[str, object]:
    """What is remembered of a node that was read; ``identity`` is what it said in a session, None outside one."""
    facts: dict[str, object] = {
        "verdict": verified.verdict,
        "channels": len({c for c, code in image if code == AccessCode.CHANNEL}),
    }
    if image.security is not None:
        facts["teds_sha256"] = sha256(image.security).hexdigest()
    if identity is not None:
        facts |= {
            "state": int(identity.state),
            "epoch": identity.epoch,
            "sequence": identity.sequence,
            "can_address": identity.can_address,
            "last_seen": utc_now(),
        }
    return facts


def vouched(node: Conversation, point: bytes, why: str) -> Check:
    """Whether the node itself is known to have said this: in a session, or by its signature that it was reset.

    ``why`` is what :func:`open_or_say_why` said; the check has failed where a key is held and neither came about.
    """
    if node.sealed:
        return session("opened under the key that is held here", "")
    if why and node.identity.state == NodeState.FACTORY:
        try:
            proof_of_reset(node, point)
        except (NotAuthentic, NodeRefused, LinkFailure):
            return session("", f"{why}, and it does not prove that it was reset")
        return session("the node signed that it was reset: the key that is held here is gone from it", "")
    return session("", why)
