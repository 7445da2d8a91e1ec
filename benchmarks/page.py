"""The page with many nodes, and the memory of the past: ``python -m benchmarks.page``; needs chromium and playwright.

First paint with a thousand nodes, times of frames with 200 live channels beside an empty page, octets of the ring.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from playwright.sync_api import sync_playwright

from teds_provision import client
from teds_provision.measure.blocks import Block
from teds_provision.ncap.history import HOUR, History
from tests.page.lab import QUIET, Lab, chromium, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

FINGER, OF_A_FINGER = "tactile-finger-sensor", 12
FRAMES = """(seconds) => new Promise((done) => {
  const times = [];
  const end = performance.now() + 1000 * seconds;
  let before = null;
  const step = (now) => {
    if (before !== null) times.push(now - before);
    before = now;
    if (now < end) requestAnimationFrame(step);
    else done(times);
  };
  requestAnimationFrame(step);
})"""


def resident() -> int:
    """Return the octets of this process that are in memory."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("no VmRSS")


def ring(channels: int) -> int:
    """Return the octets of the history of that many channels, each with its own stream and an hour filled."""
    before, past, now = resident(), History(), float(int(time.time()))
    at = np.concatenate([now - HOUR + np.arange(HOUR), now + np.arange(6000) / 100])
    ticks = np.arange(len(at), dtype=np.uint64)
    value = np.sin(at)[:, None]
    for number in range(channels):
        block = Block(f"{number:020x}", 1, (1,), 0, at, ticks, value, value, np.ones(value.shape, bool))
        past.block(block)
        if number % 100 == 99:
            past.channel_history(f"{number:020x}", 1)
    past.channel_history(f"{channels - 1:020x}", 1)
    assert len(past) == channels
    return resident() - before


def frames(page: Page, seconds: float) -> str:
    """Return median and 99th percentile of the times between frames."""
    times = sorted(page.evaluate(FRAMES, seconds))
    return f"median {times[len(times) // 2]:.1f} ms, p99 {times[int(len(times) * 0.99)]:.1f} ms, {len(times)} frames"


def many_nodes(browser: Browser, lab: Lab, nodes: int) -> list[float]:
    """Return ms from the start of the load until the first nodes are drawn, of five loads."""
    listed = [{"uuid": f"beef{number:016x}", "name": f"joint {number}"} for number in range(nodes)]
    file = lab.folder / "crowd.json"
    file.write_text(json.dumps({"whitelist": listed}))
    lab.ask("whitelist", "import", file)
    paints = []
    with opened(browser, lab) as page:
        for _ in range(5):
            page.reload()
            page.locator(".card").first.wait_for()
            paints.append(page.evaluate("performance.now()"))  # the first card stands there: later than it is painted
    return paints


def live(browser: Browser, lab: Lab, channels: int, seconds: float) -> None:
    """Print the frames of an empty page, then of one with that many live channels."""
    with opened(browser, lab, route="virtual") as page:
        print(f"empty page, {seconds:g} s: {frames(page, seconds)}", flush=True)
    with client.connect(home=lab.station.home) as station:
        for number in range(-(-channels // OF_A_FINGER)):
            station.request("POST", "/virtual", {"profile": FINGER, "name": f"finger {number}"})
        until = time.monotonic() + 120
        while time.monotonic() < until:
            good = [node for node in station.nodes() if node["verdict"] and node["verdict"]["verdict"] == "authentic"]
            if len(good) * OF_A_FINGER >= channels:
                break
            time.sleep(1)
        station.request("POST", "/measurements", {"uuids": [node["uuid"] for node in good], "rate": 20})
    with opened(browser, lab, route="measure") as page:
        time.sleep(10)
        print(f"{len(good) * OF_A_FINGER} live channels, {seconds:g} s: {frames(page, seconds)}", flush=True)
        print(f"  {page.locator('.plot-foot').inner_text()}", flush=True)


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    ring(1)  # loads what every process loads once
    for channels in (10, 100, 1000):
        print(f"ring of {channels} channels: {ring(channels) / 1e6:.1f} MB", flush=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=list(QUIET))
        lab = Lab.make(Path(tempfile.mkdtemp()))
        try:
            lab.run()
            paints = many_nodes(browser, lab, 1000)
            print(f"first paint, 1,000 nodes: best {min(paints):.0f} ms of {', '.join(f'{ms:.0f}' for ms in paints)}")
            live(browser, lab, 200, seconds)
        finally:
            lab.desk.clear()
            browser.close()


if __name__ == "__main__":
    main()
