"""``demo``: what the plant adds: --plant and --line, two more stories on this machine."""

from __future__ import annotations

import signal
from typing import Any, Final

import click

from teds_provision import plant as plant_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.extending import add_examples, add_options, callback_of
from teds_provision.cli.rendering import reporter_for
from teds_provision.errors import UsageError

_MORE: Final = "\n  teds-provision demo --plant runs three stations that share keys through a registry"


def extend(command: click.Command) -> None:
    """Add --plant and --line."""
    core = callback_of(command)

    @pass_app
    def demo(app: App, /, *, plant: bool, line: bool, **rest: Any) -> None:
        # as for Ctrl-C: the demo must remove its files and end its processes
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        if rest["page"] + plant + line > 1:
            raise UsageError("Give one of --page, --plant and --line.")
        if plant and rest["http"] is None:
            _plant(app)
        elif line and rest["http"] is None:
            _line(app)
        else:
            core(more=_MORE, **rest)

    add_options(
        command,
        "--page",
        click.Option(
            ["--plant"], is_flag=True, help="Three stations and a registry: shared keys, and a stolen station."
        ),
        click.Option(
            ["--line"], is_flag=True, help="Play a line: an order, an office that signs, proof of every board."
        ),
    )
    add_examples(command, "--page", "teds-provision demo --plant", "teds-provision demo --line")
    command.callback = demo


def _line(app: App) -> None:
    done = plant_room.demo.line.run_line(reporter_for(app), lambda text: app.note(f"\n{text}"))
    rows = [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps]
    words = ", ".join(f"{count} {word}" for word, count in sorted(done.evidence.items()))
    app.emit(
        {"steps": rows, "passed": done.passed, "evidence": done.evidence, "refused": list(done.refused)},
        f"\nDone: {done.passed} boards passed, refused: {', '.join(done.refused)}; evidence that holds: {words}.",
    )


def _plant(app: App) -> None:
    done = plant_room.demo.plant.run_plant_demo(reporter_for(app), lambda text: app.note(f"\n{text}"))
    steps = [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps]
    result = {"steps": steps, "by": done.by, "before": done.before, "after": done.after, "seconds": done.seconds}
    app.emit(
        result,
        f"\nDone in {done.seconds:.0f} s: the board was {done.before} at south; with what the stolen station signed, it"
        f" is {done.after}.\nYour own plant: docs/plant.md",
    )
