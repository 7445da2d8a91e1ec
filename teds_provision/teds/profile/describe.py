"""A profile as plain data, in the units that its author wrote: for ``profile show`` and JSON."""

from __future__ import annotations

from typing import Any, Final

from teds_provision.teds.profile.keys import CHANNEL_TYPES
from teds_provision.teds.profile.load import Listed
from teds_provision.teds.profile.model import ChannelProfile, Profile

_TYPES: Final = {code: name for name, code in CHANNEL_TYPES.items()}


def describe(profile: Profile) -> dict[str, Any]:
    """Plain data of a profile; limits and uncertainty in the channel's own unit, times in seconds."""
    return {
        **summary(profile),
        "description": profile.description,
        "node_name": profile.tim_name,
        "extends": list(profile.lineage[1:]),
        "meta": {name: value for name, value in profile.meta if isinstance(value, (int, float))},
        "channels": [describe_channel(channel) for channel in profile.channels],
        "warnings": list(profile.warnings),
    }


def summary(profile: Profile) -> dict[str, Any]:
    """The line of a profile in a list."""
    return {
        "name": profile.name,
        "title": profile.title,
        "file": profile.file,
        "abstract": profile.abstract,
        "links": list(profile.links),
        "channels": len(profile.channels),
    }


def listed(entry: Listed) -> dict[str, Any]:
    """The line of a file found in a folder, with its error where it cannot be read."""
    if entry.profile is None:
        return {"name": entry.name, "file": str(entry.path), "error": entry.error}
    return summary(entry.profile)


def describe_channel(channel: ChannelProfile) -> dict[str, Any]:
    """Plain data of one channel."""
    unit, demand = channel.unit, channel.calibration
    period = channel.fields.get("SPeriod")
    return {
        "number": channel.number,
        "name": channel.name,
        "type": _TYPES.get(channel.type, str(channel.type)),
        "unit": unit.text,
        "low_limit": unit.from_si(channel.low_limit),
        "high_limit": unit.from_si(channel.high_limit),
        "uncertainty": unit.difference_from_si(channel.uncertainty),
        "raw_range": list(channel.raw_range) if channel.raw_range else None,
        "sampling_period": period if isinstance(period, (int, float)) else None,
        "calibration": {
            "required": demand.required,
            "method": demand.method,
            "degree": demand.degree,
            "monotone": demand.monotone,
            "interval": demand.interval,
            "zero_offset": demand.zero_offset,
            "standard_deviation": demand.standard_deviation,
        },
    }
