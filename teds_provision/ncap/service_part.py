"""Parts of the service that optional rooms bring: what runs beside it, and the resources and metrics of that."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from teds_provision.ncap.live import Live
from teds_provision.optional_rooms import Hook
from teds_provision.station.station import Station

if TYPE_CHECKING:
    from starlette.requests import Request

Line = tuple[str, dict[str, str], float]
"""A metric: its name, its labels and its value."""


class ServicePart(Protocol):
    """Something that runs beside the service, on its own threads."""

    def start(self) -> None:
        """Begin; raises TedsProvisionError if it cannot."""

    def stop(self) -> None:
        """End, whether it was started or not."""

    def is_shown(self) -> bool:
        """Return True if the page shows a view of it: a member of `/status` with the part's view."""

    def resources(self) -> Mapping[str, Callable[[Request], Awaitable[dict[str, Any]]]]:
        """Return what answers a GET, by its path below /api/v1."""

    @property
    def metric_help(self) -> Mapping[str, tuple[str, str]]:
        """Kind and help of each of its metrics, by name."""

    def metrics(self) -> Iterator[Line]:
        """Yield the present values."""


@dataclass(frozen=True)
class PartKind:
    """A part before the service runs."""

    name: str
    """Its name in ``Settings.parts``: those named there are started."""
    view: str
    """The member of `/status` that is true if the page shows its view."""
    require: Callable[[Station], object]
    """Raises TedsProvisionError if the part cannot be started with this station."""
    make: Callable[[Station, Live, Callable[[], object]], ServicePart]
    """Makes it; the last argument is to be called if it changed pins, bans or keys."""


KINDS: Final[Hook[PartKind]] = Hook("ncap.service_part")
