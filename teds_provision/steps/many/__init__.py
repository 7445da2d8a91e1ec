"""Board after board: tap after tap, by a sheet, or every node of a bus at once."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.steps.many import board, boards, progress, report, sheet
else:
    __getattr__ = lazy(__name__)
