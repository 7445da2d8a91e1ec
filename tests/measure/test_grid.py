"""A group's rows: last value that is not newer, its age, NaN after two periods, nobody waits for the slowest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.measure.blocks import GroupRows
from teds_provision.measure.grid import Grid
from tests.measure.sinks.parts import ANGLE, FORCE, HAND, block

NOW = 1_795_000_000.0
SLOW = replace(FORCE, period=0.05)


def rows(grid: Grid, now: float) -> GroupRows:
    found = grid.rows(now)
    assert found is not None
    return found


def test_a_row_holds_the_last_value_that_is_not_newer_and_its_age() -> None:
    grid = Grid("g", [ANGLE, SLOW], patience=0.1)
    grid.add_block(block([[k] for k in range(10)]))
    grid.add_block(block([[100], [200]], uuid=HAND, channels=(2,), period=0.05))
    got = rows(grid, NOW + 0.3)
    np.testing.assert_allclose(got.time[:10] - NOW, np.arange(10) * 0.01, atol=1e-6)
    np.testing.assert_allclose(got.value[:10, 0], np.arange(10) / 10)
    np.testing.assert_allclose(got.value[:10, 1], [10] * 5 + [20] * 5)
    np.testing.assert_allclose(got.age[:10, 1], [0, 0.01, 0.02, 0.03, 0.04] * 2, atol=1e-6)


def test_a_stream_that_comes_with_other_channels_fills_the_columns_of_these() -> None:
    other = replace(ANGLE, number=2, name="other")
    for channels, values in (((2,), [[5]]), ((2, 1), [[5, 6]])):
        grid = Grid("g", [ANGLE, other], patience=0.0)
        grid.add_block(block([[1]]))
        assert rows(grid, NOW + 0.005).value[-1].tolist()[0] == 0.1
        grid.add_block(block(values, channels=channels, start=NOW + 0.01))
        last = rows(grid, NOW + 0.015).value[-1].tolist()
        np.testing.assert_equal(last, [np.nan if len(channels) == 1 else 0.6, 0.5])


def test_after_two_periods_a_value_is_no_value() -> None:
    grid = Grid("g", [ANGLE], patience=0.0)
    grid.add_block(block([[7]]))
    got = rows(grid, NOW + 0.0501)
    assert np.isnan(got.value[:, 0]).tolist() == [False, False, False, True, True, True]
    assert np.isnan(got.age[:, 0]).tolist() == [False, False, False, True, True, True]


def test_an_invalid_sample_is_not_covered_up_by_the_one_before() -> None:
    grid = Grid("g", [ANGLE], patience=0.0)
    grid.add_block(block([[7], [8]], valid=[[True], [False]]))
    got = rows(grid, NOW + 0.011)
    assert np.isnan(got.value[:, 0]).tolist() == [False, True]


def test_a_row_waits_for_all_but_not_longer_than_its_patience() -> None:
    grid = Grid("g", [ANGLE, FORCE], patience=0.05)
    grid.add_block(block([[1]] * 10))
    grid.add_block(block([[1]] * 3, uuid=HAND, channels=(2,)))
    assert len(rows(grid, NOW + 0.06).time) == 3, "the second stream has come to the third row"
    assert grid.rows(NOW + 0.06) is None
    assert len(rows(grid, NOW + 0.0851).time) == 1, "row 3 is past the patience"
    assert len(rows(grid, NOW + 0.0951).time) == 6, "the second stream is lost by now: nobody waits for it"


def test_a_value_that_comes_after_its_row_is_not_put_into_it() -> None:
    grid = Grid("g", [ANGLE, FORCE], patience=0.02)
    grid.add_block(block([[1]] * 10))
    grid.add_block(block([[1]], uuid=HAND, channels=(2,)))
    first = rows(grid, NOW + 0.10)
    grid.add_block(block([[k] for k in range(10, 20)], uuid=HAND, channels=(2,), index=1))
    grid.add_block(block([[1]] * 10, index=10))
    second = rows(grid, NOW + 0.2)
    assert second.time[0] > first.time[-1]
    assert np.isnan(first.value[5, 1])
    assert second.value[0, 1] == 1.9, "row 10 has its own sample"


def test_an_event_keeps_its_value() -> None:
    grid = Grid("g", [ANGLE, replace(FORCE, kind="event", period=None)], patience=0.0)
    grid.add_block(block([[1]] * 3))
    grid.add_block(block([[5]], uuid=HAND, channels=(2,)))
    for k in range(1, 30):
        grid.add_block(block([[1]] * 3, index=3 * k))
    got = rows(grid, NOW + 0.9)
    assert got.value[-1, 1] == 0.5
    assert got.age[-1, 1] > 0.8


def test_channels_of_other_groups_are_left_out() -> None:
    grid = Grid("g", [ANGLE])
    grid.add_block(block([[5]], uuid=HAND, channels=(2,)))
    assert grid.rows(NOW + 1) is None


def test_channels_that_do_not_lie_side_by_side_come_into_their_columns() -> None:
    """Two streams of one node whose channels take turns, one of them with channels that are not of the group."""
    facts = [replace(ANGLE, number=number) for number in (1, 2, 3, 4)]
    grid = Grid("g", facts, patience=0.0)
    grid.add_block(block([[3, 9, 1], [30, 9, 10]], channels=(3, 9, 1)))
    grid.add_block(replace(block([[4, 2]], channels=(4, 2)), stream=1))
    got = rows(grid, NOW + 0.0351)
    np.testing.assert_allclose(got.value[:2], [[0.1, 0.2, 0.3, 0.4], [1.0, 0.2, 3.0, 0.4]])
    assert np.isnan(got.value[3]).tolist() == [False, True, False, True], "the second stream ended a row earlier"
    np.testing.assert_allclose(got.age[2], [0.01, 0.02, 0.01, 0.02], atol=1e-6)


def test_a_row_before_the_first_value_of_a_stream_has_none_of_it() -> None:
    """Not even one that came later and is younger than two periods: no value is from the future."""
    grid = Grid("g", [ANGLE, FORCE], patience=0.0)
    grid.add_block(block([[1], [2], [3], [4]]))
    grid.add_block(block([[70], [80]], uuid=HAND, channels=(2,), start=NOW + 0.015))
    got = rows(grid, NOW + 0.0301)
    np.testing.assert_allclose(got.value[:, 0], [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal(got.value[:, 1], [np.nan, np.nan, 7.0, 8.0])
    np.testing.assert_allclose(got.age[:, 1], [np.nan, np.nan, 0.005, 0.005], atol=1e-6)


def test_rows_are_marked_from_the_first_test_pattern_on() -> None:
    grid = Grid("g", [ANGLE, FORCE], patience=0.0)
    grid.add_block(block([[1]]))
    assert not rows(grid, NOW + 0.001).test_pattern
    grid.add_block(block([[1]], uuid=HAND, channels=(2,), test_pattern=True))
    grid.add_block(block([[2]], index=1))
    assert rows(grid, NOW + 0.011).test_pattern, "whichever of its channels it is"


def test_after_a_long_gap_the_last_ten_thousand_rows_come() -> None:
    grid = Grid("g", [ANGLE], patience=0.0)
    grid.add_block(block([[1]]))
    rows(grid, NOW)
    grid.add_block(block([[2]], start=NOW + 200.0))
    got = rows(grid, NOW + 200.001)
    assert len(got.time) == 10_000
    np.testing.assert_allclose(got.time[[0, -1]] - NOW, [100.01, 200.0], atol=1e-6)


def test_how_far_apart_streams_began_is_reported() -> None:
    grid = Grid("g", [ANGLE, FORCE])
    grid.add_block(block([[1]]))
    grid.add_block(block([[1]], uuid=HAND, channels=(2,), start=NOW + 0.004))
    grid.add_block(block([[1]], index=5))
    np.testing.assert_allclose(grid.began_apart(), 0.004, atol=1e-6)


@given(
    st.lists(st.tuples(st.integers(1, 9), st.booleans()), min_size=1, max_size=20),
    st.lists(st.floats(0.001, 0.2), min_size=1, max_size=10),
)
@settings(max_examples=60)
def test_every_row_is_the_definition(sizes: list[tuple[int, bool]], looks: list[float]) -> None:
    """Against the plain definition over all samples, for any cutting into blocks and any moments of looking."""
    grid = Grid("g", [ANGLE], patience=10.0)
    samples: list[tuple[float, float]] = []
    got: list[tuple[float, float, float]] = []
    index = 0
    for turn, (size, good) in enumerate(sizes):
        narrow = block([[index + k] for k in range(size)], valid=[[good]] * size, index=index)
        samples += zip(narrow.time.tolist(), narrow.value[:, 0].tolist(), strict=True)
        index += size + (3 if turn % 3 == 2 else 0)
        grid.add_block(narrow)
        found = grid.rows(samples[-1][0] + looks[turn % len(looks)])
        if found is not None:
            got += zip(found.time.tolist(), found.value[:, 0].tolist(), found.age[:, 0].tolist(), strict=True)
    assert got
    for at, value, age in got:
        last, expected = max((when, value) for when, value in samples if when <= at + 1e-7)
        if at - last > 0.02 + 1e-9:
            assert np.isnan(value)
        else:
            assert abs(age - max(at - last, 0)) < 1e-7
            assert value == expected or (np.isnan(value) and np.isnan(expected))


def test_an_empty_block_changes_nothing_and_an_older_one_makes_no_row_wait() -> None:
    grid = Grid("g", [ANGLE], patience=10.0)
    grid.add_block(block(np.zeros((0, 1))))
    assert grid.rows(NOW) is None
    grid.add_block(block([[1], [2], [3]]))
    grid.add_block(block([[0]], start=NOW - 0.005))
    assert len(rows(grid, NOW + 0.03).time) == 3


def test_the_first_row_is_at_the_first_value_or_after_it_up_to_a_millionth_of_a_period() -> None:
    for ahead, first in ((0.0, 0.0), (5e-7, 0.0), (0.25, 1.0), (0.75, 1.0)):
        grid = Grid("g", [replace(ANGLE, period=1.0)], patience=0.0)
        grid.add_block(block([[1], [2]], start=NOW + ahead, period=1.0))
        got = rows(grid, NOW + 1.8)
        assert (got.time[0] - NOW, bool(np.isnan(got.value[0, 0]))) == (first, False)


def test_a_value_is_one_until_two_periods_are_over() -> None:
    grid = Grid("g", [replace(ANGLE, period=0.5)], patience=0.0)
    grid.add_block(block([[1]], start=100.0))
    got = rows(grid, 101.6)
    assert got.time.tolist() == [100.0, 100.5, 101.0, 101.5]
    assert np.isnan(got.value[:, 0]).tolist() == [False, False, False, True]
