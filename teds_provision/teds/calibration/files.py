"""Calibration files: CSV of points or of segments, TOML and JSON of points or coefficients, certificates (DCC).

Metadata of a CSV are lines ``# key: value``; every error names file, line and field.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from difflib import get_close_matches
from itertools import count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from teds_provision.errors import BadDataError, StoreError
from teds_provision.files import read_limited
from teds_provision.lazy import late
from teds_provision.limits import LIMITS, check_size, load_json
from teds_provision.teds.calibration.model import PLAIN, Calibration
from teds_provision.teds.calibration.order import CalibrationOrder, calibration_of
from teds_provision.teds.certificate import CertificateChoice, CertificateReference
from teds_provision.teds.profile.model import ChannelProfile, Profile
from teds_provision.teds.profile.reader import PlacedValue, SourcePlace, TomlTable, parse, read_text
from teds_provision.teds.units import parse_unit

if TYPE_CHECKING:
    from teds_provision.teds.dcc import items, signature
else:  # imports lxml: only for certificates
    items, signature = late("teds_provision.teds.dcc.items"), late("teds_provision.teds.dcc.signature")

# The CSV reader accepts delimiters, decimal commas, headers, units and metadata as instruments and spreadsheets write
# them. Columns whose name begins with "#" are remarks.

MAXIMUM_ROWS: Final = 200_000
_CHANNEL_DIGITS: Final = 5
_LINE: Final = 20_000
RAW: Final = {"raw", "count", "counts", "adc", "code", "digital", "x", "input"}
CHANNEL: Final = {"channel", "ch"}
SEGMENT: Final = ("from", "to", "offset")
REMARK: Final = "#"
_METADATA: Final = re.compile(r"#\s*([A-Za-z][A-Za-z -]*?)\s*:\s*(.*?)\s*\Z")
_UNIT: Final = re.compile(r"\s*(.*?)\s*(?:\[([^\]]*)\]|\(([^)]*)\))?\s*\Z")


@dataclass(frozen=True)
class Row:
    """Numbers of one line."""

    line: int
    channel: int | None
    values: tuple[float, ...]


@dataclass
class CsvTable:
    """A calibration CSV: metadata and unit with their lines, rows of (raw, value), or of segments with coefficients."""

    file: str
    metadata: dict[str, tuple[object, int]] = field(default_factory=dict)
    unit: tuple[object, int] | None = None
    segments: bool = False
    rows: list[Row] = field(default_factory=list)

    def by_channel(self) -> dict[int | None, list[Row]]:
        """Return rows by the channel of their line; None if the file has no such column."""
        groups: dict[int | None, list[Row]] = {}
        for row in self.rows:
            groups.setdefault(row.channel, []).append(row)
        return groups


@dataclass(frozen=True)
class _Columns:
    """Positions of the numbers in a line, and their names for errors."""

    names: tuple[str, ...]
    places: tuple[int, ...]
    channel: int | None = None
    remarks: int = 0


def read_csv(text: str, file: str, keys: Sequence[str]) -> CsvTable:
    """Read a calibration CSV; raises BadDataError naming file, line and field."""
    table = CsvTable(file)
    data = _data_lines(table, text, keys)
    delimiter = _delimiter(data[0][1])
    lines = [(number, _cells(line, delimiter)) for number, line in data]
    columns = _header(table, *lines[0])
    lines = lines if columns is None else lines[1:]
    known = columns or _unnamed(table, *lines[0])
    table.rows = [_row(table, number, cells, known, delimiter != ",") for number, cells in lines]
    if not table.rows:
        raise BadDataError(f"{file}:{data[0][0]}: the file holds a header and no points.")
    return table


def _data_lines(table: CsvTable, text: str, keys: Sequence[str]) -> list[tuple[int, str]]:
    """Return lines that are neither empty nor comments, with their numbers; comments go into the table."""
    file = table.file
    check_size(len(text), LIMITS.text_file, file)
    data: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if stripped.startswith("#"):
            _metadata(table, stripped, number, keys)
        elif stripped.strip(",;\t "):
            data.append((number, line))
    if not data:
        raise BadDataError(
            f"{file}:1: the file holds no points.", hint="It takes lines of raw value and value, like: 512, 10.5"
        )
    long = next((number for number, line in data if len(line) > _LINE), None)
    if long is not None:
        raise BadDataError(f"{file}:{long}: the line has more than {_LINE} characters.")
    if len(data) > MAXIMUM_ROWS:
        raise BadDataError(f"{file}:{data[MAXIMUM_ROWS][0]}: more than {MAXIMUM_ROWS} lines.")
    return data


def _unnamed(table: CsvTable, number: int, cells: list[str]) -> _Columns:
    """Return the columns of a file without header: raw value and value."""
    if len(cells) != 2:
        raise BadDataError(
            f"{table.file}:{number}: {len(cells)} columns and no header.",
            hint='Name them in the first line: "raw, value" or "channel, raw, value".',
        )
    return _Columns(("raw", "value"), (0, 1))


def _metadata(table: CsvTable, line: str, number: int, keys: Sequence[str]) -> None:
    match = _METADATA.match(line)
    if match is None:
        return
    key = match[1].lower().replace(" ", "-")
    if key in keys:
        if key in table.metadata:
            raise BadDataError(f"{table.file}:{number}: {key}: given twice.")
        table.metadata[key] = (match[2], number)
        return
    near = get_close_matches(key[:64], keys, n=1, cutoff=0.8)
    if near:
        raise BadDataError(f'{table.file}:{number}: {key}: there is no such key. Did you mean "{near[0]}"?')


def _delimiter(line: str) -> str:
    for delimiter in (";", "\t", ","):
        if delimiter in line:
            return delimiter
    return " "


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    cells = [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    return cells


def _number(text: str, *, decimal_comma: bool) -> float:
    plain = text.replace(",", ".") if decimal_comma and text.count(",") == 1 else text
    value = float(int(plain, 16)) if plain.lower().startswith("0x") else float(plain)
    if not math.isfinite(value) or "_" in plain:
        raise ValueError(text)
    return value


def _header(table: CsvTable, number: int, cells: list[str]) -> _Columns | None:
    """Return the columns that a header names; None if the first line is data."""
    if all(map(_is_number, cells)):
        return None
    heads = [_name_and_unit(cell) for cell in cells]
    names = [name for name, _ in heads]
    channel = next((at for at, name in enumerate(names) if name in CHANNEL), None)
    remarks = sum(name.startswith(REMARK) for name in names)
    if {"from", "to"} <= set(names):
        return _segment_columns(table, number, names, channel)
    raw, value = _pair_columns(table, number, names, channel)
    unit = heads[value][1]
    if unit:
        table.unit = (unit, number)
    return _Columns(("raw", "value"), (raw, value), channel, remarks)


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    """Return the name in small letters and the unit of ``Torque [N·m]`` or ``Torque (N·m)``."""
    match = _UNIT.match(cell)
    return (match[1].lower(), match[2] or match[3]) if match else ("", None)


def _pair_columns(table: CsvTable, number: int, names: list[str], channel: int | None) -> tuple[int, int]:
    """Return the places of raw value and value: the raw one by its name, else the first."""
    rest = [at for at, name in enumerate(names) if at != channel and not name.startswith(REMARK)]
    if len(rest) != 2:
        raise BadDataError(
            f"{table.file}:{number}: the header names {len(rest)} columns besides the channel; "
            "raw value and value are two."
        )
    raw = next((at for at in rest if names[at] in RAW), rest[0])
    return raw, next(at for at in rest if at != raw)


def _is_number(cell: str) -> bool:
    try:
        _number(cell, decimal_comma=True)
    except (ValueError, OverflowError):
        return False
    return True


def _segment_columns(table: CsvTable, number: int, names: list[str], channel: int | None) -> _Columns:
    wanted = (*SEGMENT, *takewhile(names.__contains__, (f"c{power}" for power in count())))
    twice = next((name for name in wanted if names.count(name) > 1), None)
    if twice is not None:
        raise BadDataError(f'{table.file}:{number}: the column "{twice}" appears twice.')
    wrong = _wrong_columns(names if channel is None else names[:channel] + names[channel + 1 :], wanted)
    if wrong:
        raise BadDataError(
            f"{table.file}:{number}: {wrong}: a table of segments has from, to, offset, c0, c1 and so on."
        )
    table.segments = True
    return _Columns(wanted, tuple(names.index(name) for name in wanted), channel)


def _wrong_columns(names: list[str], wanted: tuple[str, ...]) -> str:
    for name in names:
        if name not in wanted:
            return f'"{name}" is no column'
    return next((f'the column "{name}" is missing' for name in (*SEGMENT, "c0") if name not in names), "")


def _row(table: CsvTable, number: int, cells: list[str], columns: _Columns, decimal_comma: bool) -> Row:
    asked = len(columns.places) + (columns.channel is not None)
    if not asked <= len(cells) <= asked + columns.remarks or len(cells) <= max(columns.places):
        raise BadDataError(f"{table.file}:{number}: {len(cells)} columns where {asked + columns.remarks} are expected.")
    values = []
    for name, place in zip(columns.names, columns.places, strict=True):
        try:
            values.append(_number(cells[place], decimal_comma=decimal_comma))
        except (ValueError, OverflowError) as error:
            raise BadDataError(f'{table.file}:{number}: {name}: "{cells[place][:40]}" is not a number.') from error
    channel = None
    if columns.channel is not None:
        text = cells[columns.channel]
        if not (text.isascii() and text.isdecimal() and len(text) <= _CHANNEL_DIGITS):
            raise BadDataError(f'{table.file}:{number}: channel: "{text[:40]}" is not the number of a channel.')
        channel = int(text)
    return Row(number, channel, tuple(values))


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


CERTIFICATE: Final = ".xml"
"""Ending of a certificate's name."""


