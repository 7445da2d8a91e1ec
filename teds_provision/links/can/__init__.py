"""CAN: ISO-TP with normal fixed addressing, through python-can and can-isotp."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.can import (
        arrivals,
        bus,
        finding,
        frame,
        gathering,
        isotp,
        link,
        port,
        reading,
        rivals,
        shared,
        spec,
        transfer,
        wire,
    )
else:
    __getattr__ = lazy(__name__)
