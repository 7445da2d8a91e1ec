"""Facts about bluetoothd's adapters, read over D-Bus without opening anything; for the doctor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import NoReaderError
from teds_provision.lazy import late
from teds_provision.links.ble import ble_errors

if TYPE_CHECKING:
    import asyncio
else:
    asyncio = late("asyncio")  # not imported on a machine without D-Bus

_SECONDS: Final = 5.0
_SYSTEM_BUS: Final = "unix:path=/var/run/dbus/system_bus_socket"
_ADAPTER, _DEVICE = "org.bluez.Adapter1", "org.bluez.Device1"


@dataclass(frozen=True)
class AdapterFacts:
    """One adapter: switched on, able to connect to nodes, and its present number of connections of all programs."""

    name: str
    address: str
    powered: bool
    central: bool
    held: int


def adapters(bus_address: str | None = None) -> list[AdapterFacts]:
    """Return every adapter of bluetoothd; ``bus_address`` None: the system's bus.

    Raises NoReaderError if there is no system bus, bluetoothd does not run, or the D-Bus library is not installed.
    """
    kind, _, path = (bus_address or _SYSTEM_BUS).partition("=")
    if kind == "unix:path" and not Path(path.partition(",")[0]).exists():
        raise ble_errors.no_system_bus()
    try:
        import dbus_fast  # noqa: F401
    except ImportError:
        raise ble_errors.missing_bleak() from None
    try:
        return asyncio.run(asyncio.wait_for(_adapters(bus_address), _SECONDS))
    except NoReaderError:
        raise
    except TimeoutError:
        raise NoReaderError("bluetoothd does not answer.", hint="sudo systemctl restart bluetooth") from None
    except Exception as error:
        trouble = ble_errors.adapter_trouble(error, "this machine")
        raise trouble or NoReaderError(f"Cannot talk to bluetoothd: {error}.", hint=ble_errors.SERVICE_HINT) from error


async def _adapters(bus_address: str | None) -> list[AdapterFacts]:
    from dbus_fast import BusType
    from dbus_fast.aio import MessageBus

    bus = await MessageBus(bus_address=bus_address, bus_type=BusType.SYSTEM).connect()
    try:
        (owned,) = await _call(bus, "org.freedesktop.DBus", "org.freedesktop.DBus", "NameHasOwner", "org.bluez")
        if not owned:
            raise NoReaderError("The Bluetooth service (bluetoothd) is not running.", hint=ble_errors.SERVICE_HINT)
        (objects,) = await _call(bus, "org.bluez", "org.freedesktop.DBus.ObjectManager", "GetManagedObjects")
    finally:
        bus.disconnect()
    found = []
    for path, interfaces in sorted(objects.items()):
        properties = interfaces.get(_ADAPTER)
        if properties is not None:
            values = {name: value.value for name, value in properties.items()}
            held = sum(_is_held(other, path) for other in objects.values())
            central = "central" in values.get("Roles", ["central"])
            found.append(
                AdapterFacts(path.rpartition("/")[2], values["Address"], bool(values["Powered"]), central, held)
            )
    return found


def _is_held(interfaces: dict[str, Any], adapter: str) -> bool:
    device = interfaces.get(_DEVICE)
    return device is not None and device["Adapter"].value == adapter and bool(device["Connected"].value)


async def _call(bus: Any, service: str, interface: str, member: str, *words: str) -> list[Any]:
    from dbus_fast import Message, MessageType
    from dbus_fast.errors import DBusError

    path = "/org/freedesktop/DBus" if service == "org.freedesktop.DBus" else "/"
    reply = await bus.call(
        Message(
            destination=service,
            path=path,
            interface=interface,
            member=member,
            signature="s" * len(words),
            body=list(words),
        )
    )
    if reply.message_type == MessageType.ERROR:
        raise DBusError(reply.error_name, str(reply.body))
    return list(reply.body)
