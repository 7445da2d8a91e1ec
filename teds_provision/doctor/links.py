"""The doctor's checks of readers and buses: from sysfs and the file system, opening only what was requested.

A partial path such as ``usb`` hides why a reader does not
open, so each one is checked separately.
"""

from __future__ import annotations

import json
import os
import socket
import stat
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.doctor.checks import Finding, Result, System, check
from teds_provision.errors import LinkError, NoReaderError, UsageError
from teds_provision.lazy import late
from teds_provision.links.ble.ble_errors import POWER_HINT
from teds_provision.links.ble.bluez import AdapterFacts, adapters
from teds_provision.links.ble.spec import BleSpec, parse_spec
from teds_provision.links.can import bus as can_bus
from teds_provision.links.can import spec as can_spec
from teds_provision.links.nfc import pcsc_readers
from teds_provision.links.nfc.usb_listing import READERS, usb_ids
from teds_provision.links.ports import free_port

if TYPE_CHECKING:
    from teds_provision.links.can import bus_multiplexer
    from teds_provision.links.nfc import reader as nfc_reader
    from teds_provision.links.nfc import tag as nfc_tag
else:
    # Loaded only if such a link was given: nfcpy, pyserial, and the code for shared buses.
    bus_multiplexer = late("teds_provision.links.can.bus_multiplexer")
    nfc_reader, nfc_tag = late("teds_provision.links.nfc.reader"), late("teds_provision.links.nfc.tag")

_ARPHRD_CAN: Final = 280  # linux/if_arp.h
_IFF_UP: Final = 1
_SENSES: Final = 8
_LISTEN_SECONDS: Final = 0.5


@check("nfc readers", "link")
def readers(system: System) -> Iterator[Finding]:
    """Check every USB reader that nfcpy knows: this user's permission, and other users of the reader.

    A fault of one is a failure only if a USB reader was requested.
    """
    found = False
    for device in sorted(system.at("/sys/bus/usb/devices").glob("*")):
        ids = usb_ids(device)
        if ids not in READERS:
            continue
        found = True
        yield _reader(system, device, ids)
    if not found:
        yield Finding(
            "nfc readers", "skipped", f"None of the {len(READERS)} USB readers that nfcpy supports is plugged in."
        )
    yield from _pcscd(system, found)


def _reader(system: System, device: Path, ids: tuple[int, int]) -> Finding:
    vendor, product = ids
    name = f"reader usb:{vendor:04x}:{product:04x}"
    what = READERS[ids]
    bad: Result = "failed" if (system.nfc or "").startswith("usb") else "warning"
    try:
        bus, number = (int((device / part).read_text()) for part in ("busnum", "devnum"))
    except (OSError, ValueError):
        return Finding(name, "warning", f"{what} is being plugged in or removed.", "Run doctor again.")
    node = system.at(f"/dev/bus/usb/{bus:03}/{number:03}")
    held = {os.path.basename(os.path.realpath(link)) for link in device.parent.glob(f"{device.name}:*/driver")}
    driver = next(iter(held - {"usbfs"}), None)
    if driver is not None:
        fix = f"sudo modprobe -r {driver}; echo blacklist {driver} | sudo tee /etc/modprobe.d/nfc-blacklist.conf"
        return Finding(name, bad, f"{what} is in use by the kernel driver {driver}.", fix)
    if "usbfs" in held:
        fix = "Stop it; for pcscd: sudo systemctl stop pcscd.socket pcscd"
        return Finding(name, bad, f"{what} is in use by another program.", fix)
    if not os.access(node, os.R_OK | os.W_OK):
        rule = (
            f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}", '
            'TAG+="uaccess", GROUP="plugdev", MODE="0660"'
        )
        fix = f"echo '{rule}' | sudo tee /etc/udev/rules.d/70-nfc.rules, then plug the reader in again"
        return Finding(name, bad, f"You do not have permission to open {what} at {_shown(system, node)}.", fix)
    return Finding(name, "ok", f"{what} at {_shown(system, node)}: --nfc usb:{vendor:04x}:{product:04x}.")


