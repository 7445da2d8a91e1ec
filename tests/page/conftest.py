from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from tests.e2e.desk import ANGLE

from .lab import GRIPPER, QUIET, Lab, chromium
from .stage import Stage, staged

if TYPE_CHECKING:
    from playwright.sync_api import Browser


# Of this package, not of the session: while playwright runs, its thread has an event loop, and other tests want theirs.
@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Yield one chromium for all tests of the page."""
    found = chromium()
    if found is None:
        pytest.skip("no chromium here: scripts/install-test-packages installs it")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (pip install playwright)")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=list(QUIET))
        yield browser
        browser.close()


@pytest.fixture(scope="package")
def lab(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Lab]:
    """A station that runs, with an angle sensor and a gripper that it provisioned, on one bus; a reader beside it."""
    lab = Lab.make(tmp_path_factory.mktemp("page"))
    try:
        lab.create("slew", ANGLE)
        lab.create("hand", GRIPPER)
        lab.power("slew", "hand", more=("--battery", "80"))
        lab.provision("slew", ANGLE)
        lab.provision("hand", GRIPPER)
        lab.run()
        yield lab
    finally:
        lab.desk.clear()


@pytest.fixture
def fresh(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Lab]:
    """Yield a station of its own for one test, empty and not started."""
    lab = Lab.make(tmp_path_factory.mktemp("fresh"))
    try:
        yield lab
    finally:
        lab.desk.clear()


MODULES = (
    "format", "shapes", "ring", "past", "api", "dom", "live", "plot", "views/actuator", "views/bulk", "views/datasheet",
    "views/facts", "views/feed", "views/filters", "views/history", "views/line", "views/links", "views/log",
    "views/measure", "views/node", "views/nodes", "views/provision", "views/rates", "views/setpoints", "views/station",
    "views/update", "views/values", "views/virtual", "views/write",
)  # fmt: skip


@pytest.fixture(scope="package")
def modules(browser: Browser) -> Iterator[Stage]:
    """Yield the page's modules in one page, without a station."""
    with staged(browser, *MODULES) as stage:
        yield stage


@pytest.fixture
def stage(modules: Stage) -> Iterator[Stage]:
    """Yield them with a station that has nothing; an error in the page fails the test."""
    modules.reset()
    yield modules
    assert not modules.wrong, modules.wrong
