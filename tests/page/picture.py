"""The picture of the page for README: ``python -m tests.page.picture docs/page.png`` (``make page-picture``)."""

from __future__ import annotations

import sys
from pathlib import Path

from teds_provision.demo.page import page_demo

from .lab import QUIET, chromium

WIDTH, HEIGHT = 1400, 1060
SECONDS = 32  # the plot shows the last 30


def main() -> int:
    """Run the demo, wait until the plot is full, take the picture."""
    from playwright.sync_api import sync_playwright

    found = chromium()
    if found is None or len(sys.argv) != 2:
        sys.exit("Needs chromium (scripts/install-test-packages), and the name of the picture.")
    with sync_playwright() as playwright, page_demo(print) as shown:
        browser = playwright.chromium.launch(executable_path=found, args=list(QUIET))
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(shown.url)
        page.get_by_role("link", name="hand").click()
        page.get_by_role("img", name="Plot of opening").wait_for()
        page.wait_for_timeout(SECONDS * 1000)
        page.mouse.move(0, 0)
        page.screenshot(path=sys.argv[1])
        browser.close()
    print(f"{sys.argv[1]}: {Path(sys.argv[1]).stat().st_size} octets")
    return 0


if __name__ == "__main__":
    sys.exit(main())
