"""One connection of the station over the air: what ends it, who counts it, and which frames are its own.

The radio and bleak's client are mocks: what is held here are the rules of the connection alone, without a bus.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError
from teds_provision.links.ble import connection as ble_connection
from teds_provision.links.ble.adapter import CONNECT_SECONDS, Adapter
from teds_provision.links.ble.ble_errors import TooManyConnectionsError
from teds_provision.links.ble.connection import BleConnection, ConnectionLostError, NotConnectedError
from teds_provision.links.ble.spec import parse_spec
from teds_provision.protocol.messages import ble
from tests.pace import PATIENCE

ADDRESS = "C1:D8:57:00:01:01"


class MockClient:
    """Mock of BleakClient for a node that answers each whole command by ``reply``."""

    def __init__(self, place: MockPlace) -> None:
        self.place, self.is_connected, self.ended = place, False, 0
        self.notified: dict[str, Callable[[object, bytearray], None]] = {}
        self.services = SimpleNamespace(get_characteristic=self._characteristic)

    def _characteristic(self, uuid: str) -> object | None:
        return (
            SimpleNamespace(uuid=uuid, max_write_without_response_size=self.place.room)
            if (uuid in self.place.offers)
            else None
        )

    async def connect(self) -> None:
        self.place.connects += 1
        if self.place.errors:
            raise self.place.errors.pop(0)
        self.is_connected = True

    async def disconnect(self) -> None:
        self.ended += 1
        self.is_connected = False  # without a callback, as if bluetoothd had ended

    async def unpair(self) -> None:
        self.place.unpaired += 1
        self.place.offers = self.place.after_unpair

    async def start_notify(self, uuid: str, callback: Callable[[object, bytearray], None]) -> None:
        if self.place.notify_errors:
            raise self.place.notify_errors.pop(0)
        self.notified[uuid] = callback

    async def write_gatt_char(self, to: Any, octets: bytes, *, response: bool) -> None:
        if self.place.write_errors:
            raise self.place.write_errors.pop(0)
        self.place.writes.append((to.uuid, octets, response))
        await self.place.answer(self, octets)


class MockPlace:
    """An adapter whose every device is the node of :class:`MockClient`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.offers = self.after_unpair = {ble.WRITE, ble.NOTIFY, ble.DATA}
        self.room, self.connects, self.unpaired = 20, 0, 0
        self.errors: list[Exception] = []
        self.notify_errors: list[Exception] = []
        self.write_errors: list[Exception] = []
        self.writes: list[tuple[str, bytes, bool]] = []
        self.frames: list[tuple[str, str, bytes]] = []
        self.data: list[tuple[int, bytes]] = []
        self.clients: list[MockClient] = []
        self.answer: Callable[[MockClient, bytes], Awaitable[None]] = self._reply
        self.adapter = Adapter(parse_spec("hci0"))
        self.forgotten: list[str] = []
        trace: Any = SimpleNamespace(frame=lambda *frame: self.frames.append(frame))
        self.connection = BleConnection(self.adapter, ADDRESS, lambda *item: self.data.append(item), trace)
        monkeypatch.setattr(self.adapter, "device", self._device)
        monkeypatch.setattr(self.adapter, "forget", self.forgotten.append)
        monkeypatch.setattr(self.connection, "_new_client", self._client)

    async def _device(self, address: str) -> object:
        return address

    def _client(self, _device: object) -> MockClient:
        self.clients.append(MockClient(self))
        return self.clients[-1]

    async def _reply(self, client: MockClient, octets: bytes) -> None:
        for frame in ble.cut(int.from_bytes(octets[:2], "big"), b"\x01reply", 23):
            client.notified[ble.NOTIFY](None, bytearray(frame))

    def run(self, work: Callable[[], Awaitable[Any]]) -> Any:
        async def soon() -> Any:
            return await asyncio.wait_for(work(), PATIENCE)

        return asyncio.run(soon())


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> MockPlace:
    return MockPlace(monkeypatch)


