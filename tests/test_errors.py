"""The exception tree: what a message may be."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import teds_provision
from teds_provision import errors
from teds_provision.client import ApiError
from teds_provision.errors import EXIT_CODES, LinkError, NotFoundError, TedsProvisionError
from tests.parsed import walked


def test_an_unreadable_word_is_cut_in_the_middle() -> None:
    error = NotFoundError(f"No node is known as {'x' * 5000!r}, and no file.", hint="Look.")
    assert len(error.message) < 400
    assert error.message.startswith("No node is known as 'xxx")
    assert error.message.endswith(", and no file.")
    assert NotFoundError("y" * 512).message == "y" * 512, "paths and keys stay whole"


@pytest.mark.needs_room("plant")
def test_each_code_of_the_tree_has_an_exit_code_which_the_client_has_too() -> None:
    """Read from the sources: most rooms name errors of their own, and load much."""
    files = Path(teds_provision.__file__).parent.rglob("*.py")
    codes = {
        part.value.value
        for file in files
        for node in walked(file)
        if isinstance(node, ast.ClassDef) and node.name.endswith("Error")
        for part in node.body
        if isinstance(part, ast.Assign | ast.AnnAssign) and ast.unparse(part).startswith("code")
        if isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)
    }
    assert codes == EXIT_CODES.keys() - {"bad-request"}
    assert {code: ApiError(418, code, "").exit_code for code in EXIT_CODES} == EXIT_CODES


def test_an_error_whose_code_has_no_exit_code_cannot_be_defined() -> None:
    with pytest.raises(KeyError):
        type("OvenError", (LinkError,), {"code": "too-hot"})


CONTRACT = {
    1: "failed bug incomplete-installation",
    2: "usage unclear-item bad-request",
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
"""Table "exit" of docs/contract/cli.md, with the code of each error: scripts depend on both."""

CLASSES = {
    "InternalError": "bug",
    "IncompleteInstallationError": "incomplete-installation",
    "UsageError": "usage",
    "NotFoundError": "not-found",
    "NotAuthenticError": "not-authentic",
    "ForkError": "fork",
    "BadDatasheetError": "not-authentic",
    "LinkError": "link",
    "KeyStolenError": "link",
    "LinkClosedError": "link",
    "NoReaderError": "no-reader",
    "NoNodeError": "no-node",
    "NodeSilentError": "node-silent",
    "GarbledError": "garbled",
    "MessageTooLongError": "garbled",
    "AddressConflictError": "address-conflict",
    "RegistryError": "registry",
    "BoardLostError": "lost",
    "UnprovenError": "unproven",
    "PolicyError": "refused",
    "NotWhitelistedError": "not-whitelisted",
    "KeyMismatchError": "other-key",
    "KnownUuidError": "uuid-known",
    "FrozenError": "frozen",
    "DatasheetChangedError": "changed",
    "CalibrationMisfitError": "calibration-misfit",
    "NoRoomError": "no-room",
    "NotMemberError": "not-member",
    "RosterExpiredError": "roster-expired",
    "WrongImageError": "wrong-image",
    "NoUpdateError": "no-update",
    "DowngradeError": "downgrade",
    "RevertedError": "reverted",
    "NodeRefusedError": "node-refused",
    "StoreError": "store",
    "StoreChangedError": "store-changed",
    "NewerStoreError": "newer-store",
    "StoreLockedError": "store-locked",
    "NodeBusyError": "node-busy",
    "VaultError": "vault",
    "KeyringUnavailableError": "no-keyring",
    "UnknownMasterKeyError": "vault",
    "VaultChangedError": "vault-changed",
    "VaultLockedError": "vault-locked",
    "NoPassphraseError": "no-passphrase",
    "WrongPassphraseError": "wrong-passphrase",
    "BadDataError": "bad-data",
}


def test_each_code_ends_with_the_exit_code_of_the_contract() -> None:
    expected = {code: exit_code for exit_code, codes in CONTRACT.items() for code in codes.split()}
    assert dict(EXIT_CODES) == expected
    tree = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, TedsProvisionError)]
    found = {kind.__name__: kind for kind in tree}
    assert {name: kind.code for name, kind in found.items() if name != "TedsProvisionError"} == CLASSES
    assert {name: kind.exit_code for name, kind in found.items()} == {
        name: expected[kind.code] for name, kind in found.items()
    }
