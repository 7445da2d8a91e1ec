"""An SMP client of others (smpclient, Intercreate) updates a virtual node through our session as its transport."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from smpclient import SMPClient
from smpclient.generics import success
from smpclient.requests.image_management import ImageStatesRead, ImageStatesWrite
from smpclient.requests.os_management import BootloaderInformationRead, EchoWrite, ResetWrite

from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.messages.smp import MANAGE_OVERHEAD
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.conversation import Conversation
from tests.provisioning.update_bench import Owner, UpdateBench


class SessionTransport:
    """A transport of smpclient: one packet out, one back, sealed in the session of a conversation."""

    def __init__(self, node: Conversation) -> None:
        self._node, self._reply = node, b""
        self._largest = node.identity.max_message - MANAGE_OVERHEAD

    async def connect(self, address: str, timeout_s: float) -> None:
        del address, timeout_s

    async def disconnect(self) -> None:
        pass

    async def send(self, data: bytes) -> None:
        self._reply = self._node.request(security_command(Function.MANAGE, data), "an SMP packet")

    async def receive(self) -> bytes:
        return self._reply

    async def send_and_receive(self, data: bytes) -> bytes:
        await self.send(data)
        return await self.receive()

    def initialize(self, smp_server_transport_buffer_size: int) -> None:
        self._largest = min(self._largest, smp_server_transport_buffer_size)

    @property
    def mtu(self) -> int:
        return self._largest

    @property
    def max_unencoded_size(self) -> int:
        return self._largest


@pytest.fixture
def bench(tmp_path: Path) -> UpdateBench:
    return UpdateBench.copy_of(Owner(tmp_path / "owner"), tmp_path / "bench")


def test_a_client_of_others_uploads_tries_and_confirms(bench: UpdateBench) -> None:
    image = bench.owner.long

    async def update() -> None:
        with Conversation(bench.contact(), notice=lambda notice: None) as node:
            bench.station.unlock()
            require_session(bench.station, node)
            client = SMPClient(SessionTransport(node), "session")  # type: ignore[arg-type]
            await client.connect()
            echo = await client.request(EchoWrite(d="hello"))
            assert success(echo)
            assert echo.r == "hello"
            loader = await client.request(BootloaderInformationRead())
            assert success(loader)
            assert loader.bootloader == "MCUboot"
            states = await client.request(ImageStatesRead())
            assert success(states)
            assert [(state.version, state.active, state.confirmed) for state in states.images] == [
                ("1.0.0", True, True)
            ]
            offsets = [offset async for offset in client.upload(image.octets)]
            assert offsets[-1] == len(image.octets)
            started = await client.request(ImageStatesWrite(hash=image.digest))
            assert success(started)
            assert started.images[1].pending
            assert success(await client.request(ResetWrite()))
        with Conversation(bench.contact(), notice=lambda notice: None) as node:
            require_session(bench.station, node)
            client = SMPClient(SessionTransport(node), "session")  # type: ignore[arg-type]
            await client.connect()
            confirmed = await client.request(ImageStatesWrite(confirm=True))
            assert success(confirmed)
            assert [(state.version, state.confirmed) for state in confirmed.images[:1]] == [("1.2.0", True)]

    asyncio.run(update())
    assert bench.runs == ("1.2.0", False, False)
