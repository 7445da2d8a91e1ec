"""A virtual transducer's BLE: a peripheral on a controller that bumble drives, in a separate loop and thread.

The controller is named as in bumble: ``usb:0`` (a dongle, taken from the kernel), ``serial:/dev/ttyACM0``,
``tcp-client:127.0.0.1:46100`` (a virtual one).
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Final, TypeVar

from teds_provision.errors import LinkError, NoReaderError, UsageError
from teds_provision.lazy import how_to_install
from teds_provision.links.hints import BleAddress
from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import Peripheral
from teds_provision.node.handler import BleHandler
from teds_provision.protocol.operation.streams import DataFrame

Result = TypeVar("Result")
_OPEN_SECONDS: Final = 10.0
_SEND_SECONDS: Final = 2.0


class BleServer:
    """Serves ``node`` over the controller ``transport``; see LinkServer. Raises UsageError without bumble."""

    def __init__(self, transport: str, node: BleHandler, address: StaticAddress) -> None:
        try:
            import bumble  # noqa: F401
        except ImportError:
            raise UsageError(
                "A node's BLE needs bumble, which is not installed.",
                hint=how_to_install("ble-node"),
            ) from None
        self._transport, self._node, self._address = transport, node, address
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="ble-node", daemon=True)
        self._peripheral: Peripheral | None = None
        self._opened: Any = None

    @property
    def address(self) -> BleAddress:
        """The present address, for the out-of-band record of the initial NFC message."""
        return self._address.address

    def start(self) -> None:
        """Open the controller; raises NoReaderError if it does not answer."""
        self._thread.start()
        try:
            self._run(self._open(), _OPEN_SECONDS)
        except (OSError, ValueError, TimeoutError, RuntimeError) as error:
            self.stop()
            why = str(error) or type(error).__name__
            raise NoReaderError(
                f"The Bluetooth controller {self._transport} does not open: {why}.",
                hint="usb:0 needs a dongle that the kernel leaves alone (hciconfig hci0 down), and the right to it.",
            ) from error

    def stop(self) -> None:
        """End; never raises. Does nothing before the start and after the end."""
        if not self._thread.is_alive():
            return  # its loop would never do the work
        with suppress(Exception):
            self._run(self._close(), _OPEN_SECONDS)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=3)

    def tapped(self) -> None:
        """Handle a tap of the node."""
        if self._peripheral is not None:
            self._loop.call_soon_threadsafe(self._peripheral.tapped)

    def restarted(self) -> None:
        """Begin again with a node that has restarted: every connection is dropped."""
        if self._peripheral is not None:
            self._loop.call_soon_threadsafe(self._peripheral.restarted)

    def send_data(self, frame: DataFrame) -> None:
        """Send a data message; waits until the controller has taken it. Raises LinkError."""
        peripheral = self._peripheral
        if peripheral is None:
            return
        try:
            self._run(peripheral.notify_data(frame.link_source, frame.data), _SEND_SECONDS)
        except TimeoutError as error:
            raise LinkError("The Bluetooth controller takes no data.") from error

    async def _open(self) -> None:
        from bumble.host import Host
        from bumble.transport import open_transport

        self._opened = await open_transport(self._transport)
        peripheral = Peripheral(self._node, self._address)
        await peripheral.power_on(Host(self._opened.source, self._opened.sink))
        self._peripheral = peripheral

    async def _close(self) -> None:
        if self._peripheral is not None:
            await self._peripheral.power_off()
        if self._opened is not None:
            await self._opened.close()

    def _run(self, work: Coroutine[Any, Any, Result], seconds: float) -> Result:
        running = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return running.result(seconds)
        except TimeoutError:
            running.cancel()
            raise
