"""``init``: this base station's keys."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision import handover, protocol
from teds_provision import station as station_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, command, yes_option
from teds_provision.errors import TedsProvisionError, UsageFailure
from teds_provision.files import read_limited, require_new, write_new
from teds_provision.vault.agent import asking

if TYPE_CHECKING:
    from teds_provision.station.station import Station

_FILE = click.Path(path_type=Path, dir_okay=False)


@command(
    "teds-provision init --name bench",
    "teds-provision init --keystore file",
    "teds-provision init --name lab --request lab.request",
    "teds-provision init --certificate lab.cert",
)
@click.option("--name", help="The station's name, shown in every datasheet that it signs.")
@click.option(
    "--keystore", metavar="keyring|file|pkcs11:URI", help="Where the keys lie (default: the keyring if one works)."
)
@click.option("--request", type=_FILE, metavar="FILE", help="Make no CA key; ask for another's signature in FILE.")
@click.option(
    "--certificate", type=FileToRead(), metavar="CERT", help='Take in what "trust ca sign" gave for that request.'
)
@yes_option
@pass_app
def init(
    app: App, name: str | None, keystore: str | None, request: Path | None, certificate: Path | None, yes: bool
) -> None:
    """Make this base station's identity and its CA key; a second run shows them.

    The keys lie in the OS keyring, in a PKCS #11 token, or sealed under a passphrase. Stations of one owner share one
    CA: --request here, "trust ca sign" where the CA key is, --certificate here.
    """
    if request is not None and certificate is not None:
        raise click.UsageError("--request comes first, --certificate when the CA has signed it.")
    if request is not None:
        _request(app, name, keystore, request)
        return
    if certificate is not None:
        _adopt(app, certificate, yes)
        why = "this station was certified"
        station = app.station()
    else:
        station, why = station_room.station.initialise(
            app.home, name=name, keystore=keystore, ask=app.ask_secret, tell=app.note
        )
        app.closing(station.close)
        _require_same(station, name, keystore)
    ca = protocol.keys.fingerprint(station.ca)
    app.emit(
        {
            "name": station.name,
            "public_key": protocol.keys.to_pem(station.point),
            "fingerprint": station.fingerprint,
            "ca": {"public_key": protocol.keys.to_pem(station.ca), "fingerprint": ca},
            "keystore": station.identity.keystore,
            "why": why,
        },
        f"Station  {station.name}\n  key      {station.fingerprint[:16]}\n  CA key   {ca[:16]}\n"
        f"  keystore {station.identity.keystore} ({why}){_open_for(app)}\n  home     {app.home}\n\n"
        f"{protocol.keys.to_pem(station.point)}",
    )


def _open_for(app: App) -> str:
    left = asking.seconds_left(app.home)
    return "" if left is None else f", held open for {left // 60 + 1} min more (teds-provision lock)"


def _require_same(station: Station, name: str | None, keystore: str | None) -> None:
    """Raise UsageFailure where there is a station already, and the command line asks for another one."""
    for what, asked, has in (("name", name, station.name), ("keystore", keystore, station.identity.keystore)):
        if asked is not None and asked != has:
            raise UsageFailure(
                f"There is a station in {station.home} already, its {what} is {has!r}: nothing was changed.",
                hint=f"Leave --{what} out to see it, or choose another --home.",
            )


def _request(app: App, name: str | None, keystore: str | None, path: Path) -> None:
    if not path.exists():
        require_new(path)
    octets = handover.trust.ask_for_certificate(app.home, name=name, keystore=keystore, ask=app.ask_secret)
    asked = handover.trust.read_request(octets)
    fresh = not _is_request_of(path, asked.station)
    if fresh:
        write_new(path, octets)
    digits = protocol.keys.fingerprint(asked.station)
    told = {
        "name": asked.name,
        "public_key": protocol.keys.to_pem(asked.station),
        "fingerprint": digits,
        "request": str(path),
    }
    app.emit(
        {**told, "ca": None},
        f"Station {asked.name} asks for a certificate in {path}.\n"
        f"For comparison by voice:\n  {handover.trust.spoken(digits)}\n"
        f"Where the CA key is: teds-provision trust ca sign {path.name} --output {path.stem}.cert",
    )


def _is_request_of(path: Path, point: bytes) -> bool:
    """Whether the file is a request of this very station already (a token signs it differently each time)."""
    try:
        if not path.exists():
            return False
        return handover.trust.read_request(read_limited(path, handover.trust.MAX_OCTETS, "request")).station == point
    except TedsProvisionError:
        return False


def _adopt(app: App, path: Path, yes: bool) -> None:
    certificate = handover.trust.read_certificate(read_limited(path, handover.trust.MAX_OCTETS, "certificate"))
    digits = protocol.keys.fingerprint(certificate.ca)
    app.note(f"The CA of this certificate, for comparison by voice:\n  {handover.trust.spoken(digits)}")
    app.confirm("Trust this CA as the owner of this station's nodes?", yes=yes)
    handover.trust.adopt_certificate(app.home, certificate, ask=app.ask_secret).close()
