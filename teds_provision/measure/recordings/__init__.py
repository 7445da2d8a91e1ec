"""Recordings: what is in one, its values as a table, the same in another format. One reader for each format."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure.recordings import converting, opening, source, summary
else:
    __getattr__ = lazy(__name__)
