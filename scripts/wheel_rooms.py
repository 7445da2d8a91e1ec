"""Which optional rooms are in the wheel: all, or those that TEDS_PROVISION_WHEEL_ROOMS names; hatchling calls this.

``TEDS_PROVISION_WHEEL_ROOMS=none make dist`` builds the base wheel, ``=plant`` one with the plant alone; several names
are separated by commas. The sdist always has every room.
"""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from typing import Any, Final

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

VARIABLE: Final = "TEDS_PROVISION_WHEEL_ROOMS"


class WheelRooms(BuildHookInterface):  # type: ignore[type-arg]
    """Leaves the folders of rooms that are not asked for out of a wheel."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the folders to what the wheel excludes; an editable installation has them all."""
        asked = os.environ.get(VARIABLE)
        if asked is None or version == "editable":
            return
        optional = runpy.run_path(str(Path(self.root) / "teds_provision" / "optional_rooms.py"))["OPTIONAL"]
        wanted = set() if asked == "none" else set(asked.split(","))
        if wanted - set(optional):
            raise SystemExit(f"{VARIABLE}={asked}: name rooms out of {', '.join(optional)}, or none.")
        excluded = self.build_config.target_config.setdefault("exclude", [])
        excluded += [f"teds_provision/{room}/" for room in optional if room not in wanted]
