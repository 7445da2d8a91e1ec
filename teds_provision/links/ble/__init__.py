"""The station's end of Bluetooth LE, on bleak."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.ble import adapter, bluez, connection, link, port, spec, troubles
else:
    __getattr__ = lazy(__name__)
