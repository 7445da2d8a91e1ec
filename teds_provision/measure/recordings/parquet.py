"""Parquet, by pyarrow (extra ``parquet``): the columns of a CSV, typed, with its header in the file's metadata.

A file of Parquet is unusable before its end is written, so nothing records to it: recordings are converted to it.
Columns are ``time`` (unix seconds), ``uuid``, ``index``, ``tick``, ``clock_error``, ``note``, then values and raw
values as in CSV; of a grid ``time`` and the values.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.errors import BadDataError, UsageError
from teds_provision.lazy import how_to_install
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, NodeReport, Note, StationFacts
from teds_provision.measure.recordings.columns import Rows, Streams, raw_kind
from teds_provision.measure.recordings.json_lines import report_of
from teds_provision.measure.recordings.source import MOST, ROWS, Entry, Recording, facts_of, number_of, station_of
from teds_provision.measure.sinks.json_events import facts_as_json, iso, status_line
from teds_provision.measure.sinks.text import heads_of, names_of, note_of
from teds_provision.sanitize import printable

MAGIC: Final = b"PAR1"
_KEY: Final = b"teds-provision"
_AFTER: Final = b"teds-provision.log"
_CELLS: Final = 2_000_000
"""Cells that wait for their row group, at most."""
_FORMAT: Final = "teds-provision/measurement-1"


def library() -> Any:
    """Return module pyarrow, with its Parquet; raises UsageError if it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UsageError("Parquet needs pyarrow.", hint=how_to_install("parquet")) from None
    return pyarrow


