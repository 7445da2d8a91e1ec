"""Step 7 at a node: proof of what was read, by the session or the node's own signature, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256

from teds_provision.errors import LinkError, NodeRefusedError, NotAuthenticError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning import readings
from teds_provision.provisioning.agree import agreed_elsewhere, proof_of_reset, session_if_keyed
from teds_provision.provisioning.conversation import HEARD, Conversation
from teds_provision.provisioning.firmware import keep_firmware, read_firmware
from teds_provision.provisioning.identify import IdentifiedNode, prove
from teds_provision.provisioning.image_file import VerifyReport, concluded, node_or_image, verify_image_alone
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.teds_read import read_block, read_identity, read_image
from teds_provision.provisioning.verify import freshness_floor_of, possession_check, session_check, verify_image
from teds_provision.provisioning.visit import at_node
from teds_provision.shapes.verdict import Check, NodeVerdict, Verification
from teds_provision.station.firmware import KnownFirmware, firmware_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import SECURITY, Image


@dataclass(frozen=True)
class NodeVerification:
    """A node's TEDS, and what they are worth."""

    image: Image
    judged: NodeVerdict

    @property
    def verified(self) -> Verification:
        """All checks, and the verdict."""
        return self.judged.verified

    @property
    def kept(self) -> bool:
        """True if all but the Security TEDS is as it was read before the node's last start."""
        return self.judged.origin == "kept"


def verify_at_node(station: Station, node: Conversation, who: IdentifiedNode) -> NodeVerification:
    """Open a session if a key is held, read every TEDS and judge them; raises LinkError and what a read raises.

    A session in which the node answers only that it is busy counts as none: then all is read without it.
    """
    why = open_or_say_why(station, node)
    c = node.open_counter
    try:
        image = read_image(node)
    except NodeRefusedError as refusal:
        if not (node.sealed and refusal.message.startswith(HEARD)):
            raise
        node.forget()
        why, image = _why(refusal), read_image(node)
    return NodeVerification(image, judge_and_keep(station, node, image, who.point, why=why, c=c))


def verify_in_session(station: Station, node: Conversation, *, by: str) -> NodeVerification:
    """Judge the TEDS of a node in the session that is open. Raises LinkError, NodeRefusedError.

    If its Security TEDS is octet for octet the one that was read before, and the rest had no fault then, the rest is
    not read again here: the Security TEDS contains the digest of every other TEDS. c of the session shows whether the
    node has started since; then the rest's verdict is ``kept``, until it is read (:mod:`.readings`). Everything is
    judged again all the same: trust, bans and pins may have changed.
    """
    identity, c = read_identity(node), node.open_counter
    keep_firmware(station, node.uuid, read_firmware(node))
    octets = read_block(node, SECURITY)
    floor = freshness_floor_of(station, node.uuid, identity)
    image = readings.cached_image_if_current(station, node, octets, floor)
    if image is not None:
        judged = readings.verdict_of(station, node.uuid)
        assert judged is not None, "a reading that stands is there"
        return NodeVerification(image, judged)
    image = read_image(node)
    return NodeVerification(image, readings.keep(station, node, image, by=by, floor=floor, c=c))


def open_or_say_why(station: Station, node: Conversation) -> str:
    """Open a session if a key is held; return why there is none although one is held, else an empty text.

    Raises LinkError, and NodeRefusedError for a refusal in the session.
    """
    try:
        held = session_if_keyed(station, node)
    except NodeRefusedError as refusal:
        if node.sealed:
            raise
        return _why(refusal)
    if held is None and station.keys.held(node.uuid) and station.policy.tombstone(node.uuid) is None:
        elsewhere = agreed_elsewhere(station, node)
        return "the node does not open a session with any key held here" + (elsewhere and f"; {elsewhere}")
    return ""


def _why(refusal: NodeRefusedError) -> str:
    return refusal.message.removeprefix(HEARD).rstrip(".")


