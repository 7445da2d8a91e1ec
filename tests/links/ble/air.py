"""A process that is the air: nodes as Bluetooth peripherals on bumble's virtual radio, and a Bluetooth for stations.

The Bluetooth is either the stand-in for bluetoothd on a private bus (``bus``), or a controller on /dev/vhci for the
kernel (``vhci``). ``hci`` are TCP ports with a virtual controller each, for nodes that run in processes of their own.
Configured by one line of JSON on stdin; then commands, a JSON list a line, each answered by a line.
"""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bumble.att import ATT_Error
from bumble.controller import Controller
from bumble.core import UUID, PhysicalTransport
from bumble.device import Device, Peer
from bumble.hci import Address
from bumble.host import Host
from bumble.link import LocalLink
from bumble.transport import open_transport

from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import Peripheral
from teds_provision.node.hardware.board import Board
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet

STATION = "F0:F1:F2:F3:F4:22"


class Air(LocalLink):
    """bumble 0.0.236 delivers data under the sender's random address, whichever it connected with; Linux has both."""

    def send_acl_data(self, sender: Any, destination: Any, transport: Any, data: bytes) -> None:
        if transport == PhysicalTransport.LE:
            mine, peer = sender.le_connections.get(destination), self.find_le_controller(destination)
            if mine is not None and peer is not None:
                loop = asyncio.get_running_loop()
                loop.call_soon(peer.on_link_acl_data, mine.self_address, transport, data)
                return
        super().send_acl_data(sender, destination, transport, data)


class CutPeripheral(Peripheral):
    """Loses its connection after so many pieces that were written, and may be mute."""

    cut_after: int | None = None
    pieces = 0

    def _written(self, connection: Any, value: bytes) -> None:
        self.pieces += 1
        if self.cut_after is not None and self.pieces > self.cut_after:
            self.cut_after = None
            self.drop()
            return
        super()._written(connection, value)

    def drop(self) -> None:
        """Cut every connection."""
        for line in list(self._lines.values()):
            asyncio.get_running_loop().create_task(self._drop(line))


class OtherConnection:
    """A connection that is none of the station's."""

    def __init__(self, connection: Any) -> None:
        self.connection, self.is_gone = connection, False
        connection.on("disconnection", lambda _reason: setattr(self, "is_gone", True))


