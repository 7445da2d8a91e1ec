"""Errors of bleak and BlueZ, translated to errors with cause and remedy.

Names of D-Bus errors and BlueZ's texts ("le-connection-…") are those of bluetoothd 5.66.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from teds_provision.errors import LinkError, NodeSilentError, NoReaderError
from teds_provision.lazy import how_to_install

SERVICE_HINT: Final = "sudo systemctl start bluetooth (package bluez); teds-provision doctor tells you more."
POWER_HINT: Final = "bluetoothctl power on; where that is refused: rfkill unblock bluetooth."
_LIMIT: Final = "le-connection-concurrent-connection-limit"
_REFUSED: Final = ("le-connection-refused", "le-connection-busy", "le-connection-memory-allocation")
_BUSY: Final = ("org.bluez.Error.InProgress", "org.bluez.Error.NotReady")
_UNKNOWN: Final = ("org.freedesktop.DBus.Error.UnknownObject", "org.freedesktop.DBus.Error.UnknownMethod")
_NO_SERVICE: Final = ("org.freedesktop.DBus.Error.ServiceUnknown", "org.freedesktop.DBus.Error.NameHasNoOwner")


def missing_bleak() -> NoReaderError:
    """Return the error for a missing bleak."""
    return NoReaderError("BLE needs bleak, which is not installed.", hint=how_to_install("ble"))


def is_full(error: BaseException, held: Collection[object]) -> bool:
    """Return True if the adapter accepts no connection beyond those that are ``held``; with none it is only busy."""
    text = str(error)
    return _LIMIT in text or (bool(held) and any(word in text for word in _REFUSED))


def is_busy(error: BaseException) -> bool:
    """Return True if another program (or a killed one) has a connect or a scan under way on this adapter."""
    return getattr(error, "dbus_error", "") in _BUSY


def is_gone(error: BaseException) -> bool:
    """Return True if BlueZ has forgotten the device since it was seen."""
    unknown = getattr(error, "dbus_error", "") in _UNKNOWN
    return unknown or type(error).__name__ == "BleakDeviceNotFoundError" or "not found" in str(error)


def no_system_bus() -> NoReaderError:
    """Return the error for a machine without D-Bus."""
    return NoReaderError("There is no D-Bus system bus, so Bluetooth is unavailable.", hint=SERVICE_HINT)


def adapter_trouble(error: Exception, adapter: str) -> LinkError | None:
    """Return the error for unusable Bluetooth; None if the cause is the node or the air."""
    reason = getattr(getattr(error, "reason", None), "name", "")
    if isinstance(error, FileNotFoundError | ConnectionRefusedError | PermissionError):
        return no_system_bus()
    if getattr(error, "dbus_error", "") in _NO_SERVICE:
        return NoReaderError("The Bluetooth service (bluetoothd) is not running.", hint=SERVICE_HINT)
    if reason == "POWERED_OFF" or "adapter-not-powered" in str(error):
        return NoReaderError(f"Bluetooth is switched off on {adapter}.", hint=POWER_HINT)
    if reason == "NO_BLE_CENTRAL_ROLE":
        return NoReaderError(
            f"The LE central role is not supported by {adapter}.",
            hint="Use an adapter with Bluetooth 4.0 or later.",
        )
    if reason:
        return NoReaderError(
            "There is no Bluetooth adapter.", hint="Plug one in; bluetoothctl list shows the adapters."
        )
    if "adapter '" in str(error):
        return NoReaderError(
            f"There is no Bluetooth adapter {adapter}.", hint="bluetoothctl list, or: ls /sys/class/bluetooth"
        )
    if "AccessDenied" in str(error):
        return NoReaderError(
            "This user may not use Bluetooth.", hint="sudo adduser $USER bluetooth, or log in at the machine itself."
        )
    return None


class TooManyConnectionsError(LinkError):
    """An adapter's connections are used up."""


def too_many(held: int, adapter: str) -> TooManyConnectionsError:
    """Return the error for an adapter whose connections are used up."""
    return TooManyConnectionsError(
        f"The Bluetooth of {adapter} holds {held} connection{'' if held == 1 else 's'} and takes no more.",
        hint="Measure fewer nodes over it, or add an adapter: many take 5 to 9, Nordic's own controllers 20.",
    )


def silent(address: str, last: Exception | None) -> NodeSilentError:
    """Return the error for a node that does not answer."""
    why = f" ({_text(last)})" if last is not None and _text(last) else ""
    return NodeSilentError(
        f"The node at {address} does not answer over BLE{why}.",
        hint="Bring it closer. It advertises for 60 s after a tap, and while it has a key.",
    )


def _text(error: Exception) -> str:
    if isinstance(error, LinkError):
        return error.message.rstrip(".")
    return str(error).strip().rstrip(".") or type(error).__name__
