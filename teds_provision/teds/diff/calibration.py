"""What another calibration changes in the readings of a channel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from teds_provision.errors import BadData
from teds_provision.lazy import late
from teds_provision.teds.calibration.decoded import from_decoded, is_sound
from teds_provision.teds.calibration.describe import kind_of
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.guard.curve import channel_of, curve_of
from teds_provision.teds.image import BlockId

if TYPE_CHECKING:
    import numpy as np

    from teds_provision.teds.guard.curve import Channel, Curve
else:
    np = late("numpy")

CURVE_FIELDS: Final = frozenset({"CalInput", "Coefs", "Method", "ZeroOffset", "SIConvrt"})
"""Fields that make the curve: they are told as one change."""


def curve_change(channel: int, old: Mapping[BlockId, bytes], new: Mapping[BlockId, bytes]) -> str | None:
    """``gain +0.8 %, at full scale +0.35 N, stated uncertainty 0.2 N``; "" where no reading changes.

    None where one of the calibrations cannot be computed: then its fields are to be compared one by one.
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


def _calibration(channel: int, blocks: Mapping[BlockId, bytes], own: Channel) -> Calibration | None:
    try:
        decoded = decode(blocks[channel, AccessCode.CALIBRATION])
        found = from_decoded(decoded, channel=channel, units=own.units, actuator=own.actuator)
    except BadData:
        return None
    return found if is_sound(found) else None


def _parts(was: Curve, curve: Curve) -> list[str]:
    difference = curve.result - was.result
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
    """Change in percent of the mean slope over the range (least squares), None where it was nothing."""

    def slope(one: Curve) -> float:
        along = np.moveaxis(one.result, one.main, 0).reshape(len(one.axes[one.main]), -1).mean(axis=1)
        axis = one.axes[one.main] - one.axes[one.main].mean()
        return float((axis * along).sum() / max((axis * axis).sum(), 1e-300))

    before, after = slope(was), slope(curve)
    return None if before == 0 else (after / before - 1) * 100


def _signed(curve: Curve, value: float) -> str:
    if curve.channel.actuator:
        return f"{value:+.5g} raw"
    shown = curve.channel.show(value, difference=True, like=curve.calibration.unit)
    return shown if shown.startswith("-") else f"+{shown}"
