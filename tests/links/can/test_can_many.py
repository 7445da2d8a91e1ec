"""One bus, many threads: exchanges with several nodes at once, listeners, two stations of one address."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.doctor import links as doctor
from teds_provision.doctor.checks import System
from teds_provision.errors import AddressConflictError, LinkClosedError, LinkError, NodeSilentError, UsageError
from teds_provision.links import LINKS, Contact, LinkSettings, Notice, open_place, open_port
from teds_provision.links.can import bus_multiplexer, data_streams
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.bus_multiplexer import AddressConflicts
from teds_provision.links.can.port import CanPort, _patience
from teds_provision.links.can.spec import parse_spec
from teds_provision.protocol.messages.identity import Identity
from tests.links.can.hub import Hub
from tests.links.can.test_can_loss import assert_all_found
from tests.pace import PATIENCE, best_of, until

pytestmark = pytest.mark.link
Start = Callable[..., None]
ANNOUNCE = 0x1CFF0030


def write(octets: bytes) -> bytes:
    return b"\x00\x00\x01\x03" + len(octets).to_bytes(2, "big") + octets


def quiet(_: Notice) -> None:
    pass


def in_threads(work: Callable[[int], object], count: int) -> list[object]:
    results: list[object] = [None] * count

    def run(number: int) -> None:
        try:
            results[number] = work(number)
        except Exception as error:  # noqa: BLE001  (the test shows it)
            results[number] = error

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    return results


def test_eight_nodes_are_talked_to_at_once_and_none_waits_for_a_slow_one(hub: Hub, nodes: Start) -> None:
    addresses = list(range(0x21, 0x29))
    nodes(hub.spec, *addresses, delay=1.0)
    port = CanPort(hub.spec)
    bodies = [os.urandom(300 + 10 * number) for number in range(8)]

    def elapsed() -> float:
        began = time.monotonic()
        replies = in_threads(lambda number: port.link(addresses[number]).exchange(write(bodies[number])), 8)
        assert replies == [body[::-1] for body in bodies]
        return time.monotonic() - began

    best_of(5, 8, elapsed, because="eight nodes and eight threads that each wait a second")
    port.close()


def test_everyone_is_asked_while_exchanges_run(hub: Hub, nodes: Start) -> None:
    addresses = list(range(0x21, 0x29))
    nodes(hub.spec, *addresses)
    port = CanPort(hub.spec)
    stop = threading.Event()

    def talk(number: int) -> int:
        count = 0
        while not stop.is_set():
            octets = os.urandom(100)
            assert port.link(addresses[number]).exchange(write(octets)) == octets[::-1]
            count += 1
        return count

    def ask(number: int) -> object:
        del number
        try:
            for _ in range(3):
                assert_all_found(port, addresses)
            return True
        finally:
            stop.set()

    results = in_threads(lambda number: ask(number) if number == 4 else talk(number), 5)
    assert results[4] is True, results[4]
    assert all(isinstance(count, int) and count for count in results[:4]), results
    port.close()


def test_each_node_is_shown_once_while_others_are_still_asked(hub: Hub, nodes: Start) -> None:
    addresses = list(range(0x21, 0x2B))
    nodes(hub.spec, *addresses)
    with closing(CanPort(hub.spec)) as port:
        shown: list[int | None] = []
        talked: list[bool] = []

        def seen(contact: Contact) -> None:
            shown.append(contact.address)
            port.bus().check()
            asking = [one for one in port.bus()._asked if one.until > time.monotonic()]
            talked.append(bool(asking))

        found = port.find_all_early(seconds=PATIENCE, notice=quiet, listen=1.0, seen=seen)
        assert sorted(shown, key=str) == sorted((contact.address for contact in found), key=str)
        assert sorted(address or 0 for address in shown) == addresses
        assert all(talked), "each while the question to everyone was open"


def test_where_many_answer_the_listening_ends_with_a_last_question() -> None:
    for left, known, seconds in [(3.0, 0, 1.5), (1.0, 3, 1.0), (1.0, 8, 0.7), (0.5, 200, 0.5), (0.1, 8, 0.3)]:
        assert _patience(left, known) == pytest.approx(seconds)


def test_a_question_is_given_up_when_the_node_announces_itself(hub: Hub, nodes: Start) -> None:
    """It has not heard the question; whoever asks it now need not wait for the old one."""
    with closing(CanPort(hub.spec)) as port:
        found: list[Identity | None] = []
        asking = threading.Thread(
            target=lambda: found.append(port.identify(0x21, seconds=5 * PATIENCE, until_announced=True))
        )
        with closing(Bus(parse_spec(hub.spec))) as beside:
            asking.start()
            until(lambda: (frame := beside.receive(0.1)) is not None and frame.identifier >> 8 & 0xFF == 0x21)
        nodes(hub.spec, 0x21)
        asking.join(PATIENCE)
        assert found == [None]
        assert port.identify(0x21, seconds=PATIENCE) is not None


def test_an_exchange_is_given_up_when_its_reply_is_not_expected(hub: Hub) -> None:
    with closing(CanPort(hub.spec)) as port:
        link, over = port.link(0x21), threading.Event()
        link.hopeless = over.is_set
        ended: list[type] = []

        def ask() -> None:
            try:
                link.exchange_limited(write(b"x"), tries=3, seconds=5 * PATIENCE)
            except LinkError as failure:
                ended.append(type(failure))

        asking = threading.Thread(target=ask)
        asking.start()
        over.set()
        asking.join(PATIENCE)
        assert ended == [NodeSilentError]


def test_a_listener_hears_what_it_wants_beside_an_exchange(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x21)
    port = CanPort(hub.spec)
    with port.listen_frames(lambda frame: frame.identifier == ANNOUNCE) as ear:
        before = time.monotonic()
        hub.send(ANNOUNCE, b"\x01\x02abcd\x00\x00")
        assert port.link(0x21).exchange(write(b"abc")) == b"cba"
        frame = ear.get(PATIENCE)
        assert frame == Frame(ANNOUNCE, b"\x01\x02abcd\x00\x00")
        assert before - 0.1 < frame.at <= time.monotonic()
        assert ear.get(0.05) is None
    port.close()


def test_a_listener_that_does_not_read_loses_what_does_not_fit_and_knows_it(hub: Hub) -> None:
    port = CanPort(hub.spec)
    ear = port.bus().listen(lambda frame: True, most=10)
    fence = port.listen_frames(lambda frame: frame.data == b"end")
    for number in range(25):
        hub.send(ANNOUNCE, bytes([number]))
    hub.send(ANNOUNCE, b"end")
    assert fence.get(PATIENCE)
    assert [ear.get(0) for _ in range(10)] == [Frame(ANNOUNCE, bytes([number])) for number in range(10)]
    assert ear.lost == 16
    port.close()


def test_a_bus_that_goes_away_wakes_every_waiting_thread() -> None:
    hub = Hub()
    port = CanPort(hub.spec)
    ear = port.listen_frames(lambda frame: True)
    threading.Timer(0.2, hub.close).start()
    results = in_threads(lambda number: ear.get(PATIENCE) if number else port.link(0x21).exchange(write(b"x")), 2)
    assert [isinstance(result, LinkError) for result in results] == [True, True], results
    port.close()


def test_two_stations_of_one_address_are_noticed_and_named(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x21, 0x22)
    ours, theirs, other = CanPort(hub.spec), CanPort(hub.spec), CanPort(hub.spec + "&source=0xF2")
    other.link(0x22).exchange(write(b"abc"))
    ours.link(0x21).exchange(write(b"abc"))
    assert not ours.bus().conflicts.seen_within()  # a station of another address conflicts with none
    theirs.link(0x22).exchange(write(b"abcdefgh"))
    notices: list[Notice] = []
    ours.find_all(seconds=2, notice=notices.append)
    assert any(
        notice.kind == "conflict" and "0xF1" in notice.text and "source=0xF2" in notice.text for notice in notices
    )
    with pytest.raises(LinkError, match="Another base station") as failure:
        ours.link(0x55).exchange_limited(write(b"nobody"), tries=1, seconds=0.2)
    assert "source=0xF2" in failure.value.hint
    for port in (ours, theirs, other):
        port.close()


def test_an_interface_that_gives_back_our_own_frames_makes_no_rival(group: str, nodes: Start) -> None:
    nodes(group, 0x21)
    port = CanPort(group)
    for _ in range(5):
        port.link(0x21).exchange(write(bytes(200)))
    assert not port.bus().conflicts.seen_within()
    bus = Bus(parse_spec(group))
    for _ in range(3):
        bus.send(Frame(0x18DA21F1, b"\x02\x01\x02"))
    bus.close()
    until(port.bus().conflicts.seen_within)
    port.close()


def test_replies_to_a_process_that_ended_just_before_are_no_rival() -> None:
    now = [100.0]
    conflicts = AddressConflicts(0xF1, lambda: now[0])

    def four_replies() -> None:
        for node in range(4):
            conflicts.record_unsolicited(0x21 + node)

    now[0] = 102.9
    four_replies()
    assert not conflicts.seen_within()
    now[0] = 103.1
    four_replies()
    assert conflicts.seen_within()
    assert not conflicts.frames_within(within=10)
    now[0] = 120.0
    assert not conflicts.seen_within()


def test_who_measures_under_our_address_is_known_by_its_own_frames(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes stream on after a process was killed, and answer its last requests: that is no other station."""
    monkeypatch.setattr(data_streams, "LISTENING", PATIENCE)
    monkeypatch.setattr(data_streams, "SIGN_OF_LIFE", 0.5)
    monkeypatch.setattr(bus_multiplexer, "_LATE_REPLIES_SECONDS", 0.0)
    port = CanPort(hub.spec)
    stop = threading.Event()
    rival = threading.Event()

    def node_goes_on() -> None:
        while not stop.wait(0.02):
            hub.send(0x1CFF2021, bytes(8))  # data for 0xF1
            hub.send(0x18DAF121, b"\x02\x63\x01\xcc\xcc\xcc\xcc\xcc")
            if rival.is_set():
                hub.send(0x18DA21F1, b"\x02\x64\x03\xcc\xcc\xcc\xcc\xcc")

    thread = threading.Thread(target=node_goes_on)
    thread.start()
    try:
        until(port.bus().conflicts.seen_within)  # by replies alone
        port.require_sole_source()
        rival.set()
        until(lambda: port.bus().conflicts.frames_within(within=10))
        with pytest.raises(AddressConflictError, match="0xF1"):
            port.require_sole_source()
    finally:
        stop.set()
        thread.join()
        port.close()


