"""The vault whose station key and CA key are in a PKCS #11 token (a smart card, an HSM, SoftHSM).

The keys are made in the token and never leave it. Node keys are wrapped, as in every vault, under master keys; these
are sealed to the station key in the file ``vault-pkcs11.json``: a one-time key agrees with the station key (ECDH in
the token), HKDF-SHA-256 makes the sealing key, AES-256-GCM seals, and the station key signs the whole file. Opening it
needs the token once per process; changing it unseen needs the token too. Node keys are in this process's memory while
they are used: nothing else is promised, whatever the token.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from teds_provision.errors import BadDataError, NotFoundError, VaultChangedError, VaultError
from teds_provision.files import private_folder, read_limited, write_new, write_whole
from teds_provision.portable import lock
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, fingerprint, verify
from teds_provision.vault.base import Ask
from teds_provision.vault.master import MasterKeys, another_life
from teds_provision.vault.pkcs11_token import TokenKey, TokenSession, ask_pin, find_token, log_in
from teds_provision.vault.pkcs11_uri import Pkcs11Uri

FILE_NAME = "vault-pkcs11.json"
_FORMAT = "teds-vault-pkcs11/1"
_LABEL = b"TEDS1 token vault\0"
_MAX_OCTETS = 64 * 1024
_NONCE_OCTETS = 12
_DAMAGED = "Restore this file from a backup of this station; the keys are still in the token."


class Pkcs11Vault:
    """The station's keys in a token, its master keys in a file that only the token opens."""

    kind = "pkcs11"

    def __init__(
        self, home: Path, store_id: str, uri: Pkcs11Uri, session: TokenSession, opened: tuple[_Content, dict[str, Any]]
    ) -> None:
        self.description = f"PKCS #11 token {session.label!r} by {uri.module_path}"
        self._home, self._store_id, self._module_path = home, store_id, uri.module_path
        self._session, (self._content, self._members) = session, opened

    @classmethod
    def create(
        cls, home: Path, store_id: str, uri: str, ask: Ask, *, with_ca: bool = True, restored: str | None = None
    ) -> Pkcs11Vault:
        """Make the keys in the token that ``uri`` (RFC 7512) names, or take up what an earlier run made.

        The URI's ``object`` and ``id`` name the station key; a key of that name which is in the token already is taken,
        if it cannot leave it. ``with_ca`` False makes no CA key. ``restored`` is what :meth:`secret_material` gave to a
        backup; it opens with the same token alone, and a CA key that was destroyed since stays out. ``ask`` is called
        once, for the PIN, unless the token has a pad.
        Raises UsageError (URI), WrongPassphraseError, VaultError.
        """
        if (home / FILE_NAME).exists():
            vault = cls.open(home, store_id, uri, ask)
            if restored is not None:
                vault._join(_backed_up(restored, store_id, vault._session))
            return vault
        where = Pkcs11Uri.parse(uri)
        session = _open_session(where, ask, write=True)
        with exclusive(where.module_path):
            if restored is not None:
                _save(home, store_id, _backed_up(restored, store_id, session), replace=False)
            elif not (home / FILE_NAME).exists():  # otherwise another process created it first
                station = _find_or_make(session, store_id, where, "station")
                ca = _find_or_make(session, store_id, where, "CA") if with_ca else None
                _save(home, store_id, _Content(station, ca, MasterKeys.generate()), replace=False)
            opened = _load(home, store_id, session)  # check that the token can open what was just sealed to its key
        return cls(home, store_id, where, session, opened)

    @classmethod
    def open(cls, home: Path, store_id: str, uri: str, ask: Ask) -> Pkcs11Vault:
        """Open the vault with the PIN that ``ask`` gives.

        Raises UsageError (URI), WrongPassphraseError, VaultError (module, token, key or file missing or changed).
        """
        where = Pkcs11Uri.parse(uri)
        _read(home, store_id)  # fails before the user is asked for a PIN
        session = _open_session(where, ask, write=False)
        with exclusive(where.module_path):
            opened = _load(home, store_id, session)
        return cls(home, store_id, where, session, opened)

    def identity(self) -> PrivateKey:
        """Return the station's identity key."""
        return self._content.station

    def ca(self) -> PrivateKey | None:
        """Return the CA key, None if the token holds none."""
        return self._content.ca

    def wrap(self, key: bytes, *, context: bytes) -> bytes:
        """Seal a node key under the newest master key, bound to ``context``."""
        return self._content.masters.wrap(key, context=context)

    def unwrap(self, wrapped: bytes, *, context: bytes) -> bytes:
        """Open a wrapped node key; raises VaultError if it is damaged or belongs elsewhere."""
        return self._content.masters.unwrap(wrapped, context=context)

    def export_ca(self, path: Path, passphrase: str) -> None:
        """Refuse: a key made in a token never leaves it. Raises VaultError always."""
        raise VaultError(
            "The CA key is in the token and cannot leave it.",
            hint="Keep the token itself offline, or create the CA in another home with --keystore file.",
        )

    def import_ca(self, path: Path, passphrase: str) -> PrivateKey:
        """Refuse: a key from a file was in the clear somewhere. Raises VaultError always."""
        raise VaultError(
            "A CA key from a file cannot be imported into a token.", hint="Use --keystore file in another home."
        )

    def drop_ca(self) -> bool:
        """Destroy the CA key in the token; False if there is none. A token's key cannot be exported first."""
        self.refresh()
        key = self._content.ca
        if key is None:
            return False
        self._replace(replace(self._content, ca=None))
        self._session.destroy(key)
        return True

    def masters(self) -> tuple[int, ...]:
        """Return the numbers of the master keys, ascending; the last one wraps."""
        return tuple(sorted(self._content.masters.keys))

    def opener(self) -> bytes:
        """Return nothing: this vault has no secret besides the one that is asked for."""
        return b""

    def new_passphrase(self, ask: Ask) -> Callable[[], None]:
        """Ask for the token's PIN and a new one; return a function that sets it in the token, with the store locked.

        That function raises WrongPassphraseError, VaultError, and, before the token counts a try, VaultChangedError if
        another command has set a new PIN since this vault was opened.
        """
        old, new = ask("PIN of the token, as it is now", False), ask("New PIN of the token", True)

        def set_pin() -> None:
            self.refresh()
            # Count first: after a cut in between, other processes only ask again; the other way round, they would lose
            # a try.
            self._replace(replace(self._content, pins=self._content.pins + 1))
            with exclusive(self._module_path):
                self._session.set_pin(old, new)

        return set_pin

    def refresh(self) -> bool:
        """Take in changes of other processes without asking; False if there were none.

        Raises VaultChangedError if the token has a new PIN, VaultError.
        """
        if _read(self._home, self._store_id) == self._members:
            return False
        with exclusive(self._module_path):
            content, members = _load(self._home, self._store_id, self._session)
        if content.pins != self._content.pins:
            raise VaultChangedError(
                "Another command has changed the PIN in the meantime; this one changed nothing.",
                hint="Run it again with the new PIN.",
            )
        self._content, self._members = content, members
        return True

    def reread(self) -> None:
        """Read the master keys again in the session that is open: it lasts beyond a change of the PIN.

        Raises VaultError. The count of PINs stays that of the opening, so :meth:`refresh` still reports a new one.
        """
        with exclusive(self._module_path):
            content, _ = _load(self._home, self._store_id, self._session)
        self._content = replace(self._content, masters=content.masters)

    def master_keys(self) -> MasterKeys:
        """Return the master keys, for another process of this user that has the vault open."""
        return self._content.masters

    def accept(self, masters: MasterKeys) -> None:
        """Use these master keys from now on, in this process alone."""
        self._content = replace(self._content, masters=masters)

    def add_master(self) -> None:
        """Add a master key, which wraps from now on; the old ones still unwrap. First step of a change."""
        self.refresh()
        self._replace(replace(self._content, masters=self._content.masters.with_new()))

    def retire_masters(self) -> None:
        """Delete all master keys but the newest: the last step of a change, after every key was wrapped again."""
        self.refresh()
        if len(self._content.masters.keys) > 1:
            self._replace(replace(self._content, masters=self._content.masters.newest_only()))

    def secret_material(self) -> str:
        """Return what a backup needs: the file, sealed as it is. It is of no use without the token."""
        octets = read_limited(self._home / FILE_NAME, _MAX_OCTETS, "vault", failure=VaultError, follow=False)
        return octets.decode("utf-8", "replace")

    def close(self) -> None:
        """End the session with the token."""
        self._session.close()

    def _join(self, other: _Content) -> None:
        """Take in the master keys of a backup of this station; raises VaultError if it is of another."""
        self.refresh()
        here, there = self._content.masters.keys, other.masters.keys
        if other.station.point != self._content.station.point:
            raise VaultError("The vault holds the keys of another station.", hint="Restore into another --home.")
        if any(here[number] != there[number] for number in here.keys() & there):
            raise another_life()
        if there.keys() - here.keys():
            self._replace(replace(self._content, masters=MasterKeys({**there, **here})))

    def _replace(self, content: _Content) -> None:
        with exclusive(self._module_path):
            self._members = _save(self._home, self._store_id, content, replace=True)
        self._content = content

    def __repr__(self) -> str:
        return f"Pkcs11Vault({self.description}, station {fingerprint(self._content.station.point)[:16]})"


