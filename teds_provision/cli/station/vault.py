"""``vault``, ``unlock``, ``lock``: a new passphrase or PIN, a new master key, and secrets held open for a while."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import click

from teds_provision.cli.context import App, pass_app, read_line
from teds_provision.cli.options import COMMAND_SETTINGS, command, dry_run_option, examples, yes_option
from teds_provision.cli.rendering import duration, local_time
from teds_provision.errors import UsageError
from teds_provision.sanitize import counted
from teds_provision.station.station import rewrap as rewrap_store
from teds_provision.vault import agent


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision vault passphrase", "teds-provision vault rewrap"),
)
def vault() -> None:
    """Manage this station's secrets: change the passphrase, or rewrap every node key under a new master key."""


@vault.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Change the passphrase or the token's PIN.",
    epilog=examples(
        "teds-provision vault passphrase",
        "teds-provision vault passphrase --new-passphrase-fd 4",
    ),
)
@click.option("--new-passphrase-fd", type=int, metavar="N", help="Read the new passphrase from this file descriptor.")
@dry_run_option
@pass_app
def passphrase(app: App, new_passphrase_fd: int | None, dry_run: bool) -> None:
    """Change the passphrase of the vault file, or the PIN of the token; the keys stay the same.

    Copies of the old file, and backups, still open with the old passphrase. If it has leaked, see the page "when
    something went wrong".
    """
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if dry_run:
        app.emit(
            {"keystore": kind, "rewrapped": 0, "plan": True}, f"Plan: change the passphrase of the {kind} keystore."
        )
        return
    station.use_agent = False  # a passer-by at an unlocked desk must not be able to change the passphrase
    opened = station.vault

    def ask(prompt: str, confirm: bool) -> str:
        new = confirm and new_passphrase_fd is not None
        return read_line(new_passphrase_fd or 0) if new else app.ask_new(prompt) if confirm else app.ask_secret(prompt)

    set_it = opened.new_passphrase(ask)  # before the lock: other processes do not wait while the user types
    with station.lock("vault passphrase", app.note):
        opened.refresh()
        agent.lock(app.home)  # the agent holds the old secret
        set_it()
        station.audit("vault", None, "new passphrase")
    app.emit(
        {"keystore": kind, "rewrapped": 0},
        f"{opened.description} now opens with the new passphrase. Existing copies and backups keep the old one.",
    )


@vault.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Rewrap every node key under a new master key.",
    epilog=examples("teds-provision vault rewrap"),
)
@yes_option
@dry_run_option
@pass_app
def rewrap(app: App, yes: bool, dry_run: bool) -> None:
    """Create a new master key, rewrap every node key under it, and delete the old one.

    Anyone with an old copy of the store and the old master key still has the node keys of that time; if that matters,
    rotate them (agree UUID --rotate). If interrupted, run the same command again to continue.
    """
    del yes  # not needed: the old master key is kept until every key was wrapped again
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if dry_run:
        count = sum(1 for _ in station.keys.all())
        app.emit(
            {"keystore": kind, "rewrapped": count, "plan": True},
            f"Plan: rewrap {counted(count, 'key')} under a new master key.",
        )
        return
    station.unlock()
    with station.lock("vault rewrap", app.note):
        done = rewrap_store(station)
    if done.damaged:
        app.warn(
            f"{counted(done.damaged, 'key')} in the store cannot be decrypted with any master key;"
            " run teds-provision doctor."
        )
    app.emit(
        {"keystore": kind, "rewrapped": done.keys, "damaged": done.damaged},
        f"Rewrapped {counted(done.keys, 'key')} under a new master key in the {kind} keystore.",
    )


@command("teds-provision unlock --for 15m")
@click.option(
    "--for", "span", default="15m", show_default=True, metavar="TIME", help="How long: 90s, 15m, 2h (at most 12h)."
)
@pass_app
def unlock(app: App, span: str) -> None:
    """Ask for the passphrase or PIN once, and keep the vault unlocked in memory for the given time.

    Until then, this user's commands in this home open the vault without asking; "lock" ends it at once. Changing the
    passphrase and exporting the CA key still ask. A keyring does not need this: it is open while you are logged in.
    """
    seconds = duration(span)
    if not 1 <= seconds <= agent.MOST_SECONDS:
        raise UsageError(f"The vault can stay unlocked for 1 s to {agent.MOST_SECONDS // 3600} h, not {span}.")
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if kind not in agent.KINDS:
        text = f"Nothing to do: this station's keys are in the {kind}, which handles unlocking itself."
        app.emit({"unlocked": False, "until": None, "keystore": kind}, text)
        return
    station.use_agent = False
    said = ""

    def ask(prompt: str, confirm: bool) -> str:
        nonlocal said
        said = app.ask_secret(prompt, confirm)
        return said

    station.ask_by(ask)
    opened = station.vault
    opener = opened.opener() or said.encode()
    if not opener:
        raise UsageError("The token has its own PIN pad, so there is nothing to keep in memory.")
    with station.lock("unlock", app.note):
        opened.refresh()  # notices a changed passphrase or PIN, so that no old one is held and no PIN try is lost
        agent.start(app.home, kind, opener, int(seconds))
        station.audit("vault", None, "unlocked", seconds=int(seconds))
    until = (datetime.now(UTC) + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%SZ")
    text = f"The vault is unlocked until {local_time(until)}, for this user only. To lock it: teds-provision lock"
    app.emit({"unlocked": True, "until": until, "keystore": kind}, text)


@command("teds-provision lock")
@pass_app
def lock(app: App) -> None:
    """Close the vault that "unlock" holds open: the secret is wiped, and the next command asks again."""
    was = agent.lock(app.home)
    if was:
        app.station().audit("vault", None, "locked")
    app.emit({"locked": True, "was_open": was}, "The vault is closed." if was else "Nothing to do: it was not open.")
