"""What a scene told of one thing."""

from __future__ import annotations

from typing import Any

from .machine import Machine


def result(scene: Machine, name: str) -> dict[str, Any]:
    """Return its line; fails with the machine's output where there is none, or where it went wrong."""
    assert name in scene.results, scene.output[-6000:]
    found = scene.results[name]
    assert "error" not in found, found
    return found
