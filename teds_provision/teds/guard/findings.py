"""The guard: refuses calibrations of the kinds that have hurt robots before.

Erased words, a sign or slope reversed, gain and offset swapped, a table that is not monotone where it must be, results
beyond the limits, a fit worse than the stated uncertainty. Looked at over every raw value that the channel can give:
all that its data model allows, or the ``raw-range`` of its profile. Findings speak in physical units.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Final, Literal

from teds_provision.errors import BadData
from teds_provision.teds.calibration.decoded import from_decoded
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Decoded
from teds_provision.teds.guard import checks as guard_checks
from teds_provision.teds.guard.curve import channel_of, curve_of
from teds_provision.teds.image import BlockId

if TYPE_CHECKING:
    from teds_provision.teds.guard.curve import Channel
    from teds_provision.teds.profile.model import Profile

_SMALLEST_NORMAL: Final = 2.0**-126


@dataclass(frozen=True)
class GuardFinding:
    """One finding: an ``error`` refuses the datasheet (unless a person says why it is right), a ``warning`` does not.

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
        except BadData as error:
            yield self._not_understood(decoded, error)
            return
        damage = list(self._damage(calibration))
        yield from damage
        if not damage:
            yield from self._judged(calibration)
        if self.now is not None:
            for text in calibration.date_warnings(self.now):
                yield GuardFinding(self.number, "overdue", text, "warning")

    def _not_understood(self, decoded: Decoded, error: BadData) -> GuardFinding:
        """An error where the fields are ours; else somebody else's form, of which nothing can be said."""
        text = f"{error.message} It was not checked."
        if decoded.field("CalInput") is None and decoded.field("Coefs") is None:
            return GuardFinding(self.number, "unknown", text, "warning")
        return self._error("inconsistent", text)

    def _error(self, code: str, message: str) -> GuardFinding:
        return GuardFinding(self.number, code, message)

    def _calibration(self, decoded: Decoded, blocks: Mapping[BlockId, bytes]) -> Calibration:
        channel = self._channel(self.number, blocks)
        return from_decoded(decoded, channel=self.number, units=channel.units, actuator=channel.actuator)

    def _channel(self, number: int, blocks: Mapping[BlockId, bytes]) -> Channel:
        return channel_of(number, blocks, self.profile)

    def _damage(self, calibration: Calibration) -> Iterator[GuardFinding]:
        """Words that were erased, or boundaries without which nothing can be computed."""
        for name, values, per_cell in _words(calibration):
            bad = next((n for n, value in enumerate(values) if _looks_erased(value)), None)
            if bad is not None:
                where = f" (segment {bad // per_cell + 1})" if len(values) > per_cell else ""
                text = f"{name} {bad + 1} of {len(values)}{where} is {values[bad]:g}, as erased flash reads."
                yield self._error("erased", text)
        if not any(calibration.coefficients):
            yield self._error("erased", "all coefficients are zero: every reading would become the same value.")
        for number, part in enumerate(calibration.inputs, 1):
            if not part.ascending:
                yield self._error("inconsistent", f"the segment boundaries of input {number} do not ascend.")

    def _judged(self, calibration: Calibration) -> Iterator[GuardFinding]:
        channel = self._demanded(self._channel(self.number, self.new), calibration)
        numbers = {part.channel for part in calibration.inputs}
        channels = {number: self._channel(number, self.new) for number in numbers}
        old = self._before(channel)
        curve = curve_of(calibration, channel, channels, also=old)
        before = curve_of(old, channel, channels, also=calibration) if old is not None else None
        for code, severity, message in guard_checks.check(curve, before, self.given):
            yield GuardFinding(self.number, code, message, severity)

    def _demanded(self, channel: Channel, calibration: Calibration) -> Channel:
        """Without a profile, what the Calibration TEDS itself carries of its type's demands counts."""
        if self.profile is not None and self.profile.channel(self.number) is not None:
            return channel
        raw = calibration.raw_range or channel.raw
        if raw and channel.raw:
            raw = max(raw[0], channel.raw[0]), min(raw[1], channel.raw[1])
        return replace(channel, monotone=calibration.monotone, raw=raw if raw and raw[0] < raw[1] else channel.raw)

    def _before(self, channel: Channel) -> Calibration | None:
        """Calibration that the node has now; None where there is none that can be computed and compared."""
        octets = self.old.get((self.number, AccessCode.CALIBRATION))
        if octets is None:
            return None
        had = self._channel(self.number, self.old)
        if (had.units, had.actuator) != (channel.units, channel.actuator):
            return None  # the node was of another type
        try:
            calibration = self._calibration(decode(octets), self.old)
        except BadData:
            return None
        return None if any(True for _ in self._damage(calibration)) else calibration


def _words(calibration: Calibration) -> Iterator[tuple[str, tuple[float, ...], int]]:
    """Every Float32 of a calibration: what it is, the words, how many belong to one segment."""
    yield "coefficient", calibration.coefficients, math.prod(part.degree + 1 for part in calibration.inputs)
    for part in calibration.inputs:
        yield "boundary", part.boundaries, 1
        yield "offset", part.offsets, 1
    limits = (calibration.low_limit, calibration.high_limit, calibration.uncertainty)
    yield "limit", tuple(value for value in limits if value is not None and not math.isnan(value)), 1
    yield "zero offset", (calibration.zero_offset,), 1


def _looks_erased(value: float) -> bool:
    return not math.isfinite(value) or 0 < abs(value) < _SMALLEST_NORMAL