def test_a_connection_counts_as_held_from_its_subscription_until_the_node_or_we_end_it(place: MockPlace) -> None:
    own, held = place.connection, place.adapter.held
    assert not own.was_up
    place.run(own.connect)
    assert (held, own.is_up, own.was_up) == ({own}, True, True)
    (client,) = place.clients
    assert client.notified.keys() == {ble.NOTIFY, ble.DATA}, "both before the first write"
    client.is_connected = False
    own._disconnected(client)  # type: ignore[arg-type]
    assert held == set(), "else the next refusal counts it, and calls an idle adapter full"
    assert (own.is_up, own.was_up, own.mtu) == (False, True, 23)
    place.run(own.connect)
    assert (held, place.connects) == ({own}, 2)
    place.run(own.connect)
    assert place.connects == 2, "nothing is done for a connection that is up"
    place.run(own.disconnect)
    assert (held, own.is_up, place.clients[1].ended) == (set(), False, 1)


def test_a_node_without_data_is_subscribed_for_replies_alone(place: MockPlace) -> None:
    place.offers = {ble.WRITE, ble.NOTIFY}
    place.run(place.connection.connect)
    assert place.clients[0].notified.keys() == {ble.NOTIFY}
    with pytest.raises(ConnectionLostError, match="the connection ended"):
        place.run(lambda: place.connection.write_data(b"x"))


def test_a_command_goes_out_in_frames_with_response_and_its_reply_is_the_one_of_its_transaction(
    place: MockPlace,
) -> None:
    async def answer(client: MockClient, octets: bytes) -> None:
        if octets[4:6] != b"\0\x0e":
            return
        for transaction in (0x0101, 0x0102):  # that of a request that was given up, first
            (frame,) = ble.cut(transaction, b"\x01" + bytes([transaction & 255]), 23)
            client.notified[ble.NOTIFY](None, bytearray(frame))

    place.answer = answer
    assert place.run(lambda: place.connection.exchange(0x0102, bytes(range(20)), PATIENCE)) == b"\x01\x02"
    heads = [(uuid, octets[:6].hex(), octets[6:], response) for uuid, octets, response in place.writes]
    assert heads == [
        (ble.WRITE, "010200140000", bytes(range(14)), True),
        (ble.WRITE, "01020014000e", bytes(range(14, 20)), True),
    ]
    assert [(via, way, octets[:2].hex()) for via, way, octets in place.frames] == [
        ("ble", "out", "0102"),
        ("ble", "out", "0102"),
        ("ble", "in", "0101"),
        ("ble", "in", "0102"),
    ]
    assert not place.connection.asking
    place.run(lambda: place.connection.write_data(b"drive"))
    assert place.writes[-1] == (ble.DATA, b"\0drive", False), "without response, behind the octet of a whole message"
    place.clients[0].notified[ble.DATA](None, bytearray(b"\0data"))
    assert place.data == [(place.connection.number, b"\0data")]


def test_what_waits_from_before_belongs_to_no_request(place: MockPlace) -> None:
    own = place.connection
    place.run(own.connect)
    (late,) = ble.cut(7, b"\x01late", 23)
    place.clients[0].notified[ble.NOTIFY](None, bytearray(late))
    assert place.run(lambda: own.exchange(7, b"x", PATIENCE)) == b"\x01reply"


def test_a_lost_connection_ends_the_wait_for_a_reply_at_once(place: MockPlace) -> None:
    own = place.connection

    async def drop(client: MockClient, _octets: bytes) -> None:
        assert own.asking, "so that it is not given up for another node"
        client.is_connected = False
        own._disconnected(client)  # type: ignore[arg-type]

    place.answer = drop
    with pytest.raises(ConnectionLostError, match=r"^the connection ended$"):
        place.run(lambda: own.exchange(1, b"x", 10 * PATIENCE))
    assert not own.asking


