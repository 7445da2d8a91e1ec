"""What changes between two datasheets of a node, in physical terms rather than octets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Decoded, Field, TimeInstance, Units
from teds_provision.teds.codec.tables import FieldSpec, name_of, table
from teds_provision.teds.image import BlockId
from teds_provision.teds.units.units import display_unit, format_units, format_value

_BLOCKS: Final[Mapping[int, str]] = {
    AccessCode.META: "Meta-TEDS",
    AccessCode.CHANNEL: "channel description",
    AccessCode.CALIBRATION: "calibration",
    AccessCode.END_USER: "end-user TEDS",
    AccessCode.NAME: "name",
    AccessCode.PHY: "PHY TEDS",
    AccessCode.SECURITY: "Security TEDS",
}
_CHANNEL_VALUES: Final = {"LowLimit": False, "HiLimit": False, "OError": True}
_LABELS: Final = {
    "LowLimit": "low limit",
    "HiLimit": "high limit",
    "OError": "stated uncertainty",
    "PhyUnits": "unit",
    "SPeriod": "sampling period",
    "UpdateT": "update time",
    "WarmUpT": "warm-up time",
    "TCName": "name",
    "SigBits": "significant bits",
    "MaxChan": "number of channels",
    "OholdOff": "operation time-out",
    "SHoldOff": "slow-access time-out",
    "ChanType": "channel type",
    "CalKey": "calibration key",
}
_OPAQUE: Final = 48


@dataclass(frozen=True)
class Change:
    """One difference: ``before`` and ``after`` as people read them ("" where added or removed), ``text`` the sentence.

    ``field`` is the name of the TEDS field, "curve" for a calibration's course, "" for a block as a whole.
    """

    channel: int
    access_code: int
    field: str
    before: str
    after: str
    text: str


def diff_blocks(old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> list[Change]:
    """Compare framed TEDS by (channel, access code), channel by channel; never raises on any octets."""
    changes: list[Change] = []
    for channel, access_code in sorted({*old, *new}):
        key = (channel, access_code)
        before, after = old.get(key), new.get(key)
        where = _where(channel, old, new)
        if before is None or after is None:
            verb = "added" if before is None else "removed"
            label = _label(access_code)
            changes.append(Change(channel, access_code, "", "", "", f"{where}: {label} {verb}."))
        elif before != after:
            changes += _block(key, where, old, new)
    return changes


def _where(channel: int, old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> str:
    if channel == 0:
        return "node"
    octets = new.get((channel, AccessCode.NAME), old.get((channel, AccessCode.NAME)))
    name = decode(octets).get("TCName") if octets else None
    return f"channel {channel} ({name})" if isinstance(name, str) and name.isprintable() else f"channel {channel}"


def _label(access_code: int) -> str:
    return _BLOCKS.get(access_code, name_of(access_code))


def _block(key: BlockId, where: str, old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> Iterator[Change]:
    channel, access_code = key
    before, after = decode(old[key]), decode(new[key])
    skip: frozenset[str] = frozenset()
    found = False
    if access_code == AccessCode.CALIBRATION:
        from teds_provision.teds.diff.calibration import CURVE_FIELDS, curve_change

        text = curve_change(channel, old, new)
        if text is not None:
            skip = CURVE_FIELDS
            if text:
                found = True
                yield Change(channel, access_code, "curve", "", "", f"{where}: {text}.")
    units = _units(channel, old), _units(channel, new)
    ones, others = _flat(before), _flat(after)
    for path in dict.fromkeys((*ones, *others)):
        one, other = ones.get(path), others.get(path)
        name = path[-1][0]
        if path[0][0] in skip or (one is not None and other is not None and one.raw == other.raw):
            continue
        found = True
        was, now = (
            _shown(field, access_code, path, unit) if field else ""
            for field, unit in zip((one, other), units, strict=True)
        )
        yield Change(channel, access_code, name, was, now, _sentence(where, path, was, now))
    if not found:
        yield Change(
            channel, access_code, "", "", "", f"{where}: {_label(access_code)}: the same content, other octets."
        )


_Path = tuple[tuple[str, int], ...]


def _flat(decoded: Decoded) -> dict[_Path, Field]:
    """Leaves by path of (name, number among fields of that name)."""
    out: dict[_Path, Field] = {}

    def walk(fields: tuple[Field, ...], above: _Path) -> None:
        counts: dict[str, int] = {}
        for field in fields:
            name = field.name or f"field {field.type}"
            number = counts[name] = counts.get(name, -1) + 1
            path = (*above, (name, number))
            if field.children and not isinstance(field.value, Units):
                walk(field.children, path)
            else:
                out[path] = field

    walk(decoded.fields, ())
    for number, text in enumerate(decoded.text):
        path = (("text", number),)
        out[path] = Field(0, "text", text, text, 0)
    return out


def _units(channel: int, blocks: Mapping[BlockId, bytes]) -> Units | None:
    octets = blocks.get((channel, AccessCode.CHANNEL))
    units = decode(octets).get("PhyUnits") if octets else None
    return units if isinstance(units, Units) else None


def _sentence(where: str, path: _Path, before: str, after: str) -> str:
    label = ", ".join(_LABELS.get(name, name) + (f" {number + 1}" if number else "") for name, number in path)
    if not before:
        return f"{where}: {label} added: {after}."
    if not after:
        return f"{where}: {label} removed (was {before})."
    if "octets" in after and "octets" in before:
        return f"{where}: {label} is another."
    return f"{where}: {label} {before} -> {after}."


def _shown(field: Field, access_code: int, path: _Path, units: Units | None) -> str:
    value = field.value
    spec = _spec(access_code, path)
    if isinstance(value, Units):
        return format_units(value) or "count"
    if isinstance(value, TimeInstance):
        return _moment(value, spec)
    if isinstance(value, float):
        if access_code == AccessCode.CHANNEL and field.name in _CHANNEL_VALUES and units is not None:
            return format_value(value, display_unit(units), difference=_CHANNEL_VALUES[field.name])
        return show_seconds(value) if spec is not None and _is_time(access_code, spec) else f"{value:.6g}"
    if isinstance(value, int) and spec is not None and value in spec.enumeration:
        return spec.enumeration[value]
    if isinstance(value, str):
        return value if len(value) <= _OPAQUE else f"{len(value)} octets"
    if isinstance(value, bytes):
        return value.hex() if len(value) <= 16 else f"{len(value)} octets"
    if isinstance(value, tuple):
        inside = ", ".join(f"{part:.6g}" if isinstance(part, float) else str(part) for part in value[:8])
        return f"[{inside}{', and so on' if len(value) > 8 else ''}]"
    return str(value) if value is not None else field.raw.hex() or "nothing"


def _spec(access_code: int, path: _Path) -> FieldSpec | None:
    rows = table(access_code).by_name
    spec: FieldSpec | None = None
    for name, _ in path:
        spec = rows.get(name)
        if spec is None:
            return None
        rows = spec.by_name
    return spec


def _is_time(access_code: int, spec: FieldSpec) -> bool:
    """Whether a Float32 of Meta or TransducerChannel TEDS counts seconds."""
    if access_code == AccessCode.META:
        return spec.type in (10, 11, 12)
    return access_code == AccessCode.CHANNEL and (20 <= spec.type <= 26 or 28 <= spec.type <= 30)


def _moment(value: TimeInstance, spec: FieldSpec | None) -> str:
    if spec is not None and spec.kind == "duration":
        return show_seconds(value.seconds + value.nanoseconds * 1e-9)
    from datetime import UTC, datetime, timedelta

    seconds = -value.seconds if value.negative else value.seconds
    try:
        return f"{datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=seconds):%Y-%m-%d %H:%M:%S} UTC"
    except OverflowError:
        return f"{seconds} s"


def show_seconds(value: float) -> str:
    """``100 µs``, ``2 s``, ``365 d``: a time in the unit people would use."""
    if not math.isfinite(value):
        return "not available"
    for least, scale, unit in ((2 * 86_400, 86_400, "d"), (1, 1, "s"), (1e-3, 1e-3, "ms"), (1e-6, 1e-6, "µs")):
        if abs(value) >= least * 0.9999999:
            return f"{value / scale:.6g} {unit}"
    return f"{value:.6g} s"
