"""Reading the tables of a profile by their key tables, with every problem collected and placed."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from shlex import quote
from typing import Final

from teds_provision import files
from teds_provision.errors import BadDataError, StoreError
from teds_provision.limits import LIMITS, check_depth, check_toml
from teds_provision.teds.profile.keys import Key, KeyKind, KeyNeed
from teds_provision.teds.units import WrittenUnit, parse_seconds, parse_unit

# TOML read with the position of every key, so that an error in a profile names file, line and field.
#
# ``tomllib`` gives values without lines, so a small scanner finds the position of each key. Values keep the name of
# their file through inheritance.

KeyPath = tuple[str | int, ...]

_PART: Final = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\]|\\.)*"|'[^']*')"""
_KEYS: Final = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER: Final = re.compile(rf"\s*(\[\[?)\s*({_KEYS})\s*\]")
_KEY: Final = re.compile(rf"\s*({_KEYS})\s*=")
_SPLIT: Final = re.compile(_PART)
_AT: Final = re.compile(r"\(at line (\d+), column \d+\)")


@dataclass(frozen=True)
class SourcePlace:
    """File (as it is shown to people) and line, counted from 1."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(frozen=True)
class PlacedValue:
    """One value with its place; ``value`` is what TOML gives, or a tuple of Tables for an array of tables."""

    value: object
    where: SourcePlace


@dataclass(frozen=True)
class TomlTable:
    """A TOML table with the place of each entry."""

    entries: Mapping[str, PlacedValue | TomlTable]
    where: SourcePlace
    path: str = ""

    def merged(self, over: TomlTable) -> TomlTable:
        """Return this table with another laid over it, key by key; arrays and values are replaced whole."""
        entries = dict(self.entries)
        for key, entry in over.entries.items():
            below = entries.get(key)
            both = isinstance(below, TomlTable) and isinstance(entry, TomlTable)
            entries[key] = below.merged(entry) if both else entry  # type: ignore[union-attr, arg-type]
        return TomlTable(entries, over.where, over.path)


@dataclass
class _Scan:
    """Lines of all keys of one TOML text."""

    lines: dict[KeyPath, int] = field(default_factory=dict)
    counts: dict[KeyPath, int] = field(default_factory=dict)

    def header(self, path: KeyPath, array: bool, line: int) -> KeyPath:
        path = self._resolve(path[:-1]) + path[-1:]
        for length in range(1, len(path) + 1):
            self.lines.setdefault(path[:length], line)
        if array:
            number = self.counts.get(path, -1) + 1
            self.counts[path] = number
            path = (*path, number)
            self.lines[path] = line
        return path

    def _resolve(self, path: KeyPath) -> KeyPath:
        """Put the number of the latest array entry behind each part that is an array of tables."""
        out: KeyPath = ()
        for part in path:
            out = (*out, part)
            if out in self.counts:
                out = (*out, self.counts[out])
        return out


def _parts(keys: str) -> KeyPath:
    return tuple(part[1:-1] if part[0] in "\"'" else part for part in _SPLIT.findall(keys))


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the line of each table header and key of a TOML text (keys of an inline table: the table's line)."""
    scan, table, closing = _Scan(), (), None
    base: KeyPath = table
    for number, line in enumerate(text.splitlines(), 1):
        if closing:
            closing = None if closing in line else closing
            continue
        if match := _HEADER.match(line):
            base = scan.header(_parts(match[2]), match[1] == "[[", number)
        elif match := _KEY.match(line):
            path = base
            for part in _parts(match[1]):
                path = (*path, part)
                scan.lines.setdefault(path, number)
            rest = line[match.end() :].lstrip()
            quotes = rest[:3]
            if quotes in ('"""', "'''") and quotes not in rest[3:]:
                closing = quotes
    return scan.lines


