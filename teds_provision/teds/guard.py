"""The guard: refuses calibrations of the kinds that have hurt robots before.

Erased words, a sign or slope reversed, gain and offset swapped, a table that must be monotone and is not, results
beyond the limits, a fit worse than the stated uncertainty. Checked over every raw value that the channel can give: all
that its data model allows, or the ``raw-range`` of its profile. Findings are in physical units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final, Literal

from teds_provision.arrays import np
from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.formula import evaluate, residuals
from teds_provision.teds.calibration.model import Calibration, from_decoded
from teds_provision.teds.calibration.samples import Range
from teds_provision.teds.channel import TURN, Channel
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import DecodedTeds
from teds_provision.teds.curve import FLOAT32_STEP, Curve, CurveChannel, channel_of, curve_of
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile.model import ChannelProfile, Profile

# Single checks of the guard for curves that can be computed.

Raised = tuple[str, Literal["error", "warning"], str]
"""Code, severity, message."""

ALIKE: Final = 0.25
LARGE_CHANGE: Final = 0.1


def check(curve: Curve, before: Curve | None, given: Calibration | None) -> Iterator[Raised]:
    """Yield all findings of one channel; ``before`` is what the node has, ``given`` the calibration with its points."""
    if not np.isfinite(curve.result).all():
        at = int(np.argmin(np.isfinite(curve.result)))
        yield "overflow", "error", f"{_at(curve, curve.inputs_at(at))} gives no finite value."
        return
    if float(np.ptp(curve.result)) <= curve.noise:
        shown = _show(curve, float(curve.result.flat[0]))
        yield "flat", "error", f"every reading becomes {shown}: the gain is zero."
        return
    swapped = before is not None and _swapped(curve.calibration, before.calibration)
    if swapped:
        yield "swapped", "error", "gain and offset are exchanged against what the node has now."
    turned = list(_reversed(curve, before))
    yield from turned
    if not turned:
        yield from _not_monotone(curve, before)
    yield from _limits(curve)
    yield from _jumps(curve)
    yield from _residual(curve, given)
    if before is not None and not swapped and not turned:
        yield from _changed(curve, before)


def _show(curve: Curve, value: float, *, difference: bool = False) -> str:
    if curve.channel.actuator:
        return f"raw {value:.6g}"
    return curve.channel.show(value, difference=difference, like=curve.calibration.unit)


def _at(curve: Curve, inputs: tuple[float, ...]) -> str:
    """Return ``raw 512``, or for several inputs ``raw 512 with channel 2 at raw 100``."""
    own = inputs[curve.main]
    text = f"{own:.6g} {curve.calibration.unit.text}" if curve.channel.actuator else f"raw {own:.8g}"
    others = [
        f"channel {part.channel} at raw {value:.8g}"
        for number, (part, value) in enumerate(zip(curve.calibration.inputs, inputs, strict=True))
        if number != curve.main
    ]
    return f"{text} with {', '.join(others)}" if others else text


def _reversed(curve: Curve, before: Curve | None) -> Iterator[Raised]:
    span = f"from {_at(curve, _ends(curve)[0])} to {_at(curve, _ends(curve)[1])}"
    change = _show(curve, abs(curve.net), difference=True)
    demand = curve.channel.monotone
    wrong = {"increasing": curve.net < 0, "decreasing": curve.net > 0}.get(demand or "", False)
    way = "falls" if curve.net < 0 else "rises"
    if wrong and abs(curve.net) > curve.noise:
        yield "reversed", "error", f"the result {way} by {change} {span}; its type says that it must be {demand}."
    elif before is not None and _opposite(curve, before):
        had = "fell" if before.net < 0 else "rose"
        other = _show(before, abs(before.net), difference=True)
        yield (
            "reversed",
            "error",
            f"the result {way} by {change} {span}; with what the node has now it {had} by {other}.",
        )


def _opposite(curve: Curve, before: Curve) -> bool:
    least = max(curve.channel.tolerance, curve.noise)
    if curve.channel.actuator:
        least = curve.noise
    return curve.net * before.net < 0 and min(abs(curve.net), abs(before.net)) > least


def _ends(curve: Curve) -> tuple[tuple[float, ...], tuple[float, ...]]:
    middle = [float(axis[len(axis) // 2]) for axis in curve.axes]
    low, high = list(middle), list(middle)
    low[curve.main], high[curve.main] = float(curve.axes[curve.main][0]), float(curve.axes[curve.main][-1])
    return tuple(low), tuple(high)


def _not_monotone(curve: Curve, before: Curve | None) -> Iterator[Raised]:
    demand, severity, why = curve.channel.monotone, "error", "its type says that it must be monotone"
    if demand in ("increasing", "decreasing"):
        why = f"its type says that it must be {demand}"
    if demand is None:
        demand = "either"
        if before is not None and before.monotone("either"):
            why = "what the node has now is monotone"
        else:
            severity, why = "warning", "nothing here says whether it may"
    if curve.monotone(demand):
        return
    inputs, step = curve.worst_step(demand)
    way = "falls" if step < 0 else "rises"
    after = curve.next_sample(inputs[curve.main])
    amount = _show(curve, abs(step), difference=True)
    text = f"the result {way} by {amount} from {_at(curve, inputs)} to {after:.8g}; {why}."
    yield "not-monotone", "error" if severity == "error" else "warning", text


def _limits(curve: Curve) -> Iterator[Raised]:
    channel = curve.channel
    if channel.actuator:
        if channel.raw is None:
            return
        low, high, tolerance = *channel.raw, max(0.5, curve.noise)
        values, names = curve.result, ("lowest raw value", "highest raw value")
    else:
        low, high, tolerance = channel.low, channel.high, channel.tolerance
        values, names = curve.result, ("low limit", "high limit")
        # wrapped values are never beyond a limit, but a calibration over more than one turn is wrong
        if channel.full_turn:
            low = float(values.min())
            high, tolerance = low + TURN, 2 * tolerance
            names = "low limit", "end of the turn that the channel spans"
    if not math.isfinite(low) or not math.isfinite(high):
        yield "unlimited", "warning", "the channel states no limits: the results were not held against them."
    slack = tolerance + 4 * FLOAT32_STEP * max(abs(low), abs(high), 0.0) if math.isfinite(low + high) else tolerance
    for limit, over, name, where in (
        (low, low - values, names[0], "below"),
        (high, values - high, names[1], "above"),
    ):
        at = int(np.argmax(over))
        worst = float(over.flat[at])
        if math.isfinite(limit) and worst > slack:
            yield "limits", "error", _beyond(curve, at, float(values.flat[at]), worst, limit, f"{where} the {name}")


def _beyond(curve: Curve, at: int, value: float, worst: float, limit: float, where: str) -> str:
    inputs = curve.inputs_at(at)
    text = f"{_at(curve, inputs)} gives {_show(curve, value)}, {_show(curve, worst, difference=True)} {where}"
    text += f" of {_show(curve, limit)}"
    if not curve.channel.actuator:
        text += f"; the stated uncertainty is {_show(curve, curve.channel.tolerance, difference=True)}"
    part = curve.calibration.inputs[curve.main]
    own = inputs[curve.main]
    if not part.boundaries[0] <= own <= part.boundaries[-1] and not curve.channel.actuator:
        text += (
            f" (the calibration covers raw {part.boundaries[0]:.8g} to {part.boundaries[-1]:.8g};"
            " say raw-range in the profile if the channel gives no others)"
        )
    return text + "."


def _jumps(curve: Curve) -> Iterator[Raised]:
    """Find jumps between the segments of a table, which has none by its nature."""
    calibration = curve.calibration
    if calibration.method != "table" or len(calibration.inputs) != 1 or calibration.inputs[0].segments < 2:
        return
    part = calibration.inputs[0]
    edges = np.asarray(part.boundaries[1:-1])
    table = np.asarray(calibration.coefficients).reshape(part.segments, part.degree + 1)
    offsets = np.asarray(part.offsets)
    powers = np.arange(part.degree + 1)
    left = (table[:-1] * (edges - offsets[:-1])[:, None] ** powers).sum(axis=1)
    right = (table[1:] * (edges - offsets[1:])[:, None] ** powers).sum(axis=1)
    scale = 1.0 if curve.channel.actuator else abs(calibration.unit.scale)
    jumps = np.abs(right - left) * scale
    at = int(np.argmax(jumps))
    worst = float(jumps[at])
    least = max(curve.noise, 0.5 if curve.channel.actuator else curve.channel.tolerance)
    if worst > least:
        amount = _show(curve, worst, difference=True)
        edge = f"{edges[at]:.8g}"
        yield "jump", "error", f"the table jumps by {amount} at {edge}, between its segments {at + 1} and {at + 2}."


def _residual(curve: Curve, given: Calibration | None) -> Iterator[Raised]:
    channel, calibration = curve.channel, curve.calibration
    if channel.actuator or not channel.uncertainty > 0:
        return
    stated = _show(curve, channel.uncertainty, difference=True)
    left = residuals(given) if given is not None and not given.actuator else None
    limit = channel.uncertainty * (1 + 1e-6)
    if given is not None and left is not None:
        worst = given.unit.difference_to_si(left.maximum)
        if worst > limit:
            place, _ = left.worst
            shown = _show(curve, worst, difference=True)
            yield (
                "residual",
                "error",
                f"the fit misses its point at raw {place:.8g} by {shown}; the stated uncertainty is {stated}.",
            )
            return
    if calibration.uncertainty is not None:
        own = calibration.unit.difference_to_si(calibration.uncertainty)
        if own > limit:
            shown = _show(curve, own, difference=True)
            yield "residual", "error", f"the calibration is good to {shown} only; the stated uncertainty is {stated}."


def _swapped(new: Calibration, old: Calibration) -> bool:
    """Return True if coefficients 0 and 1 of every cell are exchanged (to a quarter), and were different before."""
    shape = [(part.segments, part.degree) for part in new.inputs]
    if shape != [(part.segments, part.degree) for part in old.inputs] or len(shape) != 1 or shape[0][1] < 1:
        return False
    columns = shape[0][1] + 1
    one = np.asarray(new.coefficients).reshape(-1, columns)
    other = np.asarray(old.coefficients).reshape(-1, columns)
    exchanged = _alike(one[:, 0], other[:, 1]) and _alike(one[:, 1], other[:, 0])
    return exchanged and not (_alike(one[:, 0], other[:, 0]) and _alike(one[:, 1], other[:, 1]))


def _alike(
    one: np.ndarray[tuple[int], np.dtype[np.float64]], other: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> bool:
    return bool(np.allclose(one, other, rtol=ALIKE, atol=1e-30))


def _changed(curve: Curve, before: Curve) -> Iterator[Raised]:
    if len(curve.axes) != len(before.axes) or curve.channel.actuator:
        return
    same = replace(before, axes=curve.axes)
    over = np.abs(curve.difference(same))
    at = int(np.argmax(over))
    worst, span = float(over.flat[at]), curve.channel.high - curve.channel.low
    if math.isfinite(span) and worst > LARGE_CHANGE * span > 0:
        amount = _show(curve, worst, difference=True)
        share = 100 * worst / span
        text = f"against what the node has now it differs by up to {amount} ({share:.0f} % of the range), at "
        yield "changed", "warning", text + f"{_at(curve, curve.inputs_at(at))}."


_SMALLEST_NORMAL: Final = 2.0**-126


@dataclass(frozen=True)
class GuardFinding:
    """One finding: an ``error`` refuses the datasheet (unless a reason to accept it is given), a ``warning`` does not.

    ``message`` goes behind "channel 1: " and has no full stop. Codes: erased, unreadable, inconsistent, unknown, flat,
    overflow, limits, unlimited, reversed, swapped, not-monotone, jump, residual, removed, changed, overdue.
    """

    channel: int
    code: str
    message: str
    severity: Literal["error", "warning"] = "error"


def check_calibration(
    new: Mapping[BlockId, bytes],
    old: Mapping[BlockId, bytes] | None = None,
    profile: Profile | None = None,
    *,
    calibrations: Mapping[int, Calibration] | None = None,
    now: datetime | None = None,
) -> list[GuardFinding]:
    """Judge every calibration among framed TEDS ``new`` (Length to Checksum), by themselves and against ``old``.

    ``calibrations`` are those that the blocks were made from, with their points, for the residuals of the fit; ``now``
    turns the check of due dates on. Errors come before warnings. Never raises on any octets.
    """
    findings: list[GuardFinding] = []
    for channel, access_code in sorted(new):
        if access_code == AccessCode.CALIBRATION:
            given = (calibrations or {}).get(channel)
            findings += _Judge(channel, new, old or {}, profile, given, now).findings()
    for channel, access_code in sorted(old or {}):
        if access_code == AccessCode.CALIBRATION and (channel, AccessCode.CALIBRATION) not in new:
            findings.append(
                GuardFinding(channel, "removed", "the calibration that the node has is taken away.", "warning")
            )
    plain = (replace(finding, message=finding.message.removesuffix(".")) for finding in findings)
    return sorted(plain, key=lambda finding: finding.severity != "error")


def misfit(calibration: Calibration, had: Channel, now: Channel, of: ChannelProfile | None) -> str:
    """Return why a calibration for the channel ``had`` does not fit the channel ``now``; "" if it does.

    Compared: ChanType, DatModel, ModLenth, dimension of the unit, method, raw range, and whether its points are within
    the limits. ``of`` is the profile's channel. Half a sentence, without a full stop.
    """
    if not now.described:
        return "the datasheet has no such channel"
    if not had.described:
        return "nothing says for what channel it was made"
    if had.kind is not now.kind:
        words = [channel.kind.word if channel.kind is not None else "unknown" for channel in (had, now)]
        return f"it was made for another type of channel ({words[0]}, not {words[1]})"
    if had.units != now.units:
        return f"it was made for values in {had.si_unit}, and these are in {now.si_unit}"
    if had.sample is None or now.sample is None:
        return "nothing says how a sample is coded" if had.sample != now.sample else ""
    if (had.sample.model, had.sample.octets) != (now.sample.model, now.sample.octets):
        return f"it was made for samples of {had.sample.name}, and these are {now.sample.name}"
    method = of.calibration.method if of is not None else None
    if method and method != calibration.method:
        return f"this type expects the method {method}, but got {calibration.method}"
    raw = of.raw_range if of is not None else calibration.raw_range or now.sample.raw_range
    return _beyond_raw_range(calibration, had, now, raw) or _points_beyond(calibration, had, now)


def _beyond_raw_range(calibration: Calibration, had: Channel, now: Channel, raw: Range | None) -> str:
    """Return why not, if another converter gives raw values that were never calibrated, or other ones than before."""
    before = calibration.raw_range or (had.sample.raw_range if had.sample is not None else None)
    if raw is None or before is None:
        return "" if raw == before else "it was made for another range of raw values"
    step = 4 * FLOAT32_STEP * max(map(abs, raw)) + (1.0 if now.sample is not None and now.sample.integer else 0.0)
    spans = f"raw {before[0]:.8g} to {before[1]:.8g}", f"raw {raw[0]:.8g} to {raw[1]:.8g}"
    if raw[0] < before[0] - step or raw[1] > before[1] + step:
        return f"it was made for {spans[0]}, and this channel gives {spans[1]}"
    if now.actuator or max(abs(raw[0] - before[0]), abs(raw[1] - before[1])) <= step:
        return ""  # points beyond the range were measured for this very range
    part = next((given for given in calibration.inputs if given.channel == now.number), calibration.inputs[0])
    if part.boundaries[0] < raw[0] - step or part.boundaries[-1] > raw[1] + step:
        return f"it covers raw {part.boundaries[0]:.8g} to {part.boundaries[-1]:.8g}, and this channel gives {spans[1]}"
    return ""


def _points_beyond(calibration: Calibration, had: Channel, now: Channel) -> str:
    """Return which points new limits exclude, as text; the guard checks the old limits."""
    same = [bound for bound in ("low", "high") if getattr(had, bound) == getattr(now, bound)]
    part = calibration.inputs[0]
    if len(same) == 2 or now.full_turn or len(calibration.inputs) > 1 or not now.has_range:
        return ""
    edges = np.asarray(part.boundaries, dtype=np.float64)
    values = edges if now.actuator else evaluate(calibration, edges).value
    values = values * calibration.unit.scale + calibration.unit.offset
    slack = max(now.uncertainty, 0.0) if math.isfinite(now.uncertainty) else 0.0
    slack += 4 * FLOAT32_STEP * max(abs(now.low), abs(now.high))
    for limit, over, name in ((now.low, now.low - values, "low"), (now.high, values - now.high, "high")):
        at = int(np.argmax(over))
        if float(over[at]) > slack:
            return f"its point of {now.show(float(values[at]))} is beyond the {name} limit of {now.show(limit)}"
    return ""


@dataclass(frozen=True)
class _Judge:
    """Everything that is looked at for one channel."""

    number: int
    new: Mapping[BlockId, bytes]
    old: Mapping[BlockId, bytes]
    profile: Profile | None
    given: Calibration | None
    now: datetime | None

    def findings(self) -> Iterator[GuardFinding]:
        octets = self.new[self.number, AccessCode.CALIBRATION]
        if not octets.strip(b"\xff") or not octets.strip(b"\x00"):
            yield self._error("erased", "the Calibration TEDS is erased flash, every octet of it.")
            return
        decoded = decode(octets)
        if not decoded.framed or decoded.verdict in ("malformed", "frame-bad", "frame-and-content-bad"):
            yield self._error("unreadable", "the Calibration TEDS is damaged: its length or checksum is wrong.")
            return
        try:
            calibration = self._calibration(decoded, self.new)
        except BadDataError as error:
            yield self._not_understood(decoded, error)
            return
        damage = list(self._damage(calibration))
        yield from damage
        if not damage:
            yield from self._findings_of(calibration)
        if self.now is not None:
            for text in calibration.date_warnings(self.now):
                yield GuardFinding(self.number, "overdue", text, "warning")

    def _not_understood(self, decoded: DecodedTeds, error: BadDataError) -> GuardFinding:
        """Return an error if the fields are ours; else a foreign form, which cannot be judged."""
        text = f"{error.message} It was not checked."
        if decoded.field("CalInput") is None and decoded.field("Coefs") is None:
            return GuardFinding(self.number, "unknown", text, "warning")
        return self._error("inconsistent", text)

    def _error(self, code: str, message: str) -> GuardFinding:
        return GuardFinding(self.number, code, message)

    def _calibration(self, decoded: DecodedTeds, blocks: Mapping[BlockId, bytes]) -> Calibration:
        channel = self._channel(self.number, blocks)
        return from_decoded(decoded, channel=self.number, units=channel.units, actuator=channel.actuator)

    def _channel(self, number: int, blocks: Mapping[BlockId, bytes]) -> CurveChannel:
        return channel_of(number, blocks, self.profile)

    def _damage(self, calibration: Calibration) -> Iterator[GuardFinding]:
        """Find erased words, or boundaries without which nothing can be computed."""
        for name, values, per_cell in _words(calibration):
            bad = next(
                (n for n, value in enumerate(values) if not math.isfinite(value) or 0 < abs(value) < _SMALLEST_NORMAL),
                None,
            )
            if bad is not None:
                where = f" (segment {bad // per_cell + 1})" if len(values) > per_cell else ""
                text = f"{name} {bad + 1} of {len(values)}{where} is {values[bad]:g}, as erased flash reads."
                yield self._error("erased", text)
        if not any(calibration.coefficients):
            yield self._error("erased", "all coefficients are zero: every reading would become the same value.")
        for number, part in enumerate(calibration.inputs, 1):
            if not part.ascending:
                yield self._error("inconsistent", f"the segment boundaries of input {number} do not ascend.")

    def _findings_of(self, calibration: Calibration) -> Iterator[GuardFinding]:
        channel = self._demanded(self._channel(self.number, self.new), calibration)
        numbers = {part.channel for part in calibration.inputs}
        channels = {number: self._channel(number, self.new) for number in numbers}
        old = self._before(channel)
        curve = curve_of(calibration, channel, channels, also=old)
        before = curve_of(old, channel, channels, also=calibration) if old is not None else None
        for code, severity, message in check(curve, before, self.given):
            yield GuardFinding(self.number, code, message, severity)

    def _demanded(self, channel: CurveChannel, calibration: Calibration) -> CurveChannel:
        """Return the channel with the demands that the Calibration TEDS itself carries, used without a profile."""
        if self.profile is not None and self.profile.channel(self.number) is not None:
            return channel
        raw = calibration.raw_range or channel.raw
        if raw and channel.raw:
            raw = max(raw[0], channel.raw[0]), min(raw[1], channel.raw[1])
        return replace(channel, monotone=calibration.monotone, raw=raw if raw and raw[0] < raw[1] else channel.raw)

    def _before(self, channel: CurveChannel) -> Calibration | None:
        """Return the calibration that the node has now; None if there is none that can be computed and compared."""
        octets = self.old.get((self.number, AccessCode.CALIBRATION))
        if octets is None:
            return None
        had = self._channel(self.number, self.old)
        if (had.units, had.actuator) != (channel.units, channel.actuator):
            return None  # the node had another type
        try:
            calibration = self._calibration(decode(octets), self.old)
        except BadDataError:
            return None
        return None if any(True for _ in self._damage(calibration)) else calibration


def _words(calibration: Calibration) -> Iterator[tuple[str, tuple[float, ...], int]]:
    """Yield every Float32 of a calibration: its name, the words, how many belong to one segment."""
    yield "coefficient", calibration.coefficients, math.prod(part.degree + 1 for part in calibration.inputs)
    for part in calibration.inputs:
        yield "boundary", part.boundaries, 1
        yield "offset", part.offsets, 1
    limits = (calibration.low_limit, calibration.high_limit, calibration.uncertainty)
    yield "limit", tuple(value for value in limits if value is not None and not math.isnan(value)), 1
    yield "zero offset", (calibration.zero_offset,), 1
