"""A device of Linux's Industrial I/O as a wrapped sensor, by its sysfs (Documentation/ABI/testing/sysfs-bus-iio).

A channel is ``in_TYPE[N][_MODIFIER]_raw`` with value = (raw + offset) × scale, or ``…_input``, which is a value.
``DEVICE`` is ``iio:device0``, the device's name or label, or the path of its folder; ``?root=DIR`` reads ``DIR/sys``
and ``DIR/dev`` instead of ``/sys`` and ``/dev``, for a container or a test.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import parse_qsl

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.files import read_limited
from teds_provision.node.wrapped.description import DEFAULT_PERIOD, WrappedChannel, WrappedSensor
from teds_provision.teds.origin import Origin

_BUS: Final = Path("sys/bus/iio/devices")
_MOST_OCTETS: Final = 4096
_CHANNEL: Final = re.compile(
    r"in_(?P<type>[a-z]+)(?P<index>\d*(?:-[a-z]+\d+)?)(?P<modifier>_[a-z0-9_]+?)?_(?P<form>raw|input)"
)
_SCAN: Final = re.compile(
    r"(?P<order>[bl]e):(?P<sign>[su])(?P<bits>\d+)/(?P<storage>\d+)(?:X\d+)?(?:>>(?P<shift>\d+))?"
)
_FASTEST: Final = 10_000.0
_STANDARD_BITS: Final = 32

_UNITS: Final = {
    "voltage": ("mV", 1.0),
    "altvoltage": ("mV", 1.0),
    "current": ("mA", 1.0),
    "power": ("mW", 1.0),
    "temp": ("degC", 1e-3),
    "accel": ("m/s²", 1.0),
    "gravity": ("m/s²", 1.0),
    "anglvel": ("rad/s", 1.0),
    "angl": ("rad", 1.0),
    "incli": ("degree", 1.0),
    "rot": ("degree", 1.0),
    "magn": ("T", 1e-4),
    "pressure": ("kPa", 1.0),
    "humidityrelative": ("%", 1e-3),
    "positionrelative": ("%", 1e-3),
    "illuminance": ("lx", 1.0),
    "distance": ("m", 1.0),
    "velocity": ("m/s", 1.0),
    "resistance": ("Ω", 1.0),
    "capacitance": ("nF", 1.0),
    "energy": ("J", 1.0),
    "concentration": ("%", 1.0),
    "electricalconductivity": ("S/m", 1.0),
}
"""Unit of each type after scaling, and the factor from IIO's own (milli °C, gauss, milli percent) into it."""


class ScanElement(NamedTuple):
    """Place of a channel in a scan of the buffer: ``place`` orders them, sizes are in bits."""

    place: int
    order: str
    signed: bool
    bits: int
    storage: int
    shift: int


@dataclass(frozen=True)
class IioChannel:
    """One channel: its file, scaling from raw to IIO's unit, and its place in the buffer (None: not in it)."""

    name: str
    file: Path
    type: str
    scale: float
    offset: float
    processed: bool
    scan: ScanElement | None


@dataclass(frozen=True)
class IioDevice:
    """A device's folder in sysfs, and the character device of its buffer."""

    folder: Path
    character: Path
    name: str
    period: float
    stated: bool
    channels: tuple[IioChannel, ...]

    def describe(self) -> WrappedSensor:
        """Return the sensor that a node wraps."""
        if not self.channels:
            raise BadDataError(f"The IIO device {self.name} has no channels that are read.")
        return WrappedSensor(
            Origin("iio", self.name[:60]),
            self.name,
            tuple(self._described(channel) for channel in self.channels),
            str(self.folder),
        )

    def _described(self, channel: IioChannel) -> WrappedChannel:
        unit, factor = _UNITS.get(channel.type, ("count", 1.0))
        notes = (
            [] if channel.type in _UNITS else [f"the type {channel.type} has no unit here: values are plain numbers"]
        )
        if not self.stated:
            notes.append(f"the device states no sampling frequency, so {DEFAULT_PERIOD * 1000:g} ms is assumed")
        scale = channel.scale * factor
        scan = channel.scan
        return WrappedChannel(
            channel.name,
            unit,
            scale,
            channel.offset * scale,
            scan.bits if scan is not None else _STANDARD_BITS if not channel.processed else 64,
            scan.signed if scan is not None else True,
            is_float=channel.processed,
            period=self.period,
            note="; ".join(notes),
        )


