"""Watching for taps, two stations on one node, and what ends a wait."""

from __future__ import annotations

import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from teds_provision.errors import NoNodeError
from teds_provision.links import Contact, LinkSettings, Notice, Port, open_port
from teds_provision.links.nfc import port as port_module
from tests.pace import best_of, until

from .conftest import UUID, Process, StartNode

pytestmark = pytest.mark.link
OTHER = "FFEEDDCCBBAA99887766"


class Watch:
    """A watch in a thread of its own; the nodes are processes."""

    def __init__(self, port: Port, *, use: Callable[[Contact], None] = lambda contact: None) -> None:
        self.stop = threading.Event()
        self.visits: list[str] = []
        self.notices: list[Notice] = []
        self._port, self._use = port, use
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for contact in self._port.watch(stop=self.stop, notice=self.notices.append):
            self._use(contact)
            contact.link.close()
            self.visits.append(contact.identity.uuid.hex().upper())

    def until(self, condition: Callable[[], bool]) -> None:
        until(condition, lambda: (self.visits, self.notices))

    def left(self, times: int) -> bool:
        return [notice.kind for notice in self.notices].count("node-left") == times

    def end(self) -> float:
        began = time.monotonic()
        self.stop.set()
        self._thread.join(60)
        assert not self._thread.is_alive()
        return time.monotonic() - began


@pytest.fixture
def port(path: str) -> Iterator[Port]:
    port = open_port(LinkSettings(nfc=path))
    yield port
    port.close()


@pytest.mark.parametrize("tag", ["4", "2"])
def test_each_visit_is_one_contact(start_node: StartNode, port: Port, tag: str) -> None:
    watch = Watch(port, use=lambda contact: print(contact.link.exchange(b"\0\0\x80\x07\0\0")))
    try:
        for number, uuid in enumerate([UUID, OTHER, OTHER], start=1):
            node = start_node(uuid=uuid, tag=tag)
            watch.until(lambda number=number: len(watch.visits) == number)
            time.sleep(0.5)  # it lies there: still one visit
            node.end()
            watch.until(lambda number=number: watch.left(number))
    finally:
        watch.end()
    assert watch.visits == [UUID, OTHER, OTHER]


def test_a_node_that_jitters_on_the_reader_is_one_visit(
    start_node: StartNode, port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_module, "_DEBOUNCE", 10.0)  # the second process may be slow to come
    first = start_node()
    start_node(ready=False)  # the same node, queued: back within 0.2 s
    watch = Watch(port)
    try:
        watch.until(lambda: watch.visits == [UUID])
        first.kill()
        time.sleep(1.5)
        assert watch.visits == [UUID]
        assert watch.left(0)
    finally:
        watch.end()


@pytest.mark.parametrize("lying_there", [False, True])
@pytest.mark.parametrize("tag", ["4", "2"])
def test_stop_is_honoured_at_once(start_node: StartNode, port: Port, tag: str, lying_there: bool) -> None:
    if lying_there:
        start_node(tag=tag)

    def stopped() -> float:
        watch = Watch(port)
        watch.until(lambda: not lying_there or watch.visits == [UUID])
        time.sleep(0.2)
        return watch.end()

    best_of(10, 0.3, stopped, because="the end of a thread, which a busy machine may not run for as long")


def test_a_reader_that_was_killed_leaves_the_node_to_the_next(
    start_node: StartNode, start: Callable[[str, str], Process], path: str, port: Port
) -> None:
    node = start_node()
    station = start("stations", f"hold {path}")
    station.wait_for("holding")
    station.kill()
    contact = port.find(lambda identity: True, seconds=30, notice=lambda notice: None)
    node.wait_for("lost")
    assert contact.link.exchange(b"\x05\x06\x07\x08") == b"\x01\x08\x07\x06\x05"


def test_ctrl_c_ends_the_wait_for_a_tap(start: Callable[[str, str], Process], path: str) -> None:
    station = start("stations", f"wait {path}")
    station.wait_for("waiting")
    station.signal(signal.SIGINT)
    assert station.wait() == 130