@dataclass(frozen=True)
class _Content:
    """Content of an open vault; ``pins`` counts PIN changes, so that other processes detect an old PIN."""

    station: TokenKey
    ca: TokenKey | None
    masters: MasterKeys
    pins: int = 0


def _open_session(uri: Pkcs11Uri, ask: Ask, *, write: bool) -> TokenSession:
    with exclusive(uri.module_path):
        token = find_token(uri)
    pin = ask_pin(token, uri, ask)
    with exclusive(uri.module_path):
        return log_in(token, uri, pin, write=write)


def _find_or_make(session: TokenSession, store_id: str, uri: Pkcs11Uri, role: str) -> TokenKey:
    """Name, CKA_ID and so the key itself follow from the URI and the store's id: a second run finds the first's."""
    label = f"teds-provision {role}" if uri.object is None else uri.object if role == "station" else f"{uri.object} CA"
    identifier = hashlib.sha256(_LABEL + f"{role}\0{store_id}".encode()).digest()[:16]
    if uri.id is not None:
        identifier = uri.id if role == "station" else uri.id + b"CA"
    by_label = uri.object is not None or uri.id is None
    by_id = uri.id is not None or uri.object is None
    found = session.find(label=label if by_label else None, identifier=identifier if by_id else None)
    return found or session.generate(label=label, identifier=identifier)


