"""The node on the bus as a station of strangers sees it: raw frames over a bus that loses none."""

from __future__ import annotations

import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from queue import SimpleQueue
from types import SimpleNamespace

import pytest

from teds_provision.errors import LinkError, NoReaderError
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.isotp import Pair, physical_id, single
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.can import server as server_module
from teds_provision.node.can.endpoint import CanEndpoint, StationState
from teds_provision.node.can.server import CanServer
from teds_provision.node.worker_pool import MOST_THREADS, WorkerPool
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.messages.identity import NodeState
from tests.links.can.echo_node import EchoNode
from tests.links.can.hub import Hub
from tests.pace import PATIENCE
from tests.places import free_tcp_port

IDENTIFY = b"\x00\x00\x80\x07\x00\x00"
COUNT = b"\x00\x00\x01\x7f\x00\x00"


def test_a_node_comes_back_from_bus_off_after_a_second_and_waits_twice_as_long_while_it_recurs(
    hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    server, now, waits = CanServer(hub.spec, EchoNode(0x21)), [1000.0], list[float]()
    quiet = [0.0] * 6 + [61.0, 59.0]  # seconds on the bus, each time before it fails again

    def fail(_woken: object) -> None:
        now[0] += quiet.pop(0)
        raise LinkError("bus-off")

    def reopen(seconds: float) -> None:
        waits.append(seconds)
        if not quiet:
            server._stop.set()

    monkeypatch.setattr(server, "_serve_one", fail)
    monkeypatch.setattr(server, "_reopen", reopen)
    monkeypatch.setattr(server_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    server._serve(nullcontext())  # type: ignore[arg-type]
    assert waits == [1, 2, 4, 8, 16, 30, 1, 2]


def test_a_bus_that_does_not_open_again_is_tried_until_it_does(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    server, closed, announced = CanServer(hub.spec), list[str](), list[str]()
    tries = [LinkError("bus-off"), NoReaderError("can0 is gone"), SimpleNamespace(close=lambda: closed.append("new"))]

    def opened(_spec: object) -> object:
        found = tries.pop(0)
        if isinstance(found, Exception):
            raise found
        return found

    waits: list[float] = []

    def wait(seconds: float) -> bool:
        waits.append(seconds)
        return False

    monkeypatch.setattr(server_module, "Bus", opened)
    monkeypatch.setattr(server, "_bus", SimpleNamespace(close=lambda: closed.append("old")))
    monkeypatch.setattr(server, "_stop", SimpleNamespace(wait=wait))
    monkeypatch.setattr(server, "_addresses", SimpleNamespace(announce_all=lambda: announced.append("all")))
    server._reopen(2.0)
    assert (waits, closed, announced, tries) == ([2.0] * 3, ["old"], ["all"], [])


class RawStation:
    """A station made of raw frames, at ``source``."""

    def __init__(self, spec: str, source: int = 0xF1) -> None:
        self.bus, self.source = Bus(parse_spec(spec)), source
        self.frames: list[Frame] = []

    def everyone(self, octets: str) -> None:
        self.bus.send(Frame(0x18DBFF00 | self.source, bytes.fromhex(octets)))

    def ask(self, node: int, body: bytes) -> list[bytes]:
        """Send ``body`` (none if empty), wait for the answer, and return it with whatever comes soon after it."""
        return self._hear(node, body, PATIENCE)

    def silence(self, node: int, body: bytes = b"", seconds: float = 0.2) -> list[bytes]:
        """Send ``body``, and return what comes back within ``seconds``, which is to be nothing."""
        return self._hear(node, body, seconds)

    def _hear(self, node: int, body: bytes, seconds: float) -> list[bytes]:
        pair = Pair(self.source, node, self.bus.send)
        if body:
            pair.send(body)
        messages: list[bytes] = []
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            frame = self.bus.receive(0.01)
            if frame and pair.handle_frame(frame):
                self.frames.append(frame)
            pair.run()
            while (message := pair.received()) is not None:
                messages.append(message)
                until = min(until, time.monotonic() + 0.2)
        return messages


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub()
    yield hub
    hub.close()


@pytest.fixture
def node() -> EchoNode:
    return EchoNode(0x21)


@pytest.fixture
def server(hub: Hub, node: EchoNode) -> Iterator[CanServer]:
    server = CanServer(hub.spec, node, counts_as_tapped=lambda: True)
    server.start()
    yield server
    server.stop()


@pytest.fixture
def station(hub: Hub, server: CanServer) -> Iterator[RawStation]:
    station = RawStation(hub.spec)
    yield station
    station.bus.close()


def test_answers_a_functional_identify_from_its_own_address(station: RawStation, node: EchoNode) -> None:
    station.everyone("0742000080070000")
    assert station.ask(0x21, b"") == [b"\x42\x01\x00\x17" + node.identify()]
    assert node.seen == []


def test_an_answer_to_everyone_waits_a_random_time_of_up_to_50_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[float, float]] = []

    def uniform(low: float, high: float) -> float:
        drawn.append((low, high))
        return 0.031

    monkeypatch.setattr(server_module, "random", SimpleNamespace(uniform=uniform))
    assert CanServer("udp_multicast:239.74.163.2")._spread() == 0.031
    assert drawn == [(0, 0.05)]


@pytest.mark.parametrize("octets", ["0742000101010000", "06420000800700", "0842000080070000", "1042000080070000", "07"])
def test_answers_nothing_else_that_is_asked_of_everyone(station: RawStation, node: EchoNode, octets: str) -> None:
    station.everyone(octets)
    assert station.silence(0x21) == []
    assert node.seen == []


def test_an_equal_repetition_is_not_run_again_even_after_a_functional_identify(
    station: RawStation, node: EchoNode
) -> None:
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]
    station.everyone("0742000080070000")
    assert len(station.ask(0x21, b"")) == 1
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]
    assert station.ask(0x21, b"\x0a" + COUNT) == [b"\x0a\x01\x00\x02"]
    assert node.runs == 2
    assert node.seen[0] == ("can:f1", True)


