"""One CA for several stations: a station asks, the CA's keeper signs (profile.md, "Keys and trust").

Two small JSON files travel, neither secret. The *request*: name, public key, and the station's own signature over
``"TEDS1 station request" ‖ 00 ‖ P(station) ‖ name``, so that nobody asks in another's name. The *certificate*: the
CA's key and SIG104 over the station's. Both formats are this tool's, the profile knows only SIG104.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision import vault as vaults
from teds_provision.errors import BadData, NotAuthentic, NotFound, PolicyRefused
from teds_provision.protocol.handover.jwk import point_of, public_jwk
from teds_provision.protocol.handover.strict_json import decode_base64url, dump, encode_base64url, load_object
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, fingerprint, station_key_message, verify
from teds_provision.station.station import Station
from teds_provision.store import Store, StoreLock
from teds_provision.store.home import has_store

if TYPE_CHECKING:
    from teds_provision.vault import Ask, Vault

REQUEST_FORMAT = "teds-station-request/1"
CERTIFICATE_FORMAT = "teds-station-certificate/1"
MAX_OCTETS = 16384
_LABEL = b"TEDS1 station request\0"


@dataclass(frozen=True)
class Request:
    """A station that wants to be certified: its name and point; it has proved that it holds the key."""

    name: str
    station: bytes


@dataclass(frozen=True)
class Certificate:
    """SIG104 (64 octets) of ``ca`` over ``station``, both points; verified."""

    name: str
    station: bytes
    ca: bytes
    signature: bytes


def make_request(name: str, key: PrivateKey) -> bytes:
    """Return the request of a station, as the octets of a file."""
    proof = key.sign(_LABEL + key.point + name.encode())
    members = {"format": REQUEST_FORMAT, "name": name, "station": public_jwk(key.point)}
    return dump(members | {"proof": encode_base64url(proof)}) + b"\n"


def read_request(octets: bytes) -> Request:
    """Read and check a request; raises BadData, NotAuthentic (the proof does not verify)."""
    if b"PRIVATE KEY" in octets:
        raise BadData("This file holds a private key where a request belongs.")
    members = load_object(octets, "The request")
    if members.get("format") != REQUEST_FORMAT:
        raise BadData(f"This is not a station's request ({REQUEST_FORMAT}).", hint="Make one: init --request FILE")
    name = _name(members.get("name"))
    station = point_of(members.get("station"), "The station's key")
    if not verify(station, _LABEL + station + name.encode(), decode_base64url(members.get("proof"), "The proof")):
        raise NotAuthentic("The request is not signed by the key that it names.")
    return Request(name, station)


def write_certificate(certificate: Certificate) -> bytes:
    """Return a certificate as the octets of a file."""
    members = {
        "format": CERTIFICATE_FORMAT,
        "name": certificate.name,
        "station": public_jwk(certificate.station),
        "ca": public_jwk(certificate.ca),
        "signature": encode_base64url(certificate.signature),
    }
    return dump(members) + b"\n"


def read_certificate(octets: bytes) -> Certificate:
    """Read and check a certificate; raises BadData, NotAuthentic (the CA's signature does not verify)."""
    members = load_object(octets, "The certificate")
    if members.get("format") != CERTIFICATE_FORMAT:
        raise BadData(f"This is not a station's certificate ({CERTIFICATE_FORMAT}).", hint="See: trust ca sign")
    station, ca = point_of(members.get("station"), "The station's key"), point_of(members.get("ca"), "The CA's key")
    signature = decode_base64url(members.get("signature"), "The signature")
    if not verify(ca, station_key_message(station), signature):
        raise NotAuthentic("The certificate's signature does not verify under the CA key that it names.")
    return Certificate(_name(members.get("name")), station, ca, signature)


def sign_request(station: Station, request: Request) -> Certificate:
    """Certify a station under this owner's CA, and remember that; raises NotFound where the CA key is not here."""
    if request.station == station.ca:
        raise PolicyRefused("The request names the CA's own key as a station.")
    known = station.identity.certificate(station.ca, request.station)
    signature = known or station.identity.certify(request.station)
    if known is None:
        with station.transaction():
            station.identity.keep_certificate(station.ca, request.station, signature)
            station.audit("certify", None, "done", name=request.name, key=fingerprint(request.station))
    return Certificate(request.name, request.station, station.ca, signature)


def ask_for_certificate(home: Path, *, name: str | None, keystore: str | None, ask: Ask) -> bytes:
    """Make a station key without a CA key, or take the one that is there, and return its request.

    A station that is complete asks with the key that it has. Run again it gives a request for the same key.
    """
    with Store.open(home, create=True) as store:
        return vaults.asked_first(ask, lambda known: _requested(Station(store, known), name, keystore, known))


def _requested(station: Station, name: str | None, keystore: str | None, ask: Ask) -> bytes:
    with StoreLock(station.home, command="init"):
        if station.identity.is_complete():
            return make_request(station.name, station.vault.identity())
        if station.identity.requested is None:
            vault, why = vaults.create_vault(station.home, station.id, keystore, ask, with_ca=False)
            where = keystore if keystore and keystore.startswith("pkcs11:") else vault.kind
            station.adopt(vault)
            with station.transaction():
                station.identity.found(name, where, why, requested=vault.identity().point)
                station.audit("init", None, "requested", fingerprint=fingerprint(vault.identity().point))
        else:
            vault = station.vault
        return make_request(station.name, vault.identity())


def adopt_certificate(home: Path, certificate: Certificate, *, ask: Ask) -> Station:
    """Complete a station that asked for a certificate; one that has it already is opened as it is.

    Raises NotFound (no station asked here), PolicyRefused (a certificate for another key, or another CA already).
    """
    if not has_store(home):
        raise NotFound("No station has asked for a certificate here.", hint="First: init --request FILE")
    station = Station(Store.open(home), ask)

    def adopt(known: Ask) -> None:
        station.ask_by(known)
        with StoreLock(home, command="init"):
            _adopt(station, certificate)

    try:
        vaults.asked_first(ask, adopt)
        station.ask_by(ask)
    except BaseException:
        station.close()
        raise
    return station


def _adopt(station: Station, certificate: Certificate) -> None:
    identity = station.identity
    own = identity.point if identity.is_complete() else identity.requested
    if own is None:
        raise NotFound("No station has asked for a certificate here.", hint="First: init --request FILE")
    if certificate.station != own:
        raise PolicyRefused(
            f"The certificate is for station {fingerprint(certificate.station)[:16]},"
            f" this one is {fingerprint(own)[:16]}."
        )
    fresh = not identity.is_complete()
    if not fresh and identity.certificate(certificate.ca, station.point) is not None:
        return
    with station.transaction():
        if fresh:
            identity.complete(own, certificate.ca, certificate.signature)
        else:  # a station with a CA of its own: certified by another one too, for the nodes of that one
            identity.keep_certificate(certificate.ca, station.point, certificate.signature)
        station.audit("init", None, "certified", ca=fingerprint(certificate.ca), own=fresh)


def _name(value: object) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= 100:
        raise BadData("A station's name is printable text of at most 100 characters.")
    return value


# -- the CA key itself ------------------------------------------------------------------------------------------------


def require_ca(station: Station) -> PrivateKey:
    """Return the CA key; raises PolicyRefused where this station's CA is kept elsewhere."""
    ca = station.vault.ca()
    if ca is None or ca.point != station.ca:
        raise PolicyRefused(
            f"The key of this station's CA {fingerprint(station.ca)[:16]} is not in this vault.",
            hint="Bring it: trust ca import FILE. A CA of its own has a station made by init in another --home.",
        )
    return ca


def export_ca(station: Station, vault: Vault, path: Path, passphrase: str) -> None:
    """Write the CA key to a new file under a passphrase; raises PolicyRefused, VaultFailure (token, file)."""
    require_ca(station)
    vault.export_ca(path, passphrase)
    station.audit("ca", None, "exported", ca=fingerprint(station.ca))


def drop_ca(station: Station) -> bool:
    """Delete the CA key from the vault; False if it is not there."""
    dropped = station.vault.drop_ca()
    if dropped:
        station.audit("ca", None, "dropped", ca=fingerprint(station.ca))
    return dropped


def import_ca(station: Station, vault: Vault, path: Path, passphrase: str) -> None:
    """Bring the CA key back; raises WrongPassphrase, NotFound, VaultFailure, PolicyRefused (another CA's key)."""
    if SoftwareKey.from_secret(vaults.ca_file.read_ca(path, passphrase)).point != station.ca:
        raise PolicyRefused(f"{path} holds another CA key than that of this station ({fingerprint(station.ca)[:16]}).")
    vault.import_ca(path, passphrase)
    station.audit("ca", None, "imported", ca=fingerprint(station.ca))
