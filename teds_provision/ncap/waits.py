"""The intervals at which the service polls facts that no event reports.

One constructor argument passes them from :func:`teds_provision.ncap.service_run.run` on. No option, file or variable
changes them; tests pass shorter ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Waits:
    """Seconds between two checks of the same thing."""

    store: float = 1.0
    """Changes that another process made to the store."""
    selection: float = 2.0
    """Members of a measurement that are still selected, after a change of the store."""
    keys: float = 10.0
    """Nodes whose keys are held: they are asked at once when they announce themselves."""
    link: float = 0.5
    """Nodes that are silent on a bus, and whether the bus works."""
    silent_node: float = 10.0
    """A node that was silent on a bus; operation.md allows one question in 10 s to a node that announces itself."""
    token: float = 1.0
    """The token of a connection: removed or expired."""
    discovery: float = 1.5
    """Wait for the answers to a discovery that the API asks for."""


USUAL: Final = Waits()
