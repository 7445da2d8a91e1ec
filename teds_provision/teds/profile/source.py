"""TOML read with the place of every key: a profile's error names file, line and field.

``tomllib`` gives values without lines, so a small scan over the text finds where each key stands. Values keep the file
they came from through inheritance.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from teds_provision import files
from teds_provision.errors import BadData, StoreFailure
from teds_provision.limits import LIMITS, check_depth, check_toml

KeyPath = tuple[str | int, ...]

_PART: Final = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\]|\\.)*"|'[^']*')"""
_KEYS: Final = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER: Final = re.compile(rf"\s*(\[\[?)\s*({_KEYS})\s*\]")
_KEY: Final = re.compile(rf"\s*({_KEYS})\s*=")
_SPLIT: Final = re.compile(_PART)
_AT: Final = re.compile(r"\(at line (\d+), column \d+\)")


@dataclass(frozen=True)
class Where:
    """File (as it is shown to people) and line, counted from 1."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(frozen=True)
class Item:
    """One value with its place; ``value`` is what TOML gives, or a tuple of Tables for an array of tables."""

    value: object
    where: Where


@dataclass(frozen=True)
class Table:
    """A TOML table with the place of each entry."""

    entries: Mapping[str, Item | Table]
    where: Where
    path: str = ""

    def merged(self, over: Table) -> Table:
        """Return this table with another laid over it, key by key; arrays and values are replaced whole."""
        entries = dict(self.entries)
        for key, entry in over.entries.items():
            below = entries.get(key)
            both = isinstance(below, Table) and isinstance(entry, Table)
            entries[key] = below.merged(entry) if both else entry  # type: ignore[union-attr, arg-type]
        return Table(entries, over.where, over.path)


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
    """Line of each table header and each key of a TOML text (keys inside inline tables: the line of the table)."""
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


def parse(text: str, file: str) -> Table:
    """Read TOML text; ``file`` is the name shown in errors. Raises BadData with file and line."""
    check_toml(text, file)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        message = str(error)
        at = _AT.search(message)
        line = int(at[1]) if at else max(1, text.count("\n"))
        raise BadData(f"{file}:{line}: this is not TOML: {_AT.sub('', message).strip()}.") from error
    check_depth(data, LIMITS.toml_depth, file)
    lines = key_lines(text)

    def place(path: KeyPath) -> Where:
        while path and path not in lines:
            path = path[:-1]
        return Where(file, lines.get(path, 1))

    def build(value: dict[str, object], path: KeyPath) -> Table:
        return Table({key: entry(item, (*path, key)) for key, item in value.items()}, place(path), _shown(path))

    def entry(value: object, path: KeyPath) -> Item | Table:
        if isinstance(value, dict):
            return build(value, path)
        if isinstance(value, list) and value and all(isinstance(part, dict) for part in value):
            return Item(tuple(build(part, (*path, number)) for number, part in enumerate(value)), place(path))
        return Item(value, place(path))

    return build(data, ())


def _shown(path: KeyPath) -> str:
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def read_text(path: Path) -> str:
    """Text of a small UTF-8 file; raises NotFound, BadData or StoreFailure naming it."""
    return files.read_text(path, LIMITS.text_file, "profile or calibration", failure=StoreFailure)


def walk(table: Table) -> Iterator[tuple[str, Item]]:
    """Every value of a table with its dotted path."""
    for key, entry in table.entries.items():
        path = f"{table.path}.{key}" if table.path else key
        if isinstance(entry, Table):
            yield from walk(entry)
        else:
            yield path, entry
