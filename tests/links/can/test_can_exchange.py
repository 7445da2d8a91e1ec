"""A station and nodes in two processes: whole frames both ways, silence, loss, repetition."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from teds_provision.errors import AddressConflictError, LinkError, NodeSilentError, NoNodeError, NoReaderError
from teds_provision.links.can import bus as bus_module
from teds_provision.links.can import link as link_module
from teds_provision.links.can.arrivals import Arrivals
from teds_provision.links.can.isotp import FUNCTIONAL, Frame
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import Contact, Notice
from teds_provision.node.can.server import CanServer
from teds_provision.protocol.announce import Announce, is_announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState
from tests.links.can.echo_node import EchoNode
from tests.links.can.hub import Hub
from tests.pace import PATIENCE, best_of, succeeds, until

pytestmark = pytest.mark.link
Start = Callable[..., None]


def anyone(_: Identity) -> bool:
    return True


def quiet(_: Notice) -> None:
    pass


def write(octets: bytes) -> bytes:
    return b"\x00\x00\x01\x03" + len(octets).to_bytes(2, "big") + octets


COUNT = b"\x00\x00\x01\x7f\x00\x00"


@contextlib.contextmanager
def opened(spec: str) -> Iterator[CanPort]:
    port = CanPort(spec)
    try:
        yield port
    finally:
        port.close()


@contextlib.contextmanager
def serving(spec: str, node: EchoNode) -> Iterator[CanServer]:
    server = CanServer(spec, node)
    server.start()
    try:
        yield server
    finally:
        server.stop()


def find(port: CanPort, seconds: float = PATIENCE, **options: int) -> Contact:
    return port.find(anyone, seconds=seconds, notice=quiet, **options)


@pytest.mark.parametrize("form", ["", "&fd=1"])
def test_exchanges_every_length_over_multicast(group: str, nodes: Start, form: str) -> None:
    nodes(group + form, 0x21)
    with opened(group + form) as port:
        contact = find(port)
        assert contact.address == 0x21
        assert contact.identity.can_address == 0x21
        for length in (1, 2, 6, 7, 8, 61, 62, 63, 700, 2048, 4088):
            octets = os.urandom(length)
            assert contact.link.exchange(write(octets)) == octets[::-1], length


def test_exchanges_over_a_bus_that_never_loses(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x30)
    with opened(hub.spec) as port:
        link = find(port, address=0x30).link
        for _ in range(5):
            octets = os.urandom(4088)
            assert link.exchange(write(octets)) == octets[::-1]


def test_a_node_answers_an_fd_station_in_fd_and_a_classic_one_in_classic(group: str, nodes: Start) -> None:
    nodes(group + "&fd=1", 0x21)
    octets = os.urandom(300)
    with opened(group + "&fd=1") as fd, opened(group + "&source=0xF2") as classic:
        fd_link, classic_link = find(fd).link, find(classic).link
        for _ in range(3):
            assert fd_link.exchange(write(octets)) == octets[::-1]
            assert classic_link.exchange(write(octets)) == octets[::-1]


def test_an_exchange_takes_milliseconds(group: str, nodes: Start) -> None:
    nodes(group, 0x21)
    with opened(group) as port:
        link = find(port).link
        link.exchange(write(b"warm"))

        def exchange() -> float:
            began = time.perf_counter()
            link.exchange(write(bytes(700)))
            return time.perf_counter() - began

        best_of(100, 0.1, exchange, because="milliseconds each: among a hundred even a busy machine has a quiet one")


def test_a_hundred_exchanges_under_load(group: str, nodes: Start) -> None:
    nodes(group, 0x21)
    stop = threading.Event()

    def burn() -> None:
        while not stop.is_set():
            sum(range(2000))

    load = threading.Thread(target=burn)
    load.start()
    try:
        with opened(group) as port:
            link = find(port).link
            for _ in range(100):
                octets = os.urandom(random.randrange(1, 400))
                assert link.exchange(write(octets)) == octets[::-1]
    finally:
        stop.set()
        load.join()


def test_twenty_nodes_answer_one_identify(hub: Hub, nodes: Start) -> None:
    addresses = list(range(0x10, 0x24))
    nodes(hub.spec, *addresses)
    with opened(hub.spec) as port:
        stop = threading.Event()
        found = set()
        for contact in port.watch(stop=stop, notice=quiet):
            found.add(contact.address)
            if len(found) == len(addresses):
                stop.set()
        assert found == set(addresses)
        wanted = bytes([19, addresses[19]]) * 5
        assert port.find(lambda seen: seen.uuid == wanted, seconds=PATIENCE, notice=quiet).address == addresses[19]


def test_watch_reports_a_node_back_in_factory_state_again(hub: Hub) -> None:
    node = EchoNode(0x21)
    node.state = NodeState.PROVISIONED
    with serving(hub.spec, node), opened(hub.spec) as port:
        stop = threading.Event()
        contacts = port.watch(stop=stop, notice=quiet)
        assert next(contacts).identity.state is NodeState.PROVISIONED
        threading.Timer(1.2, lambda: setattr(node, "state", NodeState.FACTORY)).start()
        assert next(contacts).identity.state is NodeState.FACTORY
        stop.set()
        assert list(contacts) == []


def test_a_board_that_was_served_may_be_changed_before_everyone_is_asked_again() -> None:
    """Asked at once, nobody new was there yet: the silence after that question held up the next board for 55 ms."""
    questions: list[float] = []

    def noted(identifier: int, _: bytes) -> bool:
        """Note each question to everyone; lose each Announce, which would bring one at once."""
        if identifier == 0x18DBFFF1:
            questions.append(time.monotonic())
        return is_announce(identifier)

    hub = Hub(noted)
    stop = threading.Event()
    with serving(hub.spec, EchoNode(0x21)), opened(hub.spec) as port:
        contacts = port.watch(stop=stop, notice=quiet)
        assert next(contacts).address == 0x21
        time.sleep(0.2)  # the work: the silence after that question is over
        before, served = len(questions), time.monotonic()
        watch = threading.Thread(target=list, args=(contacts,))
        watch.start()
        try:
            until(lambda: len(questions) > before)
            assert questions[before] - served >= 0.015
        finally:
            stop.set()
            watch.join()
    hub.close()


class StillBus:
    """A port, its bus and its listener in one, for one board at an address; ``waited`` for how long it was listened."""

    spec = parse_spec("socketcand:vcan0?host=127.0.0.1&port=1&node=33")

    def __init__(self) -> None:
        self.identity = Identity.decode(EchoNode(0x21).identify())
        self.announced: list[Frame] = []
        self.waited = 0.0

    def bus(self) -> StillBus:
        return self

    def listen(self, _: Callable[[Frame], bool], *, most: int) -> StillBus:
        return self

    def get(self, seconds: float) -> Frame | None:
        self.waited += seconds
        time.sleep(seconds)
        return None

    def get_all(self, _: float) -> list[Frame]:
        return self.announced

    def identify(self, address: int) -> Identity:
        return self.identity

    def report_rivals(self, notice: object) -> None:
        pass


@pytest.mark.parametrize("other", [False, True])
def test_what_a_board_announced_while_it_was_served_is_no_news(other: bool) -> None:
    def ended_the_pause() -> bool:
        bus, stop = StillBus(), threading.Event()
        arrivals = Arrivals(bus, quiet)  # type: ignore[arg-type]
        [(address, identity)] = arrivals.round(stop)
        announce = Announce(address + other, identity.state, uuid_crc(b"another 10" if other else identity.uuid))
        bus.announced = [Frame(announce.identifier, announce.encode(), False)]
        arrivals.pause(stop)
        return bus.waited == 0

    if other:
        assert ended_the_pause()
    else:
        succeeds(10, ended_the_pause, because="the machine may take the whole 15 ms for itself")


def test_what_a_board_announces_after_a_later_question_is_news() -> None:
    bus, stop = StillBus(), threading.Event()
    arrivals = Arrivals(bus, quiet)  # type: ignore[arg-type]
    [(address, identity)] = arrivals.round(stop)
    assert list(arrivals.round(stop)) == []
    announce = Announce(address, identity.state, uuid_crc(identity.uuid))
    bus.announced = [Frame(announce.identifier, announce.encode(), False)]
    arrivals.pause(stop)
    assert bus.waited == 0, "it has started again"


def test_watch_survives_a_bus_that_goes_away() -> None:
    hub = Hub()
    port = CanPort(hub.spec)
    notices: list[str] = []
    stop = threading.Event()
    then = {"waiting": threading.Timer(0.3, hub.close), "reader-lost": threading.Timer(2.2, stop.set)}

    def on_notice(notice: Notice) -> None:
        notices.append(notice.kind)
        if (next_one := then.pop(notice.kind, None)) is not None:
            next_one.start()

    assert list(port.watch(stop=stop, notice=on_notice)) == []
    assert notices == ["waiting", "reader-lost"]
    port.close()


def test_a_node_pulled_in_the_middle_of_its_answer_delays_no_other() -> None:
    """It was waited for a whole second in each round, in which the next board on the bus was not looked for."""
    broken_off = {(0x18DAF121, 2), (0x18DA21F1, 0)}  # its consecutive frames; asked by itself it is silent
    hub = Hub(lambda identifier, data: (identifier, data[0] >> 4) in broken_off)
    stop = threading.Event()

    def asked() -> int:
        return sum(identifier == 0x18DBFFF1 for identifier, _ in list(hub.frames))

    def between() -> float:
        """Return seconds from one question to everybody to the next but one."""
        before, began = asked(), time.monotonic()
        until(lambda: asked() >= before + 2)
        return time.monotonic() - began

    with serving(hub.spec, EchoNode(0x21)), opened(hub.spec) as port:
        watch = threading.Thread(target=lambda: list(port.watch(stop=stop, notice=quiet)))
        watch.start()
        try:
            best_of(5, 1.8, between, because="two rounds of 0.7 s leave 0.4 s to three threads")
        finally:
            stop.set()
            watch.join()
    hub.close()


def test_two_nodes_under_one_address_are_a_conflict(hub: Hub) -> None:
    first, second = EchoNode(0x21, uuid=b"A" * 10), EchoNode(0x21, uuid=b"B" * 10)
    first.pinned = second.pinned = True  # or they would sort themselves out
    with serving(hub.spec, first), serving(hub.spec, second), opened(hub.spec) as port:

        def refused(what: Callable[[], object]) -> bool:
            """Return True if it noticed that two are there; of two answers one may come too late on a busy machine."""
            try:
                what()
            except AddressConflictError as conflict:
                return "0x21" in str(conflict)
            return False

        def asked() -> None:
            link = find(port, seconds=3).link
            time.sleep(0.1)
            link.exchange(COUNT)  # either may notice, by the first answer

        until(lambda: refused(lambda: port.find_all(seconds=3, notice=quiet)))
        until(lambda: refused(asked))
        kinds: list[str] = []
        stop = threading.Event()
        latest = threading.Timer(PATIENCE, stop.set)
        latest.start()

        def on_notice(notice: Notice) -> None:
            kinds.append(notice.kind)
            if notice.kind == "conflict":
                threading.Timer(0.5, stop.set).start()

        for contact in port.watch(stop=stop, notice=on_notice):  # the first that answers
            time.sleep(0.1)
            until(lambda contact=contact: refused(lambda: contact.link.exchange(COUNT)))
        latest.cancel()
        assert "conflict" in kinds


def test_an_address_is_good_again_as_soon_as_one_node_alone_answers_there(hub: Hub) -> None:
    """It was refused for ten seconds, though a Claim sorts the two out within a tenth of one."""
    first, second = EchoNode(0x21, uuid=b"A" * 10), EchoNode(0x21, uuid=b"B" * 10)
    first.pinned = second.pinned = True
    with serving(hub.spec, first), opened(hub.spec) as port:
        with serving(hub.spec, second), pytest.raises(AddressConflictError, match="0x21"):
            port.find_all(seconds=3, notice=quiet)
        assert port.bus().has_conflict(0x21)
        [contact] = port.find_all(seconds=3, notice=quiet)
        assert contact.identity.uuid == first.uuid
        assert contact.link.exchange(COUNT)


def test_a_second_answer_that_comes_after_its_asker_has_left_shows_the_conflict_all_the_same(hub: Hub) -> None:
    with opened(hub.spec) as port:
        bus = port.bus()
        with bus.gather(7) as asked:
            hub.send(0x18DAF121, bytes([0x10, 26, 7, 1, 0, 23, 1, 0xAA]))
            until(lambda: asked.replies.busy)
        assert not bus.has_conflict(0x21)
        hub.send(0x18DAF121, bytes([0x10, 26, 7, 1, 0, 23, 1, 0xBB]))
        until(lambda: bus.has_conflict(0x21))


def test_a_late_reply_to_a_station_that_died_makes_no_second_node(hub: Hub) -> None:
    """One time in 256 it has our transaction number: the next command said that two nodes answer, for ten seconds."""
    late: list[int] = []

    def reply_late(identifier: int, data: bytes) -> bool:
        """The late reply is on the bus before the question is: so it comes before the node's own answer."""
        if identifier == FUNCTIONAL | 0xF1 and not late:
            late.append(data[1])
            hub.send(0x18DAF121, bytes([0x10, 40, data[1], 1, 0, 36, 7, 7]))
        return False

    with serving(hub.spec, EchoNode(0x21)), opened(hub.spec) as port:
        hub.lose = reply_late
        [contact] = port.find_all(seconds=PATIENCE, notice=quiet)
        assert late
        assert contact.link.exchange(COUNT)


