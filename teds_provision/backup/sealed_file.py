"""The sealed file of ``backup`` (version 2): its content, and the checks when it is opened.

One line of JSON in the clear: ``format`` ``teds-backup/2``, ``store``, ``station``, ``created``, ``key`` and ``sha256``
over all of it, which distinguishes a damaged head from a wrong passphrase. ``key`` is the file's random key, sealed
under a passphrase (Argon2id, AES-256-GCM) or as a JWE to a recovery key, which any JOSE implementation opens. Then
chunks (:mod:`.chunks`), each bound to the SHA-256 of that line. Inside: a line of JSON (:class:`.content.BackupHead`),
the store as rows (:mod:`teds_provision.station.store.dump`), and the station's signature, 64 octets: SIG(station,
"TEDS1 backup" ‖ 00 ‖ SHA-256 of the first line ‖ SHA-256 of everything before the signature).

Files of version 1, which are older than KeyAgreement 2, are refused by name.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO, Final

from teds_provision.backup.chunks import KEY_OCTETS, ChunkReader, ChunkWriter
from teds_provision.backup.content import MAX_HEAD_OCTETS, BackupHead, Content, check_digest, context_of, digest_of
from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError
from teds_provision.files import open_to_read
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.strict_json import dump, load_object
from teds_provision.protocol.keys import SIGNATURE_OCTETS, PrivateKey, fingerprint, verify
from teds_provision.station.station import Station
from teds_provision.station.store.connection import too_old
from teds_provision.vault import passphrase as sealing

FORMAT: Final = "teds-backup/2"
KEY_TYPE: Final = "teds-backup-key"
MAX_OCTETS: Final = 16 << 30
"""More is neither written nor read: about ten times what 100,000 nodes need."""
_LABEL: Final = b"TEDS1 backup\0"
_MAX_LINE_OCTETS: Final = 256 * 1024
_CLEAR: Final = ("format", "store", "station", "created")


class Sealer:
    """Key source of a sealed backup: a passphrase, or the 65-octet point of a recovery key."""

    def __init__(
        self, *, passphrase: str | None = None, recovery: bytes | None = None, costs: sealing.Costs = sealing.PRODUCT
    ) -> None:
        self._passphrase, self._recovery, self._costs = passphrase, recovery, costs
        if passphrase is not None:
            sealing.check_new(passphrase)

    def wrap(self, key: bytes, clear: dict[str, Any]) -> dict[str, Any]:
        """Seal the file's own key, as a JSON object."""
        if self._recovery is not None:
            return load_object(jose.encrypt(key, [self._recovery], cty=KEY_TYPE), "The sealed key")
        assert self._passphrase is not None
        return sealing.seal(self._passphrase, key, context=context_of(clear, FORMAT), costs=self._costs)


def write(out: BinaryIO, head: BackupHead, rows: Iterable[bytes], signer: PrivateKey, sealer: Sealer) -> bytes:
    """Write a whole backup; returns the file's own key, to read it back with. Raises what ``rows`` raises, OSError."""
    key = os.urandom(KEY_OCTETS)
    clear = {"format": FORMAT, "store": head.store, "station": head.station, "created": head.created}
    document = {**clear, "key": sealer.wrap(key, clear)}
    line = dump({**document, "sha256": digest_of(document)}) + b"\n"
    out.write(line)
    bound = hashlib.sha256(line).digest()
    chunks = ChunkWriter(out, key, bound)
    chunks.write(head.line(FORMAT))
    for octets in rows:
        chunks.write(octets)
    chunks.write(signer.sign(_LABEL + bound + chunks.digest.digest()))
    chunks.end()
    return key


class SealedFile:
    """A backup in a file, still sealed. Opening it reads its first line.

    Raises NotFoundError, BadDataError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.octets = path.stat().st_size
            with open_to_read(path) as file:
                line = file.readline(_MAX_LINE_OCTETS)
        except OSError as error:
            raise NotFoundError(f"{path} cannot be read: {error.strerror}.") from error
        if line.lstrip()[:1] != b"{":
            raise BadDataError("This is not a backup.", hint="Give the file that teds-provision backup wrote.")
        if self.octets > MAX_OCTETS:
            raise BadDataError(f"The file is larger than {MAX_OCTETS} octets; backups are smaller.")
        self._line = line
        if not line.startswith(b'{"format":"teds-backup/2"'):
            if b"teds-backup/1" in line or b'"protected"' in line:
                raise too_old("The store in the backup", 1)
            raise BadDataError("This is not a backup of this version of teds-provision.")
        if not line.endswith(b"\n") or not isinstance(
            (head := load_object(line, "The head of the backup")).get("key"), dict
        ):
            raise BadDataError("The backup is truncated in its header, or damaged.", hint="Use another copy.")
        self._head = head
        self.is_for_key = "protected" in head["key"]

    def open_with_passphrase(self, passphrase: str) -> Content:
        """Open it; raises BadDataError, NotAuthenticError (damaged or changed), WrongPassphraseError, VaultError."""
        clear = self._checked_head()
        key, _ = sealing.unseal(passphrase, self._head["key"], context=context_of(clear, FORMAT))
        return self.open_with_content_key(key)

    def open_with_key(self, key: PrivateKey) -> Content:
        """Open it with the recovery key; raises PolicyError (another key), NotAuthenticError, BadDataError."""
        self._checked_head()
        sealed = dump(self._head["key"])
        recipients = jose.read_header(sealed, max_octets=_MAX_LINE_OCTETS).recipients
        if fingerprint(key.point) not in recipients:
            shown = ", ".join(kid[:32] for kid in recipients)
            raise PolicyError(f"The backup is sealed to the recovery key {shown}, not to this one.")
        return self.open_with_content_key(jose.decrypt(sealed, key, cty=KEY_TYPE, max_octets=_MAX_LINE_OCTETS))

    def open_with_content_key(self, key: bytes) -> Content:
        """Open it with the file's own key; raises BadDataError, NotAuthenticError, StoreError."""
        clear = self._checked_head()
        bound = hashlib.sha256(self._line).digest()
        if len(key) != KEY_OCTETS:
            raise BadDataError("The backup's own key has another length than 32 octets.")
        try:
            with open_to_read(self.path) as file:
                file.seek(len(self._line))
                return _content(ChunkReader(file, key, bound), bound, clear)
        except OSError as error:
            raise NotFoundError(f"{self.path} cannot be read: {error.strerror}.") from error

    def _checked_head(self) -> dict[str, Any]:
        """Return the members in the clear after checking their digest."""
        check_digest(self._head)
        return {name: self._head.get(name) for name in _CLEAR}


def _content(chunks: ChunkReader, bound: bytes, clear: dict[str, Any]) -> Content:
    head = BackupHead.read(chunks.read_line(MAX_HEAD_OCTETS), FORMAT)
    if (head.store, head.station, head.created) != (clear["store"], clear["station"], clear["created"]):
        raise NotAuthenticError("The backup's header names a different station than its content.")
    copy = Station.of_backup(chunks)
    try:
        signed = _LABEL + bound + chunks.digest.digest()
        if not verify(head.point, signed, chunks.read(SIGNATURE_OCTETS)):
            raise NotAuthenticError("The backup is not signed by the station that it names.")
        chunks.require_end()
        return Content(**vars(head), copy=copy)
    except BaseException:
        copy.close()
        raise
