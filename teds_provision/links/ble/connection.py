"""One node over the air: connected when it is needed, one request and its reply at a time. Runs in the port's loop."""

from __future__ import annotations

import asyncio
import functools
import itertools
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import LinkError
from teds_provision.links.ble import ble_errors
from teds_provision.links.ble.adapter import CONNECT_SECONDS, Adapter
from teds_provision.links.ports import Direction, Trace
from teds_provision.protocol.messages import ble

if TYPE_CHECKING:
    from bleak import BleakClient
    from bleak.backends.characteristic import BleakGATTCharacteristic

MOST_REPLY: Final = 0xFFFF
_SUBSCRIBE_SECONDS: Final = 5.0
_DOWN_SECONDS: Final = 5.0
_FORGOTTEN_TRIES: Final = 2


class ConnectionLostError(Exception):
    """The connection ended, or did not come about, for a reason of the air: it is tried again."""


class NotConnectedError(ConnectionLostError):
    """No connection came about: nothing was sent."""


class BleConnection:
    """The connection to the node at ``address``; ``number`` identifies it in this process.

    ``data`` receives each notification of the data characteristic, in the loop.
    """

    _numbers = itertools.count(1)

    def __init__(
        self, adapter: Adapter, address: str, data: Callable[[int, bytes], None], trace: Trace | None = None
    ) -> None:
        self._adapter, self.address, self._data, self._trace = adapter, address, data, trace
        self.number = next(self._numbers)
        self.streaming = False
        """True if a measurement uses it: it is not given up for another node."""
        self.asking = False
        self.was_up = False
        """True if it was ever connected: then a lost connection is worth waiting for."""
        self._client: BleakClient | None = None
        self._news: asyncio.Queue[bytes | None] = asyncio.Queue()
        self._turn = asyncio.Lock()

    @property
    def is_up(self) -> bool:
        """True if the node is connected."""
        return self._client is not None and self._client.is_connected

    @property
    def mtu(self) -> int:
        """ATT MTU, 23 if it is not connected."""
        if not self.is_up:
            return ble.LEAST_MTU
        return max(self._characteristic(ble.WRITE).max_write_without_response_size + 3, ble.LEAST_MTU)

    async def exchange(self, transaction: int, message: bytes, seconds: float) -> bytes:
        """Write a command and return its reply; connects first if necessary.

        Raises ConnectionLostError, TimeoutError (no reply), NoNodeError, and the errors of unusable Bluetooth.
        """
        async with self._turn:
            self.asking = True
            try:
                await self.connect()
                return await self._exchange(transaction, message, seconds)
            finally:
                self.asking = False

    async def write_data(self, message: bytes) -> None:
        """Write a Drive message without response; raises ConnectionLostError."""
        to = self._characteristic(ble.DATA)
        await self._doing(lambda client: client.write_gatt_char(to, b"\0" + message, response=False))

    async def connect(self) -> None:
        """Connect and subscribe, unless that is done."""
        if self.is_up:
            return
        async with self._adapter.connecting:
            if not self.is_up:
                try:
                    await self._connect()
                except ConnectionLostError as lost:
                    raise NotConnectedError(str(lost)) from lost

    async def disconnect(self) -> None:
        """Disconnect; never raises."""
        client, self._client = self._client, None
        self._adapter.held.discard(self)
        if client is not None:
            with suppress(Exception):
                await asyncio.wait_for(client.disconnect(), _DOWN_SECONDS)

    # -- connecting ------------------------------------------------------------------------------------------------

    async def _connect(self) -> None:
        await self.disconnect()
        if not await self._client_with_service():
            # The GATT cache may be stale, as after a firmware update: have BlueZ forget the node, once.
            client, self._client = self._client, None
            if client is not None:
                with suppress(Exception):
                    await client.disconnect()
                with suppress(Exception):
                    await client.unpair()  # RemoveDevice
            self._adapter.forget(self.address)
            if not await self._client_with_service():
                await self.disconnect()
                raise LinkError(
                    f"The device at {self.address} advertises the service of a node but does not offer it.",
                    hint="Its firmware is wrong, or a cache: sudo rm -r /var/lib/bluetooth/*/cache, restart bluetooth.",
                )
        self._adapter.held.add(self)
        self.was_up = True

    async def _client_with_service(self) -> bool:
        """Connect, and subscribe; return False if the node's service is missing."""
        client = await self._connected()
        # Before connect() returns, bleak calls the disconnected callback for its own retries too: discard those events.
        self._empty()
        if any(client.services.get_characteristic(uuid) is None for uuid in (ble.WRITE, ble.NOTIFY)):
            return False
        await self._subscribe(client)
        return True

    async def _connected(self) -> BleakClient:
        """Return a connected client; looks for the device once more if BlueZ has forgotten it."""
        for attempt in range(_FORGOTTEN_TRIES):
            device = await self._adapter.device(self.address)
            client = self._client = self._new_client(device)
            try:
                await self._adapter.persist(client.connect)
                return client
            except LinkError:
                raise
            except Exception as error:
                self._client = None
                self._adapter.forget(self.address)
                if ble_errors.is_full(error, self._adapter.held):
                    raise ble_errors.too_many(len(self._adapter.held), self._adapter.spec.text) from error
                if not ble_errors.is_gone(error) or attempt == _FORGOTTEN_TRIES - 1:
                    raise ConnectionLostError(_why(error)) from error
        raise AssertionError("every attempt returns or raises")

    def _new_client(self, device: Any) -> BleakClient:
        from bleak import BleakClient

        bluez: Any = {"adapter": self._adapter.spec.adapter} if self._adapter.spec.adapter else {}
        return BleakClient(
            device,
            disconnected_callback=self._disconnected,
            services=[ble.SERVICE],
            timeout=CONNECT_SECONDS,
            bluez=bluez,
        )

    async def _subscribe(self, client: BleakClient) -> None:
        """Enable replies, and data if the node measures: before the first write."""
        try:
            async with asyncio.timeout(_SUBSCRIBE_SECONDS):
                await client.start_notify(ble.NOTIFY, lambda _c, octets: self._news.put_nowait(bytes(octets)))
                if client.services.get_characteristic(ble.DATA) is not None:
                    await client.start_notify(ble.DATA, lambda _c, octets: self._data(self.number, bytes(octets)))
        except Exception as error:
            raise ConnectionLostError(_why(error)) from error

    def _disconnected(self, client: BleakClient) -> None:
        self._adapter.held.discard(self)
        self._news.put_nowait(None)

    # -- exchanging ------------------------------------------------------------------------------------------------

    async def _exchange(self, transaction: int, message: bytes, seconds: float) -> bytes:
        self._empty()
        write = self._characteristic(ble.WRITE)
        for frame in ble.cut(transaction, message, self.mtu):
            self._note("out", frame)
            async with asyncio.timeout(seconds):
                await self._doing(functools.partial(_write, write, frame))
        assembly = ble.BleAssembly(MOST_REPLY)
        while True:
            async with asyncio.timeout(seconds):
                octets = await self._news.get()
            if octets is None:
                raise ConnectionLostError("the connection ended")
            self._note("in", octets)
            received = assembly.add_frame(octets)
            if received is not None and received.transaction == transaction:
                return received.message

    async def _doing(self, work: Callable[[BleakClient], Awaitable[None]]) -> None:
        client = self._client
        if client is None or not client.is_connected:
            raise ConnectionLostError("the connection ended")
        try:
            await work(client)
        except TimeoutError:
            raise
        except Exception as error:
            raise ConnectionLostError(_why(error)) from error

    def _characteristic(self, uuid: str) -> BleakGATTCharacteristic:
        found = self._client.services.get_characteristic(uuid) if self.is_up and self._client is not None else None
        if found is None:
            raise ConnectionLostError("the connection ended")
        return found

    def _note(self, direction: Direction, octets: bytes) -> None:
        if self._trace is not None:
            self._trace.frame("ble", direction, octets)

    def _empty(self) -> None:
        while not self._news.empty():
            self._news.get_nowait()


def _write(to: BleakGATTCharacteristic, frame: bytes, client: BleakClient) -> Awaitable[None]:
    return client.write_gatt_char(to, frame, response=True)


def _why(error: Exception) -> str:
    return str(error).strip() or type(error).__name__
