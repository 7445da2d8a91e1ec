"""The page's own modules in one real browser, without a station: their questions are answered from a table.

Each costs a hundredth of a test with a station and nodes. What the station does with a request is held elsewhere: by
the tests of this folder that run one, and by those of its API.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import teds_provision

from .lab import PATIENCE

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

FOLDER = Path(teds_provision.__file__).parent / "ncap/page"
STATION = (Path(__file__).parent / "stage.js").read_text(encoding="utf-8")
WHERE = "http://127.0.0.1"  # each request is answered here, so none leaves this process
NOW = 1_795_600_800  # 2026-11-25T10:00:00Z
ARM, HAND = "a1" * 10, "b2" * 10
MODULES = """async (names) => {
  window.page = {};
  for (const name of names) window.page[name.split("/").at(-1)] = await import(`/js/${name}.js`);
  window.page.hub = window.page.state;
  window.page.state = window.page.hub.state;
  window.ends = [];
}"""
RESET = """() => {
  window.ends.splice(0).forEach((one) => one.end());
  Object.assign(window, { answers: {}, sent: [], held: [], sockets: [] });
  for (const id of ["main", "toasts", "say", "banner"]) document.getElementById(id).replaceChildren();
  location.hash = "";
  const { state } = window.page;
  Object.assign(state, {
    connection: "live", status: { write: true, links: [] }, loaded: true, nodes: new Map(), total: 0, groups: [],
    measurements: [], virtual: [], updates: [], profiles: [], names: [], values: new Map(), rings: new Map(),
    runs: new Map(), tapped: null, offset: 0, dropped: 0, received: 0,
  });
}"""


@dataclass
class Stage:
    """A page whose clock stands still until ``pass_time``. Its modules are names in the scripts that it runs; of
    ``state.js`` the state itself, and as ``hub`` what changes it."""

    page: Page
    names: str
    wrong: list[str]
    passed: int = 0  # ms since the clock was set

    def reset(self) -> None:
        """A station that is live and has nothing."""
        self.pass_time(100)  # what was announced, and nobody waited for
        if self.passed > 30_000:  # costs as much as a small test
            self.page.clock.set_system_time(NOW + 60)
            self.passed = 0
        self.page.evaluate(RESET)
        self.wrong.clear()

    def run(self, script: str, *words: Any) -> Any:
        """Return what a script gives: the body of a function of ``words``. ``show(view)`` ends that view afterwards."""
        before = f"const {{ {self.names} }} = window.page; const show = (one) => (window.ends.push(one), one);"
        return self.page.evaluate(f"async (words) => {{ {before} {{ {script} }} }}", list(words))

    def table(self, call: str, cases: list[tuple[Any, Any]]) -> None:
        """Hold what ``call`` gives for each ``one`` of a table against what stands beside it."""
        found = self.run(f"return words.map((one) => ({call}) ?? null)", *(case for case, _ in cases))
        assert list(zip([case for case, _ in cases], found, strict=True)) == cases

    def answers(self, **more: Any) -> None:
        """Set what the station answers, by method and path."""
        self.page.evaluate("(more) => Object.assign(window.answers, more)", more)

    def pass_time(self, milliseconds: int) -> None:
        """Let the page's clock run; over seconds each timer fires once at most, as of a laptop that was closed."""
        self.passed += milliseconds
        (self.page.clock.run_for if milliseconds < 4000 else self.page.clock.fast_forward)(milliseconds)

    @property
    def sent(self) -> list[Any]:
        """What the page asked since the last time, oldest first."""
        found: list[Any] = self.page.evaluate("() => window.sent.splice(0)")
        return found

    @property
    def said(self) -> str:
        """What a screen reader was given last."""
        return str(self.page.evaluate("() => document.getElementById('say').textContent"))


def _serve(route: Route) -> None:
    name = route.request.url.removeprefix(f"{WHERE}/").split("?")[0].split("#")[0]
    if name:
        route.fulfill(path=FOLDER / name)
    else:  # the page without what starts it
        route.fulfill(
            content_type="text/html; charset=utf-8",
            body=(FOLDER / "index.html").read_text().replace('<script src="js/main.js" type="module"></script>', ""),
        )


@contextmanager
def staged(browser: Browser, *modules: str) -> Iterator[Stage]:
    """Yield a page with these modules loaded, by the last part of their names, and nothing started."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, timezone_id="UTC", locale="en-GB")
    context.add_init_script(STATION)
    context.route("**/*", _serve)
    page = context.new_page()
    page.set_default_timeout(PATIENCE)
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    try:
        page.clock.install(time=NOW)
        page.goto(f"{WHERE}/")
        page.clock.pause_at(NOW + 60)
        page.evaluate(MODULES, ["state", *modules])
        names = ["hub", "state", *(module.rpartition("/")[2] for module in modules)]
        yield Stage(page, ", ".join(names), wrong)
    finally:
        context.close()