def test_a_repetition_that_comes_while_the_first_is_still_being_run_gets_the_same_reply_once_more(
    station: RawStation, node: EchoNode
) -> None:
    node.free.clear()
    pair = Pair(station.source, 0x21, station.bus.send)
    pair.send(b"\x09" + COUNT)
    assert wait_for(lambda: node.runs == 1)
    threading.Timer(0.3, node.free.set).start()
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01", b"\x09\x01\x00\x01"]
    assert node.runs == 1


def test_a_strangers_questions_end_no_session_and_take_no_stored_reply(
    hub: Hub, station: RawStation, node: EchoNode
) -> None:
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]
    for source in range(0xF2, 0xF8):
        other = RawStation(hub.spec, source)
        try:
            assert other.ask(0x21, b"\x01" + IDENTIFY) == [b"\x01\x01\x00\x17" + node.identify()]
            other.everyone("0742000080070000")
        finally:
            other.bus.close()
    assert node.links_lost == []
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]
    assert node.runs == 1


def test_lines_do_not_share_a_stored_reply(hub: Hub, station: RawStation, node: EchoNode) -> None:
    other = RawStation(hub.spec, 0xF7)
    try:
        assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]
        assert other.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x02"]
    finally:
        other.bus.close()
    assert [name for name, _ in node.seen] == ["can:f1", "can:f7"]


@pytest.mark.parametrize("body", [b"\x01", b"\x01\x00\x00\x80\x07\x00"])
def test_what_is_too_short_for_a_command_gets_a_reply_all_the_same(station: RawStation, body: bytes) -> None:
    (reply,) = station.ask(0x21, body)
    assert reply[:1] == b"\x01"


def test_a_command_of_bad_form_gets_what_the_node_says_of_it(station: RawStation) -> None:
    assert station.ask(0x21, b"\x05\x00\x00\x01\x03\x00\x09abc") == [b"\x05cba"]