def judge_and_keep(
    station: Station,
    node: Conversation,
    image: Image,
    point: bytes,
    *,
    why: str = "",
    by: str = "verify",
    c: bytes | None = None,
    more_follows: bool = False,
) -> NodeVerdict:
    """Check what was read off a node, have it prove its key, and keep the reading. Raises only for the link.

    ``why``: why there is no session although a key is held; then nothing of the reading is kept. ``by`` is the command,
    ``c`` that of the session in which the reading began. ``more_follows``: in a run the reading reaches the disk in the
    transaction of the next durable step.
    """
    identity = (node.proven or read_identity(node)) if node.sealed else None
    firmware = read_firmware(node) if node.sealed else None
    possessed, vouch = possession_check(lambda: prove(node, point)), provenance_check(node, point, why)
    floor = freshness_floor_of(station, node.uuid, identity)
    if vouch.result == "failed":
        with station.reading():
            verified = Verification(node.uuid, (*verify_image(station, image, floor=floor), possessed, vouch))
        station.audit("verify", node.uuid, verified.verdict, why=why)
        return NodeVerdict(verified, "plain", utc_now(), by)
    more = [possessed] if node.sealed or vouch.result == "skipped" else [possessed, vouch]
    c = (c or node.open_counter) if node.sealed else None
    with station.reading():
        row, judged = readings.judge_reading(station, image, c, by=by, floor=floor, more=more)

    def record() -> None:
        readings.keep_judged(station, row, judged, image)
        keep_firmware(station, image.uuid, firmware)
        kept = station.datasheets.reading(image.uuid)
        if identity is not None or (kept is not None and not kept.in_session):
            station.nodes.remember(image.uuid, **_facts(image, identity))
        station.audit("verify", image.uuid, judged.verified.verdict)

    def record_durably() -> None:
        with station.durable("verify"):
            record()

    if more_follows:
        station.join_next_step(record)
    else:  # in a run, the result waits for the disk; the hardware check goes on meanwhile
        station.run_in_background(record_durably)
    return judged


def _facts(image: Image, identity: Identity | None) -> dict[str, object]:
    """Return the facts to record of a node that was read.

    ``identity`` is its Identify in a session, None outside one.
    """
    facts: dict[str, object] = {"channels": len({c for c, code in image if code == AccessCode.CHANNEL})}
    if image.security is not None:
        facts["teds_sha256"] = sha256(image.security).hexdigest()
    if identity is not None:
        facts |= {
            "state": int(identity.state),
            "epoch": identity.epoch,
            "sequence": identity.sequence,
            "can_address": identity.can_address,
            "last_seen": utc_now(),
            "retired": None,
        }
    return facts


def provenance_check(node: Conversation, point: bytes, why: str) -> Check:
    """Check that the node itself sent this: in a session, or by its signature that it was reset.

    ``why`` comes from :func:`open_or_say_why`; the check fails if a key is held and neither succeeded.
    """
    if node.sealed:
        return session_check("opened with the key held here", "")
    if why and node.identity.state == NodeState.FACTORY:
        try:
            proof_of_reset(node, point)
        except (NotAuthenticError, NodeRefusedError, LinkError):
            return session_check("", f"{why}, and it did not prove that it was reset")
        return session_check("the node signed that it was reset: it no longer has the key held here", "")
    return session_check("", why)


def verify_at(
    station: Station,
    links: LinkSettings,
    what: str,
    reporter: Reporter,
    *,
    accept_calibration: str | None = None,
    accept_firmware: bool = False,
    is_node: bool = False,
) -> VerifyReport:
    """Check the image file, or the node, that ``what`` names; with ``is_node`` a node's name goes first.

    ``accept_firmware``: the calibration holds with the firmware that runs now. ``error``: NotAuthenticError (4),
    UnprovenError (5), or PolicyError (6) for a calibration that would hurt.
    """
    found = node_or_image(station, what, is_node=is_node)
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
    except NodeRefusedError as refusal:  # outside a session, any device may have sent it, so it decides nothing
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