class ParquetWriter:
    """Writes entries of a recording into one file. ``facts`` are those of every channel that will come."""

    def __init__(self, path: Path, facts: Sequence[ChannelFacts], station: StationFacts, *, wide: bool) -> None:
        pa = self._pa = library()
        self._known = [
            channel_facts
            for _, channel_facts in sorted({channel_facts.key: channel_facts for channel_facts in facts}.items())
        ]
        self._places = {facts.key: place for place, facts in enumerate(self._known)}
        self._wide = wide
        columns: list[tuple[str, Any]] = [("time", pa.float64())]
        if not wide:
            columns += [("uuid", pa.string()), ("index", pa.int64()), ("tick", pa.uint64())]
            columns += [("clock_error", pa.float64()), ("note", pa.string())]
        columns += [(printable(name), pa.float64()) for name in heads_of(self._known)]
        if not wide:
            forms = zip(names_of(self._known), self._known, strict=True)
            columns += [(printable(f"{name} raw"), self._raw_type(facts.sample_form)) for name, facts in forms]
        head = {
            "format": _FORMAT,
            "station": station.name,
            "group": station.group,
            "started": iso(station.started),
            "clock": station.clock,
            "test_pattern": station.test_pattern,
            "wide": wide,
            "channels": [facts_as_json(facts) for facts in self._known],
        }
        self._schema = pa.schema(columns, metadata={_KEY: json.dumps(head)})
        self._writer = pa.parquet.ParquetWriter(path, self._schema, compression="zstd", compression_level=1)
        self._waiting: list[Block | GroupRows] = []
        self._rows = 0
        self._log: list[dict[str, Any]] = []

    def _raw_type(self, form: str) -> Any:
        pa = self._pa
        return {"float": pa.float64(), "uint64": pa.uint64(), "int64": pa.int64()}.get(raw_kind(form), pa.string())

    def add_entry(self, entry: Entry) -> None:
        """Add one entry; raises BadDataError for a raw value that contradicts its channel's datasheet."""
        if isinstance(entry, Block | GroupRows):
            self._waiting.append(entry)
            self._rows += len(entry.time)
            if self._rows * len(self._schema) >= _CELLS:
                self._flush()
        elif isinstance(entry, NodeReport):
            self._log = [event for event in self._log if event.get("uuid") != entry.uuid] + [status_line(entry)]
        elif isinstance(entry, Note):
            self._log.append({"event": "note", "time": entry.at, "why": entry.text})

    def finish(self) -> None:
        """Write the rest, and the end of the file."""
        self._flush()
        self._writer.add_key_value_metadata({_AFTER: json.dumps(self._log)})
        self.close()

    def close(self) -> None:
        """Give back what was opened."""
        self._writer.close()

    def _flush(self) -> None:
        if not self._rows:
            return
        count, waiting, width = self._rows, self._waiting, len(self._known)
        self._rows, self._waiting = 0, []
        values: list[NDArray[Any]] = [np.full(count, np.nan) for _ in range(width)]
        raws: list[list[tuple[int, int, NDArray[Any]]]] = [[] for _ in range(width)]
        at = 0
        for part in waiting:
            end = at + len(part.time)
            keys = part.channels if isinstance(part, GroupRows) else [(part.uuid, number) for number in part.channels]
            for column, key in enumerate(keys):
                place = self._places[key]
                values[place][at:end] = part.value[:, column]
                if isinstance(part, Block):
                    raws[place].append((at, end, part.raw[:, column]))
            at = end
        order = np.argsort(np.concatenate([part.time for part in waiting]), kind="stable")
        arrays = [self._pa.array(np.concatenate([part.time for part in waiting])[order])]
        blocks = [part for part in waiting if isinstance(part, Block)]
        if not self._wide:
            arrays += self._beside(blocks, order)
        arrays += [self._pa.array(value[order], mask=np.isnan(value)[order]) for value in values]
        if not self._wide:
            arrays += [self._raw(place, pieces, count, order) for place, pieces in enumerate(raws)]
        self._writer.write_table(self._pa.Table.from_arrays(arrays, schema=self._schema))

    def _beside(self, blocks: Sequence[Block], order: NDArray[Any]) -> list[Any]:
        pa, lengths = self._pa, [len(block.time) for block in blocks]
        uuids = np.repeat(np.array([block.uuid for block in blocks], dtype=object), lengths)
        index = np.concatenate(
            [np.arange(block.index, block.index + n) for block, n in zip(blocks, lengths, strict=True)]
        )
        tick = np.concatenate([block.tick for block in blocks])
        error = np.repeat([np.nan if block.clock_error is None else block.clock_error for block in blocks], lengths)
        notes = np.repeat(np.array([self._note(block) for block in blocks], dtype=object), lengths)
        return [
            pa.array(uuids[order], pa.string()),
            pa.array(index[order], pa.int64()),
            pa.array(tick[order], pa.uint64()),
            pa.array(error[order], mask=np.isnan(error)[order]),
            pa.array(notes[order], pa.string()),
        ]

    def _note(self, block: Block) -> str | None:
        if block.test_pattern:
            return "test pattern"
        return note_of([self._known[self._places[block.uuid, number]] for number in block.channels]) or None

    def _raw(self, place: int, pieces: list[tuple[int, int, NDArray[Any]]], count: int, order: NDArray[Any]) -> Any:
        kind = self._schema.field(len(self._schema) - len(self._known) + place).type
        dtype = {"int64": np.int64, "uint64": np.uint64, "double": np.float64}.get(str(kind))
        missing = np.ones(count, dtype=bool)
        found = np.zeros(count, dtype=object if dtype is None else dtype)
        try:
            for at, end, column in pieces:
                if dtype is None:
                    found[at:end] = [
                        value.hex() if isinstance(value, bytes) else str(value) for value in column.tolist()
                    ]
                elif column.dtype.kind == "O":
                    found[at:end] = np.array(column.tolist(), dtype=dtype)
                else:
                    found[at:end] = (
                        column.astype(dtype, casting="same_kind") if dtype != np.int64 else _as_int64(column)
                    )
                missing[at:end] = False
            return self._pa.array(found[order], kind, mask=missing[order])
        except (TypeError, ValueError, OverflowError) as error:
            known = self._known[place]
            raise BadDataError(
                f"A raw value of {known.label} of {known.uuid} is no {known.sample_form or 'number'}: {error}."
            ) from None


def _as_int64(column: NDArray[Any]) -> NDArray[Any]:
    whole = column.astype(np.int64)
    if column.dtype.kind == "f" and (whole != column).any():
        raise ValueError("it is not a whole number")
    return whole


