"""The guard: refuses calibrations of the kinds that have hurt robots before."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.teds.guard import checks, curve, findings
else:
    __getattr__ = lazy(__name__)
