"""``demo``: the whole story on this machine."""

from __future__ import annotations

import signal

from teds_provision import demo as demo_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.rendering import reporter_for

NEXT = """
Next, with a node of your own (or a virtual one: node create, node run):
  teds-provision init         makes this station's keys; says where they go before it asks
  teds-provision provision    waits for a tap, then does every step; run it again, it carries on
  teds-provision measure      records and publishes calibrated values
  teds-provision doctor       says what is wrong with reader, bus or store, and the cure"""


@command("teds-provision demo", "teds-provision --json demo")
@pass_app
def demo(app: App) -> None:
    """Two base stations and two virtual nodes: provision over NFC and CAN, hand over, measure, move an actuator.

    Uses throwaway homes and vaults, talks to this machine alone, leaves nothing behind.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: a folder and a process are to be taken away
    done = demo_room.demo.run_demo(reporter_for(app), lambda text: app.note(f"\n{text}"))
    steps = [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps]
    app.emit(
        {"uuid": done.uuid.hex(), "steps": steps, "verdict": done.verdict},
        f"\nDone: {len(steps)} steps, the sensor is {done.verdict} and in the hands of station crane.\n{NEXT}",
    )
