"""``address``: give a node another CAN address."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.errors import GarbledError, NodeSilentError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.links.ports import MultiStationLink
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.provisioning.agree import open_session
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.teds_read import read_identity
from teds_provision.provisioning.visit import at_node
from teds_provision.station.station import Station


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
        node.forget()  # a link is one pair of addresses, so the session ended with the old one
    elif node.sealed and read_identity(node).can_address != address:
        raise GarbledError("The node accepted the new CAN address but still reports the old one.")
    with station.durable("address"):
        station.nodes.remember(node.uuid, can_address=address)
        station.audit("address", node.uuid, "done", address=address)
    return True


def _is_at(node: Conversation, address: int) -> bool:
    """Return True if this node answers at the new address; its answer is a hint, as every address is."""
    link = node.contact.link
    there = link.identify_at(address) if isinstance(link, MultiStationLink) else None
    return there is not None and there.uuid == node.uuid
