"""Meeting a node: open the port that the user chose, wait for the node, talk, and leave everything closed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from teds_provision.links import LinkSettings, open_port
from teds_provision.protocol.identity import Identity
from teds_provision.workflow.conversation import Conversation
from teds_provision.workflow.progress import Reporter
from teds_provision.workflow.station import Station


@contextmanager
def meet(station: Station, links: LinkSettings, uuid: bytes | None, reporter: Reporter) -> Iterator[Conversation]:
    """Wait for node ``uuid`` (None: any node) on the chosen link and give a conversation with it.

    Raises NoReader, NoNode after ``links.timeout`` seconds, AddressConflict.
    """

    def wanted(identity: Identity) -> bool:
        return uuid is None or identity.uuid == uuid

    known = station.store.node(uuid) if uuid is not None else None
    address = known.can_address if known is not None and known.can_address else None
    port = open_port(links)
    try:
        contact = port.find(wanted, seconds=links.timeout, notice=reporter.notice, address=address)
        with Conversation(contact, notice=reporter.notice) as node:
            yield node
    finally:
        port.close()
