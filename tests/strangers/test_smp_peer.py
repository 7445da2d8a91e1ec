"""An SMP client in Rust updates a virtual node through our session; the rest of its commands do not pass."""

from __future__ import annotations

from pathlib import Path

from teds_provision.errors import NodeRefusedError
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.conversation import Conversation
from tests.provisioning.update_bench import Owner, UpdateBench
from tests.strangers.smp_peer import PASSED, PEER, Ask, run_client

pytestmark = PEER


def in_session(node: Conversation) -> Ask:
    def ask(packet: bytes) -> tuple[bool, int, bytes]:
        try:
            return True, 0, node.request(security_command(Function.MANAGE, packet), "an SMP packet")
        except NodeRefusedError as refusal:
            return False, refusal.reason, b""

    return ask


def test_a_client_in_rust_updates_a_virtual_node(tmp_path: Path) -> None:
    bench = UpdateBench.copy_of(Owner(tmp_path / "owner"), tmp_path / "bench")
    image = tmp_path / "new.bin"
    image.write_bytes(bench.owner.long.octets)
    bench.station.unlock()
    with Conversation(bench.contact(), notice=lambda notice: None) as node:
        require_session(bench.station, node)
        gave = run_client(in_session(node), image, "before")
    assert gave.pop("buffer") > 512
    assert gave.pop("images") == [[0, "1.0.0", True, False], [1, "1.2.0", False, True]]
    assert gave.pop("try") == ["1.0.0", "1.2.0"]
    assert gave == PASSED
    assert bench.runs == ("1.2.0", True, False)
    with Conversation(bench.contact(), notice=lambda notice: None) as node:
        require_session(bench.station, node)
        assert run_client(in_session(node), image, "after")["images"][0] == [0, "1.2.0", True, False]
    assert bench.runs == ("1.2.0", False, False)
    bench.close()
