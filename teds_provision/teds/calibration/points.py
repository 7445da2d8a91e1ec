"""A calibration CSV that grows point by point, as `calibrate capture` writes it and every calibration file is read."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from typing import Final

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.teds.calibration.files import CSV_KEYS, read_csv
from teds_provision.teds.units import WrittenUnit, parse_unit

_HEAD: Final = re.compile(r"channel, raw, value \[([^\]]*)\], # spread, # count")
_DATE: Final = re.compile(r"# date: \d{4}-\d\d-\d\d$", re.MULTILINE)
_NODE: Final = re.compile(r"# node: ([0-9a-f]{20})$", re.MULTILINE)


@dataclass(frozen=True)
class Point:
    """One captured point: mean ``raw`` of ``count`` samples, their standard deviation, the reference in SI units."""

    channel: int
    raw: float
    reference: float
    spread: float
    count: int


def with_point(text: str, file: str, point: Point, *, node: str, unit: WrittenUnit, today: date) -> str:
    """Return the text of a file with one more point; an empty text becomes a new file in ``unit``.

    Values are in the unit of the file. Raises PolicyError if the file is of another node, BadDataError if it is no
    calibration CSV with these columns, or its unit is of another kind.
    """
    if not text:
        head = f"# node: {node}\n# date: {today}\nchannel, raw, value [{unit.text}], # spread, # count\n"
        return head + _row(point, unit)
    heads = [found for line in text.splitlines() if (found := _HEAD.fullmatch(line.strip()))]
    if len(heads) != 1:
        raise BadDataError(
            f"{file} is no file that capture wrote: its columns are others.",
            hint="Name a new file; the columns are: channel, raw, value [unit], # spread, # count.",
        )
    read_csv(text, file, CSV_KEYS)
    owner = _NODE.search(text)
    if owner is not None and owner[1] != node:
        raise PolicyError(f"{file} holds points of node {owner[1]}, not of {node}.", hint="Name another file.")
    own = parse_unit(heads[0][1])
    if own.units != unit.units:
        raise BadDataError(
            f"{file} holds values in {own.text}; this channel's are in {unit.text}.", hint="Name another file."
        )
    dated = _DATE.sub(f"# date: {today}", text)
    return dated + ("" if dated.endswith("\n") else "\n") + _row(point, own)


def node_of(text: str) -> str:
    """Return the UUID of the node that the points belong to, 20 hex digits; "" if the file names none."""
    owner = _NODE.search(text)
    return owner[1] if owner is not None else ""


def _row(point: Point, unit: WrittenUnit) -> str:
    value = f"{unit.from_si(point.reference):.9g}"
    return f"{point.channel}, {point.raw:.9g}, {value}, {point.spread:.3g}, {point.count}\n"


def points_of(text: str, file: str) -> list[Mapping[str, float | int | None]]:
    """Return the points of such a file as plain data: channel, raw, value (in the file's unit), spread, count."""
    table = read_csv(text, file, CSV_KEYS)
    lines = text.splitlines()
    out: list[Mapping[str, float | int | None]] = []
    for row in table.rows:
        raw, value = row.values
        cells = [cell.strip() for cell in lines[row.line - 1].split(",")]
        spread, count, *_ = *cells[3:], "", ""
        out.append(
            {
                "channel": row.channel,
                "raw": raw,
                "value": value,
                "spread": _number(spread),
                "count": None if (number := _number(count)) is None else int(number),
            }
        )
    return out


def _number(text: str) -> float | None:
    """Return a remark that is a number; None for other text."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