def parse(text: str, file: str) -> TomlTable:
    """Read TOML text; ``file`` is the name shown in errors. Raises BadDataError with file and line."""
    check_toml(text, file)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        message = str(error)
        at = _AT.search(message)
        line = int(at[1]) if at else max(1, text.count("\n"))
        raise BadDataError(f"{file}:{line}: this is not TOML: {_AT.sub('', message).strip()}.") from error
    check_depth(data, LIMITS.toml_depth, file)
    lines = key_lines(text)

    def place(path: KeyPath) -> SourcePlace:
        while path and path not in lines:
            path = path[:-1]
        return SourcePlace(file, lines.get(path, 1))

    def build(value: dict[str, object], path: KeyPath) -> TomlTable:
        text = ""
        for part in path:
            text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
        return TomlTable({key: entry(item, (*path, key)) for key, item in value.items()}, place(path), text)

    def entry(value: object, path: KeyPath) -> PlacedValue | TomlTable:
        if isinstance(value, dict):
            return build(value, path)
        if isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
            return PlacedValue(tuple(build(part, (*path, number)) for number, part in enumerate(value)), place(path))
        return PlacedValue(value, place(path))

    return build(data, ())


def read_text(path: Path) -> str:
    """Read a small UTF-8 file; raises NotFoundError, BadDataError or StoreError naming it."""
    return files.read_text(path, LIMITS.text_file, "profile or calibration", failure=StoreError)


_LIMITS = {KeyKind.U8: 0xFF, KeyKind.U16: 0xFFFF, KeyKind.U32: 0xFFFF_FFFF}
_SHOWN = 60  # characters of a wrong value in a message
FLOAT32_MAXIMUM = 3.4028234663852886e38
NAME_OCTETS = 120
"""The longest name, as UTF-8: what wire, labels and lists have room for."""


@dataclass(frozen=True)
class ProfileProblem:
    """One thing wrong with a profile; ``field`` is the dotted path of the key."""

    where: SourcePlace
    field: str
    message: str
    severity: str = "error"

    def __str__(self) -> str:
        place = f"{self.where}: " if self.field == "" else f"{self.where}: {self.field}: "
        return place + self.message