def load_calibrations(
    path: Path, profile: Profile, choice: CertificateChoice | None = None, *, due: datetime | None = None
) -> dict[int, Calibration]:
    """Read a calibration file for the channels of a profile: by channel number, fitted as file or profile ask.

    ``choice`` decides how a certificate is read; ``due`` is when the next calibration is due, whatever the file and
    the profile state. Raises NotFoundError (no such file) and BadDataError (file, line, field, and what is wrong), and
    for a certificate UsageError (an unclear item, no lxml) and NotAuthenticError (a bad signature).
    """
    if path.suffix.lower() == CERTIFICATE:
        octets = read_limited(path, LIMITS.certificate, "certificate", failure=StoreError)
        found = read_certified(octets, str(path), profile, choice)
    else:
        found = read_calibrations(read_text(path), str(path), profile, choice.channel if choice is not None else None)
        found = _for_channel(found, choice, str(path))
    return {number: _with_due(calibration, due, str(path)) for number, calibration in found.items()}


def _for_channel(found: dict[int, Calibration], choice: CertificateChoice | None, file: str) -> dict[int, Calibration]:
    """Return the contents of a file for the channel that the caller names, all of it if none is named."""
    if choice is None or choice.channel is None:
        return found
    if choice.channel not in found:
        raise BadDataError(f"{file} holds no calibration of channel {choice.channel}.")
    return {choice.channel: found[choice.channel]}


