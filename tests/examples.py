"""Limit the examples of properties: ``make quick`` gives each few, whatever a test asks for itself."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import is_hypothesis_test, settings


def limit_examples(items: Sequence[pytest.Item], most: int) -> None:
    """Give each property ``most`` examples at most."""
    for item in items:
        test = getattr(item, "function", None)
        if test is not None and is_hypothesis_test(test):
            asked = test._hypothesis_internal_use_settings  # where hypothesis keeps them, and its own plugin reads them
            if asked.max_examples > most:
                test._hypothesis_internal_use_settings = settings(asked, max_examples=most)
