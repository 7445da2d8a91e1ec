# ruff: noqa: F821, F722 - annotations are D-Bus signatures, read by dbus-fast
"""A stand-in for bluetoothd on a private bus, so that bleak's own BlueZ code runs where there is no Bluetooth.

It has the manners of bluetoothd 5.66 that matter here: a device is known only after a scan and forgotten some time
after it; one connect at a time, or InProgress; connects that fail with BlueZ's words; a limit of connections; a stale
cache of services until RemoveDevice. The radio below is bumble's.
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from bumble.core import UUID
from bumble.device import Device, Peer
from bumble.hci import Address
from dbus_fast import DBusError, PropertyAccess
from dbus_fast.aio import MessageBus
from dbus_fast.service import ServiceInterface, dbus_method, dbus_property

READ = PropertyAccess.READ
ADAPTER = "/org/bluez/hci0"
FAILED = "org.bluez.Error.Failed"


@dataclass
class Manners:
    """``forget`` seconds after a scan; ``aborts``: so many connects fail at first; ``limit`` connections, 0: any."""

    mtu: int = 247
    forget: float = 30.0
    in_progress: bool = False
    aborts: int = 0
    refusals: int = 0
    limit: int = 0
    stale: bool = False
    always_stale: bool = False
    powered: bool = True
    central: bool = True
    delay: float = 0.0


class Adapter(ServiceInterface):
    def __init__(self, bluez: "Bluez") -> None:
        super().__init__("org.bluez.Adapter1")
        self.bluez, self.scans = bluez, 0
        self.filter: dict[str, Any] = {}

    @dbus_property(access=READ)
    def Address(self) -> "s":
        return "F0:F1:F2:F3:F4:22"

    @dbus_property(access=READ)
    def Name(self) -> "s":
        return "stand-in"

    @dbus_property(access=READ)
    def Powered(self) -> "b":
        return self.bluez.manners.powered

    @dbus_property(access=READ)
    def Discovering(self) -> "b":
        return self.scans > 0

    @dbus_property(access=READ)
    def Roles(self) -> "as":
        return ["central", "peripheral"] if self.bluez.manners.central else ["peripheral"]

    @dbus_property(access=READ)
    def UUIDs(self) -> "as":
        return []

    @dbus_method()
    def SetDiscoveryFilter(self, properties: "a{sv}"):
        self.filter = {name: value.value for name, value in properties.items()}

    @dbus_method()
    async def StartDiscovery(self):
        self.scans += 1
        if self.scans == 1:
            await self.bluez.device.start_scanning(filter_duplicates=False)
        self.emit_properties_changed({"Discovering": True})

    @dbus_method()
    async def StopDiscovery(self):
        self.scans = max(0, self.scans - 1)
        if not self.scans:
            await self.bluez.device.stop_scanning()
            self.emit_properties_changed({"Discovering": False})
            self.bluez.forget_later()

    @dbus_method()
    def RemoveDevice(self, path: "o"):
        self.bluez.removed += 1
        self.bluez.remove(path, connected_too=True)


class Remote(ServiceInterface):
    """org.bluez.Device1."""

    def __init__(self, bluez: "Bluez", address: Address, uuids: list[str]) -> None:
        super().__init__("org.bluez.Device1")
        self.bluez, self.address, self.uuids = bluez, address, uuids
        self.text = str(address).split("/")[0]
        self.path = f"{ADAPTER}/dev_{self.text.replace(':', '_')}"
        self.connected = self.resolved = self.pending = False
        self.connection: Any = None
        self.objects: list[str] = []

    @dbus_property(access=READ)
    def Address(self) -> "s":
        return self.text

    @dbus_property(access=READ)
    def AddressType(self) -> "s":
        return "random"

    @dbus_property(access=READ)
    def Alias(self) -> "s":
        return self.text.replace(":", "-")

    @dbus_property(access=READ)
    def Paired(self) -> "b":
        return False

    @dbus_property(access=READ)
    def RSSI(self) -> "n":
        return -60

    @dbus_property(access=READ)
    def Connected(self) -> "b":
        return self.connected

    @dbus_property(access=READ)
    def ServicesResolved(self) -> "b":
        return self.resolved

    @dbus_property(access=READ)
    def UUIDs(self) -> "as":
        return self.uuids

    @dbus_property(access=READ)
    def Adapter(self) -> "o":
        return ADAPTER

    @dbus_method()
    async def Connect(self):
        self.pending = True
        try:
            await self.bluez.connect(self)
        finally:
            self.pending = False

    @dbus_method()
    async def Disconnect(self):
        if self.connection is not None:
            await self.connection.disconnect()


class Service(ServiceInterface):
    def __init__(self, uuid: str, device: str) -> None:
        super().__init__("org.bluez.GattService1")
        self.uuid, self.device = uuid, device

    @dbus_property(access=READ)
    def UUID(self) -> "s":
        return self.uuid

    @dbus_property(access=READ)
    def Device(self) -> "o":
        return self.device

    @dbus_property(access=READ)
    def Primary(self) -> "b":
        return True

    @dbus_property(access=READ)
    def Includes(self) -> "ao":
        return []


class Characteristic(ServiceInterface):
    def __init__(self, uuid: str, service: str, proxy: Any, remote: Remote) -> None:
        super().__init__("org.bluez.GattCharacteristic1")
        self.uuid, self.service, self.proxy, self.remote = uuid, service, proxy, remote
        self.notifying, self.value = False, b""

    @dbus_property(access=READ)
    def UUID(self) -> "s":
        return self.uuid

    @dbus_property(access=READ)
    def Service(self) -> "o":
        return self.service

    @dbus_property(access=READ)
    def Flags(self) -> "as":
        kind = type(self.proxy.properties)
        names = {"write": kind.WRITE, "write-without-response": kind.WRITE_WITHOUT_RESPONSE, "notify": kind.NOTIFY}
        return [name for name, flag in names.items() if self.proxy.properties & flag]

    @dbus_property(access=READ)
    def Notifying(self) -> "b":
        return self.notifying

    @dbus_property(access=READ)
    def MTU(self) -> "q":
        return self.remote.connection.att_mtu if self.remote.connection else 23

    @dbus_property(access=READ)
    def Value(self) -> "ay":
        return self.value

    @dbus_method()
    async def WriteValue(self, value: "ay", options: "a{sv}"):
        kind = options.get("type")
        await asyncio.sleep(self.remote.bluez.manners.delay)
        try:
            await self.proxy.write_value(bytes(value), with_response=kind is None or kind.value == "request")
        except Exception as error:
            raise DBusError(FAILED, f"Not connected ({type(error).__name__})") from error

    @dbus_method()
    async def StartNotify(self):
        await self.proxy.subscribe(self.notified)
        self.notifying = True

    @dbus_method()
    async def StopNotify(self):
        self.notifying = False
        with suppress(Exception):
            await self.proxy.unsubscribe(self.notified)

    def notified(self, value: bytes) -> None:
        self.value = bytes(value)
        self.emit_properties_changed({"Value": self.value})


class Bluez:
    """org.bluez on ``bus``, over bumble's ``device``."""

    def __init__(self, bus: MessageBus, device: Device, manners: Manners) -> None:
        self.bus, self.device, self.manners = bus, device, manners
        self.adapter = Adapter(self)
        self.remotes: dict[str, Remote] = {}
        self.pending = asyncio.Lock()
        self.removed = self.connects = self.most_held = self.pending_at_once = self._pending = 0
        self._tasks: set[asyncio.Task[None]] = set()

    async def serve(self) -> None:
        """Take the name."""
        self.bus.export(ADAPTER, self.adapter)
        self.device.on("advertisement", self.advertised)
        await self.bus.request_name("org.bluez")

    def advertised(self, advertisement: Any) -> None:
        uuids = [full(UUID.from_bytes(data)) for kind, data in advertisement.data.ad_structures if kind in (6, 7)]
        key = str(advertisement.address)
        remote = self.remotes.get(key)
        wanted = self.adapter.filter.get("UUIDs")
        if remote is None:
            if not wanted or set(wanted) & set(uuids):
                remote = self.remotes[key] = Remote(self, advertisement.address, uuids)
                self.bus.export(remote.path, remote)
        else:
            remote.emit_properties_changed({"RSSI": -60})

    def forget_later(self) -> None:
        async def later() -> None:
            await asyncio.sleep(self.manners.forget)
            if not self.adapter.scans:
                for remote in list(self.remotes.values()):
                    self.remove(remote.path)

        task = asyncio.get_running_loop().create_task(later())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def remove(self, path: str, *, connected_too: bool = False) -> None:
        for key, remote in list(self.remotes.items()):
            if remote.path == path and (connected_too or not (remote.connected or remote.pending)):
                del self.remotes[key]
                self.bus.unexport(path)

    @property
    def known(self) -> int:
        return len(self.remotes)

    @property
    def held(self) -> int:
        return sum(remote.connected for remote in self.remotes.values())

    async def connect(self, remote: Remote) -> None:
        self.connects += 1
        self._pending += 1
        self.pending_at_once = max(self.pending_at_once, self._pending)
        try:
            if self.manners.in_progress and self.pending.locked():
                raise DBusError("org.bluez.Error.InProgress", "Operation already in progress")
            async with self.pending:
                await self._connect(remote)
        finally:
            self._pending -= 1

    async def _connect(self, remote: Remote) -> None:
        if self.manners.limit and self.held >= self.manners.limit:
            raise DBusError(FAILED, "le-connection-concurrent-connection-limit")
        if self.manners.refusals:
            self.manners.refusals -= 1
            raise DBusError(FAILED, "Input/output error")
        if self.manners.aborts:
            self.manners.aborts -= 1
            remote.connected = True
            remote.emit_properties_changed({"Connected": True})
            asyncio.get_running_loop().call_later(0.05, self._flash_off, remote)
            raise DBusError(FAILED, "le-connection-abort-by-local")
        try:
            remote.connection = await self.device.connect(remote.address, timeout=25)
        except Exception as error:
            raise DBusError(FAILED, "le-connection-timeout") from error
        remote.connection.on("disconnection", lambda _reason: self._gone(remote))
        remote.connected = True
        self.most_held = max(self.most_held, self.held)
        remote.emit_properties_changed({"Connected": True})
        with suppress(Exception):  # it may be cut at once
            await self._resolve(remote)

    def _flash_off(self, remote: Remote) -> None:
        remote.connected = False
        remote.emit_properties_changed({"Connected": False})

    def _gone(self, remote: Remote) -> None:
        remote.connected = remote.resolved = False
        remote.connection = None
        for path in remote.objects:
            self.bus.unexport(path)
        remote.objects = []
        remote.emit_properties_changed({"Connected": False, "ServicesResolved": False})
        self.forget_later()

    async def _resolve(self, remote: Remote) -> None:
        peer = Peer(remote.connection)
        await peer.request_mtu(self.manners.mtu)
        await peer.discover_services()
        await peer.discover_characteristics()
        stale = self.manners.always_stale or (self.manners.stale and not self.removed)
        for number, service in enumerate(peer.services):
            if stale and len(service.uuid.to_bytes()) == 16:
                continue  # what the cache of an older firmware does not know
            path = f"{remote.path}/service{number:04x}"
            self._export(remote, path, Service(full(service.uuid), remote.path))
            for place, proxy in enumerate(service.characteristics):
                self._export(remote, f"{path}/char{place:04x}", Characteristic(full(proxy.uuid), path, proxy, remote))
        remote.resolved = True
        remote.emit_properties_changed({"ServicesResolved": True})

    def _export(self, remote: Remote, path: str, thing: ServiceInterface) -> None:
        self.bus.export(path, thing)
        remote.objects.append(path)


def full(uuid: UUID) -> str:
    """Return a UUID as BlueZ writes it."""
    octets = uuid.to_bytes()
    if len(octets) == 16:
        return uuid.to_hex_str("-").lower()
    return f"0000{uuid.to_hex_str().lower()[-4:]}-0000-1000-8000-00805f9b34fb"
