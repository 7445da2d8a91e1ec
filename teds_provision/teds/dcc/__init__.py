"""Digital calibration certificates (DCC 3.x of PTB): read, checked for a signature, and written.

lxml and signxml come with the extra ``bench`` and are loaded when a certificate is read. PTB's schemas are not part of
this package (docs/adr/0024-no-dcc-schemas.md): :mod:`read` checks the structure itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.teds.dcc import items, read, shown, signature, write
else:
    __getattr__ = lazy(__name__)

__all__ = ["items", "read", "shown", "signature", "write"]
