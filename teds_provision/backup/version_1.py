"""The sealed file of ``backup`` as version 0.1 made it, which still opens: what stands in it, and what is checked.

Inside, whatever seals it: a compact JWS (ES256) by the station itself, ``typ`` ``teds-backup+jws``, over one line of
JSON (station, store, date, the vault's secret material) and the octets of the database after it. Outside, either

* a passphrase: JSON with ``format`` ``teds-backup/1``, ``store``, ``station``, ``created`` in the clear, bound to the
  sealed part (Argon2id, AES-256-GCM), and ``sha256`` over all of it, so that damage is told from a wrong passphrase; or
* a recovery key: a JWE (General JSON, ``cty`` ``teds-backup+jws``) that any JOSE implementation opens with that key.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from teds_provision.backup.content import MAX_HEAD_OCTETS, Head, check_digest, context_of
from teds_provision.errors import BadData, NotAuthentic, NotFound, PolicyRefused
from teds_provision.files import open_to_read
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.strict_json import decode_base64url, load_object, refuse_many, separators
from teds_provision.protocol.keys import PrivateKey, fingerprint
from teds_provision.vault import passphrase as sealing

FORMAT: Final = "teds-backup/1"
MAX_OCTETS: Final = 512 * 1024 * 1024
_MOST_MEMBERS: Final = 1000
TYP: Final = "teds-backup+jws"


@dataclass(frozen=True)
class Content(Head):
    """What a backup of version 1 holds: its head, and the octets of the database."""

    database: bytes = field(repr=False, kw_only=True)


def read(path: Path) -> bytes:
    """Read a file that should be a backup, and not endlessly; raises NotFound, BadData."""
    try:
        with open_to_read(path) as file:
            head = file.read(64)
            _check_start(head)
            octets = head + file.read(MAX_OCTETS)
    except OSError as error:
        raise NotFound(f"{path} cannot be read: {error.strerror}.") from error
    return octets


def is_for_key(octets: bytes) -> bool:
    """Say whether a recovery key opens this file (else a passphrase); raises BadData where it is no backup."""
    document = _document(octets)
    if "protected" in document:
        return True
    if document.get("format") != FORMAT:
        raise BadData("This is not a backup of this version of teds-provision.")
    return False


def open_with_passphrase(octets: bytes, passphrase: str) -> Content:
    """Open a file; raises BadData, NotAuthentic (damaged or changed), WrongPassphrase, VaultFailure."""
    document = _document(octets)
    check_digest(document)
    clear = {name: document.get(name) for name in ("format", "store", "station", "created")}
    sealed = document.get("sealed")
    if not isinstance(sealed, dict):
        raise BadData("The backup has no sealed part.")
    inner, _ = sealing.unseal(passphrase, sealed, context=context_of(clear, FORMAT))
    content = _verified(inner)
    if (content.store, content.station) != (clear["store"], clear["station"]):
        raise NotAuthentic("The backup says outside that it is of another station than it is inside.")
    return content


def open_with_key(octets: bytes, key: PrivateKey) -> Content:
    """Open a file with the recovery key; raises PolicyRefused (another key), NotAuthentic, BadData."""
    recipients = jose.read_header(octets, max_octets=MAX_OCTETS).recipients
    if fingerprint(key.point) not in recipients:
        shown = ", ".join(kid[:16] for kid in recipients)
        raise PolicyRefused(f"The backup is sealed to the recovery key {shown}, not to this one.")
    return _verified(jose.decrypt(octets, key, cty=TYP, max_octets=MAX_OCTETS))


def _verified(inner: bytes) -> Content:
    """Check the signature under the key that the content names; whose key that is, the caller has to know."""
    parts = inner.split(b".", 2)
    unchecked = _parsed(decode_base64url(parts[1] if len(parts) == 3 else b"", "The content of the backup"))

    def named(kid: str) -> bytes | None:
        return unchecked.point if kid == unchecked.station else None

    return _parsed(jose.verify_compact(inner, named, typ=TYP, max_octets=MAX_OCTETS).payload)


def _parsed(payload: bytes) -> Content:
    end = payload.find(b"\n", 0, MAX_HEAD_OCTETS)
    if end < 0:
        raise BadData("The content of the backup has no head.")
    head = Head.read(payload[:end], FORMAT)
    return Content(**vars(head), database=payload[end + 1 :])


def _document(octets: bytes) -> dict[str, Any]:
    if len(octets) > MAX_OCTETS:
        raise BadData(f"The file is larger than {MAX_OCTETS} octets; no backup is.")
    _check_start(octets[:64])
    # nearly all of a backup is one text of base64url; anything else is refused before it costs 25 times what it is
    refuse_many(separators(octets), _MOST_MEMBERS, "a backup")
    return load_object(octets, "The backup")


def _check_start(octets: bytes) -> None:
    if octets.lstrip()[:1] != b"{":
        raise BadData("This is not a backup.", hint="Give the file that teds-provision backup wrote.")
