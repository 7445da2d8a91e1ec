"""Every message of sensor_msgs, checked."""

from __future__ import annotations

from typing import Any

from checked import made


def __getattr__(name: str) -> Any:
    try:
        return made(f"sensor_msgs/msg/{name}")
    except KeyError:
        raise AttributeError(name) from None