def test_the_registry_opens_a_place_and_names_what_it_does_not_know(hub: Hub) -> None:
    port = open_place(f"can:{hub.spec}")
    assert port.place == f"can:{hub.spec}"
    assert port.capabilities == LINKS["can"].capabilities
    port.close()
    with pytest.raises(UsageError, match="radio"):
        open_place("radio:0")
    with pytest.raises(UsageError, match="requires --can"):
        open_port(LinkSettings("can"))
    with pytest.raises(UsageError, match="2 readers"):
        open_port(LinkSettings(nfc=("udp:localhost:7", "udp:localhost:8")))
    assert LinkSettings(nfc=("usb", "udp:localhost:8")).places == ("nfc:usb", "nfc:udp:localhost:8")


def test_the_doctor_names_another_station_of_our_address_with_its_cure(hub: Hub, tmp_path: Path) -> None:
    stop = threading.Event()

    def talk() -> None:
        while not stop.wait(0.02):
            hub.send(0x18DA21F1, b"\x02\x01\x02\xcc\xcc\xcc\xcc\xcc")

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        (found,) = list(doctor.can(System(tmp_path, can=hub.spec)))
        (other,) = list(doctor.can(System(tmp_path, can=hub.spec + "&source=0xF2")))
    finally:
        stop.set()
        thread.join()
    assert (found.result, "source=0xF2" in found.fix) == ("warning", True)
    assert other.result == "ok"


def test_what_another_thread_still_asks_does_not_open_a_closed_port_again(hub: Hub, nodes: Start) -> None:
    """After Ctrl-C a thread that was between two questions opened the bus again and waited out a mute node."""
    nodes(hub.spec, 0x21)
    port = CanPort(hub.spec)
    link = port.link(0x21)
    body = os.urandom(20)
    assert link.exchange(write(body))
    port.close()

    for ask in (lambda: link.exchange(write(body)), lambda: port.link(0x21).exchange(write(body)), port.bus):
        with pytest.raises(LinkClosedError, match="was closed"):
            ask()


def test_closing_a_port_ends_the_exchange_of_another_thread_with_what_it_was(hub: Hub) -> None:
    port = CanPort(hub.spec)
    ended: list[Exception] = []

    def ask_a_mute_node() -> None:
        try:
            port.link(0x21).exchange(write(b"nothing"))
        except LinkError as error:
            ended.append(error)

    asking = threading.Thread(target=ask_a_mute_node)
    asking.start()
    time.sleep(0.2)
    port.close()
    asking.join(PATIENCE)

    assert [type(error) for error in ended] == [LinkClosedError]
