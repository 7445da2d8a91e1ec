"""``demo --page``: what a newcomer runs to see the page."""

from __future__ import annotations

import signal
import urllib.request
from http.cookiejar import CookieJar
from pathlib import Path

import pytest

from tests.e2e.desk import Running

pytestmark = pytest.mark.link


def test_the_demo_serves_the_page_measures_and_leaves_nothing_behind() -> None:
    running = Running("--json", "demo", "--page")
    try:
        [line] = running.wait_for_lines(1, 150)
        browser = urllib.request.build_opener(
            urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor(CookieJar())
        )
        with browser.open(line["url"], timeout=60) as page:
            assert b"js/main.js" in page.read()
        with browser.open(line["url"].split("/login")[0] + "/api/v1/measurements", timeout=60) as answer:
            assert b'"group":"crane"' in answer.read()
        assert Path(line["home"]).exists()
        running.signal(signal.SIGINT)
        assert running.end().code == 0
        assert not Path(line["home"]).exists()
    finally:
        running.close()


def test_http_without_page_is_refused() -> None:
    running = Running("--json", "demo", "--http", "127.0.0.1:1")
    try:
        assert running.end().code == 2
    finally:
        running.close()
