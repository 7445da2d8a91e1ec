"""A sheet of boards (``--batch FILE``): which board gets which name, profile and calibration. Checked before any tap.

CSV with a header: ``uuid`` (or empty: in the order of the taps), ``name``, ``profile``, ``calibration`` (a file, beside
the sheet unless its path is absolute), ``fingerprint`` (32 to 64 hex digits, e.g. from a scanned label: it pins the
board's key before the tap).
"""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from teds_provision.errors import BadData, TedsProvisionError
from teds_provision.files import read_limited
from teds_provision.station.label import read_label
from teds_provision.station.station import Station
from teds_provision.steps.build_order import BuildOrder, Prepared, prepare

MAX_SHEET_OCTETS: Final = 4 << 20
MAX_ROWS: Final = 10_000
COLUMNS: Final = ("uuid", "name", "profile", "calibration", "fingerprint")
_SHOWN: Final = 20
_DELIMITERS: Final = ",;\t"  # of equals the first
_UUID = re.compile("[0-9a-f]{20}")
_FINGERPRINT = re.compile("[0-9a-f]{32,64}")


@dataclass(frozen=True)
class Row:
    """One board of the sheet: ``number`` counts from 1, ``line`` is that of the file."""

    number: int
    line: int
    uuid: bytes | None
    fingerprint: str | None
    prepared: Prepared
    digest: str

    @property
    def by_order(self) -> bool:
        """Whether the next board that nobody else is meant by takes this row."""
        return self.uuid is None and self.fingerprint is None

    @property
    def lacks_calibration(self) -> bool:
        """Whether the type asks for a calibration and the row brings none; its board may have one from before."""
        profile = self.prepared.profile
        if profile is None or self.prepared.calibrations is not None:
            return False
        return any(channel.calibration.required for channel in profile.channels)

    def means(self, uuid: bytes, fingerprint: str) -> bool:
        """Whether this row names that board; a UUID with another key is for the pin to refuse."""
        if self.uuid is not None:
            return self.uuid == uuid
        return self.fingerprint is not None and fingerprint.startswith(self.fingerprint)