def test_a_node_is_asked_first_where_it_is_thought_to_be(hub: Hub) -> None:
    """Everyone answers after a random wait of up to 50 ms, one that is asked alone at once (profile: wire, "CAN")."""
    with serving(hub.spec, EchoNode(0x21)), opened(hub.spec) as port:

        def others() -> set[int]:
            """What else went over the bus: where the node had no processor in time, everyone is asked after it."""
            hub.frames.clear()
            assert find(port, address=0x21).address == 0x21
            asked = {identifier for identifier, _ in hub.frames if identifier >> 16 in (0x18DA, 0x18DB)}
            return asked ^ {0x18DA21F1, 0x18DAF121}

        succeeds(5, others, because="the node has 50 ms to answer")
        assert find(port, address=0x22).address == 0x21, "the guess is wrong: then everyone is asked"


def test_no_node_is_there(hub: Hub) -> None:
    with opened(hub.spec) as port:

        def looked() -> float:
            began = time.monotonic()
            with pytest.raises(NoNodeError, match=r"within 1\.2 s"):
                find(port, seconds=1.2)
            seconds = time.monotonic() - began
            assert seconds > 1.0
            return seconds

        best_of(5, 3.0, looked, because="a try is 1.2 s of waiting and two of patience")


def test_another_node_than_the_wanted_is_reported_and_waited_past(hub: Hub) -> None:
    spec = hub.spec + "&node=0x21"
    with serving(hub.spec, EchoNode(0x21)), opened(spec) as port:

        def others() -> list[str]:
            """Return what was reported instead: a node without processor time is reported as missing."""
            notices: list[Notice] = []
            with pytest.raises(NoNodeError) as error:
                port.find(lambda _: False, seconds=1.2, notice=notices.append)
            kinds = [notice.kind for notice in notices]
            return [] if "2121" in str(error.value) and kinds == ["waiting", "foreign-tag"] else [str(error.value)]

        succeeds(5, others, because="the node has 50 ms to answer")