def _pcscd(system: System, found: bool) -> Iterator[Finding]:
    for name in system.at("/proc").glob("[0-9]*/comm"):
        try:
            running = name.read_text().strip() == "pcscd"
        except OSError:
            continue
        if running:
            yield Finding(
                "pcscd",
                "warning" if found else "ok",
                "pcscd is running and claims the ACR122U and other readers; use them with --nfc pcsc.",
                "sudo systemctl stop pcscd.socket pcscd, or use --nfc pcsc" if found else "",
            )
            return


@check("pc/sc", "link")
def pcsc(system: System) -> Iterator[Finding]:
    """Report the PC/SC readers of pcscd; a failure only if one was requested."""
    asked = (system.nfc or "").partition(":")[0] == "pcsc"
    if system.root != Path("/"):
        yield Finding("pc/sc", "skipped", "These checks are running on another machine's files.")
        return

    try:
        found = pcsc_readers.contactless(pcsc_readers.names())
    except NoReaderError as failure:
        yield Finding("pc/sc", "failed" if asked else "skipped", failure.message, failure.hint if asked else "")
        return
    if found:
        paths = ", ".join(f"--nfc 'pcsc:{name}'" for name in found)
        yield Finding("pc/sc", "ok", f"Readers: {paths}.")
    else:
        fix = "Plug it in; pcsc_scan (package pcsc-tools) lists the readers of pcscd" if asked else ""
        yield Finding("pc/sc", "failed" if asked else "skipped", "pcscd has no reader.", fix)


