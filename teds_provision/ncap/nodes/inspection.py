"""Inspection of one node that came to a link: its identity, its datasheet's verdict, its power.

Detection is applied here (operation.md section 7): in whitelist mode a session is opened only with a node that is on
the list under its key; transparent mode also reads strangers, within limits.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Final

from teds_provision.errors import BadDataError, NodeRefusedError
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.operation.commands import POWER, PowerReply
from teds_provision.provisioning.agree import session_if_keyed
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.firmware import read_firmware
from teds_provision.provisioning.identify import IdentifiedNode, identify
from teds_provision.provisioning.readings import is_keyed, keep
from teds_provision.provisioning.teds_read import list_blocks, read_block, read_identity, read_image
from teds_provision.provisioning.verify import freshness_floor_of, session_check, verify_image
from teds_provision.provisioning.verify_node import verify_in_session
from teds_provision.shapes.verdict import NodeVerdict, Verification
from teds_provision.station.firmware import firmware_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.sheet import Sheet

STRANGERS_TEDS: Final = 256
STRANGERS_OCTETS: Final = 65_535
STRANGERS_SECONDS: Final = 60.0


@dataclass(frozen=True)
class NodeInspection:
    """Result of an inspection. ``sheet`` is that of a node whose datasheet is not stored here, else None.

    A ``judged`` that came in no session is shown beside the node's reading, and changes no row. ``firmware`` is what a
    node reported in no session, marked so; it is not stored.
    """

    judged: NodeVerdict
    sheet: Sheet | None = None
    power: dict[str, Any] | None = None
    firmware: dict[str, Any] | None = None


def look(station: Station, node: Conversation) -> NodeInspection:
    """Verify a node: in a session if its key is held here, else its plain answers; raises TedsProvisionError."""
    if station.keys.held(node.uuid) and node.identity.state != NodeState.FACTORY:
        found = _in_session(station, node)
        if found is not None:
            return found
    who = identify(station, node)
    return _stranger(station, node, who)


def _in_session(station: Station, node: Conversation) -> NodeInspection | None:
    """Inspect the node in a session, with the checks of a measurement."""
    if session_if_keyed(station, node) is None:
        return None
    looked = verify_in_session(station, node, by="ncap")
    sheet = Sheet.from_image(looked.image) if looked.verified.verdict == "not authentic" else None
    return NodeInspection(looked.judged, sheet, power_of(node))


def read_anew(station: Station, node: Conversation) -> tuple[Image, NodeVerdict] | None:
    """Read every TEDS of a node in a session, and keep that reading; None if no session can be opened."""
    if session_if_keyed(station, node) is None:
        return None
    c, identity = node.open_counter, read_identity(node)
    image = read_image(node)
    floor = freshness_floor_of(station, node.uuid, identity)
    with station.durable("read"):
        return image, keep(station, node, image, by="ncap", floor=floor, c=c)


def _stranger(station: Station, node: Conversation, who: IdentifiedNode) -> NodeInspection:
    """Inspect a node without a held key: its TEDS are read to be shown, and not stored."""
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
    reported = firmware_of(station, node.uuid, read_firmware(node, once=True))
    checks = (*verify_image(station, image, floor=freshness_floor_of(station, node.uuid, None)), session_check("", why))
    return NodeInspection(
        NodeVerdict(Verification(node.uuid, checks), "plain", utc_now(), "ncap"),
        Sheet.from_image(image),
        firmware=None if reported is None else reported.to_json(),
    )


def power_of(node: Conversation) -> dict[str, Any] | None:
    """Return the reply to 128.18 in an open session, None if the node has none."""
    try:
        return PowerReply.decode(node.request(POWER, "to report its power")).as_json()
    except (NodeRefusedError, BadDataError):
        return None
