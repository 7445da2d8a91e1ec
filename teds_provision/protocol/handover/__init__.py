"""Bundles, receipts and revocations of a handover: their content, and how they are signed and sealed.

The modules are loaded at their first use: showing a file does not need the cryptography of a bundle.
"""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.protocol.handover import bundle, jose, receipt, revocation, strict_json
else:
    __getattr__ = lazy(__name__)
