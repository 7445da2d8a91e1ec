from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.vault.passphrase import STORE, Person


@pytest.fixture(autouse=True)
def _locked_again() -> Iterator[None]:
    forget_vaults()
    yield
    forget_vaults()


@pytest.fixture
def vault(tmp_path: Path) -> FileVault:
    return FileVault.create(tmp_path, STORE, Person(), costs=THROWAWAY)
