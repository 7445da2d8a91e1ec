"""The station's keys in the keyring of the operating system, as one entry.

Only backends that are known to encrypt and to keep what they are given count. ``keyring``'s own choice is not asked:
it would silently take a plaintext file or a backend that forgets. Every set is read back and compared.
"""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

from teds_provision.errors import KeyringUnavailableError, VaultError
from teds_provision.vault.base import SERVICE, Ask
from teds_provision.vault.master import Material
from teds_provision.vault.software import SoftwareVault, merge_keys

if TYPE_CHECKING:
    from keyring.backend import KeyringBackend

ALLOWED: Final = {
    "keyring.backends.SecretService.Keyring": "Secret Service over D-Bus (gnome-keyring, KeePassXC, KWallet)",
    "keyring.backends.libsecret.Keyring": "Secret Service through libsecret",
    "keyring.backends.kwallet.DBusKeyring": "KWallet",
    "keyring.backends.macOS.Keyring": "macOS Keychain",
    "keyring.backends.Windows.WinVaultKeyring": "Windows Credential Manager",
}
_CHAINER: Final = "keyring.backends.chainer.ChainerBackend"
_UNLOCK = (
    "Unlock it (log in to the desktop, or pipe its password to gnome-keyring-daemon --unlock), then run this again."
)
_NO_ENTRY = "Open the keyring of the user who ran init, or restore a backup (teds-provision restore)."
_INSTEAD = "Start a Secret Service (gnome-keyring, KWallet), or run teds-provision init --keystore file."
_Result = TypeVar("_Result")


class KeyringVault(SoftwareVault):
    """The station's keys as one entry of a real keyring; nothing asks for a passphrase but the keyring itself."""

    kind = "keyring"

    def __init__(self, backend: KeyringBackend, name: str, store_id: str, material: Material) -> None:
        super().__init__(material)
        self.description = ALLOWED[name]
        self._backend = backend
        self._entry = _entry(store_id)

    @classmethod
    def create(cls, store_id: str, *, restored: str | None = None) -> KeyringVault:
        """Make the entry of this store, or take the one that is there.

        ``restored`` is the secret material of a backup. Raises KeyringUnavailableError (none, or none that may hold a
        secret), VaultError (locked, or it does not keep what it is given).
        """
        name, backend = next(_viable())
        entry = _entry(store_id)
        line = _get(name, backend, entry)
        existing = None if line is None else Material.decode(line)
        if existing is None:
            _probe(name, backend)
        material = merge_keys(existing, restored)
        if material != existing:
            _set(name, backend, entry, material.encode())
        return cls(backend, name, store_id, material)

    @classmethod
    def open(cls, store_id: str) -> KeyringVault:
        """Read the entry of this store; raises KeyringUnavailableError, VaultError (locked, or no such entry)."""
        failure: VaultError | None = None
        for name, backend in _viable():
            try:
                line = _get(name, backend, _entry(store_id))
            except VaultError as error:
                failure = failure or error
                continue
            if line is not None:
                return cls(backend, name, store_id, Material.decode(line))
        raise failure or VaultError(
            "The keyring has no entry for this station.",
            hint=_NO_ENTRY,
        )

    def opener(self) -> bytes:
        """Return nothing: this vault has no secret besides the one that is asked for."""
        return b""

    def new_passphrase(self, ask: Ask) -> Callable[[], None]:
        """Refuse: the keyring asks for its own passphrase. Raises VaultError always."""
        raise VaultError(
            f"The keyring has its own passphrase ({self.description}).",
            hint="Change it with the keyring's own program (Seahorse, KWallet manager, Keychain Access, passwd).",
        )

    def _load(self) -> Material:
        line = _get(self._name(), self._backend, self._entry)
        if line is None:
            raise VaultError("The keyring no longer has an entry for this station.", hint=_NO_ENTRY)
        return Material.decode(line)

    def _save(self, material: Material) -> None:
        _set(self._name(), self._backend, self._entry, material.encode())

    def _name(self) -> str:
        backend = type(self._backend)
        return f"{backend.__module__}.{backend.__qualname__}"


