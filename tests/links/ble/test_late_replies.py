"""Which reply belongs to which command over the air: one that comes too late is nobody's.

The client of bleak is a stand-in here: no radio of a test delays a notification for longer than its command is waited
for.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

from teds_provision.links.ble.adapter import Adapter
from teds_provision.links.ble.connection import BleConnection
from teds_provision.protocol.messages import ble

MTU = 23
LATE, ANSWER = b"the reply to the command before", b"the reply to this one, which is longer than one frame"


class Client:
    """A connected node that notifies ``replies`` (transaction, message) once a command is whole."""

    is_connected = True

    def __init__(self, *replies: tuple[int, bytes]) -> None:
        self.replies = replies
        self.assembly = ble.BleAssembly(0xFFFF)
        self.services = SimpleNamespace(
            get_characteristic=lambda _uuid: SimpleNamespace(max_write_without_response_size=MTU - 3)
        )

    def frames(self) -> Iterator[bytes]:
        for transaction, message in self.replies:
            yield from ble.cut(transaction, message, MTU)

    async def write_gatt_char(self, _to: Any, frame: bytes, *, response: bool) -> None:
        assert response
        if self.assembly.add_frame(frame) is not None:
            for notified in self.frames():
                self.line._news.put_nowait(notified)

    def serve(self) -> BleConnection:
        self.line = BleConnection(cast(Adapter, SimpleNamespace()), "C0:00:00:00:00:01", lambda _number, _octets: None)
        self.line._client = cast(Any, self)
        return self.line


def test_a_reply_of_another_transaction_is_dropped() -> None:
    async def exchange() -> bytes:
        return await Client((6, LATE), (7, ANSWER)).serve().exchange(7, b"a command of some octets", 60)

    assert asyncio.run(exchange()) == ANSWER
