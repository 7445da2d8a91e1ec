"""Rows with a column for each channel, as CSV and Parquet have them, become blocks.

Rows of one node in which the same channels have a raw value are those of one stream. Raw values stay exact: integers,
floats, else octet strings.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.measure.blocks import Block
from teds_provision.measure.recordings.source import ROWS, Entry

_EXACT = 2**53  # integers up to here are exact as floats


@dataclass(frozen=True)
class Rows:
    """Rows of one node, in their order; ``value`` (NaN if there is none) and ``raw`` for each of its channels."""

    uuid: str
    channels: tuple[int, ...]
    time: NDArray[Any]  # float64, unix seconds
    index: NDArray[Any]  # int64
    tick: NDArray[Any]  # uint64; 0 if unknown
    clock_error: NDArray[Any]  # float64, NaN if unknown
    test: NDArray[Any]  # bool
    value: Sequence[NDArray[Any]]
    raw: Sequence[NDArray[Any]]
    there: NDArray[Any]  # n × c bool: True if there is a raw value


class Streams:
    """Finds the streams in rows, and numbers them by node in the order in which they are seen."""

    def __init__(self) -> None:
        self._numbers: dict[str, dict[tuple[int, ...], int]] = {}

    def blocks(self, rows: Rows) -> Iterator[Block]:
        """Yield the blocks of these rows: a gap of ``index`` begins another one."""
        numbers = self._numbers.setdefault(rows.uuid, {})
        patterns, which = np.unique(rows.there, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            columns = np.flatnonzero(pattern).tolist()
            if not columns:
                continue
            channels = tuple(rows.channels[place] for place in columns)
            stream = numbers.setdefault(channels, len(numbers))
            for part in _runs(np.flatnonzero(which.ravel() == number), rows):
                yield _block(rows, part, columns, channels, stream)


def _block(rows: Rows, part: NDArray[Any], columns: list[int], channels: tuple[int, ...], stream: int) -> Block:
    value = np.column_stack([rows.value[place][part] for place in columns])
    raw = stacked([rows.raw[place][part] for place in columns])
    first = part[0]
    error = float(rows.clock_error[first])
    return Block(
        rows.uuid, stream, channels, int(rows.index[first]), rows.time[part], rows.tick[part], raw, value,
        np.isfinite(value), 0.0, None if np.isnan(error) else error, bool(rows.test[first]),
    )  # fmt: skip


def _runs(part: NDArray[Any], rows: Rows) -> list[NDArray[Any]]:
    """Cut at gaps of the sample number, and at changes of what is constant in a block."""
    error = rows.clock_error[part]
    cut = np.diff(rows.index[part]) != 1
    cut |= (error[1:] != error[:-1]) & ~(np.isnan(error[1:]) & np.isnan(error[:-1]))
    cut |= np.diff(rows.test[part])
    return np.split(part, np.flatnonzero(cut) + 1)


def stacked(columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return raw values of a block: of one type if that is possible without loss, else Python's objects."""
    kinds = {column.dtype.kind for column in columns}
    if len(kinds) == 1 or (kinds == {"i", "f"} and all(_are_floats(column) for column in columns)):
        return np.column_stack(columns)
    found = np.empty((len(columns[0]), len(columns)), dtype=object)
    for place, column in enumerate(columns):
        found[:, place] = column.tolist()
    return found


def _are_floats(column: NDArray[Any]) -> bool:
    return column.dtype.kind == "f" or bool(((column >= -_EXACT) & (column <= _EXACT)).all())


RawKind = Literal["float", "int64", "uint64", "integer", ""]
_FLOATS: Final = ("Float32", "Float64", "fraction", "long fraction", "time of day")
_INTEGERS: Final = ("unsigned integer", "bit sequence", "long integer")


def raw_kind(form: str) -> RawKind:
    """Return the type for raw values of a form (``SampleForm.name``, "unsigned integer, 2 octets").

    "" for an unknown one.

    ``integer``: whole numbers of more than 64 bits.
    """
    model, _, size = form.partition(", ")
    if model in _FLOATS:
        return "float"
    octets = size.partition(" ")[0]
    if model not in _INTEGERS or not octets.isdecimal():
        return ""
    return "int64" if int(octets) < 8 else "uint64" if int(octets) == 8 else "integer"


def integers(values: Sequence[int]) -> NDArray[Any]:
    """Return integers of any size in the smallest array type that holds them all."""
    for kind in (np.int64, np.uint64):
        try:
            return np.array(values, dtype=kind)
        except OverflowError:
            continue
    return np.array(values, dtype=object)


class BlockJoiner:
    """Joins blocks of a stream that follow each other, so that few and large ones go on.

    :meth:`add_block` gives back what is ready, at the latest when :data:`ROWS` rows wait; nodes stay as near to each
    other as the rows of so many instants are.
    """

    def __init__(self) -> None:
        self._waiting: dict[tuple[str, int, tuple[int, ...]], list[list[Block]]] = {}
        self._rows = 0

    def add_block(self, block: Block) -> list[Entry]:
        """Take one more."""
        runs = self._waiting.setdefault((block.uuid, block.stream, block.channels), [])
        if runs and _follows(runs[-1], block):
            runs[-1].append(block)
        else:
            runs.append([block])
        self._rows += len(block.time)
        return self.flush() if self._rows >= ROWS else []

    def flush(self) -> list[Entry]:
        """Return all entries that wait, and the end of a chunk."""
        runs = [run for all_of in self._waiting.values() for run in all_of]
        self._waiting, self._rows = {}, 0
        return [*(_joined(run) for run in runs), ()]


def _follows(run: list[Block], block: Block) -> bool:
    last = run[-1]
    return (
        block.index == last.index + len(last.time)
        and block.clock_error == last.clock_error
        and block.test_pattern == last.test_pattern
        and block.raw.dtype == last.raw.dtype
    )


def _joined(run: list[Block]) -> Block:
    if len(run) == 1:
        return run[0]
    parts: dict[str, Any] = {name: np.concatenate([getattr(block, name) for block in run]) for name in _BY_ROW}
    return replace(run[0], **parts)


_BY_ROW = ("time", "tick", "raw", "value", "valid")


def part_of(block: Block, rows: slice) -> Block:
    """Return some rows of a block."""
    parts: dict[str, Any] = {name: getattr(block, name)[rows] for name in _BY_ROW}
    return replace(block, index=block.index + (rows.start or 0), **parts)
