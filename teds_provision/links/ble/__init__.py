"""The station's end of Bluetooth LE, on bleak."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.ble import adapter, ble_errors, bluez, connection, link, port, spec
else:
    __getattr__ = lazy(__name__)
