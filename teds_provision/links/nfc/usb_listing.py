"""The USB readers that nfcpy knows, and whether one may be plugged in; nfcpy is not loaded for that."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

READERS: Final = {
    (0x054C, 0x0193): "Sony PN531",
    (0x04CC, 0x0531): "Philips PN531",
    (0x04CC, 0x2533): "NXP PN533",
    (0x04E6, 0x5591): "SCM SCL3711",
    (0x04E6, 0x5593): "SCM SCL3712",
    (0x054C, 0x02E1): "Sony RC-S330/360/370",
    (0x054C, 0x06C1): "Sony RC-S380/S",
    (0x054C, 0x06C3): "Sony RC-S380/P",
    (0x072F, 0x2200): "ACS ACR122U",
}
"""Vendor and product of each (nfc/clf/device.py of nfcpy 1.0.4), and its name."""


def may_have_reader(root: Path = Path("/")) -> bool:
    """Return False if this system lists its USB devices (Linux, in sysfs) and none of them is such a reader."""
    if not sys.platform.startswith("linux"):
        return True
    return any(usb_ids(device) in READERS for device in (root / "sys/bus/usb/devices").glob("*"))


def usb_ids(device: Path) -> tuple[int, int]:
    """Return vendor and product of a device in sysfs, zeros for a folder that is none."""
    try:
        vendor, product = (int((device / name).read_text(), 16) for name in ("idVendor", "idProduct"))
    except (OSError, ValueError):
        return 0, 0
    return vendor, product
