"""The quick run gives each property few examples, and changes nothing else of what it asks for."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.examples import limit_examples


def examples_of(asked: int, most: int) -> int:
    """Return how many examples a property gets that asks for so many."""
    tried = []

    @settings(max_examples=asked, phases=[Phase.generate], database=None, suppress_health_check=list(HealthCheck))
    @given(st.integers())
    def test(number: int) -> None:
        tried.append(number)

    limit_examples(cast(Any, [SimpleNamespace(function=test), SimpleNamespace(function=len), SimpleNamespace()]), most)
    test()
    return len(tried)


def test_a_property_that_asks_for_many_examples_gets_few() -> None:
    assert examples_of(200, 20) == 20


def test_a_property_that_asks_for_fewer_gets_those() -> None:
    assert examples_of(7, 20) == 7
