"""Commands that provision a node."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.cli.steps import verify_files
else:
    __getattr__ = lazy(__name__)
