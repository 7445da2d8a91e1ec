"""Calibration files: CSV of measured points or of segments, TOML and JSON of points or ready coefficients.

Metadata of a CSV stand in lines ``# key: value``; every error names file, line and field.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Final

from teds_provision.errors import BadData
from teds_provision.limits import LIMITS, load_json
from teds_provision.teds.calibration.csv_text import CsvTable, read_csv
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.order import Order, calibration_of
from teds_provision.teds.profile.model import ChannelProfile, Profile
from teds_provision.teds.profile.reader import Item, Table, Where, parse, read_text

KEYS: Final = (
    "channel",
    "date",
    "interval",
    "method",
    "degree",
    "unit",
    "uncertainty",
    "tolerance",
    "zero-offset",
    "low-limit",
    "high-limit",
    "by",
    "points",
    "slope",
    "intercept",
    "coefficients",
    "boundaries",
    "offsets",
    "inputs",
    "calibration",
)
CSV_KEYS: Final = KEYS[:12]
_CHANNELS: Final = re.compile(r"([0-9]{1,5})(?:\s*-\s*([0-9]{1,5}))?\Z")


def load_calibrations(path: Path, profile: Profile) -> dict[int, Calibration]:
    """Read a calibration file for the channels of a profile: by channel number, fitted as file or profile ask.

    Raises NotFound (no such file) and BadData (file, line, field, and what is wrong).
    """
    return read_calibrations(read_text(path), str(path), profile)


def read_calibrations(text: str, file: str, profile: Profile) -> dict[int, Calibration]:
    """As :func:`load_calibrations`, from text; the ending of the name ``file`` decides: .toml, .json, else CSV."""
    match Path(file).suffix.lower():
        case ".toml":
            orders = _from_table(parse(text, file), file)
        case ".json":
            orders = _from_table(_json(text, file), file)
        case _:
            orders = _from_csv(read_csv(text, file, CSV_KEYS))
    out: dict[int, Calibration] = {}
    for order in orders:
        for channel in _channels(order, profile):
            if channel.number in out:
                raise order.wrong("channel", f"channel {channel.number} has two calibrations in this file.")
            out[channel.number] = calibration_of(order, channel)
    return out


def _from_csv(table: CsvTable) -> list[Order]:
    orders = []
    for channel, rows in table.by_channel().items():
        order = Order(table.file, rows[0].line, dict(table.metadata))
        if channel is not None:
            order.values["channel"] = (channel, rows[0].line)
        if table.unit and "unit" not in order.values:
            order.values["unit"] = table.unit
        if table.segments:
            order.values["segments"] = ([row.values for row in rows], rows[0].line)
        else:
            order.values["points"] = ([list(row.values) for row in rows], rows[0].line)
        orders.append(order)
    return orders


def _json(text: str, file: str) -> Table:
    data = load_json(text, "the calibration", octets=LIMITS.text_file, file=file)
    if not isinstance(data, dict):
        raise BadData(f"{file}:1: an object is expected, with points or coefficients.")

    def line(key: str) -> Where:
        at = text.find(f'"{key}"')
        return Where(file, text.count("\n", 0, max(at, 0)) + 1)

    def table(value: Mapping[str, object], where: Where, path: str) -> Table:
        return Table({key: entry(part, line(key), f"{path}{key}") for key, part in value.items()}, where, path)

    def entry(value: object, where: Where, path: str) -> Item | Table:
        if isinstance(value, dict):
            return table(value, where, f"{path}.")
        if isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
            return Item(tuple(table(part, where, f"{path}[{n}].") for n, part in enumerate(value)), where)
        return Item(value, where)

    return table(data, Where(file, 1), "")


def _from_table(table: Table, file: str) -> list[Order]:
    many = table.entries.get("calibration")
    if isinstance(many, Item) and isinstance(many.value, tuple):
        shared = {key: entry for key, entry in table.entries.items() if key != "calibration"}
        return [_order(Table({**shared, **part.entries}, part.where), file) for part in many.value]
    return [_order(table, file)]


def _order(table: Table, file: str) -> Order:
    order = Order(file, table.where.line)
    for key, entry in table.entries.items():
        if key not in KEYS or key == "calibration" or isinstance(entry, Table):
            near = get_close_matches(key[:64], KEYS, n=1)
            guess = f' Did you mean "{near[0]}"?' if near else f" Known are: {', '.join(KEYS)}."
            raise BadData(f"{entry.where}: {key}: there is no such key.{guess}")
        order.values[key] = (entry.value, entry.where.line)
    return order


def _only_channel(order: Order, profile: Profile) -> ChannelProfile:
    """The one channel that wants a calibration, or the one that there is."""
    wanting = [channel for channel in profile.channels if channel.calibration.required] or profile.channels
    if len(wanting) != 1:
        raise order.wrong("channel", f"{profile.name} has {len(profile.channels)} channels: say which one this is for.")
    return wanting[0]


def _channels(order: Order, profile: Profile) -> list[ChannelProfile]:
    value = order.get("channel")
    if value is None:
        return [_only_channel(order, profile)]
    if isinstance(value, str) and value.strip() == "all":
        return list(profile.channels)
    match = _CHANNELS.match(str(value).strip()) if not isinstance(value, bool) else None
    if match is None:
        raise order.wrong("channel", f'a channel is a number, a range like 1-12, or "all", not {value!r}.')
    low, high = int(match[1]), int(match[2] or match[1])
    found = [channel for channel in profile.channels if low <= channel.number <= high]
    if len(found) != high - low + 1:
        raise order.wrong("channel", f"{profile.name} has the channels 1 to {len(profile.channels)}, not {value}.")
    return found
