"""Differences between two datasheets of a node, in physical terms rather than octets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

from teds_provision.arrays import np
from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.formula import kind_of
from teds_provision.teds.calibration.model import Calibration, from_decoded, is_sound
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import DecodedTeds, Field, Units
from teds_provision.teds.codec.tables import FieldSpec, name_of, table
from teds_provision.teds.codec.values import read_text
from teds_provision.teds.curve import Curve, CurveChannel, channel_of, curve_of
from teds_provision.teds.image import BlockId
from teds_provision.teds.sheet import described, name_among
from teds_provision.teds.show import Context, meaning_of, text_of

_BLOCKS: Final[Mapping[int, str]] = {
    AccessCode.META: "Meta-TEDS",
    AccessCode.CHANNEL: "channel description",
    AccessCode.CALIBRATION: "calibration",
    AccessCode.END_USER: "end-user TEDS",
    AccessCode.NAME: "name",
    AccessCode.PHY: "PHY TEDS",
    AccessCode.SECURITY: "Security TEDS",
    AccessCode.ORIGIN: "Origin TEDS",
    AccessCode.CERTIFICATE: "Certificate TEDS",
}
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
    "ZeroOffset": "zero offset",
    "ZeroDate": "date of the zero offset",
}
_OPAQUE: Final = 48
_OPAQUE_OCTETS: Final = 16


@dataclass(frozen=True)
class Change:
    """One difference: ``before`` and ``after`` as people read them ("" if added or removed), ``text`` the sentence.

    ``field`` is the name of the TEDS field, "curve" for a calibration's curve, "" for a block as a whole.
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
    name = name_among(channel, new if (channel, AccessCode.NAME) in new else old)
    return f"channel {channel} ({name})" if name else f"channel {channel}"


def _label(access_code: int) -> str:
    return _BLOCKS.get(access_code, name_of(access_code))


