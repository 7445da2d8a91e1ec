"""A node in the air: when it advertises and with what, whom it drops, and which address it has (profile.md, "BLE").

The controller is a mock, and the clock is the test's: what is held here are the rules of the peripheral alone.
"""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import StoreError
from teds_provision.node.ble import peripheral as ble_peripheral
from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import Peripheral


class MockDevice:
    """Mock of bumble's device: what it was given to advertise, and whether it does."""

    def __init__(self) -> None:
        self.advertises = False
        self.commands: list[Any] = []

    async def start_advertising(self, **_: object) -> None:
        self.advertises = True

    async def stop_advertising(self) -> None:
        self.advertises = False

    async def send_sync_command(self, command: Any) -> None:
        self.commands.append(command)


class Scene:
    """A peripheral whose node has a state, and sessions on the links that are named."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, *, factory: bool) -> None:
        self.now, self.factory, self.sessions = 1000.0, factory, set[str]()
        self.lost: list[str] = []
        monkeypatch.setattr(ble_peripheral, "time", SimpleNamespace(monotonic=lambda: self.now))
        node: Any = SimpleNamespace(
            in_factory_state=lambda: self.factory,
            in_session=lambda link: link in self.sessions,
            lost=self.lost.append,
        )
        self.address = StaticAddress(folder, factory=factory)
        self.peripheral = Peripheral(node, self.address)
        self.peripheral._device = self.device = MockDevice()

    def connect(self) -> str:
        """Have a station connect; return the name of its link."""
        known = set(self.peripheral._lines)
        self.peripheral._connected(SimpleNamespace(on=lambda *_: None, disconnect=_at_once))
        self.device.advertises = False  # a controller stops at a connection
        (number,) = self.peripheral._lines.keys() - known
        return self.peripheral._lines[number].name

    def look(self) -> bool:
        """Let it look round; return True if it advertises then."""
        asyncio.run(self.peripheral._look())
        return self.device.advertises

    @property
    def links(self) -> set[str]:
        return {line.name for line in self.peripheral._lines.values()}


async def _at_once() -> None:
    """End a connection."""


def test_a_node_without_key_advertises_for_60_seconds_after_a_tap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=True)
    assert not scene.look()
    scene.peripheral.tapped()
    assert scene.look()
    scene.now += 59.9
    assert scene.look()
    scene.now += 0.1
    assert not scene.look()
    scene.factory = False
    assert scene.look(), "with a key it always does"


def test_a_node_advertises_until_three_stations_are_connected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    for others, advertises in ((0, True), (1, True), (2, True), (3, False)):
        assert scene.look() is advertises, others
        if others < 3:
            scene.sessions.add(scene.connect())
    gone = scene.peripheral._lines[3]
    scene.peripheral._disconnected(gone)
    assert scene.look()


def test_it_advertises_flags_and_the_service_and_nothing_that_names_the_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    assert scene.look()
    service = bytes.fromhex("d857000129b544d391d4401ec8a7a4d4")[::-1]
    assert scene.device.advertising_data == b"\x02\x01\x06" + b"\x11\x07" + service  # type: ignore[attr-defined]
    assert scene.device.scan_response_data == b""  # type: ignore[attr-defined]


def test_a_restart_drops_every_connection_even_one_that_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    names = {scene.connect() for _ in range(3)}
    scene.sessions |= names

    async def fails() -> None:
        raise OSError("the connection has ended")

    lines = list(scene.peripheral._lines.values())
    lines[0].connection.disconnect = fails

    async def restart() -> None:
        scene.peripheral.restarted()
        await asyncio.gather(*scene.peripheral._dropping)

    asyncio.run(restart())
    ble_peripheral._finish_turns(lines)
    scene.peripheral._workers.end()
    assert (scene.links, scene.peripheral._dropping) == (set(), set())
    assert set(scene.lost) == names


def test_a_connection_without_a_session_is_dropped_after_10_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    stranger, owner = scene.connect(), scene.connect()
    scene.sessions.add(owner)
    scene.now += 9.9
    scene.look()
    assert scene.links == {stranger, owner}
    scene.now += 0.1
    scene.look()
    assert scene.links == {owner}
    scene.now += 500
    scene.look()
    scene.sessions.clear()
    scene.now += 9.9
    scene.look()
    assert scene.links == {owner}, "counted from the end of its session"
    scene.now += 0.1
    scene.look()
    assert scene.links == set()


def test_the_address_is_static_random_and_new_at_a_reset_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=True)
    first = scene.address.address
    assert (len(first.octets), first.octets[0] & 0xC0, first.random) == (6, 0xC0, True)
    scene.factory = False
    assert scene.look()
    assert json.loads((tmp_path / "ble.json").read_text()) == {"address": first.octets.hex(), "keyed": True}
    assert StaticAddress(tmp_path, factory=False).address == first, "a restart keeps it"
    scene.factory = True
    assert not scene.look()
    second = scene.address.address
    assert second.octets != first.octets
    assert bytes(scene.device.random_address)[::-1] == second.octets  # type: ignore[attr-defined]
    assert [command.random_address for command in scene.device.commands] == [scene.device.random_address]  # type: ignore[attr-defined]
    assert not scene.look()
    assert scene.address.address == second, "once for each reset"
    scene.factory = False
    scene.look()
    assert scene.address.address == second
    third = StaticAddress(tmp_path, factory=True).address
    assert third.octets != second.octets, "the power went between the reset and the look"


def test_a_look_round_that_fails_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    looks: list[int] = []

    async def look() -> None:
        looks.append(len(looks))
        scene.peripheral._news.set()
        if len(looks) == 1:
            raise OSError("the controller is busy")
        scene.peripheral._is_off = True

    monkeypatch.setattr(scene.peripheral, "_look", look)
    monkeypatch.setattr(ble_peripheral, "_LOOK_SECONDS", 0.001)
    asyncio.run(scene.peripheral._look_after())
    assert looks == [0, 1]


def test_a_node_that_fails_does_not_reply_and_takes_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(tmp_path, monkeypatch, factory=False)
    scene.connect()
    (line,) = scene.peripheral._lines.values()
    replies: list[bytes] = []
    answers = iter((StoreError("its flash file is gone"), b"\1\0\0"))

    def answer(*_: object, **__: object) -> bytes:
        found = next(answers)
        if isinstance(found, Exception):
            raise found
        return found

    async def reply(_line: object, transaction: int, octets: bytes) -> None:
        assert transaction == 7
        replies.append(octets)

    def at_once(work: Any, _loop: object) -> Any:
        asyncio.run(work)
        return SimpleNamespace(result=lambda: None)

    scene.peripheral._node.reply_sent = scene.lost.append  # type: ignore[method-assign]
    monkeypatch.setattr(line.repetition, "answer", answer)
    monkeypatch.setattr(scene.peripheral, "_reply", reply)
    monkeypatch.setattr(ble_peripheral.asyncio, "run_coroutine_threadsafe", at_once)
    line.waiting = 2
    job = scene.peripheral._job(line, cast("Any", SimpleNamespace(transaction=7, message=b"")), 0, cast("Any", None))
    job()
    assert (line.waiting, replies, scene.lost) == (1, [], [])
    job()
    assert (line.waiting, replies, scene.lost) == (0, [b"\1\0\0"], [line.name])
