"""A CAN frame, as the profile uses it."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Frame:
    """One CAN data frame with a 29-bit identifier; ``data`` 0 to 8 octets, in FD up to 64.

    ``at`` is when it came in, in seconds of ``time.monotonic()``, taken back by what it lay in the kernel's queue;
    0 for a frame that is sent.
    """

    identifier: int
    data: bytes
    fd: bool = False
    at: float = field(default=0.0, compare=False)
