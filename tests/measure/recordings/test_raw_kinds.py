"""What holds the raw values of a channel in a file follows from the form that its datasheet gives them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from teds_provision.measure.recordings.columns import BlockJoiner, Rows, Streams, integers, raw_kind, stacked
from teds_provision.teds.calibration.samples import DataModel, SampleForm, SampleReader
from tests.measure.sinks.parts import block

KINDS = {"f": "float", "u": "uint64", "O": "integer"}


def forms() -> list[tuple[DataModel, int]]:
    """Return each data model in the lengths that it may have."""
    every = itertools.product(DataModel, (1, 2, 4, 8, 9, 12))
    return [(model, octets) for model, octets in every if not SampleForm(model, octets, 0).problem]


@pytest.mark.parametrize(("model", "octets"), forms())
def test_each_form_is_held_as_its_samples_are_read(model: DataModel, octets: int) -> None:
    """A Parquet made of a CSV held text in place of numbers, and could not be read."""
    form = SampleForm(model, octets, 7 if model == DataModel.UNSIGNED else 0)
    read = SampleReader(form).raw(np.full(octets, 255, dtype=np.uint8))
    kind = KINDS[read.dtype.kind]
    assert raw_kind(form.name) == ("int64" if kind == "uint64" and octets < 8 else kind)


@pytest.mark.parametrize("form", ["", "model 9 (reserved), 2 octets", "unsigned integer", "unsigned integer, many"])
def test_a_form_that_is_not_known_is_none(form: str) -> None:
    assert raw_kind(form) == ""


def rows_of(there: list[list[bool]], **more: Any) -> Rows:
    """Return rows of channels 4 and 7: raw value and value of a row are its place, and ten times that for channel 7."""
    n = len(there)
    place = np.arange(n)
    return replace(
        Rows(
            "ab", (4, 7), place / 10, place, place.astype(np.uint64), np.full(n, np.nan), np.zeros(n, bool),
            [place * 1.0, place * 10.0], [place, place * 10], np.array(there),
        ),
        **more,
    )  # fmt: skip


BOTH, FIRST, SECOND, NONE = [True, True], [True, False], [False, True], [False, False]


def shapes(streams: Streams, rows: Rows) -> list[tuple[int, tuple[int, ...], int, list[float]]]:
    return [
        (block.stream, block.channels, block.index, (block.time * 10).round().tolist())
        for block in streams.blocks(rows)
    ]


def test_rows_in_which_the_same_channels_have_values_are_one_stream() -> None:
    streams = Streams()
    assert shapes(streams, rows_of([BOTH, BOTH, NONE, FIRST, FIRST, SECOND])) == [
        (0, (7,), 5, [5.0]), (1, (4,), 3, [3.0, 4.0]), (2, (4, 7), 0, [0.0, 1.0]),
    ]  # fmt: skip
    assert shapes(streams, rows_of([BOTH])) == [(2, (4, 7), 0, [0.0])], "it keeps its number"
    assert shapes(streams, rows_of([FIRST], uuid="cd")) == [(0, (4,), 0, [0.0])], "each node has its own"


def test_a_gap_or_a_change_of_what_is_constant_begins_another_block() -> None:
    nan = np.nan
    for change, parts in (
        ({}, [[0, 1, 2, 3]]),
        ({"index": np.array([0, 1, 3, 4])}, [[0, 1], [2, 3]]),
        ({"index": np.array([0, 1, 0, 1])}, [[0, 1], [2, 3]]),
        ({"clock_error": np.array([0.1, 0.1, 0.2, nan])}, [[0, 1], [2], [3]]),
        ({"test": np.array([False, False, False, True])}, [[0, 1, 2], [3]]),
    ):  # fmt: skip
        found = list(Streams().blocks(rows_of([FIRST] * 4, **cast(Any, change))))
        assert [(block.time * 10).round().tolist() for block in found] == parts
    error, none = Streams().blocks(rows_of([FIRST] * 2, clock_error=np.array([0.1, nan])))
    assert (error.clock_error, none.clock_error) == (0.1, None)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ([0, -1], "int64"),
        ([2**63 - 1], "int64"),
        ([2**63], "uint64"),
        ([2**64 - 1], "uint64"),
        ([2**64], "object"),
        ([2**63, -1], "object"),
    ],
)
def test_whole_numbers_are_held_exactly_in_the_smallest_type(values: list[int], kind: str) -> None:
    held = integers(values)
    assert (held.dtype, held.tolist()) == (np.dtype(kind), values)


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ([np.array([1]), np.array([2])], "int64"),
        ([np.array([1.5]), np.array([2])], "float64"),
        ([np.array([1.5]), np.array([2**53])], "float64"),
        ([np.array([1.5]), np.array([2**53 + 1])], "object"),
        ([np.array([1.5]), np.array([-(2**53) - 1])], "object"),
        ([np.array([2**63], np.uint64), np.array([2])], "object"),
    ],
)
def test_raw_values_of_a_block_lose_nothing_by_standing_side_by_side(columns: list[Any], kind: str) -> None:
    held = stacked(columns)
    assert (held.dtype, held.tolist()) == (np.dtype(kind), [[columns[0].tolist()[0], columns[1].tolist()[0]]])


def test_blocks_that_follow_each_other_are_joined_and_each_node_has_its_own() -> None:
    joiner = BlockJoiner()
    parts = [
        block([[1], [2]]),
        block([[9]], uuid="cd" * 10),
        block([[3]], index=2),
        block([[5]], index=4),
        block([[6]], index=5, clock_error=0.5),
        block([[7.5]], index=6, clock_error=0.5),
        block([[8.5]], index=7, clock_error=0.5, test_pattern=True),
    ]
    for part in parts:
        assert joiner.add_block(part) == []
    *found, end = joiner.flush()
    assert end == ()
    assert [(cast(Any, one).index, cast(Any, one).raw[:, 0].tolist()) for one in found] == [
        (0, [1, 2, 3]), (4, [5]), (5, [6]), (6, [7.5]), (7, [8.5]), (0, [9]),
    ]  # fmt: skip
    assert joiner.flush() == [()]
    many = block(np.zeros((4095, 1)))
    assert joiner.add_block(many) == []
    [whole, end] = joiner.add_block(block([[1.0]], index=4095))
    assert (len(cast(Any, whole).time), end) == (4096, ())