@pytest.mark.parametrize(("tag", "kind", "capacity"), [("4", "Type4Tag", 4160), ("2", "Type2Tag", 876)])
def test_any_other_reader_sees_who_the_node_is(
    start_node: StartNode, start: Callable[[str, str], Process], path: str, tag: str, kind: str, capacity: int
) -> None:
    start_node(tag=tag)
    phone = start("stations", f"stock {path}")
    assert phone.wait_for("record").split()[1] == "urn:nfc:wkt:Tp"
    name, payload = phone.wait_for("record").split()[1:]
    assert name == "urn:nfc:ext:teds-provision:id"
    assert payload.startswith("01" + UUID.lower())
    assert phone.wait_for("tag").split()[1:] == [kind, str(capacity)]


def test_the_import_of_nfcpy_leaves_the_program_as_it_was() -> None:
    import subprocess
    import sys

    code = (
        "import logging, warnings; shown = warnings.showwarning\n"
        "import teds_provision.links.nfc.port\n"
        "assert warnings.showwarning is shown\n"
        "assert not logging.getLogger('nfc').isEnabledFor(logging.ERROR)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_the_links_do_not_load_nfcpy_before_a_reader_is_opened() -> None:
    import subprocess
    import sys

    code = "import sys, teds_provision.links, teds_provision.links.nfc.poller; assert 'nfc' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_node_that_still_works_for_a_reader_before_asks_the_next_for_time(
    start_node: StartNode, start: Callable[[str, str], Process], path: str, port: Port
) -> None:
    node = start_node(delay=4.0)
    station = start("stations", f"hold {path}")
    node.wait_for("request 1")
    station.kill()  # no RFOFF: the node does not know yet
    began = time.monotonic()
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    assert time.monotonic() - began > 0.9  # S(WTX) until the command has ended
    assert contact.identity.epoch == 1
    assert contact.link.exchange(b"abcd") == b"\x01dcba"


def test_nonsense_from_the_other_side_is_no_node(path: str, port: Port) -> None:
    rng = random.Random(1451)
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", int(path.rsplit(":", 1)[1])))
        other.settimeout(0.1)

        def babble() -> None:
            while not stop.is_set():
                try:
                    _, address = other.recvfrom(2048)
                except TimeoutError:
                    continue
                octets = rng.randbytes(rng.choice((0, 1, 2, 5, 16, 40)))
                frames = (octets, b"\x44\x00", b"\x08\x01\x02\x03\x08", b"\x20", b"\x00", b"\x06\x78\x80\xb0\x02\x00")
                good = [b"106A " + frame.hex().encode() for frame in frames]
                other.sendto(rng.choice([octets, b"106A", b"106A zz", b"\xff 00", *good * 3]), address)

        thread = threading.Thread(target=babble)
        thread.start()
        try:
            with pytest.raises(NoNodeError):
                port.find(lambda identity: True, seconds=4, notice=lambda notice: None)
        finally:
            stop.set()
            thread.join()


@pytest.mark.parametrize("tag", ["4", "2"])
def test_a_node_serves_after_any_nonsense(start_node: StartNode, path: str, port: Port, tag: str) -> None:
    start_node(tag=tag)
    rng = random.Random(1588)
    starts = [b"\x26", b"\x93\x20", b"\xe0\x80", b"\x02", b"\x03", b"\xb2", b"\xa2", b"\x30\x04", b"\xc2"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        for _ in range(400):
            octets = rng.choice(starts) + rng.randbytes(rng.choice((0, 1, 4, 30)))
            datagram = rng.choice([b"106A " + octets.hex().encode(), octets, b"106A ", b"106A 0", b"212F 00", b""])
            reader.sendto(datagram, ("127.0.0.1", int(path.rsplit(":", 1)[1])))
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    assert contact.link.exchange(b"abcd") == b"\x01dcba"