def _save(home: Path, store_id: str, content: _Content, *, replace: bool) -> dict[str, Any]:
    """Seal the master keys to the station key, sign, write atomically; return the octets written."""
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    one_time, nonce = SoftwareKey.generate(), os.urandom(_NONCE_OCTETS)
    members: dict[str, Any] = {
        "format": _FORMAT,
        "store": store_id,
        "station": _described(content.station),
        "ca": None if content.ca is None else _described(content.ca),
        "pins": content.pins,
        "one_time": one_time.point.hex(),
        "nonce": nonce.hex(),
    }
    key = _sealing_key(one_time.ecdh(content.station.point), members)
    masters = json.dumps({number: master.hex() for number, master in content.masters.keys.items()})
    members["sealed"] = AESGCM(key).encrypt(nonce, masters.encode(), None).hex()
    members["signature"] = content.station.sign(_signed(members)).hex()
    write = write_whole if replace else write_new
    write(home / FILE_NAME, json.dumps(members, indent=1).encode() + b"\n", failure=VaultError)
    return members


def _load(home: Path, store_id: str, session: TokenSession) -> tuple[_Content, dict[str, Any]]:
    members = _read(home, store_id)
    return _content_of(members, session), members


def _backed_up(restored: str, store_id: str, session: TokenSession) -> _Content:
    """Open what a backup holds; a CA key that the token lacks was destroyed since (:meth:`Pkcs11Vault.drop_ca`)."""
    return _content_of(_parsed(restored.encode(), store_id, "The backup"), session, without_lost_ca=True)


def _content_of(members: dict[str, Any], session: TokenSession, *, without_lost_ca: bool = False) -> _Content:
    station = _held(session, members["station"], "station")
    find_ca = _find if without_lost_ca else _held
    ca = None if members["ca"] is None else find_ca(session, members["ca"], "CA")
    if not verify(station.point, _signed(members), _octets(members, "signature")):
        raise VaultError(f"{FILE_NAME} was changed: its signature does not verify.", hint=_DAMAGED)
    pins = members.get("pins", 0)
    if not isinstance(pins, int):
        raise VaultError(f"{FILE_NAME} is damaged (pins).", hint=_DAMAGED)
    return _Content(station, ca, _unsealed(station, members), pins)


def _unsealed(station: TokenKey, members: dict[str, Any]) -> MasterKeys:
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    key = _sealing_key(station.ecdh(_octets(members, "one_time")), members)
    try:
        plain = AESGCM(key).decrypt(_octets(members, "nonce"), _octets(members, "sealed"), None)
    except (InvalidTag, ValueError):
        raise VaultError(
            "The token does not open what was sealed to its key.", hint="Check the token's driver."
        ) from None
    return MasterKeys({int(number): bytes.fromhex(master) for number, master in json.loads(plain).items()})


def _sealing_key(shared: bytes, members: dict[str, Any]) -> bytes:
    """Derive the key by HKDF-SHA-256 over x of the ECDH; it is bound to all clear members except the signature."""
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF

    clear = {name: value for name, value in members.items() if name not in ("sealed", "signature")}
    return HKDF(hashes.SHA256(), 32, None, _LABEL + b"seal\0" + _canonical(clear)).derive(shared)


