"""Error of a reader that does not open: its name, its holder, the remedy; sysfs and the chip are mocks."""

from __future__ import annotations

import ctypes.util
import errno
import sys
from pathlib import Path
from typing import Any, cast

import pytest

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc import hints, nfcpy, reader, udp
from teds_provision.links.nfc.nfcpy import nfc
from teds_provision.links.nfc.reader import Reader
from teds_provision.links.nfc.tag import ReaderLostError

AGAIN = "Unplug it, plug it in again."
USB, ACR = "usb:054c:06c1", (0x054C, 0x06C1)


def plugged(root: Path, name: str, vendor: str, product: str, **drivers: str) -> None:
    device = root / name
    device.mkdir()
    (device / "idVendor").write_text(f"{vendor}\n")
    (device / "idProduct").write_text(f"{product}\n")
    for interface, driver in drivers.items():
        own = device / f"{name}:{interface.replace('_', '.')}"
        own.mkdir()
        (root.parent / "drivers" / driver).mkdir(parents=True, exist_ok=True)
        (own / "driver").symlink_to(root.parent / "drivers" / driver)


@pytest.fixture
def sysfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    root = tmp_path / "devices"
    root.mkdir()
    real = Path

    def path(text: str) -> Path:
        return root if text == "/sys/bus/usb/devices" else real(text)

    monkeypatch.setattr(reader, "Path", path)
    return root


def test_who_holds_a_reader_is_what_the_kernel_says(sysfs: Path) -> None:
    assert reader._kernel_driver(*ACR) == "port100"
    assert reader._kernel_driver(0x054C, 0x06C3) == "port100"
    assert reader._kernel_driver(0x04CC, 0x2533) == "pn533_usb"
    (sysfs / "usb1").mkdir()  # without ids
    plugged(sysfs, "1-1", "054c", "zzzz", **{"1_0": "usbhid"})
    plugged(sysfs, "1-2", "054c", "06c3", **{"1_0": "usbhid"})
    plugged(sysfs, "1-3", "0541", "06c1", **{"1_0": "usbhid"})
    assert reader._kernel_driver(*ACR) == "port100"
    plugged(sysfs, "1-4", "054c", "06c1", **{"1_0": "pn533_usb"})
    assert reader._kernel_driver(*ACR) == "pn533_usb"
    assert reader._kernel_driver(0x054C, 0x06C3) == "usbhid"


@pytest.mark.parametrize(
    ("drivers", "holder"),
    [({"1_0": "usbfs"}, ""), ({"1_0": "usbfs", "1_1": "port100"}, "port100"), ({}, "")],
)
def test_a_program_holds_a_reader_through_usbfs(sysfs: Path, drivers: dict[str, str], holder: str) -> None:
    plugged(sysfs, "1-4", "054c", "06c1", **drivers)
    assert reader._kernel_driver(*ACR) == holder


def test_a_reader_that_is_held_by_the_kernel_or_a_program_is_given_back_so(sysfs: Path) -> None:
    plugged(sysfs, "1-4", "054c", "06c1", **{"1_0": "port100"})
    held = reader._explained(USB, OSError(errno.EBUSY, "busy"), *ACR)
    assert held.message == "Reader usb:054c:06c1 is in use by port100."
    assert held.hint == "sudo modprobe -r port100; echo blacklist port100 | sudo tee /etc/modprobe.d/nfc-blacklist.conf"
    (sysfs / "1-4" / "1-4:1.0" / "driver").unlink()
    held = reader._explained(USB, OSError(errno.EBUSY, "busy"), *ACR)
    assert held.message == "Reader usb:054c:06c1 is in use by another program."
    assert held.hint == (
        "pcscd claims most readers: use it (--nfc pcsc), or stop it: sudo systemctl stop pcscd.socket pcscd."
    )


