"""Commands of measuring and acting."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.cli.measure import showing
else:
    __getattr__ = lazy(__name__)