def find(text: str) -> IioDevice:
    """Return the device that ``iio:DEVICE`` names; raises NotFoundError, BadDataError, UsageError."""
    place, _, query = text.partition("?")
    options = dict(parse_qsl(query))
    if set(options) - {"root"}:
        raise UsageError(f"iio:{text} has an unknown key.", hint="The only key is root=DIR.")
    root = Path(options.get("root", "/"))
    folder = Path(place) if "/" in place else _by_name(root / _BUS, place)
    if not folder.is_dir():
        raise NotFoundError(f"There is no IIO device in {folder}.", hint="List them: ls /sys/bus/iio/devices")
    period, stated = _period(folder)
    name = _text(folder / "name") or _text(folder / "label") or folder.name
    channels = tuple(sorted(_channels(folder), key=_order))
    return IioDevice(folder, root / "dev" / folder.name, name, period, stated, channels)


def _by_name(bus: Path, name: str) -> Path:
    folders = sorted(bus.glob("iio:device*"))
    for folder in folders:
        if name in (folder.name, _text(folder / "label"), _text(folder / "name")):
            return folder
    known = ", ".join(f"{folder.name} ({_text(folder / 'name') or 'no name'})" for folder in folders) or "none"
    raise NotFoundError(f"There is no IIO device {name!r} in {bus}.", hint=f"There are: {known}.")


def _order(channel: IioChannel) -> tuple[int, str]:
    return (channel.scan.place if channel.scan is not None else 1 << 16, channel.file.name)


def _channels(folder: Path) -> Iterator[IioChannel]:
    seen: set[str] = set()
    for file in sorted(folder.glob("in_*")):
        match = _CHANNEL.fullmatch(file.name)
        if match is None:
            continue
        name = file.name.removeprefix("in_").removesuffix(f"_{match['form']}")
        if name in seen:  # a channel that has both files, in_*_input and in_*_raw: input sorts first
            continue
        seen.add(name)
        processed = match["form"] == "input"
        scale, offset = (
            (1.0, 0.0) if processed else (_shared(folder, match, "scale", 1.0), _shared(folder, match, "offset", 0.0))
        )
        scan = None if processed else _scan(folder, name)
        yield IioChannel(name, file, match["type"], scale, offset, processed, scan)


def _shared(folder: Path, match: re.Match[str], what: str, default: float) -> float:
    """Return a number of the channel itself, else the one that all of its type share."""
    own = f"in_{match['type']}{match['index']}{match['modifier'] or ''}_{what}"
    for name in dict.fromkeys(
        (own, f"in_{match['type']}{match['modifier'] or ''}_{what}", f"in_{match['type']}_{what}")
    ):
        text = _text(folder / name)
        if text:
            return _number(folder / name, text)
    return default


def _number(path: Path, text: str) -> float:
    try:
        number = float(text.split(maxsplit=1)[0])
    except (ValueError, IndexError):
        number = math.nan
    if not math.isfinite(number):
        raise BadDataError(f"{path} holds {text[:40]!r}, which is not a number.")
    return number


def _scan(folder: Path, name: str) -> ScanElement | None:
    for inner in ("scan_elements", "buffer0"):
        kind, index = _text(folder / inner / f"in_{name}_type"), _text(folder / inner / f"in_{name}_index")
        match = _SCAN.fullmatch(kind)
        if match is None or not index.isdecimal():
            continue
        bits, storage, shift = int(match["bits"]), int(match["storage"]), int(match["shift"] or 0)
        if storage in (8, 16, 32, 64) and bits > 0 and bits + shift <= storage:
            return ScanElement(int(index), match["order"], match["sign"] == "s", bits, storage, shift)
    return None


def _period(folder: Path) -> tuple[float, bool]:
    """Return seconds between samples, and whether the device states them."""
    for path in (folder / "sampling_frequency", *sorted(folder.glob("in_*sampling_frequency"))):
        text = _text(path)
        if text:
            hertz = _number(path, text)
            if 0 < hertz <= _FASTEST:
                return 1 / hertz, True
    return DEFAULT_PERIOD, False


def _text(path: Path) -> str:
    """Return the text of a file in sysfs, "" if there is none that can be read."""
    try:
        octets = read_limited(path, _MOST_OCTETS, "sysfs file")
    except (NotFoundError, BadDataError):
        return ""
    return octets.decode(errors="replace").strip()
