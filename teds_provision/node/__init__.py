"""The virtual transducer: flash in a file, TIM server, both links."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

__all__ = ["Battery", "BleServer", "Board", "CanServer", "NfcServer", "StaticAddress"]

if TYPE_CHECKING:
    from teds_provision.node import firmware, flash_file, node_template, realtime_loop, sources, virtual, wrapped
    from teds_provision.node.ble import peripheral
    from teds_provision.node.ble.address import StaticAddress
    from teds_provision.node.ble.server import BleServer
    from teds_provision.node.can.server import CanServer
    from teds_provision.node.hardware.board import Battery, Board
    from teds_provision.node.nfc import tnep
    from teds_provision.node.nfc.server import NfcServer
else:
    __getattr__ = lazy(
        __name__,
        {
            "ble": "peripheral",
            "ble.address": "StaticAddress",
            "ble.server": "BleServer",
            "can.server": "CanServer",
            "hardware.board": "Battery Board",
            "nfc": "tnep",
            "nfc.server": "NfcServer",
        },
    )