@pytest.mark.parametrize(
    ("path", "error", "ids", "words", "hint"),
    [
        (
            USB, OSError(errno.EACCES, "x"), ACR, "You do not have permission to open reader usb:054c:06c1.",
            "Put this line into /etc/udev/rules.d/70-nfc.rules and plug the reader in again: "
            'SUBSYSTEM=="usb", ATTRS{idVendor}=="054c", ATTRS{idProduct}=="06c1", '
            'TAG+="uaccess", GROUP="plugdev", MODE="0660"',
        ),
        (
            "tty:USB0:pn532", OSError(errno.EACCES, "x"), (0, 0), "You do not have permission to open tty:USB0:pn532.",
            "Serial ports: sudo adduser $USER dialout, log in again.",
        ),
        ("tty:USB0:pn532", OSError(errno.EBUSY, "busy"), (0, 0),
         "The reader tty:USB0:pn532 cannot be opened: [Errno 16] busy.", AGAIN),
        (USB, RuntimeError("odd"), ACR, "The reader usb:054c:06c1 cannot be opened: odd.", AGAIN),
        (
            "tty:USB0:pn532", OSError(errno.ENODEV, "x"), (0, 0),
            "No NFC reader answers on the serial line tty:USB0:pn532.",
            "List the serial lines (ls /dev/ttyUSB* /dev/ttyACM*), and write one like tty:USB0:pn532.",
        ),
        (
            "tty:USB0:pn532", OSError(errno.ENOENT, "x"), (0, 0),
            "No NFC reader answers on the serial line tty:USB0:pn532.",
            "List the serial lines (ls /dev/ttyUSB* /dev/ttyACM*), and write one like tty:USB0:pn532.",
        ),
    ],
)  # fmt: skip
def test_a_reader_that_does_not_open_says_why(
    path: str, error: Exception, ids: tuple[int, int], words: str, hint: str
) -> None:
    found = reader._explained(path, error, *ids)
    assert (found.message, found.hint) == (words, hint)


def test_a_reader_that_is_absent_is_looked_for_on_usb_and_serial_ports() -> None:
    found = reader._explained(USB, OSError(errno.ENODEV, "x"), *ACR)
    assert found.message == "No NFC reader was found on usb:054c:06c1."
    assert (found.hint or "").startswith("Plug in a reader that nfcpy knows (")
    assert "054c:06c1" in (found.hint or "")


