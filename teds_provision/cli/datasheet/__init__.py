"""Commands about datasheets: show and profile."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.cli.datasheet import show_files, show_json, show_table
else:
    __getattr__ = lazy(__name__)
