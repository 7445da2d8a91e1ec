"""Twenty channels at 100 Hz for some seconds; ``python -m tests.page.load`` does it for a minute."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.cli.shell import PROGRAM

from .lab import Lab
from .load import ALMOST_ALL, run

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = [pytest.mark.system, pytest.mark.realtime]


def test_twenty_channels_at_100_hz_lose_nothing_unreported_and_need_no_more_memory(
    browser: Browser, fresh: Lab
) -> None:
    fresh.run(program=PROGRAM)
    seen = run(browser, fresh, 8)
    assert seen.grown < 3_000_000, seen
    assert seen.drawn > 0, seen
    if seen.dropped == 0:
        assert seen.received > ALMOST_ALL * seen.given > 0, seen
