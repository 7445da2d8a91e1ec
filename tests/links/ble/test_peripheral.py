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


class Connected:
    """A peripheral with one connection, whose jobs wait until the test runs them."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.peripheral, self.jobs = scene, scene.peripheral, list[Any]()
        self.drained, self.ended = list[str](), list[Any]()
        self.connection: Any = SimpleNamespace(
            att_mtu=100, drain=self._drain, on=lambda event, call: self.ended.append((event, call))
        )
        self.peripheral._connected(self.connection)
        self.line = self.peripheral._lines[2]
        self.line.jobs = cast("Any", SimpleNamespace(put=self.jobs.append))
        self.calls: list[tuple[object, ...]] = []
        node: Any = scene.peripheral._node
        node.tick = lambda: 4711
        node.unheard = lambda name: self.calls.append(("unheard", name))
        node.drive = lambda name, message: self.calls.append(("drive", name, message))

    async def _drain(self) -> None:
        self.drained.append("drained")
        raise OSError("the connection has ended meanwhile")

    def run(self) -> None:
        while self.jobs:
            self.jobs.pop(0)()


@pytest.fixture
def connected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Connected:
    return Connected(Scene(tmp_path, monkeypatch, factory=False))


def test_data_go_to_a_connection_that_has_asked_for_them(connected: Connected) -> None:
    sent: list[tuple[object, ...]] = []

    async def notify(*what: object) -> None:
        sent.append(what)

    connected.scene.device.notify_subscriber = notify  # type: ignore[attr-defined]
    connected.peripheral._data = "the characteristic"

    def send(number: int) -> None:
        asyncio.run(connected.peripheral.notify_data(number, b"data"))

    send(2)
    send(3)
    assert (sent, connected.drained) == ([], []), "it has not asked for any, and the other is not there"
    connected.peripheral._subscribed(connected.connection, True, False)
    connected.peripheral._subscribed(SimpleNamespace(), False, False)
    send(2)
    assert (sent, connected.drained) == ([(connected.connection, "the characteristic", b"data")], ["drained"])
    assert connected.jobs == []
    connected.peripheral._subscribed(connected.connection, False, False)
    connected.run()
    send(2)
    assert (len(sent), connected.calls) == (1, [("unheard", "ble:2")])


@pytest.mark.parametrize(
    ("octets", "driven"), [(b"\0message", b"message"), (b"\0", b""), (b"\1message", None), (b"", None)]
)
def test_a_drive_message_comes_under_stream_0(connected: Connected, octets: bytes, driven: bytes | None) -> None:
    connected.peripheral._driven(SimpleNamespace(), b"\0of a stranger")
    connected.peripheral._driven(connected.connection, octets)
    connected.run()
    assert connected.calls == ([] if driven is None else [("drive", "ble:2", driven)])


def test_of_commands_that_wait_a_connection_has_four(connected: Connected, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[int, bytes, int]] = []

    def job(line: object, received: Any, tick: int, _loop: object) -> Any:
        assert line is connected.line
        made.append((received.transaction, received.message, tick))
        return made.clear

    monkeypatch.setattr(connected.peripheral, "_job", job)

    async def write(connection: object, *pieces: str) -> None:
        for piece in pieces:
            connected.peripheral._written(connection, bytes.fromhex(piece))

    whole = [f"000{number} 0003 0000 616263" for number in range(1, 7)]
    asyncio.run(write(SimpleNamespace(), whole[0]))
    asyncio.run(write(connected.connection, "0001 0003 0000 61"))
    assert (made, connected.line.waiting) == ([], 0), "a stranger's, and one that is not whole"
    asyncio.run(write(connected.connection, "0001 0003 0001 6263", *whole[1:]))
    assert made == [(number, b"abc", 4711) for number in range(1, 5)]
    assert (connected.line.waiting, len(connected.jobs)) == (4, 4)


def test_a_number_is_free_again_once_the_session_of_its_connection_has_ended(connected: Connected) -> None:
    scene, peripheral, line = connected.scene, connected.peripheral, connected.line
    line.repetition.answer(1, b"\0\0\x80\1\0\0", lambda _: b"kept", now=0.0)
    peripheral._news.clear()
    ((event, gone),) = connected.ended
    assert event == "disconnection"
    gone(19)
    assert peripheral._news.is_set()
    assert (line.gone, peripheral._lines, scene.lost) == (True, {}, [])
    assert line.repetition.answer(1, b"\0\0\x80\1\0\0", lambda _: b"again", now=0.0) == b"again"
    peripheral._disconnected(line)
    assert len(connected.jobs) == 1, "it is gone once"
    peripheral._news.clear()
    assert scene.connect() == "ble:3", "the session of the first has not ended"
    assert peripheral._news.is_set()
    connected.run()
    assert scene.lost == ["ble:2"]
    assert scene.connect() == "ble:2"
    peripheral._news.clear()
    peripheral.tapped()
    assert peripheral._news.is_set()


def test_advertising_begins_once_and_anew_under_a_new_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, log = Scene(tmp_path, monkeypatch, factory=False), list[str]()

    async def start(**_: object) -> None:
        log.append("start")

    async def stop() -> None:
        log.append("stop")

    async def command(_: object) -> None:
        log.append("address")

    monkeypatch.setattr(scene.device, "start_advertising", start)
    monkeypatch.setattr(scene.device, "stop_advertising", stop)
    monkeypatch.setattr(scene.device, "send_sync_command", command)
    scene.look()
    scene.look()
    assert log == ["start"]
    scene.factory = True
    scene.peripheral.tapped()
    scene.look()
    assert log == ["start", "stop", "address", "start"], "a controller refuses another address while it advertises"
