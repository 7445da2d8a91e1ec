"""The ``identify`` command: who lies on the reader or hangs on the bus, once or as they come."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from teds_provision.errors import TedsProvisionError
from teds_provision.links import LinkSettings, Notice
from teds_provision.protocol.messages.identity import Identity
from teds_provision.station.station import Station
from teds_provision.steps.identify import Identified, describe, identify
from teds_provision.steps.provision import add_to_whitelist
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.meeting import meet_everyone
from teds_provision.talk.progress import Reporter
from teds_provision.talk.watching import Came, watch_nodes


@dataclass(frozen=True)
class Found:
    """A node that proved its key; ``identity`` is its plain Identify, a hint."""

    who: Identified
    identity: Identity
    whitelisted: bool
    channels: int
    name: str | None
    charging: dict[str, object] | None = None
    ble: str | None = None


def identify_at(
    station: Station,
    links: LinkSettings,
    reporter: Reporter,
    *,
    add: bool = False,
    watch: bool = False,
    stop: threading.Event | None = None,
) -> Iterator[Came[Found]]:
    """Identify who is there, or (``watch``) whoever comes until ``stop``; ``add`` whitelists what proves its key.

    With ``watch`` an error ends one node only. Without it that is so where another node was identified, and it is told
    as a notice; else the first error is raised.
    """
    if add:
        station.unlock()  # before a node lies there: a pin is sealed by the vault
    if watch:
        yield from watch_nodes(links, lambda node: _one(station, node, add), reporter, stop or threading.Event())
        return
    first: TedsProvisionError | None = None
    identified = False
    with meet_everyone(links, reporter) as nodes:
        for node, found in _side_by_side(nodes, lambda node: _one(station, node, add)):
            if isinstance(found, Found):
                identified = True
                yield Came(node.uuid, links.places[0], 0.0, found)
                continue
            first = first or found
            if len(nodes) > 1:
                text = f"Node {node.uuid.hex()} was not identified: {found.message}"
                reporter.notice(Notice("unfinished", text, uuid=node.uuid))
    if first is not None and not identified:
        raise first


def _side_by_side(
    nodes: list[Conversation], work: Callable[[Conversation], Found]
) -> Iterator[tuple[Conversation, Found | TedsProvisionError]]:
    """What became of each node, in their order: as many at a time as the link bears, as a mute one takes 40 s."""

    def one(node: Conversation) -> Found | TedsProvisionError:
        try:
            return work(node)
        except TedsProvisionError as error:
            return error

    at_once = min(len(nodes), *(node.contact.link.capabilities.at_once for node in nodes))
    if at_once < 2:
        yield from ((node, one(node)) for node in nodes)
        return
    pool = ThreadPoolExecutor(at_once, thread_name_prefix="node")
    try:
        yield from zip(nodes, pool.map(one, nodes), strict=True)
    finally:  # after a Ctrl-C nobody is waited for: the bus is closed next
        pool.shutdown(wait=False, cancel_futures=True)


def _one(station: Station, node: Conversation, add: bool) -> Found:
    who = identify(station, node)
    described = describe(node)
    entry = who.whitelisted
    if entry is None and add:
        entry = add_to_whitelist(station, node, who)
    known = station.nodes.get(who.uuid)
    name = (known.name if known else None) or described.name
    facts: dict[str, object] = {}
    read = station.nodes.reading(who.uuid)
    if read is None or not read.is_datasheet:  # nothing is verified here: it stands for what is not known better
        facts["channels"] = described.channels
        if name is not None and station.nodes.all_named(name) in ([], [who.uuid]):
            facts["name"] = name
    with station.durable("identify"):
        station.nodes.remember(who.uuid, **facts)
        station.audit("identify", who.uuid, "proven", fingerprint=who.fingerprint)
    return _found(node, who, listed=entry is not None, channels=described.channels, name=name)


def _found(node: Conversation, who: Identified, *, listed: bool, channels: int, name: str | None) -> Found:
    charging = node.contact.charging.to_json() if node.contact.charging else None
    ble = node.contact.ble.text if node.contact.ble else None
    return Found(who, node.identity, listed, channels, name, charging, ble)
