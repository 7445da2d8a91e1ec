"""The stories of the plant and of the line on one machine, and the PostgreSQL that they run with."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.plant.demo import cluster, line, plant
else:
    __getattr__ = lazy(__name__)