class BleScene:
    """Nodes, radio and Bluetooth of one test."""

    def __init__(self) -> None:
        self.link = Air()
        self.nodes: list[Any] = []
        self.virtual: list[VirtualNode] = []
        self.pulse = RealtimeLoop()
        self.bluez: Any = None
        self.keep: list[Any] = []
        self.strangers: list[OtherConnection] = []
        self.stranger_seconds = 10.0

    async def open(self, config: dict[str, Any]) -> None:
        self.pulse.start()
        self.stranger_seconds = config.get("stranger_seconds", 10.0)
        for number, folder in enumerate(config.get("nodes", [])):
            in_c = config.get("in_c", False)
            await (self.add_in_c if in_c is True or (in_c and folder in in_c) else self.add)(number, Path(folder))
        for port in config.get("hci", []):
            transport = await open_transport(f"tcp-server:127.0.0.1:{port}")
            self.keep.append((transport, self.controller(f"H{port}", transport)))
        if config.get("vhci"):
            transport = await open_transport("vhci")
            self.keep.append((transport, self.controller("V", transport, STATION)))
        if config.get("bus"):
            await self.stand_in(config["bus"], config.get("manners", {}))

    def controller(self, name: str, transport: Any, address: str | None = None) -> Controller:
        return Controller(
            name, host_source=transport.source, host_sink=transport.sink, link=self.link, public_address=address
        )

    def host(self, name: str, address: str | None = None) -> Host:
        host = Host()
        host.controller = Controller(name, link=self.link, public_address=address)
        return host

    async def add(self, number: int, folder: Path) -> None:
        def board(file: Any) -> Board | None:
            return Board(Sheet.from_image(Image(file.load().uuid, file.hardware))) if file.hardware else None

        node = VirtualNode(folder, exclusive=True, board=board, pulse=self.pulse)
        address = StaticAddress(folder, factory=node.in_factory_state())
        peripheral = CutPeripheral(node, address, stranger_seconds=self.stranger_seconds)
        await peripheral.power_on(self.host(f"N{number}", f"00:D8:57:00:{number >> 8:02X}:{number & 255:02X}"))
        loop = asyncio.get_running_loop()

        def send(frame: DataFrame) -> None:
            asyncio.run_coroutine_threadsafe(peripheral.notify_data(frame.link_source, frame.data), loop).result(2)

        node.streams_over(send, "ble")
        self.nodes.append(peripheral)
        self.virtual.append(node)

    async def add_in_c(self, number: int, folder: Path) -> None:
        """The same node as firmware: the C library takes over what the folder holds."""
        from tests.firmware.ble_board import CPeripheral

        peripheral = CPeripheral(folder)
        await peripheral.power_on(self.host(f"N{number}", f"00:D8:57:00:{number >> 8:02X}:{number & 255:02X}"))
        self.nodes.append(peripheral)

    async def stand_in(self, bus_address: str, manners: dict[str, Any]) -> None:
        from dbus_fast.aio import MessageBus

        from tests.links.ble.bluez import Bluez, Manners

        device = Device(name="station", address=Address(STATION), host=self.host("station", STATION))
        await device.power_on()
        bus = await MessageBus(bus_address=bus_address).connect()
        self.bluez = Bluez(bus, device, Manners(**manners))
        await self.bluez.serve()

    # -- commands --------------------------------------------------------------------------------------------------

    def do(self, words: list[Any]) -> Any:
        name, *rest = words
        doing: dict[str, Callable[..., Any]] = {
            "tap": lambda number: self.nodes[number].tapped(),
            "drop": lambda number: self.nodes[number].drop(),
            "cut": self.cut,
            "pieces": lambda number: self.nodes[number].pieces,
            "lines": lambda number: len(self.nodes[number]._lines),
            "reset": lambda number: self.virtual[number].reset_by_hand(),
            "stranger": self.stranger,
            "access": self.access,
            "strangers_held": lambda: sum(not stranger.is_gone for stranger in self.strangers),
            "address": lambda number: self.nodes[number]._address.address.text,
            "manners": self.manners,
            "counts": self.counts,
        }
        return doing[name](*rest)

    async def stranger(self, number: int) -> None:
        """Somebody else connects to a node, and says nothing."""
        device = Device(name="stranger", host=self.host(f"S{len(self.strangers)}"))
        await device.power_on()
        address = Address(self.nodes[number]._address.address.text, Address.RANDOM_DEVICE_ADDRESS)
        self.strangers.append(OtherConnection(await device.connect(address, timeout=10)))

    async def access(self, number: int, kind: str, uuid: str) -> int | None:
        """Somebody reads or writes a characteristic of a node: the error that comes back, None for none in 5 s."""
        await self.stranger(number)
        peer = Peer(self.strangers[-1].connection)
        await peer.discover_services()
        await peer.discover_characteristics()
        (found,) = peer.get_characteristics_by_uuid(UUID(uuid))
        work = found.read_value() if kind == "read" else found.write_value(b"\0", with_response=True)
        try:
            await asyncio.wait_for(work, 5)
        except ATT_Error as error:
            return int(error.error_code)
        except TimeoutError:
            return None
        return 0

    def cut(self, number: int, pieces: int) -> None:
        node = self.nodes[number]
        node.cut_after = node.pieces + pieces

    def manners(self, changed: dict[str, Any]) -> dict[str, Any]:
        for name, value in changed.items():
            setattr(self.bluez.manners, name, value)
        if "powered" in changed:
            self.bluez.adapter.emit_properties_changed({"Powered": changed["powered"]})
        return asdict(self.bluez.manners)

    def counts(self) -> dict[str, int]:
        names = ("removed", "connects", "most_held", "pending_at_once", "held", "known")
        return {name: getattr(self.bluez, name) for name in names}


async def main() -> None:
    """Serve until stdin ends, or the descriptor that is named instead of it."""
    logging.basicConfig(level=logging.ERROR)
    loop = asyncio.get_running_loop()
    lines = asyncio.StreamReader()
    source = open(int(sys.argv[1])) if sys.argv[1:] else sys.stdin  # noqa: SIM115  until the process ends
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), source)
    everything = BleScene()
    await everything.open(json.loads(await lines.readline()))
    print(json.dumps({"nodes": [node._address.address.text for node in everything.nodes]}), flush=True)
    while line := await lines.readline():
        try:
            result = everything.do(json.loads(line))
            if isinstance(result, Awaitable):
                result = await result
            print(json.dumps({"result": result}), flush=True)
        except Exception as error:  # noqa: BLE001 - told to the test
            print(json.dumps({"error": repr(error)}), flush=True)
    for node in everything.nodes:
        with suppress(Exception):
            await asyncio.wait_for(node.power_off(), 3)
    everything.pulse.stop()


if __name__ == "__main__":
    asyncio.run(main())
