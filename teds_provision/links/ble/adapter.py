"""One Bluetooth adapter as bleak has it: scans for nodes, one connect at a time, how many connections it holds.

Everything here runs in the port's loop. BlueZ knows a device only after it was seen, and forgets it about 30 s after
the scan: so the one address is scanned for, and what was seen is connected at once.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import LinkError, NoNodeError
from teds_provision.links.ble import ble_errors
from teds_provision.links.ble.spec import BleSpec
from teds_provision.protocol.messages.ble import SERVICE

if TYPE_CHECKING:
    from bleak.backends.device import BLEDevice
    from bleak.backends.scanner import AdvertisementData

CONNECT_SECONDS: Final = 10.0
_FRESH_SECONDS: Final = 20.0
"""A device that was seen so lately BlueZ still knows."""
_BUSY_TRIES: Final = 6
_FIRST_PAUSE: Final = 0.25
_LOOK_SECONDS: Final = 0.05


class Adapter:
    """``spec.adapter``, or the first that is powered."""

    def __init__(self, spec: BleSpec) -> None:
        self.spec = spec
        self.connecting = asyncio.Lock()
        """Some controllers take one pending connect and refuse the next."""
        self.held: set[object] = set()
        self._seen: dict[str, tuple[BLEDevice, float]] = {}

    def seen(self) -> dict[str, float]:
        """Return every node that advertised, and when (monotonic seconds)."""
        return {address: at for address, (_, at) in self._seen.items()}

    def forget(self, address: str) -> None:
        """Drop a device that BlueZ has forgotten."""
        self._seen.pop(address, None)

    async def scan(self, seconds: float, enough: Callable[[dict[str, float]], bool]) -> dict[str, float]:
        """Listen for nodes until ``enough`` is true of what was seen since the begin; which addresses, and when."""
        began = time.monotonic()
        now: dict[str, float] = {}
        async with self._scanner(now):
            while time.monotonic() - began < seconds and not enough(now):
                await asyncio.sleep(_LOOK_SECONDS)
        return now

    async def device(self, address: str) -> BLEDevice:
        """Return the device at this address, as BlueZ knows it now; raises NoNodeError."""
        known = self._seen.get(address)
        if known is None or time.monotonic() - known[1] > _FRESH_SECONDS:
            await self.scan(CONNECT_SECONDS, lambda now: address in now)
            known = self._seen.get(address)
        if known is None:
            raise NoNodeError(
                f"No node advertises as {address}.",
                hint="Tap it: it then advertises for 60 s; a node with a key always does. Is it in range?",
            )
        return known[0]

    @asynccontextmanager
    async def _scanner(self, now: dict[str, float]) -> AsyncIterator[None]:
        try:
            from bleak import BleakScanner
        except ImportError:
            raise ble_errors.missing_bleak() from None
        for name in ("bleak", "dbus_fast"):
            logging.getLogger(name).setLevel(logging.CRITICAL)

        def detected(device: BLEDevice, advertisement: AdvertisementData) -> None:
            # BlueZ merges the filters of all programs and keeps the UUIDs that a device had earlier, so check again.
            if SERVICE in (uuid.lower() for uuid in advertisement.service_uuids):
                at = time.monotonic()
                self._seen[device.address.upper()] = (device, at)
                now[device.address.upper()] = at

        bluez: Any = {"adapter": self.spec.adapter} if self.spec.adapter else {}
        scanner = BleakScanner(detected, service_uuids=[SERVICE], bluez=bluez)
        await self.persist(scanner.start)
        try:
            yield
        finally:
            try:
                await scanner.stop()
            except Exception as error:  # bleak and D-Bus raise many classes; the scan has ended anyway
                trouble = ble_errors.adapter_trouble(error, self.spec.text)
                if trouble is not None:
                    raise trouble from error

    async def persist(self, work: Callable[[], Any]) -> Any:
        """Do what another program's connect or scan may hold up.

        Raises NoReaderError for Bluetooth that cannot be used.
        """
        for attempt in range(_BUSY_TRIES):
            try:
                return await work()
            except LinkError:
                raise
            except Exception as error:
                trouble = ble_errors.adapter_trouble(error, self.spec.text)
                if trouble is not None:
                    raise trouble from error
                if not ble_errors.is_busy(error) or attempt == _BUSY_TRIES - 1:
                    raise
                await asyncio.sleep(_FIRST_PAUSE * 2**attempt)
        raise AssertionError("every attempt returns or raises")
