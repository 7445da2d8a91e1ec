"""Whom a station connects to over the air, which connections it keeps, and which data it takes.

Adapter, connections, links and clock are mocks.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import LinkError, NodeSilentError, NoNodeError, NoReaderError
from teds_provision.links.ble import port as of_port
from teds_provision.links.ble.port import BlePort, RememberedNodes
from teds_provision.links.ble.spec import parse_spec
from teds_provision.links.ports import Notice
from teds_provision.protocol.messages.frames import Reply
from teds_provision.protocol.messages.identity import Identity, NodeState

ONE, TWO, THREE = "C1:D8:57:00:01:01", "C1:D8:57:00:01:02", "C1:D8:57:00:01:03"
NUMBERS = {ONE: 1, TWO: 2, THREE: 3}


def who(address: str) -> Identity:
    return Identity(bytes([NUMBERS[address]] * 10), NodeState.KEYED, 1, 2, 1024, 0)


class MockPort(BlePort):
    """A port whose nodes advertise as ``heard`` has them: address and since when (seconds)."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, where: str = "hci0") -> None:
        self.spec, self.place, self.trace = parse_spec(where), "ble:hci0", None
        self.now = 100.0
        self.heard: dict[str, float] = {}
        self.fails: dict[str, LinkError] = {}
        self.scan_fails: list[LinkError] = []
        self.asked: list[tuple[float, str]] = []
        self.closed: list[str] = []
        self.notices: list[tuple[str, str]] = []
        self.stop_at = 1e9
        self._loop = SimpleNamespace(run=lambda done: done, stop=lambda: None)  # type: ignore[assignment]
        self._adapter = SimpleNamespace(scan=self._scan)  # type: ignore[assignment]
        self._connections = {}
        self._known = RememberedNodes(folder / "cache.json")
        self._data = queue.Queue(3)
        self._streams = set()
        self._heard = self._closed = False
        self.lost, self._transaction = 0, 0xFFFE
        self._lock = threading.Lock()
        monkeypatch.setattr(of_port, "time", SimpleNamespace(monotonic=lambda: self.now, monotonic_ns=lambda: 7))
        monkeypatch.setattr(of_port, "BleConnection", self._connection)
        monkeypatch.setattr(of_port, "BleLink", self._mock_link)

    def _scan(self, seconds: float, over: Callable[[dict[str, float]], bool]) -> dict[str, float]:
        if self.scan_fails:
            raise self.scan_fails.pop(0)
        until = self.now + seconds
        while True:
            seen = {address: self.now for address, at in self.heard.items() if 100 + at <= self.now}
            if over(seen) or self.now >= until:
                return seen
            self.now = round(self.now + 0.1, 3)

    def _connection(self, adapter: object, address: str, data: object, trace: object) -> Any:
        return SimpleNamespace(
            address=address, number=NUMBERS[address], is_up=False, asking=False, streaming=False,
            disconnect=lambda: self.closed.append(address),
        )  # fmt: skip

    def _mock_link(self, loop: object, connection: Any, number: object, room: object, notice: object) -> Any:
        def exchange(frame: bytes) -> bytes:
            assert frame.hex() == "000080070000"
            self.asked.append((round(self.now - 100, 1), connection.address))
            if connection.address in self.fails:
                raise self.fails[connection.address]
            connection.is_up = True
            return Reply(True, who(connection.address).encode()).encode()

        def close() -> None:
            connection.is_up = False
            self.closed.append(connection.address)

        return SimpleNamespace(exchange=exchange, close=close, connection=connection)

    def note(self, notice: Notice) -> None:
        self.notices.append((notice.kind, notice.text))

    def seeks(self, address: str, seconds: float = 10.0) -> int | None:
        """Seek one node; return the number of its connection."""
        wanted = who(address).uuid
        return self.find(lambda node: node.uuid == wanted, seconds=seconds, notice=self.note).connection

    def is_set(self) -> bool:
        return self.now >= self.stop_at

    def wait(self, seconds: float) -> bool:
        self.now += seconds
        return self.is_set()


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> MockPort:
    return MockPort(monkeypatch, tmp_path)


