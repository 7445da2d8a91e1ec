"""USB readers: opening, unplugging, plugging in again. nfcpy's pn533 driver is real, the chip below it is a mock."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from teds_provision.errors import NoNodeError, NoReaderError, UsageError
from teds_provision.links import LinkSettings, Notice, open_port
from teds_provision.links.nfc import reader
from teds_provision.links.nfc.port import NfcPort
from teds_provision.node.nfc.tags import ATS, IsoDepTag, NdefApplication, Type2Memory, Type4Memory
from teds_provision.node.nfc.tnep import TnepTag
from tests.pace import until

from .conftest import UUID
from .echo_node import Echo
from .pn533_chip import Chip

UID = bytes.fromhex("02112233445566")


@pytest.fixture
def chip(monkeypatch: pytest.MonkeyPatch) -> Chip:
    chip = Chip()
    chip.install(monkeypatch)
    return chip


class Node:
    """An emulated tag on the mock's antenna."""

    def __init__(self, chip: Chip, tag: str) -> None:
        self._chip = chip
        self._memory = Type2Memory(UID) if tag == "2" else Type4Memory(2000)
        self._tnep = TnepTag(self._memory, Echo(bytes.fromhex(UUID), 0.0), wt_int=12, n_wait=15)
        self._card: IsoDepTag | None = None
        self._tnep.start()

    def put_down(self) -> None:
        chip = self._chip
        chip.uid, chip.sak = UID, 0 if isinstance(self._memory, Type2Memory) else 0x20
        chip.polled, chip.answer = self._tnep.activated, self._answer

    def take_away(self) -> None:
        self._chip.answer, self._chip.polled = None, lambda: None

    def close(self) -> None:
        self._tnep.stop()

    def _answer(self, command: bytes) -> bytes | None:
        if isinstance(self._memory, Type2Memory):
            return self._memory.answer(command)
        if command[0] == 0xE0:
            self._card = IsoDepTag(command, NdefApplication(self._memory, self._tnep.ready))
            return ATS
        return self._card.answer(command) if self._card else None


@pytest.fixture
def make_node(chip: Chip) -> Iterator[Callable[[str], Node]]:
    nodes: list[Node] = []

    def make(tag: str = "2") -> Node:
        nodes.append(Node(chip, tag))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.mark.parametrize("tag", ["2", "4"])
@pytest.mark.parametrize("path", ["usb", "usb:04e6", "usb:04e6:5591", "usb:001:005"])
def test_frames_go_over_a_usb_reader(make_node: Callable[[str], Node], chip: Chip, tag: str, path: str) -> None:
    make_node(tag).put_down()
    port = open_port(LinkSettings(nfc=path))
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    assert contact.identity.uuid.hex().upper() == UUID
    for size in (10, 480, 1500):
        assert contact.link.exchange(bytes(range(10)) + bytes(size)) == b"\x01" + bytes(size) + bytes(range(9, -1, -1))
    contact.link.close()
    port.close()


def test_an_empty_field_is_no_busy_loop(chip: Chip) -> None:
    port = open_port(LinkSettings(nfc="usb"))
    chip.commands = 0
    with pytest.raises(NoNodeError):
        port.find(lambda identity: True, seconds=1, notice=lambda notice: None)
    assert chip.commands < 400
    port.close()


def test_a_watch_survives_unplugging_and_plugging_in_elsewhere(make_node: Callable[[str], Node], chip: Chip) -> None:
    node, stop = make_node("2"), threading.Event()
    notices: list[Notice] = []
    visits: list[bytes] = []
    port = open_port(LinkSettings(nfc="usb:001:005"))

    def watch() -> None:
        for contact in port.watch(stop=stop, notice=notices.append):
            visits.append(contact.link.exchange(b"abcd"))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        node.put_down()
        until(lambda: len(visits) == 1)
        chip.plugged = False  # while the node lies on it
        node.take_away()
        until(lambda: "reader-lost" in [notice.kind for notice in notices])
        time.sleep(1.5)
        chip.plugged, chip.number = True, 6
        until(lambda: "reader-ready" in [notice.kind for notice in notices])
        node.put_down()
        until(lambda: len(visits) == 2)
        node.take_away()
        until(lambda: "node-left" in [notice.kind for notice in notices[-3:]])
        chip.plugged = False  # while it waits
        until(lambda: [notice.kind for notice in notices].count("reader-lost") == 2)
    finally:
        stop.set()
        thread.join(60)
        port.close()
    assert visits == [b"\x01dcba"] * 2
    kinds = [notice.kind for notice in notices]
    assert kinds.count("reader-lost") == 2
    assert kinds.count("reader-ready") == 1


