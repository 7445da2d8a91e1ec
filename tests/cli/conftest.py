from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.vault.selection import forget_vaults
from tests.bench import copy_home


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """Yield the home of a station with a passphrase vault at the lowest cost; every command unlocks it anew."""
    folder = tmp_path / "home"
    copy_home(folder)
    forget_vaults()
    yield folder
    forget_vaults()
