"""A board in the air: bumble is its chip's Bluetooth stack, the C library its firmware."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import CentralState, Peripheral
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.handler import BleHandler
from teds_provision.node.hardware.board import Board
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet
from tests.firmware.memory_node import MemoryNode

FIRST = 2
_BEAT = 0.002
"""The link of connection 0."""


class CPeripheral(Peripheral):
    """The node of a virtual node's folder as firmware: its identity, key and datasheet, the library's frames."""

    def __init__(self, folder: Path) -> None:
        file = FlashFile(folder)
        state = file.load()
        self._secret = file.key.secret()
        self.c = MemoryNode(self._draw, time.monotonic, uuid=state.uuid, max_message=2048, max_teds=16384)
        if file.hardware:
            for number, facts in Board(Sheet.from_image(Image(state.uuid, file.hardware))).channels.items():
                self.c.add_channel(number, int(facts.kind), facts.octets, model=facts.model, shortest=facts.shortest)
        assert self.c.start() == 0
        self.c.put(state)
        self._turn = threading.Lock()
        self.pieces = 0
        self._beats: asyncio.Task[None] | None = None
        super().__init__(cast(BleHandler, self), StaticAddress(folder, factory=False))

    def _draw(self, kind: str, size: int) -> bytes:
        return self._secret if kind == "i" else b"\x01" + os.urandom(size - 1)

    # -- what the peripheral asks of its node --------------------------------------------------------------------

    def in_factory_state(self) -> bool:
        with self._turn:
            return self.c.identity().state == 0

    def in_session(self, name: str) -> bool:
        with self._turn:
            return self.c.in_session(int(name.partition(":")[2], 16))

    def lost(self, name: str) -> None:
        with self._turn:
            self.c.ble_disconnected(int(name.partition(":")[2], 16) - FIRST)

    def unheard(self, name: str) -> None:
        """It was told already."""

    # -- data messages -------------------------------------------------------------------------------------------

    async def power_on(self, host: Any) -> None:
        await super().power_on(host)
        self._beats = asyncio.get_running_loop().create_task(self._beat())

    async def power_off(self) -> None:
        if self._beats is not None:
            self._beats.cancel()
        await super().power_off()

    async def _beat(self) -> None:
        while True:
            with self._turn:
                self.c.poll()
                due = self.c.ble_data()
            if due is None:
                await asyncio.sleep(_BEAT)
                continue
            with suppress(Exception):  # the connection is gone
                await self.notify_data(due[0] + FIRST, due[1])

    def _subscribed(self, connection: Any, notify: bool, indicate: bool) -> None:
        super()._subscribed(connection, notify, indicate)
        line = self._line_of(connection)
        if line is not None:
            with self._turn:
                self.c.ble_hears(line.number - FIRST, notify)

    def _driven(self, connection: Any, value: bytes) -> None:
        line = self._line_of(connection)
        if line is not None:
            with self._turn:
                self.c.ble_driven(line.number - FIRST, bytes(value))

    # -- connections ---------------------------------------------------------------------------------------------

    def _connected(self, connection: Any) -> None:
        super()._connected(connection)
        line = self._line_of(connection)
        assert line is not None
        with self._turn:
            self.c.ble_connected(line.number - FIRST, line.mtu)

    def _written(self, connection: Any, value: bytes) -> None:
        line = self._line_of(connection)
        if line is None:
            return
        self.pieces += 1
        with self._turn:
            self.c.ble_mtu(line.number - FIRST, line.mtu)
            due = self.c.ble_written(line.number - FIRST, bytes(value))
        if due:
            asyncio.get_running_loop().create_task(self._notified(line, due))

    async def _notified(self, line: CentralState, due: list[bytes]) -> None:
        for value in due:
            with suppress(Exception):  # the connection is gone
                await self._device.notify_subscriber(line.connection, self._notify, value)
