"""The console for people: colour and tables by rich; what a node, a tag or a file brought steers nothing in them."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from teds_provision.sanitize import sanitize


class CleanConsole(Console):
    """A rich console whose text, not its colours, is cleaned of all that is not printable."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Render, with every text sanitized."""
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(sanitize(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """End as every command ends whose reader went away."""
        raise BrokenPipeError