def test_a_node_that_falls_silent(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "REPLY_SECONDS", 0.3)
    with opened(hub.spec) as port:
        with serving(hub.spec, EchoNode(0x21)):
            link = find(port).link
        with pytest.raises(NodeSilentError, match="0x21"):
            link.exchange(COUNT)
    requests = {data for identifier, data in hub.frames if identifier == 0x18DA21F1 and data[0] >> 4 == 0}
    repeated = [data for identifier, data in hub.frames if identifier == 0x18DA21F1 and data[2:] == COUNT]
    assert len(repeated) == 3
    assert len(set(repeated)) == 1
    assert requests


def test_a_lost_reply_is_repeated_and_the_command_runs_once(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "REPLY_SECONDS", 2.0)
    node = EchoNode(0x21)
    with serving(hub.spec, node), opened(hub.spec) as port:
        link = find(port).link
        lost: list[bytes] = []

        def lose_first(identifier: int, data: bytes) -> bool:
            if identifier == 0x18DAF121 and not lost:
                lost.append(data)
                return True
            return False

        hub.lose = lose_first
        assert link.exchange(COUNT) == b"\x01\x00\x01"
        assert lost
        assert node.runs == 1
        assert link.exchange(COUNT) == b"\x01\x00\x02"


@pytest.mark.parametrize("way", [0x18DA21F1, 0x18DAF121])
def test_a_lost_consecutive_frame_is_made_good(hub: Hub, way: int) -> None:
    node = EchoNode(0x21)
    with serving(hub.spec, node), opened(hub.spec) as port:
        link = find(port).link
        lost: list[bytes] = []

        def lose_one(identifier: int, data: bytes) -> bool:
            if identifier == way and data[0] == 0x23 and not lost:
                lost.append(data)
                return True
            return False

        hub.lose = lose_one
        octets = os.urandom(300)
        assert link.exchange(write(octets)) == octets[::-1]
        assert lost
        assert node.runs == 1


