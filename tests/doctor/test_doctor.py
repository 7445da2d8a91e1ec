"""The doctor: machines with every trouble that readers, buses, stores and clocks are known for."""

from __future__ import annotations

import json
import os
import re
import sqlite3
import time
import tomllib
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import teds_provision.links
from teds_provision import teds
from teds_provision.doctor import checks
from teds_provision.doctor import machine as doctor_machine
from teds_provision.doctor.checks import CHECKS, Finding, System, examine, exit_code
from teds_provision.doctor.station import holds_private_key
from teds_provision.lazy import REQUIRED, install_command
from teds_provision.links.nfc.usb_listing import READERS
from teds_provision.protocol.keys import SoftwareKey, to_pem
from teds_provision.station.node_keys import deferred
from teds_provision.station.station import Station
from teds_provision.station.store import row_sample
from teds_provision.station.store.database import Database
from teds_provision.station.store.lock import StoreLock
from teds_provision.station.store.records import Draft, KeyFlags, KeyRecord, NodeRecord, StationRecord, WhitelistEntry
from teds_provision.station.store.store import Store
from teds_provision.teds.image import Image
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, copy_home
from tests.places import free_bus, free_reader


@pytest.fixture
def system(tmp_path: Path) -> System:
    """Return a machine without any hardware, and no station."""
    (tmp_path / "system").mkdir()
    (tmp_path / "work").mkdir()
    return System(tmp_path / "home", workspace=tmp_path / "work", root=tmp_path / "system", environment={})


@pytest.fixture
def stationed(system: System) -> Iterator[System]:
    forget_vaults()
    copy_home(system.home)
    yield system
    forget_vaults()


def look(system: System, name: str) -> list[Finding]:
    """Return what one check finds."""
    if name not in CHECKS:  # each of its modules has its own; who examines loads them all
        list(examine(System(system.home / "nowhere")))
    return list(CHECKS[name][1](system))


def by_name(system: System) -> dict[str, Finding]:
    return {finding.name: finding for _, finding in examine(system)}


def plug_in(system: System, vendor: int, product: int, *, driver: str | None = None, node: bool = True) -> None:
    """A USB device as sysfs and devfs show it."""
    devices = system.at("/sys/bus/usb/devices")
    device, interface = devices / "1-2", devices / "1-2:1.0"
    device.mkdir(parents=True)
    interface.mkdir()
    texts = {"idVendor": f"{vendor:04x}", "idProduct": f"{product:04x}", "busnum": "1", "devnum": "5"}
    for name, text in texts.items():
        (device / name).write_text(text + "\n")
    if driver is not None:
        target = system.at(f"/sys/bus/usb/drivers/{driver}")
        target.mkdir(parents=True)
        (interface / "driver").symlink_to(target)
    if node:
        file = system.at("/dev/bus/usb/001/005")
        file.parent.mkdir(parents=True)
        file.touch(mode=0o666)


