"""A TEDS as people want to see it: :func:`describe` gives fields with units and words, and what they mean together."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import calibrated_unit, from_decoded
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.keyforms import read_key
from teds_provision.teds.codec.model import DecodedTeds, Field, Finding, TimeInstance, Units
from teds_provision.teds.codec.tables import FieldSpec, name_of, table
from teds_provision.teds.codec.uuid import unpack_uuid
from teds_provision.teds.formats import TedsBlock
from teds_provision.teds.formats.jsonform import teds_to_json
from teds_provision.teds.formats.tree import shortest
from teds_provision.teds.origin import read_origin
from teds_provision.teds.sheet import channel_from, described
from teds_provision.teds.units import WrittenUnit, display_unit, format_value, name_of_units

# The value of a field as text for users.

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
    """Return the words for a code, and whether it means something weak that no new TEDS may use."""
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
    """Return the value of a field for people; hex digits if nothing better is known."""
    kind = spec.kind if spec is not None else ""
    match field.value:
        case Units() as units:
            return name_of_units(units)
        case TimeInstance() as moment:
            return span(moment) if kind == "duration" else instant(moment)
        case float(number):
            return _number(field, number, context, spec)
        case tuple(numbers):
            shown = ", ".join(
                f"{part:.7g}" if isinstance(part, float) else str(part) for part in numbers[:SHOWN_NUMBERS]
            )
            return f"{shown}, … ({len(numbers)})" if len(numbers) > SHOWN_NUMBERS else shown
        case _ if kind == "key":
            return key(field)
        case _ if kind == "block id" and len(field.raw) == 35:
            return signed_block(field.raw, context.beside)
        case str(text):
            return text
        case int(number):
            return f"{number} {spec.unit}" if spec is not None and spec.unit else str(number)
        case _:
            return hexadecimal(field.raw)


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
    """Return seconds in the unit that suits: ``100 µs``, ``500 ms``, ``365 days``."""
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
    """Return the length of a time, in days if it is that long."""
    total = value.seconds + value.nanoseconds / 1e9
    text = seconds(total)
    return f"-{text}" if value.negative else text


def hexadecimal(octets: bytes) -> str:
    """Return hex digits; of many octets only the beginning."""
    if len(octets) <= SHOWN_OCTETS:
        return octets.hex() or "(empty)"
    return f"{octets[:SHOWN_OCTETS].hex()}… ({len(octets)} octets)"


def key(field: Field) -> str:
    """Describe a key or signature: the form it came in, and the fingerprint of a P-256 point."""
    found = read_key(field.raw)
    if found.point is not None:
        return f"P-256 key, fingerprint {fingerprint(found.point)[:FINGERPRINT_DIGITS]} ({found.form})"
    what = "no P-256 key" if field.name in _KEYS else "signature"
    return f"{what}, {len(found.octets)} octets as {found.form}: {found.octets[:8].hex()}…"


def fingerprint(point: bytes) -> str:
    """Return the SHA-256 of an uncompressed point, 64 hex digits."""
    return hashlib.sha256(point).hexdigest()


def signed_block(raw: bytes, beside: Mapping[tuple[int, int], bytes]) -> str:
    """Return which TEDS a SignedBlock means, and whether the present one matches."""
    channel, code, digest = int.from_bytes(raw[:2], "big"), raw[2], raw[3:]
    text = f"channel {channel} {name_of(code)} {digest.hex()[:FINGERPRINT_DIGITS]}…"
    octets = beside.get((channel, code))
    if octets is None:
        return f"{text} (absent)" if len(beside) > 1 else text
    return f"{text} ({'same' if hashlib.sha256(octets).digest() == digest else 'OTHER DIGEST'})"


_PROFILE_VERSION = "ProfileVersion"

Line = tuple[str, str]


def summary_of(decoded: DecodedTeds, context: Context, now: datetime) -> tuple[Line, ...]:
    """Return lines of (label, text) for people."""
    match decoded.access_code:
        case AccessCode.META:
            return tuple(_uuid(decoded, context))
        case AccessCode.CHANNEL:
            return tuple(_range(decoded, context))
        case AccessCode.CALIBRATION:
            return tuple(_calibration(decoded, context, now))
        case AccessCode.SECURITY:
            return tuple(_security(decoded, context))
        case AccessCode.ORIGIN:
            return tuple(_origin(decoded))
        case _:
            return ()


def _uuid(decoded: DecodedTeds, _context: Context) -> Iterator[Line]:
    value = decoded.get("UUID")
    parts = unpack_uuid(value) if isinstance(value, bytes) else None
    if parts is None:
        return
    if not parts.plausible:
        yield "UUID", "gives no sensible place and time: probably random, which is allowed"
        return
    if parts.degrees is not None:
        latitude, longitude = parts.degrees
        yield "made at", f"{abs(latitude):.4f}° {'NS'[latitude < 0]}, {abs(longitude):.4f}° {'EW'[longitude < 0]}"
    moment = parts.moment
    yield "made in", f"{moment:%Y-%m-%d %H:%M:%S} (TAI)" if moment is not None else str(parts.year)
    if parts.manufacturer:
        yield "maker's number", str(parts.manufacturer)


def _range(decoded: DecodedTeds, context: Context) -> Iterator[Line]:
    channel = channel_from(decoded)
    if context.unit is None or not channel.has_range:
        return
    text = f"{channel.show(channel.low)} to {channel.show(channel.high)}"
    if not math.isnan(channel.uncertainty):
        text += f", uncertainty {channel.show(channel.uncertainty, difference=True)}"
    yield "range", text


def _calibration(decoded: DecodedTeds, context: Context, now: datetime) -> Iterator[Line]:
    own = described(context.channel or 1, context.beside)
    try:
        calibration = from_decoded(decoded, channel=context.channel, units=own.units, actuator=own.actuator)
    except BadDataError as error:
        yield "calibration", f"{error.message} {error.hint}".strip()
        return
    segments = " × ".join(str(part.segments) for part in calibration.inputs)
    degrees = ", ".join(str(part.degree) for part in calibration.inputs)
    yield "method", f"{calibration.method}: {segments} segment{'' if segments == '1' else 's'} of degree {degrees}"
    if calibration.date is not None:
        yield "calibrated", f"{calibration.date:%Y-%m-%d}"
    if calibration.due is not None:
        yield "due", f"{calibration.due:%Y-%m-%d}{' (overdue)' if calibration.overdue(now) else ''}"


def _security(decoded: DecodedTeds, context: Context) -> Iterator[Line]:
    ours = decoded.field(_PROFILE_VERSION) is not None
    if not ours:
        yield "kind", "another vendor's Security TEDS (no field 105): shown, never trusted"
    yield from _keys(decoded)
    signature = decoded.field("Signature")
    when = decoded.get("LastModified")
    signed = f"claims to be signed, {instant(when)}" if isinstance(when, TimeInstance) else "claims to be signed"
    yield "signature", f"{signed}; check with: verify" if signature is not None else "none: initial or unsigned"
    for name, field_word in (("Sequence", "sequence"), ("KeyEpoch", "key epoch")):
        number = decoded.get(name)
        if isinstance(number, int):
            yield field_word, str(number)
    if ours and context.beside:
        try:
            security.decode(decoded.octets)
        except BadDataError as error:
            yield "form", f"not canonical, so never authentic: {error.message}"


def _origin(decoded: DecodedTeds) -> Iterator[Line]:
    try:
        origin = read_origin(decoded.octets)
    except BadDataError as error:
        yield "form", f"not the Origin TEDS of the profile: {error.message}"
        return
    yield "wrapped", f"{origin.text}: the node's proof ends at the wrapper, not at the sensor"


def _keys(decoded: DecodedTeds) -> Iterator[Line]:
    for name, label in (("NodePublicKey", "node"), ("BaseStationPublicKey", "station")):
        field = decoded.field(name)
        point = read_key(field.raw).point if field is not None else None
        if point is not None:
            digits = fingerprint(point)[:FINGERPRINT_DIGITS]
            yield f"{label} key", f"fingerprint {digits} (a hint, not an anchor of trust)"


__all__ = ["ShownField", "ShownTeds", "describe", "finding_to_json", "shown_to_json"]


@dataclass(frozen=True)
class ShownField:
    """One field for people: ``text`` is the value, ``meaning`` words for a code, ``weak`` a flag of the latter."""

    type: int
    name: str
    text: str
    meaning: str
    weak: bool
    offset: int
    children: tuple[ShownField, ...] = ()


@dataclass(frozen=True)
class ShownTeds:
    """One TEDS for people; ``summary`` holds (label, text) lines about the whole."""

    block: TedsBlock
    decoded: DecodedTeds
    fields: tuple[ShownField, ...]
    summary: tuple[Line, ...]

    @property
    def title(self) -> str:
        """``channel 1 · ChanTEDS (3)``, ``ChanTEDS (3)``, or that it is unknown."""
        code = self.block.access_code
        name = f"{table(code).name} ({code})" if code is not None else "unknown class"
        if self.decoded.access_code is not None and code is not None and self.decoded.access_code != code:
            name += f", though its TEDSID says {self.decoded.access_code}"
        return name if self.block.channel is None else f"channel {self.block.channel} · {name}"


def describe(
    block: TedsBlock, beside: Mapping[tuple[int, int], bytes] | None = None, *, now: datetime | None = None
) -> ShownTeds:
    """Decode a block and put it into words; ``beside`` are the framed TEDS that lie in the same image.

    Never raises, whatever the octets.
    """
    decoded = decode(block.octets)
    context = _context(block, decoded, dict(beside or {}))
    rows = table(decoded.access_code) if decoded.access_code is not None else None
    known: Mapping[int, FieldSpec] = {} if rows is None else {**rows.inner, **rows.aliases, **rows.by_type}
    fields = tuple(_field(field, known, context) for field in decoded.fields)
    return ShownTeds(block, decoded, fields, summary_of(decoded, context, now or datetime.now(UTC)))


def _field(field: Field, known: Mapping[int, FieldSpec], context: Context) -> ShownField:
    spec = known.get(field.type) if field.name else None
    if field.name == "TEDSID":
        return ShownField(field.type, field.name, field.raw.hex(" "), "", False, field.offset)
    inner = {} if spec is None else spec.by_type
    children = () if isinstance(field.value, Units) else tuple(_field(part, inner, context) for part in field.children)
    text = "" if children else text_of(field, context, spec)
    meaning, weak = meaning_of(field, spec)
    return ShownField(field.type, field.name or f"type {field.type}", text, meaning, weak, field.offset, children)


def _context(block: TedsBlock, decoded: DecodedTeds, beside: dict[tuple[int, int], bytes]) -> Context:
    series = decoded.get("SUnits")
    return Context(
        _unit(block, decoded, beside),
        display_unit(series) if isinstance(series, Units) else None,
        beside,
        converted=decoded.access_code == AccessCode.CALIBRATION,
        channel=block.channel,
    )


def _unit(block: TedsBlock, decoded: DecodedTeds, beside: Mapping[tuple[int, int], bytes]) -> WrittenUnit | None:
    """Return the unit of LowLimit, HiLimit and OError: the channel's, or the calibrated one; None if unknown."""
    if decoded.access_code == AccessCode.CHANNEL:
        channel = channel_from(decoded)
        return channel.unit if channel.units_stated else None
    if decoded.access_code != AccessCode.CALIBRATION:
        return None
    channel = described(block.channel or 1, beside)
    return calibrated_unit(decoded, channel.units) if channel.units_stated else None


