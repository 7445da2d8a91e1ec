"""What the doctor looks at around Bluetooth: adapters, switches, the service, roles and connections.

Nothing is opened and nobody is connected to; a trouble is a failure only where BLE was asked for.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from teds_provision.doctor.registry import Finding, Place, Result, check
from teds_provision.errors import NoReader, UsageFailure
from teds_provision.links.ble.bluez import AdapterFacts, adapters
from teds_provision.links.ble.spec import BleSpec, parse_spec
from teds_provision.links.ble.troubles import POWER_HINT

_NAME: Final = "bluetooth"
_MANY: Final = 5
"""Connections from which on many adapters take no more (notes in docs/hardware.md)."""


@check("bluetooth switches", "machine")
def switches(place: Place) -> Iterator[Finding]:
    """Does the kernel know a Bluetooth adapter, and is it blocked by rfkill or by a switch."""
    found = sorted(path.name for path in place.at("/sys/class/bluetooth").glob("hci*") if ":" not in path.name)
    if not found:
        yield Finding("bluetooth switches", "skipped", "The kernel knows no Bluetooth adapter.")
        return
    blocked = list(_blocked(place))
    yield from blocked
    if not blocked:
        yield Finding("bluetooth switches", "ok", f"{', '.join(found)}: not blocked.")


def _blocked(place: Place) -> Iterator[Finding]:
    for switch in sorted(place.at("/sys/class/rfkill").glob("rfkill*")):
        try:
            kind, name = (switch / "type").read_text().strip(), (switch / "name").read_text().strip()
            soft, hard = ((switch / side).read_text().strip() == "1" for side in ("soft", "hard"))
        except OSError:
            continue
        if kind != "bluetooth" or not (soft or hard):
            continue
        if hard:
            yield Finding(
                "bluetooth switches", "warning", f"{name} is off by a switch.", "Use the machine's switch or key."
            )
        else:
            yield Finding("bluetooth switches", "warning", f"{name} is blocked.", "rfkill unblock bluetooth")


@check(_NAME, "link")
def bluetooth(place: Place) -> Iterator[Finding]:
    """System bus, bluetoothd, its adapters: switched on, central role, connections that are held."""
    if place.system != Path("/") and "DBUS_SYSTEM_BUS_ADDRESS" not in place.environment:
        yield Finding(_NAME, "skipped", "Another machine's folders are looked at.")
        return
    asked = place.ble is not None
    try:
        spec = parse_spec(place.ble or "")
        found = adapters(place.environment.get("DBUS_SYSTEM_BUS_ADDRESS"))
        _require(found, spec)
    except (NoReader, UsageFailure) as failure:
        yield Finding(_NAME, "failed" if asked else "skipped", failure.message, failure.hint if asked else "")
        return
    for each in found:
        yield _adapter(each, spec, asked=asked)


def _require(found: list[AdapterFacts], spec: BleSpec) -> None:
    """Raise NoReader where there is no adapter, or not the one that was named."""
    if not found:
        raise NoReader("bluetoothd has no adapter.", hint="Plug one in; bluetoothctl list")
    if spec.adapter is not None and spec.adapter not in {each.name for each in found}:
        named = ", ".join(each.name for each in found)
        raise NoReader(f"There is no Bluetooth adapter {spec.adapter}.", hint=f"There is {named}.")


def _adapter(facts: AdapterFacts, spec: BleSpec, *, asked: bool) -> Finding:
    name = f"{_NAME} {facts.name}"
    bad: Result = "failed" if asked and spec.adapter in (None, facts.name) else "warning"
    if not facts.central:
        return Finding(name, bad, f"{facts.name} has no LE central role.", "Use an adapter of Bluetooth 4.0 up.")
    if not facts.powered:
        return Finding(name, bad, f"{facts.name} is switched off.", POWER_HINT)
    held = f"{facts.held} connection{'' if facts.held == 1 else 's'} held"
    if facts.held >= _MANY:
        fix = "Disconnect what is not needed (bluetoothctl devices Connected), or add an adapter"
        return Finding(name, "warning", f"{facts.name}: {held}; many adapters take 5 to 9.", fix)
    return Finding(name, "ok", f"{facts.name} ({facts.address}) is on, central, {held}: --ble {facts.name}.")
