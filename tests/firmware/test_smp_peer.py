"""An SMP client in Rust updates the host port through our session; the rest of its commands do not pass."""

from __future__ import annotations

from pathlib import Path

from teds_provision.protocol.messages.frames import Command, Function
from tests.firmware.mcuboot import digest_of
from tests.firmware.test_host_updates import NEW, SETTLED, Bench, bench
from tests.strangers.smp_peer import PASSED, PEER, run_client

__all__ = ["bench"]
pytestmark = PEER


def test_a_client_in_rust_updates_a_node_in_c(bench: Bench, tmp_path: Path) -> None:
    image = tmp_path / "new.bin"
    image.write_bytes(NEW)
    bench.start().agree().open()

    def ask(packet: bytes) -> tuple[bool, int, bytes]:
        reply = bench.sealed(Command(0, 128, Function.MANAGE, packet))
        return reply.ok, reply.reason, reply.payload

    gave = run_client(ask, image, "before")
    assert gave.pop("buffer") == 971
    assert gave.pop("images") == [[0, "1.0.0", True, False], [1, "1.2.3.45", False, True]]
    assert gave.pop("try") == ["1.0.0", "1.2.3.45"]
    assert gave == PASSED
    bench.wait_for_restart()
    bench.open()
    assert run_client(ask, image, "after")["images"][0] == [0, "1.2.3.45", True, False]
    assert (bench.about().image, bench.about().flags) == (digest_of(NEW), SETTLED)
