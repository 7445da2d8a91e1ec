"""Digital calibration certificates (DCC 3.x of PTB): read, checked for a signature, and written.

lxml and signxml come with the extra ``bench`` and are loaded when a certificate is read. PTB's schemas are not part of
this package (docs/adr/0024-no-dcc-schemas.md): :mod:`read` checks the structure itself.
"""

from teds_provision.teds.dcc import items, shown, signature, write

__all__ = ["items", "shown", "signature", "write"]
