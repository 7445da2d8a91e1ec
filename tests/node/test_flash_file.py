"""A virtual node's flash: taken by one process before it is read, and told plainly where it cannot be used."""

from __future__ import annotations

import itertools
import json
import os
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, cast

import pytest

from teds_provision.errors import BadDataError, NotFoundError, StoreError, StoreLockedError, UsageError
from teds_provision.files import whole_file
from teds_provision.node import flash_file
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.virtual import Delays, VirtualNode
from teds_provision.protocol.flash import FlashError
from teds_provision.protocol.keys import verify
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from ..protocol.desk import CREDENTIALS, UUID, Desk


@dataclass
class BadDisk:
    """A file that takes what is written and has something else: cut short, or with one octet changed."""

    file: BinaryIO
    what: str

    def write(self, octets: bytes) -> int:
        self.file.write(octets[:-3] if self.what == "cut" else octets[:99] + b"?" + octets[100:])
        return len(octets)

    def seek(self, at: int) -> int:
        return self.file.seek(at)

    def read(self) -> bytes:
        return self.file.read()


@pytest.mark.parametrize("what", ["cut", "garbled"])
def test_what_the_disk_took_and_reads_back_as_something_else_takes_no_place_of_the_old_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    flash = FlashFile.create(tmp_path / "node")
    before, octets = flash.load(), flash.path.read_bytes()

    @contextmanager
    def bad_disk(path: Path, *, replace: bool) -> Iterator[BinaryIO]:
        with whole_file(path, replace=replace) as file:
            yield cast(BinaryIO, BadDisk(file, what))

    monkeypatch.setattr(flash_file, "whole_file", bad_disk)
    with pytest.raises(FlashError):
        flash.commit(replace(before, epoch=9))
    assert (flash.load(), flash.path.read_bytes()) == (before, octets)
    monkeypatch.undo()
    flash.commit(replace(before, epoch=9))
    assert FlashFile(tmp_path / "node").load().epoch == 9


def test_the_file_is_replaced_whole_or_not_replaced(tmp_path: Path) -> None:
    """The process is killed at each call that changes the folder: the old state or the new one, never a part."""
    flash = FlashFile.create(tmp_path / "node")
    before = flash.load()
    after = replace(before, epoch=before.epoch + 1)
    seen = set()
    for call in range(1, 40):
        child = os.fork()
        if child == 0:
            _die_at(call, tmp_path / "node")
            flash.commit(after)
            os._exit(0)
        died = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
        now = FlashFile(tmp_path / "node").load()
        assert now in (before, after), call
        seen.add(now.epoch)
        if not died:
            break
        for draft in flash.path.parent.glob(".*"):
            draft.unlink()  # a left-over draft is looked at by the next commit
        flash.commit(before)
    else:
        pytest.fail("it never came to its end")
    assert seen == {before.epoch, after.epoch}


def _die_at(call: int, folder: Path) -> None:
    """Have this process end at its ``call``-th call from now on that names a file of ``folder``."""
    calls = itertools.count(1)

    def step(event: str, arguments: tuple[object, ...]) -> None:
        if str(folder) in str(arguments) and next(calls) == call:
            os._exit(9)

    sys.addaudithook(step)


def test_the_whole_file_of_a_node(tmp_path: Path) -> None:
    folder, teds = tmp_path / "a" / "node", {(1, 3): b"abc", (0, 1): b"\x01\x02"}
    firmware = FirmwareReport("desk/board", (1, 2, 3), 4, bytes(range(32)), FirmwareFlag.LOCATE)
    made = FlashFile.create(
        folder, uuid=UUID, name="left", max_message=512, blocks=teds, read_only=frozenset({(1, 3)}), firmware=firmware
    )
    key = made.key
    assert json.loads(made.path.read_text()) == {
        "format": "teds-virtual-node/3",
        "name": "left",
        "max_message": 512,
        "key": key.secret().hex(),
        "hardware": [[0, 1, "0102"], [1, 3, "616263"]],
        "firmware": {
            "text": "desk/board", "version": "1.2.3", "build": 4, "image": bytes(range(32)).hex(), "flags": ["locate"]
        },
        "flash": {
            "uuid": UUID.hex(),
            "node_key": key.point.hex(),
            "node_key_signature": made.load().node_key_signature.hex(),
            "blocks": [[0, 1, "0102"], [1, 3, "616263"]],
            "read_only": [[1, 3]],
            "epoch": 0,
            "sequence": 0,
            "key": None,
            "station": None,
            "ca": None,
            "provisioned": False,
            "can_address": 1 + zlib.crc32(UUID) % 239,
        },
    }  # fmt: skip
    assert verify(key.point, b"TEDS1 node key\0" + UUID + key.point, made.load().node_key_signature)
    assert (folder.stat().st_mode & 0o777, made.path.stat().st_mode & 0o777) == (0o700, 0o600)
    later = replace(
        made.load(), blocks={(0, 1): b"new"}, epoch=3, sequence=4, key=bytes(16), station=key.point, ca=b"\4" * 65,
        provisioned=True, can_address=9,
    )  # fmt: skip
    made.commit(later)
    again = FlashFile(folder)
    assert (again.load(), again.hardware) == (later, teds)
    assert (again.name, again.max_message, again.firmware) == ("left", 512, firmware)


