"""Master keys go from one process of a user to another one of the same user, and nowhere else."""

from __future__ import annotations

import os
import socket
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from teds_provision.files import short_path
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


KEY = "ab" * 32


@pytest.mark.parametrize(
    ("request_", "answer", "keys"),
    [
        (f'{{"1": "{KEY}", "2": "{KEY}"}}', b"Y", {1: bytes.fromhex(KEY), 2: bytes.fromhex(KEY)}),
        (f'{{"3": "{KEY}"}}', b"N", {3: bytes.fromhex(KEY)}),  # refused by who receives it
        ("{}", b"N", None),
        ("[]", b"N", None),
        ("3", b"N", None),
        ("", b"N", None),
        ("{", b"N", None),
        ("[" * 60_000, b"N", None),
        (f'{{"one": "{KEY}"}}', b"N", None),
        ('{"1": 5}', b"N", None),
        ('{"1": "0g"}', b"N", None),
        (f'{{"1": "{KEY}00"}}', b"N", None),
        (f'{{"1": "{KEY}", "2": "{KEY[2:]}"}}', b"N", None),
        (f'{{"1": "{KEY}"' + " " * (64 * 1024 - 73) + "}", b"Y", {1: bytes.fromhex(KEY)}),
        (f'{{"1": "{KEY}"' + " " * (64 * 1024 - 72) + "}", b"N", None),
    ],
    ids=lambda part: part[:12] if isinstance(part, str) else None,
)
def test_a_request_holds_keys_of_32_octets_by_number_and_nothing_else(
    tmp_path: Path, request_: str, answer: bytes, keys: dict[int, bytes] | None
) -> None:
    """At most 64 KiB; one octet comes back: Y if the keys are used from now on, N if not."""
    came: list[dict[int, bytes]] = []

    def accept(masters: MasterKeys) -> bool:
        came.append(dict(masters.keys))
        return 3 not in masters.keys

    with (
        master_socket.MasterSocket(tmp_path, accept),
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line,
        short_path(tmp_path / master_socket.SOCKET) as name,
    ):
        line.connect(name)
        with suppress(BrokenPipeError, ConnectionResetError):
            line.sendall(request_.encode())
            line.shutdown(socket.SHUT_WR)
            assert line.recv(8) == answer
    assert came == ([] if keys is None else [keys])


def test_a_system_that_does_not_name_the_peer_of_a_socket_receives_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(socket, "SO_PEERCRED")
    with master_socket.MasterSocket(tmp_path, lambda _: True):
        assert list(tmp_path.iterdir()) == []
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other,
        short_path(tmp_path / master_socket.SOCKET) as name,
    ):
        other.bind(name)
        other.listen()
        assert master_socket.hand_over(tmp_path, MasterKeys.generate()) is None, "nor is anything given to a listener"
