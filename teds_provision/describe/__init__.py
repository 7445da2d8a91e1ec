"""Datasheets in formats that other tools read: a W3C Thing Description, ros2_control, an Asset Administration Shell.

The modules are loaded at their first use: each format needs other rooms and libraries.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.describe import asset_shell, described_node, ros2_control, thing_description
else:
    __getattr__ = lazy(__name__)

__all__ = ["asset_shell", "described_node", "ros2_control", "thing_description"]
