"""Master keys go from one process of a user to another one of the same user, and nowhere else."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from teds_provision.vault import master_socket
from teds_provision.vault.master import MasterKeys


def test_another_user_at_either_end_neither_gets_nor_gives_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, masters, came = threading.current_thread(), MasterKeys.generate(), list[dict[int, bytes]]()

    def accept(keys: MasterKeys) -> bool:
        came.append(dict(keys.keys))
        return True

    def handed_over(*, foreign_receiver: bool = False, foreign_sender: bool = False) -> bool | None:
        def user_at(_line: object) -> int:
            foreign = foreign_receiver if threading.current_thread() is here else foreign_sender
            return os.geteuid() + foreign

        monkeypatch.setattr(master_socket, "user_at", user_at)
        return master_socket.hand_over(tmp_path, masters)

    with master_socket.MasterSocket(tmp_path, accept):
        assert handed_over(foreign_receiver=True) is None
        assert not handed_over(foreign_sender=True)
        assert came == []
        assert handed_over() is True
    assert came == [dict(masters.keys)]
    assert not (tmp_path / master_socket.SOCKET).exists(), "a command would find a socket where no process listens"