def inspect() -> str:
    """Name the keyring that would hold the keys, after it has answered (for doctor).

    Raises KeyringUnavailableError (none, or none that may hold a secret), VaultError (locked, or it fails).
    """
    name, backend = next(_viable())
    _get(name, backend, _entry("doctor"))
    return ALLOWED[name]


def _entry(store_id: str) -> str:
    return f"station/{store_id}"


def _viable() -> Iterator[tuple[str, KeyringBackend]]:
    """Give the allowed backends that work here, the best first; raises KeyringUnavailableError if there is none."""
    configured = _configured()
    if configured not in (None, _CHAINER):
        if configured not in ALLOWED:
            raise KeyringUnavailableError(
                f"The configured keyring {configured} is not suitable for secrets.", hint=_INSTEAD
            )
        names = [str(configured)]
    else:
        names = _candidates()
    found = False
    for name in names:
        module, _, attribute = name.rpartition(".")
        try:
            kind = getattr(import_module(module), attribute)
            usable = kind.priority > 0  # asks the platform, and raises if the backend cannot work
            backend = kind()
        except Exception:  # noqa: BLE001  backends raise anything: RuntimeError, D-Bus, GLib and import errors
            continue
        if usable:
            found = True
            yield name, backend
    if not found:
        raise KeyringUnavailableError("This machine has no keyring that is suitable for secrets.", hint=_INSTEAD)


def _candidates() -> list[str]:
    if sys.platform == "darwin":
        return ["keyring.backends.macOS.Keyring"]
    if sys.platform == "win32":
        return ["keyring.backends.Windows.WinVaultKeyring"]
    names = [name for name in ALLOWED if name.split(".")[2] in ("SecretService", "libsecret", "kwallet")]
    if "KDE" in os.environ.get("XDG_CURRENT_DESKTOP", "").split(":"):
        names.sort(key=lambda name: "kwallet" not in name)
    return names


def _configured() -> str | None:
    """Return the backend that the user chose for keyring (environment, then keyringrc.cfg), None if none."""
    named = os.environ.get("PYTHON_KEYRING_BACKEND")
    if named:
        return named
    from configparser import Error, RawConfigParser

    from keyring.util import platform_

    parser = RawConfigParser()
    try:
        parser.read(os.path.join(platform_.config_root(), "keyringrc.cfg"), encoding="utf-8")
        return parser.get("backend", "default-keyring", fallback="").strip() or None
    except (Error, UnicodeDecodeError, OSError):
        return "of an unreadable keyringrc.cfg"


def _probe(name: str, backend: KeyringBackend) -> None:
    """Set, read back, compare and delete a random entry before a key is trusted to this keyring."""
    entry = f"probe/{secrets.token_hex(8)}"
    try:
        _set(name, backend, entry, secrets.token_urlsafe(24))
    finally:
        with suppress(Exception):  # a probe that cannot be deleted contains no secret
            backend.delete_password(SERVICE, entry)


def _set(name: str, backend: KeyringBackend, entry: str, line: str) -> None:
    _call(name, lambda: backend.set_password(SERVICE, entry, line))
    read = _get(name, backend, entry)
    if read is None or not secrets.compare_digest(read.encode(), line.encode()):
        raise VaultError(f"The keyring ({ALLOWED[name]}) did not store the secret.", hint=_INSTEAD)


def _get(name: str, backend: KeyringBackend, entry: str) -> str | None:
    return _call(name, lambda: backend.get_password(SERVICE, entry))


def _call(name: str, action: Callable[[], _Result]) -> _Result:
    try:
        return action()
    except Exception as error:  # noqa: BLE001  D-Bus, sockets and each backend raise their own kinds; all become ours
        _fail(name, error)


def _fail(name: str, error: Exception) -> NoReturn:
    from keyring.errors import InitError, KeyringLocked, NoKeyringError

    if isinstance(error, NoKeyringError):
        raise KeyringUnavailableError(
            "This machine has no keyring that is suitable for secrets.", hint=_INSTEAD
        ) from error
    if isinstance(error, KeyringLocked | InitError):
        raise VaultError(f"The keyring is locked and was not unlocked ({ALLOWED[name]}).", hint=_UNLOCK) from error
    raise VaultError(
        f"The keyring failed ({ALLOWED[name]}: {type(error).__name__}).", hint="Check that its service runs."
    ) from error
