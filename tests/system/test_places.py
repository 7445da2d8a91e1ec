"""What a scene's machine has in memory of its own, and what of the host it must still see."""

from __future__ import annotations

from pathlib import Path

import pytest

from .machine import in_memory


@pytest.mark.parametrize(
    ("checkout", "hidden"),
    [
        ("/work/main", ["/dev/shm", "/tmp", "/run"]),
        ("/tmp/checkout", ["/dev/shm", "/run"]),
        ("/dev/shm/checkout", ["/tmp", "/run"]),
        ("/tmpfiles/checkout", ["/dev/shm", "/tmp", "/run"]),
    ],
)
def test_a_checkout_in_a_temporary_folder_is_not_hidden(checkout: str, hidden: list[str]) -> None:
    assert in_memory(Path(checkout)) == hidden
