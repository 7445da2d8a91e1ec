"""A datasheet of a known node is given to the page: the copy gets a UUID of its own by a button beside the refusal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from teds_provision import client

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system


WIDE = pytest.mark.nightly(
    "tests/page/test_copies.py::test_a_copy_gets_a_new_uuid_by_keyboard[360]: nothing of it hangs on the width"
)


@pytest.mark.parametrize("width", [360, pytest.param(1600, marks=WIDE)])
def test_a_copy_gets_a_new_uuid_by_keyboard(browser: Browser, lab: Lab, tmp_path: Path, width: int) -> None:
    """The hint named a member of the API's body, and the focus was lost with the button that was pressed."""
    hand = lab.nodes["hand"].uuid
    sheet = tmp_path / f"{'hand of the crane, as it was read on the bench ' * 4}.xml"
    with lab.visited(), client.connect(home=lab.station.home) as station:
        sheet.write_text(station.request("GET", f"/nodes/{hand}/teds?format=xml"))
        with opened(browser, lab, width=width, route="virtual") as page:
            page.get_by_label("Or a datasheet file").set_input_files(sheet)
            page.get_by_label("Name", exact=True).fill("copy")
            page.get_by_role("button", name="Create", exact=True).focus()
            page.keyboard.press("Enter")
            refusal = page.get_by_role("alert").filter(has_text=hand)
            refusal.wait_for()
            assert "new_uuid" not in refusal.inner_text()
            offer = page.get_by_role("button", name="Create it with a new UUID")
            above, below = refusal.bounding_box(), offer.bounding_box()
            assert above is not None
            assert below is not None
            assert below["y"] >= above["y"] + above["height"] + 4, "they touch"
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            offer.focus()
            page.keyboard.press("Enter")
            page.get_by_text("Created", exact=True).wait_for()
            [made] = station.request("GET", "/virtual")["virtual"]
            try:
                assert (made["uuid"] != hand, made["name"]) == (True, "copy")
                assert made["uuid"] in page.evaluate("document.activeElement.href ?? 'lost'")
            finally:
                station.request("DELETE", f"/virtual/{made['uuid']}")
