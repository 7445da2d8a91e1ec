"""One node that came to a link: who it is, what its datasheet is worth, what it has to say of its power.

What detection allows (operation.md section 7) is decided here: in whitelist mode a session is opened only with a node
that is on the list under its key; transparent mode also reads strangers, within limits.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

from teds_provision.errors import BadDataError, NodeRefusedError, TedsProvisionError
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.operation.commands import POWER, PowerReply
from teds_provision.station.station import Station
from teds_provision.steps.agree import session_if_keyed
from teds_provision.steps.identify import IdentifiedNode, identify
from teds_provision.steps.readings import NodeVerdict, is_keyed, keep
from teds_provision.steps.teds_read import list_blocks, read_block, read_identity, read_image
from teds_provision.steps.verify import Verification, freshness_floor_of, session_check, verify_image
from teds_provision.steps.verify_node import verify_in_session
from teds_provision.store import utc_now
from teds_provision.talk.conversation import Conversation
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.sheet import Sheet

STRANGERS_TEDS: Final = 256
STRANGERS_OCTETS: Final = 65_535
STRANGERS_SECONDS: Final = 60.0


@dataclass(frozen=True)
class NodeInspection:
    """What was found out. ``sheet`` is that of a node whose datasheet is not kept here, None otherwise.

    A ``judged`` that came in no session is shown beside the node's row of reading, and changes no row.
    """

    judged: NodeVerdict
    sheet: Sheet | None = None
    power: dict[str, Any] | None = None


def look(station: Station, node: Conversation) -> NodeInspection:
    """Verify a node: in a session where its key is held here, else what it shows; raises TedsProvisionError."""
    if station.keys.held(node.uuid) and node.identity.state != NodeState.FACTORY:
        found = _in_session(station, node)
        if found is not None:
            return found
    who = identify(station, node)
    return _stranger(station, node, who)


def _in_session(station: Station, node: Conversation) -> NodeInspection | None:
    """In a session, as before a measurement."""
    if session_if_keyed(station, node) is None:
        return None
    looked = verify_in_session(station, node, by="ncap")
    sheet = Sheet.from_image(looked.image) if looked.verified.verdict == "not authentic" else None
    return NodeInspection(looked.judged, sheet, power_of(node))


def read_anew(station: Station, node: Conversation) -> tuple[Image, NodeVerdict] | None:
    """Read every TEDS of a node in a session, and keep that reading; None where no session comes about."""
    if session_if_keyed(station, node) is None:
        return None
    c, identity = node.open_counter, read_identity(node)
    image = read_image(node)
    known = freshness_floor_of(station, node.uuid, identity)
    with station.durable("read"):
        return image, keep(station, node, image, by="ncap", known=known, c=c)


def _stranger(station: Station, node: Conversation, who: IdentifiedNode) -> NodeInspection:
    """A node of which no key is held: its TEDS are read to be shown, and nothing of it is kept."""
    until = time.monotonic() + STRANGERS_SECONDS
    blocks = {SECURITY: who.security_teds}
    for block in list_blocks(node)[:STRANGERS_TEDS]:
        if block == SECURITY:
            continue
        octets = read_block(node, block, until=until)
        if len(octets) > STRANGERS_OCTETS:
            raise BadDataError(
                f"TEDS {block[1]} of channel {block[0]} has {len(octets)} octets: too long for an untrusted node."
            )
        blocks[block] = octets
    image = Image(node.uuid, blocks)
    why = "the node does not open a session with any key held here" if is_keyed(station, node.uuid) else ""
    checks = (*verify_image(station, image, known=freshness_floor_of(station, node.uuid, None)), session_check("", why))
    return NodeInspection(
        NodeVerdict(Verification(node.uuid, checks), "plain", utc_now(), "ncap"), Sheet.from_image(image)
    )


def power_of(node: Conversation) -> dict[str, Any] | None:
    """128.18 in an open session, None where the node does not tell."""
    try:
        return PowerReply.decode(node.request(POWER, "to tell its power")).as_json()
    except (NodeRefusedError, BadDataError):
        return None


def as_problem(error: TedsProvisionError) -> dict[str, str]:
    """An error as the API tells it."""
    return {"code": error.code, "message": error.message, "hint": error.hint}