def test_a_reply_of_another_transaction_is_dropped(hub: Hub) -> None:
    node = EchoNode(0x21, delay=0.5)
    with serving(hub.spec, node), opened(hub.spec) as port:
        link = find(port).link
        forged: list[bytes] = []

        def forge() -> None:
            until(lambda: node.runs)
            request = next(data for way, data in reversed(hub.frames) if way == 0x18DA21F1 and data[2:8] == COUNT)
            forged.append(bytes([4, request[1] ^ 0x55]) + b"\xff\xff\xff\xcc\xcc\xcc")
            hub.send(0x18DAF121, forged[0])

        forger = threading.Thread(target=forge)
        forger.start()
        assert link.exchange(COUNT) == b"\x01\x00\x01"
        forger.join()
        assert forged


def test_a_slow_command_of_one_station_does_not_hold_up_another(hub: Hub) -> None:
    node = EchoNode(0x21)
    node.free.clear()
    with serving(hub.spec, node), opened(hub.spec) as port, opened(hub.spec + "&source=0xF2") as other:
        slow, identity = find(port).link, b"\x00\x00\x80\x07\x00\x00"
        replies: list[bytes] = []
        thread = threading.Thread(target=lambda: replies.append(slow.exchange(write(bytes(500)))))
        thread.start()
        until(lambda: node.runs)
        assert find(other, address=0x21).link.exchange(identity)[3:] == node.identify()
        assert replies == []
        node.free.set()
        thread.join()
        assert replies == [bytes(500)]
    assert {name for name, _ in node.seen} == {"can:f1", "can:f2"}
    assert set(node.links_lost) == {"can:f1", "can:f2"}


