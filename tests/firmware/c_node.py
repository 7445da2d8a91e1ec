"""The node in C in the place of the virtual one: the same words for a test, another process behind them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest

from teds_provision.protocol.announce import default_can_address
from tests.e2e.powered import PoweredNode
from tests.firmware import builds
from tests.firmware_images import public

OFFERS: Final = frozenset({"nfc", "can", "reset by hand", "power cuts"})
"""What a test may need of a node and this one has. It has no Type 2 tag, no BLE, no slow chip, no trace, no battery, no
sources but its own, and its channels are not those of its datasheet."""
_IDENTITY, _SLOT, _HEAD = 256, 16384, 192  # of the host port's flash file and of a slot (slots.c)
_KEYED, _PROVISIONED = 1, 2


@dataclass
class CNode(PoweredNode):
    """A node in C; its flash is the file ``flash.bin`` in its folder. Members as those of ``tests.e2e.desk.Node``."""

    firmware: tuple[Path, Path] | None = None

    def start(self, *options: object, nfc: bool = True, can: bool = False, **more: Any) -> CNode:
        """Power on, and wait until its links are up. What it has no option for is not this test's node."""
        if options and options != ("--tag", "4"):
            pytest.skip(f"the node in C has no {options[0]}")
        self.folder.mkdir(exist_ok=True)
        links = self.desk.links
        words: list[object] = ["--flash", self.folder / "flash.bin", "--uuid", self.uuid]
        words += [*(["--nfc", links.nfc] if nfc else []), *(["--can", links.can] if can else [])]
        if self.firmware is not None:
            image, key = self.firmware
            words += ["--images", self.folder / "images", "--owner", public(key, "raw"), "--image", image]
            words += ["--security-counter"]
        self.ready(self.desk.start(*words, program=(str(builds.host()),), fork=False, **more))
        return self

    @property
    def octets(self) -> bytes:
        """What its flash holds that counts: identity and slot, without the blank one."""
        whole = (self.folder / "flash.bin").read_bytes()
        return whole[:_IDENTITY] + self._slot(whole)

    @property
    def flash(self) -> dict[str, Any]:
        """What stands in its flash."""
        slot = self._slot((self.folder / "flash.bin").read_bytes())
        if not slot:
            blank: dict[str, Any] = dict.fromkeys(("key", "station", "ca"))
            blank["can_address"] = default_can_address(bytes.fromhex(self.uuid))
            return {**blank, "provisioned": False, "epoch": 0, "sequence": 0, "blocks": [], "read_only": []}
        records, blocks = _HEAD + int.from_bytes(slot[16:20], "big"), []
        at = _HEAD
        while at < records:
            channel, code, length = slot[at], slot[at + 1], int.from_bytes(slot[at + 4 : at + 8], "big")
            blocks.append([channel, code, slot[at + 8 : at + 8 + length].hex()])
            at += 8 + length
        keyed = bool(slot[5] & _KEYED)
        return {
            "key": slot[28:44].hex() if keyed else None,
            "station": slot[44:109].hex() if keyed else None,
            "ca": slot[109:174].hex() if keyed else None,
            "can_address": slot[6],
            "provisioned": bool(slot[5] & _PROVISIONED),
            "epoch": int.from_bytes(slot[20:24], "big"),
            "sequence": int.from_bytes(slot[24:28], "big"),
            "blocks": blocks,
            "read_only": [],
        }

    def _slot(self, whole: bytes) -> bytes:
        slots = [whole[at : at + _SLOT] for at in (_IDENTITY, _IDENTITY + _SLOT)]
        written = [slot for slot in slots if slot[:5] == b"TSLT\x01"]
        return max(written, key=lambda slot: slot[8:12], default=b"")
