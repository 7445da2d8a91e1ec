"""Set CAN address (128.10): plainly by tap, or in a session (profile.md, "CAN")."""

from __future__ import annotations

from teds_provision.errors import Garbled, NodeSilent
from teds_provision.links.ports import OnABus
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.station.station import Station
from teds_provision.steps.agree import open_session
from teds_provision.steps.read import read_identity
from teds_provision.talk.conversation import Conversation, SessionLost


def set_address(station: Station, node: Conversation, address: int) -> bool:
    """Give the node another CAN address, 1 to 239, durably; False where it has it already.

    Its reply still leaves from the old address; the node is met at the new one from then on. A board that moves at once
    loses that reply: where none comes over the bus, who is at the new address is asked before wiring is spoken of.
    Raises NodeRefused (3: neither tapped nor in a session; 17: written less than 10 s ago), OtherKey, LinkFailure.
    """
    if node.identity.can_address == address:
        return False
    open_session(station, node)
    try:
        node.send(security_command(Function.SET_CAN_ADDRESS, bytes([address])), "the new CAN address")
    except SessionLost as lost:
        raise lost.cause from lost
    except (NodeSilent, Garbled):
        if not _is_at(node, address):
            raise
    if node.contact.address is not None:
        node.forget()  # a link is one pair of addresses: this session ended with the old one
    elif node.sealed and _address_of(node) != address:
        raise Garbled("The node took the new CAN address and still shows the old one.")
    with station.durable("address"):
        station.nodes.remember(node.uuid, can_address=address)
        station.audit("address", node.uuid, "done", address=address)
    return True


def _is_at(node: Conversation, address: int) -> bool:
    """Whether this node answers at the new address; what it says there is a hint, as every address is."""
    link = node.contact.link
    there = link.there(address) if isinstance(link, OnABus) else None
    return there is not None and there.uuid == node.uuid


def _address_of(node: Conversation) -> int:
    return read_identity(node).can_address
