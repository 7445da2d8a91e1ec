"""New firmware for many boards, on the page: the plan, its questions, progress, another browser, a closed tab."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.e2e.desk import ANGLE
from tests.firmware_images import make_key, sign
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Lab]:
    """Yield a station that runs, two fingers of one owner, and a board that takes no firmware."""
    lab = Lab.make(tmp_path_factory.mktemp("hand"))
    try:
        key = make_key(lab.folder / "owner.pem")
        old = image(lab, "1.0.0")
        for name in ("index", "thumb", "palm"):
            firmware = None if name == "palm" else (old, key)
            lab.nodes[name] = lab.desk.node(name, called=name, type_=ANGLE, firmware=firmware)
        lab.power("index", "thumb", "palm")
        for name in ("index", "thumb", "palm"):
            lab.provision(name, ANGLE)
        lab.run()
        yield lab
    finally:
        lab.desk.clear()


def image(lab: Lab, version: str, board: str = "virtual/finger", octets: int = 3000) -> Path:
    return sign(lab.folder, version, lab.folder / "owner.pem", counter=1, board=board, octets=octets)


def select(page: Page, *names: str) -> None:
    """Select nodes in the list, and go to their update."""
    page.locator(".card", has_text="palm").get_by_text("Authentic", exact=True).wait_for()
    page.get_by_role("button", name="Select", exact=True).click()
    for name in names:
        page.get_by_role("checkbox", name=f"Select {name}").check()
    page.get_by_role("button", name="Update firmware").click()
    page.get_by_text(re.compile(f"^{len(names)} boards? selected")).wait_for()


def plan(page: Page, file: Path) -> None:
    page.locator("#firmware-image").set_input_files(file)
    page.get_by_text(file.name).wait_for()
    page.get_by_role("button", name="Show the plan").click()


def board(page: Page, name: str, of: str = "Boards of this update") -> Locator:
    return page.get_by_role("list", name=of).get_by_role("listitem").filter(has_text=name)


def progress(page: Page) -> Locator:
    return page.get_by_role("region", name="How the update goes")


def test_from_a_selection_to_updated_boards(browser: Browser, hand: Lab) -> None:
    with opened(browser, hand) as page:
        select(page, "index", "thumb", "palm")
        plan(page, image(hand, "1.1.0"))
        planned = "Plan of each board"
        board(page, "index", planned).get_by_text(re.compile(r"Installs 1\.1\.0, \d+ octets, about \d+ s")).wait_for()
        board(page, "palm", planned).get_by_text("takes no firmware over its session").wait_for()
        page.get_by_role("button", name="Update 2 boards to 1.1.0").click()
        page.get_by_role("heading", name="Update to 1.1.0 is over").wait_for()
        progress(page).get_by_text("2 of 2 boards done: 2 updated").wait_for()
        board(page, "thumb").get_by_text("1.0.0 → 1.1.0").wait_for()
        page.reload()
        page.get_by_role("heading", name="Update to 1.1.0 is over").wait_for()
        page.get_by_text("No boards are selected.").wait_for()
        assert page.get_by_role("button", name="Show the plan").is_disabled()


def test_another_boards_image_and_an_older_one_are_asked_about(browser: Browser, hand: Lab) -> None:
    with opened(browser, hand, width=360, height=740) as page:
        select(page, "index", "thumb")
        plan(page, image(hand, "1.2.0", board="other/board"))
        page.get_by_role("button", name="No board to update").wait_for()
        assert page.get_by_role("button", name="No board to update").is_disabled()
        page.get_by_role("checkbox", name="Install it on index all the same").check()
        page.get_by_role("button", name="Update 1 board to 1.2.0").wait_for()
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        plan(page, image(hand, "0.9.0"))
        board(page, "thumb", "Plan of each board").get_by_text("tick “Allow an older version”").wait_for()
        page.get_by_label("Allow an older version").check()
        page.get_by_role("button", name="Show the plan").click()
        page.get_by_role("button", name="Update 2 boards to 0.9.0").wait_for()


def test_what_is_no_image_is_refused_with_the_cure(browser: Browser, hand: Lab) -> None:
    with opened(browser, hand) as page:
        select(page, "index")
        hostile = hand.folder / "<img src=x onerror=alert(1)>.bin"
        hostile.write_bytes(b"no image")
        plan(page, hostile)
        page.get_by_role("alert").filter(has_text="not a whole MCUboot image").wait_for()
        large = hand.folder / "large.bin"
        large.write_bytes(b"\0" * (5 << 20))
        page.locator("#firmware-image").set_input_files(large)
        page.get_by_role("alert").filter(has_text="too large for a firmware image").wait_for()
        assert page.get_by_role("button", name="Show the plan").is_disabled()
    with opened(browser, hand, route="nodes/update", read_only=True) as page:
        page.get_by_text("This browser has read-only access.").wait_for()
        assert page.locator("#firmware-image").is_disabled()


def test_it_goes_on_without_the_tab_and_a_second_person_sees_who_updates(browser: Browser, hand: Lab) -> None:
    assert hand.board is not None
    with opened(browser, hand) as other:
        select(other, "thumb")
        plan(other, image(hand, "1.3.1"))
        other.get_by_role("button", name="Update 1 board to 1.3.1").wait_for()
        with opened(browser, hand, width=1600) as page:
            select(page, "index", "thumb")
            page.get_by_label("Boards at once").fill("1")
            plan(page, image(hand, "1.3.0"))
            start = page.get_by_role("button", name="Update 2 boards to 1.3.0")
            start.wait_for()
            hand.board.signal(signal.SIGSTOP)  # the boards answer nothing, so the update stands still
            try:
                start.press("Enter")
                progress(page).get_by_text("0 of 2 boards done").wait_for()
                board(page, "thumb").get_by_text("waiting").wait_for()
                other.get_by_role("heading", name="Updating to 1.3.0").wait_for()
                other.get_by_text("Requested by the page").wait_for()
                assert other.get_by_role("button", name="Update 1 board to 1.3.1").is_hidden()
                other.get_by_role("link", name=re.compile("Firmware update to 1.3.0")).wait_for()
            finally:
                hand.board.signal(signal.SIGCONT)
        other.get_by_role("heading", name="Update to 1.3.0 is over").wait_for()
        progress(other).get_by_text("2 of 2 boards done: 2 updated").wait_for()
    until(lambda: not list((hand.station.home / "updates").glob("*.image")))
