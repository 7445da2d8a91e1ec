"""numpy at its first use, and the types of arrays: ``from teds_provision.arrays import NDArray, np``.

numpy takes longer to load than most commands take without it. A module that always computes imports it by itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import late

__all__ = ["Ends", "Floats", "NDArray", "Octets", "np", "without_repeats"]

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ends = float | Floats
    Octets = bytes | bytearray | memoryview | NDArray[np.uint8]
else:
    np = late("numpy")
    NDArray = Floats = Ends = Octets = object  # used only in annotations, which are never evaluated


def without_repeats(values: Floats) -> Floats:
    """Return numbers in ascending order, each once: numpy.unique without what that loads (numpy.ma, 40 ms of CPU)."""
    ordered = np.sort(values)
    return ordered[np.append(True, ordered[1:] != ordered[:-1])] if ordered.size else ordered
