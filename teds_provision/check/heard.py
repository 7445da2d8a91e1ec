"""The frames of one run as its link carried them, beside the trace that the user asked for, if any."""

from __future__ import annotations

from dataclasses import dataclass, field

from teds_provision.links.ports import Direction, Trace


@dataclass(frozen=True)
class HeardFrame:
    """One frame: a CAN frame with its ``identifier``, or a block of the NFC link."""

    link: str
    direction: Direction
    octets: bytes
    identifier: int | None
    fd: bool


@dataclass
class Heard:
    """A trace that remembers the frames and hands everything on to ``further``; see ``links.ports.Trace``."""

    further: Trace | None = None
    frames: list[HeardFrame] = field(default_factory=list)

    def frame(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        *,
        identifier: int | None = None,
        fd: bool = False,
        at: float | None = None,
    ) -> None:
        """Remember a frame."""
        self.frames.append(HeardFrame(link, direction, bytes(octets), identifier, fd))
        if self.further is not None:
            self.further.frame(link, direction, octets, identifier=identifier, fd=fd, at=at)

    def message(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        words: str,
        *,
        uuid: bytes,
        sealed: bool = False,
        opened: bytes | None = None,
    ) -> None:
        """Hand a message on."""
        if self.further is not None:
            self.further.message(link, direction, octets, words, uuid=uuid, sealed=sealed, opened=opened)
