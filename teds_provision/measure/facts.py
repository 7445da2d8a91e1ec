"""From a signed datasheet to the facts that go with every value."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from teds_provision.measure.blocks import ChannelFacts
from teds_provision.measure.blocks import Kind as KindWord
from teds_provision.teds.sheet import Channel, Kind, Sheet

_WORDS: dict[Kind, KindWord] = {Kind.SENSOR: "sensor", Kind.ACTUATOR: "actuator", Kind.EVENT_SENSOR: "event"}


def facts_of(sheet: Sheet, channel: Channel, *, name: str, fingerprint: str, period: float | None) -> ChannelFacts:
    """Facts of one channel; ``name`` of the node, ``fingerprint`` of its Security TEDS (64 hex digits).

    Values, limits and uncertainty are in the SI unit of the datasheet; ``period`` in seconds, which events do not have.
    """
    calibrated, due = channel.calibrated_at, channel.due
    return ChannelFacts(
        uuid=sheet.uuid.hex(),
        node=name or sheet.meta.name,
        number=channel.number,
        name=channel.name,
        kind=_WORDS.get(channel.kind or Kind.SENSOR, "sensor"),
        unit=channel.si_unit,
        units=channel.units,
        shown_unit=channel.unit.text,
        low=_known(channel.low),
        high=_known(channel.high),
        uncertainty=_known(channel.stated_uncertainty),
        calibrated=calibrated.date().isoformat() if calibrated else None,
        due=due.date().isoformat() if due else None,
        overdue=channel.overdue(datetime.now(UTC)),
        fingerprint=fingerprint,
        sample_form=channel.sample.name if channel.sample else "",
        period=None if channel.kind == Kind.EVENT_SENSOR else period,
        vector=next((group for group in sheet.meta.vectors if channel.number in group), ()),
    )


def _known(number: float) -> float | None:
    return number if math.isfinite(number) else None
