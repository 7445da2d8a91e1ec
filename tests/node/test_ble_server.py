"""A node's end of Bluetooth: its loop, what it hands to the peripheral there, and a controller that fails.

The controller is a mock: what bumble does with a real one is in ``tests/links/ble``.
"""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NoReaderError, UsageError
from teds_provision.node.ble import server
from teds_provision.node.ble.server import BleServer
from tests.pace import PATIENCE

ADDRESS: Any = SimpleNamespace(address="C0:00:00:00:00:01")
NODE: Any = object()


class Controller:
    """Calls of the controller, in order; a step in ``fails`` raises its error, the step ``slow`` times out."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.fails: dict[str, Exception] = {}
        self.slow = ""
        self.happened = threading.Semaphore(0)

    async def step(self, *what: Any) -> None:
        if what[0] in self.fails:
            raise self.fails[what[0]]
        if what[0] == self.slow:
            raise TimeoutError
        self.note(*what)

    def note(self, *what: Any) -> None:
        self.done.append((*what, threading.current_thread().name))
        self.happened.release()

    def wait(self, number: int) -> list[Any]:
        for _ in range(number):
            assert self.happened.acquire(timeout=PATIENCE)
        return self.done


@pytest.fixture
def controller(monkeypatch: pytest.MonkeyPatch) -> Controller:
    made = Controller()

    async def open_transport(name: str) -> Any:
        await made.step("open", name)
        return SimpleNamespace(source="source", sink="sink", close=lambda: made.step("close"))

    class Peripheral:
        def __init__(self, node: object, address: object) -> None:
            assert (node, address) == (NODE, ADDRESS)

        async def power_on(self, host: object) -> None:
            await made.step("power on", host)

        async def power_off(self) -> None:
            await made.step("power off")

        async def notify_data(self, link: str, data: bytes) -> None:
            await made.step("data", link, data)

        def tapped(self) -> None:
            made.note("tapped")

        def restarted(self) -> None:
            made.note("restarted")

    def host(source: object, sink: object) -> object:
        return ("host", source, sink)

    for name, module in (
        ("bumble", SimpleNamespace()),
        ("bumble.host", SimpleNamespace(Host=host)),
        ("bumble.transport", SimpleNamespace(open_transport=open_transport)),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(server, "Peripheral", Peripheral)
    return made


@pytest.fixture
def served(controller: Controller) -> Iterator[BleServer]:
    made = BleServer("usb:0", NODE, ADDRESS)
    yield made
    made.stop()


def of_loop(*steps: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    return [(*step, "ble-node") for step in steps]


OPENED = ("open", "usb:0"), ("power on", ("host", "source", "sink"))


def frame(data: bytes = b"\1data") -> Any:
    return SimpleNamespace(link_source="ble:c0", data=data)


def test_all_of_a_node_s_bluetooth_happens_in_its_own_loop(controller: Controller, served: BleServer) -> None:
    assert served.address is ADDRESS.address
    served.start()
    served.tapped()
    served.restarted()
    served.send_data(frame())
    assert controller.wait(5) == of_loop(*OPENED, ("tapped",), ("restarted",), ("data", "ble:c0", b"\1data"))
    served.stop()
    assert controller.done[5:] == of_loop(("power off",), ("close",))
    assert not served._thread.is_alive()


def test_before_the_controller_is_there_nothing_is_sent(controller: Controller, served: BleServer) -> None:
    served.tapped()
    served.restarted()
    served.send_data(frame())
    served.stop()
    assert controller.done == []


@pytest.mark.parametrize(
    ("where", "error", "why"),
    [
        ("open", OSError("no such device"), "no such device"),
        ("open", ValueError("unknown transport"), "unknown transport"),
        ("power on", TimeoutError(), "TimeoutError"),
        ("power on", RuntimeError("reset"), "reset"),
    ],
)
def test_a_controller_that_does_not_open_is_named_and_given_back(
    controller: Controller, served: BleServer, where: str, error: Exception, why: str
) -> None:
    controller.fails[where] = error
    with pytest.raises(NoReaderError) as no:
        served.start()
    assert no.value.message == f"The Bluetooth controller usb:0 does not open: {why}."
    assert no.value.hint == (
        "usb:0 needs a dongle that the kernel leaves alone (hciconfig hci0 down), and the right to it."
    )
    assert not served._thread.is_alive()
    assert controller.done == of_loop(*OPENED[:1], ("close",)) * (where == "power on")


def test_a_controller_that_fails_at_the_end_ends_all_the_same(controller: Controller, served: BleServer) -> None:
    served.start()
    controller.fails["power off"] = OSError("gone")
    served.stop()
    assert not served._thread.is_alive()


def test_a_controller_that_takes_no_data_is_a_fault_of_the_link(controller: Controller, served: BleServer) -> None:
    served.start()
    controller.slow = "data"
    with pytest.raises(LinkError) as no:
        served.send_data(frame())
    assert no.value.message == "The Bluetooth controller takes no data."


def test_what_a_controller_does_not_take_in_time_is_given_up(
    controller: Controller, served: BleServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it would leave later, behind messages that are newer."""
    monkeypatch.setattr(server, "_SEND_SECONDS", 0.01)
    served.start()
    controller.wait(2)

    async def stuck(_link: str, _data: bytes) -> None:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            controller.note("given up")
            raise

    monkeypatch.setattr(served._peripheral, "notify_data", stuck)
    with pytest.raises(LinkError):
        served.send_data(frame())
    assert controller.wait(1)[-1][0] == "given up"


def test_a_node_s_bluetooth_needs_bumble(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bumble", None)
    with pytest.raises(UsageError) as no:
        BleServer("usb:0", NODE, ADDRESS)
    assert no.value.message == "A node's BLE needs bumble, which is not installed."
    assert "[ble-node]" in (no.value.hint or "")
