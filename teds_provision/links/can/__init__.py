"""CAN: ISO-TP with normal fixed addressing, through python-can and can-isotp."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.can import (
        arrivals,
        bus,
        bus_multiplexer,
        identify_broadcast,
        isotp,
        link,
        port,
        sensor_bus,
        spec,
    )
else:
    __getattr__ = lazy(__name__)