# -- finding -----------------------------------------------------------------------------------------------------------


def test_others_are_disconnected_and_named_once_until_the_wanted_one_is_there(port: MockPort) -> None:
    port.heard = {ONE: 0.0, TWO: 1.0, THREE: 7.0}
    assert port.seeks(THREE) == 3
    *others, last = [address for _, address in port.asked]
    assert last == THREE
    assert set(others) == {ONE, TWO}
    assert port.closed == others
    assert others.count(ONE) == 2, "again after five seconds or more"
    assert next(address for address, _ in port._known.items()) == THREE
    assert [kind for kind, _ in port.notices] == ["waiting", "foreign-tag", "foreign-tag"]
    assert who(ONE).uuid.hex() in port.notices[1][1]
    assert ONE in port.notices[1][1]


def test_a_node_that_does_not_answer_is_asked_again_in_the_round_after_five_seconds(port: MockPort) -> None:
    port.heard, port.fails = {ONE: 0.0}, {ONE: NodeSilentError("It is silent.")}
    with pytest.raises(NoNodeError, match="did not answer over BLE within 12 s"):
        port.seeks(ONE, 12.0)
    assert [at for at, _ in port.asked] == [0.0, 6.0]
    assert port.closed == [ONE] * 2
    assert {text for kind, text in port.notices if kind == "unfinished"} == {
        f"The node at {ONE} did not say who it is: It is silent."
    }


def test_bluetooth_that_fails_ends_the_search(port: MockPort) -> None:
    port.heard, port.fails = {ONE: 0.0}, {ONE: NoReaderError("Off.")}
    with pytest.raises(NoReaderError):
        port.seeks(ONE)


def test_a_connection_that_was_there_before_a_question_stays(port: MockPort) -> None:
    port.heard = {ONE: 0.0, TWO: 1.0}
    assert port.seeks(ONE) == 1
    assert port._connections[ONE].is_up
    assert port.seeks(TWO) == 2
    assert port.closed == []


def test_a_node_that_was_met_before_is_asked_first_if_it_advertises(port: MockPort) -> None:
    port._known.remember_node(THREE, who(THREE))
    port._known.remember_node(ONE, who(ONE))
    port.heard = {ONE: 0.0, THREE: 0.0}
    assert port.seeks(THREE) == 3
    assert [address for _, address in port.asked] == [THREE]
    port.asked.clear()
    port.heard = {ONE: 0.0}
    port._connections.clear()
    with pytest.raises(NoNodeError, match=f"others did: {who(ONE).uuid.hex()}"):
        port.seeks(THREE, 4.0)
    assert [address for _, address in port.asked] == [ONE], "not the one that is not there"


def test_if_any_node_will_do_nobody_is_waited_for(port: MockPort) -> None:
    port._known.remember_node(THREE, who(THREE))
    port.heard = {ONE: 0.0}
    assert port.find(lambda _: True, seconds=10, notice=port.note).connection == 1
    assert port.now == 100.0


def test_the_address_of_the_option_is_asked_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    port = MockPort(monkeypatch, tmp_path, f"hci0?address={TWO}")
    port.heard = {ONE: 0.0, TWO: 0.5}
    with pytest.raises(NoNodeError, match=f"over BLE at {TWO} within 3 s"):
        port.seeks(ONE, 3.0)
    assert {address for _, address in port.asked} == {TWO}


def test_a_node_is_one_visit_until_it_was_silent_for_ten_seconds(port: MockPort) -> None:
    port.heard, port.stop_at = {ONE: 0.0}, 150.0
    visits = []
    for contact in port.watch(stop=cast("threading.Event", port), notice=port.note):
        visits.append((round(port.now - 100, 1), contact.connection))
        silent = 9.0 if len(visits) == 1 else 10.5
        port.heard[ONE] = port.now - 100 + silent
        contact.link.close()
        if len(visits) == 2:
            port.stop_at = port.now
    assert len(visits) == 2
    assert visits[0] == (pytest.approx(0.0, abs=2.1), 1)