def _with_due(calibration: Calibration, due: datetime | None, file: str) -> Calibration:
    if due is None:
        return calibration
    if calibration.date is None:
        raise BadDataError(f"{file} states no date, so it cannot be due on {due:%Y-%m-%d}.", hint="Add # date: to it.")
    seconds = (due - calibration.date).total_seconds()
    if not 0 < seconds < 2**32:
        raise BadDataError(f"A calibration of {calibration.date:%Y-%m-%d} cannot be due on {due:%Y-%m-%d}.")
    return replace(calibration, interval=seconds)


def read_certified(
    octets: bytes, file: str, profile: Profile, choice: CertificateChoice | None = None
) -> dict[int, Calibration]:
    """Read a certificate for the one channel of a profile that it is for; see :func:`load_calibrations`."""
    wanted = choice or CertificateChoice()
    certificate = signature.read_checked(octets, file, wanted.trusted, datetime.now(UTC))
    channel = _certified_channel(certificate.file, profile, wanted.channel)
    item = items.chosen_item(certificate, channel, wanted)
    calibration = calibration_of(items.order_of(certificate, item, channel), channel)
    reference = CertificateReference(
        certificate.number,
        certificate.laboratory,
        certificate.calibrated.isoformat(),
        certificate.sha256,
        certificate.signature,
        (*certificate.warnings, *certificate.unchecked),
    )
    reference.encode()  # raises if the number is too large
    return {channel.number: replace(calibration, certificate=reference)}