def test_a_machine_without_anything_has_no_failure(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SESSION_BUS_ADDRESS", f"unix:path={system.home}/no-bus")
    found = list(examine(system))
    assert exit_code(found) == 0
    assert [finding for _, finding in found if finding.result == "failed"] == []
    assert all(finding.why.endswith((".", ")")) for _, finding in found)
    assert not system.home.exists()


@pytest.mark.needs_room("plant")
def test_the_registry_holds_every_check(system: System) -> None:
    list(examine(system))
    machine = ["python", "libraries", "argon2id", "libusb", "clock"]
    links = ["nfc readers", "pc/sc", "serial ports", "nfc loopback", "nfc", "can interfaces", "can loopback", "can"]
    links += ["bluetooth switches", "bluetooth"]
    station = [
        "home",
        "disk",
        "store",
        "keyring",
        "vault",
        "unlock",
        "keys folder",
        "store file",
        "nodes",
        "registry",
        "seals",
        "config",
        "profiles",
    ]
    assert sorted(CHECKS) == sorted(machine + links + station)


# -- readers -----------------------------------------------------------------------------------------------------------


def test_the_known_readers_are_those_of_nfcpy() -> None:
    from teds_provision.links.nfc.nfcpy import nfc

    assert set(READERS) == set(nfc.clf.device.usb_device_map)


def test_the_shipped_udev_rules_have_a_line_for_each_of_them() -> None:
    rules = (Path(teds_provision.links.__file__).parent / "nfc" / "70-teds-provision-nfc.rules").read_text()
    found = re.findall(r'^ATTR\{idVendor\}=="(....)", ATTR\{idProduct\}=="(....)", TAG', rules, re.MULTILINE)
    assert {(int(vendor, 16), int(product, 16)) for vendor, product in found} == set(READERS)


def test_a_free_reader_is_named_with_its_path(system: System) -> None:
    plug_in(system, 0x054C, 0x06C3)
    (reader,) = look(system, "nfc readers")
    assert (reader.name, reader.result) == ("reader usb:054c:06c3", "ok")
    assert "/dev/bus/usb/001/005" in reader.why
    assert "--nfc usb:054c:06c3" in reader.why


@pytest.mark.parametrize(("ids", "driver"), [((0x04E6, 0x5591), "pn533_usb"), ((0x054C, 0x06C1), "port100")])
def test_a_kernel_driver_that_holds_a_reader_is_named_with_its_removal(
    system: System, ids: tuple[int, int], driver: str
) -> None:
    plug_in(system, *ids, driver=driver)
    (reader,) = look(system, "nfc readers")
    assert (reader.result, driver in reader.why) == ("warning", True)
    assert f"modprobe -r {driver}" in reader.fix
    (asked,) = look(System(system.home, nfc="usb", root=system.root), "nfc readers")
    assert asked.result == "failed"


def test_a_reader_that_this_user_may_not_open_gets_its_udev_rule(system: System) -> None:
    plug_in(system, 0x072F, 0x2200, node=False)
    (reader,) = look(system, "nfc readers")
    assert reader.result == "warning"
    assert 'ATTRS{idVendor}=="072f", ATTRS{idProduct}=="2200"' in reader.fix
    assert 'TAG+="uaccess"' in reader.fix


def test_pcscd_is_a_trouble_only_beside_a_reader(system: System) -> None:
    comm = system.at("/proc/123/comm")
    comm.parent.mkdir(parents=True)
    comm.write_text("pcscd\n")
    assert [finding.result for finding in look(system, "nfc readers")] == ["skipped", "ok"]
    plug_in(system, 0x072F, 0x2200, driver="usbfs")
    reader, pcscd = look(system, "nfc readers")
    assert "in use by another program" in reader.why
    assert (pcscd.result, "systemctl stop pcscd" in pcscd.fix) == ("warning", True)


def test_other_usb_devices_are_none_of_ours(system: System) -> None:
    plug_in(system, 0x1D6B, 0x0002)
    assert [finding.result for finding in look(system, "nfc readers")] == ["skipped"]


def test_serial_ports_are_listed(system: System) -> None:
    system.at("/dev").mkdir()
    system.at("/dev/ttyUSB0").touch()
    (ports,) = look(system, "serial ports")
    assert (ports.result, "ttyUSB0" in ports.why) == ("ok", True)
    system.at("/dev/ttyACM0").symlink_to("gone")  # as good as closed, also to root
    (ports,) = look(system, "serial ports")
    assert (ports.result, "dialout" in ports.fix) == ("warning", True)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("udp:10.0.0.1:54321", "loopback"),
        ("nonsense", "is not a reader"),
        ("tty:NONE7:pn532", ""),
    ],
)
def test_a_reader_that_was_asked_for_and_does_not_open_is_exit_5(system: System, path: str, words: str) -> None:
    asked = System(system.home, nfc=path, root=system.root, workspace=system.workspace)
    (reader,) = look(asked, "nfc")
    assert (reader.result, words in reader.why) == ("failed", True)
    assert reader.fix
    assert exit_code([("link", reader)]) == 5


def test_an_empty_simulated_reader_says_how_to_put_a_node_on_it(system: System) -> None:
    path = free_reader()
    (reader,) = look(System(system.home, nfc=path, root=system.root), "nfc")
    assert (reader.result, f"--nfc {path}" in reader.fix) == ("warning", True)


# -- buses -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("flags", "result"), [("0x40081", "ok"), ("0x40080", "warning")])
def test_a_can_interface_of_the_kernel_is_up_or_gets_its_command(system: System, flags: str, result: str) -> None:
    for name, kind in (("can0", "280"), ("eth0", "1")):
        folder = system.at(f"/sys/class/net/{name}")
        folder.mkdir(parents=True)
        (folder / "type").write_text(kind + "\n")
        (folder / "flags").write_text(flags + "\n")
    (interface,) = look(system, "can interfaces")
    assert (interface.name, interface.result) == ("can can0", result)
    assert ("ip link set can0 up type can bitrate 500000" in interface.fix) is (result == "warning")


def test_frames_of_a_simulated_bus_come_back(system: System) -> None:
    (loopback,) = look(system, "can loopback")
    assert (loopback.result, loopback.fix) == ("ok", "")


