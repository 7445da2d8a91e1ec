"""The published known-answer vectors of the profile, read once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from teds_provision.protocol.keys import SoftwareKey

PATH = Path(__file__).parent.parent / "vectors" / "profile" / "kat.json"
KAT: dict[str, Any] = json.loads(PATH.read_text())
UUID = bytes.fromhex(KAT["uuid"])


def key(name: str) -> SoftwareKey:
    """Return one of the vectors' private keys: node, station, ca, one_time."""
    return SoftwareKey(int(KAT[name]["d"], 16))


def octets(*path: str | int) -> bytes:
    """Return a hex value at a path of the vectors."""
    value: Any = KAT
    for step in path:
        value = value[step]
    return bytes.fromhex(value)