def _certified_channel(file: str, profile: Profile, number: int | None) -> ChannelProfile:
    if number is None:
        wanting = [channel for channel in profile.channels if channel.calibration.required] or profile.channels
        if len(wanting) == 1:
            return wanting[0]
        raise BadDataError(
            f"{profile.name} has {len(profile.channels)} channels: say which one {file} is for.",
            hint=f"Put its number before the file: --calibration {wanting[0].number}={file}" if wanting else "",
        )
    channel = profile.channel(number)
    if channel is None:
        raise BadDataError(f"{profile.name} has {_numbers_of(profile)}, not {number}.")
    return channel


def read_calibrations(text: str, file: str, profile: Profile, channel: int | None = None) -> dict[int, Calibration]:
    """Read calibrations as :func:`load_calibrations` does, from text.

    The ending of the name ``file`` decides: .toml, .json, .xml for a certificate, else CSV. ``channel``: read those
    of this channel alone, and take one that names no channel as its own; None: all, and such a one is for the only
    channel of the profile that can be meant.
    """
    if Path(file).suffix.lower() == CERTIFICATE:
        return read_certified(text.encode(), file, profile)
    match Path(file).suffix.lower():
        case ".toml":
            orders = _from_table(parse(text, file), file)
        case ".json":
            orders = _from_table(_json(text, file), file)
        case _:
            orders = _from_csv(read_csv(text, file, CSV_KEYS))
    out: dict[int, Calibration] = {}
    for order in orders:
        if channel is not None:
            order.values.setdefault("channel", (channel, order.line))
        for meant in _channels(order, profile):
            if channel is not None and meant.number != channel:
                continue
            if meant.number in out:
                raise order.wrong("channel", f"channel {meant.number} has two calibrations in this file.")
            out[meant.number] = calibration_of(order, meant)
    return out


def fit_points(text: str, file: str, *, method: str | None = None, degree: int | None = None) -> dict[int, Calibration]:
    """Fit the points of a CSV as they are, by channel number, without a profile's demands.

    ``method`` and ``degree`` take precedence over those of the file. Raises BadDataError (file, line, field) as reading
    one does, and for a file of segments, which has no points.
    """
    table = read_csv(text, file, CSV_KEYS)
    out: dict[int, Calibration] = {}
    for order in _from_csv(table):
        if table.segments:
            raise order.wrong("", "these are segments with coefficients; there are no points to fit.")
        for key, value in (("method", method), ("degree", degree)):
            if value is not None:
                order.values[key] = (value, order.line)
        number = int(order.number("channel") or 1)
        unit = order.get("unit")
        out[number] = calibration_of(
            order, ChannelProfile(number, "", parse_unit(str(unit)) if unit else PLAIN, _SENSOR)
        )
    return out


_SENSOR: Final[Mapping[str, object]] = {"ChanType": 0}


