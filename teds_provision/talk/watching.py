"""Node after node: the same work for each that comes, until someone says stop; one that fails does not end it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import TypeVar

from teds_provision.errors import TedsProvisionError
from teds_provision.links import LinkSettings, open_port
from teds_provision.station.station import Station
from teds_provision.talk.conversation import Conversation, SessionLost
from teds_provision.talk.progress import Reporter

Result = TypeVar("Result")


def watch_nodes(
    station: Station,
    links: LinkSettings,
    work: Callable[[Conversation], Result],
    reporter: Reporter,
    stop: threading.Event,
) -> Iterator[Result | TedsProvisionError]:
    """Do ``work`` with every node that comes on the chosen link; yields its result, or the error that ended it.

    Debounced (one visit, one result); goes on when the reader is unplugged and plugged in again. Raises NoReader only
    where the port cannot be opened at the start.
    """
    port = open_port(links)
    try:
        for contact in port.watch(stop=stop, notice=reporter.notice):
            try:
                with Conversation(contact, notice=reporter.notice) as node:
                    outcome: Result | TedsProvisionError = work(node)
            except TedsProvisionError as error:
                outcome = error
            except SessionLost as lost:
                outcome = lost.cause
            yield outcome
    finally:
        port.close()
