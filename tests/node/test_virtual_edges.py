"""A virtual node at its edges: a board that does not start, links that are called, sources and flash that fail."""

from __future__ import annotations

import errno
import json
import logging
import os
import socket
import stat
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeSilentError, StoreError, UsageError
from teds_provision.node import flash_file, virtual
from teds_provision.node.ble import address as ble_address
from teds_provision.node.ble.address import StaticAddress
from teds_provision.node.ble.peripheral import Peripheral
from teds_provision.node.firmware import boot_loader
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.sources import command, lines
from teds_provision.node.virtual import VirtualNode, _SlowKey
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.frames import IDENTIFY


@pytest.fixture
def node(tmp_path: Path) -> VirtualNode:
    FlashFile.create(tmp_path / "node")
    return VirtualNode(tmp_path / "node")


def test_a_board_whose_image_does_not_verify_is_silent_and_says_so_in_its_log(
    node: VirtualNode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    called: list[str] = []
    node.when_restarted(lambda: called.append("can"))
    node.when_restarted(lambda: called.append("ble"))
    before = node.tim

    def start() -> None:
        raise StoreError("The image in slot a is not signed by the owner.")

    monkeypatch.setattr(node, "_start", start)
    with caplog.at_level(logging.ERROR):
        node.restart()
    assert caplog.messages == ["The board does not start: The image in slot a is not signed by the owner."]
    assert called == ["can", "ble"], "their conversations are over all the same"
    assert node.tim is before
    with pytest.raises(NodeSilentError) as no:
        node.request("can:f1", IDENTIFY.encode(), tapped=False)
    assert no.value.message == "The board does not answer."


def test_a_restart_loses_what_is_in_ram_and_tells_every_link(node: VirtualNode) -> None:
    called: list[str] = []
    node.when_restarted(lambda: called.append("can"))
    own, before = node.can_address(), node.tim
    node.take_can_address(77)
    assert node.can_address() == 77
    node.restart()
    assert (node.can_address(), called) == (own, ["can"])
    assert node.tim is not before
    assert node.request("can:f1", IDENTIFY.encode(), tapped=False)[:3] == b"\1\0\x17"


def test_a_pressed_button_is_announced_over_every_bus(node: VirtualNode) -> None:
    called: list[str] = []
    node.press_button()
    node.announces_presses_over(lambda: called.append("a"))
    node.announces_presses_over(lambda: called.append("b"))
    node.press_button()
    assert called == ["a", "b"]


def test_a_node_without_channels_has_no_clock_no_claims_and_nothing_to_do(node: VirtualNode) -> None:
    assert (node.beat(), node.tick(), node.tick(5.0), node.actuator_claimed()) == (None, 0, 0, False)
    assert (node.in_factory_state(), node.in_session("can:f1")) == (True, False)
    node.trigger("can:f1", bytes(8), 0)
    node.drive("can:f1", b"\0")
    node.unheard("can:f1")


def test_data_messages_that_were_lost_are_reported_every_ten_seconds_and_the_rest_at_the_end(
    node: VirtualNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports: list[str] = []
    board: Any = SimpleNamespace(notify=reports.append)
    uuid = node.tim.flash.uuid
    clock = [0.0]
    monkeypatch.setattr(virtual, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    steps = [
        (100.0, 0, True), (100.0, 3, True), (109.9, 4, True), (110.0, 5, True), (110.1, 5, True), (112.0, 6, True),
        (113.0, 7, False), (113.1, 7, False), (113.2, 9, False), (123.1, 10, True), (123.2, 11, True),
    ]  # fmt: skip
    for clock[0], missed, streaming in steps:
        tim = SimpleNamespace(missed=missed, streaming=streaming, flash=SimpleNamespace(uuid=uuid))
        monkeypatch.setattr(node, "tim", tim)
        node._report_missed(board)
    assert reports == [
        f"{more} data messages of node {uuid.hex()} could not be sent in time ({missed})."
        for more, missed in ((3, 3), (2, 5), (2, 7), (2, 9), (2, 11))
    ]


# -- Bluetooth ---------------------------------------------------------------------------------------------------------


class _Line:
    """A connection with a queue that runs its jobs at once."""

    def __init__(self, connection: object) -> None:
        self.connection, self.name, self.number = connection, "ble:1", 1
        self.jobs = SimpleNamespace(put=lambda job: job())
        self.hears, self.waiting, self.came = True, 0, list[bytes]()
        self.assembly = SimpleNamespace(add_frame=self._frame)

    def _frame(self, octets: bytes) -> object:
        self.came.append(octets)
        return None


def _peripheral() -> tuple[Any, _Line, list[Any]]:
    log: list[Any] = []
    made: Any = Peripheral.__new__(Peripheral)
    line = _Line("own")
    made._lines = {1: line}
    made._node = SimpleNamespace(
        drive=lambda name, data: log.append((name, data)), unheard=lambda name: log.append(("unheard", name))
    )
    return made, line, log


def test_a_drive_message_has_stream_0_and_comes_from_a_connection() -> None:
    made, _, log = _peripheral()
    for connection, octets in (("own", b"\0abc"), ("own", b"\1abc"), ("own", b""), ("other", b"\0abc"), ("own", b"\0")):
        made._driven(connection, octets)
    assert log == [("ble:1", b"abc"), ("ble:1", b"")]


def test_a_station_that_wants_no_data_any_more_is_unheard() -> None:
    made, line, log = _peripheral()
    made._subscribed("own", True, False)
    assert (line.hears, log) == (True, [])
    made._subscribed("other", False, False)
    assert (line.hears, log) == (True, [])
    made._subscribed("own", False, False)
    assert (line.hears, log) == (False, [("unheard", "ble:1")])


def test_a_piece_from_no_connection_is_dropped_and_a_message_that_is_not_whole_waits() -> None:
    made, line, log = _peripheral()
    made._written("other", b"a")
    made._written("own", b"b")
    assert (line.came, line.waiting, log) == ([b"b"], 0, [])


# -- sources -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "words", "hint"),
    [
        (lines.make_socket, "unix: needs a path.", "Write --source unix:/tmp/hand.sock."),
        (lines.make_simulation, "simulation: needs a path.", "Write --source simulation:/tmp/hand.sock."),
    ],
)
def test_a_socket_of_a_source_needs_a_path(make: Any, words: str, hint: str) -> None:
    with pytest.raises(UsageError) as no:
        make("", [], print)
    assert (no.value.message, no.value.hint) == (words, hint)


def test_values_of_actuators_that_a_simulation_does_not_read_are_lost() -> None:
    sent: list[tuple[bytes, int]] = []

    def full(_octets: bytes, _flags: int) -> None:
        raise BlockingIOError

    rig: Any = SimpleNamespace(_peer=None)
    lines.UnixSocket.acted(rig, {"grip": 1.5})
    rig._peer = SimpleNamespace(send=lambda octets, flags: sent.append((octets, flags)))
    lines.UnixSocket.acted(rig, {"grip": 1.5})
    rig._peer = SimpleNamespace(send=full)
    lines.UnixSocket.acted(rig, {"grip": 1.5})
    assert [json.loads(octets) for octets, _ in sent] == [{"set": {"grip": 1.5}}]
    assert sent[0][0].endswith(b"\n")


def test_a_program_that_does_not_end_in_two_seconds_is_killed() -> None:
    done: list[Any] = []

    def wait(seconds: float | None = None) -> int:
        done.append(("wait", seconds))
        if seconds is not None:
            raise subprocess.TimeoutExpired("hand", seconds)
        return -9

    process = SimpleNamespace(terminate=lambda: done.append("terminate"), kill=lambda: done.append("kill"), wait=wait)
    rig: Any = SimpleNamespace(_process=process, _stopped=False)
    command.CommandSource.stop(rig)
    assert (done, rig._stopped) == (["terminate", ("wait", 2.0), "kill", ("wait", None)], True)
    alone: Any = SimpleNamespace(_process=None, _stopped=False)
    command.CommandSource.stop(alone)
    assert alone._stopped is True


class Slots:
    """Images of a board: how the one that starts behaves, and what was done to them."""

    running = None

    def __init__(self, *behaviour: str, on_trial: bool) -> None:
        self.behaviour, self.on_trial, self.done = behaviour, on_trial, list[str]()

    def behaves(self, how: str) -> bool:
        return how in self.behaviour

    def start(self) -> None:
        if self.done:
            self.on_trial = False  # the boot loader reverts it
        self.done.append("start")

    def confirm(self) -> None:
        self.on_trial = False
        self.done.append("confirm")


@pytest.mark.parametrize(
    ("behaviour", "on_trial", "done", "silent"),
    [
        ((), False, ["start"], False),
        (("crash",), True, ["start", "start"], False),
        (("crash",), False, ["start"], False),  # there is no image to go back to
        (("confirm",), True, ["start", "confirm"], False),
        (("mute",), False, ["start"], True),
    ],
)
def test_how_an_image_behaves_at_its_start(
    node: VirtualNode, behaviour: tuple[str, ...], on_trial: bool, done: list[str], silent: bool
) -> None:
    slots: Any = Slots(*behaviour, on_trial=on_trial)
    node._slots = slots
    node._start()
    assert (slots.done, node._off) == (done, silent)


def test_a_slow_chip_works_for_each_use_of_its_key() -> None:
    work, key = list[str](), SoftwareKey(77)
    slow = _SlowKey(key, lambda: work.append("work"))
    assert slow.point == key.point
    assert work == []
    assert slow.sign(b"message") == key.sign(b"message")
    assert slow.sign_digest(bytes(32)) == key.sign_digest(bytes(32))
    assert slow.ecdh(SoftwareKey(78).point) == key.ecdh(SoftwareKey(78).point)
    assert work == ["work"] * 3


def test_a_node_whose_lock_cannot_be_had_is_named(tmp_path: Path) -> None:
    FlashFile.create(tmp_path / "node")
    (tmp_path / "node" / "lock").mkdir()
    with pytest.raises(StoreError) as no:
        FlashFile(tmp_path / "node", exclusive=True)
    assert no.value.message == f"The folder {tmp_path / 'node'} cannot be used: Is a directory."


def test_an_address_of_ble_that_cannot_be_kept_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ble_address, "whole_file", full)
    with pytest.raises(StoreError, match=r"cannot be written: No space left on device\.$"):
        StaticAddress(tmp_path, factory=True)


@pytest.mark.parametrize(
    "text",
    ["", "{", "7", "[]", "{}", '{"address": 7}', '{"address": "xy"}', "[" * 4000, "\xff" * 5000,
     '{"address": "c0"}', '{"address": "401122334455"}', '{"address": null}'],
)  # fmt: skip
def test_a_file_that_holds_no_static_address_is_made_anew(tmp_path: Path, text: str) -> None:
    (tmp_path / "ble.json").write_text(text, "latin-1")
    made = StaticAddress(tmp_path, factory=True)
    kept = json.loads((tmp_path / "ble.json").read_text())
    assert int(kept["address"][:2], 16) & 0xC0 == 0xC0
    assert len(kept["address"]) == 12
    assert StaticAddress(tmp_path, factory=True).address == made.address


def test_a_simulation_whose_connection_breaks_has_ended() -> None:
    class Broken:
        def recv(self, _most: int) -> bytes:
            raise ConnectionResetError

        def fileno(self) -> int:
            return near.fileno()

    near, far = socket.socketpair()
    source = lines.UnixSocket([], print, Path("/nowhere"))
    with near, far:
        far.send(b"x")
        assert source._receive(Broken()) == b""  # type: ignore[arg-type]
        assert source._receive(near) == b"x"
        source._stop.set()
        assert source._receive(near) == b""


# -- flash and slots ---------------------------------------------------------------------------------------------------


def test_a_folder_that_cannot_hold_a_node_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(flash_file, "_replace", full)
    with pytest.raises(StoreError) as no:
        FlashFile.create(tmp_path / "node")
    assert no.value.message == f"The folder {tmp_path / 'node'} cannot be used: No space left on device."
    assert no.value.hint == "Choose another folder."


def test_the_other_slot_is_written_by_its_owner_alone(tmp_path: Path) -> None:
    rig: Any = SimpleNamespace(_folder=tmp_path, _state=SimpleNamespace(running="a"), _other=1)
    before = os.umask(0)
    try:
        ImageSlots.write(rig, 0, b"abcdef")
    finally:
        os.umask(before)
    (slot,) = tmp_path.iterdir()
    assert slot.name == boot_loader._SLOTS["b"]
    assert stat.S_IMODE(slot.stat().st_mode) == 0o600
    ImageSlots.write(rig, 4, b"XY")
    assert slot.read_bytes() == b"abcdXY"
    ImageSlots.write(rig, 0, b"new")
    assert slot.read_bytes() == b"new", "offset 0 erases the slot"
    assert rig._other is None


def test_a_folder_of_slots_that_cannot_be_made_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boot_loader, "load_firmware_image", lambda *_: SimpleNamespace(octets=b"", security_counter=1))
    (tmp_path / boot_loader.FOLDER).write_text("")
    monkeypatch.setattr(ImageSlots, "exist_in", staticmethod(lambda _folder: False))
    with pytest.raises(StoreError) as no:
        ImageSlots.create(tmp_path, Path("image"), Path("key"))
    assert no.value.message == f"The folder {tmp_path / boot_loader.FOLDER} cannot be made: File exists."