class ParquetRecording(Recording):
    """Parquet as :class:`ParquetWriter` writes it."""

    form = "Parquet"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._pa = library()
        with self._open() as file:
            words, self._log = self._words(file.metadata.metadata or {})
        self.wide = words.get("wide") is True
        self.station = station_of(words)
        listed = words["channels"] if isinstance(words.get("channels"), list) else []
        if len(listed) > MOST.channels:
            raise self._bad(f"it names more than {MOST.channels} channels")
        self._known = [facts_of(item, str(path)) for item in listed]
        for facts in self._known:
            self.know(facts)
        if self.wide:
            self.form = "Parquet, wide"

    def _bad(self, why: str) -> BadDataError:
        return BadDataError(f"{self.path}: {why}.", hint="It was changed since it was written, or is damaged.")

    def _open(self) -> Any:
        try:
            return self._pa.parquet.ParquetFile(
                self.path, memory_map=False, thrift_string_size_limit=64 << 20, thrift_container_size_limit=1 << 20
            )
        except (self._pa.ArrowException, OSError) as error:
            raise self._bad(f"it is not a complete Parquet file: {_first_line(error)}") from None

    def _words(self, metadata: dict[bytes, bytes]) -> tuple[dict[str, Any], list[Any]]:
        try:
            words, log = json.loads(metadata[_KEY]), json.loads(metadata.get(_AFTER, b"[]"))
        except (KeyError, ValueError, RecursionError):
            raise self._bad("it is not a recording of this program") from None
        if not isinstance(words, dict) or words.get("format") != _FORMAT or not isinstance(log, list):
            raise self._bad("it is not a recording of this program")
        return words, log

    def _stored_entries(self) -> Iterator[Entry]:
        """See the class above."""
        yield tuple(self._known)
        width, streams = len(self._known), Streams()
        with self._open() as file:
            names = file.schema_arrow.names
            if len(names) != (1 + width if self.wide else 6 + 2 * width) or len(names) > MOST.columns:
                raise self._bad("its columns are not those of its channels")
            try:
                for batch in file.iter_batches(batch_size=ROWS):
                    if self.wide:
                        yield self._grid(batch)
                    else:
                        yield from self._blocks(batch, streams)
                        yield ()
            except (self._pa.ArrowException, OSError, ValueError, TypeError) as error:
                raise self._bad(f"its values cannot be read: {_first_line(error)}") from None
        for words in self._log:
            if isinstance(words, dict) and words.get("event") == "note":
                yield Note(number_of(words.get("time")) or 0.0, str(words.get("why"))[: MOST.text])
            elif isinstance(words, dict) and (report := report_of(words)) is not None:
                yield report

    def _grid(self, batch: Any) -> GroupRows:
        time, *columns = [_floats(batch.column(place)) for place in range(batch.num_columns)]
        value = np.column_stack(columns) if columns else np.empty((len(time), 0))
        keys = tuple(facts.key for facts in self._known)
        return GroupRows(self.station.group or "all", keys, time, value, np.full_like(value, np.nan))

    def _blocks(self, batch: Any, streams: Streams) -> Iterator[Block]:
        width = len(self._known)
        uuids = batch.column(1).to_pylist()
        for uuid in dict.fromkeys(uuids):
            rows = np.flatnonzero(np.array([uuid_text == uuid for uuid_text in uuids]))
            mine = batch if len(rows) == len(uuids) else batch.take(self._pa.array(rows))
            at = 6 + width
            places = [
                k for k, facts in enumerate(self._known)
                if facts.uuid == uuid and mine.column(at + k).null_count < mine.num_rows
            ]  # fmt: skip
            raws = [mine.column(at + k) for k in places]
            yield from streams.blocks(
                Rows(
                    str(uuid),
                    tuple(self._known[k].number for k in places),
                    _floats(mine.column(0)),
                    mine.column(2).to_numpy(zero_copy_only=False).astype(np.int64),
                    mine.column(3).fill_null(0).to_numpy(zero_copy_only=False).astype(np.uint64),
                    _floats(mine.column(4)),
                    np.array([flag == "test pattern" for flag in mine.column(5).to_pylist()]),
                    [_floats(mine.column(6 + k)) for k in places],
                    [_exact(raw) for raw in raws],
                    np.array([raw.is_valid().to_numpy(zero_copy_only=False) for raw in raws]).T.reshape(
                        len(rows), len(places)
                    ),
                )
            )


def _floats(column: Any) -> NDArray[Any]:
    return np.array(column.to_numpy(zero_copy_only=False), dtype=np.float64)


def _exact(column: Any) -> NDArray[Any]:
    """Return raw values: numbers unchanged; of text, whole numbers beyond 64 bits, else octets of hex digits."""
    kind = str(column.type)
    if kind in ("int64", "uint64"):
        filled: NDArray[Any] = column.fill_null(0).to_numpy(zero_copy_only=False)
        return filled
    if kind == "double":
        return _floats(column)
    found = np.empty(len(column), dtype=object)
    found[:] = [_long(value) if value else b"" for value in column.to_pylist()]
    return found


def _long(text: str) -> int | bytes:
    return int(text) if text.isdecimal() and text.isascii() else bytes.fromhex(text)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200].rstrip(".")