def finding_to_json(finding: Finding) -> dict[str, Any]:
    """Return one finding as a JSON object."""
    out: dict[str, Any] = {"severity": finding.severity, "offset": finding.offset, "code": finding.code}
    out["message"] = finding.message
    extra = {"field": finding.field, "asked": finding.asked, "found": finding.found}
    return out | {key: value for key, value in extra.items() if value not in {"", None}}


def shown_to_json(shown: ShownTeds) -> dict[str, Any]:
    """Return one TEDS as JSON: the field tree of format ``teds/1`` with edition, verdict, findings and meaning."""
    decoded = shown.decoded
    out = {"edition": decoded.edition, **teds_to_json(shown.block)}
    out["edition"], out["verdict"] = decoded.edition, str(decoded.verdict)
    out["findings"] = [finding_to_json(finding) for finding in decoded.findings]
    visible = [field for field in shown.fields if field.name != "TEDSID"]
    if len(visible) == len(out["fields"]):
        out["fields"] = [_annotated(tree, field) for tree, field in zip(out["fields"], visible, strict=True)]
    if shown.summary:
        out["summary"] = [{"label": label, "text": text} for label, text in shown.summary]
    return out


def _annotated(tree: dict[str, Any], field: ShownField) -> dict[str, Any]:
    out = {**tree, "offset": field.offset}
    inner = tree.get("fields")
    if inner is not None and len(inner) == len(field.children):
        out["fields"] = [_annotated(part, child) for part, child in zip(inner, field.children, strict=True)]
    elif field.text:
        out["text"] = field.text
    if field.meaning:
        out["meaning"] = field.meaning
    return out | ({"weak": True} if field.weak else {})
