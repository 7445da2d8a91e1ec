"""``ncap run``: what the plant adds: --registry, to stay in sync."""

from __future__ import annotations

from typing import Any

import click

from teds_provision.cli.extending import add_options, callback_of


def extend(command: click.Command) -> None:
    """Add --registry to ``ncap run``."""
    assert isinstance(command, click.Group)
    run = command.commands["run"]
    core = callback_of(run)

    def with_registry(*, registry: bool, **rest: Any) -> None:
        core(parts=frozenset({"registry"} if registry else ()), **rest)

    says = "Stay in sync with the registry that this station joined."
    add_options(run, "--trust-dcc", click.Option(["--registry"], is_flag=True, help=says))
    run.callback = with_registry
