"""The option keys of each python-can interface: python-can silently ignores unknown ones."""

from __future__ import annotations

import functools
import importlib
import inspect
import re
from typing import Final

_PICKED: Final = re.compile(r"""kwargs(?:\.get\(|\.pop\(|\[)\s*["'](\w+)["']|:param [^:\n]*?(\w+):""")
"""A key that an interface picks out of what it is given, or that its documentation names."""
_ANYWHERE: Final = frozenset({"bitrate", "data_bitrate", "receive_own_messages", "timing"})
_NOT_KEYS: Final = frozenset({"self", "args", "kwargs", "channel", "can_filters", "interface", "fd", ""})


@functools.cache
def known_keys(interface: str) -> frozenset[str]:
    """Return the keys of a python-can interface: arguments of its class and its bases, and those that it reads by name.

    Empty if they cannot be determined: an interface whose driver is not installed, or of another package.
    """
    from can.interfaces import BACKENDS

    try:
        module, name = BACKENDS[interface]
        if not module.startswith("can."):
            return frozenset()
        kinds = [kind for kind in getattr(importlib.import_module(module), name).__mro__ if kind is not object]
        makers = [kind.__init__ for kind in kinds if "__init__" in vars(kind)]
        source = "".join(map(inspect.getsource, makers))
    except Exception:  # noqa: BLE001  a driver's library that is missing raises anything
        return frozenset()
    named = {key for make in makers for key in inspect.signature(make).parameters}
    picked = {key for found in _PICKED.findall(source) for key in found}
    return frozenset(named | picked | _ANYWHERE) - _NOT_KEYS
