"""Units as the standard writes them, and as people do."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.teds.units import names, units
else:
    __getattr__ = lazy(__name__)
