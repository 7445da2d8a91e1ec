"""The nodes' end of a bus frame by frame, without a bus: what goes out for what came in, and when.

Time stands still between the steps of a test, random waits are the longest, and each job runs at once.
"""

from __future__ import annotations

import functools
import heapq
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import LinkError, NodeSilentError
from teds_provision.links.can.bus import Frame
from teds_provision.node.can import endpoint as endpoint_module
from teds_provision.node.can import server as server_module
from teds_provision.node.can.endpoint import CanEndpoint
from teds_provision.node.can.server import CanServer, EndpointTable
from teds_provision.node.worker_pool import JobQueue
from teds_provision.protocol.announce import uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState

LOW, HIGH = bytes(9) + b"\5", bytes(9) + b"\1"
"""UUIDs of a smaller and of a greater CRC-32."""
TRIGGER_OF_F1, DRIVE = 0x18FF00F1, 0x18EF0000
WRITE = "000001030000"


class Node:
    """A node that answers what it was asked with ``answer``, and writes down what its bus calls."""

    def __init__(self, address: int = 0x21, uuid: bytes = LOW) -> None:
        self.address, self.uuid, self.pinned = address, uuid, False
        self.answer: bytes | Exception = b"\1\0\0"
        self.log: list[Any] = []

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        del tapped
        self.log.append((link, frame.hex()))
        if frame[2:4] == b"\x80\x0a":
            self.address = frame[6]
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def request_received(self, link: str, frame: bytes, *, tapped: bool, **how: Any) -> bytes:
        self.log.append(how)
        return self.request(link, frame, tapped=tapped)

    def lost(self, link: str) -> None:
        self.log.append(f"lost {link}")

    def reply_sent(self, link: str) -> None:
        self.log.append(f"sent {link}")

    def identify(self) -> bytes:
        return Identity(self.uuid, NodeState.KEYED, 0, 0, 512, self.address).encode()

    def can_address(self) -> int:
        return self.address

    def take_can_address(self, address: int) -> None:
        self.address = address

    def actuator_claimed(self) -> bool:
        return self.pinned

    def tick(self, at: float) -> int:
        return round(at * 10)

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        self.log.append((link, token, tick))

    def drive(self, link: str, data: bytes) -> None:
        self.log.append((link, data))


class Quiet(CanServer):
    """The end of these nodes on a bus that is a list; ``clock`` holds the time."""

    def __init__(self, clock: list[float], *nodes: Node, measuring: bool = False, options: str = "") -> None:
        self.told: list[str] = []
        super().__init__(f"virtual:none{options}", notify=self.told.append)
        self.clock, self.sent, self.held = clock, list[Frame](), list[Callable[[], None]]()
        self.waits = False
        workers: Any = SimpleNamespace(new_queue=lambda: JobQueue(self._job))
        self._bus = cast("Any", SimpleNamespace(send=self.sent.append))
        self._endpoints = [
            CanEndpoint(cast("Any", node), lambda: False, workers, self._out, cast("Any", node) if measuring else None)
            for node in nodes
        ]
        for each in self._endpoints:
            each.claim.uniform = lambda _low, high: high
        self._endpoint_of = {id(each.handler): each for each in self._endpoints}
        self._addresses = self._new_table()

    def _job(self, job: Callable[[], None]) -> None:
        if self.waits:
            self.held.append(job)
        else:
            job()

    def _spread(self) -> float:
        return 0.05

    def heard(self, identifier: int, octets: str, *, fd: bool = False) -> list[str]:
        """Take a frame; return what left at once."""
        self._dispatch(Frame(identifier, bytes.fromhex(octets), fd, self.clock[0]))
        return self.left()

    def left(self) -> list[str]:
        frames, self.sent[:] = [f"{each.identifier:08x} {each.data.hex()}" for each in self.sent], []
        return frames

    def after(self, seconds: float) -> list[str]:
        """Let time pass; return what left meanwhile."""
        self.clock[0] += seconds
        while self._later and self._later[0][0] <= self.clock[0]:
            heapq.heappop(self._later)[2]()
        self._looked = 0.0
        self._run_transfers(self.clock[0])
        return self.left()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    for module in (server_module, endpoint_module):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def announce(node: Node, *, crc: bytes = b"", address: int = 0) -> str:
    number = crc or uuid_crc(node.uuid).to_bytes(4, "big")
    return f"1cff00{address or node.address:02x} 0101{number.hex()}0000"


# -- announces and addresses -------------------------------------------------------------------------------------------


def test_the_uuids_of_this_file_have_a_smaller_and_a_greater_crc() -> None:
    assert uuid_crc(LOW) < uuid_crc(HIGH)


