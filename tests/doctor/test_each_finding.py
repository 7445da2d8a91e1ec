"""The doctor's findings about readers, buses, Bluetooth, machine and station, word for word, each fault made here."""

from __future__ import annotations

import json
import logging
import os
import socket
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.doctor import checks, fleet, links, machine, station
from teds_provision.doctor.checks import CHECKS, Finding, System, examine, exit_code, intact
from teds_provision.errors import (
    KeyringUnavailableError,
    LinkError,
    NoReaderError,
    NotFoundError,
    StoreChangedError,
    StoreError,
    VaultError,
    WrongPassphraseError,
)
from teds_provision.links.nfc import pcsc_readers
from teds_provision.station.node_keys import deferred
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord, StationRecord, WhitelistEntry
from teds_provision.station.store.row_sample import RowSample

from ..bench import copy_home
from .test_doctor import plug_in


@pytest.fixture
def system(tmp_path: Path) -> System:
    (tmp_path / "system").mkdir()
    return System(tmp_path / "home", workspace=tmp_path, root=tmp_path / "system", environment={})


def one(found: Iterator[Finding]) -> Finding:
    (finding,) = found
    return finding


# -- readers -----------------------------------------------------------------------------------------------------------


def usb(system: System, *, driver: str | None = None) -> Finding:
    vendor, product = next(iter(links.READERS))
    plug_in(system, vendor, product, driver=driver)
    first, *_ = links.readers(system)
    return first


@pytest.mark.parametrize(("nfc", "result"), [(None, "warning"), ("udp:localhost:5", "warning"), ("usb", "failed")])
def test_a_reader_in_use_is_a_failure_only_if_it_was_asked_for(system: System, nfc: str | None, result: str) -> None:
    asked = replace(system, nfc=nfc)
    found = usb(asked, driver="pn533_usb")
    vendor, product = next(iter(links.READERS))
    what = links.READERS[vendor, product]
    assert found == Finding(
        f"reader usb:{vendor:04x}:{product:04x}",
        result,  # type: ignore[arg-type]
        f"{what} is in use by the kernel driver pn533_usb.",
        "sudo modprobe -r pn533_usb; echo blacklist pn533_usb | sudo tee /etc/modprobe.d/nfc-blacklist.conf",
    )


def test_a_reader_that_another_program_has_and_one_that_is_being_unplugged(system: System) -> None:
    vendor, product = next(iter(links.READERS))
    what, name = links.READERS[vendor, product], f"reader usb:{vendor:04x}:{product:04x}"
    assert usb(system, driver="usbfs") == Finding(
        name, "warning", f"{what} is in use by another program.",
        "Stop it; for pcscd: sudo systemctl stop pcscd.socket pcscd",
    )  # fmt: skip
    (system.at("/sys/bus/usb/devices") / "1-2" / "devnum").unlink()
    assert next(links.readers(system)) == Finding(
        name, "warning", f"{what} is being plugged in or removed.", "Run doctor again."
    )


def test_a_reader_that_may_not_be_opened_gets_its_rule(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, how: how != os.R_OK | os.W_OK)
    vendor, product = next(iter(links.READERS))
    found = usb(replace(system, nfc="usb:x"))
    assert found.result == "failed"
    assert found.why == (
        f"You do not have permission to open {links.READERS[vendor, product]} at /dev/bus/usb/001/005 (mode 0666)."
    ) or found.why.endswith(f"at {links._shown(system, system.at('/dev/bus/usb/001/005'))}.")
    assert found.fix == (
        f'echo \'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}", '
        'TAG+="uaccess", GROUP="plugdev", MODE="0660"\' | sudo tee /etc/udev/rules.d/70-nfc.rules, '
        "then plug the reader in again"
    )


def test_the_mode_of_a_device_is_shown_if_it_is_there(system: System) -> None:
    node = system.at("/dev/x")
    node.parent.mkdir(parents=True)
    assert links._shown(system, node) == "/dev/x"
    node.touch()
    node.chmod(0o640)
    assert links._shown(system, node) == "/dev/x (mode 0640)"


@pytest.mark.parametrize(
    ("asked", "names", "result", "why", "fix"),
    [
        (None, ["ACS"], "ok", "Readers: --nfc 'pcsc:ACS'.", ""),
        ("pcsc", ["A", "B"], "ok", "Readers: --nfc 'pcsc:A', --nfc 'pcsc:B'.", ""),
        (None, [], "skipped", "pcscd has no reader.", ""),
        ("usb", [], "skipped", "pcscd has no reader.", ""),
        ("pcsc:ACS", [], "failed", "pcscd has no reader.",
         "Plug it in; pcsc_scan (package pcsc-tools) lists the readers of pcscd"),
        (None, None, "skipped", "No pcscd.", ""),
        ("pcsc", None, "failed", "No pcscd.", "Start it."),
    ],
)  # fmt: skip
def test_readers_of_pcscd(
    system: System, monkeypatch: pytest.MonkeyPatch, asked: str | None, names: Any, result: Any, why: str, fix: str
) -> None:
    def found() -> list[str]:
        if names is None:
            raise NoReaderError("No pcscd.", hint="Start it.")
        return list(names)

    monkeypatch.setattr(pcsc_readers, "names", found)
    monkeypatch.setattr(pcsc_readers, "contactless", lambda found: found)
    here = replace(system, nfc=asked, root=Path("/"))
    assert one(links.pcsc(here)) == Finding("pc/sc", result, why, fix)
    assert one(links.pcsc(system)).why == "These checks are running on another machine's files."


class Reader:
    """A reader with a tag at the sense of this number; 0: none."""

    name = "simulated"

    def __init__(self, tag_at: int, *, lost: bool = False) -> None:
        self.tag_at, self.lost, self.senses, self.closed = tag_at, lost, 0, False

    def sense(self) -> object:
        self.senses += 1
        if self.lost:
            raise links.nfc_tag.ReaderLostError("unplugged")
        return object() if self.senses == self.tag_at else None

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("path", "tag_at", "result", "why", "fix"),
    [
        ("usb", 8, "ok", "simulated on usb opens; there is a tag on it.", ""),
        ("usb", 9, "ok", "simulated on usb opens; there is nothing on it.", ""),
        ("udp:localhost:7", 1, "ok", "simulated on udp:localhost:7 opens; there is a tag on it.", ""),
        ("udp:localhost:7", 0, "warning", "simulated on udp:localhost:7 opens; there is nothing on it.",
         "teds-provision node run DIR --nfc udp:localhost:7"),
    ],
)  # fmt: skip
def test_the_reader_that_was_asked_for(
    system: System, monkeypatch: pytest.MonkeyPatch, path: str, tag_at: int, result: Any, why: str, fix: str
) -> None:
    reader = Reader(tag_at)
    monkeypatch.setattr(links.nfc_reader, "open_reader", lambda _: reader)
    assert one(links.nfc(replace(system, nfc=path))) == Finding("nfc", result, why, fix)
    assert reader.closed


