"""The collected and worked strings of ``tests/vectors/ieee1451`` (origin and verdict of each in its index)."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent.parent / "vectors" / "ieee1451"
ALL: dict[str, dict[str, Any]] = {
    entry["name"]: entry for entry in json.loads((FOLDER / "index.json").read_text())["vectors"]
}
TEDS = [name for name, entry in ALL.items() if entry["verdict"] != "message"]
CLEAN = [name for name, entry in ALL.items() if entry["verdict"] == "clean"]


@cache
def octets_of(name: str) -> bytes:
    lines = (FOLDER / ALL[name]["file"]).read_text().splitlines()
    return bytes.fromhex("".join(line for line in lines if not line.startswith("#")))