def test_the_reply_to_set_can_address_leaves_from_the_old_one(hub: Hub) -> None:
    node = EchoNode(0x21)
    with serving(hub.spec, node), opened(hub.spec) as port:
        assert find(port).link.exchange(b"\x00\x00\x80\x0a\x00\x01\x42") == b"\x01\x00\x00"
        moved = find(port, address=0x42)
        assert moved.address == 0x42
        assert moved.link.exchange(write(bytes(100))) == bytes(100)


def test_no_bus_is_named_with_its_cure() -> None:
    with pytest.raises(NoReaderError) as missing:
        CanPort("socketcan:nosuch0?bitrate=250000")
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        kernel_has_can = True
    except OSError:
        kernel_has_can = False
    if kernel_has_can:
        assert "ip link set nosuch0 up type can bitrate 250000" in missing.value.hint
    else:
        assert "modprobe can_raw" in missing.value.hint
    with pytest.raises(NoReaderError, match="socketcand"):
        CanPort("socketcand:can0?port=1")
    with pytest.raises(NoReaderError):
        CanPort("nonsense:can0")
    with pytest.raises(NoReaderError):
        CanPort("udp_multicast:127.0.0.1")


@pytest.mark.parametrize(
    ("pythons", "ours"),
    [
        ("Bus.__init__() got an unexpected keyword argument 'baud'", "takes no baud="),
        ("Bus.__init__() missing 1 required keyword-only argument: 'serial'", "also needs 'serial'"),
        ("cannot be combined", "does not take these options: cannot be combined"),
    ],
)
def test_an_option_that_an_interface_does_not_take_is_named(pythons: str, ours: str) -> None:
    refused = bus_module._unknown_key(parse_spec("slcan:/dev/ttyACM0?bitrate=500000"), TypeError(pythons))
    assert ours in refused.message
    assert "own options are bitrate" in refused.hint


def test_a_bus_that_closes_is_a_link_failure() -> None:
    hub = Hub()
    with opened(hub.spec) as port:
        time.sleep(0.1)
        hub.close()
        with pytest.raises(LinkError) as failure:
            find(port, seconds=3)
        assert not isinstance(failure.value, NoNodeError)
