"""Retries of a Bluetooth adapter, their limits, and the device it accepts; bleak and the air are mocks."""

from __future__ import annotations

import asyncio
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NoNodeError, NoReaderError
from teds_provision.links.ble import adapter as adapter_module
from teds_provision.links.ble.adapter import Adapter
from teds_provision.protocol.messages.ble import SERVICE

SPEC: Any = SimpleNamespace(adapter="hci1", text="hci1")


class BusError(Exception):
    def __init__(self, name: str, text: str = "") -> None:
        super().__init__(text or name)
        self.dbus_error = name


BUSY = BusError("org.bluez.Error.InProgress")


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(adapter_module, "asyncio", SimpleNamespace(sleep=sleep, Lock=asyncio.Lock))
    return pauses


def persisted(*steps: Any) -> tuple[Any, int]:
    left, asked = list(steps), [0]

    async def work() -> Any:
        asked[0] += 1
        step = left.pop(0)
        if isinstance(step, Exception):
            raise step
        return step

    async def run() -> Any:
        return await Adapter(SPEC).persist(work)

    return asyncio.run(run()), asked[0]


def test_what_another_program_holds_up_is_tried_six_times_with_longer_pauses(slept: list[float]) -> None:
    assert persisted(BUSY, BusError("org.bluez.Error.NotReady"), "done") == ("done", 3)
    assert slept == [0.25, 0.5]
    slept.clear()
    assert persisted(*[BUSY] * 5, "done") == ("done", 6)
    assert slept == [0.25, 0.5, 1.0, 2.0, 4.0]
    with pytest.raises(BusError):
        persisted(*[BUSY] * 6, "never")


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (LinkError("the link"), LinkError),
        (FileNotFoundError(), NoReaderError),
        (BusError("org.freedesktop.DBus.Error.ServiceUnknown"), NoReaderError),
        (RuntimeError("odd"), RuntimeError),
    ],
)
def test_any_other_failure_is_none_to_wait_for(slept: list[float], error: Exception, kind: type[Exception]) -> None:
    with pytest.raises(kind):
        persisted(error, "never")
    assert slept == []


class Air:
    """A scanner of bleak: what advertises at each start, and how it stops."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, list[str]]] = []
        self.stop_fails: Exception | None = None
        self.made: list[Any] = []

    def scanner(self, detected: Any, *, service_uuids: list[str], bluez: Any) -> Any:
        self.made.append((service_uuids, bluez))

        async def start() -> None:
            for address, services in self.heard:
                detected(SimpleNamespace(address=address), SimpleNamespace(service_uuids=services))

        async def stop() -> None:
            if self.stop_fails is not None:
                raise self.stop_fails

        return SimpleNamespace(start=start, stop=stop)


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Air:
    made = Air()
    monkeypatch.setitem(sys.modules, "bleak", SimpleNamespace(BleakScanner=made.scanner))
    return made


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]

    async def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(adapter_module, "asyncio", SimpleNamespace(sleep=sleep, Lock=asyncio.Lock))
    monkeypatch.setattr(adapter_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def test_a_node_is_what_advertises_the_service_now(air: Air, clock: list[float]) -> None:
    """BlueZ hands on what other programs look for as well."""
    air.heard = [("aa:bb", [SERVICE.upper()]), ("cc:dd", ["1234"]), ("ee:ff", [])]

    async def run() -> None:
        adapter = Adapter(SPEC)
        assert await adapter.scan(1.0, lambda now: False) == {"AA:BB": 100.0}
        assert clock[0] == pytest.approx(101.0, abs=0.06)
        assert adapter.seen() == {"AA:BB": 100.0}
        began = clock[0]
        assert await adapter.scan(60.0, lambda now: "AA:BB" in now) == {"AA:BB": began}
        assert clock[0] == began, "enough at once"
        adapter.forget("AA:BB")
        adapter.forget("00:00")
        assert adapter.seen() == {}

    asyncio.run(run())
    assert air.made[0] == ([SERVICE], {"adapter": "hci1"})


def test_without_a_named_adapter_bluez_takes_the_first(air: Air, clock: list[float]) -> None:
    spec: Any = SimpleNamespace(adapter="", text="")
    asyncio.run(Adapter(spec).scan(0.0, lambda now: True))
    assert air.made == [([SERVICE], {})]


def test_a_device_that_was_seen_twenty_seconds_ago_is_looked_for_again(air: Air, clock: list[float]) -> None:
    async def run() -> None:
        adapter = Adapter(SPEC)
        air.heard = [("AA:BB", [SERVICE])]
        await adapter.scan(0.0, lambda now: True)
        air.heard = []
        clock[0] += 20.0
        assert (await adapter.device("AA:BB")).address == "AA:BB"
        assert len(air.made) == 1
        clock[0] += 0.1
        assert (await adapter.device("AA:BB")).address == "AA:BB", "BlueZ may know it all the same"
        assert len(air.made) == 2
        began = clock[0]
        with pytest.raises(NoNodeError) as no:
            await adapter.device("11:22")
        assert clock[0] - began == pytest.approx(10.0, abs=0.06)
        assert no.value.message == "No node advertises as 11:22."
        assert no.value.hint == ("Tap it: it then advertises for 60 s; a node with a key always does. Is it in range?")

    asyncio.run(run())


def test_a_scan_that_cannot_be_stopped_has_ended_unless_bluetooth_is_gone(air: Air, clock: list[float]) -> None:
    air.stop_fails = RuntimeError("odd")
    assert asyncio.run(Adapter(SPEC).scan(0.0, lambda now: True)) == {}
    air.stop_fails = BusError("org.freedesktop.DBus.Error.NameHasNoOwner")
    with pytest.raises(NoReaderError, match="bluetoothd"):
        asyncio.run(Adapter(SPEC).scan(0.0, lambda now: True))


def test_bluetooth_needs_bleak(monkeypatch: pytest.MonkeyPatch, clock: list[float]) -> None:
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(NoReaderError) as no:
        asyncio.run(Adapter(SPEC).scan(0.0, lambda now: True))
    assert no.value.message == "BLE needs bleak, which is not installed."
    assert "[ble]" in (no.value.hint or "")
