"""What the doctor says of Bluetooth: no bus, no service, off, no central role, blocked, nearly full."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from teds_provision.doctor import links
from teds_provision.doctor.checks import Finding, System
from teds_provision.links.ble.port import BlePort

from .radio import Radio, needs_dbus

Air = Callable[..., Radio]


def system(tmp_path: Path, bus: str = "", ble: str | None = None) -> System:
    system = tmp_path / "system"
    system.mkdir(exist_ok=True)
    environment = {"DBUS_SYSTEM_BUS_ADDRESS": bus} if bus else {}
    return System(tmp_path / "home", ble=ble, root=system, environment=environment)


def switch(there: System, kind: str, *, soft: int = 0, hard: int = 0) -> list[Finding]:
    (there.at("/sys/class/bluetooth/hci0")).mkdir(parents=True, exist_ok=True)
    folder = there.at(f"/sys/class/rfkill/rfkill{kind}")
    folder.mkdir(parents=True)
    for name, text in {"type": kind, "name": "hci0", "soft": soft, "hard": hard}.items():
        (folder / name).write_text(f"{text}\n")
    return list(links.switches(there))


def test_switches_are_read_from_the_kernel(tmp_path: Path) -> None:
    assert [finding.result for finding in links.switches(system(tmp_path))] == ["skipped"]
    assert [finding.result for finding in switch(system(tmp_path), "wlan", soft=1)] == ["ok"]
    (soft,) = switch(system(tmp_path), "bluetooth", soft=1)
    assert (soft.result, soft.fix) == ("warning", "rfkill unblock bluetooth")


def test_a_switch_of_the_machine_is_named(tmp_path: Path) -> None:
    (hard,) = switch(system(tmp_path), "bluetooth", soft=1, hard=1)
    assert "switch" in hard.fix


def test_no_bus_is_a_failure_only_if_ble_was_requested(tmp_path: Path) -> None:
    nowhere = f"unix:path={tmp_path}/nothing"
    (quiet,) = links.bluetooth(system(tmp_path, nowhere))
    (asked,) = links.bluetooth(system(tmp_path, nowhere, ble="auto"))
    assert (quiet.result, quiet.fix) == ("skipped", "")
    assert asked.result == "failed"
    assert "systemctl start bluetooth" in asked.fix
    (wrong,) = links.bluetooth(system(tmp_path, nowhere, ble="hci0?speed=3"))
    assert "no option" in wrong.why


@needs_dbus
@pytest.mark.link
def test_adapters_as_bluetoothd_has_them(
    tmp_path: Path, air: Air, port: Callable[..., BlePort], monkeypatch: pytest.MonkeyPatch
) -> None:
    radio = air(1)

    def look(ble: str | None = "auto") -> Finding:
        (found,) = links.bluetooth(system(tmp_path, radio.address, ble))
        return found

    assert look().result == "ok"
    assert "0 connections held: --ble hci0" in look().why
    port().find(lambda _: True, seconds=20, notice=lambda _: None)
    assert "1 connection held" in look().why
    monkeypatch.setattr(links, "_MANY", 1)
    assert look().result == "warning"
    assert "add an adapter" in look().fix
    assert look("hci7").result == "failed"
    radio.do("manners", {"powered": False})
    assert (look().result, look(None).result) == ("failed", "warning")
    assert "power on" in look().fix
    radio.do("manners", {"central": False})
    assert "central role" in look().why