def test_a_node_that_is_there_is_opened_and_another_one_is_refused(tmp_path: Path) -> None:
    teds = {(0, 1): b"\x01"}
    made = FlashFile.create(tmp_path / "node", uuid=UUID, blocks=teds)
    for same in ({}, {"uuid": UUID}, {"blocks": teds}, {"uuid": UUID, "blocks": teds}):
        assert FlashFile.create(tmp_path / "node", **same).key.point == made.key.point
    for other in ({"uuid": bytes(10)}, {"blocks": {}}, {"uuid": UUID, "blocks": {(0, 1): b"\x02"}}):
        with pytest.raises(UsageError, match="already holds another node"):
            FlashFile.create(tmp_path / "node", **other)


@pytest.mark.parametrize(("teds", "least"), [(0, 45), (20, 105)])
def test_a_node_bears_messages_that_list_its_teds(tmp_path: Path, teds: int, least: int) -> None:
    """List has 42 octets around three for each TEDS, the Security TEDS among them."""
    blocks = {(channel, 3): b"x" for channel in range(teds)}
    with pytest.raises(UsageError) as refused:
        FlashFile.create(tmp_path / "node", blocks=blocks, max_message=least - 1)
    assert refused.value.hint == f"--max-message {least}"
    assert not (tmp_path / "node" / "flash.json").exists()
    assert FlashFile.create(tmp_path / "node", blocks=blocks, max_message=least).max_message == least


def test_a_commit_takes_its_delay_and_is_durable_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    FlashFile.create(tmp_path / "node")
    slept: list[tuple[float, int]] = []
    slow = FlashFile(tmp_path / "node", delay=0.25)
    monkeypatch.setattr(
        "teds_provision.node.flash_file.time.sleep",
        lambda seconds: slept.append((seconds, FlashFile(tmp_path / "node").load().epoch)),
    )
    slow.commit(replace(slow.load(), epoch=5))
    assert slept == [(0.25, 0)]
    assert FlashFile(tmp_path / "node").load().epoch == 5


@pytest.mark.parametrize(
    ("change", "reported"),
    [({"firmware": None}, None), ({}, "virtual/teds-provision"), ({"max_message": 0}, BadDataError),
     ({"firmware": {"text": "x"}}, BadDataError),
     ({"firmware": {"text": "x", "version": "1", "build": 1, "image": None, "flags": [1]}}, BadDataError),
     ({"hardware": [[1]]}, BadDataError), ({"name": ...}, BadDataError)],
    ids=str,
)  # fmt: skip
def test_members_of_a_file_that_may_be_missing_and_those_that_may_not(
    tmp_path: Path, change: dict[str, object], reported: object
) -> None:
    path = FlashFile.create(tmp_path / "node").path
    document = json.loads(path.read_text()) | change
    path.write_text(json.dumps({name: value for name, value in document.items() if value is not ...}))
    if reported is BadDataError:
        with pytest.raises(BadDataError, match="or it is damaged"):
            FlashFile(tmp_path / "node")
        return
    firmware = FlashFile(tmp_path / "node").firmware
    assert (None if firmware is None else firmware.text) == reported


def test_a_running_node_is_refused_to_another_process(tmp_path: Path) -> None:
    FlashFile.create(tmp_path / "node")
    running = VirtualNode(tmp_path / "node", exclusive=True)
    with pytest.raises(StoreLockedError):
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


@pytest.mark.parametrize(
    "change",
    [{"key": "00" * 32}, {"key": 7}, {"key": "xy"}, {"key": None}, {"flash": 7}, {"flash": []}, {"flash": None},
     {"flash": {}},
     {"max_message": None}, {"max_message": "many"}, {"max_message": 0}, {"hardware": 7}, {"hardware": [[1, 3]]},
     {"hardware": [[1, 3, "xy"]]}, {"firmware": 7}, {"firmware": []}, {"firmware": {}}, {"format": "another"},
     {"name": ...}],
)  # fmt: skip
def test_a_member_of_another_form_is_a_damaged_flash(tmp_path: Path, change: dict[str, Any]) -> None:
    path = FlashFile.create(tmp_path / "node").path
    whole = json.loads(path.read_text()) | change
    path.write_text(json.dumps({name: value for name, value in whole.items() if value is not ...}))
    with pytest.raises(BadDataError, match="not a virtual node's flash"):
        FlashFile(tmp_path / "node")


@pytest.mark.parametrize("document", ["", "[]", "{}", '{"format": "teds-virtual-node/1"}', "damaged key"])
def test_a_damaged_flash_is_bad_data(tmp_path: Path, document: str) -> None:
    path = FlashFile.create(tmp_path / "node").path
    if document == "damaged key":
        document = json.dumps(json.loads(path.read_text()) | {"key": "00" * 32})
    path.write_text(document)
    with pytest.raises(BadDataError):
        FlashFile(tmp_path / "node")


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be used"):
        FlashFile.create(tmp_path / "file" / "node")
    with pytest.raises(NotFoundError):
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
    counter = decode_reply(node.request("nfc", session.request_counter().encode(), tapped=True)).payload
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
