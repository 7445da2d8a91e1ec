"""``demo``: the whole story on this machine."""

from __future__ import annotations

import signal

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command


@command("teds-provision demo", "teds-provision --json demo")
@pass_app
def demo(app: App) -> None:
    """Two base stations and a virtual node: provision over NFC, verify over CAN, hand over, verify from the second.

    Uses throwaway homes and vaults, talks to this machine alone, leaves nothing behind.
    """
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.demo.demo import run_demo

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C: a folder and a process are to be taken away
    done = run_demo(reporter_for(app), lambda text: app.note(f"\n{text}"))
    steps = [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps]
    app.emit(
        {"uuid": done.uuid.hex(), "steps": steps, "verdict": done.verdict},
        f"\nDone: {len(steps)} steps, the sensor is {done.verdict} and in the hands of station crane.",
    )
