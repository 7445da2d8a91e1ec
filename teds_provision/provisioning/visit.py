"""A visit to one node: meet it, take its lock, have it prove its key; then a command does its steps, and leaves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Literal

from teds_provision.links import LinkSettings
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import IdentifiedNode, identify
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.progress import Reporter
from teds_provision.station.station import Station

Unlock = Literal["always", "if held", "never"]


@dataclass(frozen=True)
class NodeVisit:
    """A node that was met and proved its identity key, for as long as the meeting lasts."""

    station: Station
    node: Conversation
    who: IdentifiedNode
    released: bool = False  # True if the running `ncap` measured the node and released it


@contextmanager
def at_node(
    station: Station,
    links: LinkSettings,
    uuid: bytes,
    reporter: Reporter,
    *,
    unlock: Unlock = "if held",
    writes: str = "",
) -> Iterator[NodeVisit]:
    """Meet node ``uuid`` on the chosen link and have it prove its key.

    The vault is opened before any wait: always, if a key of this node is held, or never. Another command of this
    station that works on the same node is waited for. ``writes`` is the command that writes to the node: a running
    `ncap` of this home that measures it releases it meanwhile. Raises NoReaderError, NoNodeError after
    ``links.timeout`` seconds, KeyMismatchError, NotAuthenticError, LinkError; PolicyError if the node is not released.
    """

    def before() -> None:
        if unlock != "never":
            station.unlock(None if unlock == "always" else uuid)

    with (
        meet(station, links, uuid, reporter, before=before) as node,
        station.node_lock(uuid),
        station.released(uuid, writes) if writes else nullcontext() as released,
    ):
        yield NodeVisit(station, node, identify(station, node, recall=unlock != "never"), bool(released))
