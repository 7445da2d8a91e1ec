"""Every message of builtin_interfaces, checked."""

from __future__ import annotations

from typing import Any

from checked import made


def __getattr__(name: str) -> Any:
    try:
        return made(f"builtin_interfaces/msg/{name}")
    except KeyError:
        raise AttributeError(name) from None
