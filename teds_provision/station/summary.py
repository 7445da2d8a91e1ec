"""A node in a few lines: its name, and each channel with unit and range."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from teds_provision import teds
from teds_provision.sanitize import printable
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import channel_of


@dataclass(frozen=True)
class ChannelSummary:
    """One TransducerChannel: its name, unit and range as people write them, and whether a calibration is there."""

    number: int
    name: str
    unit: str
    range: str
    calibrated: bool


@dataclass(frozen=True)
class NodeSummary:
    """Name of the node and its channels, from its datasheet."""

    name: str | None
    channels: tuple[ChannelSummary, ...]


def summarise(image: Image, units: Mapping[int, str] | None = None) -> NodeSummary:
    """Decode what people want to see; never raises on any octets.

    ``units``: display units of channels, if the profile names them.
    """
    shown = units or {}
    channels = [
        _channel(image, channel, shown.get(channel, "")) for channel, code in image if code == AccessCode.CHANNEL
    ]
    return NodeSummary(_name(image, 0), tuple(channels))


def _name(image: Image, channel: int) -> str | None:
    octets = image.blocks.get((channel, AccessCode.NAME))
    found = teds.decode(octets).get("TCName") if octets is not None else None
    return printable(found) if isinstance(found, str) else None


def _channel(image: Image, number: int, display: str) -> ChannelSummary:
    channel = replace(channel_of(number, image.blocks), display=display)
    unit = text = ""
    if channel.units_stated and channel.has_range:
        unit, text = channel.shown.text, f"{channel.show(channel.low)} to {channel.show(channel.high)}"
    return ChannelSummary(
        number, _name(image, number) or "", unit, text, (number, AccessCode.CALIBRATION) in image.blocks
    )
