"""20 channels at 100 Hz in a real browser: does its memory grow, does it lose points or drawings without saying so?

``python -m tests.page.load --seconds 60`` is the long form; the suite runs a short one.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision import client
from tests.pace import until

from .lab import QUIET, Lab, chromium, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession, Page

RATE = 100
SHOWN = 20
CHANNELS = 24
LOOKS = 6
CATCHING_UP = 30.0  # seconds for a page that is behind
ALMOST_ALL = 0.95  # of what was given: a report of the page and the count beside it are not of one instant


@dataclass(frozen=True)
class Load:
    """What was seen: seconds, octets of the heap after a collection at each look, points, drawings."""

    seconds: float
    heap: tuple[int, ...]
    received: int  # points that the page took in, from its second report on
    given: int  # points that the station gave out to whoever listens, since then: it thins bursts
    dropped: int  # messages that it was too slow for, by its own count
    drawn: int
    left_out: int  # drawings, by its own count
    sampled: int  # by the station, of all channels that it measures
    lost: int  # between node and station

    @property
    def grown(self) -> int:
        """Octets from the second look to the last: by the second one all code is compiled and all buffers are there."""
        return self.heap[-1] - self.heap[1]

    def __str__(self) -> str:
        heap = ", ".join(f"{octets / 1e6:.2f}" for octets in self.heap)
        return (
            f"{self.seconds:.1f} s, {CHANNELS} channels, {SHOWN} drawn: {self.received} of {self.given} points came "
            f"({self.dropped} messages dropped, as the page tells; {self.sampled} were sampled from the first on, and "
            f"{self.lost} lost before the station), "
            f"drawn {self.drawn / self.seconds:.1f} times/s ({self.left_out} left out, as it tells), heap {heap} MB"
        )


def run(browser: Browser, lab: Lab, seconds: float) -> Load:
    """Return two tactile fingers of 12 channels each, measured at RATE, twenty of them drawn."""
    with client.connect(home=lab.station.home) as station:
        asked = [{"profile": "tactile-finger-sensor", "name": name, "source": "sine:3"} for name in ("index", "thumb")]
        uuids = [station.request("POST", "/virtual", entry)["uuid"] for entry in asked]
        until(
            lambda: all((station.node(uuid)["verdict"] or {}).get("verdict") == "authentic" for uuid in uuids),
            "not provisioned",
        )
        beside = Listener(lab)
        beside.start()
        with opened(browser, lab, route="measure", smooth=True) as page:
            kept = station.request("POST", "/measurements", {"uuids": uuids, "rate": RATE})["id"]
            early = until(lambda: received_beyond(page, RATE * SHOWN), "no points arrive")
            early = until(lambda: received_beyond(page, early), "no more points arrive")  # counted just now
            before = beside.given  # the page was not there to see the first ones
            devtools = page.context.new_cdp_session(page)
            began, heaps = time.monotonic(), []
            for _ in range(LOOKS):
                heaps.append(heap(devtools))
                time.sleep(seconds / (LOOKS - 1))
            heaps.append(heap(devtools))
            end = time.monotonic() + CATCHING_UP
            while True:  # it reports once a second: a report that came just now, beside what was given until now
                late = until(partial(received_beyond, page, counts_of(page)["received"]), "no more points arrive")
                points, counts = (late - early, beside.given - before), counts_of(page)
                if counts["dropped"] or points[0] > ALMOST_ALL * points[1] or time.monotonic() > end:
                    break
            sampled, lost = samples(station)
            station.request("DELETE", f"/measurements/{kept}", {})
            elapsed = time.monotonic() - began
    return Load(elapsed, tuple(heaps), *points, counts["dropped"], counts["drawn"], counts["skipped"], sampled, lost)


class Listener(threading.Thread):
    """A client beside the page: counts the points that the station gives out."""

    def __init__(self, lab: Lab) -> None:
        super().__init__(daemon=True)
        self._lab = lab
        self.given = 0

    def run(self) -> None:
        """Count until the station ends."""
        with suppress(Exception):  # the connection ends as the station does
            for message in client.connect(home=self._lab.station.home).live():
                if message["type"] == "values":
                    self.given += sum(len(times) for times, _ in message["channels"].values())


def received_beyond(page: Page, count: int) -> int:
    """Return how many points the page has taken in, 0 if not more than ``count``."""
    received = counts_of(page)["received"]
    return received if received > count else 0


def counts_of(page: Page) -> dict[str, int]:
    """Return what the plot says of itself, once a second."""
    dataset = page.locator(".plot-foot").evaluate("foot => ({...foot.dataset})")
    return {name: int(dataset.get(name, 0)) for name in ("received", "dropped", "drawn", "skipped")}


def heap(devtools: CDPSession) -> int:
    """Return octets of the page's JavaScript after a collection."""
    devtools.send("HeapProfiler.collectGarbage")
    return int(devtools.send("Runtime.getHeapUsage")["usedSize"])


def samples(station: client.Client) -> tuple[int, int]:
    """Samples taken and lost so far."""
    nodes = [
        node for measurement in station.request("GET", "/measurements")["measurements"] for node in measurement["nodes"]
    ]
    return sum(node.get("samples", 0) for node in nodes), sum(node.get("lost", 0) for node in nodes)


def main() -> int:
    """Return the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    from playwright.sync_api import sync_playwright

    found = chromium()
    if found is None:
        sys.exit("No chromium here: scripts/install-test-packages installs it.")
    folder = Path(tempfile.mkdtemp(prefix="page-load-"))
    lab = Lab.make(folder)
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=found, args=list(QUIET))
            lab.run()
            print(run(browser, lab, seconds))
            browser.close()
    finally:
        lab.desk.clear()
        shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
