"""The one exception tree of the tool.

Every error that a user can meet is a :class:`TedsProvisionError`. Its class fixes the stable word that ``--json``
reports as ``code``, from which the exit code of the command line follows (:data:`EXIT_CODES`; table "exit" of the
command-line contract); the instance carries a one-sentence message (what happened and why) and a hint (what to do
next). A foreign exception that escapes is a bug and ends with exit 1.

This module is below every room and imports nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Final

_CODES: Final = {
    1: "failed bug incomplete-installation",
    2: "usage unclear-item bad-request",  # bad-request is used only by the API
    3: "not-found",
    4: "not-authentic fork",
    5: "link no-reader no-node node-silent garbled address-conflict registry lost unproven no-answer",
    6: "refused not-whitelisted other-key uuid-known frozen changed calibration-misfit no-room not-member"
    " roster-expired wrong-image no-update downgrade reverted node-refused conflict declined firmware not-adopted"
    " not-named office-refused wrong-board",
    7: "store store-changed newer-store store-locked node-busy vault no-keyring vault-changed vault-locked"
    " no-passphrase wrong-passphrase",
    8: "bad-data missing-field newer-format not-canonical",
}
EXIT_CODES: Final[Mapping[str, int]] = MappingProxyType(
    {code: exit_code for exit_code, codes in _CODES.items() for code in codes.split()}
)
"""Exit code of the command line for each error's code, here alone: the classes and ``client`` take theirs from it."""

_LONG_WORD: Final = r"\S{513,}"
"""Longest word that is shown whole: longer than any path or key that a person reads."""


def _shortened(text: str) -> str:
    """Return the text with the middle left out of words that are too long to be read; an error has three lines."""
    return re.sub(_LONG_WORD, lambda word: f"{word[0][:200]}[…]{word[0][-40:]}", text)


class TedsProvisionError(Exception):
    """Root of the tree; raised itself only for failures that fit nothing below (exit 1)."""

    code: ClassVar[str] = "failed"
    exit_code: ClassVar[int] = EXIT_CODES[code]

    def __init_subclass__(cls, **settings: Any) -> None:
        """Give a class the exit code of its ``code``."""
        super().__init_subclass__(**settings)
        cls.exit_code = EXIT_CODES[cls.code]

    def __init__(self, message: str, *, hint: str = "") -> None:
        self.message = _shortened(message)
        super().__init__(self.message)
        self.hint = hint


class InternalError(TedsProvisionError):
    """A foreign exception that would otherwise end a thread silently (exit 1)."""

    code = "bug"


class IncompleteInstallationError(TedsProvisionError):
    """A package that the tool requires is not installed (exit 1)."""

    code = "incomplete-installation"


class UsageError(TedsProvisionError):
    """The command line itself is wrong (exit 2)."""

    code = "usage"


class NotFoundError(TedsProvisionError):
    """No such UUID, profile, station or file (exit 3)."""

    code = "not-found"


class NotAuthenticError(TedsProvisionError):
    """A signature, tag, digest or sender is not what it claims to be (exit 4)."""

    code = "not-authentic"


class ForkError(NotAuthenticError):
    """The registry has pages under this station's key that do not go on from those here."""

    code = "fork"


class BadDatasheetError(NotAuthenticError):
    """A datasheet that was read is not authentic: no disturbed frame, which another try would cure."""


class LinkError(TedsProvisionError):
    """The way to the node failed: no reader, no node, unplugged, garbled, bus-off (exit 5)."""

    code = "link"


class KeyStolenError(LinkError):
    """A session ended because a thief has its key; the next one begins with a new key."""


class LinkClosedError(LinkError):
    """The command closed the bus itself, as after Ctrl-C: nothing is tried again."""


class NoReaderError(LinkError):
    """The reader or the CAN adapter cannot be opened."""

    code = "no-reader"


class NoNodeError(LinkError):
    """Nothing that answers as a node came within the time allowed."""

    code = "no-node"


class NodeSilentError(LinkError):
    """A node that was there does not answer any more (moved away, time-out, power lost)."""

    code = "node-silent"


class GarbledError(LinkError):
    """A message over the link is torn, corrupt or breaks the wire format."""

    code = "garbled"


class MessageTooLongError(GarbledError):
    """The node refuses a message on the level of the link because of its length."""


