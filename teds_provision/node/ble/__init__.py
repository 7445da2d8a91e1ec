"""The node's end of BLE: a peripheral on bumble."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.node.ble import address, peripheral, server
else:
    __getattr__ = lazy(__name__)