def test_other_addresses_are_not_its_own(station: RawStation, node: EchoNode) -> None:
    assert station.silence(0x22, b"\x01" + IDENTIFY) == []
    assert station.ask(0x21, b"\x02\x00\x00\x80\x0a\x00\x01\x22") == [b"\x02\x01\x00\x00"]
    assert len(station.ask(0x22, b"\x01" + IDENTIFY)) == 1
    assert station.silence(0x21, b"\x01" + IDENTIFY) == []


def test_a_station_outside_f1_to_f7_is_not_heard(hub: Hub, server: CanServer, node: EchoNode) -> None:
    outsider = RawStation(hub.spec, 0xF8)
    try:
        assert outsider.silence(0x21, b"\x01" + IDENTIFY) == []
    finally:
        outsider.bus.close()


def test_an_overlong_message_is_refused_and_the_line_goes_on(station: RawStation) -> None:
    station.bus.send(Frame(physical_id(0x21, 0xF1), bytes.fromhex("1000000010000000")))
    assert wait_for(lambda: bool(station.silence(0x21, seconds=0.1) or station.frames))
    assert [frame.data for frame in station.frames] == [bytes.fromhex("05000000010acccc")], (
        "10, in place of a flow control"
    )
    assert station.ask(0x21, b"\x09" + COUNT) == [b"\x09\x01\x00\x01"]


def test_a_request_of_max_message_and_its_transaction_is_taken(station: RawStation) -> None:
    station.bus.send(Frame(physical_id(0x21, 0xF1), bytes.fromhex("1fff000000000000")))  # 4094 and one
    assert wait_for(lambda: bool(station.silence(0x21, seconds=0.1) or station.frames))
    assert [frame.data[:3].hex() for frame in station.frames] == ["301000"], "a flow control for 16 frames"


def test_garbage_on_the_line_does_no_harm(station: RawStation) -> None:
    for octets in ("", "00", "ff", "30", "37ffff", "2199", "1005010203040506", "4f00000000000000", "0f010203"):
        station.bus.send(Frame(physical_id(0x21, 0xF1), bytes.fromhex(octets)))
    station.bus.send(Frame(0x18DA21F1, single(b"\x09" + COUNT)))
    assert station.ask(0x21, b"") == [b"\x09\x01\x00\x01"]


def test_stopping_ends_the_sessions(hub: Hub, node: EchoNode) -> None:
    server = CanServer(hub.spec, node)
    server.start()
    station = RawStation(hub.spec)
    assert len(station.ask(0x21, b"\x09" + COUNT)) == 1
    server.stop()
    assert node.links_lost == ["can:f1"]
    assert node.seen == [("can:f1", False)]
    server.start()
    assert len(station.ask(0x21, b"\x0a" + COUNT)) == 1, "it can begin again"
    server.stop()
    station.bus.close()


def announces(hub: Hub) -> list[Announce]:
    found = (Announce.decode(identifier, data) for identifier, data in list(hub.frames))
    return [announce for announce in found if announce is not None]


def wait_for(what: Callable[[], bool], seconds: float = PATIENCE) -> bool:
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.005)
    return True


def test_of_a_station_that_does_not_wait_for_replies_four_requests_wait(node: EchoNode) -> None:
    queue: SimpleQueue[object] = SimpleQueue()
    endpoint = CanEndpoint(node, lambda: True, WorkerPool(), lambda endpoint, frame: None)
    state = StationState(endpoint, 0xF1, queue)  # type: ignore[arg-type]
    for _ in range(10):
        state.put(lambda: None)
    assert queue.qsize() == 4


def test_announces_itself_once_after_its_start(hub: Hub, server: CanServer, node: EchoNode) -> None:
    node.state = NodeState.PROVISIONED
    assert wait_for(lambda: bool(announces(hub)))
    assert hub.frames[0][0] == 0x1CFF0021
    assert not wait_for(lambda: len(announces(hub)) > 1, 0.3)
    assert announces(hub)[0].crc == zlib.crc32(node.uuid)


