"""Everybody can use the page: no violation that axe finds, at every width, in both schemes; by keyboard alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system

AXE = (Path(__file__).parent / "vendor" / "axe.min.js").read_text(encoding="utf-8")
RULES = (
    "{runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa', 'best-practice'], resultTypes: ['violations']}"
)


def violations(page: Page) -> list[str]:
    """Return what axe says, one line each."""
    if not page.evaluate("window.axe !== undefined"):
        page.evaluate(AXE)
    found = page.evaluate(f"axe.run(document, {RULES})")["violations"]
    return [
        f"{item['id']}: {node['target']} {node['failureSummary'][:300]}" for item in found for node in item["nodes"]
    ]


@pytest.mark.parametrize(("width", "scheme"), [(360, "light"), (1600, "dark")])
def test_no_view_has_a_violation_or_is_wider_than_the_window(
    browser: Browser, lab: Lab, scheme: str, width: int
) -> None:
    hand = lab.nodes["hand"].uuid
    views = ["nodes", f"nodes/{hand}/live", f"nodes/{hand}/datasheet", f"nodes/{hand}/provision", "measure", "virtual"]
    wrong: dict[str, object] = {}
    with opened(browser, lab, width=width, color_scheme=scheme) as page:
        for view in [*views, "log", "station"]:
            page.goto(f"{lab.url}/#/{view}")
            page.locator("main").get_by_role("heading").first.wait_for()
            page.locator(".busy-line").wait_for(state="detached")
            found = violations(page)
            if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
                found.append(f"wider than {width}")
            if found:
                wrong[view] = found
    assert not wrong


def test_from_the_address_bar_to_a_nodes_datasheet_by_keyboard(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab) as page:
        page.get_by_role("link", name="Datasheet").wait_for()  # Tab ends at what is there
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.textContent") == "Skip to content"
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.id") == "main"
        for _ in range(40):
            page.keyboard.press("Tab")
            if page.evaluate("document.activeElement.textContent") == "Datasheet":
                break
        page.keyboard.press("Enter")
        page.get_by_role("heading", name="Datasheet (TEDS)").wait_for()
