"""The waits of the service: how long it pauses between looks at what no event reports.

One constructor argument passes them from :func:`teds_provision.ncap.service_run.run` on. No option, file or variable
changes them; tests pass shorter ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Waits:
    """Seconds between two looks, each at one thing."""

    store: float = 1.0
    """At the store, for what another process has changed."""
    selection: float = 2.0
    """At which members of a measurement are still selected, after a change of the store."""
    keys: float = 10.0
    """At whose keys are held: their nodes are looked for at once when they announce themselves."""
    link: float = 0.5
    """At a bus: who is silent, and whether it works."""
    silent_node: float = 10.0
    """At a node that was silent on a bus: the contract's bound for asking one that announces itself."""
    token: float = 1.0
    """At the token of a connection: whether it was removed, or has expired."""
    discovery: float = 1.5
    """For the answers to a discovery that the API asks for."""


USUAL: Final = Waits()