def test_a_reader_that_is_lost_at_once_is_closed(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = Reader(0, lost=True)
    monkeypatch.setattr(links.nfc_reader, "open_reader", lambda _: reader)
    found = one(links.nfc(replace(system, nfc="usb")))
    assert (found.result, found.fix) == ("failed", "Unplug it, plug it in.")
    assert found.why == "simulated opened but failed immediately: The reader no longer answers (unplugged)."
    assert reader.closed
    assert one(links.nfc(system)).result == "skipped"


def test_serial_ports_that_may_not_be_opened_are_named(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    ports = [system.at(f"/dev/tty{name}") for name in ("USB1", "ACM0", "AMA3", "S0")]
    for port in ports:
        port.parent.mkdir(parents=True, exist_ok=True)
        port.touch()
    assert one(links.serial_ports(system)) == Finding("serial ports", "ok", "ttyACM0, ttyAMA3, ttyUSB1 can be opened.")
    monkeypatch.setattr(os, "access", lambda path, how: "USB" not in str(path))
    assert one(links.serial_ports(system)) == Finding(
        "serial ports", "warning", "You do not have permission to open ttyUSB1.",
        "sudo adduser $USER dialout, then log in again",
    )  # fmt: skip


def test_a_loopback_that_is_closed_stops_simulated_readers_alone(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert one(links.nfc_loopback(system)) == Finding("nfc loopback", "ok", "Simulated readers (udp:) work.")

    class Closed(socket.socket):
        def sendto(self, *_: Any) -> int:
            raise OSError(101, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", Closed)
    found = one(links.nfc_loopback(system))
    assert (found.result, found.fix) == ("warning", "sudo ip link set lo up; allow loopback in the firewall")
    assert "Network is unreachable" in found.why


# -- CAN ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "rate", "state", "finding"),
    [
        ("0x40081", 250000, "ERROR-ACTIVE",
         Finding("can can0", "ok", "can0 is up, 250000 bit/s: --can socketcan:can0.")),
        ("0x40081", 0, "", Finding("can can0", "ok", "can0 is up: --can socketcan:can0.")),
        ("0x40080", 250000, "", Finding("can can0", "warning", "can0 is down, 250000 bit/s.",
                                       "sudo ip link set can0 up type can bitrate 250000")),
        ("0x40080", 0, "", Finding("can can0", "warning", "can0 is down.",
                                  "sudo ip link set can0 up type can bitrate 500000")),
        ("0x40081", 125000, "BUS-OFF", Finding(
            "can can0", "warning", "can0 is bus-off, 125000 bit/s.",
            "Check wiring, termination and bit rate; then: sudo ip link set can0 type can restart")),
    ],
)  # fmt: skip
def test_a_can_interface_word_for_word(
    system: System, monkeypatch: pytest.MonkeyPatch, flags: str, rate: int, state: str, finding: Finding
) -> None:
    for name, kind in (("can0", "280"), ("eth0", "1")):
        folder = system.at(f"/sys/class/net/{name}")
        folder.mkdir(parents=True)
        (folder / "type").write_text(f"{kind}\n")
        (folder / "flags").write_text(f"{flags}\n")
    monkeypatch.setattr(links, "_bitrate", lambda *_: (rate, state))
    assert one(links.can_interfaces(system)) == finding


def test_a_kernel_without_can_is_no_trouble(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    for known, text in (
        (True, "no CAN interface"),
        (False, "no CAN (modprobe can can_raw, where its modules are there)"),
    ):
        monkeypatch.setattr(links, "_kernel_can", lambda known=known: known)
        why = f"The kernel has {text}; other interfaces of --can may still work."
        assert one(links.can_interfaces(system)) == Finding("can interfaces", "skipped", why)


@pytest.mark.parametrize(
    ("shown", "found"),
    [
        ([{"linkinfo": {"info_data": {"state": "BUS-OFF", "bittiming": {"bitrate": 500000}}}}], (500000, "BUS-OFF")),
        ([{"linkinfo": {"info_data": {}}}], (0, "")),
        ([{"linkinfo": {}}], (0, "")),
        ([], (0, "")),
        ("no list", (0, "")),
    ],
)
def test_bit_rate_and_state_come_from_ip(
    system: System, monkeypatch: pytest.MonkeyPatch, shown: Any, found: tuple[int, str]
) -> None:
    asked: list[list[str]] = []

    def run(words: list[str], **_: Any) -> Any:
        asked.append(words)
        return SimpleNamespace(stdout=json.dumps(shown).encode())

    monkeypatch.setattr(subprocess, "run", run)
    assert links._bitrate(replace(system, root=Path("/")), "can0") == found
    assert asked == [["ip", "-details", "-json", "link", "show", "can0"]]
    assert links._bitrate(system, "can0") == (0, ""), "another machine's files"
    assert len(asked) == 1


# -- Bluetooth ---------------------------------------------------------------------------------------------------------


def adapter(name: str = "hci0", **changes: Any) -> Any:
    return SimpleNamespace(**{"name": name, "address": "AA:BB", "central": True, "powered": True, "held": 1} | changes)


POWER = "bluetoothctl power on; where that is refused: rfkill unblock bluetooth."


@pytest.mark.parametrize(
    ("asked", "found", "expected"),
    [
        (None, [adapter()], [("ok", "hci0 (AA:BB) is on, central, 1 connection held: --ble hci0.", "")]),
        (None, [adapter(held=4)], [("ok", "hci0 (AA:BB) is on, central, 4 connections held: --ble hci0.", "")]),
        (None, [adapter(held=5)], [("warning", "hci0: 5 connections held; many adapters take 5 to 9.",
         "Disconnect what is not needed (bluetoothctl devices Connected), or add an adapter")]),
        (None, [adapter(central=False)], [("warning", "hci0 has no LE central role.",
         "Use an adapter with Bluetooth 4.0 or later.")]),
        ("", [adapter(central=False)], [("failed", "hci0 has no LE central role.",
         "Use an adapter with Bluetooth 4.0 or later.")]),
        ("hci1", [adapter(powered=False), adapter("hci1", powered=False)],
         [("warning", "hci0 is switched off.", POWER), ("failed", "hci1 is switched off.", POWER)]),
        (None, [], [("skipped", "bluetoothd has no adapter.", "")]),
        ("", [], [("failed", "bluetoothd has no adapter.", "Plug one in; bluetoothctl list")]),
        ("hci7", [adapter(), adapter("hci1")],
         [("failed", "There is no Bluetooth adapter hci7.", "There is hci0, hci1.")]),
    ],
)  # fmt: skip
def test_bluetooth_adapters_word_for_word(
    system: System, monkeypatch: pytest.MonkeyPatch, asked: str | None, found: list[Any], expected: list[Any]
) -> None:
    monkeypatch.setattr(links, "adapters", lambda _: found)
    bus = replace(system, ble=asked, environment={"DBUS_SYSTEM_BUS_ADDRESS": "unix:path=/x"})
    assert [(each.result, each.why, each.fix) for each in links.bluetooth(bus)] == expected
    assert one(links.bluetooth(replace(bus, environment={}))).result == "skipped"


def test_a_blocked_adapter_says_by_what(system: System) -> None:
    assert one(links.switches(system)).why == "The kernel has no Bluetooth adapter."
    (system.at("/sys/class/bluetooth") / "hci0").mkdir(parents=True)
    (system.at("/sys/class/bluetooth") / "hci0:12").mkdir()

    def switch(number: int, kind: str, soft: str, hard: str) -> None:
        folder = system.at(f"/sys/class/rfkill/rfkill{number}")
        folder.mkdir(parents=True)
        for name, text in {"type": kind, "name": f"switch{number}", "soft": soft, "hard": hard}.items():
            (folder / name).write_text(f"{text}\n")

    switch(0, "wlan", "1", "1")
    switch(1, "bluetooth", "0", "0")
    assert one(links.switches(system)) == Finding("bluetooth switches", "ok", "hci0: not blocked.")
    switch(2, "bluetooth", "1", "0")
    switch(3, "bluetooth", "1", "1")
    assert list(links.switches(system)) == [
        Finding("bluetooth switches", "warning", "switch2 is blocked.", "rfkill unblock bluetooth"),
        Finding(
            "bluetooth switches", "warning", "switch3 is turned off by a switch.", "Use the machine's switch or key."
        ),
    ]


# -- the machine -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "numbers"),
    [("1.2.3", (1, 2, 3)), ("8.4.2rc1", (8, 4, 2)), ("2026.1", (2026, 1)), ("1.2.dev3", (1, 2)), ("1.2+x", (1, 2)),
     ("v1", ()), ("1..2", (1,)), ("1.2rc4.5", (1, 2)), ("2.0.dev3.1", (2, 0)), ("1.2+local.7", (1, 2))],
)  # fmt: skip
def test_a_version_is_its_leading_numbers(text: str, numbers: tuple[int, ...]) -> None:
    assert machine._numbers(text) == numbers


@pytest.mark.parametrize(("nfc", "result"), [(None, "warning"), ("udp:x", "warning"), ("usb:x", "failed")])
def test_a_missing_libusb_hinders_usb_readers_alone(
    system: System, monkeypatch: pytest.MonkeyPatch, nfc: str | None, result: str
) -> None:
    tried: list[str] = []

    def load(name: str) -> Any:
        tried.append(name)
        raise OSError

    monkeypatch.setattr(machine.ctypes, "CDLL", load)
    found = one(machine.libusb(replace(system, nfc=nfc)))
    assert (found.result, found.fix) == (result, "sudo apt install libusb-1.0-0")
    assert tried == ["libusb-1.0.so.0", "libusb-1.0.dylib", "libusb-1.0.dll"]
    monkeypatch.setattr(machine.ctypes, "CDLL", lambda name: name)
    assert one(machine.libusb(system)) == Finding("libusb", "ok", "libusb-1.0.so.0 loads.")


@pytest.mark.parametrize(("year", "result"), [(2024, "failed"), (2025, "ok"), (2099, "ok"), (2100, "failed")])
def test_a_clock_shows_a_year_between_2025_and_2099(
    system: System, monkeypatch: pytest.MonkeyPatch, year: int, result: str
) -> None:
    moment = machine.datetime(year, 6, 1, 12, 30, tzinfo=machine.UTC)
    monkeypatch.setattr(machine, "datetime", SimpleNamespace(now=lambda _: moment))
    found = one(machine.clock(system))
    assert found.result == result
    assert found.why == (f"{year}-06-01 12:30 UTC." if result == "ok" else f"The clock is wrong: {year}-06-01.")


@pytest.mark.parametrize(("seconds", "result"), [(120, "ok"), (121, "warning"), (-121, "warning"), (3599, "ok")])
def test_a_hardware_clock_may_run_in_local_time(
    system: System, monkeypatch: pytest.MonkeyPatch, seconds: int, result: str
) -> None:
    clock = system.at("/sys/class/rtc/rtc0/since_epoch")
    clock.parent.mkdir(parents=True)
    clock.write_text(f"{1_780_000_000 + seconds}\n")
    local: Callable[[], Any] = lambda: SimpleNamespace(tm_isdst=0)  # noqa: E731
    monkeypatch.setattr(
        machine, "time", SimpleNamespace(time=lambda: 1_780_000_000.0, timezone=-3600, altzone=-7200, localtime=local)
    )
    found = one(machine.clock(system))
    assert found.result == result
    if result == "warning":
        assert found.why == f"The hardware clock differs from the system's by {seconds} s."


@pytest.mark.parametrize(
    ("results", "code"),
    [
        ([], 0),
        ([("store", "warning"), ("link", "skipped"), ("machine", "ok")], 0),
        ([("machine", "failed")], 1),
        ([("machine", "failed"), ("link", "failed")], 5),
        ([("link", "failed"), ("store", "failed"), ("machine", "failed")], 7),
    ],
)
def test_the_exit_code_is_that_of_the_worst_room(results: list[Any], code: int) -> None:
    assert exit_code([(room, Finding("x", result, "why.")) for room, result in results]) == code


def test_a_part_that_was_checked_says_so() -> None:
    part: Any = SimpleNamespace(sampled=True)
    assert intact("nodes", "all 3", "2 of 3", part) == Finding(
        "nodes", "ok", "2 of 3 (doctor --full checks all).", "", sampled=True
    )
    whole: Any = SimpleNamespace(sampled=False)
    assert intact("nodes", "all 3", "2 of 3", whole) == Finding("nodes", "ok", "all 3.")


# -- the station, word for word ----------------------------------------------------------------------------------------


@pytest.fixture
def stationed(system: System) -> System:
    copy_home(system.home)
    return system


def words(system: System, name: str) -> list[tuple[str, str, str]]:
    """Return result, reason and cure of each finding of one check."""
    if name not in CHECKS:
        list(examine(System(system.home / "nowhere")))
    return [(finding.result, finding.why, finding.fix) for finding in CHECKS[name][1](system)]


def test_an_init_that_was_cut_is_named_with_its_cure(system: System) -> None:
    system.home.mkdir(mode=0o700)
    Station.make(system.home).close()
    assert words(system, "store") == [
        ("warning", "init was started here but not finished.", "teds-provision init")
    ]  # fmt: skip
    assert words(system, "vault") == [("skipped", "There is no station yet.", "teds-provision init")]


def test_a_broken_chain_says_where(stationed: System) -> None:
    with closing(sqlite3.connect(stationed.home / "store.sqlite3")) as connection, connection:
        connection.execute("DROP TRIGGER audit_is_never_changed")
        connection.execute("UPDATE audit SET outcome = 'x' WHERE seq = 1")
    (log,) = (one for one in words(stationed, "store") if "chain" in one[1])
    assert log == (
        "failed",
        "The hash chain is broken: entry 1 was changed, or the one before.",
        "Keep a copy, run teds-provision log, and find out who changed the file.",
    )


@pytest.mark.parametrize(
    ("left", "said"),
    [
        (None, ("ok", "The vault is locked.", "")),
        (754, ("warning", "The vault stays unlocked for 12 min 34 s more, for every process of this user.",
               "teds-provision lock")),
        (0, ("warning", "The vault stays unlocked for 0 min 0 s more, for every process of this user.",
             "teds-provision lock")),
    ],
)  # fmt: skip
def test_how_long_the_vault_stays_open(
    system: System, monkeypatch: pytest.MonkeyPatch, left: int | None, said: tuple[str, str, str]
) -> None:
    monkeypatch.setattr("teds_provision.doctor.station.agent.seconds_left", lambda home: left)
    assert words(system, "unlock") == [said]


def test_a_token_is_there_with_its_file(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    with Station.inspect(stationed.home) as store:
        store.identity.put(StationRecord("bench", "pkcs11:token=bench?module-path=/m.so"))
    monkeypatch.setattr("teds_provision.doctor.station.find_token", lambda uri: SimpleNamespace(label="bench  "))
    with pytest.raises(VaultError, match=r"The file vault-pkcs11\.json is missing") as missing:
        words(stationed, "vault")
    assert missing.value.hint == "teds-provision restore FILE"
    (stationed.home / "vault-pkcs11.json").touch()
    assert words(stationed, "vault") == [("ok", "The token 'bench' is there.", "")]
    assert words(stationed, "keyring") == [("skipped", "Not used by this station.", "")]


def test_a_machine_without_a_keyring_gets_a_passphrase_file(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    for error, fix in (
        (KeyringUnavailableError("There is none.", hint="Start one."), "teds-provision init --keystore file"),
        (VaultError("It is locked.", hint="Unlock it."), "Unlock it."),
    ):
        monkeypatch.setattr("teds_provision.doctor.station.inspect", raising(error))
        assert words(system, "keyring") == [("warning", f"{error.message} init will use a passphrase file.", fix)]
    monkeypatch.setattr("teds_provision.doctor.station.inspect", lambda: "KWallet")
    assert words(system, "keyring") == [("ok", "KWallet.", "")]


def raising(error: Exception) -> Callable[[], str]:
    def fail() -> str:
        raise error

    return fail


def test_settings_are_counted_and_the_first_five_bad_names_shown(system: System) -> None:
    assert words(system, "config") == [("skipped", "There is no config.toml.", "")]
    system.home.mkdir()
    path = system.home / "config.toml"
    told = replace(
        system,
        bad_names=lambda values, _text: [f"line 1: --{name}." for name in values if name != "via"],
        bad_value=lambda values: "via is no link." if "via" in values else "",
    )
    path.write_text("")
    assert words(told, "config") == [("ok", f"{path} contains 0 settings.", "")]
    path.write_text("via = 'x'\n")
    assert words(told, "config") == [("failed", "via is no link.", "Fix that line.")]
    path.write_text("via = 'x'\na = 1\n")
    assert words(told, "config") == [("failed", f"{path}, line 1: --a.", "Fix or remove that line.")]
    five = " ".join(f"line 1: --{name}." for name in "abcde")
    for names, more in (("abcde", ""), ("abcdefg", " And 2 more.")):
        path.write_text("".join(f"{name} = 1\n" for name in names))
        assert words(told, "config") == [("failed", f"{path}, {five}{more}", "Fix these lines.")]
    assert words(system, "config")[0][0] == "ok", "names that nobody knows are no fault"


# -- seals and firmware ------------------------------------------------------------------------------------------------

CHANGED = "Changed by another program and not trusted: "


@pytest.mark.parametrize(
    ("keystore", "asked", "unlocks", "broken", "result", "why"),
    [
        ("file", False, None, 0, "skipped", "Not checked: pins and trust need the vault, and no passphrase was given."),
        ("pkcs11:token=a", False, None, 0, "skipped", "Not checked: pins and trust need the vault, and no passphrase"),
        ("keyring", False, None, 0, "ok", "Pins, trust and the station's own CA are unchanged."),
        ("file", True, None, 0, "ok", "Pins, trust and the station's own CA are unchanged."),
        ("keyring", False, None, 1, "failed", f"{CHANGED}row 0."),
        ("file", True, None, 5, "failed", f"{CHANGED}row 0, row 1, row 2, row 3, row 4."),
        ("file", True, None, 6, "failed", f"{CHANGED}row 0, row 1, row 2, row 3, row 4 …."),
        ("file", True, StoreChangedError("The CA was changed.", hint="Restore."), 0, "failed", "The CA was changed."),
        ("file", True, WrongPassphraseError("Wrong.", hint="Again."), 0, "skipped", "Wrong."),
        ("keyring", False, StoreError("It is locked."), 0, "skipped", "It is locked."),
    ],
)
def test_seals_are_checked_whenever_nobody_has_to_be_asked(
    system: System, monkeypatch: pytest.MonkeyPatch,
    keystore: str, asked: bool, unlocks: Exception | None, broken: int, result: str, why: str,
) -> None:  # fmt: skip
    closed: list[int] = []

    def unlock() -> None:
        if unlocks is not None:
            raise unlocks

    station = SimpleNamespace(
        identity=SimpleNamespace(keystore=keystore), unlock=unlock, close=lambda: closed.append(1),
        row_macs=SimpleNamespace(all_broken=lambda _sample: [f"row {number}" for number in range(broken)]),
    )  # fmt: skip
    monkeypatch.setattr(fleet, "has_store", lambda _home: True)
    monkeypatch.setattr(fleet.Station, "open", lambda _home, *, ask: station)
    finding = one(fleet.seals(replace(system, ask=(lambda _prompt, _confirm: "x") if asked else None)))
    assert (finding.result, finding.why.startswith(why), closed) == (result, True, [1])
    if isinstance(unlocks, StoreChangedError):
        assert finding.fix == "Restore."


def test_firmware_that_needs_an_operator_is_counted_by_node(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    states = ("good", "unjudged", "on-trial", "pending", "old", "not-reported", "other")
    known = {
        bytes([number]): SimpleNamespace(state=state, changed=state in ("good", "old"))
        for number, state in enumerate(states)
    }
    types: list[Any] = []

    def known_firmware(record: Any, demand: Callable[[], object]) -> Any:
        types.append(demand())
        return known.get(record.uuid)

    monkeypatch.setattr(fleet, "known_firmware", known_firmware)
    monkeypatch.setattr(fleet, "FirmwareDemands", lambda _home: SimpleNamespace(demand_of=lambda profile: profile))
    records = [SimpleNamespace(uuid=bytes([number])) for number in range(8)]  # the last one reports nothing
    nodes = {bytes([1]): SimpleNamespace(profile="load-cell")}
    station: Any = SimpleNamespace(
        home=system.home, firmware_reports=SimpleNamespace(all=lambda _sample: iter(records)),
        nodes=SimpleNamespace(get_many=lambda uuids: nodes),
    )  # fmt: skip
    odd, changed = fleet._firmware(station, RowSample(full=True))
    assert (odd, changed) == ([b"\4", b"\5", b"\6"], [b"\0", b"\4"])
    assert types == [None, "load-cell", *[None] * 6]


# -- what the machine does not tell ------------------------------------------------------------------------------------


def unreadable(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Have these files vanish between the listing and the reading."""
    read = Path.read_text

    def read_text(path: Path, *args: Any, **more: Any) -> str:
        if path.name in names and path.parent.name in ("41", "rfkill0", "gone0"):
            raise OSError(3, "No such process")
        return read(path, *args, **more)

    monkeypatch.setattr(Path, "read_text", read_text)


def test_what_vanishes_while_it_is_looked_at_is_passed_over(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, command in (("41", "pcscd"), ("42", "pcscd")):
        (system.at("/proc") / number).mkdir(parents=True)
        (system.at("/proc") / number / "comm").write_text(f"{command}\n")
    for name in ("gone0", "can0", "odd0"):
        folder = system.at(f"/sys/class/net/{name}")
        folder.mkdir(parents=True)
        (folder / "type").write_text("280\n" if name != "odd0" else "what\n")
        (folder / "flags").write_text("0x40081\n")
    for number in range(2):
        folder = system.at(f"/sys/class/rfkill/rfkill{number}")
        folder.mkdir(parents=True)
        for name, text in (("type", "bluetooth"), ("name", f"hci{number}"), ("soft", "1"), ("hard", "0")):
            (folder / name).write_text(f"{text}\n")
    unreadable(monkeypatch, "comm", "type")
    monkeypatch.setattr(links, "_bitrate", lambda *_: (0, ""))
    pcscd = one(links._pcscd(system, found=False))
    assert (pcscd.result, pcscd.fix) == ("ok", ""), "of the other process"
    assert [found.name for found in links.can_interfaces(system)] == ["can can0"]
    blocked = Finding("bluetooth switches", "warning", "hci1 is blocked.", "rfkill unblock bluetooth")
    assert list(links._blocked(system)) == [blocked]


def test_whether_the_kernel_makes_can_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = list[bool]()

    def made(*_: Any) -> Any:
        return SimpleNamespace(close=lambda: closed.append(True))

    monkeypatch.setattr(socket, "socket", made)
    assert (links._kernel_can(), closed) == (True, [True])
    for error in (OSError(97, "Address family not supported"), AttributeError("AF_CAN")):

        def refuses(*_: Any, error: Exception = error) -> Any:
            raise error

        monkeypatch.setattr(socket, "socket", refuses)
        assert not links._kernel_can()


class Bus:
    """A simulated bus; ``lost`` is raised when something is received."""

    def __init__(self, *frames: Any, lost: Exception | None = None) -> None:
        self.frames, self.lost, self.closed = list(frames), lost, 0
        self.spec = SimpleNamespace(source=0xF1, text="udp_multicast:239.74.1.1")

    def send(self, frame: Any) -> None:
        self.frames.append(frame)

    def receive(self, seconds: float) -> Any:
        assert 0 < seconds <= 2
        if self.lost is not None:
            raise self.lost
        return self.frames.pop(0) if self.frames else None

    def close(self) -> None:
        self.closed += 1


def test_a_simulated_bus_that_fails_or_is_silent_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    silent = "A frame sent to a simulated bus was not received."
    route = "sudo ip route add 239.0.0.0/8 dev lo; allow multicast in the firewall"
    good = links.can_bus.Frame(0x18DAF101, b"doctor")
    cases: list[tuple[list[Any], tuple[bool, str, str]]] = [
        ([Bus(), Bus(good)], (True, "", "")),
        ([Bus(), Bus()], (False, silent, route)),
        ([Bus(), Bus(links.can_bus.Frame(0x18DAF101, b"Doctor"))], (False, silent, route)),
        (
            [Bus(), Bus(lost=LinkError("The bus is gone.", hint="Plug it in."))],
            (False, "The bus is gone.", "Plug it in."),
        ),
        ([Bus(), LinkError("No second bus.", hint="One is enough.")], (False, "No second bus.", "One is enough.")),
    ]
    for buses, found in cases:
        rest = list(buses)

        def opened(_spec: Any, rest: list[Any] = rest) -> Any:
            bus = rest.pop(0)
            if isinstance(bus, Exception):
                raise bus
            return bus

        monkeypatch.setattr(links.can_bus, "Bus", opened)
        assert links._self_test("udp_multicast:239.74.1.1") == found
        assert [bus.closed for bus in buses if isinstance(bus, Bus)] == [1] * sum(isinstance(b, Bus) for b in buses)


def test_the_bus_that_was_asked_for_is_listened_to_and_closed(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = replace(system, can="udp_multicast:239.74.1.1")
    clock, seen = iter([0.0, 0.1, 0.2, 99.0]), list[Any]()
    rivals = SimpleNamespace(
        check_frame=seen.append, seen_within=lambda: len(seen) > 1, text="Two of us.", hint="End one."
    )
    monkeypatch.setattr(links.bus_multiplexer, "AddressConflicts", lambda source: rivals if source == 0xF1 else None)

    def looked(bus: Bus, *times: float) -> Finding:
        nonlocal clock
        clock = iter(times)
        seen.clear()
        monkeypatch.setattr(links.can_bus, "Bus", lambda _: bus)
        monkeypatch.setattr(links, "time", SimpleNamespace(monotonic=lambda: next(clock)))
        found = one(links.can(asked))
        assert bus.closed == 1
        return found

    opens = Finding("can", "ok", "udp_multicast:239.74.1.1 opens.")
    assert looked(Bus(), 0.0, 0.1, 99.0) == opens
    assert looked(Bus("a"), 0.0, 0.1, 0.2, 99.0) == opens
    assert seen == ["a"]
    assert looked(Bus("a", "b"), 0.0, 0.1, 0.2, 99.0) == Finding("can", "warning", "Two of us.", "End one.")
    lost = LinkError("The bus is off.", hint="Check the wiring.")
    assert looked(Bus(lost=lost), 0.0, 0.1) == Finding("can", "failed", "The bus is off.", "Check the wiring.")


def test_nobody_is_asked_for_a_passphrase() -> None:
    with pytest.raises(VaultError) as error:
        fleet._nobody("Passphrase")
    assert error.value.message == "doctor never asks for a passphrase."


# -- what is odd about a machine and a station -------------------------------------------------------------------------


def test_a_config_that_cannot_be_read_keeps_the_remedy_of_its_error(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    system.home.mkdir()
    path = system.home / "config.toml"
    path.write_bytes(b"a = '\xff'\n")
    assert words(system, "config") == [("failed", f"{path}:1: the text is not UTF-8.", "Save the file as UTF-8.")]
    path.write_text("a = [")
    [(result, _, fix)] = words(system, "config")
    assert (result, fix) == ("failed", "Fix or remove the file.")


@pytest.mark.parametrize(("count", "shown", "more"), [(1, 1, ""), (5, 5, ""), (6, 5, " …")])
def test_of_nodes_that_wait_five_are_named(
    stationed: System, monkeypatch: pytest.MonkeyPatch, count: int, shown: int, more: str
) -> None:
    uuids = [bytes([number]) * 10 for number in range(count)]
    monkeypatch.setattr(fleet, "_firmware", lambda _station, _sample: (uuids, []))
    found = next(finding for finding in words(stationed, "nodes") if "firmware" in finding[1])
    some = ", ".join(uuid.hex() for uuid in uuids[:shown])
    assert found == (
        "warning",
        f"{count} with firmware that their type does not accept: {some}{more}.",
        "teds-provision update UUID IMAGE",
    )


@pytest.mark.parametrize(("ahead", "result"), [(0, "ok"), (120, "ok"), (121, "failed")])
def test_a_clock_may_be_two_minutes_before_the_last_entry(
    system: System, monkeypatch: pytest.MonkeyPatch, ahead: int, result: str
) -> None:
    now = machine.datetime(2026, 11, 22, 12, 0, tzinfo=machine.UTC)
    last = now + timedelta(seconds=ahead)
    monkeypatch.setattr(machine, "datetime", SimpleNamespace(now=lambda _: now))
    monkeypatch.setattr(machine, "_last_entry", lambda _system: last)
    assert one(machine.clock(system)).result == result


def test_a_time_of_the_log_or_of_the_hardware_that_is_none_is_not_compared(
    stationed: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Station.inspect

    @contextmanager
    def inspect(home: Path) -> Iterator[Any]:
        with real(home):
            yield SimpleNamespace(audit_log=SimpleNamespace(latest=lambda: "yesterday"))

    monkeypatch.setattr(Station, "inspect", inspect)
    assert machine._last_entry(stationed) is None
    clock = stationed.at("/sys/class/rtc/rtc0/since_epoch")
    clock.parent.mkdir(parents=True)
    clock.write_text("never\n")
    assert machine._drift(stationed) is None


def test_half_a_number_of_a_reader_is_one_that_is_being_plugged_in(system: System) -> None:
    vendor, product = next(iter(links.READERS))
    usb(system)
    (system.at("/sys/bus/usb/devices") / "1-2" / "devnum").write_text("\n")
    found = next(links.readers(system))
    assert (found.result, found.fix) == ("warning", "Run doctor again."), (vendor, product)


def test_a_port_that_can_be_read_but_not_written_is_closed(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    port = system.at("/dev/ttyACM0")
    port.parent.mkdir(parents=True)
    port.touch()
    monkeypatch.setattr(os, "access", lambda _path, how: how == os.R_OK)
    assert one(links.serial_ports(system)).why == "You do not have permission to open ttyACM0."


def test_a_process_that_ends_while_pcscd_is_looked_for_is_passed_over(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, name in ((1, "gone"), (2, "pcscd")):
        comm = system.at(f"/proc/{number}/comm")
        comm.parent.mkdir(parents=True)
        comm.write_text(f"{name}\n")
    read = Path.read_text

    def gone(path: Path, *words: Any, **how: Any) -> str:
        if path.parent.name == "1":
            raise ProcessLookupError
        return read(path, *words, **how)

    monkeypatch.setattr(Path, "read_text", gone)
    assert [finding.result for finding in links._pcscd(system, False)] == ["ok"]


@pytest.mark.parametrize("full", [True, False])
def test_a_full_check_looks_at_every_row(stationed: System, monkeypatch: pytest.MonkeyPatch, full: bool) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(Station, "damage", lambda _station, sample: asked.append(sample) or "torn")
    assert words(replace(stationed, full=full), "store") == [
        ("failed", "The store is damaged: torn.", "teds-provision restore FILE")
    ]
    assert [sample is None for sample in asked] == [full]


def test_a_station_without_nodes_needs_no_backup_yet(stationed: System) -> None:
    assert ("ok", "Nothing to back up yet.", "") in words(stationed, "store")


@pytest.mark.parametrize("before", [True, False])
def test_the_log_of_the_keyrings_is_as_it_was(before: bool) -> None:
    logger = logging.getLogger("keyring")
    was, logger.disabled = logger.disabled, before
    try:
        with station._quiet_logging():
            assert logger.disabled
        assert logger.disabled is before
    finally:
        logger.disabled = was


@pytest.mark.parametrize(
    ("content", "result"),
    [
        ({"memory_kib": 19 * 1024}, "The passphrase file exists (Argon2id, 19 MiB)."),
        ({"memory_kib": 19 * 1024 - 1}, "The passphrase file has weak demo settings."),
        ({"memory_kib": "much"}, "The passphrase file has weak demo settings."),
        ({"memory_kib": 19 * 1024, "store": None}, None),
        ({"memory_kib": 19 * 1024, "store": "another"}, None),
    ],
)
def test_a_passphrase_file_is_of_this_store_and_costs_a_guesser_much(
    stationed: System, monkeypatch: pytest.MonkeyPatch, content: dict[str, Any], result: str | None
) -> None:
    with Station.inspect(stationed.home) as opened:
        own = opened.id
    monkeypatch.setattr(station, "read_sealed", lambda _path: {"store": own} | content)
    if result is not None:
        assert station._file_vault(stationed).why == result
        return
    with pytest.raises(VaultError, match=r"^vault\.json belongs to another store\.$"):
        station._file_vault(stationed)


@pytest.mark.parametrize("error", [PermissionError(13, "Permission denied"), NotFoundError("It is gone.")])
def test_a_file_of_keys_that_cannot_be_read_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def refuse(_path: Path) -> None:
        raise error

    monkeypatch.setattr(station, "open_to_read", refuse)
    assert station.holds_private_key(tmp_path / "a.pem") is False


def test_a_check_that_breaks_is_named_with_its_error(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_system: System) -> Iterator[Finding]:
        raise ValueError("odd")
        yield

    def refused(_system: System) -> Iterator[Finding]:
        yield Finding("b", "ok", "First.")
        raise LinkError("It is lost.", hint="Plug it in.")

    monkeypatch.setattr(checks, "CHECKS", {"a": ("machine", broken), "b": ("link", refused)})
    monkeypatch.setattr(checks, "_MODULES", ())
    monkeypatch.setattr(checks, "_OF_ROOMS", SimpleNamespace(parts=list))
    assert list(examine(system)) == [
        ("machine", Finding("a", "failed", "the check itself failed: ValueError: odd.", "Report this.")),
        ("link", Finding("b", "ok", "First.")),
        ("link", Finding("b", "failed", "It is lost.", "Plug it in.")),
    ]


@pytest.mark.parametrize(("sampled", "among"), [(False, ""), (True, " (of the 5,000 keyed last)")])
def test_what_waits_for_a_person_has_its_remedy(
    stationed: System, monkeypatch: pytest.MonkeyPatch, sampled: bool, among: str
) -> None:
    one, two = bytes(10), bytes([1]) * 10
    tally = SimpleNamespace(overdue=[one], twice=[one, two], drafts=[two], unverified=[one], rotations=[one, two])
    later = deferred(datetime(2099, 1, 1, tzinfo=UTC), "station lost was removed")

    def waiting(day: str, sample: RowSample) -> Any:
        assert datetime.fromisoformat(day).strftime("%Y-%m-%d") == day
        sample.sampled = sampled
        return tally

    @contextmanager
    def inspect(_home: Path) -> Iterator[Any]:
        yield SimpleNamespace(
            overview=SimpleNamespace(waiting=waiting),
            keys=SimpleNamespace(rotations_due=lambda: {one: "restored", two: later}),
        )

    monkeypatch.setattr(Station, "inspect", inspect)
    monkeypatch.setattr(fleet, "_firmware", lambda _station, _sample: ([], [two]))
    first, second = one.hex(), two.hex()
    expected = [
        ("warning", f"1 with an expired calibration: {first}.", "teds-provision nodes --due 0"),
        ("warning", f"2 with a name that another node has{among}: {first}, {second}.",
         "Give them different names: build UUID --name, sign, write"),
        ("warning", f"1 with a datasheet that was built but not written: {second}.", "teds-provision draft list"),
        ("warning", f"1 keyed but never verified{among}: {first}.", "teds-provision verify UUID"),
        ("warning", f"1 whose firmware changed since calibration: {second}.",
         "Calibrate again, or: verify UUID --accept-firmware"),
        ("warning", f"1 whose key must be rotated: {first}.", "Open a session once: teds-provision verify UUID"),
        ("warning", f"1 whose key another holder rotates first: {second}.",
         "Wait for its copy; verify UUID does it from 2099-01-01T00:00:00Z on"),
    ]  # fmt: skip
    part = "names, verdicts and firmware were looked at of the 5,000 nodes keyed last and of some others"
    found = words(stationed, "nodes")
    assert found[:7] == expected
    assert found[7:] == ([("ok", f"N{part[1:]} (doctor --full checks all).", "")] if sampled else [])


def test_every_reader_that_is_plugged_in_is_looked_at(system: System) -> None:
    first, second, *_ = links.READERS
    devices = system.at("/sys/bus/usb/devices")
    for name, (vendor, product) in (("1-3", second), ("1-2", first), ("1-1", (0x1D6B, 2))):
        (devices / name).mkdir(parents=True)
        (devices / name / "idVendor").write_text(f"{vendor:04x}\n")
        (devices / name / "idProduct").write_text(f"{product:04x}\n")
    names = [f"reader usb:{vendor:04x}:{product:04x}" for vendor, product in (first, second)]
    assert [(found.name, found.fix) for found in links.readers(system)] == [
        (name, "Run doctor again.") for name in names
    ]
    assert one(links.readers(replace(system, root=system.root / "none"))) == Finding(
        "nfc readers", "skipped", f"None of the {len(links.READERS)} USB readers that nfcpy supports is plugged in."
    )


@pytest.mark.parametrize(
    ("version", "result"), [((3, 10, 9), "failed"), ((3, 11, 0), "ok"), ((3, 12, 1), "ok"), ((4, 0, 0), "ok")]
)
def test_python_is_new_enough_from_3_11_on(
    system: System, monkeypatch: pytest.MonkeyPatch, version: tuple[int, ...], result: Any
) -> None:
    shown = ".".join(map(str, version))
    monkeypatch.setattr(machine, "sys", SimpleNamespace(version_info=version))
    monkeypatch.setattr(machine, "platform", SimpleNamespace(python_version=lambda: shown, platform=lambda: "Linux-6"))
    fix = "" if result == "ok" else "Install Python 3.11 or newer and recreate the virtual environment."
    assert one(machine.python(system)) == Finding("python", result, f"Python {shown} on Linux-6.", fix)


def test_home_and_disk_word_for_word(stationed: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = stationed.home
    assert words(replace(stationed, home=tmp_path / "none"), "home") == [
        ("skipped", f"There is no station in {tmp_path / 'none'} yet.", "teds-provision init")
    ]
    home.chmod(0o700)
    for name in ("vault.json", "store.sqlite3"):
        (home / name).chmod(0o604)
    assert words(stationed, "home") == [
        ("ok", f"{home} is private to this user.", ""),
        ("failed", "Other users can read store.sqlite3, vault.json.",
         f"chmod 600 {home / 'store.sqlite3'} {home / 'vault.json'}"),
    ]  # fmt: skip
    home.chmod(0o755)
    assert words(stationed, "home")[0] == ("warning", f"Other users can read {home}.", f"chmod 700 {home}")
    home.chmod(0o777)
    assert words(stationed, "home")[0] == ("failed", f"Other users can write to {home}.", f"chmod 700 {home}")
    monkeypatch.setattr(os, "geteuid", lambda: home.stat().st_uid + 1)
    assert words(stationed, "home")[0][2] == f"sudo chown -R $USER {home}, or use another --home"
    for free, found in (
        ((65 << 20) - 1, ("ok", f"64 MiB free at {home}.", "")),
        ((64 << 20) - 1, ("warning", f"63 MiB free at {home}.",
                          "Free some space: a full disk stops every command that changes something.")),
    ):  # fmt: skip
        monkeypatch.setattr(station.shutil, "disk_usage", lambda _path, free=free: SimpleNamespace(free=free))
        assert words(stationed, "disk") == [found]


def test_a_vault_in_the_keyring_is_named_as_the_keyring_names_it(
    stationed: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Station.inspect(stationed.home) as store:
        store.identity.put(StationRecord("bench", "keyring"))
        own = store.id
    opened = SimpleNamespace(open=lambda store_id: SimpleNamespace(description=f"KWallet, {store_id}"))
    monkeypatch.setattr(station, "KeyringVault", opened)
    assert words(stationed, "vault") == [("ok", f"KWallet, {own}.", "")]


@pytest.mark.parametrize(
    ("octets", "holds"),
    [
        (b"PuTTY-User-Key-File-3: ssh-ed25519\n", True),
        (b"\x30" + bytes(43) + b"\x02\x01\x00\x30", True),
        (b"\x30" + bytes(44) + b"\x02\x01\x00\x30", False),  # of a larger structure
        (b'{"kty": "EC", "k": "AA"}', True),
        (b'{"kty": "EC", "d" : "AA"}', True),
        (b"", False),
    ],
)
def test_which_octets_are_a_private_key(tmp_path: Path, octets: bytes, holds: bool) -> None:
    (tmp_path / "a").write_bytes(octets)
    assert station.holds_private_key(tmp_path / "a") is holds


def test_seals_that_are_broken_or_not_checked_have_their_remedy(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[str] = []

    def all_broken(sample: RowSample) -> list[str]:
        sample.sampled = True
        return found

    opened = SimpleNamespace(
        identity=SimpleNamespace(keystore="file"), unlock=lambda: None, close=lambda: None,
        row_macs=SimpleNamespace(all_broken=all_broken),
    )  # fmt: skip
    monkeypatch.setattr(fleet, "has_store", lambda _home: True)
    monkeypatch.setattr(fleet.Station, "open", lambda _home, *, ask: opened)
    asked = replace(system, ask=lambda _prompt, _confirm: "x")
    unchanged = "Pins, trust and the station's own CA are unchanged"
    assert one(fleet.seals(asked)) == Finding(
        "seals", "ok",
        f"{unchanged}, of each large table the newest and 5,000 random rows (doctor --full checks all).", "",
        sampled=True,
    )  # fmt: skip
    assert one(fleet.seals(system)).fix == "teds-provision --passphrase-fd 3 doctor 3<FILE"
    found.append("pin 8d4d")
    assert one(fleet.seals(asked)).fix == (
        "Remove them (whitelist remove, trust remove), find out who changed the file, and add them again."
    )
    for error, result in ((WrongPassphraseError("Wrong.", hint="Again."), "skipped"),
                          (StoreChangedError("Changed.", hint="Restore."), "failed")):  # fmt: skip
        monkeypatch.setattr(opened, "unlock", raising(error))
        assert one(fleet.seals(asked)) == Finding("seals", result, error.message, error.hint)  # type: ignore[arg-type]


def test_a_store_is_summed_up_and_a_bus_that_was_not_asked_for_is_named(stationed: System, tmp_path: Path) -> None:
    with Station.inspect(stationed.home) as store:
        store.nodes.restore(NodeRecord(bytes(10)))
        store.pins.restore([WhitelistEntry(bytes([number]) * 10, "ab" * 32) for number in range(2)])
    assert words(stationed, "store")[0] == ("ok", "Intact; 1 node, 2 whitelisted.", "")
    assert words(replace(stationed, home=tmp_path / "none"), "store") == [
        ("skipped", "There is no station yet.", "teds-provision init")
    ]
    assert words(stationed, "can") == [
        ("skipped", "No bus was given, so none was opened.", "teds-provision doctor --can socketcan:can0")
    ]
