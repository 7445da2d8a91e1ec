"""Every string of the vectors' index decodes to the verdict that it has there."""

from __future__ import annotations

import pytest

from teds_provision import teds
from tests.teds.vectors import ALL, CLEAN, TEDS, octets_of


@pytest.mark.parametrize("name", ALL)
def test_verdict_is_that_of_the_index(name: str) -> None:
    assert teds.decode(octets_of(name)).verdict == ALL[name]["verdict"]
