"""The whole store of a station, sealed into one file, and back."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.backup import backup, chunks, content, merge, restore, sealed_file
else:
    __getattr__ = lazy(__name__)
