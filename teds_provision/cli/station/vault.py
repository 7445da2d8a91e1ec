"""``vault``: where this station's secrets lie: a new passphrase or PIN, a new master key."""

from __future__ import annotations

import click

from teds_provision import station as station_room
from teds_provision.cli.context import App, pass_app, read_line
from teds_provision.cli.options import COMMAND_SETTINGS, dry_run_option, examples, yes_option
from teds_provision.vault.agent import asking


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision vault passphrase", "teds-provision vault rewrap"),
)
def vault() -> None:
    """Where this station's secrets lie: give it a new passphrase, or wrap every node key under a new master key."""


@vault.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Set a new passphrase, or PIN of the token.",
    epilog=examples(
        "teds-provision vault passphrase",
        "teds-provision vault passphrase --new-passphrase-fd 4",
    ),
)
@click.option("--new-passphrase-fd", type=int, metavar="N", help="Read the new passphrase from this file descriptor.")
@dry_run_option
@pass_app
def passphrase(app: App, new_passphrase_fd: int | None, dry_run: bool) -> None:
    """Give the passphrase file a new passphrase, or the token a new PIN; the keys stay the same.

    Copies of the old file, and backups, still open with the old passphrase. Where that has leaked, see the page "when
    something went wrong".
    """
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if dry_run:
        app.emit({"keystore": kind, "rewrapped": 0, "plan": True}, f"Plan: a new passphrase for the {kind} keystore.")
        return
    station.use_agent = False  # who walks up to an unlocked desk shall not lock its owner out
    opened = station.vault

    def ask(prompt: str, confirm: bool) -> str:
        new = confirm and new_passphrase_fd is not None
        return read_line(new_passphrase_fd or 0) if new else app.ask_new(prompt) if confirm else app.ask_secret(prompt)

    set_it = opened.new_passphrase(ask)  # nobody else waits for the store while a person types
    with station.lock("vault passphrase", app.note):
        opened.refresh()
        asking.lock(app.home)  # what is held open is of the old one
        set_it()
        station.audit("vault", None, "new passphrase")
    app.emit(
        {"keystore": kind, "rewrapped": 0},
        f"{opened.description} opens with the new passphrase. Copies and backups made before open with the old one.",
    )


@vault.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Make a new master key and wrap every node key anew.",
    epilog=examples("teds-provision vault rewrap"),
)
@yes_option
@dry_run_option
@pass_app
def rewrap(app: App, yes: bool, dry_run: bool) -> None:
    """Make a new master key, wrap every node key under it, and forget the old one.

    Who has an old copy of the store and the old master key still has the node keys of that day: agree anew with the
    nodes (agree UUID --rotate) where that matters. A run that was cut is carried on by the same command.
    """
    del yes  # nothing here is lost: the old master key goes when nothing needs it any more
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if dry_run:
        count = sum(1 for _ in station.keys.all())
        app.emit(
            {"keystore": kind, "rewrapped": count, "plan": True}, f"Plan: wrap {count} keys under a new master key."
        )
        return
    station.unlock()
    with station.lock("vault rewrap", app.note):
        done = station_room.rewrap.rewrap(station)
    if done.damaged:
        app.warn(f"{done.damaged} keys in the store open under no master key; run teds-provision doctor.")
    app.emit(
        {"keystore": kind, "rewrapped": done.keys, "damaged": done.damaged},
        f"{done.keys} keys are wrapped under a new master key in the {kind} keystore.",
    )