def _block(key: BlockId, where: str, old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> Iterator[Change]:
    channel, access_code = key
    before, after = decode(old[key]), decode(new[key])
    skip: frozenset[str] = frozenset()
    found = False
    if access_code == AccessCode.CALIBRATION:
        text = curve_change(channel, old, new)
        if text is not None:
            skip = CURVE_FIELDS
            if text:
                found = True
                yield Change(channel, access_code, "curve", "", "", f"{where}: {text}.")
    contexts = _context(channel, old), _context(channel, new)
    for path, item, other in _differing(_flat(before), _flat(after)):
        if path[0][0] in skip:
            continue
        found = True
        was = _shown(item, access_code, path, contexts[0]) if item else ""
        now = _shown(other, access_code, path, contexts[1]) if other else ""
        yield Change(channel, access_code, path[-1][0], was, now, _sentence(where, path, was, now))
    if not found:
        yield Change(
            channel, access_code, "", "", "", f"{where}: {_label(access_code)}: the same content, other octets."
        )


_Path = tuple[tuple[str, int], ...]


def _differing(
    ones: Mapping[_Path, Field], others: Mapping[_Path, Field]
) -> Iterator[tuple[_Path, Field | None, Field | None]]:
    """Yield the leaves that differ in their octets; None for one that one side lacks."""
    for path in dict.fromkeys((*ones, *others)):
        one, other = ones.get(path), others.get(path)
        if one is None or other is None or one.raw != other.raw:
            yield path, one, other


def _flat(decoded: DecodedTeds) -> dict[_Path, Field]:
    """Return the leaves by path of (name, number among fields of that name)."""
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
        out[path] = Field(0, "text", read_text(text), text, 0)
    return out


def _context(channel: int, blocks: Mapping[BlockId, bytes]) -> Context:
    own = described(channel, blocks)
    return Context(own.unit if own.units_stated else None, channel=channel)


def _sentence(where: str, path: _Path, before: str, after: str) -> str:
    label = ", ".join(_LABELS.get(name, name) + (f" {number + 1}" if number else "") for name, number in path)
    if not before:
        return f"{where}: {label} added: {after}."
    if not after:
        return f"{where}: {label} removed (was {before})."
    if "octets" in after and "octets" in before:
        return f"{where}: {label} is another."
    return f"{where}: {label} {before} -> {after}."


def _shown(field: Field, access_code: int, path: _Path, context: Context) -> str:
    spec = _spec(access_code, path)
    word, _ = meaning_of(field, spec)
    if word:
        return word
    opaque = isinstance(field.value, bytes) or (spec is not None and spec.kind == "key")
    if (opaque and len(field.raw) > _OPAQUE_OCTETS) or (isinstance(field.value, str) and len(field.value) > _OPAQUE):
        return f"{len(field.raw)} octets"
    plain = context if access_code == AccessCode.CHANNEL else Context(channel=context.channel)
    return text_of(field, plain, spec) or "nothing"


def _spec(access_code: int, path: _Path) -> FieldSpec | None:
    rows = table(access_code).by_name
    spec: FieldSpec | None = None
    for name, _ in path:
        spec = rows.get(name)
        if spec is None:
            return None
        rows = spec.by_name
    return spec


# How another calibration changes the readings of a channel.

CURVE_FIELDS: Final = frozenset({"CalInput", "Coefs", "Method", "ZeroOffset", "SIConvrt"})
"""Fields that make the curve: they are reported as one change."""


def curve_change(channel: int, old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> str | None:
    """Return ``gain +0.8 %, at full scale +0.35 N, stated uncertainty 0.2 N``; "" if no reading changes.

    None if one of the calibrations cannot be computed: then its fields are to be compared one by one.
    """
    one, other = channel_of(channel, old, None), channel_of(channel, new, None)
    before, after = _calibration(channel, old, one), _calibration(channel, new, other)
    if before is None or after is None or len(before.inputs) != len(after.inputs):
        return None
    others = {part.channel: channel_of(part.channel, new, None) for part in after.inputs}
    view = replace(other, raw=after.raw_range or other.raw)
    curve = curve_of(after, view, others, also=before, dense=True)
    was = replace(curve_of(before, view, others, also=after, dense=True), axes=curve.axes)
    parts = _parts(was, curve)
    if kind_of(before) != kind_of(after):
        parts.append(f"{kind_of(before)} -> {kind_of(after)}")
    if not parts:
        return ""
    if not other.actuator and other.uncertainty > 0:
        stated = other.show(other.uncertainty, difference=True, like=after.unit)
        parts.append(f"stated uncertainty {stated}")
    return ", ".join(parts)


def _calibration(channel: int, blocks: Mapping[BlockId, bytes], own: CurveChannel) -> Calibration | None:
    try:
        decoded = decode(blocks[channel, AccessCode.CALIBRATION])
        found = from_decoded(decoded, channel=channel, units=own.units, actuator=own.actuator)
    except BadDataError:
        return None
    return found if is_sound(found) else None


def _parts(was: Curve, curve: Curve) -> list[str]:
    difference = curve.difference(was)
    if not np.isfinite(difference).all():
        return ["the readings are no numbers"]
    if float(np.abs(difference).max(initial=0.0)) <= curve.noise / 4:
        return []
    parts = []
    gain = _gain(was, curve)
    if gain is not None and abs(gain) >= 0.0005:
        parts.append(f"gain {gain:+.3g} %")
    low, high = (float(np.median(np.take(difference, end, axis=curve.main))) for end in (0, -1))
    at = int(np.argmax(np.abs(difference)))
    worst = float(difference.flat[at])
    ends = (("at the low end", low), ("at full scale", high))
    parts += [f"{where} {_signed(curve, change)}" for where, change in ends if abs(change) > curve.noise]
    if abs(worst) > 1.01 * max(abs(low), abs(high)):
        parts.append(f"at most {_signed(curve, worst)} (at {_place(curve, at)})")
    return parts or [f"at most {_signed(curve, worst)}"]


def _place(curve: Curve, at: int) -> str:
    own = curve.inputs_at(at)[curve.main]
    return f"{own:.8g}" if curve.channel.actuator else f"raw {own:.8g}"


def _gain(was: Curve, curve: Curve) -> float | None:
    """Return the change in percent of the mean slope over the range (least squares), None if it was zero."""

    def slope(curve: Curve) -> float:
        along = np.moveaxis(curve.result, curve.main, 0).reshape(len(curve.axes[curve.main]), -1).mean(axis=1)
        axis = curve.axes[curve.main] - curve.axes[curve.main].mean()
        return float((axis * along).sum() / max((axis * axis).sum(), 1e-300))

    before, after = slope(was), slope(curve)
    return None if before == 0 else (after / before - 1) * 100


def _signed(curve: Curve, value: float) -> str:
    if curve.channel.actuator:
        return f"{value:+.5g} raw"
    shown = curve.channel.show(value, difference=True, like=curve.calibration.unit)
    return shown if shown.startswith("-") else f"+{shown}"
