"""Wrapped sensors: a virtual node around a CAN message, a CANopen device or an IIO device (virtual-nodes.md)."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

__all__ = ["canopen_device", "dbc_message", "description", "iio_device", "reading", "running", "wrapped_source"]

if TYPE_CHECKING:
    from teds_provision.node.wrapped import (
        canopen_device,
        dbc_message,
        description,
        iio_device,
        reading,
        running,
        wrapped_source,
    )
else:
    __getattr__ = lazy(__name__)
