"""The known answers of measurement operation, read once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

PATH = Path(__file__).parents[2] / "vectors" / "profile" / "operation_kat.json"
KAT: dict[str, Any] = json.loads(PATH.read_text())
UUID = bytes.fromhex(KAT["uuid"])
MESSAGE_KEY = bytes.fromhex(KAT["open"]["k_m"])
STATION, NODE = KAT["station_can_address"], KAT["node_can_address"]
WIDTHS = {int(number): facts["octets"] for number, facts in KAT["channels"].items()}


def can_frame(text: str) -> tuple[int, bytes]:
    """Return a frame as candump writes it: identifier and data."""
    identifier, _, data = text.partition("#")
    return int(identifier, 16), bytes.fromhex(data.lstrip("#"))