@pytest.mark.parametrize("error", [RuntimeError("libusb broke"), OSError(errno.EIO, "libusb broke")])
def test_a_library_that_cannot_list_the_readers_is_named(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def find(_path: str) -> None:
        raise error

    monkeypatch.setattr(nfc.clf.transport.USB, "find", find)
    with pytest.raises(NoReaderError) as no:
        reader.open_reader("usb")
    assert no.value.message == f"The reader usb cannot be opened: {error}."


def test_without_libusb_the_readers_of_pc_sc_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(_path: str) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(nfc.clf.transport.USB, "find", find)
    monkeypatch.setattr(reader, "paths", lambda: ["pcsc:ACR122"])
    assert reader.plugged_in() == ["pcsc:ACR122"]
    assert reader._the_only_one() == "pcsc:ACR122"
    monkeypatch.setattr(reader, "paths", lambda: ["pcsc:a", "pcsc:b"])
    with pytest.raises(UsageError) as no:
        reader.open_reader("auto")
    assert no.value.message == "2 readers are plugged in: pcsc:a, pcsc:b."
    assert no.value.hint == "Choose one, e.g. --nfc 'pcsc:a'."
    monkeypatch.setattr(reader, "paths", list)
    assert reader._the_only_one() == "usb"


@pytest.mark.parametrize("path", ["usb:1234:5678:9", "usb:xyz", "tty", "tty::pn532", "bluetooth", "", "usb:1234:"])
def test_what_names_no_reader_is_a_mistake_of_the_caller(path: str) -> None:
    with pytest.raises(UsageError) as no:
        reader.open_reader(path)
    assert no.value.message == f"{path!r} is not a reader."
    assert no.value.hint == "Use auto, usb, usb:072f:2200, tty:USB0:pn532, pcsc or udp:localhost:54321."


class _Chip:
    """A chip whose polls do what the list has."""

    device = "a chip"
    trace = None

    def __init__(self, *polls: Any) -> None:
        self.polls, self.targets = list(polls), list[Any]()

    def sense(self, *targets: Any, iterations: int) -> None:
        assert iterations == 1
        self.targets.append([target.brty for target in targets])
        poll = self.polls.pop(0)
        if poll is not None:
            raise poll

    def close(self) -> None:
        raise OSError("the chip is gone")


def test_ten_polls_in_a_row_that_fail_are_a_lost_reader_and_one_that_succeeds_begins_anew() -> None:
    fault = nfc.clf.TransmissionError("crc")
    chip = _Chip(*[fault] * 9, None, *[fault] * 10)
    made = Reader(cast("Any", chip), again="usb", simulated=False)
    for _ in range(19):
        assert made.sense() is None
    with pytest.raises(ReaderLostError):
        made.sense()
    assert chip.targets[0] == ["106A", "106B", "212F"]
    simulated = Reader(cast("Any", _Chip(None)), again="udp", simulated=True)
    assert simulated.sense() is None
    assert cast("Any", simulated)._clf.targets == [["106A"]]
    made.close()
    assert made._clf.device is None


@pytest.mark.parametrize(
    ("payload", "fields"),
    [
        ("0000000000", {}),
        (
            "12ae0a000500",
            {
                "version": "1.2", "mode": None, "retries": 11, "negotiation_wait": 1, "read_confirmation": 0,
                "read_wait_ms": 2540, "write_timeout_ms": 512, "write_wait_ms": 0,
            },
        ),
        (
            "1001ff01010b",
            {
                "version": "1.0", "mode": None, "retries": 0, "negotiation_wait": 0, "read_confirmation": 1,
                "read_wait_ms": 10, "write_timeout_ms": 64, "write_wait_ms": 10,
            },
        ),
        ("1003ffff0409", {"read_wait_ms": 2540, "write_timeout_ms": 512, "write_wait_ms": 9, "negotiation_wait": 1}),
        ("1044fffe020a", {"read_wait_ms": 2540, "write_timeout_ms": 128, "write_wait_ms": 10, "retries": 1}),
        ("1044fffd000a", {"read_wait_ms": 2530, "write_timeout_ms": 512}),
    ],
)  # fmt: skip
def test_what_a_node_that_can_be_charged_announces(payload: str, fields: dict[str, Any]) -> None:
    """NFC Forum WLC 2.0, WLC_CAP record."""
    found = hints.capability(bytes.fromhex(payload))
    assert bool(found) is bool(fields)
    assert {name: found[name] for name in fields if fields[name] is not None} == {
        name: value for name, value in fields.items() if value is not None
    }


def test_loading_nfcpy_leaves_the_search_for_libraries_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if nfcpy cannot be imported; what other code searches then must be found."""
    find = ctypes.util.find_library
    nfcpy._load()
    assert ctypes.util.find_library is find
    monkeypatch.setitem(sys.modules, "nfc.tag.tt4", None)
    with pytest.raises(ImportError):
        nfcpy._load()
    assert ctypes.util.find_library is find


def test_only_what_nfcpy_has_a_driver_for_is_a_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[Any] = [[(*ACR, 1, 5), (0x1D6B, 0x0002, 1, 1), (0x054C, 0x06C3, 2, 7)], None]
    asked: list[str] = []

    def find(path: str) -> Any:
        asked.append(path)
        return found.pop(0)

    monkeypatch.setattr(nfc.clf.transport.USB, "find", find)
    assert reader._usb_readers("usb") == [(*ACR, 1, 5), (0x054C, 0x06C3, 2, 7)]
    assert reader._usb_readers("usb:001") == []
    assert asked == ["usb", "usb:001"]


@pytest.mark.parametrize(
    ("path", "address"),
    [
        ("udp", ("127.0.0.1", 54321)),
        ("udp:localhost", ("127.0.0.1", 54321)),
        ("udp:127.0.0.1:1", ("127.0.0.1", 1)),
        ("udp::65535", ("127.0.0.1", 65535)),
        ("udp:localhost:65536", "Write udp:localhost:PORT."),
        ("udp:localhost:0", "Write udp:localhost:PORT."),
        ("udp:localhost:1:2", "Write udp:localhost:PORT."),
        ("tcp:localhost:1", "Write udp:localhost:PORT."),
        ("udp:10.0.0.1:1", "Use udp:localhost:PORT; anyone who can reach the port could write to the node."),
    ],
)
def test_the_address_of_a_simulated_reader_has_defaults_and_is_of_this_machine(path: str, address: Any) -> None:
    if isinstance(address, tuple):
        assert udp.address_of(path) == address
        return
    with pytest.raises(UsageError) as no:
        udp.address_of(path)
    assert no.value.hint == address
