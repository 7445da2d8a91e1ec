"""What only a person at a terminal needs: console, lines that are broken between words, completion by a shell."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.cli.terminal import completing, console, folding
else:
    __getattr__ = lazy(__name__)