def test_moves_away_from_a_smaller_crc_and_ends_the_sessions_there(
    station: RawStation, server: CanServer, node: EchoNode, hub: Hub
) -> None:
    assert len(station.ask(0x21, b"\x09" + COUNT)) == 1
    station.bus.send(Frame(0x18DAF122, b"\x30\x00\x00"))  # a station at 0x22 is heard
    station.bus.send(Frame(0x1CFF0021, Announce(0x21, 0, zlib.crc32(node.uuid) - 1).encode()))
    assert wait_for(lambda: node.address == 0x23)
    assert wait_for(lambda: any(announce.address == 0x23 for announce in announces(hub)))
    assert node.links_lost == ["can:f1"]
    assert len(station.ask(0x23, b"\x0a" + COUNT)) == 1
    assert station.silence(0x21, b"\x0b" + COUNT) == []


def test_stays_before_a_greater_crc_and_says_so(station: RawStation, hub: Hub, node: EchoNode) -> None:
    assert wait_for(lambda: len(announces(hub)) == 1)
    station.bus.send(Frame(0x1CFF0021, Announce(0x21, 0, zlib.crc32(node.uuid) + 1).encode()))
    assert wait_for(lambda: len(announces(hub)) == 3)  # its own, the stranger's, its own again
    assert node.address == 0x21


def test_stays_with_an_actuator_claimed(station: RawStation, hub: Hub, node: EchoNode) -> None:
    node.pinned = True
    station.bus.send(Frame(0x1CFF0021, Announce(0x21, 0, zlib.crc32(node.uuid) - 1).encode()))
    assert wait_for(lambda: len(announces(hub)) >= 2)
    assert node.address == 0x21


def test_an_equal_crc_is_told_to_a_person(hub: Hub, node: EchoNode) -> None:
    messages: list[str] = []
    server = CanServer(hub.spec, node, notify=messages.append)
    server.start()
    stranger = RawStation(hub.spec)
    try:
        for _ in range(2):
            stranger.bus.send(Frame(0x1CFF0021, Announce(0x21, 0, zlib.crc32(node.uuid)).encode()))
        assert wait_for(lambda: len(messages) == 1)
        assert node.uuid.hex() in messages[0]
        assert node.address == 0x21
    finally:
        server.stop()
        stranger.bus.close()


def test_6_nodes_on_one_address_in_two_processes_sort_themselves_out(hub: Hub) -> None:
    nodes = [EchoNode(0x21, uuid=bytes([number]) * 10) for number in range(6)]
    servers = [CanServer(hub.spec), CanServer(hub.spec)]
    for number, node in enumerate(nodes):
        servers[number % 2].add(node)
    try:
        for server in servers:
            server.start()
        assert wait_for(lambda: len({node.address for node in nodes}) == 6)
    finally:
        for server in servers:
            server.stop()


def test_200_nodes_in_one_process_answer_everyone_and_keep_to_few_threads(hub: Hub) -> None:
    nodes = [EchoNode(1 + number, uuid=bytes([number]) * 10, delay=0.02) for number in range(200)]
    server = CanServer(hub.spec)
    for node in nodes:
        server.add(node)
    before = threading.active_count()
    server.start()
    stranger = RawStation(hub.spec)
    try:
        pairs = {node.address: Pair(0xF1, node.address, stranger.bus.send) for node in nodes}
        answers: dict[int, bytes] = {}
        asked = time.monotonic() - 20
        until = time.monotonic() + 3 * 20
        while len(answers) < 200 and time.monotonic() < until:
            if time.monotonic() - asked >= 20:  # again, where a busy machine lets their answers be too late
                asked = time.monotonic()
                stranger.everyone("0742000080070000")
            frame = stranger.bus.receive(0.05)
            if frame is not None and (pair := pairs.get(frame.identifier & 0xFF)) and pair.handle_frame(frame):
                while (message := pair.received()) is not None:
                    answers[pair.peer] = message
        assert len(answers) == 200
        assert all(answers[node.address][5:15] == node.uuid for node in nodes)
        for pair in pairs.values():
            pair.send(b"\x01\x00\x00\x01\x03\x00\x00")
        assert wait_for(lambda: all(node.runs for node in nodes))
        assert threading.active_count() - before <= MOST_THREADS + 5
    finally:
        server.stop()
        stranger.bus.close()


