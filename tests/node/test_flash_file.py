"""A virtual node's flash: taken by one process before it is read, and told plainly where it cannot be used."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import BadData, NotFound, StoreFailure, StoreLocked
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.virtual import Delays, VirtualNode
from teds_provision.protocol.agreement import StationAgreement
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.session import StationSession
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from ..protocol.desk import CREDENTIALS, UUID, Desk


def test_a_running_node_is_refused_to_another_process(tmp_path: Path) -> None:
    FlashFile.create(tmp_path / "node")
    running = VirtualNode(tmp_path / "node", exclusive=True)
    with pytest.raises(StoreLocked):
        VirtualNode(tmp_path / "node", exclusive=True)
    running.flash_file.release()
    VirtualNode(tmp_path / "node", exclusive=True).flash_file.release()


def test_what_was_committed_before_the_node_was_taken_is_what_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last commit of the process before happens while this one is starting."""
    import fcntl

    before = FlashFile.create(tmp_path / "node")
    take = fcntl.flock

    def late(descriptor: int, how: int) -> None:
        monkeypatch.setattr(fcntl, "flock", take)  # a commit takes a lock too
        before.commit(replace(before.load(), epoch=7))
        take(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    node = VirtualNode(tmp_path / "node", exclusive=True)
    assert node.tim.flash.epoch == 7
    node.flash_file.release()


@pytest.mark.parametrize("document", ["", "[]", "{}", '{"format": "teds-virtual-node/1"}', "damaged key"])
def test_a_damaged_flash_is_bad_data(tmp_path: Path, document: str) -> None:
    path = FlashFile.create(tmp_path / "node").path
    if document == "damaged key":
        document = json.dumps(json.loads(path.read_text()) | {"key": "00" * 32})
    path.write_text(document)
    with pytest.raises(BadData):
        FlashFile(tmp_path / "node")


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreFailure, match="cannot be used"):
        FlashFile.create(tmp_path / "file" / "node")
    with pytest.raises(NotFound):
        FlashFile(tmp_path / "nothing", exclusive=True)


@pytest.mark.parametrize("older", ["teds-virtual-node/1", "teds-virtual-node/2"])
def test_a_flash_of_key_agreement_1_wakes_in_factory_state_with_its_identity(tmp_path: Path, older: str) -> None:
    desk = Desk().provision()
    path = FlashFile.create(tmp_path / "node", uuid=UUID).path
    made = FlashFile(tmp_path / "node")
    made.commit(replace(desk.flash, node_key=made.key.point, can_address=77))
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "format": older}))

    migrated = FlashFile(tmp_path / "node")
    state = migrated.load()
    assert (state.state, state.key, state.ca, state.station) == (NodeState.FACTORY, None, None, None)
    assert (state.uuid, state.epoch, state.sequence, state.can_address) == (UUID, 1, 1, 77)
    assert migrated.key.point == made.key.point
    assert state.blocks == {block: teds for block, teds in desk.flash.blocks.items() if block != SECURITY}
    shown = security.decode(state.security_teds())
    assert (shown.values, shown.signed) == (security.OUR_VALUES, False)
    migrated.commit(replace(state, sequence=2))
    assert json.loads(path.read_text())["format"] == "teds-virtual-node/3"
    assert FlashFile(tmp_path / "node").load() == replace(state, sequence=2)


def test_an_open_costs_a_slow_node_an_ecdh_and_what_is_left_of_a_key_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr("teds_provision.node.virtual.time.sleep", slept.append)
    made = FlashFile.create(tmp_path / "node", uuid=UUID)
    made.commit(replace(made.load(), key=bytes(16), epoch=1))
    slept.clear()
    node, session = VirtualNode(tmp_path / "node", delays=Delays(crypto=0.25)), StationSession(bytes(16), UUID)
    counter = decode_reply(node.request("nfc", session.ask().encode(), tapped=True)).payload
    assert slept == [], "asking for c costs nothing"
    session.accept(decode_reply(node.request("nfc", session.open(counter).encode(), tapped=True)).payload)
    pair, ecdh = slept
    assert 0 < pair <= 0.25, "the chip began with the key pair at the node's start"
    assert ecdh == 0.25


def test_every_point_operation_of_an_agreement_and_a_proof_is_slow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr("teds_provision.node.virtual.time.sleep", slept.append)
    FlashFile.create(tmp_path / "node", uuid=UUID)
    node = VirtualNode(tmp_path / "node", delays=Delays(crypto=0.25))
    request = StationAgreement(CREDENTIALS, UUID).request().encode()
    assert decode_reply(node.request("nfc", request, tapped=True)).ok
    pair = slept.pop(1)
    assert 0 < pair <= 0.25, "the chip began with the one-time key pair at its start"
    assert slept == [0.25] * 4, "SIG104 is checked, two ECDH, and sigN"
    prove = security_command(Function.PROVE, bytes(32)).encode()
    assert decode_reply(node.request("nfc", prove, tapped=True)).ok
    assert slept == [0.25] * 5
