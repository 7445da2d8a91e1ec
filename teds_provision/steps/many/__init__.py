"""Many at once: board after board (tap after tap, by a sheet, or every node of a bus), and many datasheets."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.steps.many import board, boards, fits, progress, report, sheet, verify_files
else:
    __getattr__ = lazy(__name__)