class TriggerListener(EchoNode):
    """A node that notes at which tick it heard a trigger."""

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.ticks: list[int] = []

    def tick(self, at: float = 0.0) -> int:
        return round(at * 1e9) if at else time.monotonic_ns()

    def request_received(self, link: str, frame: bytes, *, tapped: bool, **_: object) -> bytes:
        return self.request(link, frame, tapped=tapped)

    def reply_sent(self, link: str) -> None: ...

    def drive(self, link: str, data: bytes) -> None: ...

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        self.ticks.append(tick)


def test_a_trigger_is_timed_while_a_data_frame_of_the_node_is_still_on_the_wire(hub: Hub) -> None:
    """The tick of a trigger is that of its end within 100 µs (operation.md section 5), whatever the node sends."""
    node = TriggerListener(0x21)
    server = CanServer(f"{hub.spec}&pace=1&bitrate=200")  # a frame of 8 octets takes 0.65 s
    server.add(node, measuring_handler=node)
    server.start()
    stranger = RawStation(hub.spec)
    try:
        assert stranger.ask(0x21, b"\x09" + COUNT)
        ends: list[int] = []

        def send() -> None:
            server.send_data(node, 0x1CFF2021, b"measured", fd=False)
            ends.append(time.monotonic_ns())

        began = time.monotonic_ns()
        sending = threading.Thread(target=send)
        sending.start()
        stranger.bus.send(Frame(0x18FF00F1, b"eight oc"))
        assert wait_for(lambda: bool(node.ticks))
        sending.join()
        assert began < node.ticks[0] < ends[0]
    finally:
        server.stop()
        stranger.bus.close()


def test_a_lost_flow_control_costs_the_next_request_nothing(station: RawStation, server: CanServer) -> None:
    """The node waits for a flow control that never comes; the same request again gets the whole stored reply."""
    request = b"\x05\x00\x00\x01\x03\x00\x1e" + bytes(30)
    pair = Pair(0xF1, 0x21, station.bus.send)
    pair.send(request)
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:  # our flow control for its reply is never sent
        frame = station.bus.receive(0.05)
        if frame is None or frame.identifier != 0x18DAF121:
            continue
        if frame.data[0] >> 4 == 3:
            pair.handle_frame(frame)
        elif frame.data[0] >> 4 == 1:
            break
    assert station.ask(0x21, request) == [b"\x05" + bytes(30)]


def test_comes_back_from_a_lost_bus_silent_and_announces_again(node: EchoNode) -> None:
    hub = Hub(port=free_tcp_port())  # not one that the system may deal out to others while it is closed
    server = CanServer(hub.spec, node)
    server.start()
    stranger = RawStation(hub.spec)
    assert len(stranger.ask(0x21, b"\x09" + COUNT)) == 1
    stranger.bus.close()
    port = hub.port
    hub.close()
    assert wait_for(lambda: node.links_lost == ["can:f1"])
    again = Hub(port=port)
    try:
        assert wait_for(lambda: bool(announces(again)))
    finally:
        server.stop()
        again.close()


def test_a_question_to_everyone_in_a_station_s_own_name_costs_its_reply_nothing(
    hub: Hub, station: RawStation, server: CanServer
) -> None:
    """A stranger asks everyone from this address while the reply waits for its flow control, and before it leaves."""
    request = b"\x05\x00\x00\x01\x03\x00\x1e" + bytes(30)
    pair = Pair(0xF1, 0x21, station.bus.send)
    held: list[Frame] = []
    messages: list[bytes] = []
    pair.send(request)
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and not messages:
        frame = station.bus.receive(0.05)
        if frame is None or frame.identifier != 0x18DAF121:
            continue
        if frame.data[0] >> 4 == 1 and not held:
            held.append(frame)
            station.everyone("0742000080070000")
            time.sleep(0.1)  # its answer is due after 50 ms
        pair.handle_frame(frame)
        messages += [] if (message := pair.received()) is None else [message]
    assert messages == [b"\x05" + bytes(30)]


