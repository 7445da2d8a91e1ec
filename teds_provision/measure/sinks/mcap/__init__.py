"""MCAP: a recorder that writes it, the container itself, and what makes a file whole that was cut."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure.sinks.mcap import recording, recover, writer
else:
    __getattr__ = lazy(__name__)
