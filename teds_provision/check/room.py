"""The additions of ``node check`` to the program."""

from __future__ import annotations

from typing import Final

from teds_provision.optional_rooms import OptionalRoom

ROOM: Final = OptionalRoom(
    helps={"node": "Create and run virtual nodes; check a real board's firmware."},
    extends={"node": "commands:extend"},
)