def test_of_the_questions_to_everyone_during_a_reply_the_newest_is_answered(
    station: RawStation, server: CanServer
) -> None:
    """Answers queued behind the reply would each wait for the one before, and answer what was asked long ago."""

    def first_frame() -> Frame:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            frame = station.bus.receive(0.05)
            if frame is None or frame.identifier != 0x18DAF121:
                continue
            if frame.data[0] >> 4 == 1:
                return frame
            pair.handle_frame(frame)
        raise AssertionError("no reply")

    for transaction in (0x05, 0x06, 0x07, 0x08, 0x09):
        pair = Pair(0xF1, 0x21, station.bus.send)
        pair.send(bytes((transaction,)) + b"\x00\x00\x01\x03\x00\x1e" + bytes(30))
        assert first_frame().data[2] == transaction
        began = time.monotonic()
        for question in ("41", "42", "43"):
            station.everyone(f"07{question}000080070000")
            time.sleep(0.1)  # its answer is due after 50 ms
        prompt = time.monotonic() - began < 0.8  # the reply has a second for its flow control
        answered = first_frame().data[2]
        if prompt:
            break
        while (frame := station.bus.receive(1.5)) is not None:  # a busy machine: once more, when all is silent
            assert frame
    assert answered == 0x43


def test_forged_announces_move_it_three_times_at_once_and_then_later(
    station: RawStation, hub: Hub, node: EchoNode, server: CanServer
) -> None:
    for moves in range(1, 4):
        station.bus.send(Frame(0x1CFF0000 | node.address, Announce(node.address, 0, 0).encode()))
        assert wait_for(lambda at=0x21 + moves: node.address == at)  # type: ignore[misc]
    asked = time.monotonic()
    station.bus.send(Frame(0x1CFF0024, Announce(0x24, 0, 0).encode()))
    assert wait_for(lambda: node.address == 0x25)
    assert time.monotonic() - asked >= 1.0


def test_a_repetition_that_meets_the_reply_costs_neither(station: RawStation, server: CanServer) -> None:
    """The first frame of the reply and that of the repeated request cross on the bus."""
    request = b"\x05\x00\x00\x01\x03\x00\x1e" + bytes(30)
    pair = Pair(0xF1, 0x21, station.bus.send)
    pair.send(request)
    messages: list[bytes] = []
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and not messages:
        frame = station.bus.receive(0.05)
        if frame is None or frame.identifier != 0x18DAF121:
            continue
        if frame.data[0] >> 4 == 1:
            station.bus.send(Frame(0x18DA21F1, bytes([0x10, len(request)]) + request[:6]))
        pair.handle_frame(frame)
        if (message := pair.received()) is not None:
            messages.append(message)
    assert messages == [b"\x05" + bytes(30)]


def test_a_pressed_button_is_announced_at_once_and_claims_nothing(
    station: RawStation, server: CanServer, node: EchoNode, hub: Hub
) -> None:
    assert wait_for(lambda: len(announces(hub)) == 1)
    for _ in range(3):
        server.announce_press(node)
    station.bus.send(Frame(0x1CFF0021, Announce(0x21, 0, zlib.crc32(node.uuid) - 1, pressed=True).encode()))
    assert len(station.ask(0x21, b"\x0c" + COUNT)) == 1, "it is where it was, and has answered after all of these"
    pressed = [announce for announce in announces(hub) if announce.crc == zlib.crc32(node.uuid)]
    assert [announce.pressed for announce in pressed] == [False, True], "one a second"
