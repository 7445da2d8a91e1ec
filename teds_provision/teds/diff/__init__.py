"""What changes between two datasheets, in physical terms."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.teds.diff import calibration, datasheets
else:
    __getattr__ = lazy(__name__)
