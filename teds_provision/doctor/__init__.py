"""Named checks of this machine, its links and the station, each with its cause and the cure."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.doctor import checks, fleet, links, machine, report, station
else:
    __getattr__ = lazy(__name__)