@dataclass(frozen=True)
class Sheet:
    """All rows of one file, each found good."""

    path: Path
    rows: tuple[Row, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a person should know before the first board, once for all rows of which it is true."""
        found: dict[str, list[int]] = {}
        for row in self.rows:
            for warning in row.prepared.warnings:
                found.setdefault(warning, []).append(row.number)
            if row.lacks_calibration:
                found.setdefault("the type asks for a calibration, and none is named.", []).append(row.number)
        return tuple(f"Row{'s' if len(rows) > 1 else ''} {_numbers(rows)}: {why}" for why, rows in found.items())


def read_sheet(station: Station, path: Path, order: BuildOrder) -> Sheet:
    """Read a sheet, and read, fit and guard all that it names; ``order`` is what rows get that leave it out.

    Raises NotFound (no such file), BadData with every line that is wrong.
    """
    reading = _Reading(station, path, order)
    reading.read(read_limited(path, MAX_SHEET_OCTETS, "sheet of boards"))
    if reading.mistakes:
        mistakes = [f"{path.name}:{_numbers(lines)}: {why}" for why, lines in reading.mistakes.items()]
        shown = "; ".join(mistakes[:_SHOWN])
        more = f"; and {len(mistakes) - _SHOWN} more" if len(mistakes) > _SHOWN else ""
        raise BadData(f"{shown}{more}.", hint="Nothing was provisioned. Mend the sheet and run the same command again.")
    if not reading.rows:
        raise BadData(f"{path} has no row.", hint=f"A header ({', '.join(COLUMNS)}) and a line per board.")
    return Sheet(path, tuple(reading.rows))


def _numbers(numbers: Sequence[int]) -> str:
    """``2, 9, 16``; of many the first few, and how many more."""
    more = f" and {len(numbers) - _SHOWN} more" if len(numbers) > _SHOWN else ""
    return f"{', '.join(map(str, numbers[:_SHOWN]))}{more}"


class _Reading:
    def __init__(self, station: Station, path: Path, order: BuildOrder) -> None:
        self.station, self.path, self.order = station, path, order
        self.rows: list[Row] = []
        self.mistakes: dict[str, list[int]] = {}
        self.count = 0
        self._seen: dict[tuple[str, str], int] = {}
        self._prepared: dict[BuildOrder, Prepared | str] = {}

    def wrong(self, line: int, why: str) -> None:
        self.mistakes.setdefault(why, []).append(line)
        self.count += 1

    def read(self, octets: bytes) -> None:
        try:
            text = octets.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            self.wrong(1 + octets[: error.start].count(b"\n"), "it is not UTF-8 (a spreadsheet calls it: CSV UTF-8)")
            return
        first = text.partition("\n")[0]
        delimiter = max(_DELIMITERS, key=first.count)
        table = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        try:
            header = [cell.strip().lower() for cell in next(table, [])]
            if not self._header_is_good(header):
                return
            for row in table:
                cells = [cell.strip() for cell in row]
                if any(cells):
                    self._row(table.line_num, header, cells)
                if len(self.rows) > MAX_ROWS:
                    self.wrong(table.line_num, f"there are more than {MAX_ROWS} rows")
                    return
        except csv.Error as error:
            self.wrong(table.line_num, f"this is no CSV: {error}")

    def _header_is_good(self, header: Sequence[str]) -> bool:
        for name in header:
            if name not in COLUMNS:
                self.wrong(1, f"there is no column {name!r}; columns are {', '.join(COLUMNS)}")
            elif header.count(name) > 1:
                self.wrong(1, f"the column {name!r} is there twice")
        return not self.mistakes

    def _row(self, line: int, header: Sequence[str], cells: Sequence[str]) -> None:
        before = self.count
        if len(cells) > len(header):
            self.wrong(line, f"{len(cells)} cells under {len(header)} columns")
        values = dict(zip(header, cells, strict=False))
        self._take_label(line, values)
        uuid = self._digits(line, "uuid", values.get("uuid", ""), _UUID, "20 hex digits")
        pin = self._digits(line, "fingerprint", values.get("fingerprint", ""), _FINGERPRINT, "32 to 64 hex digits")
        prepared = self._order(line, values)
        for what, value in (("uuid", uuid), ("fingerprint", pin), ("name", values.get("name", ""))):
            self._once(line, what, value or "")
        if uuid is not None and prepared is not None and prepared.order.name is not None:
            self._name_is_free(line, bytes.fromhex(uuid), prepared.order.name)
        if self.count == before and prepared is not None:
            digest = hashlib.sha256("\0".join(cells).encode()).hexdigest()
            number = len(self.rows) + 1
            self.rows.append(Row(number, line, bytes.fromhex(uuid) if uuid else None, pin, prepared, digest))

    def _take_label(self, line: int, values: dict[str, str]) -> None:
        """A label that was scanned into the cell of UUID or fingerprint says both; another cell may not contradict."""
        for name in ("uuid", "fingerprint"):
            label = read_label(values.get(name, ""))
            if label is None:
                continue
            said = {"uuid": label[0].hex(), "fingerprint": label[1]}
            other = "uuid" if name == "fingerprint" else "fingerprint"
            digits = re.sub(r"[\s:-]", "", values.get(other, "")).lower().removeprefix("0x")
            if digits and read_label(values[other]) is None and not said[other].startswith(digits):
                self.wrong(line, f"{other}: {values[other][:48]!a}, and the label in {name} says {said[other]}")
            values.update(said)

    def _digits(self, line: int, what: str, text: str, form: re.Pattern[str], rule: str) -> str | None:
        if not text:
            return None
        digits = re.sub(r"[\s:-]", "", text).lower().removeprefix("0x")
        if form.fullmatch(digits):
            return digits
        self.wrong(line, f"{what}: {rule} are needed, here is {text[:48]!a}")
        return None

    def _once(self, line: int, what: str, value: str) -> None:
        if not value:
            return
        other = self._seen.setdefault((what, value), line)
        if other != line and not (what == "name" and ("{uuid}" in value or "{n}" in value)):
            self.wrong(line, f"the {what} {value} stands in line {other} too")

    def _name_is_free(self, line: int, uuid: bytes, name: str) -> None:
        others = [other for other in self.station.nodes.all_named(name) if other != uuid]
        if others:
            self.wrong(line, f"node {others[0].hex()} has the name {name!r} already")

    def _order(self, line: int, values: dict[str, str]) -> Prepared | None:
        file = values.get("calibration") or None
        order = replace(
            self.order,
            profile=values.get("profile") or self.order.profile,
            name=values.get("name") or self.order.name,
            calibration=self.path.parent / file if file else None,
        )
        shared = replace(order, name=None)  # one fit for all that name the same file
        if shared not in self._prepared:
            try:
                self._prepared[shared] = prepare(self.station, shared)
            except TedsProvisionError as error:
                self._prepared[shared] = error.message.rstrip(".")
        try:
            prepare(self.station, BuildOrder(name=order.name))
        except TedsProvisionError as error:
            self.wrong(line, error.message.rstrip("."))
        found = self._prepared[shared]
        if isinstance(found, str):
            self.wrong(line, found)
            return None
        return replace(found, order=order)