def test_no_reply_is_no_lost_connection(place: MockPlace) -> None:
    async def mute(_client: MockClient, _octets: bytes) -> None:
        pass

    place.answer = mute
    with pytest.raises(TimeoutError):
        place.run(lambda: place.connection.exchange(1, b"x", 0.01))
    assert place.connection.is_up
    assert not place.connection.asking


def test_the_service_that_is_missing_is_looked_for_once_more_without_the_cache(place: MockPlace) -> None:
    place.offers = {ble.WRITE}
    place.run(place.connection.connect)
    assert (place.unpaired, place.forgotten, place.connects) == (1, [ADDRESS], 2)
    assert place.clients[0].ended == 1
    place.run(place.connection.disconnect)
    place.offers = place.after_unpair = {ble.NOTIFY}
    with pytest.raises(LinkError, match=f"^The device at {ADDRESS} advertises the service of a node but does not"):
        place.run(place.connection.connect)
    assert (place.unpaired, place.adapter.held) == (2, set())
    assert place.clients[-1].ended == 1, "and it is let go"


@pytest.mark.parametrize(
    ("errors", "held", "raised", "connects"),
    [
        (["device C1 not found"], 0, None, 2),
        (["device C1 not found"] * 2, 0, NotConnectedError, 2),
        (["le-connection-abort-by-local"], 0, NotConnectedError, 1),
        (["le-connection-refused"], 0, NotConnectedError, 1),
        (["le-connection-refused"], 1, TooManyConnectionsError, 1),
        (["le-connection-concurrent-connection-limit"], 0, TooManyConnectionsError, 1),
        (["br-connection-adapter-not-powered"], 0, LinkError, 1),
    ],
)
def test_what_becomes_of_a_connect_that_fails(
    place: MockPlace, errors: list[str], held: int, raised: type[Exception] | None, connects: int
) -> None:
    place.errors = [RuntimeError(text) for text in errors]
    place.adapter.held |= set(range(held))
    if raised is None:
        place.run(place.connection.connect)
        assert place.forgotten == [ADDRESS]
    else:
        with pytest.raises(raised):
            place.run(place.connection.connect)
        assert not place.connection.is_up
    assert place.connects == connects


@pytest.mark.parametrize("error", [RuntimeError("refused"), TimeoutError(), OSError("gone")])
def test_a_subscription_that_fails_is_a_connection_that_did_not_come_about(place: MockPlace, error: Exception) -> None:
    place.notify_errors = [error]
    with pytest.raises(NotConnectedError) as lost:
        place.run(place.connection.connect)
    assert str(lost.value) == (str(error) or "TimeoutError")
    assert (place.adapter.held, place.connection.was_up) == (set(), False)
    place.run(place.connection.connect)
    assert place.connection.is_up


def test_a_write_that_fails_is_a_lost_connection_and_one_that_takes_too_long_is_none(place: MockPlace) -> None:
    own = place.connection
    place.run(own.connect)
    place.write_errors = [RuntimeError("not permitted"), TimeoutError()]
    with pytest.raises(ConnectionLostError, match=r"^not permitted$") as lost:
        place.run(lambda: own.exchange(1, b"x", PATIENCE))
    assert not isinstance(lost.value, NotConnectedError), "it may have gone out"
    with pytest.raises(TimeoutError):
        place.run(lambda: own.exchange(1, b"x", PATIENCE))
    assert (own.is_up, own.asking, place.writes) == (True, False, [])
    place.clients[0].is_connected = False

    async def work() -> None:
        await own._doing(lambda _client: asyncio.sleep(0))

    with pytest.raises(ConnectionLostError, match=r"^the connection ended$"):
        place.run(work)


def test_how_long_each_wait_of_a_connection_may_take() -> None:
    assert (ble_connection._SUBSCRIBE_SECONDS, ble_connection._DOWN_SECONDS) == (5, 5)
    assert (ble_connection.MOST_REPLY, CONNECT_SECONDS) == (65535, 10)
