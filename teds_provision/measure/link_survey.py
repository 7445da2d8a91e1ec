"""Find the nodes on a station's links: one short broadcast per bus, beside any measurement there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

from teds_provision.errors import NoNodeError, TedsProvisionError
from teds_provision.links import LinkSettings, Notice, open_place
from teds_provision.links.opening import capabilities_at, plugged_in
from teds_provision.measure.sources import own_source_address
from teds_provision.protocol.messages.identity import Identity
from teds_provision.station.station import Station

_LISTEN_SECONDS = 1.0


@dataclass(frozen=True)
class LinkSurvey:
    """State of one link. ``nodes`` are plain Identifies: unproven hints.

    ``state``: ``up``; ``listed`` for a link that carries no question without a tap or a connection; ``down`` with
    ``why`` and its remedy ``cure``. ``troubles``: faults that were heard, such as two nodes at one address.
    """

    place: str
    state: Literal["up", "listed", "down"]
    why: str = ""
    cure: str = ""
    nodes: tuple[tuple[int, Identity], ...] = ()
    troubles: tuple[str, ...] = field(default=())


def readers() -> Iterator[LinkSurvey]:
    """Yield the readers that are plugged in; none of them is opened."""
    return (LinkSurvey(place, "listed") for place in plugged_in())


def look(station: Station, places: Sequence[str]) -> Iterator[LinkSurvey]:
    """Send a broadcast at each of these places in turn, at most a second each."""
    for place in places:
        if not capabilities_at(place).connectionless:
            yield LinkSurvey(place, "listed")
            continue
        notices: list[Notice] = []
        try:
            with own_source_address(station, LinkSettings().at(place), "looking") as links:
                port = open_place(links.places[0])
                try:
                    contacts = port.find_all(seconds=_LISTEN_SECONDS, notice=notices.append)
                finally:
                    port.close()
        except NoNodeError:
            contacts = []
        except TedsProvisionError as error:
            yield LinkSurvey(place, "down", error.message, error.hint)
            continue
        nodes = tuple((contact.address or 0, contact.identity) for contact in contacts)
        troubles = tuple(notice.text for notice in notices if notice.kind in ("conflict", "unfinished"))
        yield LinkSurvey(place, "up", nodes=nodes, troubles=troubles)
