"""A node as a Bluetooth LE peripheral: its GATT service, its connections, when it advertises (profile.md, "BLE").

Runs in the caller's loop, over any controller that bumble can talk to; commands run in a pool of threads.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final

from teds_provision.errors import TedsProvisionError
from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.handler import BleHandler
from teds_provision.node.worker_pool import WorkerPool
from teds_provision.protocol.messages import ble
from teds_provision.protocol.repetition import Repetition

BUS: Final = "ble"
CONNECTIONS: Final = 3
"""Connections at once: two at least, so that a stranger does not hold the only one."""
STRANGER_SECONDS: Final = 10.0
"""After so long a connection without a session is dropped."""
TAPPED_SECONDS: Final = 60.0
"""A node without key advertises for so long after a tap."""
_LONGEST: Final = 0xFFFF
"""Octets of a request that are put together: what is longer than maxMessage gets 10, and not silence."""
_FIRST_SOURCE: Final = 2
_MOST_WAITING: Final = 4
_LOOK_SECONDS: Final = 0.5
_END_SECONDS: Final = 3.0
"""For commands that run when the node is switched off."""
_INTERVAL_MS: Final = 100
_FLAGS: Final = b"\x06"
"""LE general discoverable, no BR/EDR."""
_LOG: Final = logging.getLogger(__name__)


class CentralState:
    """One connection: its session (by name), its stored reply, what it has enabled. Used in the loop alone."""

    def __init__(self, number: int, connection: Any, workers: WorkerPool) -> None:
        self.number, self.connection = number, connection
        self.name = f"{BUS}:{number:x}"
        self.jobs = workers.new_queue()
        self.assembly = ble.BleAssembly(_LONGEST)
        self.repetition = Repetition()
        self.waiting = 0
        self.hears = False
        self.gone = False
        self.without_session_since = time.monotonic()

    @property
    def mtu(self) -> int:
        """ATT MTU of the connection."""
        return int(self.connection.att_mtu)


class Peripheral:
    """One node in the air. ``address`` is kept beside its flash; ``power_on`` begins, ``power_off`` ends."""

    def __init__(self, node: BleHandler, address: StaticAddress, *, stranger_seconds: float = STRANGER_SECONDS) -> None:
        self._node, self._address, self._stranger_seconds = node, address, stranger_seconds
        self._workers = WorkerPool()
        self._dropping: set[asyncio.Task[None]] = set()
        self._lines: dict[int, CentralState] = {}
        self._ending: set[int] = set()
        """Numbers of connections that are gone, and whose sessions the node has not ended yet."""
        self._tapped_until = 0.0
        self._advertising = False
        self._news = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._is_off = False
        self._device: Any = None
        self._notify: Any = None
        self._data: Any = None

    async def power_on(self, host: Any) -> None:
        """Begin on the controller behind a bumble ``host``."""
        from bumble.device import Device
        from bumble.gatt import Characteristic, CharacteristicValue, Service

        properties, permissions = Characteristic.Properties, Characteristic.Permissions
        self._notify = Characteristic(
            _uuid(ble.NOTIFY), properties.NOTIFY, permissions(0), CharacteristicValue(read=_unread, write=_unwritten)
        )
        self._data = Characteristic(
            _uuid(ble.DATA),
            properties.NOTIFY | properties.WRITE_WITHOUT_RESPONSE,
            permissions.WRITEABLE,
            CharacteristicValue(read=_unread, write=self._driven),
        )
        write = Characteristic(
            _uuid(ble.WRITE),
            properties.WRITE,
            permissions.WRITEABLE,
            CharacteristicValue(read=_unread, write=self._written),
        )
        self._device = Device(name="", address=self._bumble_address(), host=host)
        self._device.add_service(Service(_uuid(ble.SERVICE), [write, self._notify, self._data]))
        self._data.on(self._data.EVENT_SUBSCRIPTION, self._subscribed)
        self._device.on("connection", self._connected)
        await self._device.power_on()
        self._task = asyncio.get_running_loop().create_task(self._look_after())

    async def power_off(self) -> None:
        """End every connection and every session."""
        self._is_off = True
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        lines = list(self._lines.values())
        for line in lines:
            await self._drop(line)
        with suppress(Exception):
            await self._device.stop_advertising()
            await self._device.power_off()
        # before the workers end: they would drop queued jobs, and a session would not be closed
        await asyncio.to_thread(_finish_turns, lines)
        await asyncio.to_thread(self._workers.end)

    def tapped(self) -> None:
        """Advertise for at least a minute: the node was tapped."""
        self._tapped_until = time.monotonic() + TAPPED_SECONDS
        self._news.set()

    async def notify_data(self, number: int, octets: bytes) -> None:
        """Send a data message over the connection of this number; drop it if that is gone."""
        line = self._lines.get(number)
        if line is not None and line.hears:
            await self._device.notify_subscriber(line.connection, self._data, octets)
            with suppress(Exception):  # the connection may end meanwhile
                await line.connection.drain()

    # -- advertising -----------------------------------------------------------------------------------------------

    async def _look_after(self) -> None:
        while not self._is_off:  # until Python 3.12, wait_for loses a cancellation that comes together with its event
            try:
                await self._look()
            except Exception:  # noqa: BLE001 - bumble raises what its controller says; it is tried again at the next look
                _LOG.debug("Advertising failed.", exc_info=True)
            self._news.clear()
            with suppress(TimeoutError):
                await asyncio.wait_for(self._news.wait(), _LOOK_SECONDS)

    async def _look(self) -> None:
        """Start or stop advertising, with the node's present address; drop connections without a session."""
        factory = self._node.in_factory_state()
        if self._address.look(factory=factory):
            await self._stop_advertising()
            from bumble.hci import HCI_LE_Set_Random_Address_Command

            self._device.static_address = self._device.random_address = self._bumble_address()
            command = HCI_LE_Set_Random_Address_Command(random_address=self._device.random_address)
            await self._device.send_sync_command(command)
        wanted = len(self._lines) < CONNECTIONS and (not factory or time.monotonic() < self._tapped_until)
        if wanted and not self._advertising:
            await self._advertise()
        elif not wanted:
            await self._stop_advertising()
        now = time.monotonic()
        for line in list(self._lines.values()):
            if self._node.in_session(line.name):
                line.without_session_since = now
            elif now - line.without_session_since >= self._stranger_seconds:
                await self._drop(line)

    async def _advertise(self) -> None:
        from bumble.core import AdvertisingData

        self._device.advertising_data = bytes(
            AdvertisingData(
                [
                    (AdvertisingData.FLAGS, _FLAGS),
                    (AdvertisingData.COMPLETE_LIST_OF_128_BIT_SERVICE_CLASS_UUIDS, bytes(_uuid(ble.SERVICE))),
                ]
            )
        )
        self._device.scan_response_data = b""
        await self._device.start_advertising(
            advertising_interval_min=_INTERVAL_MS, advertising_interval_max=_INTERVAL_MS
        )
        self._advertising = True

    async def _stop_advertising(self) -> None:
        if self._advertising:
            self._advertising = False
            await self._device.stop_advertising()

    def _bumble_address(self) -> Any:
        from bumble.hci import Address

        return Address(self._address.address.text, Address.RANDOM_DEVICE_ADDRESS)

    # -- connections -----------------------------------------------------------------------------------------------

    def _connected(self, connection: Any) -> None:
        number = next(
            free for free in range(_FIRST_SOURCE, 256) if free not in self._lines and free not in self._ending
        )
        line = self._lines[number] = CentralState(number, connection, self._workers)
        connection.on("disconnection", lambda _reason: self._disconnected(line))
        self._advertising = False  # a controller stops advertising when a central connects
        self._news.set()

    def _disconnected(self, line: CentralState) -> None:
        if not line.gone:
            line.gone = True
            del self._lines[line.number]
            self._ending.add(line.number)
            line.repetition.forget()
            line.jobs.put(lambda: self._end_session(line))
            self._news.set()

    def _end_session(self, line: CentralState) -> None:
        """End the session of a connection that is gone; only then another one may have its name."""
        self._node.lost(line.name)
        self._ending.discard(line.number)

    def restarted(self) -> None:
        """Drop every connection: the board has restarted."""
        for line in list(self._lines.values()):
            self._dropping.add(task := asyncio.get_running_loop().create_task(self._drop(line)))
            task.add_done_callback(self._dropping.discard)

    async def _drop(self, line: CentralState) -> None:
        with suppress(Exception):  # the connection may have ended already
            await asyncio.wait_for(line.connection.disconnect(), 2.0)
        self._disconnected(line)

    def _line_of(self, connection: Any) -> CentralState | None:
        return next((line for line in self._lines.values() if line.connection is connection), None)

    def _subscribed(self, connection: Any, notify: bool, _indicate: bool) -> None:
        line = self._line_of(connection)
        if line is not None:
            line.hears = notify
            if not notify:
                line.jobs.put(lambda: self._node.unheard(line.name))

    # -- commands --------------------------------------------------------------------------------------------------

    def _written(self, connection: Any, value: bytes) -> None:
        """Handle a piece of a command that a station wrote."""
        line = self._line_of(connection)
        received = line.assembly.add_frame(bytes(value)) if line is not None else None
        if line is None or received is None or line.waiting >= _MOST_WAITING:
            return
        line.waiting += 1
        loop, tick = asyncio.get_running_loop(), self._node.tick()
        job = self._job(line, received, tick, loop)
        line.jobs.put(job)

    def _job(
        self, line: CentralState, received: ble.ReceivedMessage, tick: int, loop: asyncio.AbstractEventLoop
    ) -> Callable[[], None]:
        def run(frame: bytes) -> bytes:
            return self._node.request_received(
                line.name, frame, tapped=False, received=tick, mtu=line.mtu, hears=line.hears
            )

        def job() -> None:
            try:
                reply = line.repetition.answer(received.transaction, received.message, run, now=time.monotonic())
            except TedsProvisionError:
                return  # a node that fails (its flash file is gone) does not reply
            finally:
                line.waiting -= 1
            sent = asyncio.run_coroutine_threadsafe(self._reply(line, received.transaction, reply), loop)
            with suppress(Exception):  # the connection is gone
                sent.result()
            line.repetition.reply_sent(time.monotonic())
            self._node.reply_sent(line.name)

        return job

    async def _reply(self, line: CentralState, transaction: int, reply: bytes) -> None:
        for frame in ble.cut(transaction, reply, line.mtu):
            if line.gone:
                return
            await self._device.notify_subscriber(line.connection, self._notify, frame)
        self._news.set()

    def _driven(self, connection: Any, value: bytes) -> None:
        """Handle a Drive message: 00 ‖ message."""
        line = self._line_of(connection)
        if line is not None and value[:1] == b"\0":
            line.jobs.put(lambda: self._node.drive(line.name, bytes(value[1:])))


def _finish_turns(lines: Sequence[CentralState]) -> None:
    """Wait until the jobs of these connections have run, the loss of each among them."""
    until = time.monotonic() + _END_SECONDS
    for line in lines:
        ended = threading.Event()
        line.jobs.put(ended.set)
        ended.wait(max(0.0, until - time.monotonic()))


def _unread(_connection: Any) -> bytes:
    """Refuse an ATT read; bumble answers only this exception, after any other the client waits for its 30 s."""
    from bumble.att import ATT_READ_NOT_PERMITTED_ERROR, ATT_Error

    raise ATT_Error(ATT_READ_NOT_PERMITTED_ERROR)


def _unwritten(_connection: Any, _value: bytes) -> None:
    from bumble.att import ATT_WRITE_NOT_PERMITTED_ERROR, ATT_Error

    raise ATT_Error(ATT_WRITE_NOT_PERMITTED_ERROR)


def _uuid(text: str) -> Any:
    from bumble.core import UUID

    return UUID(text)