def _signed(members: dict[str, Any]) -> bytes:
    return _LABEL + b"file\0" + _canonical({name: value for name, value in members.items() if name != "signature"})


def _canonical(members: dict[str, Any]) -> bytes:
    return json.dumps(members, sort_keys=True, separators=(",", ":")).encode()


def _described(key: TokenKey) -> dict[str, str]:
    return {"label": key.label, "id": key.identifier.hex(), "point": key.point.hex()}


def _find(session: TokenSession, described: Any, role: str) -> TokenKey | None:
    """Return the key that the file names, None if the token holds none; it must still be the same."""
    try:
        label, identifier, point = str(described["label"]), bytes.fromhex(described["id"]), described["point"]
    except (KeyError, TypeError, ValueError):
        raise VaultError(f"{FILE_NAME} does not say which key is the {role} key.", hint=_DAMAGED) from None
    key = session.find(label=label, identifier=identifier)
    if key is not None and key.point.hex() != point:
        raise VaultError(
            f"The {role} key {label!r} in the token {session.label!r} is not the one from init.",
            hint="Plug in the token that was used at init.",
        )
    return key


def _held(session: TokenSession, described: Any, role: str) -> TokenKey:
    """Return the key that the file names; the token must hold it."""
    key = _find(session, described, role)
    if key is None:
        raise VaultError(
            f"The token {session.label!r} does not hold the {role} key {str(described['label'])!r}.",
            hint="Plug in the token that was used at init; a key deleted there cannot be recovered.",
        )
    return key


def _octets(members: dict[str, Any], name: str) -> bytes:
    try:
        return bytes.fromhex(members[name])
    except (KeyError, TypeError, ValueError):
        raise VaultError(f"{FILE_NAME} is damaged ({name}).", hint=_DAMAGED) from None


def _read(home: Path, store_id: str) -> dict[str, Any]:
    path = home / FILE_NAME
    try:
        octets = read_limited(path, _MAX_OCTETS, "vault", failure=VaultError, follow=False)
    except NotFoundError:
        raise VaultError(f"{path} is missing.", hint=_DAMAGED) from None
    except BadDataError:
        octets = b""
    return _parsed(octets, store_id, str(path))


def _parsed(octets: bytes, store_id: str, path: str) -> dict[str, Any]:
    try:
        members = json.loads(octets)
    except (ValueError, RecursionError):
        members = None
    if len(octets) > _MAX_OCTETS or not isinstance(members, dict) or not {"station", "ca"} <= members.keys():
        raise VaultError(f"{path} is damaged.", hint=_DAMAGED)
    if members.get("format") != _FORMAT or members.get("store") != store_id:
        raise VaultError(f"{path} is of another version or belongs to another store.", hint=_DAMAGED)
    return members


# One process at a time while a token is at risk: loading the module, logging in, making keys.
#
# SoftHSM rewrites its token file at every login, and a process that loads it then sees no token, or fails with
# CKR_GENERAL_ERROR (SoftHSMv2#757). The lock is one per user and module, as several homes may share a token. Other
# users' processes and other programs do not take this lock; because of them, one more try is made.

_WAIT_SECONDS = 30.0
_POLL_SECONDS = 0.02


@contextmanager
def exclusive(module_path: str) -> Iterator[None]:
    """Hold the lock of a module; released by the kernel if the process dies. Raises VaultError after 30 s."""
    path = _folder() / f"pkcs11-{hashlib.sha256(module_path.encode()).hexdigest()[:16]}.lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise VaultError(f"{path} cannot be opened: {error.strerror}.", hint="Check its owner and mode.") from error
    try:
        _wait(descriptor)
        yield
    finally:
        os.close(descriptor)


def _wait(descriptor: int) -> None:
    until = time.monotonic() + _WAIT_SECONDS
    while True:
        try:
            lock(descriptor)
        except BlockingIOError:
            if time.monotonic() > until:
                raise VaultError(
                    "Another teds-provision process is using the token.", hint="Wait for it to finish, or stop it."
                ) from None
            time.sleep(_POLL_SECONDS)
        else:
            return


def _folder() -> Path:
    """Return a folder that only this user can write to: in /run/user, else in the home.

    Not in /tmp, as another user could create a folder of that name first and lock this user out.
    """
    user = os.getuid()
    session = Path(f"/run/user/{user}")
    parent = session if os.access(session, os.W_OK) else Path.home() / ".cache"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        return private_folder(parent / f"teds-provision-{user}")
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise VaultError(
            f"The folder {parent / f'teds-provision-{user}'} cannot be used: {reason}.",
            hint="Remove it and run the command again.",
        ) from error
