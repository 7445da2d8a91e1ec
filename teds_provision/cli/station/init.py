"""``init``: this base station's keys."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, command, yes_option
from teds_provision.errors import TedsProvisionError, UsageError
from teds_provision.files import read_limited, require_new, write_new
from teds_provision.lazy import late
from teds_provision.protocol.keys import fingerprint, to_pem
from teds_provision.station.station import Station, initialise
from teds_provision.vault import agent

if TYPE_CHECKING:
    from teds_provision.handover import trust
else:  # bundles and receipts: only for the CA of another station
    trust = late("teds_provision.handover.trust")

_FILE = click.Path(path_type=Path, dir_okay=False)


@command(
    "teds-provision init --name bench",
    "teds-provision init --keystore file",
    "teds-provision init --name lab --request lab.request",
    "teds-provision init --certificate lab.cert",
    "teds-provision --home new init --ca owner-ca.pem",
)
@click.option("--name", help="Station name, shown in every datasheet it signs.")
@click.option(
    "--keystore",
    metavar="keyring|file|pkcs11:URI",
    help="Where to keep the keys (default: the OS keyring if available).",
)
@click.option(
    "--request", type=_FILE, metavar="FILE", help="Create no CA key; write a request for another station's CA to FILE."
)
@click.option(
    "--certificate", type=FileToRead(), metavar="CERT", help='Install the certificate that "trust ca sign" issued.'
)
@click.option(
    "--ca",
    "ca_file",
    type=FileToRead(),
    metavar="FILE",
    help='Use the owner\'s CA key from this file of "trust ca export" instead of creating one.',
)
@yes_option
@pass_app
def init(
    app: App,
    name: str | None,
    keystore: str | None,
    request: Path | None,
    certificate: Path | None,
    ca_file: Path | None,
    yes: bool,
) -> None:
    """Create this base station's identity and CA key; a second run shows them.

    The keys are kept in the OS keyring, in a PKCS #11 token, or encrypted with a passphrase. Stations of one owner
    share one CA: --request here, "trust ca sign" on the station with the CA key, --certificate here. If no station with
    that CA is left but its exported file is, use --ca.
    """
    if ca_file is not None and (request is not None or certificate is not None):
        raise click.UsageError("Use --ca alone: the key in its file certifies this station at once.")
    if request is not None and certificate is not None:
        raise click.UsageError("Use --request first, then --certificate once the CA has signed it.")
    if request is not None:
        _request(app, name, keystore, request)
        return
    if certificate is not None:
        _adopt(app, certificate, yes)
        why = "this station was certified"
        station = app.station()
    elif ca_file is not None:
        passphrase = app.ask_secret("Passphrase of the CA key's file")
        trust.found_under(app.home, ca_file, passphrase, name=name, keystore=keystore, ask=app.ask_secret)
        why = f"with the CA key of {ca_file}"
        station = app.station()
    else:
        station, why = initialise(app.home, name=name, keystore=keystore, ask=app.ask_secret, notify=app.note)
        app.closing(station.close)
        _require_same(station, name, keystore)
    ca = fingerprint(station.ca)
    app.emit(
        {
            "name": station.name,
            "public_key": to_pem(station.point),
            "fingerprint": station.fingerprint,
            "ca": {"public_key": to_pem(station.ca), "fingerprint": ca},
            "keystore": station.identity.keystore,
            "why": why,
        },
        f"Station  {station.name}\n  key      {station.fingerprint[:16]}\n  CA key   {ca[:16]}\n"
        f"  keystore {station.identity.keystore} ({why}){_open_for(app)}\n  home     {app.home}\n\n"
        f"{to_pem(station.point)}",
    )


def _open_for(app: App) -> str:
    left = agent.seconds_left(app.home)
    return "" if left is None else f", unlocked for {left // 60 + 1} more min (to lock it: teds-provision lock)"


def _require_same(station: Station, name: str | None, keystore: str | None) -> None:
    """Raise UsageError if a station exists, and the command line differs from it."""
    for what, asked, has in (("name", name, station.name), ("keystore", keystore, station.identity.keystore)):
        if asked is not None and asked != has:
            raise UsageError(
                f"{station.home} already holds a station whose {what} is {has!r}. Nothing was changed.",
                hint=f"Omit --{what} to show it, or choose another --home.",
            )


def _request(app: App, name: str | None, keystore: str | None, path: Path) -> None:
    if not path.exists():
        require_new(path)
    octets = trust.ask_for_certificate(app.home, name=name, keystore=keystore, ask=app.ask_secret)
    asked = trust.read_request(octets)
    fresh = not _is_request_of(path, asked.station)
    if fresh:
        write_new(path, octets)
    digits = fingerprint(asked.station)
    result = {
        "name": asked.name,
        "public_key": to_pem(asked.station),
        "fingerprint": digits,
        "request": str(path),
    }
    app.emit(
        {**result, "ca": None},
        f"Certificate request of station {asked.name}: {path}.\n"
        f"Compare by voice:\n  {trust.spoken(digits)}\n"
        f"On the station with the CA key: teds-provision trust ca sign {quote(path.name)}"
        f" --output {quote(path.stem + '.cert')}",
    )


def _is_request_of(path: Path, point: bytes) -> bool:
    """Return True if the file is a request of this very station already (a token signs it differently each time)."""
    try:
        if not path.exists():
            return False
        return trust.read_request(read_limited(path, trust.MAX_OCTETS, "request")).station == point
    except TedsProvisionError:
        return False


def _adopt(app: App, path: Path, yes: bool) -> None:
    certificate = trust.read_certificate(read_limited(path, trust.MAX_OCTETS, "certificate"))
    digits = fingerprint(certificate.ca)
    app.note(f"The CA that issued this certificate; compare by voice:\n  {trust.spoken(digits)}")
    app.confirm("Trust this CA as the owner of this station's nodes?", yes=yes)
    trust.adopt_certificate(app.home, certificate, ask=app.ask_secret).close()