def _from_csv(table: CsvTable) -> list[CalibrationOrder]:
    orders = []
    for channel, rows in table.by_channel().items():
        order = CalibrationOrder(table.file, rows[0].line, dict(table.metadata))
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


def _json(text: str, file: str) -> TomlTable:
    data = load_json(text, "the calibration", octets=LIMITS.text_file, file=file)
    if not isinstance(data, dict):
        raise BadDataError(f"{file}:1: an object is expected, with points or coefficients.")

    def line(key: str) -> SourcePlace:
        at = text.find(f'"{key}"')
        return SourcePlace(file, text.count("\n", 0, max(at, 0)) + 1)

    def table(value: Mapping[str, object], where: SourcePlace, path: str) -> TomlTable:
        return TomlTable({key: entry(part, line(key), f"{path}{key}") for key, part in value.items()}, where, path)

    def entry(value: object, where: SourcePlace, path: str) -> PlacedValue | TomlTable:
        if isinstance(value, dict):
            return table(value, where, f"{path}.")
        if isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
            return PlacedValue(tuple(table(part, where, f"{path}[{n}].") for n, part in enumerate(value)), where)
        return PlacedValue(value, where)

    return table(data, SourcePlace(file, 1), "")


def _from_table(table: TomlTable, file: str) -> list[CalibrationOrder]:
    many = table.entries.get("calibration")
    if isinstance(many, PlacedValue) and isinstance(many.value, tuple):
        shared = {key: entry for key, entry in table.entries.items() if key != "calibration"}
        return [_order(TomlTable({**shared, **part.entries}, part.where), file) for part in many.value]
    return [_order(table, file)]


def _order(table: TomlTable, file: str) -> CalibrationOrder:
    order = CalibrationOrder(file, table.where.line)
    for key, entry in table.entries.items():
        if key not in KEYS:
            near = get_close_matches(key[:64], KEYS, n=1)
            guess = f' Did you mean "{near[0]}"?' if near else f" Known are: {', '.join(KEYS)}."
            raise BadDataError(f"{entry.where}: {key}: there is no such key.{guess}")
        if key == "calibration":
            raise BadDataError(f"{entry.where}: {key}: tables [[calibration]] are expected.")
        if isinstance(entry, TomlTable):
            raise BadDataError(f"{entry.where}: {key}: a value is expected here, not a table.")
        order.values[key] = (entry.value, entry.where.line)
    return order


def _only_channel(order: CalibrationOrder, profile: Profile) -> ChannelProfile:
    """Return the only channel that needs a calibration, or the only one that exists."""
    wanting = [channel for channel in profile.channels if channel.calibration.required] or profile.channels
    if len(wanting) != 1:
        named = f"name the one that it is for, in a line '# channel: N' or as --calibration N={order.file}."
        raise order.wrong("channel", f"{profile.name} has {len(profile.channels)} channels: {named}")
    return wanting[0]


def _channels(order: CalibrationOrder, profile: Profile) -> list[ChannelProfile]:
    value = order.get("channel")
    if value is None:
        return [_only_channel(order, profile)]
    if isinstance(value, str) and value.strip() == "all":
        return list(profile.channels)
    match = _CHANNELS.match(str(value).strip()) if not isinstance(value, bool) else None
    if match is None:
        given = repr(value) if isinstance(value, str | int | float) else "a list; several channels: [[calibration]]"
        raise order.wrong("channel", f'a channel is a number, a range like 1-12, or "all", not {given}.')
    low, high = int(match[1]), int(match[2] or match[1])
    found = [channel for channel in profile.channels if low <= channel.number <= high]
    if len(found) != high - low + 1:
        raise order.wrong("channel", f"{profile.name} has {_numbers_of(profile)}, not {value}.")
    return found


def _numbers_of(profile: Profile) -> str:
    many = len(profile.channels)
    return "channel 1" if many == 1 else f"channels 1 to {many}"
