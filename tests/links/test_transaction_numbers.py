"""Transaction numbers of the three links: the first of a process is random, then each is one more (wire.md, "CAN")."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.links.ble import port as ble_port
from teds_provision.links.can import port as can_port
from teds_provision.links.nfc import port as nfc_port


def can() -> Any:
    return can_port.CanPort("virtual:transactions")


def ble() -> Any:
    return ble_port.BlePort("hci0")


def nfc() -> Any:
    return nfc_port.NfcPort("udp:localhost:1")


@pytest.mark.parametrize(("opened", "most"), [(can, 256), (ble, 65536), (nfc, 65536)])
def test_the_first_of_a_process_is_random_and_the_last_is_followed_by_0(
    monkeypatch: pytest.MonkeyPatch, opened: Callable[[], Any], most: int
) -> None:
    """A fixed one would meet the reply that the node stored for the process before."""
    reader = SimpleNamespace(again="udp:localhost:1", name="a reader", close=lambda: None)
    monkeypatch.setattr(nfc_port, "open_reader", lambda *_: reader)
    drawn = iter((200, most - 2))
    monkeypatch.setattr(secrets, "randbelow", lambda limit: {most: next(drawn)}[limit])
    for expected in ([201, 202, 203], [most - 1, 0, 1]):
        port = opened()
        assert [port.next_transaction() for _ in range(3)] == expected
        port.close()
