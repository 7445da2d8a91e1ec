"""A process that holds secrets leaves no copy of its memory behind: no core dump, and no debugger of the same user.

Called before the first secret is asked for, whatever options were given (--debug does not lift it). Not promised: the
swap, a suspended machine, and the administrator, who reads every memory.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Final

_PR_SET_DUMPABLE: Final = 4


def harden() -> None:
    """Forbid core dumps, and on Linux tracing by processes of the same user; a system that cannot is left as it is."""
    with suppress(OSError, ValueError, ModuleNotFoundError):
        import resource  # not on Windows, which writes no core dumps

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        import ctypes  # saves some milliseconds in commands such as `nodes`

        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
