"""WLC and Bluetooth LE out-of-band records of an initial message (profile.md, "BLE"; operation.md section 7).

Layouts as several public stacks agree on them; the texts of NFC Forum and Bluetooth SIG were not at hand. Whatever
comes is read without an error: what is cut off or out of range is left out. Pure; imports no NFC library.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from teds_provision.links.hints import BleAddress, Charging, ChargingState
from teds_provision.links.nfc.message import NdefRecord

OUT_OF_BAND: Final = b"application/vnd.bluetooth.le.oob"
MIME: Final = 2
_AD_ADDRESS: Final = 0x1B
_MODES: Final = ("static", "negotiated", "full", "reserved")
_STATUS_FIELDS: Final = (
    (0x01, "battery_percent", False),
    (0x02, "received_power", False),
    (0x04, "received_voltage", False),
    (0x08, "received_current", False),
    (0x10, "battery_celsius", True),
    (0x20, "node_celsius", True),
    (0x40, "reserved", False),
    (0x80, "second_control", False),
)
"""Control bit, field, signed; the fields follow in this order."""
_SECOND_FIELDS: Final = ((0x01, "battery_voltage"), (0x02, "battery_current"))
_LONGEST_EXPONENT: Final = 0x13

Fields = dict[str, int | str]


def charging(records: Sequence[NdefRecord]) -> Charging | None:
    """Return the charging report of a message's WLC records, None if it has none."""
    raw: dict[str, Fields] = {}
    for record in records:
        for name, read in ((b"WLCCAP", capability), (b"WLCSTAI", status), (b"WLCCTL", control)):
            if record.is_well_known(name) and name.decode() not in raw:
                raw[name.decode()] = read(record.payload)
    if not raw:
        return None
    stai, ctl = raw.get("WLCSTAI", {}), raw.get("WLCCTL", {})
    percent = _number(stai, "battery_percent")
    return Charging(
        _state(raw.get("WLCCAP"), stai, ctl),
        percent if percent is not None else _number(ctl, "battery_percent"),
        _number(stai, "battery_celsius"),
        _number(stai, "node_celsius"),
        raw,
    )


def _state(cap: Fields | None, stai: Fields, ctl: Fields) -> ChargingState:
    if ctl.get("error"):
        return "error"
    if cap is not None and cap.get("mode") == "full":
        return "full"
    if stai.get("received_power"):
        return "charging"
    if ctl:
        return "wanted" if ctl.get("power_wanted") else "no"
    return "wanted" if cap else "no"


def _number(fields: Fields, name: str) -> int | None:
    value = fields.get(name)
    return value if isinstance(value, int) else None


def capability(payload: bytes) -> Fields:
    """Return the fields of ``WLCCAP``: the node can be charged; times in ms."""
    if len(payload) < 6:
        return {}
    version, flags, wait, read_wait, write_timeout, write_wait = payload[:6]
    return {
        "version": f"{version >> 4}.{version & 15}",
        "mode": _MODES[flags >> 6],
        "retries": flags >> 2 & 15,
        "negotiation_wait": flags >> 1 & 1,
        "read_confirmation": flags & 1,
        "wait_ms": _milliseconds(wait),
        "read_wait_ms": 2540 if read_wait in (0, 255) else read_wait * 10,
        "write_timeout_ms": 1 << ((write_timeout if 1 <= write_timeout <= 4 else 4) + 5),
        "write_wait_ms": min(write_wait, 10),
    }


def status(payload: bytes) -> Fields:
    """Return the fields of ``WLCSTAI``, the node's state: percent and °C, the rest without a public unit."""
    return dict(_status_fields(payload))


def _status_fields(payload: bytes) -> Iterator[tuple[str, int]]:
    octets = iter(payload[1:])
    second = 0
    flags = payload[0] if payload else 0
    announced = [(name, signed) for bit, name, signed in _STATUS_FIELDS if flags & bit]
    for (name, signed), octet in zip(announced, octets, strict=False):
        second = octet if name == "second_control" else second
        if name != "battery_percent" or octet <= 100:
            yield name, _signed(octet) if signed else octet
    yield from zip([name for bit, name in _SECOND_FIELDS if second & bit], octets, strict=False)


def _signed(octet: int) -> int:
    return octet - 256 if octet > 127 else octet


def control(payload: bytes) -> Fields:
    """Return the fields of ``WLCCTL``: whether the node wants power, and for how long (ms)."""
    if len(payload) < 6:
        return {}
    flags, request, step, percent, driver, last = payload[:6]
    fields: Fields = {
        "error": flags >> 7,
        "counter": flags & 7,
        "power_wanted": int(request >> 6 == 1),
        "duration_ms": _milliseconds(request >> 1),
        "information_wanted": request & 1,
        "power_step": _signed(step),
        "driver": driver >> 6,
    }
    if flags >> 3 & 3 == 1 and percent <= 100:
        fields["battery_percent"] = percent
    if flags >> 7:
        return fields | {"protocol_error": last >> 1 & 1, "temperature_error": last & 1}
    return fields | {"hold_off_ms": min(last, 15) * 2}


def _milliseconds(exponent: int) -> int:
    return 1 << (min(exponent & 31, _LONGEST_EXPONENT) + 3)


def ble_address(records: Sequence[NdefRecord]) -> BleAddress | None:
    """Return the device address of a Bluetooth LE out-of-band record, None if there is no valid one."""
    for record in records:
        if record.tnf == MIME and record.type.lower() == OUT_OF_BAND:
            for kind, data in _structures(record.payload):
                if kind == _AD_ADDRESS and len(data) == 7:
                    return BleAddress(data[5::-1], bool(data[6] & 1))
    return None


def _structures(octets: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield advertising structures: length, type, data; ends at one that is cut off."""
    at = 0
    while at + 1 < len(octets):
        size = octets[at]
        if size == 0 or at + 1 + size > len(octets):
            return
        yield octets[at + 1], octets[at + 2 : at + 1 + size]
        at += 1 + size