def test_a_node_that_goes_on_advertising_while_it_is_served_is_one_visit(port: MockPort) -> None:
    port.heard, port.stop_at = {ONE: 0.0}, 180.0
    visits = 0
    for _ in port.watch(stop=cast("threading.Event", port), notice=port.note):
        visits += 1
        port.now += 30
    assert visits == 1


def test_a_node_that_did_not_say_who_it_is_is_asked_again_while_it_advertises(port: MockPort) -> None:
    """It was asked once, and never again as long as it went on advertising."""
    port.heard, port.fails, port.stop_at = {ONE: 0.0}, {ONE: NodeSilentError("It is busy.")}, 310.0
    stop = cast("threading.Event", port)
    assert list(port.watch(stop=stop, notice=port.note)) == []
    at = [at for at, _ in port.asked]
    waits = [round(later - earlier) for earlier, later in itertools.pairwise(at)]
    assert waits == [6, 10, 20, 40, 60, 60], "after 5 s, 10 s and so on to 60 s, looked at every 2 s"

    def heal(notice: Notice) -> None:
        if notice.kind == "unfinished":
            port.fails.clear()

    port.asked, port.stop_at = [], port.now + 100
    visits = [contact.connection for contact in port.watch(stop=stop, notice=heal)]
    assert (visits, len(port.asked)) == ([1], 2), "it answered the second time, and is one visit"


def test_one_that_was_away_and_did_not_answer_before_is_asked_at_once(port: MockPort) -> None:
    port.heard, port.fails, port.stop_at = {ONE: 0.0}, {ONE: NodeSilentError("It is busy.")}, 190.0
    stop = cast("threading.Event", port)

    def leave(notice: Notice) -> None:
        if len(port.asked) == 4:  # it would be asked again after 40 s
            port.heard = {ONE: port.now - 100 + 12}

    assert list(port.watch(stop=stop, notice=leave)) == []
    at = [at for at, _ in port.asked]
    assert [round(later - earlier) for earlier, later in itertools.pairwise(at)][:5] == [6, 10, 20, 12, 6]


def test_an_adapter_that_is_away_is_named_once_and_tried_again(port: MockPort) -> None:
    port.scan_fails, port.stop_at = [NoReaderError("It is off.")] * 3, 110.0
    list(port.watch(stop=cast("threading.Event", port), notice=port.note))
    assert port.notices[1:] == [
        ("reader-lost", "It is off. Waiting for it."),
        ("reader-ready", "Bluetooth is back."),
    ]


def everyone(port: MockPort, seconds: float = 20.0, listen: float = 0.0) -> list[int | None]:
    """Return the numbers of all nodes that were found."""
    return [contact.connection for contact in port.find_all(seconds=seconds, notice=port.note, listen=listen)]


def test_all_are_found_once_no_new_one_has_come_for_a_while_and_each_is_disconnected(port: MockPort) -> None:
    port.heard = {TWO: 0.0, ONE: 1.0, THREE: 12.0}
    assert everyone(port) == [1, 2], "by their addresses"
    assert sorted(port.closed) == [ONE, TWO]
    assert 2.5 <= port.now - 100 < 4.6
    port.closed.clear()
    assert port.seeks(ONE) == 1
    assert everyone(port, listen=15.0) == [1, 2, 3]
    assert sorted(port.closed) == [TWO, THREE], "one that was connected before stays so"
    assert {kind for kind, _ in port.notices} == {"waiting"}


def test_all_are_in_the_order_of_their_addresses_whoever_came_first(port: MockPort) -> None:
    port.heard = {TWO: 0.0, ONE: 12.0}
    assert everyone(port, listen=15.0) == [1, 2]
    assert [address for _, address in port.asked] == [TWO, ONE]


def test_nobody_who_advertises_is_said_with_the_remedy(port: MockPort) -> None:
    with pytest.raises(NoNodeError) as none:
        everyone(port, 5.0)
    assert none.value.message == "No node advertises within 5 s."
    assert none.value.hint == "A node advertises for 60 s after a tap, and as long as it has a key."
    assert 5.0 <= port.now - 100 < 5.3


