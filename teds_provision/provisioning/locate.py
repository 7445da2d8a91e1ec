"""``locate``: make a board blink or beep, alone, one after the other to name them, or while it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from teds_provision.errors import NodeRefusedError, TedsProvisionError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.build import require_free_name
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.visit import at_node
from teds_provision.station.station import Station


def locate(node: Conversation, seconds: int) -> None:
    """Make a node blink or beep, 0: stop; needs a session, or a node in factory state. Raises NodeRefusedError."""
    try:
        node.request_retry_once(security_command(Function.LOCATE, bytes([seconds])), "to blink")
    except NodeRefusedError as refusal:
        if refusal.reason != Reason.UNKNOWN_COMMAND:
            raise
        raise NodeRefusedError(
            f"Node {node.uuid.hex()} cannot blink or beep.", reason=refusal.reason, hint="Press its button instead."
        ) from refusal


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
