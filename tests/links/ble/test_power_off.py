"""A node in the air that is switched off: its connections end, and its sessions with them."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from bumble.controller import Controller
from bumble.core import PhysicalTransport
from bumble.device import Device
from bumble.hci import Address
from bumble.host import Host

from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import CentralState, Peripheral
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.virtual import VirtualNode
from teds_provision.node.worker_pool import WorkerPool
from tests.links.ble.air import STATION, Air
from tests.pace import PATIENCE


class Node(VirtualNode):
    """Notes which links it lost."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, exclusive=True)
        self.lost_links: list[str] = []

    def lost(self, link: str) -> None:
        self.lost_links.append(link)
        super().lost(link)


async def until(holds: Callable[[], bool]) -> None:
    async def wait() -> None:
        while not holds():
            await asyncio.sleep(0.01)

    await asyncio.wait_for(wait(), PATIENCE)


def host_at(air: Air, name: str, address: str) -> Host:
    host = Host()
    host.controller = Controller(name, link=air, public_address=address)
    return host


def busy_until(done: threading.Event) -> None:
    """Be a command that takes long: the only thread of the node runs it."""
    done.wait(PATIENCE)


async def switched_off(node: Node, folder: Path) -> None:
    air = Air()
    peripheral = Peripheral(node, StaticAddress(folder, factory=True))
    peripheral._workers = WorkerPool(1)
    await peripheral.power_on(host_at(air, "N", "00:D8:57:00:00:01"))
    peripheral.tapped()
    central = Device(name="C", address=Address(STATION), host=host_at(air, "C", "F0:F1:F2:F3:F4:22"))
    await central.power_on()
    await until(lambda: peripheral._advertising)
    there = Address(StaticAddress(folder, factory=True).address.text, Address.RANDOM_DEVICE_ADDRESS)
    connection = await asyncio.wait_for(central.connect(there, PhysicalTransport.LE), PATIENCE)
    gone = asyncio.Event()
    connection.on("disconnection", lambda _reason: gone.set())
    await until(lambda: len(peripheral._lines) == 1)
    (line,) = peripheral._lines.values()
    done = threading.Event()
    peripheral._workers.run(lambda: busy_until(done))
    off = asyncio.create_task(peripheral.power_off())
    await asyncio.wait_for(gone.wait(), PATIENCE)
    await until(lambda: peripheral._workers._ended or len(line.jobs._jobs) > 1)
    assert node.lost_links == []
    done.set()
    await asyncio.wait_for(off, PATIENCE)
    assert node.lost_links == ["ble:2"]
    assert peripheral._lines == {}
    assert peripheral._task is not None
    assert peripheral._task.done(), "nothing advertises any more"
    assert not peripheral._device.is_advertising


@pytest.mark.timeout(40)
def test_a_node_that_is_switched_off_has_lost_its_connections_and_their_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.node.ble.peripheral._END_SECONDS", PATIENCE, raising=False)
    FlashFile.create(tmp_path / "node")
    node = Node(tmp_path / "node")
    before = set(threading.enumerate())
    loop = asyncio.new_event_loop()  # asyncio.run would wait for a peripheral that goes on to look, without end
    try:
        loop.run_until_complete(switched_off(node, tmp_path / "node"))
        loop.run_until_complete(loop.shutdown_default_executor())
    finally:
        loop.close()
    assert {thread for thread in threading.enumerate() if thread.is_alive()} <= before, "no thread of it is left"


async def connected_meanwhile(node: Node, folder: Path) -> None:
    peripheral = Peripheral(node, StaticAddress(folder, factory=True))
    peripheral._workers = WorkerPool(1)
    done = threading.Event()

    def connect() -> CentralState:
        known = set(peripheral._lines)
        peripheral._connected(SimpleNamespace(on=lambda *_: None))
        (number,) = peripheral._lines.keys() - known
        return peripheral._lines[number]

    first = connect()
    first.jobs.put(lambda: busy_until(done))
    peripheral._disconnected(first)
    second = connect()
    assert second.name != first.name, "the session of the first is still to be ended, by its name"
    done.set()
    await until(lambda: node.lost_links == [first.name])
    peripheral._workers.end()
    assert connect().name == first.name


def test_who_connects_while_the_session_before_is_still_to_be_ended_does_not_lose_its_own(tmp_path: Path) -> None:
    FlashFile.create(tmp_path)
    asyncio.run(connected_meanwhile(Node(tmp_path), tmp_path))