def test_a_node_that_restarts_announces_itself_from_its_new_address_within_half_a_second(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    server.waits = True
    server.heard(0x18DA21F1, "1014010000010300")
    assert [len(each) for each in (server._active, server._pushing)] == [1, 0]
    node.address = 0x44
    server.restarted(cast("Any", node))
    assert len(server._active) == 0
    assert server.left() == []
    assert server.after(0.5) == [announce(node, address=0x44)]
    assert server.after(10) == []
    assert server.heard(0x18DA21F1, "0701" + WRITE[:12]) == []
    server.waits = False
    assert server.heard(0x18DA44F1, "0701" + WRITE) == ["18daf144 0401010000cccccc"]


def test_a_node_of_another_bus_and_one_of_a_bus_that_ends_do_not_start_again(clock: list[float]) -> None:
    node, other = Node(), Node(0x22)
    server = Quiet(clock, node)
    server.restarted(cast("Any", other))
    server.announce_press(cast("Any", other))
    server._stop.set()
    server.restarted(cast("Any", node))
    assert server.after(10) == []


def test_a_press_is_announced_at_once(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    server.announce_press(cast("Any", node))
    crc = uuid_crc(LOW).to_bytes(4, "big").hex()
    assert server.after(0.0) == [f"1cff0021 0101{crc}0100"]


@pytest.mark.parametrize(("options", "told"), [("", 1), ("?receive_own_messages=1", 0)])
def test_another_node_of_the_same_crc_is_named_once_and_an_echo_never(
    clock: list[float], options: str, told: int
) -> None:
    node = Node()
    server = Quiet(clock, node, options=options)
    for _ in range(3):
        server.heard(*_split(announce(node)))
    assert (
        server.told
        == [
            "Another node announces the UUID 00000000000000000005 (or one of equal CRC-32) "
            "from the CAN address 0x21: disconnect one of them."
        ]
        * told
    )
    assert (server.after(10), node.address) == ([], 0x21)


def _split(frame: str) -> tuple[int, str]:
    identifier, octets = frame.split()
    return int(identifier, 16), octets


def test_two_nodes_of_one_process_that_meet_part(clock: list[float]) -> None:
    """Two servers of one process receive each other's frames, which do not come back from the bus."""
    low, high, beside = Node(), Node(uuid=HIGH), Node(0x22, bytes(10))
    server = Quiet(clock, low, high, beside)
    server.send_data(cast("Any", beside), 0x1CFE0022, b"data", fd=False)
    server.left()
    server._addresses.announce_all()
    first = server.after(0.5)
    assert announce(low, address=0x21) in first
    assert (low.address, beside.address, server.told) == (0x21, 0x22, [])
    assert high.address == 0x23
    assert announce(high, address=0x23) in server.after(0.05)
    assert server.heard(0x18DA23F1, "0701" + WRITE) == ["18daf123 0401010000cccccc"]


@pytest.mark.parametrize(
    ("source", "taken"), [(0x22, True), (0xEF, False), (0xF1, False), (0xF0, False), (0x00, False)]
)
def test_an_address_from_which_a_frame_came_is_in_use(clock: list[float], source: int, taken: bool) -> None:
    node = Node(uuid=HIGH)
    server = Quiet(clock, node)
    server.heard(0x18DA0000 | 0xF1 << 8 | source, "0501000000")
    server.heard(0x1CFF0021, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
    assert node.address == (0x23 if taken else 0x22)


def test_the_last_and_the_first_node_address_may_be_in_use_as_well(clock: list[float]) -> None:
    for source, moved in ((0xEF, 1), (0x01, 239)):
        node = Node(238, HIGH)
        server = Quiet(clock, node)
        server.heard(0x18DAF100 | source, "0501000000")
        server.heard(0x1CFF00EE, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
        assert node.address == moved
    server.heard(0x1CFF00EF, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
    assert node.address == 2


def test_what_looks_like_an_announce_and_is_none_moves_nobody(clock: list[float]) -> None:
    node = Node(uuid=HIGH)
    server = Quiet(clock, node)
    for octets in ("0201000000000000", "01010000000000", "0103000000000000"):
        server.heard(0x1CFF0021, octets)
    assert node.address == 0x21


def test_of_four_claims_the_fourth_is_given_way_to_a_second_later_once(clock: list[float]) -> None:
    """Three moves at once; a claim that is repeated meanwhile changes nothing (profile.md, "CAN")."""
    node = Node(uuid=HIGH)
    server = Quiet(clock, node)
    low = uuid_crc(LOW).to_bytes(4, "big").hex()
    server.waits = True
    for address in (0x21, 0x22, 0x23):
        server.heard(0x18DA0000 | address << 8 | 0xF1, "1014010000010300")
        assert len(server._active) == 1
        server.heard(0x1CFF0000 | address, f"0101{low}0000")
        assert (node.address, len(server._active)) == (address + 1, 0)
    server.left()
    for _ in range(3):
        server.heard(0x1CFF0024, f"0101{low}0000")
    assert len([job for *_, job in server._later if isinstance(job, functools.partial)]) == 1, "one move"
    server.after(0.99)
    assert node.address == 0x24
    sent = server.after(0.02)
    assert node.address == 0x25
    assert sent == []
    assert server.after(0.05) == [announce(node, address=0x25)]
    assert server.told == [], "another CRC is no conflict for a person"


def test_a_move_that_waits_is_dropped_if_the_address_was_set_or_an_actuator_is_claimed(clock: list[float]) -> None:
    low = uuid_crc(LOW).to_bytes(4, "big").hex()
    for pinned in (False, True):
        node = Node(uuid=HIGH)
        server = Quiet(clock, node)
        for address in (0x21, 0x22, 0x23, 0x24):
            server.heard(0x1CFF0000 | address, f"0101{low}0000")
        if pinned:
            node.pinned = True
        else:
            server.heard(0x18DA24F1, "1008010000800a00")
            server.heard(0x18DA24F1, "210144cccccccccc")
        server.after(5)
        assert node.address == (0x24 if pinned else 0x44)


def test_an_echo_is_of_the_own_crc_and_a_claim_of_another_counts(clock: list[float]) -> None:
    node = Node(uuid=HIGH)
    server = Quiet(clock, node, options="?receive_own_messages=1")
    server.heard(0x1CFF0021, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
    assert node.address == 0x22


def test_an_announce_that_left_meanwhile_does_not_leave_twice(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    server._addresses.announce_all()
    server._addresses.announce_all()
    assert server.after(1.0) == [announce(node)]


# -- commands ----------------------------------------------------------------------------------------------------------


def test_a_command_longer_than_max_message_is_refused_at_its_first_frame(clock: list[float]) -> None:
    """513 octets with the transaction are the most of a node of 512."""
    server = Quiet(clock, Node())
    assert server.heard(0x18DA21F1, "1202070000010300") == ["18daf121 05070000010acccc"]
    assert server.heard(0x18DA21F1, "1201070000010300") == ["18daf121 301000cccccccccc"]


def test_a_node_that_fails_does_not_reply_and_takes_the_next_command(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    node.answer = NodeSilentError("its flash file is gone")
    for transaction in range(1, 7):
        assert server.heard(0x18DA21F1, f"07{transaction:02x}" + WRITE) == []
    node.answer = b"\1\0\0"
    assert server.heard(0x18DA21F1, "0709" + WRITE) == ["18daf121 0409010000cccccc"]
    assert len(node.log) == 7


def test_a_reply_goes_out_from_the_address_of_its_request_and_flows_on_from_there(clock: list[float]) -> None:
    """Set CAN address, with a long reply: its flow control still goes to the old address."""
    node = Node()
    server = Quiet(clock, node)
    node.answer = bytes(range(20))
    assert server.heard(0x18DA21F1, "1008010000800a00") == ["18daf121 301000cccccccccc"]
    assert server.heard(0x18DA21F1, "210144cccccccccc") == ["18daf121 1015010001020304"]
    assert server.heard(0x18DA21F1, "300000cccccccccc") == [
        "18daf121 2105060708090a0b",
        "18daf121 220c0d0e0f101112",
        "18daf121 2313cccccccccccc",
    ]
    assert server.heard(0x18DA21F1, "0702" + WRITE) == []
    node.answer = b"\1\0\0"
    assert server.heard(0x18DA44F1, "0702" + WRITE) == ["18daf144 0402010000cccccc"]


def test_the_reply_to_a_station_that_was_lost_stays_here(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    server.waits = True
    server.heard(0x18DA21F1, "0701" + WRITE)
    server.heard(0x18DBFFF1, "0702000080070000")
    server._lose_stations()
    for job in server.held:
        job()
    assert server.left() == []
    assert server.after(10) == []
    assert (len(server._active), len(server._pushing), server._later, server._broadcast_due) == (0, 0, [], {})


def test_a_bus_that_is_lost_under_a_reply_fails_the_reading_thread_alone(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)

    def gone(_frame: Frame) -> None:
        raise LinkError("gone")

    server._bus = cast("Any", SimpleNamespace(send=gone))
    assert server.heard(0x18DA21F1, "0701" + WRITE) == []
    assert node.log == [("can:f1", WRITE)]


# -- questions to everyone ---------------------------------------------------------------------------------------------


def test_of_two_questions_of_a_station_to_everyone_the_newer_is_answered(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    assert server.heard(0x18DBFFF1, "0701000080070000") == []
    assert server.after(0.03) == []
    assert server.heard(0x18DBFFF1, "0702000080070000") == []
    assert server.after(0.03) == []
    assert server.after(0.03) == ["18daf121 101b020100170100"]
    assert server.after(5) == []


def test_a_node_that_moved_meanwhile_does_not_answer_everyone(clock: list[float]) -> None:
    node = Node(uuid=HIGH)
    server = Quiet(clock, node)
    server.heard(0x18DBFFF1, "0701000080070000")
    server.heard(0x1CFF0021, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
    assert [frame for frame in server.after(1) if not frame.startswith("1cff")] == []


@pytest.mark.parametrize(
    ("identifier", "octets"),
    [
        (0x18DBFFF1, "07010000800b0000"),
        (0x18DBFFF1, "0801000080070000"),
        (0x18DBFFF1, "1007010000800700"),
        (0x18DBFFF8, "0701000080070000"),
        (0x18DBFF21, "0701000080070000"),
        (0x18DBFEF1, "0701000080070000"),
    ],
)  # fmt: skip
def test_nothing_else_is_answered_to_everyone(clock: list[float], identifier: int, octets: str) -> None:
    server = Quiet(clock, Node())
    assert (server.heard(identifier, octets), server.after(1)) == ([], [])


# -- measuring ---------------------------------------------------------------------------------------------------------


def test_a_trigger_reaches_every_measuring_node_with_its_arrival_and_drive_frames_the_one_they_name(
    clock: list[float],
) -> None:
    first, second = Node(), Node(0x22, HIGH)
    server = Quiet(clock, first, second, measuring=True)
    server.heard(0x18DA21F1, "0701" + WRITE)
    assert first.log == [{"fd": False, "received": 10_000}, ("can:f1", WRITE), "sent can:f1"]
    first.log.clear()
    server.heard(TRIGGER_OF_F1, "0102030405060708")
    assert first.log == second.log == [("can:f1", bytes(range(1, 9)), 10_000)]
    server.heard(DRIVE | 0x22F2, "00aa")
    assert (len(first.log), second.log[1:]) == (1, [("can:f2", b"\0\xaa")])


def test_a_node_that_does_not_measure_hears_no_trigger_and_no_drive_frame(clock: list[float]) -> None:
    node = Node()
    server = Quiet(clock, node)
    server.heard(TRIGGER_OF_F1, "0102030405060708")
    server.heard(DRIVE | 0x21F1, "00aa")
    assert node.log == []


def test_a_data_frame_leaves_for_a_node_of_this_bus_alone(clock: list[float]) -> None:
    node, other, beside = Node(), Node(0x22), Node(0x23, HIGH)
    server = Quiet(clock, node, beside)
    server.send_data(cast("Any", node), 0x1CFE0025, b"data", fd=False)
    assert server.left() == ["1cfe0025 64617461"]
    server.send_data(cast("Any", other), 0x1CFE0024, b"data", fd=False)
    server._stop.set()
    server.send_data(cast("Any", node), 0x1CFE0024, b"data", fd=False)
    server._stop.clear()
    server._bus = None
    server.send_data(cast("Any", node), 0x1CFE0024, b"data", fd=False)
    assert server.left() == []
    server._bus = cast("Any", SimpleNamespace(send=server.sent.append))
    for address in (0x23, 0x24):
        server.heard(0x1CFF0000 | address, f"0101{uuid_crc(LOW).to_bytes(4, 'big').hex()}0000")
    assert beside.address == 0x26, "0x25 was heard from the other node of this process"


def test_an_address_from_which_a_frame_came_is_known_to_every_node_of_the_bus_once() -> None:
    heard: list[tuple[str, int]] = []
    endpoints: Any = [
        SimpleNamespace(
            address=number,
            spoken_from=set(),
            claim=SimpleNamespace(hear=lambda source, name=name: heard.append((name, source))),
        )
        for number, name in enumerate("ab", 5)
    ]
    table = EndpointTable(endpoints, lambda *_: None, lambda _: None, lambda _: None, echoes=False)
    for source in (0, 1, 0xEF, 0xF0, 0xF1, 1):
        table.record_use(source)
    assert heard == [("a", 1), ("b", 1), ("a", 0xEF), ("b", 0xEF)]
    heard.clear()
    for endpoint, source in ((0, 5), (0, 5), (1, 6), (0, 7)):
        table.speaks(endpoints[endpoint], 0x18DAF100 | source)
    assert heard == [("b", 5), ("a", 6), ("b", 7)], "nobody hears its own"