def test_unplugging_in_the_middle_of_a_transfer_is_a_reader_error(make_node: Callable[[str], Node], chip: Chip) -> None:
    node = make_node("2")
    node.put_down()
    port = open_port(LinkSettings(nfc="usb"))
    contact = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    answer, left = chip.answer, [20]

    def unplug_after_a_while(command: bytes) -> bytes | None:
        left[0] -= 1
        chip.plugged = left[0] > 0
        return answer(command) if answer else None

    chip.answer = unplug_after_a_while
    with pytest.raises(NoReaderError) as caught:
        contact.link.exchange(bytes(400))
    assert caught.value.exit_code == 5
    contact.link.close()
    with pytest.raises(NoReaderError, match="was unplugged"):
        port.find(lambda identity: True, seconds=0.5, notice=lambda notice: None)
    chip.plugged = True
    node.put_down()
    again = port.find(lambda identity: True, seconds=60, notice=lambda notice: None)
    assert again.link.exchange(b"xy") == b"\x01yx"
    port.close()


@pytest.mark.parametrize(
    ("refuse", "message", "hint"),
    [
        (errno.EACCES, "do not have permission to open", 'ATTRS{idVendor}=="04e6", ATTRS{idProduct}=="5591"'),
        (errno.EBUSY, "in use by pn533_usb", "modprobe -r pn533_usb"),
        (errno.EIO, "cannot be opened", "plug it in again"),
    ],
)
def test_a_reader_that_cannot_be_opened_says_why(chip: Chip, refuse: int, message: str, hint: str) -> None:
    chip.refuse = refuse
    for path in ("usb", "usb:04e6", "usb:04e6:5591"):
        with pytest.raises(NoReaderError) as caught:
            NfcPort(path)
        assert message in caught.value.message
        assert hint in caught.value.hint


def test_without_a_reader_the_known_ones_are_listed(chip: Chip) -> None:
    chip.plugged = False
    with pytest.raises(NoReaderError) as caught:
        NfcPort("usb")
    assert "054c:06c3" in caught.value.hint


def test_without_libusb_its_package_is_named(chip: Chip, monkeypatch: pytest.MonkeyPatch) -> None:
    import nfc.clf.device

    def missing(path: str) -> None:
        raise FileNotFoundError("cannot find a suitable libusb-1.0")

    monkeypatch.setattr(nfc.clf.device.transport.USB, "find", missing)
    with pytest.raises(NoReaderError) as caught:
        NfcPort("usb")
    assert "libusb-1.0-0" in caught.value.hint


def test_auto_takes_the_only_reader_and_names_it(make_node: Callable[[str], Node], chip: Chip) -> None:
    make_node("4")
    port = open_port(LinkSettings())
    notices: list[Notice] = []
    with pytest.raises(NoNodeError):
        port.find(lambda identity: True, seconds=0.3, notice=notices.append)
    assert "usb:04e6:5591" in notices[0].text
    assert port.place == "nfc:usb:04e6:5591"
    port.close()


def test_auto_lists_several_readers(chip: Chip, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_usb_readers", lambda path: [(0x04E6, 0x5591, 1, 5), (0x054C, 0x06C3, 1, 6)])
    with pytest.raises(UsageError, match=r"2 readers are plugged in: usb:001:005, usb:001:006") as caught:
        open_port(LinkSettings(nfc="auto"))
    assert caught.value.exit_code == 2
