"""``ncap token``: who else may call the API."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, command, examples
from teds_provision.lazy import late
from teds_provision.store.records import iso

if TYPE_CHECKING:
    from teds_provision.ncap.web import tokens
else:
    tokens = late("teds_provision.ncap.web.tokens")


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision ncap token add plotter --read-only", "teds-provision ncap token list"),
)
def token() -> None:
    """Tokens for scripts: add, list, remove. Only their digests are kept."""


@command("teds-provision ncap token add plotter --read-only", name="add")
@click.argument("name")
@click.option("--read-only", is_flag=True, help="It may read and change nothing.")
@pass_app
def add(app: App, name: str, *, read_only: bool) -> None:
    """Make a token and print it, once.

    Send it as `Authorization: Bearer TOKEN`.
    """
    app.station()
    made = tokens.Tokens(app.home).add(name, read_only=read_only)
    app.emit({"name": name, "token": made, "read_only": read_only}, made)


@command("teds-provision ncap token list", name="list")
@pass_app
def list_tokens(app: App) -> None:
    """List every token that is good now, those of browsers too."""
    app.station()
    found = [
        {
            "name": one.name,
            "kind": one.kind,
            "read_only": one.read_only,
            "created": iso(datetime.fromtimestamp(one.created, UTC)),
            "until": iso(datetime.fromtimestamp(one.until, UTC)) if one.until else None,
        }
        for one in tokens.Tokens(app.home).all()
    ]
    lines = [f"{one['name']}  {one['kind']}{'  read-only' if one['read_only'] else ''}" for one in found]
    app.emit({"tokens": found}, "\n".join(lines) or "There is no token. Make one: teds-provision ncap token add NAME")


@command("teds-provision ncap token remove plotter", name="remove")
@click.argument("name")
@pass_app
def remove(app: App, name: str) -> None:
    """Take a token away.

    Who uses it is refused from now on; the name `browser` logs every browser out.
    """
    app.station()
    gone = tokens.Tokens(app.home).remove(name)
    app.emit({"removed": name, "count": gone}, f"Removed: {name}.")


for one in (add, list_tokens, remove):
    token.add_command(one)
