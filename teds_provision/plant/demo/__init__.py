"""The stories of the plant and of the line on one machine, and the PostgreSQL that they run with."""

from teds_provision.plant.demo import line, plant

__all__ = ["line", "plant"]
