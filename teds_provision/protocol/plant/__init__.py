"""Documents that stations of one owner exchange, their proofs, and what follows from them (contract/plant.md).

``document`` signs and opens; ``roster``, ``page``, ``event`` and ``evidence`` are the contents. All pure: octets and
values in, values out; the clock and the store are the caller's.
"""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.protocol.plant import (
        chain,
        claim,
        document,
        event,
        evidence,
        fold,
        job,
        page,
        roster,
        sharing,
        signer,
        signing,
    )
else:
    __getattr__ = lazy(__name__)
