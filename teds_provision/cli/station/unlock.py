"""``unlock`` and ``lock``: the vault held open in memory for a while, so that fifty commands ask once."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.rendering import duration, local_time
from teds_provision.errors import UsageFailure
from teds_provision.vault.agent import asking


@command("teds-provision unlock --for 15m")
@click.option(
    "--for", "span", default="15m", show_default=True, metavar="TIME", help="How long: 90s, 15m, 2h (to 12h)."
)
@pass_app
def unlock(app: App, span: str) -> None:
    """Ask for the passphrase (or PIN) once, and hold what opens the vault in memory until the time is over.

    Every command of this user in this home opens the vault then without asking. "lock" ends it at once. A new
    passphrase and the export of the CA key ask all the same. A keyring needs none of this: it is open while the desktop
    is.
    """
    seconds = duration(span)
    if not 1 <= seconds <= asking.MOST_SECONDS:
        raise UsageFailure(f"The vault is held open for 1 s to {asking.MOST_SECONDS // 3600} h, not for {span}.")
    station = app.station()
    kind = station.identity.keystore.partition(":")[0]
    if kind not in asking.KINDS:
        text = f"Nothing to do: the keys of this station lie in the {kind}, which asks for itself."
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
        raise UsageFailure("The token has a PIN pad of its own: there is nothing that could be held.")
    with station.lock("unlock", app.note):
        opened.refresh()  # an old passphrase is not held, and an old PIN costs no try
        asking.start(app.home, kind, opener, int(seconds))
        station.audit("vault", None, "unlocked", seconds=int(seconds))
    until = (datetime.now(UTC) + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%SZ")
    text = f"The vault is open until {local_time(until)}, for this user alone. Close it: teds-provision lock"
    app.emit({"unlocked": True, "until": until, "keystore": kind}, text)


@command("teds-provision lock")
@pass_app
def lock(app: App) -> None:
    """Close the vault that "unlock" holds open: the secret is wiped, and the next command asks again."""
    was = asking.lock(app.home)
    if was:
        app.station().audit("vault", None, "locked")
    app.emit({"locked": True, "was_open": was}, "The vault is closed." if was else "Nothing to do: it was not open.")
