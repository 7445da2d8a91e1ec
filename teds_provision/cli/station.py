"""``init``: this base station's keys."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command


@command("teds-provision init --name bench", "teds-provision init --keystore file")
@click.option("--name", help="The station's name, shown in every datasheet that it signs.")
@click.option(
    "--keystore", metavar="keyring|file|pkcs11:URI", help="Where the keys lie (default: the keyring if one works)."
)
@pass_app
def init(app: App, name: str | None, keystore: str | None) -> None:
    """Make this base station's identity and its CA key; a second run shows them.

    The keys lie in the OS keyring, in a PKCS #11 token, or sealed under a passphrase.
    """
    from teds_provision.protocol.keys import fingerprint, to_pem
    from teds_provision.workflow.station import initialise

    station, why = initialise(app.home, name=name, keystore=keystore, ask=app.ask_secret)
    app.closing(station.close)
    ca = fingerprint(station.ca)
    app.emit(
        {
            "name": station.name,
            "public_key": to_pem(station.point),
            "fingerprint": station.fingerprint,
            "ca": {"public_key": to_pem(station.ca), "fingerprint": ca},
            "keystore": station.keystore,
            "why": why,
        },
        f"Station  {station.name}\n  key      {station.fingerprint[:16]}\n  CA key   {ca[:16]}\n"
        f"  keystore {station.keystore} ({why})\n  home     {app.home}\n\n{to_pem(station.point)}",
    )
