"""``init``: this base station's keys."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, command, dry_run_option, yes_option
from teds_provision.errors import TedsProvisionError, UsageError
from teds_provision.files import read_limited, require_new, write_new
from teds_provision.lazy import late
from teds_provision.protocol.keys import fingerprint, to_pem
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.sqlite import has_store
from teds_provision.vault import agent, selection

if TYPE_CHECKING:
    from teds_provision.handover import trust
    from teds_provision.handover.trust import Certificate
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
@dry_run_option
@pass_app
def init(
    app: App,
    name: str | None,
    keystore: str | None,
    request: Path | None,
    certificate: Path | None,
    ca_file: Path | None,
    yes: bool,
    dry_run: bool,
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
    if dry_run:
        _plan(app, name, keystore, request=request, certificate=certificate, ca_file=ca_file)
        return
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
        _to_json(station, why),
        f"Station  {station.name}\n  key      {station.fingerprint[:16]}\n  CA key   {ca[:16]}\n"
        f"  keystore {station.identity.keystore} ({why}){_open_for(app)}\n  home     {app.home}\n\n"
        f"{to_pem(station.point)}",
    )


def _to_json(station: Station, why: str) -> dict[str, Any]:
    return {
        "name": station.name,
        "public_key": to_pem(station.point),
        "fingerprint": station.fingerprint,
        "ca": {"public_key": to_pem(station.ca), "fingerprint": fingerprint(station.ca)},
        "keystore": station.identity.keystore,
        "why": why,
    }


def _plan(
    app: App,
    name: str | None,
    keystore: str | None,
    *,
    request: Path | None,
    certificate: Path | None,
    ca_file: Path | None,
) -> None:
    """Print what init would do, without a key, a passphrase or a folder."""
    if has_store(app.home):
        station = app.inspected()
        if station.identity.is_complete() and request is None and certificate is None and ca_file is None:
            _require_same(station, name, keystore)
            why = station.identity.keystore_why
            app.emit(_to_json(station, why) | {"plan": True}, f"Nothing to do: station {station.name} exists.")
            return
    result: dict[str, Any] = {"plan": True, "name": name, "home": str(app.home)}
    if certificate is not None:
        ca = _read_certificate(certificate).ca
        text = f"trust the CA {fingerprint(ca)[:32]}, which issued {certificate}"
        app.emit(result | {"ca": {"public_key": to_pem(ca), "fingerprint": fingerprint(ca)}}, f"Plan: {text}.")
        return
    kind, why = selection.plan_vault(app.home, keystore)
    if request is not None:
        if not request.exists():
            require_new(request)
        what = f"create the station's key, and write a certificate request to {request}"
    elif ca_file is not None:
        what = f"create the station's key, certified by the CA key of {ca_file}"
    else:
        what = "create the station's key and a CA key"
    text = f"Plan: {what}, in the {kind.partition(':')[0]} keystore ({why}), home {app.home}."
    app.emit(result | {"keystore": kind, "why": why}, text)


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


def _read_certificate(path: Path) -> Certificate:
    return trust.read_certificate(read_limited(path, trust.MAX_OCTETS, "certificate"))


def _adopt(app: App, path: Path, yes: bool) -> None:
    certificate = _read_certificate(path)
    digits = fingerprint(certificate.ca)
    app.note(f"The CA that issued this certificate; compare by voice:\n  {trust.spoken(digits)}")
    app.confirm("Trust this CA as the owner of this station's nodes?", yes=yes)
    trust.adopt_certificate(app.home, certificate, ask=app.ask_secret).close()
