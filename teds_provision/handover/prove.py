"""A node counts as taken over when it opened a session here, under a key that after a move is new."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

from teds_provision.errors import LinkFailure, NoNode, TedsProvisionError
from teds_provision.links import LinkSettings, open_port
from teds_provision.station.station import Station
from teds_provision.steps.agree import require_session
from teds_provision.steps.identify import identify
from teds_provision.store import pages
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import Reporter


@dataclass(frozen=True)
class Proven:
    """A node that opened a session; ``rotated``: under a new key, so that the former holders are locked out."""

    uuid: bytes
    epoch: int
    rotated: bool


@dataclass(frozen=True)
class NotProven:
    """A node that did not, and why."""

    uuid: bytes
    why: str


def prove_node(station: Station, node: Conversation) -> Proven:
    """Have one node prove its identity key and open a session; a move's key is rotated in it.

    Raises TedsProvisionError: link, other key, unknown key.
    """
    due = station.keys.rotation_due(node.uuid) is not None
    identify(station, node)
    held = require_session(station, node)
    station.audit("handover", node.uuid, "taken over", epoch=held.record.epoch, rotated=due)
    return Proven(node.uuid, held.record.epoch, rotated=due)


def proven_of(station: Station, uuids: Iterable[bytes]) -> set[bytes]:
    """Those of many nodes with which a session was opened under the key that is held, and no rotation is due."""
    proven: set[bytes] = set()
    for page in pages(uuids):
        active = {key.uuid for key in station.keys.of_page(page) if key.state == "active"}
        proven |= active - station.keys.due_of_page(page)
    return proven


def prove_nodes(
    station: Station,
    links: LinkSettings,
    uuids: Sequence[bytes],
    reporter: Reporter,
    *,
    hold: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> list[Proven | NotProven]:
    """Meet each of these nodes on the chosen link, in whatever order they come; ends when none comes in time.

    ``hold`` holds the store for as long as one node is worked on, never while one is waited for.
    """
    waiting, outcomes = set(uuids), dict[bytes, Proven | NotProven]()
    try:
        port = open_port(links)
    except LinkFailure as error:
        return [NotProven(uuid, error.message) for uuid in uuids]
    try:
        while waiting:
            try:
                contact = port.find(
                    lambda identity: identity.uuid in waiting, seconds=links.timeout, notice=reporter.notice
                )
            except NoNode:
                break
            uuid = contact.identity.uuid
            waiting.discard(uuid)
            try:
                with Conversation(contact, notice=reporter.notice) as node, hold():
                    outcomes[uuid] = prove_node(station, node)
            except TedsProvisionError as error:
                outcomes[uuid] = NotProven(uuid, error.message)
    except LinkFailure as error:
        return [outcomes.get(uuid, NotProven(uuid, error.message)) for uuid in uuids]
    finally:
        port.close()
    return [outcomes.get(uuid, NotProven(uuid, "it was not met")) for uuid in uuids]
