"""Where a command came from."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.protocol.operation.hardware import Port
from teds_provision.protocol.session import NodeSession


@dataclass(frozen=True)
class Origin:
    """A command's link and port, whether it counts as tapped, and the session that it was sealed in (None: plain).

    ``received`` is the tick at which its last frame came.
    """

    link: str
    tapped: bool
    port: Port
    received: int
    session: NodeSession | None = None
