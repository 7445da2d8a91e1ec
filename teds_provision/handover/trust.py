"""Trusted keys: of stations and CAs, added after comparing the fingerprint (profile.md, "Keys and trust")."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from teds_provision.errors import (
    BadDataError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.files import read_limited
from teds_provision.handover.pending import OPEN, BundleNotes, signer_of
from teds_provision.protocol.handover.jose import point_of, public_jwk
from teds_provision.protocol.handover.strict_json import decode_base64url, dump, encode_base64url, load_object
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, fingerprint, from_pem, station_key_message, verify
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter
from teds_provision.station.store.lock import StoreLock
from teds_provision.station.store.records import TrustRecord, TrustRole
from teds_provision.station.store.sqlite import has_store
from teds_provision.vault.base import Ask, Vault
from teds_provision.vault.ca_file import read_ca
from teds_provision.vault.selection import asked_first, create_vault

# One CA for several stations: a station requests a certificate, and the CA's holder signs it.
# See profile.md, "Keys and trust".
#
# Two small JSON files are exchanged; neither is secret. The *request*: name, public key, and the station's own
# signature over ``"TEDS1 station request" ‖ 00 ‖ P(station) ‖ name``, so that a station cannot request a certificate in
# another's name. The *certificate*: the CA's key and SIG104 over the station's. Both formats are this tool's own; the
# profile defines only SIG104.

REQUEST_FORMAT = "teds-station-request/1"
CERTIFICATE_FORMAT = "teds-station-certificate/1"
MAX_OCTETS = 16384
_LABEL = b"TEDS1 station request\0"


@dataclass(frozen=True)
class CertificateRequest:
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


def read_request(octets: bytes) -> CertificateRequest:
    """Read and check a request; raises BadDataError, NotAuthenticError (the proof does not verify)."""
    if b"PRIVATE KEY" in octets:
        raise BadDataError("This file contains a private key, not a request.")
    members = load_object(octets, "The request")
    if members.get("format") != REQUEST_FORMAT:
        raise BadDataError(
            f"This is not a station's request ({REQUEST_FORMAT}).", hint="To create one: init --request FILE"
        )
    name = _name(members.get("name"))
    station = point_of(members.get("station"), "The station's key")
    if not verify(station, _LABEL + station + name.encode(), decode_base64url(members.get("proof"), "The proof")):
        raise NotAuthenticError("The request is not signed by the key that it names.")
    return CertificateRequest(name, station)


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
    """Read and check a certificate; raises BadDataError, NotAuthenticError (the CA's signature does not verify)."""
    members = load_object(octets, "The certificate")
    if members.get("format") != CERTIFICATE_FORMAT:
        raise BadDataError(f"This is not a station's certificate ({CERTIFICATE_FORMAT}).", hint="See: trust ca sign")
    station, ca = point_of(members.get("station"), "The station's key"), point_of(members.get("ca"), "The CA's key")
    signature = decode_base64url(members.get("signature"), "The signature")
    if not verify(ca, station_key_message(station), signature):
        raise NotAuthenticError("The certificate's signature does not verify under the CA key that it names.")
    return Certificate(_name(members.get("name")), station, ca, signature)


def sign_request(station: Station, request: CertificateRequest) -> Certificate:
    """Certify a station under this owner's CA, and record that; raises NotFoundError if the CA key is not here."""
    if request.station == station.ca:
        raise PolicyError("The request names the CA's own key as a station.")
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
    with Station.make(home, ask=ask) as station:

        def request(known: Ask) -> bytes:
            station.ask_by(known)
            return _requested(station, name, keystore, known)

        return asked_first(ask, request)


def _requested(station: Station, name: str | None, keystore: str | None, ask: Ask) -> bytes:
    with StoreLock(station.home, command="init"):
        if station.identity.is_complete():
            return make_request(station.name, station.vault.identity())
        if station.identity.requested is None:
            vault, why = create_vault(station.home, station.id, keystore, ask, with_ca=False)
            where = keystore if keystore and keystore.startswith("pkcs11:") else vault.kind
            station.adopt(vault)
            with station.transaction():
                station.identity.establish(name, where, why, requested=vault.identity().point)
                station.audit("init", None, "requested", fingerprint=fingerprint(vault.identity().point))
        else:
            vault = station.vault
        return make_request(station.name, vault.identity())


def adopt_certificate(home: Path, certificate: Certificate, *, ask: Ask) -> Station:
    """Complete a station that asked for a certificate; one that has it already is opened as it is.

    Raises NotFoundError (no station asked here), PolicyError (a certificate for another key, or another CA already).
    """
    if not has_store(home):
        raise NotFoundError("This station has not requested a certificate.", hint="First: init --request FILE")
    station = Station.inspect(home, ask=ask)

    def adopt(known: Ask) -> None:
        station.ask_by(known)
        with StoreLock(home, command="init"):
            _adopt(station, certificate)

    try:
        asked_first(ask, adopt)
        station.ask_by(ask)
    except BaseException:
        station.close()
        raise
    return station


def found_under(home: Path, path: Path, passphrase: str, *, name: str | None, keystore: str | None, ask: Ask) -> None:
    """Make a station of an owner whose CA key survived in a file of ``trust ca export``; the key comes into its vault.

    Run again after a cut, it carries on. Raises WrongPassphraseError, VaultError (no such file), PolicyError (the home
    has a station of another CA).
    """
    owner = SoftwareKey.from_secret(read_ca(path, passphrase))
    if has_store(home):
        with Station.inspect(home, ask=ask) as station:
            identity = station.identity
            if identity.is_complete() and identity.ca != owner.point:
                raise PolicyError(
                    f"{home} holds a station of another CA ({fingerprint(identity.ca)[:16]}). Nothing was changed.",
                    hint="Choose an empty home: teds-provision --home NEW init --ca FILE",
                )
    request = read_request(ask_for_certificate(home, name=name, keystore=keystore, ask=ask))
    signature = owner.sign(station_key_message(request.station))
    certificate = Certificate(request.name, request.station, owner.point, signature)
    with closing(adopt_certificate(home, certificate, ask=ask)) as station:
        vault = station.vault
        with StoreLock(home, command="init"):
            import_ca(station, vault, path, passphrase)


def _adopt(station: Station, certificate: Certificate) -> None:
    identity = station.identity
    own = identity.point if identity.is_complete() else identity.requested
    if own is None:
        raise NotFoundError("This station has not requested a certificate.", hint="First: init --request FILE")
    if certificate.station != own:
        raise PolicyError(
            f"The certificate is for station {fingerprint(certificate.station)[:16]},"
            f" this one is {fingerprint(own)[:16]}."
        )
    fresh = not identity.is_complete()
    if not fresh and identity.certificate(certificate.ca, station.point) is not None:
        return
    with station.transaction():
        if fresh:
            identity.complete(own, certificate.ca, certificate.signature)
        else:  # this station already has another CA: keep this certificate too, for that CA's nodes
            identity.keep_certificate(certificate.ca, station.point, certificate.signature)
        station.audit("init", None, "certified", ca=fingerprint(certificate.ca), own=fresh)


def _name(value: object) -> str:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= 100:
        raise BadDataError("A station's name is printable text of at most 100 characters.")
    return value


# -- the CA key itself ------------------------------------------------------------------------------------------------


def require_ca(station: Station) -> PrivateKey:
    """Return the CA key; raises PolicyError if this station's CA is kept elsewhere."""
    ca = station.vault.ca()
    if ca is None or ca.point != station.ca:
        raise PolicyError(
            f"The key of this station's CA {fingerprint(station.ca)[:16]} is not in this vault.",
            hint="To import it: trust ca import FILE. A station with its own CA is created by init in another --home.",
        )
    return ca


def export_ca(station: Station, vault: Vault, path: Path, passphrase: str) -> bool:
    """Write the CA key to a new file under a passphrase; False if the file holds it so already.

    Raises PolicyError, VaultError (token, another file).
    """
    require_ca(station)
    if path.exists():
        with suppress(TedsProvisionError):  # another file, or another passphrase: the vault refuses to replace it
            require_own_ca(station, path, passphrase)
            return False
    vault.export_ca(path, passphrase)
    station.audit("ca", None, "exported", ca=fingerprint(station.ca))
    return True


def drop_ca(station: Station) -> bool:
    """Delete the CA key from the vault; False if it is not there."""
    dropped = station.vault.drop_ca()
    if dropped:
        station.audit("ca", None, "dropped", ca=fingerprint(station.ca))
    return dropped


def require_own_ca(station: Station, path: Path, passphrase: str) -> None:
    """Raise PolicyError unless the file holds this station's CA key.

    Raises WrongPassphraseError, NotFoundError, VaultError.
    """
    if SoftwareKey.from_secret(read_ca(path, passphrase)).point != station.ca:
        raise PolicyError(f"{path} contains a CA key other than this station's ({fingerprint(station.ca)[:16]}).")


def import_ca(station: Station, vault: Vault, path: Path, passphrase: str) -> None:
    """Bring the CA key back; raises WrongPassphraseError, NotFoundError, VaultError, PolicyError (another CA's key)."""
    require_own_ca(station, path, passphrase)
    vault.import_ca(path, passphrase)
    station.audit("ca", None, "imported", ca=fingerprint(station.ca))


MAX_KEY_FILE = 64 * 1024
_MIN_PREFIX = 8
_DER_SUFFIXES = (".der", ".key", ".p8", ".pk8", ".p12", ".pfx")
_CA_SUFFIXES = (".ca.pem", ".ca.pub")


@dataclass(frozen=True)
class Candidate:
    """A key that the user wants to trust, its origin, and the CA's signature over it if the file has one."""

    record: TrustRecord
    path: Path
    certificate: Certificate | None = None
    known: bool = False


def spoken(digits: str) -> str:
    """Return a fingerprint as people read it aloud: sixteen groups of four digits."""
    return " ".join(digits[start : start + 4] for start in range(0, len(digits), 4))


def candidate(station: Station, name: str, path: Path, role: TrustRole) -> Candidate:
    """Read one public key (PEM) or a station's certificate.

    Raises NotFoundError, BadDataError (private key, RSA, P-384, neither key nor certificate), PolicyError (the
    station's own key, a name of another key).
    """
    point, certificate = _read(path)
    if certificate is not None and role == "ca":
        raise UsageError(f"{path} is a station's certificate, not a CA's key.", hint="Omit --role.")
    digits = fingerprint(point)
    if point == station.point or (role == "ca" and point == station.ca):
        raise PolicyError(f"{path} contains this station's own key ({digits[:16]}), which is always trusted.")
    if not name.strip() or name != name.strip() or not name.isprintable() or len(name) > 100:
        raise UsageError(
            f"{name!r} is not a valid name for a key.", hint="Give printable text of at most 100 characters."
        )
    if role == "station":
        _refuse_in_roster(station, digits)
    record = TrustRecord(name, role, point, digits)
    return Candidate(record, path, certificate, _is_listed(station, record))


def _refuse_in_roster(station: Station, fingerprint: str) -> None:
    if station.policy.in_roster(fingerprint):
        raise PolicyError(
            f"Trust in the key {fingerprint[:16]} is decided by the plant's roster, not by this station.",
            hint="On the station with the CA key: teds-provision registry add, or remove",
        )


def _is_listed(station: Station, wanted: TrustRecord) -> bool:
    """Return True if this key is listed under this name already; raises PolicyError if another key has the name."""
    named = [record for record in station.policy.listed() if record.name == wanted.name]
    for old in named:
        if (old.role, old.point) != (wanted.role, wanted.point):
            raise PolicyError(
                f"The name {wanted.name!r} is already taken by the {old.role} {old.fingerprint[:16]}.",
                hint=f"Choose another name, or run teds-provision trust remove {quote(wanted.name)} first.",
            )
    return bool(named)


def candidates_of(station: Station, folder: Path, role: TrustRole) -> list[Candidate]:
    """Read every key of a folder such as ``keys/``: ``NAME.pem``, ``NAME.ca.pem`` (a CA), ``NAME.cert`` (certificate).

    A folder that holds a private key anywhere is refused whole (PolicyError).
    """
    if not folder.is_dir():
        raise NotFoundError(f"There is no folder {folder}.")
    refuse_private_keys(folder)
    found: list[Candidate] = []
    for path in sorted(folder.rglob("*")):
        kind = _kind(path)
        if kind is None:
            continue
        name, of_ca = kind
        if _read(path)[0] in (station.point, station.ca):
            continue
        found.append(candidate(station, name, path, "ca" if of_ca else role))
    if not found:
        raise NotFoundError(
            f"{folder} contains no key of another station or CA.", hint="Keys are NAME.pem or NAME.ca.pem."
        )
    return found


def refuse_private_keys(folder: Path) -> None:
    """Raise PolicyError if any file below ``folder`` holds a private key; such a folder is shared and kept."""
    for path, why in private_keys(folder):
        raise PolicyError(
            f"{path} holds {why}; this folder is for public keys.",
            hint="Remove it there and from the version history, and treat that key as compromised.",
        )


def private_keys(folder: Path) -> Iterator[tuple[Path, str]]:
    """Give every file below ``folder`` that holds a private or secret key, and what it is."""
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or ".git" in path.parts:
            continue
        secret = _secret_in(read_limited(path, 16 << 20, "key"), path.suffix)
        if secret:
            yield path, secret


def _secret_in(octets: bytes, suffix: str) -> str:
    """Return the kind of secret in a file that must not be shared, "" if there is none."""
    if b"PRIVATE KEY" in octets:
        return "a private key"
    if suffix in _DER_SUFFIXES and octets[:1] == b"\x30":
        return "" if _is_public_der(octets) else "a private key"
    if b'"kty"' in octets and (b'"d"' in octets or b'"k"' in octets):
        return "a private or secret JSON Web Key"
    if b'"teds-provision-vault' in octets or b'"teds-vault' in octets:
        return "a vault"
    return ""


def add(station: Station, chosen: list[Candidate]) -> int:
    """Trust these keys, in one transaction; returns how many were new."""
    new = 0
    with station.transaction():
        for candidate in chosen:
            if candidate.certificate is not None:
                station.identity.keep_certificate(
                    candidate.certificate.ca, candidate.certificate.station, candidate.certificate.signature
                )
            if candidate.known:
                continue
            station.policy.trust(candidate.record)
            station.audit(
                "trust",
                None,
                "added",
                name=candidate.record.name,
                role=candidate.record.role,
                key=candidate.record.fingerprint,
            )
            new += 1
    return new


def find_trusted(station: Station, text: str, role: TrustRole | None = None) -> TrustRecord:
    """Return the trusted key that ``text`` means: a name, the first digits of a fingerprint, or a PEM file.

    Raises NotFoundError, UsageError (several fit), BadDataError (file), PolicyError (the file's key is not trusted).
    """
    known = station.policy.listed() if role is None else station.policy.trusted(role)
    fits = [record for record in known if record.name == text] or _by_digits(known, text)
    if len(fits) > 1:
        raise UsageError(f"{text!r} matches {len(fits)} trusted keys.", hint="Give the name, or more digits.")
    if fits:
        return fits[0]
    if Path(text).is_file():
        return _by_file(known, text)
    what = "station" if role == "station" else "key"
    raise NotFoundError(
        f"No trusted {what} is known as {text!r}.", hint="teds-provision trust add NAME FILE; see trust list"
    )


@dataclass(frozen=True)
class RemovedTrust:
    """A key that was trusted until it was removed at ``at``."""

    name: str
    role: str
    fingerprint: str
    at: str


def find_removed(station: Station, text: str) -> RemovedTrust | None:
    """Return the key that was last removed under this name, or with these first digits; None if none was."""
    digits, found = text.replace(" ", "").lower(), None
    for entry in station.audit_log.chosen(AuditFilter(act="trust")):
        name, key = str(entry.detail.get("name", "")), str(entry.detail.get("key", ""))
        if entry.outcome == "removed" and (name == text or (len(digits) >= _MIN_PREFIX and key.startswith(digits))):
            found = RemovedTrust(name, str(entry.detail.get("role", "")), key, entry.at)
    return found


def _by_digits(known: list[TrustRecord], text: str) -> list[TrustRecord]:
    digits = text.replace(" ", "").lower()
    if len(digits) < _MIN_PREFIX or set(digits) - set("0123456789abcdef"):
        return []
    return [record for record in known if record.fingerprint.startswith(digits)]


def _by_file(known: list[TrustRecord], file: str) -> TrustRecord:
    point = _read(Path(file))[0]
    for record in known:
        if record.point == point:
            return record
    raise PolicyError(
        f"The key {fingerprint(point)[:16]} of {file} is not trusted here.",
        hint=f"Compare its fingerprint by voice, then: teds-provision trust add NAME {quote(str(file))}",
    )


@dataclass(frozen=True)
class Removal:
    """Consequences of ending the trust in a key.

    ``shared`` are nodes whose key that station holds: each is rotated at the next contact. ``cas`` are CAs that count
    for some nodes only because this key's owner brought them, or that were trusted by themselves; ``under`` counts the
    nodes that keep one of them: datasheets of its stations are not authentic any more. ``bans`` are nodes that this
    station alone has banned. ``open`` are ids of bundles that left for it and are not closed.
    """

    record: TrustRecord
    shared: tuple[bytes, ...]
    cas: tuple[bytes, ...]
    under: int
    bans: tuple[bytes, ...]
    open: tuple[str, ...]


def plan_removal(station: Station, record: TrustRecord) -> Removal:
    """Find what depends on the trust in a key; changes nothing. Raises PolicyError for one that the roster names."""
    if record.role == "station":
        _refuse_in_roster(station, record.fingerprint)
    cas = _cas_of(station, record)
    under = sum(ca in cas for ca in station.keys.cas_of_nodes().values())
    if record.role == "ca":
        return Removal(record, (), cas, under, (), ())
    digits = record.fingerprint
    shared = {holder.uuid for holder in station.keys.holders() if holder.fingerprint == digits}
    bans = [entry.uuid for entry in station.policy.revocations() if signer_of(entry.statement) == digits]
    left = [row.id for row in station.handovers.all() if row.state == OPEN and digits in row.peers]
    return Removal(record, tuple(sorted(shared)), cas, under, tuple(bans), tuple(left))


def remove(station: Station, record: TrustRecord) -> Removal:
    """Trust a key no more, and end all that hung on it, in one transaction (see :class:`Removal`)."""
    with station.transaction():
        removal = plan_removal(station, record)
        station.policy.distrust(record.name)  # this row alone: its key may also be trusted in the other role
        for uuid in removal.shared:
            station.keys.demand_rotation(uuid, f"station {record.name} is no longer trusted, and holds this key")
        for ca in removal.cas:
            station.policy.end_ca(ca)
        for uuid in removal.bans:
            station.policy.lift(uuid)
        ended = {"rotations": len(removal.shared), "cas": len(removal.cas), "bans": len(removal.bans)}
        station.audit("trust", None, "removed", name=record.name, role=record.role, key=record.fingerprint, **ended)
    return removal


def _cas_of(station: Station, record: TrustRecord) -> tuple[bytes, ...]:
    """Return the CAs whose trust ends with this key: itself, or those that no other trusted station brought."""
    trusted = {trusted.point for trusted in station.policy.trusted("ca")} | {station.ca}
    if record.role == "ca":
        return () if record.point == station.ca else (record.point,)
    stations = {trusted.fingerprint for trusted in station.policy.trusted("station")} - {record.fingerprint}
    brought = _brought_cas(station)
    ended = [ca for ca, by in brought.items() if record.fingerprint in by and not by & stations and ca not in trusted]
    return tuple(ended)


def _brought_cas(station: Station) -> dict[bytes, set[str]]:
    """Return the CAs that came in bundles, each with the fingerprints of the stations that sent it."""
    brought: dict[bytes, set[str]] = {}
    for row in station.handovers.all():
        if row.direction == "in":
            brought.setdefault(bytes.fromhex(BundleNotes.from_json(row.nodes).ca), set()).update(row.peers)
    return brought


def _read(path: Path) -> tuple[bytes, Certificate | None]:
    octets = read_limited(path, MAX_KEY_FILE, "key")
    if CERTIFICATE_FORMAT.encode() in octets:
        certificate = read_certificate(octets)
        return certificate.station, certificate
    try:
        return from_pem(octets), None
    except BadDataError as error:
        raise BadDataError(f"{path}: {error.message}", hint="Give the public key (PEM) that init shows.") from error


def _kind(path: Path) -> tuple[str, bool] | None:
    """Name, and whether it is a CA's, of a file of a key folder; None for a file that is no key."""
    if not path.is_file() or path.name.startswith("."):
        return None
    for suffix in _CA_SUFFIXES:
        if path.name.endswith(suffix):
            return path.name.removesuffix(suffix), True
    return (path.stem, False) if path.suffix in (".pem", ".pub", ".cert") else None


def _is_public_der(octets: bytes) -> bool:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_der_public_key

    try:
        load_der_public_key(octets)
    except (ValueError, UnsupportedAlgorithm):
        return False
    return True
