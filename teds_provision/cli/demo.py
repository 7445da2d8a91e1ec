"""``demo``: the whole story on this machine."""

from __future__ import annotations

import signal
import sys

import click

from teds_provision import demo as demo_room
from teds_provision import provisioning
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.rendering import reporter_for
from teds_provision.errors import UsageError

NEXT = """
Next, with your own node (or a virtual one: node create, node run):
  teds-provision init         creates this station's keys; tells you where before it asks
  teds-provision provision    waits for a tap, then does every step; run it again to continue
  teds-provision measure      records and publishes calibrated values
  teds-provision doctor       finds problems with reader, bus or store, and how to fix them
  teds-provision demo --page  runs a base station with its web page"""


@command("teds-provision demo", "teds-provision demo --page")
@click.option("--page", is_flag=True, help="Run a base station with its page and virtual nodes until Ctrl-C.")
@click.option("--http", metavar="HOST:PORT", help="With --page: the address to serve on (default: a free local port).")
@pass_app
def demo(app: App, *, page: bool, http: str | None, more: str = "") -> None:
    """Two base stations and two virtual nodes: provision over NFC and CAN, hand over, measure, move an actuator.

    Uses temporary homes and vaults, communicates on this machine only, and leaves nothing behind.
    """
    # as for Ctrl-C: the demo must remove its folder and end its process
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if page:
        _page(app, http)
        return
    if http is not None:
        raise UsageError("--http requires --page.", hint="Run: teds-provision demo --page --http 127.0.0.1:8351")
    done = demo_room.story.run_demo(reporter_for(app), lambda text: app.note(f"\n{text}"))
    steps = [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps]
    app.emit(
        {"uuid": done.uuid.hex(), "steps": steps, "verdict": done.verdict},
        f"\nDone: {len(steps)} steps, the sensor is {done.verdict} and in the hands of station crane.\n{NEXT}{more}",
    )


def _page(app: App, http: str | None) -> None:
    over = provisioning.meeting.IdleStop(None)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.request_stop())
    with demo_room.page.page_demo(app.note, http) as shown:
        text = f"""Open {shown.url}
  (valid once, for five minutes; for another: teds-provision --home {shown.home} ncap open)
To place another node on its reader:
  {shown.tap}
Press Ctrl-C to stop."""
        app.emit({"ready": True, "url": shown.url, "home": str(shown.home), "tap": shown.tap}, text)
        sys.stdout.flush()
        over.wait()
