"""Facts that a node's profile adds to its channels beside the datasheet: display unit, frame, deviation."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path

from teds_provision.errors import TedsProvisionError
from teds_provision.station.station import Station
from teds_provision.teds.profile import ChannelProfile, default_folders, find_profile, load_profile


def shown_units(station: Station, uuid: bytes) -> Mapping[int, str]:
    """Return the display unit of each channel whose profile names one; empty for a profile that cannot be read.

    Values are computed, published and kept in SI whatever it is.
    """
    return units_of(channel_profiles(station, uuid).values())


def units_of_profile(name: str | None, home: Path) -> Mapping[int, str]:
    """Return the unit of each channel for which a profile names one; none without a profile that can be read."""
    return units_of(_channels_of(name, home).values()) if name else {}


def units_of(channels: Iterable[ChannelProfile]) -> dict[int, str]:
    """Return the display unit of each of these channels that names one."""
    return {channel.number: channel.display for channel in channels if channel.display}


def channel_profiles(station: Station, uuid: bytes) -> Mapping[int, ChannelProfile]:
    """Return the channels of a node's profile by number; empty if it has none, or one that cannot be read."""
    record = station.nodes.get(uuid)
    return _channels_of(record.profile, station.home) if record is not None and record.profile else {}


def _channels_of(name_or_path: str, home: Path) -> Mapping[int, ChannelProfile]:
    folders = default_folders(home)
    try:
        path = find_profile(name_or_path, folders)
        return _read(path, folders, path.stat().st_mtime_ns, int(time.monotonic()))
    except (TedsProvisionError, OSError):
        return {}


@lru_cache(maxsize=64)  # a plant has a thousand nodes, but a dozen types
def _read(path: Path, folders: tuple[Path, ...], _changed: int, _second: int) -> Mapping[int, ChannelProfile]:
    """Read the channels of a profile; again each second, as the profiles that it extends may change."""
    return {channel.number: channel for channel in load_profile(path, folders).channels}