def _shown(value: object) -> str:
    """Return a value of the file as a message shows it."""
    if isinstance(value, tuple):  # the type of a list of tables (Table)
        return "a list of tables [[…]]"
    text = repr(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


class _BadValueError(Exception):
    """A value is malformed; the text is the reason."""


@dataclass
class Problems:
    """All problems of one profile, in the order in which they were found."""

    found: list[ProfileProblem] = field(default_factory=list)

    def error(self, where: SourcePlace, path: str, message: str) -> None:
        """Add an error."""
        self.found.append(ProfileProblem(where, path, message))

    def warning(self, where: SourcePlace, path: str, message: str) -> None:
        """Add a warning."""
        self.found.append(ProfileProblem(where, path, message, "warning"))

    @property
    def errors(self) -> list[ProfileProblem]:
        """The errors alone."""
        return [problem for problem in self.found if problem.severity == "error"]

    def raise_errors(self, name: str) -> None:
        """Raise BadDataError with the first error and the number of the others."""
        errors = self.errors
        if errors:
            more = f" ({len(errors) - 1} more)" if len(errors) > 1 else ""
            raise BadDataError(
                f"{errors[0]}{more}", hint=f"See all of them with: teds-provision profile check {quote(name)}"
            )


class Section:
    """One table being read: keys are taken one by one, what is left at ``finish`` is unknown."""

    def __init__(self, table: TomlTable, problems: Problems, unit: WrittenUnit | None = None) -> None:
        self.table = table
        self.problems = problems
        self.unit = unit
        self._known: set[str] = set()

    def path(self, key: str) -> str:
        """Return the dotted path of a key."""
        return f"{self.table.path}.{key}" if self.table.path else key

    def place_of(self, key: str) -> SourcePlace:
        """Return the place of a key, or of the table if the key is missing."""
        entry = self.table.entries.get(key)
        return self.table.where if entry is None else entry.where

    def error(self, key: str, message: str) -> None:
        """Report an error at a key."""
        self.problems.error(self.place_of(key), self.path(key), message)

    def warning(self, key: str, message: str) -> None:
        """Report a warning at a key."""
        self.problems.warning(self.place_of(key), self.path(key), message)

    def item(self, key: str) -> object:
        """Return the value of a key, None if it is absent; a table there is an error."""
        self._known.add(key)
        entry = self.table.entries.get(key)
        if isinstance(entry, TomlTable):
            self.error(key, "a value is expected here, not a table.")
            return None
        return None if entry is None else entry.value

    def text(self, key: str, default: str = "") -> str:
        """Return the text of a key."""
        value = self.item(key)
        if value is None:
            return default
        if not isinstance(value, str):
            self.error(key, f"a text in quotes is expected, not {_shown(value)}.")
            return default
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """List of texts of a key."""
        value = self.item(key)
        if value is None:
            return ()
        if not isinstance(value, list) or not all(isinstance(part, str) for part in value):
            self.error(key, f'a list of texts is expected, like ["nfc", "can"], not {_shown(value)}.')
            return ()
        return tuple(value)

    def flag(self, key: str, default: bool = False) -> bool:
        """Return the truth value of a key."""
        value = self.item(key)
        if value is None:
            return default
        if not isinstance(value, bool):
            self.error(key, f"true or false is expected, not {_shown(value)}.")
            return default
        return value

    def section(self, key: str) -> Section | None:
        """Return the table under a key."""
        self._known.add(key)
        entry = self.table.entries.get(key)
        if isinstance(entry, PlacedValue):
            self.error(key, f"a table [{self.path(key)}] is expected, not {_shown(entry.value)}.")
            return None
        return None if entry is None else Section(entry, self.problems, self.unit)

    def sections(self, key: str) -> list[Section]:
        """Return the tables of an array [[key]]."""
        self._known.add(key)
        entry = self.table.entries.get(key)
        if entry is None:
            return []
        if isinstance(entry, PlacedValue) and isinstance(entry.value, tuple):
            return [Section(table, self.problems, self.unit) for table in entry.value]
        if isinstance(entry, PlacedValue) and entry.value == []:
            return []
        self.error(key, f"tables [[{self.path(key)}]] are expected.")
        return []

    def read(self, key: Key) -> object:
        """Return the value of a key by its table, converted to SI units; None if absent or wrong (reported)."""
        value = self.item(key.key)
        if value is None:
            if key.key not in self.table.entries:
                self._missing(key)
            return None
        try:
            return self._convert(key, value)
        except _BadValueError as error:
            self.error(key.key, str(error))
        except BadDataError as error:
            self.error(key.key, f"{error.message} {error.hint}".strip())
        return None

    def pairs(self, keys: Iterable[Key]) -> tuple[tuple[str, object], ...]:
        """Return field name and value of every key that is present."""
        values = [(key.field, self.read(key)) for key in keys]
        return tuple((name, value) for name, value in values if value is not None)

    def name(self, key: str, default: str = "") -> str:
        """Return a text of at most :data:`NAME_OCTETS`."""
        name = self.text(key, default)
        if len(name.encode()) > NAME_OCTETS:
            self.error(key, f"a name has at most {NAME_OCTETS} octets, this one {len(name.encode())}.")
        return name

    def finish(self, also: Sequence[str] = ()) -> None:
        """Refuse unknown keys, suggesting the nearest."""
        known = self._known | set(also)
        for key in self.table.entries:
            if key not in known:
                near = get_close_matches(key[:64], known, n=1, cutoff=0.6)
                guess = f' Did you mean "{near[0]}"?' if near else f" Known here: {', '.join(sorted(known))}."
                self.error(key, f"there is no such key.{guess}")

    def _missing(self, key: Key) -> None:
        if key.need is KeyNeed.OPTIONAL:
            return
        example = f" Write for example: {key.key} = {key.example}" if key.example else ""
        message = f"missing ({key.help}).{example}"
        report = self.error if key.need is KeyNeed.REQUIRED else self.warning
        report(key.key, message)

    def _convert(self, key: Key, value: object) -> object:
        match key.kind:
            case KeyKind.TIME:
                return _not_negative(finite(parse_seconds(value)))
            case KeyKind.VALUE:
                return finite(self._quantity(value, difference=False))
            case KeyKind.DIFFERENCE:
                return _not_negative(finite(self._quantity(value, difference=True)))
            case KeyKind.ANGLE:
                return finite(_angle(value))
            case KeyKind.NUMBER:
                return finite(_number(value))
            case KeyKind.FLAG:
                if not isinstance(value, bool):
                    raise _BadValueError(f"true or false is expected, not {_shown(value)}.")
                return int(value)
            case KeyKind.CHOICE:
                return _choice(key, value)
            case KeyKind.CHOICES:
                return _list(key, value)
            case KeyKind.U8 | KeyKind.U16 | KeyKind.U32:
                return _integer(value, _LIMITS[key.kind])

    def _quantity(self, value: object, *, difference: bool) -> float:
        unit = self.unit or parse_unit("1")
        if isinstance(value, str):
            number, _, text = value.strip().partition(" ")
            written = parse_unit(text.strip() or "1")
            if written.units != unit.units:
                raise _BadValueError(f'"{value}" is not in a unit of this channel ({unit.text}).')
            unit, value = written, _number_text(number)
        number_value = _number(value)
        return unit.difference_to_si(number_value) if difference else unit.to_si(number_value)


def finite(value: float) -> float:
    """Return the value if a Float32 can hold it."""
    if not math.isfinite(value) or abs(value) > FLOAT32_MAXIMUM:
        raise _BadValueError(f"{value} does not fit a Float32.")
    return value


def _not_negative(value: float) -> float:
    if value < 0:
        raise _BadValueError("it must not be negative.")
    return value


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _BadValueError(f"a number is expected, not {_shown(value)}.")
    if isinstance(value, int) and abs(value) > FLOAT32_MAXIMUM:
        raise _BadValueError("the number does not fit a Float32.")
    return float(value)


def _number_text(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise _BadValueError(f'a number and a unit are expected, like "10 mm"; "{text}" is not a number.') from None


def _angle(value: object) -> float:
    if isinstance(value, str):
        number, _, text = value.strip().partition(" ")
        unit = parse_unit(text.strip() or "rad")
        if unit.units != parse_unit("rad").units:
            raise _BadValueError(f'"{value}" is not an angle.')
        return unit.to_si(_number_text(number))
    return _number(value)


def _integer(value: object, limit: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= limit:
        raise _BadValueError(f"a whole number from 0 to {limit} is expected, not {_shown(value)}.")
    return value


def _choice(key: Key, value: object) -> int:
    if isinstance(value, str) and value in key.choices:
        return key.choices[value]
    if isinstance(value, int) and not isinstance(value, bool):
        return _integer(value, 0xFF)
    near = get_close_matches(str(value)[:64], key.choices, n=1, cutoff=0.6)
    guess = f'Did you mean "{near[0]}"?' if near else f"One of {', '.join(key.choices)} is expected."
    raise _BadValueError(f"{value!r} is not known here. {guess}")


def _list(key: Key, value: object) -> tuple[object, ...]:
    if not isinstance(value, list) or not value:
        raise _BadValueError(f"a list is expected, like {key.example}, not {_shown(value)}.")
    if key.field == "DAngles":
        if len(value) != 2:
            raise _BadValueError(f"two angles are expected, not {len(value)}.")
        return tuple(finite(_angle(part)) for part in value)
    return tuple(_integer(part, 0xFFFF) for part in value)
