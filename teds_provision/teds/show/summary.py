"""What a TEDS means beyond its fields: place and time of a UUID, range, calibration and due date, keys, weak codes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import datetime

from teds_provision.errors import BadData
from teds_provision.teds.calibration.decoded import from_decoded
from teds_provision.teds.codec import security
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.keyforms import read_key
from teds_provision.teds.codec.model import Decoded, TimeInstance
from teds_provision.teds.codec.uuid import unpack_uuid
from teds_provision.teds.sheet import channel_from, described
from teds_provision.teds.show.values import FINGERPRINT_DIGITS, Context, fingerprint, instant

_PROFILE_VERSION = "ProfileVersion"

Line = tuple[str, str]


def summary_of(decoded: Decoded, context: Context, now: datetime) -> tuple[Line, ...]:
    """Lines of (label, text) for people."""
    match decoded.access_code:
        case AccessCode.META:
            return tuple(_uuid(decoded, context))
        case AccessCode.CHANNEL:
            return tuple(_range(decoded, context))
        case AccessCode.CALIBRATION:
            return tuple(_calibration(decoded, context, now))
        case AccessCode.SECURITY:
            return tuple(_security(decoded, context))
        case _:
            return ()


def _uuid(decoded: Decoded, _context: Context) -> Iterator[Line]:
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


def _range(decoded: Decoded, context: Context) -> Iterator[Line]:
    channel = channel_from(decoded)
    if context.unit is None or not channel.has_range:
        return
    text = f"{channel.show(channel.low)} to {channel.show(channel.high)}"
    if not math.isnan(channel.uncertainty):
        text += f", uncertainty {channel.show(channel.uncertainty, difference=True)}"
    yield "range", text


def _calibration(decoded: Decoded, context: Context, now: datetime) -> Iterator[Line]:
    own = described(context.channel or 1, context.beside)
    try:
        calibration = from_decoded(decoded, channel=context.channel, units=own.units, actuator=own.actuator)
    except BadData as error:
        yield "calibration", f"{error.message} {error.hint}".strip()
        return
    segments = " × ".join(str(part.segments) for part in calibration.inputs)
    degrees = ", ".join(str(part.degree) for part in calibration.inputs)
    yield "method", f"{calibration.method}: {segments} segment{'' if segments == '1' else 's'} of degree {degrees}"
    if calibration.date is not None:
        yield "calibrated", f"{calibration.date:%Y-%m-%d}"
    if calibration.due is not None:
        yield "due", f"{calibration.due:%Y-%m-%d}{' (overdue)' if calibration.overdue(now) else ''}"


def _security(decoded: Decoded, context: Context) -> Iterator[Line]:
    ours = decoded.field(_PROFILE_VERSION) is not None
    if not ours:
        yield "kind", "somebody else's Security TEDS (no field 105): shown, never trusted"
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
        yield from _form(decoded)


def _keys(decoded: Decoded) -> Iterator[Line]:
    for name, label in (("NodePublicKey", "node"), ("BaseStationPublicKey", "station")):
        field = decoded.field(name)
        point = read_key(field.raw).point if field is not None else None
        if point is not None:
            digits = fingerprint(point)[:FINGERPRINT_DIGITS]
            yield f"{label} key", f"fingerprint {digits} (a hint, not an anchor of trust)"


def _form(decoded: Decoded) -> Iterator[Line]:
    try:
        security.decode(decoded.octets)
    except BadData as error:
        yield "form", f"not canonical, so never authentic: {error.message}"
