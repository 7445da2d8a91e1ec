"""The manager of a virtual node's images: every answer whole, and an upload piece by piece."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from teds_provision.errors import StoreError
from teds_provision.firmware_image import FirmwareImage
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.firmware.manager import ImageManager, ManagedFirmware
from teds_provision.protocol.messages.firmware import FirmwareFlag
from teds_provision.protocol.messages.smp import decode_map, decode_packet, encode_map

OLD = FirmwareImage(b"", (1, 2, 3, 0), b"\1" * 32, "board/app", 1, 32)
NEW = FirmwareImage(b"", (1, 3, 0, 7), b"\2" * 32, None, 1, 32)


@dataclass
class Slots:
    """Two slots in memory."""

    running: FirmwareImage = OLD
    other: FirmwareImage | None = None
    on_trial: bool = False
    pending: bool = False
    written: bytearray = field(default_factory=bytearray)
    log: list[str] = field(default_factory=list)
    broken: bool = False

    def write(self, offset: int, octets: bytes) -> None:
        if self.broken:
            raise OSError(28, "full")
        if offset == 0:
            self.written.clear()
        assert offset == len(self.written)
        self.written += octets

    def flush(self) -> bytes:
        return bytes(self.written)

    def confirm(self) -> None:
        self.log.append("confirm")

    def start_next(self, digest: bytes) -> bool:
        self.log.append("start")
        return self.other is not None and digest == self.other.digest


@pytest.fixture
def slots() -> Slots:
    return Slots()


@pytest.fixture
def manager(slots: Slots) -> ImageManager:
    return ImageManager(cast("ImageSlots", slots), lambda: slots.log.append("restart"))


def ask(manager: ImageManager, first: int, group: int, number: int, **body: Any) -> dict[str, Any]:
    octets = encode_map(body)
    head = bytes((first, 0)) + len(octets).to_bytes(2, "big") + group.to_bytes(2, "big") + bytes((9, number))
    reply = decode_packet(manager.manage(head + octets))
    assert (reply.command.first, reply.command.group, reply.command.number) == (first + 1, group, number)
    assert (reply.sequence, reply.whole) == (9, True)
    return dict(decode_map(reply.body))


def states(manager: ImageManager) -> list[dict[str, Any]]:
    found = ask(manager, 8, 1, 0)
    assert found["splitStatus"] == 0
    return list(found["images"])


RUNS = {"slot": 0, "version": "1.2.3", "hash": OLD.digest, "bootable": True, "active": True}
WAITS = {"slot": 1, "version": "1.3.0.7", "hash": NEW.digest, "bootable": True}


def test_what_the_manager_answers(manager: ImageManager, slots: Slots) -> None:
    assert ask(manager, 10, 0, 0, d="hello") == {"r": "hello"}
    assert ask(manager, 10, 0, 0) == {"r": ""}
    assert ask(manager, 8, 0, 6) == {"buf_size": 2048, "buf_count": 1}
    assert ask(manager, 8, 0, 8) == {"bootloader": "MCUboot"}
    assert ask(manager, 8, 0, 8, query="mode") == {"mode": 3}
    for query in ("other", ""):
        assert ask(manager, 8, 0, 8, query=query) == {"err": {"group": 0, "rc": 5}}
    assert ask(manager, 8, 1, 6) == {
        "images": [{"image": 0, "slots": [{"slot": 0, "size": 1048576}, {"slot": 1, "size": 1048576}]}]
    }
    assert (manager.offered, manager.buffer) == (True, 2048)
    manager.restart()
    assert slots.log == ["restart"]


@pytest.mark.parametrize(
    ("other", "on_trial", "pending", "shown"),
    [
        (None, False, False, [{**RUNS, "confirmed": True}]),
        (NEW, False, False, [{**RUNS, "confirmed": True}, WAITS]),
        (NEW, False, True, [{**RUNS, "confirmed": True}, {**WAITS, "pending": True}]),
        (NEW, True, False, [RUNS, {**WAITS, "confirmed": True}]),
    ],
)
def test_the_states_of_the_slots(
    manager: ImageManager, slots: Slots, other: Any, on_trial: bool, pending: bool, shown: list[dict[str, Any]]
) -> None:
    slots.other, slots.on_trial, slots.pending = other, on_trial, pending
    assert states(manager) == shown
    assert (manager.on_trial, manager.pending) == (on_trial, pending)


def test_what_about_reports(manager: ImageManager, slots: Slots) -> None:
    always = FirmwareFlag.LOCATE | FirmwareFlag.MANAGE | FirmwareFlag.SIGNATURE | FirmwareFlag.COUNTER
    report = manager.report()
    assert (report.text, report.version, report.build, report.image, report.flags) == (
        "board/app", (1, 2, 3), 0, OLD.digest, always
    )  # fmt: skip
    slots.on_trial = True
    assert manager.report().flags == always | FirmwareFlag.ON_TRIAL
    slots.on_trial, slots.pending, slots.running = False, True, NEW
    located: list[int] = []
    firmware = ManagedFirmware(manager, located.append)
    about = firmware.about()
    assert (about.text, about.version, about.build, about.flags) == ("", (1, 3, 0), 7, always | FirmwareFlag.PENDING)
    firmware.locate(5)
    assert located == [5]


@pytest.mark.parametrize(
    ("board", "text"), [("x" * 48, "x" * 48), ("x" * 49, ""), ("aZ09._+-/", "aZ09._+-/"), ("a b", ""), ("ä", "")]
)
def test_a_board_text_that_about_cannot_carry_is_left_out(
    manager: ImageManager, slots: Slots, board: str, text: str
) -> None:
    slots.running = FirmwareImage(b"", (1, 2, 3, 0), OLD.digest, board, None, 32)
    assert manager.report().text == text


def test_an_image_is_started_by_its_digest_or_the_running_one_confirmed(manager: ImageManager, slots: Slots) -> None:
    slots.other = NEW
    assert ask(manager, 10, 1, 0, hash=OLD.digest) == {"err": {"group": 1, "rc": 33}}
    assert slots.log == []
    assert ask(manager, 10, 1, 0, hash=b"\3" * 32) == {"err": {"group": 1, "rc": 24}}
    assert ask(manager, 10, 1, 0, hash=NEW.digest)["splitStatus"] == 0
    assert slots.log == ["start", "start"]
    assert ask(manager, 10, 1, 0, confirm=True)["images"][0]["slot"] == 0
    assert slots.log[2:] == ["confirm"]


IMAGE = bytes(range(200))
SHA = hashlib.sha256(IMAGE).digest()


def upload(manager: ImageManager, offset: int | None, data: bytes, **more: Any) -> dict[str, Any]:
    return ask(manager, 10, 1, 1, **({} if offset is None else {"off": offset}), data=data, **more)


def test_an_upload_goes_on_where_it_stands(manager: ImageManager, slots: Slots) -> None:
    assert upload(manager, 50, IMAGE[:50]) == {"off": 0}, "nothing was begun"
    assert upload(manager, 0, IMAGE[:50], len=200, sha=SHA) == {"off": 50}
    assert upload(manager, 20, IMAGE[20:70]) == {"off": 50}, "a piece that is there already"
    assert upload(manager, 60, IMAGE[60:70]) == {"off": 50}, "one that does not follow"
    assert upload(manager, 50, IMAGE[50:120]) == {"off": 120}
    assert upload(manager, 0, IMAGE[:50], len=200, sha=SHA) == {"off": 120}, "the same image is carried on"
    assert upload(manager, 120, IMAGE[120:] + b"!") == {"err": {"group": 1, "rc": 31}}
    assert upload(manager, 120, IMAGE[120:]) == {"off": 200, "match": True}
    assert bytes(slots.written) == IMAGE
    assert upload(manager, 200, b"") == {"off": 0}, "it has ended"


def test_another_image_begins_anew_and_one_without_a_digest_always(manager: ImageManager, slots: Slots) -> None:
    upload(manager, 0, IMAGE[:50], len=200, sha=SHA)
    assert upload(manager, 0, IMAGE[:30], len=201, sha=SHA) == {"off": 30}
    assert upload(manager, 0, IMAGE[:20], len=200, sha=b"\5" * 32) == {"off": 20}
    assert upload(manager, 20, IMAGE[20:]) == {"off": 200, "match": False}
    for octets in (30, 20, 10):
        assert upload(manager, 0, IMAGE[:octets], len=200) == {"off": octets}
    assert upload(manager, 10, IMAGE[10:]) == {"off": 200, "match": True}, "nothing to hold it against"
    assert bytes(slots.written) == IMAGE


@pytest.mark.parametrize(
    ("body", "error"),
    [
        ({"off": 0, "data": b"x"}, 21),
        ({"off": 0, "data": b"x", "len": 0}, 21),
        ({"off": 0, "data": b"x", "len": True}, 21),
        ({"off": 0, "data": b"x", "len": 1048577}, 30),
        ({"off": 0, "data": b"x", "len": 5, "image": 1}, 1),
        ({"off": 0, "data": "x", "len": 5}, 1),
        ({"off": 0, "data": b"xxxxxx", "len": 5}, 31),
    ],
    ids=str,
)
def test_a_piece_that_cannot_be_is_refused(manager: ImageManager, body: dict[str, Any], error: int) -> None:
    assert ask(manager, 10, 1, 1, **body) == {"err": {"group": 1, "rc": error}}


def test_a_slot_takes_a_mebibyte_and_a_full_disk_is_an_error(manager: ImageManager, slots: Slots) -> None:
    assert upload(manager, 0, b"x", len=1048576) == {"off": 1}
    slots.broken = True
    assert upload(manager, 1, b"x") == {"err": {"group": 1, "rc": 12}}
    slots.broken = False
    assert upload(manager, 1, b"y") == {"off": 2}
    assert bytes(slots.written) == b"xy", "what was not written is written again"


def test_state_that_cannot_be_stored_is_an_error_of_the_manager(
    manager: ImageManager, slots: Slots, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_digest: bytes) -> bool:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(slots, "start_next", full)
    assert ask(manager, 10, 1, 0, hash=NEW.digest) == {"err": {"group": 1, "rc": 12}}
