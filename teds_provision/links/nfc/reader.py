"""Opening a reader, and the error message if that fails."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path
from typing import Any

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc.nfcpy import Frontend, nfc
from teds_provision.links.nfc.pcsc import PcscReader
from teds_provision.links.nfc.pcsc_readers import PREFIX, paths
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError, ReaderTag, activate, translated
from teds_provision.links.nfc.udp import ReaderDevice, address_of, frontend
from teds_provision.links.ports import Trace

AUTO = "auto"
_PATH = re.compile(r"usb(:[0-9a-fA-F]{4}(:[0-9a-fA-F]{4})?|:\d{1,3}(:\d{1,3})?)?|(tty|com):[^:]+(:\w+)?")
_HOPELESS = 10  # polls in a row that fail with an error of the reader
_NO_LIBUSB = "usb: paths need the C library libusb, which is not installed."


class Reader:
    """An opened reader. ``again`` is the path under which it will come back after it was unplugged."""

    def __init__(self, clf: Any, *, again: str, simulated: bool, trace: Trace | None = None) -> None:
        self._clf = clf
        clf.trace = trace
        self._failures = 0
        self.again = again
        self.name = str(clf.device)
        technologies = ("106A",) if simulated else ("106A", "106B", "212F")
        self._targets = [nfc.clf.RemoteTarget(technology) for technology in technologies]

    def sense(self) -> ReaderTag | None:
        """Poll the field once and activate a tag that is there; takes up to about 0.2 s. Raises ReaderLostError."""
        try:
            with translated():
                target = self._clf.sense(*self._targets, iterations=1)
        except FieldLostError as error:
            self._failures += 1
            if self._failures >= _HOPELESS:
                raise ReaderLostError(error.__cause__) from error
            return None
        self._failures = 0
        return None if target is None else activate(self._clf, target)

    def close(self) -> None:
        """Switch the field off and release the device; never raises."""
        try:
            self._clf.close()
        except Exception:  # noqa: BLE001  (nfcpy's drivers talk to the chip while closing: anything when it is gone)
            self._clf.device = None


def open_reader(path: str, trace: Trace | None = None) -> Reader | PcscReader:
    """Open the reader that ``path`` names: ``udp[:host][:port]``, ``pcsc[:READER]`` or any path of nfcpy.

    Those are ``usb``, ``usb:072f:2200``, ``tty:USB0:pn532``. ``auto`` is the only USB reader, else the only PC/SC
    reader. Raises NoReaderError with the cause and its remedy, UsageError for a malformed path, and if ``auto`` finds
    several. Every frame goes to ``trace``.
    """
    if path == AUTO:
        path = _the_only_one()
    if path.partition(":")[0] == PREFIX:
        return PcscReader(path, trace)
    if path.startswith("udp"):
        device = ReaderDevice(*address_of(path))
        return Reader(frontend(device, path), again=path, simulated=True, trace=trace)
    if not _PATH.fullmatch(path):
        raise UsageError(
            f"{path!r} is not a reader.",
            hint="Use auto, usb, usb:072f:2200, tty:USB0:pn532, pcsc or udp:localhost:54321.",
        )
    if path.startswith("usb"):
        return _open_usb(path, trace)
    try:
        return Reader(Frontend(path), again=path, simulated=False, trace=trace)
    except Exception as error:  # nfcpy and pyserial raise anything
        raise _explained(path, error) from error


def _open_usb(path: str, trace: Trace | None) -> Reader:
    """Open the first reader that can be opened, by its full path: a partial one hides why it fails."""
    failure: NoReaderError | None = None
    for vendor, product, bus, number in _usb_readers(path):
        try:
            clf = Frontend(f"usb:{int(bus):03}:{int(number):03}")
        except Exception as error:  # noqa: BLE001  (nfcpy's drivers raise anything)
            failure = failure or _explained(f"usb:{vendor:04x}:{product:04x}", error, vendor, product)
            continue
        return Reader(clf, again=f"usb:{vendor:04x}:{product:04x}", simulated=False, trace=trace)
    raise failure or NoReaderError(f"No NFC reader was found on {path}.", hint=_candidates())


def _usb_readers(path: str) -> list[tuple[int, int, int, int]]:
    """Return vendor, product, bus and device number of every reader on ``path`` that nfcpy has a driver for."""
    try:
        seen = nfc.clf.transport.USB.find(path) or []
    except FileNotFoundError as error:
        raise NoReaderError(_NO_LIBUSB, hint="On Debian: sudo apt install libusb-1.0-0.") from error
    except Exception as error:  # libusb1 raises its own tree
        raise _explained(path, error) from error
    return [found for found in seen if found[:2] in nfc.clf.device.usb_device_map]


def plugged_in() -> list[str]:
    """Return the paths of the readers that ``auto`` chooses from: USB readers, else those of PC/SC. None is opened."""
    try:
        found = [f"usb:{int(bus):03}:{int(number):03}" for _, _, bus, number in _usb_readers("usb")]
    except NoReaderError:  # without libusb, PC/SC readers still work
        found = []
    return found or paths()


def _the_only_one() -> str:
    """Return the path of the only reader; ``usb`` if there is none, so that the error names what is missing."""
    found = plugged_in()
    if len(found) > 1:
        raise UsageError(
            f"{len(found)} readers are plugged in: {', '.join(found)}.", hint=f"Choose one, e.g. --nfc '{found[0]}'."
        )
    return found[0] if found else "usb"


def _explained(path: str, error: Exception, vendor: int = 0, product: int = 0) -> NoReaderError:
    code = error.errno if isinstance(error, OSError) else None
    if code == errno.EACCES:
        return _forbidden(path, vendor, product)
    if code == errno.EBUSY and vendor:
        return _in_use(path, vendor, product)
    if code in (errno.ENODEV, errno.ENOENT):
        return _absent(path)
    return NoReaderError(f"The reader {path} cannot be opened: {error}.", hint="Unplug it, plug it in again.")


def _forbidden(path: str, vendor: int, product: int) -> NoReaderError:
    if vendor:
        rule = (
            f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}", '
            'TAG+="uaccess", GROUP="plugdev", MODE="0660"'
        )
        return NoReaderError(
            f"You do not have permission to open reader {path}.",
            hint=f"Put this line into /etc/udev/rules.d/70-nfc.rules and plug the reader in again: {rule}",
        )
    return NoReaderError(
        f"You do not have permission to open {path}.", hint="Serial ports: sudo adduser $USER dialout, log in again."
    )


def _in_use(path: str, vendor: int, product: int) -> NoReaderError:
    driver = _kernel_driver(vendor, product)
    return NoReaderError(
        f"Reader {path} is in use by {driver or 'another program'}.",
        hint=f"sudo modprobe -r {driver}; echo blacklist {driver} | sudo tee /etc/modprobe.d/nfc-blacklist.conf"
        if driver
        else "pcscd claims most readers: use it (--nfc pcsc), or stop it: sudo systemctl stop pcscd.socket pcscd.",
    )


def _absent(path: str) -> NoReaderError:
    if path.startswith("tty"):
        return NoReaderError(
            f"No NFC reader answers on the serial line {path}.",
            hint="List the serial lines (ls /dev/ttyUSB* /dev/ttyACM*), and write one like tty:USB0:pn532.",
        )
    return NoReaderError(f"No NFC reader was found on {path}.", hint=_candidates())


def _kernel_driver(vendor: int, product: int) -> str:
    """Return the kernel driver that holds the reader, "" for a program; the usual one if sysfs does not report it."""
    for device in Path("/sys/bus/usb/devices").glob("*"):
        try:
            ids = [int((device / name).read_text(), 16) for name in ("idVendor", "idProduct")]
        except (OSError, ValueError):
            continue
        if ids == [vendor, product]:
            held = {os.path.basename(os.path.realpath(link)) for link in device.glob(f"{device.name}:*/driver")}
            return "" if held == {"usbfs"} else next(iter(held - {"usbfs"}), "")
    return "port100" if (vendor, product) in ((0x054C, 0x06C1), (0x054C, 0x06C3)) else "pn533_usb"


def _candidates() -> str:
    """Describe what was looked for, and which serial ports could have a reader."""
    known = ", ".join(f"{vendor:04x}:{product:04x}" for vendor, product in nfc.clf.device.usb_device_map)
    ports = sorted(path.name.removeprefix("tty") for path in Path("/dev").glob("tty[AU][CMS][AB]*"))
    serial = f" Serial ports here: {', '.join(f'--nfc tty:{port}:pn532' for port in ports)}." if ports else ""
    return f"Plug in a reader that nfcpy knows ({known}) and check with lsusb.{serial}"