@check("serial ports", "machine")
def serial_ports(system: System) -> Iterator[Finding]:
    """Check that this user may open the serial ports that a reader or a CAN adapter could be behind."""
    ports = sorted(path for kind in ("USB", "ACM", "AMA") for path in system.at("/dev").glob(f"tty{kind}*"))
    if not ports:
        yield Finding("serial ports", "skipped", "There is no serial port that a reader could use.")
        return
    closed = [port.name for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        why = f"You do not have permission to open {', '.join(closed)}."
        yield Finding("serial ports", "warning", why, "sudo adduser $USER dialout, then log in again")
    else:
        yield Finding("serial ports", "ok", f"{', '.join(port.name for port in ports)} can be opened.")


@check("nfc loopback", "machine")
def nfc_loopback(system: System) -> Iterator[Finding]:
    """Do datagrams reach this machine's own loopback: simulated readers need nothing else."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.settimeout(2)
        try:
            receiver.bind(("127.0.0.1", 0))
            sender.sendto(b"doctor", receiver.getsockname())
            arrived = receiver.recv(16) == b"doctor"
        except OSError as error:
            fix = "sudo ip link set lo up; allow loopback in the firewall"
            yield Finding("nfc loopback", "warning", f"Simulated readers cannot work: {error}.", fix)
            return
    yield Finding("nfc loopback", "ok" if arrived else "warning", "Simulated readers (udp:) work.")


@check("nfc", "link")
def nfc(system: System) -> Iterator[Finding]:
    """Open the requested reader, and check what is on it."""
    if system.nfc is None:
        yield Finding("nfc", "skipped", "No reader was given, so none was opened.", "teds-provision doctor --nfc usb")
        return

    try:
        reader = nfc_reader.open_reader(system.nfc)
    except (NoReaderError, UsageError) as failure:
        yield Finding("nfc", "failed", failure.message, failure.hint)
        return
    try:
        tag = any(reader.sense() is not None for _ in range(_SENSES))
    except nfc_tag.ReaderLostError as error:
        why = f"{reader.name} opened but failed immediately: {error.message}"
        yield Finding("nfc", "failed", why, "Unplug it, plug it in.")
        return
    finally:
        reader.close()
    lies = "there is a tag on it" if tag else "there is nothing on it"
    fix = "" if tag or not system.nfc.startswith("udp") else f"teds-provision node run DIR --nfc {system.nfc}"
    yield Finding("nfc", "ok" if tag or not fix else "warning", f"{reader.name} on {system.nfc} opens; {lies}.", fix)


@check("can interfaces", "machine")
def can_interfaces(system: System) -> Iterator[Finding]:
    """Check every CAN interface of the kernel: that it is up, and its bit rate."""
    found = False
    for interface in sorted(system.at("/sys/class/net").glob("*")):
        try:
            kind, flags = int((interface / "type").read_text()), int((interface / "flags").read_text(), 16)
        except (OSError, ValueError):
            continue
        if kind != _ARPHRD_CAN:
            continue
        found = True
        name, up = f"can {interface.name}", bool(flags & _IFF_UP)
        rate, state = _bitrate(system, interface.name)
        at = f", {rate} bit/s" if rate else ""
        if not up:
            fix = f"sudo ip link set {interface.name} up type can bitrate {rate or 500000}"
            yield Finding(name, "warning", f"{interface.name} is down{at}.", fix)
        elif state == "BUS-OFF":
            fix = f"Check wiring, termination and bit rate; then: sudo ip link set {interface.name} type can restart"
            yield Finding(name, "warning", f"{interface.name} is bus-off{at}.", fix)
        else:
            yield Finding(name, "ok", f"{interface.name} is up{at}: --can socketcan:{interface.name}.")
    if not found:
        text = "no CAN interface" if _kernel_can() else "no CAN (modprobe can can_raw, where its modules are there)"
        yield Finding("can interfaces", "skipped", f"The kernel has {text}; other interfaces of --can may still work.")


def _kernel_can() -> bool:
    """Return True if the kernel makes CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def _bitrate(system: System, name: str) -> tuple[int, str]:
    """Return bit rate (0: unknown) and state from ``ip``; sysfs has neither."""
    if system.root != Path("/"):
        return 0, ""
    words = ["ip", "-details", "-json", "link", "show", name]
    try:
        shown = json.loads(subprocess.run(words, capture_output=True, timeout=5, check=True).stdout)
        data: dict[str, Any] = shown[0]["linkinfo"]["info_data"]
        return int(data.get("bittiming", {}).get("bitrate", 0)), str(data.get("state", ""))
    except (OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError):
        return 0, ""


@check("can loopback", "machine")
def can_loopback(system: System) -> Iterator[Finding]:
    """Do frames of a simulated bus come back, without leaving this machine (hop limit 0)."""
    channel = f"239.74.{os.getpid() >> 8 & 255}.{os.getpid() & 255 or 1}"
    arrived, why, fix = _self_test(f"udp_multicast:{channel}?hop_limit=0&port={free_port()}")
    text = "Simulated buses (udp_multicast:) work." if arrived else why
    yield Finding("can loopback", "ok" if arrived else "warning", text, fix)


def _self_test(spec: str) -> tuple[bool, str, str]:
    sent = can_bus.Frame(0x18DAF101, b"doctor")
    buses: list[can_bus.Bus] = []
    try:
        for _ in range(2):  # one after the other: if the second one fails, the first one is closed
            buses.append(can_bus.Bus(can_spec.parse_spec(spec)))
        buses[0].send(sent)
        arrived = buses[1].receive(2.0) == sent
    except LinkError as failure:
        return False, failure.message, failure.hint
    finally:
        for bus in buses:
            bus.close()
    why = "" if arrived else "A frame sent to a simulated bus was not received."
    return arrived, why, "" if arrived else "sudo ip route add 239.0.0.0/8 dev lo; allow multicast in the firewall"


@check("can", "link")
def can(system: System) -> Iterator[Finding]:
    """Open the bus that was asked for; listen a moment for errors, and for another station of our address."""
    if system.can is None:
        yield Finding(
            "can", "skipped", "No bus was given, so none was opened.", "teds-provision doctor --can socketcan:can0"
        )
        return

    try:
        bus = can_bus.Bus(can_spec.parse_spec(system.can))
    except (LinkError, UsageError) as failure:
        yield Finding("can", "failed", failure.message, failure.hint)
        return
    rivals = bus_multiplexer.AddressConflicts(bus.spec.source)
    until = time.monotonic() + _LISTEN_SECONDS
    try:
        while (left := until - time.monotonic()) > 0:
            frame = bus.receive(left)
            if frame is not None:
                rivals.check_frame(frame)
    except LinkError as failure:
        yield Finding("can", "failed", failure.message, failure.hint)
        return
    finally:
        bus.close()
    if rivals.seen_within():
        yield Finding("can", "warning", rivals.text, rivals.hint)
    else:
        yield Finding("can", "ok", f"{bus.spec.text} opens.")


def _shown(system: System, node: Path) -> str:
    shown = f"/{node.relative_to(system.root)}"
    try:
        return f"{shown} (mode {stat.S_IMODE(node.stat().st_mode):04o})"
    except OSError:
        return shown


# Checks around Bluetooth: adapters, switches, the service, roles and connections.
#
# Nothing is opened and no connection is made; a fault is a failure only if BLE was requested.

_BLUETOOTH: Final = "bluetooth"
_MANY: Final = 5
"""Connections from which on many adapters take no more (notes in docs/hardware.md)."""


@check("bluetooth switches", "machine")
def switches(system: System) -> Iterator[Finding]:
    """Check that the kernel knows a Bluetooth adapter, and that neither rfkill nor a switch blocks it."""
    found = sorted(path.name for path in system.at("/sys/class/bluetooth").glob("hci*") if ":" not in path.name)
    if not found:
        yield Finding("bluetooth switches", "skipped", "The kernel has no Bluetooth adapter.")
        return
    blocked = list(_blocked(system))
    yield from blocked
    if not blocked:
        yield Finding("bluetooth switches", "ok", f"{', '.join(found)}: not blocked.")


def _blocked(system: System) -> Iterator[Finding]:
    for switch in sorted(system.at("/sys/class/rfkill").glob("rfkill*")):
        try:
            kind, name = (switch / "type").read_text().strip(), (switch / "name").read_text().strip()
            soft, hard = ((switch / side).read_text().strip() == "1" for side in ("soft", "hard"))
        except OSError:
            continue
        if kind != "bluetooth" or not (soft or hard):
            continue
        if hard:
            yield Finding(
                "bluetooth switches",
                "warning",
                f"{name} is turned off by a switch.",
                "Use the machine's switch or key.",
            )
        else:
            yield Finding("bluetooth switches", "warning", f"{name} is blocked.", "rfkill unblock bluetooth")


@check(_BLUETOOTH, "link")
def bluetooth(system: System) -> Iterator[Finding]:
    """Check system bus, bluetoothd and its adapters: power, central role, connections that are held."""
    if system.root != Path("/") and "DBUS_SYSTEM_BUS_ADDRESS" not in system.environment:
        yield Finding(_BLUETOOTH, "skipped", "These checks are running on another machine's files.")
        return
    asked = system.ble is not None
    try:
        spec = parse_spec(system.ble or "")
        found = adapters(system.environment.get("DBUS_SYSTEM_BUS_ADDRESS"))
        _require(found, spec)
    except (NoReaderError, UsageError) as failure:
        yield Finding(_BLUETOOTH, "failed" if asked else "skipped", failure.message, failure.hint if asked else "")
        return
    for adapter in found:
        yield _adapter(adapter, spec, asked=asked)


def _require(found: list[AdapterFacts], spec: BleSpec) -> None:
    """Raise NoReaderError if there is no adapter, or not the one that was named."""
    if not found:
        raise NoReaderError("bluetoothd has no adapter.", hint="Plug one in; bluetoothctl list")
    if spec.adapter is not None and spec.adapter not in {adapter.name for adapter in found}:
        named = ", ".join(adapter.name for adapter in found)
        raise NoReaderError(f"There is no Bluetooth adapter {spec.adapter}.", hint=f"There is {named}.")


def _adapter(facts: AdapterFacts, spec: BleSpec, *, asked: bool) -> Finding:
    name = f"{_BLUETOOTH} {facts.name}"
    bad: Result = "failed" if asked and spec.adapter in (None, facts.name) else "warning"
    if not facts.central:
        return Finding(
            name, bad, f"{facts.name} has no LE central role.", "Use an adapter with Bluetooth 4.0 or later."
        )
    if not facts.powered:
        return Finding(name, bad, f"{facts.name} is switched off.", POWER_HINT)
    held = f"{facts.held} connection{'' if facts.held == 1 else 's'} held"
    if facts.held >= _MANY:
        fix = "Disconnect what is not needed (bluetoothctl devices Connected), or add an adapter"
        return Finding(name, "warning", f"{facts.name}: {held}; many adapters take 5 to 9.", fix)
    return Finding(name, "ok", f"{facts.name} ({facts.address}) is on, central, {held}: --ble {facts.name}.")
