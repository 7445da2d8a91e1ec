"""The value of one field as people write it: units, words for codes, dates, keys with their fingerprints."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from datetime import UTC, datetime, timedelta
from typing import Final

from teds_provision.teds.codec.keyforms import read_key
from teds_provision.teds.codec.model import Field, TimeInstance, Units
from teds_provision.teds.codec.tables import FieldSpec, name_of
from teds_provision.teds.formats.tree import shortest
from teds_provision.teds.units import WrittenUnit, format_value, name_of_units

_DAY: Final = 86_400
SHOWN_NUMBERS: Final = 8
SHOWN_OCTETS: Final = 24
FINGERPRINT_DIGITS: Final = 16
_MODES: Final = ("trigger", "free-running", "free-running with pre-trigger", "continuous", "immediate")
_IN_CHANNEL_UNIT: Final = frozenset({"LowLimit", "HiLimit", "OError"})
_IN_SERIES_UNIT: Final = frozenset({"SOrigin", "StepSize"})
_DIFFERENCES: Final = frozenset({"OError", "StepSize"})
_KEYS: Final = frozenset({"NodePublicKey", "BaseStationPublicKey"})


@dataclass(frozen=True)
class Context:
    """Units that the fields of one TEDS are in, its channel, and the TEDS that lie beside it.

    ``converted``: limits are in ``unit`` already and not in SI, as in a Calibration TEDS.
    """

    unit: WrittenUnit | None = None
    series: WrittenUnit | None = None
    beside: Mapping[tuple[int, int], bytes] = dataclass_field(default_factory=dict)
    converted: bool = False
    channel: int | None = None


def meaning_of(field: Field, spec: FieldSpec | None) -> tuple[str, bool]:
    """Words for a code, and whether it stands for something weak that no new TEDS may use."""
    value = field.value
    if spec is None or not isinstance(value, int):
        return "", False
    if field.name == "SampMode":
        names = [_MODES[bit] for bit in range(5) if value >> bit & 1]
        return ", ".join(names), False
    if not spec.enumeration:
        return "", False
    word = spec.enumeration.get(value, "manufacturer's own" if value >= 128 else "reserved")
    return word, value in spec.weak


def text_of(field: Field, context: Context, spec: FieldSpec | None) -> str:
    """Value of a field for people; hex digits where nothing better is known."""
    kind = spec.kind if spec is not None else ""
    match field.value:
        case Units() as units:
            return name_of_units(units)
        case TimeInstance() as moment:
            return _moment(moment, kind)
        case float(number):
            return _number(field, number, context, spec)
        case tuple(numbers):
            return _list(numbers)
        case _ if kind == "key":
            return key(field)
        case _ if _is_signed_block(field, kind):
            return signed_block(field.raw, context.beside)
        case str(text):
            return text
        case int(number):
            return _integer(number, spec)
        case _:
            return hexadecimal(field.raw)


def _moment(value: TimeInstance, kind: str) -> str:
    return span(value) if kind == "duration" else instant(value)


def _is_signed_block(field: Field, kind: str) -> bool:
    return kind == "block id" and len(field.raw) == 35


def _list(numbers: tuple[int, ...] | tuple[float, ...]) -> str:
    shown = ", ".join(f"{part:.7g}" if isinstance(part, float) else str(part) for part in numbers[:SHOWN_NUMBERS])
    return f"{shown}, … ({len(numbers)})" if len(numbers) > SHOWN_NUMBERS else shown


def _integer(value: int, spec: FieldSpec | None) -> str:
    return f"{value} {spec.unit}" if spec is not None and spec.unit else str(value)


def _number(field: Field, value: float, context: Context, spec: FieldSpec | None) -> str:
    value = shortest(value)
    if field.name in _IN_CHANNEL_UNIT and context.unit is not None:
        difference = field.name in _DIFFERENCES
        if context.converted:
            return f"{value:.7g} {context.unit.text}".strip() if value == value else "not available"  # noqa: PLR0124 - NaN
        return format_value(value, context.unit, difference=difference)
    if field.name in _IN_SERIES_UNIT and context.series is not None:
        return format_value(value, context.series, difference=field.name in _DIFFERENCES)
    if spec is not None and spec.unit == "s":
        return seconds(value)
    return "not available" if value != value else f"{value:.7g}"  # noqa: PLR0124 - NaN


def seconds(value: float) -> str:
    """Seconds in the unit that suits: ``100 µs``, ``500 ms``, ``365 days``."""
    if value != value:  # noqa: PLR0124 - NaN
        return "not available"
    if abs(value) >= 2 * _DAY:
        return f"{value / _DAY:.6g} days"
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"), (1e-9, "ns")):
        if abs(value) >= scale * 0.999999:
            return f"{value / scale:.6g} {unit}"
    return f"{value:.6g} s"


def instant(value: TimeInstance) -> str:
    """Date and time, UTC."""
    if not value.seconds and not value.nanoseconds:
        return "not set (0)"
    try:
        moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
            seconds=-value.seconds if value.negative else value.seconds
        )
    except OverflowError:
        return f"{'-' if value.negative else ''}{value.seconds} s since 1970"
    return f"{moment:%Y-%m-%d %H:%M:%S} UTC"


def span(value: TimeInstance) -> str:
    """Length of a time, in days where it is that long."""
    total = value.seconds + value.nanoseconds / 1e9
    text = seconds(total)
    return f"-{text}" if value.negative else text


def hexadecimal(octets: bytes) -> str:
    """Hex digits, the beginning alone of many."""
    if len(octets) <= SHOWN_OCTETS:
        return octets.hex() or "(empty)"
    return f"{octets[:SHOWN_OCTETS].hex()}… ({len(octets)} octets)"


def key(field: Field) -> str:
    """A key or signature: the form it came in, and the fingerprint of a P-256 point."""
    found = read_key(field.raw)
    if found.point is not None:
        return f"P-256 key, fingerprint {fingerprint(found.point)[:FINGERPRINT_DIGITS]} ({found.form})"
    what = "no P-256 key" if field.name in _KEYS else "signature"
    return f"{what}, {len(found.octets)} octets as {found.form}: {found.octets[:8].hex()}…"


def fingerprint(point: bytes) -> str:
    """SHA-256 of an uncompressed point, 64 hex digits."""
    return hashlib.sha256(point).hexdigest()


def signed_block(raw: bytes, beside: Mapping[tuple[int, int], bytes]) -> str:
    """Which TEDS a SignedBlock means, and whether the one that lies beside it is that one."""
    channel, code, digest = int.from_bytes(raw[:2], "big"), raw[2], raw[3:]
    text = f"channel {channel} {name_of(code)} {digest.hex()[:FINGERPRINT_DIGITS]}…"
    octets = beside.get((channel, code))
    if octets is None:
        return f"{text} (absent)" if len(beside) > 1 else text
    return f"{text} ({'same' if hashlib.sha256(octets).digest() == digest else 'OTHER DIGEST'})"
