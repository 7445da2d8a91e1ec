"""``--from``: reads the description of a sensor, whatever form it has."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from teds_provision.errors import UsageError
from teds_provision.node.wrapped import canopen_device, dbc_message, iio_device
from teds_provision.node.wrapped.description import WrappedSensor

FORMS: Final = "dbc:FILE, eds:FILE or iio:DEVICE"


def describe(text: str, message: str | None = None) -> WrappedSensor:
    """Return the sensor that ``--from`` names; raises UsageError, NotFoundError or BadDataError."""
    kind, colon, place = text.partition(":")
    if kind not in ("dbc", "eds", "iio") or not colon or not place:
        raise UsageError(f"--from {text!r} names no sensor.", hint=f"Use {FORMS}.")
    if message is not None and kind != "dbc":
        raise UsageError("--message chooses a message of a DBC file.", hint="Omit it, or use --from dbc:FILE.")
    if kind == "dbc":
        return dbc_message.read(Path(place), message).sensor
    if kind == "eds":
        return canopen_device.read(Path(place))
    return iio_device.find(place).describe()