@pytest.mark.parametrize("spec", ["socketcan:can99", "nonsense", "nosuch:can0", "socketcand:can0?port=1"])
def test_a_bus_that_was_asked_for_and_does_not_open_is_exit_5(system: System, spec: str) -> None:
    asked = System(system.home, can=spec, root=system.root)
    (bus,) = look(asked, "can")
    assert bus.result == "failed"
    assert bus.fix


def test_a_bus_that_was_asked_for_opens(system: System) -> None:
    spec = free_bus()
    (bus,) = look(System(system.home, can=spec), "can")
    assert (bus.result, bus.why) == ("ok", f"{spec.partition('?')[0]} opens.")


# -- the machine -------------------------------------------------------------------------------------------------------


def test_the_versions_asked_for_are_those_of_the_project() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]  # nfcpy brings ndeflib, tests name it
    declared = dict(text.partition(";")[0].split(">=") for text in wanted if ">=" in text)
    assert {text.split(">=")[0] for text in project["dependencies"]} == REQUIRED.keys()
    assert {name: declared[name] for name in doctor_machine._LIBRARIES} == doctor_machine._LIBRARIES


def test_a_missing_an_old_and_a_shadowing_library_are_reported(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    real = metadata.version

    def version(name: str) -> str:
        if name == "msgpack":
            raise metadata.PackageNotFoundError(name)
        return {"nfcpy": "0.13.5", "ndef": "0.2"}.get(name) or real(name)

    monkeypatch.setattr(metadata, "version", version)
    libraries, ndeflib = look(system, "libraries")
    assert libraries.result == "failed"
    assert "msgpack is missing, nfcpy 0.13.5 (needs 1.0.4)" in libraries.why
    assert libraries.fix == install_command("nfcpy>=1.0.4", "msgpack>=1.0")
    assert (ndeflib.result, "pip uninstall --yes ndef" in ndeflib.fix) == ("failed", True)


def test_a_clock_that_went_back_is_reported(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    assert look(stationed, "clock")[0].result == "ok"
    monkeypatch.setattr("teds_provision.station.store.audit.utc_now", lambda: "2099-01-01T00:00:00Z")
    with Store.open(stationed.home) as store:
        store.audit.append("test", None, "done")
    (clock,) = look(stationed, "clock")
    assert (clock.result, "before the last audit log entry" in clock.why) == ("failed", True)
    monkeypatch.undo()
    with Store.open(stationed.home) as store:
        store.audit.append("test", None, "done")
    assert look(stationed, "clock")[0].result == "ok", "an entry was made since the clock was set right"


@pytest.mark.parametrize(("ahead", "result"), [(0, "ok"), (86_000, "warning"), (-86_000, "warning")])
def test_a_hardware_clock_that_differs_is_reported(system: System, ahead: int, result: str) -> None:
    clock = system.at("/sys/class/rtc/rtc0/since_epoch")
    clock.parent.mkdir(parents=True)
    clock.write_text(f"{int(time.time()) + ahead}\n")
    assert look(system, "clock")[0].result == result


def test_a_check_that_breaks_is_a_finding_and_the_others_run(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(system: System) -> Iterator[Finding]:
        raise OSError("a library fell over")
        yield

    list(examine(system))
    monkeypatch.setitem(checks.CHECKS, "clock", ("machine", broken))
    found = by_name(system)
    assert (found["clock"].result, "fell over" in found["clock"].why) == ("failed", True)
    assert "keys folder" in found
    assert exit_code(list(examine(system))) == 1


# -- the station -------------------------------------------------------------------------------------------------------


def test_a_healthy_station_has_nothing_that_failed(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SESSION_BUS_ADDRESS", f"unix:path={stationed.home}/no-bus")
    found = by_name(stationed)
    for name in ("home", "store", "audit log", "backup", "lock", "disk"):
        assert found[name].result == "ok", found[name]
    assert found["keyring"].result == "skipped"
    assert (found["vault"].result, "weak demo settings" in found["vault"].why) == ("warning", True)


def test_a_home_open_to_others_gets_its_chmod(stationed: System) -> None:
    stationed.home.chmod(0o777)
    assert [(finding.result, finding.fix) for finding in look(stationed, "home")] == [
        ("failed", f"chmod 700 {stationed.home}")
    ]
    stationed.home.chmod(0o755)
    (stationed.home / "vault.json").chmod(0o644)
    home, files = look(stationed, "home")
    assert (home.result, files.result) == ("warning", "failed")
    assert f"chmod 600 {stationed.home / 'vault.json'}" in files.fix


def test_a_damaged_store_and_a_broken_chain_are_exit_7(stationed: System) -> None:
    with closing(sqlite3.connect(stationed.home / "store.sqlite3")) as connection, connection:
        connection.execute("DROP TRIGGER audit_is_never_changed")
        connection.execute("UPDATE audit SET outcome = 'x'")
    log = next(finding for finding in look(stationed, "store") if finding.name == "audit log")
    assert (log.result, exit_code([("store", log)])) == ("failed", 7)
    for end in ("-wal", "-shm"):
        (stationed.home / f"store.sqlite3{end}").unlink(missing_ok=True)
    (stationed.home / "store.sqlite3").write_bytes(b"no database" * 1000)
    found = list(examine(stationed))
    store = next(finding for _, finding in found if finding.name == "store")
    assert (store.result, "restore" in store.fix) == ("failed", True)
    assert exit_code(found) == 7


def test_who_holds_the_store_is_named(stationed: System) -> None:
    with StoreLock(stationed.home, command="provision"):
        lock = next(finding for finding in look(stationed, "store") if finding.name == "lock")
    assert lock.result == "warning"
    assert re.fullmatch(rf"The store is locked by pid {os.getpid()} \(provision\) since [0-9T:-]+Z\.", lock.why), (
        lock.why
    )
    lock = next(finding for finding in look(stationed, "store") if finding.name == "lock")
    assert (lock.result, lock.why) == ("ok", "The store is not locked.")


def test_a_lost_passphrase_file_is_reported_without_asking_for_anything(stationed: System) -> None:
    (stationed.home / "vault.json").unlink()
    vault = by_name(stationed)["vault"]
    assert (vault.result, "restore" in vault.fix) == ("failed", True)


@pytest.mark.parametrize(
    ("memory", "result"), [(19 * 1024, "ok"), (19 * 1024 - 1, "warning"), ("much", "warning"), (None, "warning")]
)
def test_a_passphrase_file_that_costs_a_guesser_little_is_a_warning(
    stationed: System, memory: object, result: str
) -> None:
    path = stationed.home / "vault.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "memory_kib": memory}))
    (vault,) = (finding for finding in look(stationed, "vault"))
    assert (vault.result, "19 MiB" in vault.why) == (result, result == "ok")


def test_a_passphrase_file_of_another_store_is_a_failure(stationed: System) -> None:
    path = stationed.home / "vault.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "store": "77" * 16}))
    vault = by_name(stationed)["vault"]
    assert (vault.result, vault.why, "restore" in vault.fix) == (
        "failed", "vault.json belongs to another store.", True,
    )  # fmt: skip


def test_nodes_without_a_backup_are_a_warning(stationed: System) -> None:
    with Station.inspect(stationed.home) as store:
        store.nodes.restore(NodeRecord(bytes(10)))
    backup = next(finding for finding in look(stationed, "store") if finding.name == "backup")
    assert (backup.result, backup.fix) == ("warning", "teds-provision backup FILE")
    with Station.inspect(stationed.home) as store:
        store.audit("backup", None, "done")
    assert next(finding for finding in look(stationed, "store") if finding.name == "backup").result == "ok"


@pytest.mark.parametrize(
    ("ages", "result", "why"),
    [
        ((0,), "ok", "The last backup is 0 days old."),
        ((1,), "ok", "The last backup is 1 day old."),
        ((90,), "ok", "The last backup is 90 days old."),
        ((91,), "warning", "The last backup is 91 days old."),
        ((400, 5), "ok", "The last backup is 5 days old."),
        ((-1,), "ok", "The last backup is 0 days old."),
    ],
)
def test_a_backup_is_old_after_90_days_and_the_last_one_counts(
    stationed: System, monkeypatch: pytest.MonkeyPatch, ages: tuple[int, ...], result: str, why: str
) -> None:
    for days in ages:
        at = (datetime.now(UTC) - timedelta(days=days, minutes=1)).strftime("%Y-%m-%dT%H:%M:%SZ")
        with monkeypatch.context() as patch, Station.inspect(stationed.home) as store:
            patch.setattr("teds_provision.station.store.audit.utc_now", lambda at=at: at)
            store.audit("backup", None, "done")
    (backup,) = (finding for finding in look(stationed, "store") if finding.name == "backup")
    fix = "" if result == "ok" else "teds-provision backup FILE"
    assert (backup.result, backup.why, backup.fix) == (result, why, fix)


def test_a_backup_of_a_clock_that_was_ahead_is_a_warning(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, Station.inspect(stationed.home) as store:
        patch.setattr("teds_provision.station.store.audit.utc_now", lambda: "2099-01-01T00:00:00Z")
        store.audit("backup", None, "done")
    (backup,) = (finding for finding in look(stationed, "store") if finding.name == "backup")
    assert (backup.result, backup.why, backup.fix) == (
        "warning",
        "The last backup is dated 2099-01-01T00:00:00Z, in the future.",
        "Check the clock, then: teds-provision backup FILE",
    )


@pytest.mark.parametrize(("free", "result"), [(64 << 20, "ok"), ((64 << 20) - 1, "warning")])
def test_a_disk_with_less_than_64_mib_is_a_warning(
    system: System, monkeypatch: pytest.MonkeyPatch, free: int, result: str
) -> None:
    """A home that is not there yet is made in the folder above it."""
    asked: list[Path] = []

    def usage(path: Path) -> SimpleNamespace:
        asked.append(path)
        return SimpleNamespace(free=free)

    monkeypatch.setattr("teds_provision.doctor.station.shutil.disk_usage", usage)
    (disk,) = look(replace(system, home=system.home / "below" / "it"), "disk")
    assert (disk.result, disk.fix != "", asked) == (result, result != "ok", [system.home.parent])


def test_a_home_of_another_user_is_a_warning(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 4711)
    stationed.home.chmod(0o777)
    home, *_ = look(stationed, "home")
    assert (home.result, home.why) == ("warning", f"{stationed.home} belongs to another user.")


@pytest.mark.parametrize(
    ("mode", "result"),
    [(0o700, "ok"), (0o720, "failed"), (0o702, "failed"), (0o740, "warning"), (0o704, "warning"), (0o710, "warning"),
     (0o701, "warning")],
)  # fmt: skip
def test_a_home_is_closed_to_the_group_and_to_all_others(stationed: System, mode: int, result: str) -> None:
    stationed.home.chmod(mode)
    assert look(stationed, "home")[0].result == result


@pytest.mark.parametrize(
    ("name", "named"), [("store.sqlite3", True), ("vault-pkcs11.json", True), ("config.toml", False)]
)
@pytest.mark.parametrize("mode", [0o640, 0o604])
def test_the_store_and_the_vault_are_closed_to_others_and_settings_need_not_be(
    stationed: System, name: str, named: bool, mode: int
) -> None:
    path = stationed.home / name
    path.touch()
    path.chmod(mode)
    found = {finding.name: finding for finding in look(stationed, "home")}
    assert ("files" in found and name in found["files"].why) is named


def test_a_station_whose_keyring_is_gone_is_a_failure(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DBUS_SESSION_BUS_ADDRESS", f"unix:path={stationed.home}/no-bus")
    with Station.inspect(stationed.home) as store:
        store.identity.put(StationRecord("bench", "keyring"))
    found = by_name(stationed)
    assert (found["keyring"].result, found["vault"].result) == ("failed", "failed")
    monkeypatch.setenv("PYTHON_KEYRING_BACKEND", "keyring.backends.null.Keyring")
    assert "null" in by_name(stationed)["keyring"].why


def test_a_token_whose_module_is_missing_is_a_failure(stationed: System) -> None:
    with Station.inspect(stationed.home) as store:
        store.identity.put(StationRecord("bench", "pkcs11:token=bench?module-path=/nowhere/module.so"))
    vault = by_name(stationed)["vault"]
    assert (vault.result, "module" in vault.why) == ("failed", True)


# -- keys/ -------------------------------------------------------------------------------------------------------------


def private_keys() -> dict[str, bytes]:
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    key = ec.generate_private_key(ec.SECP256R1())
    plain = NoEncryption()
    return {
        "pkcs8.pem": key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, plain),
        "sec1.pem": key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, plain),
        "pkcs8.der": key.private_bytes(Encoding.DER, PrivateFormat.PKCS8, plain),
        "sec1.der": key.private_bytes(Encoding.DER, PrivateFormat.TraditionalOpenSSL, plain),
        "ssh": key.private_bytes(Encoding.PEM, PrivateFormat.OpenSSH, plain),
        "key.jwk": b'{"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA", "d": "AA"}',
        "shared.jwk": b'{"kty": "oct", "k": "AA"}',
    }


@pytest.mark.parametrize("name", ["pkcs8.pem", "sec1.pem", "pkcs8.der", "sec1.der", "ssh", "key.jwk", "shared.jwk"])
def test_a_private_key_in_the_keys_folder_is_found_in_every_form(system: System, name: str) -> None:
    folder = system.workspace / "keys" / "stations"
    folder.mkdir(parents=True)
    (folder / "bench.pem").write_text(to_pem(SoftwareKey.generate().point))
    (folder.parent / "README.md").write_text("Public keys only.\n")
    (folder / "public.jwk").write_bytes(b'{"kty": "EC", "crv": "P-256", "x": "AA", "y": "AA"}')
    (folder / "words.json").write_bytes(b'{"d": 1, "k": 2}')
    (folder / "certificate.der").write_bytes(b"\x30\x82\x01\x02\x30\x81\xa9\x02\x01\x02")
    (folder / "other.bin").write_bytes(b"\x31\x02\x01\x00\x30\x02\x01\x01\x04\x20")
    (folder / "gone.pem").symlink_to(folder / "nothing.pem")
    assert look(system, "keys folder")[0].result == "ok"
    (folder / name).write_bytes(private_keys()[name])
    (keys,) = look(system, "keys folder")
    assert (keys.result, f"keys/stations/{name}" in keys.why) == ("failed", True)


def test_the_keys_folder_of_this_project_holds_no_private_key() -> None:
    folder = Path(__file__).parents[2] / "keys"
    assert folder.is_dir()
    assert [path for path in folder.rglob("*") if path.is_file() and holds_private_key(path)] == []


# -- the fleet ---------------------------------------------------------------------------------------------------------


def test_a_broken_config_is_reported_and_the_rest_is_still_looked_at(stationed: System) -> None:
    (stationed.home / "config.toml").write_text("home = [")
    found = by_name(stationed)
    assert (found["config"].result, found["store"].result) == ("failed", "ok")
    assert "not valid TOML" in found["config"].why


def test_keys_that_no_command_knows_are_named(stationed: System) -> None:
    def bad_names(values: dict[str, Any], text: str) -> list[str]:
        assert text == (stationed.home / "config.toml").read_text()
        return [f"line 1: {name} is none." for name in values if name != "via"]

    system = replace(stationed, bad_names=bad_names)
    (stationed.home / "config.toml").write_text("via = 'nfc'\n")
    assert by_name(system)["config"].result == "ok"
    (stationed.home / "config.toml").write_text("vai = 'nfc'\n[provisoin]\n")
    config = by_name(system)["config"]
    assert (config.result, "line 1: vai is none. line 1: provisoin is none." in config.why) == ("failed", True)


def test_profiles_of_this_home_alone_are_checked(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    """One in the working folder is of somebody else, and is refused where it is used."""
    assert look(system, "profiles")[0].result == "skipped"
    own, others = system.home / "profiles", system.workspace / "profiles"
    monkeypatch.setattr(teds.profile, "default_folders", lambda home: (own, others))
    for folder in (own, others):
        folder.mkdir(parents=True)
    (own / "mine.toml").write_text("title = 'x'\nchannel = {}\n")
    (others / "theirs.toml").write_text("no TOML")
    (found,) = look(system, "profiles")
    assert "theirs" not in found.why
    (own / "broken.toml").write_text("no TOML")
    broken = look(system, "profiles")
    assert {finding.result for finding in broken} == {"failed"}
    assert "Cannot use profile broken" in broken[0].why
    assert not any("theirs" in finding.why for finding in broken)


@pytest.mark.parametrize("vault", ["vault.json", "vault-pkcs11.json", None])
def test_a_store_that_is_gone_beside_its_vault_is_a_failure(stationed: System, vault: str | None) -> None:
    (stationed.home / "store.sqlite3").unlink()
    if vault is None:
        (stationed.home / "vault.json").unlink()
        assert "store file" not in by_name(stationed)
        return
    (stationed.home / "vault.json").rename(stationed.home / vault)
    found = by_name(stationed)["store file"]
    assert (found.result, "restore" in found.fix) == ("failed", True)


def test_what_waits_for_a_person_is_reported(stationed: System) -> None:
    assert look(stationed, "nodes")[0].result == "ok"
    with Station.inspect(stationed.home) as store:
        for number in range(3):
            store.nodes.restore(NodeRecord(bytes([number]) * 10, name="same" if number else "other", due="2020-01-01"))
        store.datasheets.keep_draft(Draft(bytes(10), Image(bytes(10), {(0, 1): b"x"})))
        store.keys.add(KeyRecord(bytes(10), 1, "ab" * 8, "active", 1, b"wrapped"))
        later = [deferred(datetime(2099, 1, day, tzinfo=UTC), "station lost was removed") for day in (2, 1, 3)]
        store.keys.put_flags({b"\1" * 10: KeyFlags(rotation="restored")})
        over = deferred(datetime(2020, 1, 1, tzinfo=UTC), "station lost was removed")  # its holder did not come
        store.keys.put_flags({b"\7" * 10: KeyFlags(rotation=over)})
        store.keys.put_flags({bytes([2 + n]) * 10: KeyFlags(rotation=why) for n, why in enumerate(later)})
    found = look(stationed, "nodes")
    reasons = [finding.why for finding in found]
    counts = [why.split()[0] for why in reasons]
    assert counts == ["3", "2", "1", "1", "2", "3"]
    words = ("expired", "name", "not written", "never verified", "must be rotated", "another holder rotates first")
    for why, word in zip(reasons, words, strict=True):
        assert word in why
    assert found[-2].fix.startswith("Open a session once")
    assert "2099-01-01T00:00:00Z" in found[-1].fix, "the first of them: a session today would change nothing"


def test_seals_are_checked_if_the_passphrase_is_given(stationed: System) -> None:
    assert look(stationed, "seals")[0].result == "skipped"
    forget_vaults()
    system = replace(stationed, ask=lambda prompt, confirm: PASSPHRASE)
    assert look(system, "seals")[0].result == "ok"
    with Station.inspect(stationed.home) as store:
        store.pins.restore([WhitelistEntry(bytes(10), "ab" * 32)])
    found = look(system, "seals")[0]
    assert (found.result, bytes(10).hex() in found.why) == ("failed", True)


@pytest.fixture
def crowded(stationed: System, monkeypatch: pytest.MonkeyPatch) -> System:
    """Return a station with more nodes and entries of its log than a check reads of each table by default."""
    monkeypatch.setattr(row_sample, "SAMPLED", 20)
    monkeypatch.setattr(row_sample, "_NEWEST", 3)
    monkeypatch.setattr(row_sample, "_RUN", 5)
    forget_vaults()
    with Station.open(stationed.home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.unlock()
        for number in range(60):
            station.pins.put(WhitelistEntry(bytes([number]) * 10, f"{number:064x}"))
            station.keys.add(KeyRecord(bytes([number]) * 10, 1, "ab" * 8, "active", 1, b"wrapped"))
            station.audit("verify", bytes([number]) * 10, "authentic")
    return replace(stationed, ask=lambda prompt, confirm: PASSPHRASE)


def changed_in(home: Path, *statements: str) -> None:
    """Change the store as another program would."""
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection, connection:
        connection.execute("DROP TRIGGER IF EXISTS audit_is_never_changed")
        connection.execute("DROP TRIGGER IF EXISTS audit_is_never_shortened")
        connection.execute("PRAGMA ignore_check_constraints = ON")
        for statement in statements:
            connection.execute(statement)


def verdicts(system: System) -> dict[str, tuple[str, bool]]:
    """Result of each check of the store that may be a sample, and whether it was one."""
    found = [*look(system, "store"), *look(system, "seals")]
    return {
        finding.name: (finding.result, finding.sampled)
        for finding in found
        if finding.name in ("store", "audit log", "seals")
    }


def test_of_a_large_store_a_sample_is_checked_and_named_as_one(crowded: System) -> None:
    assert verdicts(crowded) == dict.fromkeys(("store", "audit log", "seals"), ("ok", True))
    assert all("--full" in finding.why for finding in look(crowded, "seals"))
    whole = replace(crowded, full=True)
    assert verdicts(whole) == dict.fromkeys(("store", "audit log", "seals"), ("ok", False))


def steps_of(system: System, monkeypatch: pytest.MonkeyPatch) -> int:
    """Instructions that SQLite runs for the checks of the store, in tens."""
    counted, begin = [0], Database.__init__

    def count() -> int:
        counted[0] += 1
        return 0

    def watched(database: Database, path: Path, connection: sqlite3.Connection) -> None:
        begin(database, path, connection)
        connection.set_progress_handler(count, 10)

    with monkeypatch.context() as patch:
        patch.setattr(Database, "__init__", watched)
        for name in ("store", "nodes", "seals"):
            assert all(finding.result != "failed" for finding in look(system, name))
    return counted[0]


def test_what_a_check_reads_does_not_grow_with_the_nodes(crowded: System, monkeypatch: pytest.MonkeyPatch) -> None:
    few, whole = steps_of(crowded, monkeypatch), replace(crowded, full=True)
    full = steps_of(whole, monkeypatch)
    with Station.open(crowded.home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.unlock()
        for number in range(100, 700):
            uuid = number.to_bytes(2) * 5
            station.pins.put(WhitelistEntry(uuid, f"{number:064x}", name=f"node {number}"))
            station.nodes.put(NodeRecord(uuid, None, f"node {number}", None, 1, 0, 0))
            station.keys.add(KeyRecord(uuid, 1, "ab" * 8, "active", 1, b"wrapped"))
            station.audit("verify", uuid, "authentic")
    assert steps_of(crowded, monkeypatch) < 1.5 * few
    assert steps_of(whole, monkeypatch) > 5 * full


def test_nodes_without_a_key_are_sampled_too(stationed: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_sample, "SAMPLED", 20)
    monkeypatch.setattr(row_sample, "_RUN", 5)
    forget_vaults()
    with Station.open(stationed.home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.unlock()
        for number in range(60):
            station.pins.put(WhitelistEntry(bytes([number]) * 10, f"{number:064x}"))
    system = replace(stationed, ask=lambda prompt, confirm: PASSPHRASE)
    assert verdicts(system)["seals"] == ("ok", True)
    changed_in(stationed.home, "UPDATE whitelist SET fingerprint = 'ff' WHERE uuid > x'05'")
    assert verdicts(system)["seals"][0] == "failed"


def test_neighbours_without_a_key_are_sampled_however_far_another_row_is(
    stationed: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sheet of whitelisted boards has UUIDs of one place, maker and hour; one board of another maker stands apart."""
    monkeypatch.setattr(row_sample, "SAMPLED", 180)
    monkeypatch.setattr(row_sample, "_RUN", 1)
    forget_vaults()
    maker = bytes.fromhex("8d4d9da65281f7")
    with Station.open(stationed.home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        station.unlock()
        for number in range(200):
            station.pins.put(WhitelistEntry(maker + number.to_bytes(3), f"{number:064x}"))
        for apart in (bytes(10), b"\xff" * 10):
            station.pins.put(WhitelistEntry(apart, "ab" * 32))
    system = replace(stationed, ask=lambda prompt, confirm: PASSPHRASE)
    assert verdicts(system)["seals"] == ("ok", True)
    changed_in(
        stationed.home,
        f"UPDATE whitelist SET fingerprint = 'ff' WHERE uuid BETWEEN x'{maker.hex()}000008' AND x'{maker.hex()}0000c0'",
    )
    assert (
        verdicts(system)["seals"][0] == "failed"
    )  # 45 starts, each among them one time in four: missed once in 400,000 runs


def test_what_another_program_did_to_the_newest_is_always_found(crowded: System) -> None:
    changed_in(crowded.home, "UPDATE whitelist SET fingerprint = 'ff' WHERE uuid = (SELECT max(uuid) FROM whitelist)")
    changed_in(crowded.home, "UPDATE audit SET outcome = 'x' WHERE seq = (SELECT max(seq) - 1 FROM audit)")
    found = verdicts(crowded)
    assert (found["seals"][0], found["audit log"][0]) == ("failed", "failed")


def test_one_changed_row_among_many_is_found_by_a_full_check(crowded: System) -> None:
    changed_in(crowded.home, f"UPDATE whitelist SET fingerprint = 'ff' WHERE uuid = x'{'07' * 10}'")
    changed_in(crowded.home, f"UPDATE audit SET outcome = 'x' WHERE uuid = x'{'07' * 10}'")
    found = verdicts(replace(crowded, full=True))
    assert (found["seals"][0], found["audit log"][0]) == ("failed", "failed")


def test_a_sample_finds_a_change_of_many_old_rows(crowded: System) -> None:
    changed_in(crowded.home, f"UPDATE whitelist SET fingerprint = 'ff' WHERE uuid < x'{'30' * 10}'")
    assert verdicts(crowded)["seals"] == ("failed", False)  # a third of 48 rows; none of them once in 10^8 runs


def test_an_entry_that_was_taken_out_of_a_long_log_is_found(crowded: System) -> None:
    changed_in(crowded.home, "DELETE FROM audit WHERE seq = 7")
    (log,) = (finding for finding in look(crowded, "store") if finding.name == "audit log")
    assert (log.result, "entry 7 is missing" in log.why) == ("failed", True)


def test_a_small_table_beside_large_ones_is_checked_whole(crowded: System) -> None:
    changed_in(crowded.home, "INSERT INTO trust VALUES('x', 'ca', x'00', 'y', 'z', NULL)")
    (store,) = look(crowded, "store")
    assert (store.result, "trust" in store.why) == ("failed", True)
