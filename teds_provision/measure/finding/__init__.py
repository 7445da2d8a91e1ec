"""Which nodes are on the buses of this process: buses, the look-out on each, and the two modes of detection."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure.finding import air, asking, buses, lookout, sightings, sources
else:
    __getattr__ = lazy(__name__)
