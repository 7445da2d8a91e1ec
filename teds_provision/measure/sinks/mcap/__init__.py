"""MCAP: a recorder that writes it, the container itself, and what makes a file whole that was cut."""

from teds_provision.measure.sinks.mcap import recover

__all__ = ["recover"]
