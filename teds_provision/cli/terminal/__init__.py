"""What only a person at a terminal needs: the console with colours and tables, and completion by a shell."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.cli.terminal import completing, console
else:
    __getattr__ = lazy(__name__)