class AddressConflictError(LinkError):
    """Two nodes answer under one CAN address, or one UUID at two."""

    code = "address-conflict"


class RegistryError(LinkError):
    """The registry cannot be reached, or refuses the login."""

    code = "registry"


class BoardLostError(LinkError):
    """A board did not come back after the restart with new firmware."""

    code = "lost"


class UnprovenError(LinkError):
    """A key of the node is held here and no session came about, so nothing that was read counts."""

    code = "unproven"


class PolicyError(TedsProvisionError):
    """Refused by policy: not whitelisted, other key, weak algorithm, stale, expired, replayed (exit 6)."""

    code = "refused"


class NotWhitelistedError(PolicyError):
    """The node is not on the whitelist."""

    code = "not-whitelisted"


class KeyMismatchError(PolicyError):
    """A known UUID came with another identity key than the pinned one."""

    code = "other-key"


class KnownUuidError(PolicyError):
    """A new node would have the UUID of a node that the station or its bus has already."""

    code = "uuid-known"


class FrozenError(PolicyError):
    """Something is being measured and stays as it is until that ends."""

    code = "frozen"


class DatasheetChangedError(PolicyError):
    """A node has another datasheet by now than the one that a change was reviewed against."""

    code = "changed"


class CalibrationMisfitError(PolicyError):
    """A calibration that a node has does not fit the channel that it would be kept for."""

    code = "calibration-misfit"


class NoRoomError(PolicyError):
    """The bus, or the budget of messages, has no room for a node's data."""

    code = "no-room"


class NotMemberError(PolicyError):
    """The station is no member of the registry, or none any more."""

    code = "not-member"


class RosterExpiredError(PolicyError):
    """The roster is older than the owner's CA allows."""

    code = "roster-expired"


class WrongImageError(PolicyError):
    """A firmware image does not name the board that it is for."""

    code = "wrong-image"


class NoUpdateError(PolicyError):
    """A board takes no firmware over its session."""

    code = "no-update"


class DowngradeError(PolicyError):
    """A firmware image is older than what runs."""

    code = "downgrade"


class RevertedError(PolicyError):
    """A new firmware image did not prove itself, and the board runs its old one again."""

    code = "reverted"


class NodeRefusedError(PolicyError):
    """The node refused a command; ``reason`` is the u8 of profile.md, "Reasons".

    ``sealed``: the refusal came in a session, under the node's key. Any device on the link can send another one.
    """

    code = "node-refused"

    def __init__(self, message: str, *, reason: int, hint: str = "", sealed: bool = False) -> None:
        super().__init__(message, hint=hint)
        self.reason = reason
        self.sealed = sealed


class StoreError(TedsProvisionError):
    """Store or vault: locked, corrupt, missing (exit 7)."""

    code = "store"


class StoreChangedError(StoreError):
    """Another program changed a row that decides whom the station believes."""

    code = "store-changed"


class NewerStoreError(StoreError):
    """The store has a schema that only a newer version of this tool knows."""

    code = "newer-store"


class StoreLockedError(StoreError):
    """Another process holds the store."""

    code = "store-locked"


class NodeBusyError(StoreLockedError):
    """Another command or request of this station works on the node."""

    code = "node-busy"


class VaultError(StoreError):
    """The keyring, token or passphrase file cannot give what it should."""

    code = "vault"


class KeyringUnavailableError(VaultError):
    """No keyring of the machine may hold a secret."""

    code = "no-keyring"


class UnknownMasterKeyError(VaultError):
    """A key is wrapped under a master key that an open vault does not have (any more, or yet)."""


class VaultChangedError(VaultError):
    """The question that an operator answered is obsolete: another command changed the vault meanwhile."""

    code = "vault-changed"


class VaultLockedError(VaultChangedError):
    """Another command changed passphrase and master key, and this process cannot open the vault again by itself."""

    code = "vault-locked"


class NoPassphraseError(VaultError):
    """A passphrase or PIN is needed, and there is no terminal to ask at."""

    code = "no-passphrase"


class WrongPassphraseError(VaultError):
    """The passphrase or PIN does not open the vault."""

    code = "wrong-passphrase"


class BadDataError(TedsProvisionError):
    """TEDS, profile, calibration, image or bundle that does not parse or does not add up (exit 8)."""

    code = "bad-data"