def test_a_question_that_fails_by_a_bug_leaves_no_connection(port: MockPort) -> None:
    port.heard, port.fails = {ONE: 0.0}, cast("Any", {ONE: ZeroDivisionError()})
    with pytest.raises(ZeroDivisionError):
        port.seeks(ONE)
    assert port.closed == [ONE]


# -- connections and data ----------------------------------------------------------------------------------------------


def test_only_an_idle_connection_makes_room(port: MockPort) -> None:
    port.heard = {ONE: 0.0, TWO: 0.0, THREE: 0.0}
    for address in NUMBERS:
        port.seeks(address)
    port.closed.clear()
    port.open_stream(1, 0, 100)
    port._connections[TWO].asking = True
    assert port._make_room()
    assert port.closed == [THREE]
    port._connections[THREE].is_up = False
    assert not port._make_room()
    port._connections[TWO].asking = False
    assert port._make_room()
    assert port.closed == [THREE, TWO]


def test_a_connection_is_kept_while_any_stream_of_its_node_is_open(port: MockPort) -> None:
    port.heard = {ONE: 0.0, TWO: 0.0}
    port.seeks(ONE)
    port.seeks(TWO)
    port.open_stream(1, 0, 100)
    port.open_stream(1, 1, 100)
    assert (port._connections[ONE].streaming, port._connections[TWO].streaming) == (True, False)
    port.close_stream(1, 0)
    port.close_stream(2, 1)
    assert port._connections[ONE].streaming
    port.open_stream(2, 0, 100)
    port.close_stream(1, 1)
    assert not port._connections[ONE].streaming


def test_data_is_taken_of_open_streams_while_somebody_listens_and_what_does_not_fit_is_counted(
    port: MockPort,
) -> None:
    port.open_stream(1, 2, 100)
    frame = b"\2data"
    port._take_data(1, frame)
    with port.listen() as heard:
        assert heard.get_all(0.0) == []
        port._take_data(2, frame)
        port._take_data(1, b"\1data")
        assert heard.get_all(0.0) == []
        for _ in range(5):
            port._take_data(1, frame)
        assert [(data.node, data.stream, data.octets) for data in heard.get_all(0.0)] == [(1, 2, b"data")] * 3
        assert heard.lost == 2
    port._take_data(1, frame)
    assert port.get_all(0.0) == []


def test_a_node_that_is_known_no_more_has_no_link(port: MockPort) -> None:
    port.heard = {ONE: 0.0}
    port.seeks(ONE)
    assert port.link(1).connection.address == ONE
    with pytest.raises(NoNodeError):
        port.link(2)


def test_transactions_are_of_16_bits(port: MockPort) -> None:
    assert [port.next_transaction() for _ in range(3)] == [0xFFFF, 0, 1]


def test_who_listens_waits_for_the_first_message_and_takes_those_that_are_there_behind_it(
    port: MockPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits, there = list[float](), ["a", "b", "c"]

    def get(timeout: float) -> str:
        waits.append(timeout)
        return get_nowait()

    def get_nowait() -> str:
        if not there:
            raise queue.Empty
        return there.pop(0)

    monkeypatch.setattr(port, "_data", SimpleNamespace(get=get, get_nowait=get_nowait))
    found: list[Any] = [port.get_all(0.25), port.get_all(2.5)]
    assert (found, waits) == ([["a", "b", "c"], []], [0.25, 2.5])


def test_a_cache_that_could_not_be_written_is_written_the_next_time_for_this_user_alone(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    folder.write_text("in its place")
    known = RememberedNodes(folder / "nodes.json")
    known.remember_node(ONE, who(ONE))
    known.save()
    folder.unlink()
    known.save()
    assert RememberedNodes(folder / "nodes.json").items() == [(ONE, who(ONE))]
    assert folder.stat().st_mode & 0o077 == 0
    (folder / "nodes.json").unlink()
    known.save()
    assert not (folder / "nodes.json").exists(), "nothing is new"
