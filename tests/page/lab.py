"""A base station that runs, nodes in processes of their own, and browsers: all real, all on this machine."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from teds_provision import client
from tests.bench import PASSPHRASE, make_station
from tests.e2e.desk import ANGLE, Desk, Node, Running, Station
from tests.ncap import short_waits
from tests.places import free_tcp_port

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

QUIET = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
)  # fmt: skip
GRIPPER = "gripper"
CALIBRATIONS = {
    ANGLE: ("csv", "# date: 2026-11-01\nraw,value [degree]\n0,0\n65535,360\n"),
    GRIPPER: (
        "toml",
        "".join(
            f"[[calibration]]\nchannel = {channel}\ndate = 2026-11-01\n"
            f'unit = "{unit}"\npoints = [[0, 0], [4095, {high}]]\n'
            for channel, unit, high in ((1, "mm", 110), (2, "mm", 110), (3, "N", 140))
        ),
    ),
}
FRAMES = "requestAnimationFrame = draw => setTimeout(() => draw(performance.now()), 100)"
PATIENCE = 60_000  # ms that a test waits for something to be seen


def chromium() -> str | None:
    """Return the browser of this system; without windows, if it has that one: a page costs it a quarter of the CPU."""
    names = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
    return next((found for name in names if (found := shutil.which(name))), None)


@dataclass
class Lab:
    """A home, its bus and its reader; the daemon when it runs."""

    folder: Path
    desk: Desk
    station: Station
    port: int = field(default_factory=free_tcp_port)
    daemon: Running | None = None
    nodes: dict[str, Node] = field(default_factory=dict)
    board: Running | None = None

    @classmethod
    def make(cls, folder: Path) -> Lab:
        """A station without nodes; nothing runs yet."""
        make_station(folder / "prepared" / "bench", "bench").close()
        (folder / "desk").mkdir()
        desk = Desk(folder / "desk", folder / "prepared")
        return cls(folder, desk, desk.station())

    @property
    def can(self) -> str:
        return f"{self.desk.links.can}&fd=1"

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def run(self, *options: object, **more: Any) -> None:
        """Start the daemon and wait until it serves."""
        links = ["--can", self.can, "--nfc", self.desk.links.nfc]
        words = ["--home", self.station.home, "--json", "ncap", "run", "--http", f"127.0.0.1:{self.port}", *links]
        more.setdefault("program", short_waits.PROGRAM)
        self.daemon = self.desk.start(*words, *options, passphrase=PASSPHRASE, **more)
        self.daemon.wait_for('"ready": true')

    @contextmanager
    def visited(self) -> Iterator[None]:
        """One test in a lab that several share, however it ends: what it began ends, and no group is left."""
        try:
            yield
        finally:
            self.desk.clear(but=[self.daemon, self.board])
            if self.daemon is not None and self.daemon.runs:
                self._tidy()

    def _tidy(self) -> None:
        with client.connect(home=self.station.home) as station:
            for measurement in station.request("GET", "/measurements")["measurements"]:
                station.end_measurement(measurement["id"])
            for group in station.request("GET", "/groups")["groups"]:
                station.request("DELETE", f"/groups/{quote(group['name'], safe='')}")
            if station.status()["detection"] != "whitelist":
                station.request("PUT", "/detection", {"mode": "whitelist"})

    def end(self, number: int = signal.SIGTERM) -> None:
        """End the daemon."""
        assert self.daemon is not None
        self.daemon.signal(number)
        self.daemon.process.wait(60)
        self.daemon.close()

    def create(self, name: str, type_: str) -> Node:
        """Return a virtual node in factory state, from a transducer type; not powered."""
        node = self.nodes[name] = self.desk.node(name, called=name, type_=type_)
        return node

    def power(self, *names: str, nfc: bool = False, source: str = "ramp:2", more: tuple[str, ...] = ()) -> Running:
        """Power nodes on the bus, in one process; ``nfc``: on the reader instead (one node)."""
        where = ["--nfc", self.desk.links.nfc] if nfc else ["--can", self.can]
        folders = [self.nodes[name].folder for name in names]
        running = self.desk.start("--json", "node", "run", *folders, *where, "--source", source, *more)
        running.wait_for('"ready": true')
        self.board = self.board or running
        return running

    def moved(self, name: str) -> list[dict[str, Any]]:
        """Return what the actuators of a node of the first process did, as that process told."""
        assert self.board is not None
        while self.board.read(0.05):
            pass
        whole = self.board.out.split("\n")[:-1]  # the next one may have come in part
        lines = [json.loads(line) for line in whole if '"actuator"' in line]
        return [line for line in lines if line["uuid"] == self.nodes[name].uuid]

    def provision(self, name: str, type_: str, called: str | None = None) -> None:
        """By the command line over the bus."""
        node = self.nodes[name]
        ending, text = CALIBRATIONS[type_]
        calibration = self.desk.folder / f"{name}.{ending}"
        calibration.write_text(text)
        words = ["--profile", type_, "--calibration", calibration, "--name", called or name, "--via", "can"]
        done = self.station.ask(
            "provision", *words, "--can", f"{self.can}&node=0x{node.flash['can_address']:02X}", "--yes"
        )
        assert done["verdict"] == "authentic"

    def ask(self, *words: object) -> Any:
        """Return a command of the same home."""
        return self.station.ask(*words)

    def measurements(self) -> list[dict[str, Any]]:
        """Return what the daemon measures."""
        with client.connect(home=self.station.home) as station:
            found: list[dict[str, Any]] = station.request("GET", "/measurements")["measurements"]
        return found

    def measure(self, *names: str, rate: float = 100.0) -> None:
        """Begin to measure nodes, as a request of a script."""
        with client.connect(home=self.station.home) as station:
            station.request("POST", "/measurements", {"uuids": [self.nodes[name].uuid for name in names], "rate": rate})

    def login(self, *, read_only: bool = False) -> str:
        """Return an address of the page with a token that works once."""
        with client.connect(home=self.station.home) as station:
            return station.login_url(read_only=read_only)


@contextmanager
def opened(
    browser: Browser,
    lab: Lab,
    *,
    width: int = 1280,
    height: int = 900,
    route: str = "",
    read_only: bool = False,
    smooth: bool = False,
    **more: Any,
) -> Iterator[Page]:
    """Yield a browser of its own, signed in. An error, a breach of its policy or a foreign address fails the test.

    It draws ten frames a second, as drawing takes a third of a page's processor time; ``smooth``: as many as it can.
    """
    context = browser.new_context(viewport={"width": width, "height": height}, **more)
    if not smooth:
        context.add_init_script(FRAMES)
    page = context.new_page()
    page.set_default_timeout(PATIENCE)
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "console", lambda message: wrong.append(message.text) if "Content Security Policy" in message.text else None
    )
    page.on("request", lambda request: wrong.append(f"foreign: {request.url}") if lab.url not in request.url else None)
    try:
        page.goto(lab.login(read_only=read_only))
        if route:
            page.goto(f"{lab.url}/#/{route}")
        page.locator("#connection", has_text="Live").wait_for()
        yield page
    except BaseException:
        print(f"{page.url}\n{page.locator('body').inner_text()}")  # what a person would have seen
        raise
    finally:
        page.unroute_all(behavior="ignoreErrors")  # what a route still fetches ends with its page
        context.close()
    assert not wrong, wrong
