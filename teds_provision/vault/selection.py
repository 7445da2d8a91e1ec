"""Chooses a station's vault once, at ``init``, and opens it once per process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

from teds_provision.errors import UsageError, VaultChangedError, VaultError, WrongPassphraseError
from teds_provision.lazy import late
from teds_provision.vault import agent
from teds_provision.vault.base import LAST_ATTEMPT, Ask, Vault
from teds_provision.vault.hardening import harden
from teds_provision.vault.passphrase import PRODUCT, Costs

if TYPE_CHECKING:
    from teds_provision.vault import file_vault, keyring_vault, pkcs11
else:  # a station uses only one of them, and argon2, keyring and python-pkcs11 are slow to import
    file_vault, keyring_vault = late("teds_provision.vault.file_vault"), late("teds_provision.vault.keyring_vault")
    pkcs11 = late("teds_provision.vault.pkcs11")

_opened: dict[tuple[Path, str, str], Vault] = {}
_Made = TypeVar("_Made")
_FILE_EXISTS: Final = "the passphrase file already exists"
_KEYRING_AVAILABLE: Final = "an OS keyring is available"


class _QuestionNeededError(Exception):
    """An operator has to be asked first."""

    def __init__(self, prompt: str, confirm: bool) -> None:
        super().__init__(prompt)
        self.question = prompt, confirm


def asked_first(ask: Ask, work: Callable[[Ask], _Made]) -> _Made:
    """Do ``work``, which takes a lock and may need a passphrase inside it, without that lock while an operator types.

    It receives an ``ask`` that knows the answers given so far. At an open question ``work`` is abandoned, the operator
    is asked, and it starts over: so it must change nothing before its questions, and reread what it asks about. Changes
    by another process meanwhile lead to other questions, not to an old answer.
    """
    answers: dict[tuple[str, bool], str] = {}

    def known(prompt: str, confirm: bool) -> str:
        if (prompt, confirm) not in answers:
            raise _QuestionNeededError(prompt, confirm)
        return answers[prompt, confirm]

    while True:
        try:
            return work(known)
        except _QuestionNeededError as unasked:
            answers[unasked.question] = ask(*unasked.question)


def create_vault(
    home: Path,
    store_id: str,
    keystore: str | None,
    ask: Ask,
    *,
    costs: Costs = PRODUCT,
    restored: str | None = None,
    with_ca: bool = True,
    notify: Callable[[str], object] = lambda text: None,
) -> tuple[Vault, str]:
    """Make the vault of a station, or open the one that an earlier run made; return it and the reason for the choice.

    ``notify`` gets reason, place and duration before a new passphrase is asked for. The caller holds the
    store, and does not wait for typing meanwhile (:func:`asked_first`).

    ``keystore`` is ``keyring``, ``file``, ``pkcs11:…`` (RFC 7512) or None: then the keyring if one works (proven by a
    set, a read back and a delete), else a passphrase file. ``costs`` are those of a new passphrase file, ``restored``
    the secret material of a backup; ``with_ca`` False makes no CA key. Raises VaultError (leaves too), UsageError.
    """
    harden()

    def asked(prompt: str, confirm: bool) -> str:
        if confirm:
            notify(
                f"{'' if keystore else 'No OS keyring was found. '}The station's keys will be stored in"
                f" {home / 'vault.json'}, encrypted with a passphrase. Commands that use a key ask for it; after"
                " teds-provision unlock they don't for a while. If you lose it, you can only restore from a backup."
                " At least 8 characters; four random words are good. This takes about a second."
            )
        return ask(prompt, confirm)

    vault, why = _create(home, store_id, keystore, asked, costs, restored, with_ca=with_ca)
    if not with_ca and restored is None:
        vault.drop_ca()  # the CA key was just made and has not been used
    _opened[home.resolve(), store_id, keystore if keystore and vault.kind == "pkcs11" else vault.kind] = vault
    return vault, why


def plan_vault(home: Path, keystore: str | None) -> tuple[str, str]:
    """Return the keystore that :func:`create_vault` would choose, and why; makes nothing and asks for nothing.

    Raises KeyringUnavailableError, VaultError (a requested keyring that does not work), UsageError.
    """
    if keystore is not None:
        if keystore == "keyring":
            keyring_vault.inspect()
        elif keystore != "file" and not keystore.startswith("pkcs11:"):
            raise _unknown(keystore)
        return keystore, "as requested"
    if (home / file_vault.FILE_NAME).exists():
        return "file", _FILE_EXISTS
    try:
        keyring_vault.inspect()
    except VaultError as failure:
        return "file", _no_keyring(failure)
    return "keyring", _KEYRING_AVAILABLE


def open_vault(home: Path, store_id: str, keystore: str, ask: Ask, *, use_agent: bool = False) -> Vault:
    """Open the vault of a station; a second call in one process returns the same vault, refreshed.

    With ``use_agent`` there is no question while ``unlock`` holds it open. Raises VaultError and its leaves: locked,
    missing, damaged, wrong passphrase.
    """
    harden()
    place = (home.resolve(), store_id, keystore)
    vault, changed = _opened.get(place), None
    if vault is not None:
        try:
            vault.refresh()
            return vault
        except VaultChangedError as failure:  # the passphrase was changed, so ask for the new one
            changed = failure
    try:
        _opened[place] = vault = _open(home, store_id, keystore, ask, use_agent=use_agent)
    except WrongPassphraseError:
        if changed is not None:  # the passphrase was right until it was changed
            raise changed from None
        raise
    return vault


def forget_vaults() -> None:
    """Drop every vault that this process has unlocked."""
    _opened.clear()


def _create(
    home: Path,
    store_id: str,
    keystore: str | None,
    ask: Ask,
    costs: Costs,
    restored: str | None,
    *,
    with_ca: bool,
) -> tuple[Vault, str]:
    if keystore is not None and keystore.startswith("pkcs11:"):
        return pkcs11.Pkcs11Vault.create(
            home, store_id, keystore, ask, restored=restored, with_ca=with_ca
        ), "as requested"
    if keystore == "keyring":
        return keyring_vault.KeyringVault.create(store_id, restored=restored), "as requested"
    if keystore == "file":
        vault = file_vault.FileVault.create(home, store_id, ask, costs=costs, restored=restored)
        return vault, "as requested"
    if keystore is not None:
        raise _unknown(keystore)
    if (home / file_vault.FILE_NAME).exists():
        return file_vault.FileVault.create(home, store_id, ask, restored=restored), _FILE_EXISTS
    try:
        return keyring_vault.KeyringVault.create(store_id, restored=restored), _KEYRING_AVAILABLE
    except VaultError as failure:
        why = _no_keyring(failure)
    return file_vault.FileVault.create(home, store_id, ask, costs=costs, restored=restored), why


def _open(home: Path, store_id: str, keystore: str, ask: Ask, *, use_agent: bool) -> Vault:
    if keystore == "file":
        return file_vault.FileVault.open(home, store_id, ask, held=agent.held(home, "file") if use_agent else None)
    if keystore == "keyring":
        return keyring_vault.KeyringVault.open(store_id)
    if keystore.startswith("pkcs11:"):
        pin = agent.held(home, "pkcs11") if use_agent else None
        if pin is not None:
            try:
                return pkcs11.Pkcs11Vault.open(home, store_id, keystore, _holding(pin, ask))
            except WrongPassphraseError:  # the PIN was changed: a second try could lock the token
                agent.lock(home)
                raise
        return pkcs11.Pkcs11Vault.open(home, store_id, keystore, ask)
    raise _unknown(keystore)


def _unknown(keystore: str) -> UsageError:
    return UsageError(f"There is no keystore {keystore!r}.", hint="Use keyring, file or pkcs11:URI.")


def _no_keyring(failure: VaultError) -> str:
    return f"no OS keyring: {failure.message[:1].lower()}{failure.message[1:].rstrip('.')}"


def _holding(pin: bytes, ask: Ask) -> Ask:
    """Give the PIN that is held, unless the token has one try left: that is for a person."""

    def give(prompt: str, confirm: bool) -> str:
        return ask(prompt, confirm) if LAST_ATTEMPT in prompt else pin.decode()

    return give
