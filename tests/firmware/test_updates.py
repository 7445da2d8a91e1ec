"""Updates of the node in C over its own boot loader and SMP server: trials, reverts, the counter, power cuts."""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import pytest

from teds_provision.protocol.messages.frames import Command, Reason, Reply
from tests.firmware import smp
from tests.firmware.desk import CDesk
from tests.firmware.mcuboot import Owner, digest_of, tlv
from tests.firmware.smp import packet
from tests.protocol.desk import META, NAME

pytestmark = pytest.mark.system

OWNER = Owner()
OLD = OWNER.image((1, 0, 0, 0), payload=b"old" * 900, counter=3, text="host/loadcell")
NEW = OWNER.image((1, 2, 3, 45), payload=b"new" * 1200, counter=4, text="host/loadcell")
MANAGES, ON_TRIAL, PENDING, SIGNED, COUNTER = 2, 4, 8, 16, 32
NO_IMAGE = -100
SLOT = 16384


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    CDesk.close_all()


class PowerGoneError(Exception):
    """The board does not answer any more."""


class Board(CDesk):
    """A node that updates itself; a restart that it asks for happens at once, and its sessions are over."""

    @classmethod
    def make(cls, image: bytes = OLD, *, owner: Owner = OWNER, counter: bool = True) -> Board:
        desk = cls()
        desk.node.has_images(owner.public, image, counter=counter)
        desk.restart()
        desk.provision({(0, 1): META, (1, 12): NAME})
        desk.node.poll()
        desk.open()
        return desk

    def about(self) -> tuple[bytes, int, bytes, str]:
        """Return the running image's digest, the flags, its version and text."""
        payload = self.plain(Command(0, 128, 21, b""), link="can:f1", tapped=False).payload
        return payload[10:42], payload[1], payload[2:10], payload[42:].decode()

    def ask(self, command: tuple[int, int, int], body: bytes = smp.EMPTY) -> Any:
        """Return what the manager answers, or the reason of a refusal."""
        reply = self.manage(packet(command, body))
        if self.node.dead:
            raise PowerGoneError
        return smp.body_of(reply.payload) if reply.ok else reply.reason

    def manage(self, octets: bytes) -> Reply:
        return self.sealed(Command(0, 128, 23, octets))

    def raw(self, octets: bytes, *, link: str = "nfc", tapped: bool = True) -> Reply:
        reply = super().raw(octets, link=link, tapped=tapped)
        if self.node.restart_if_asked() not in (None, 0):
            raise PowerGoneError
        return reply

    def upload(self, image: bytes, *, until: int | None = None, size: int = 893) -> Any:
        """Send an image in pieces from where the manager wants them; return its last answer."""
        off, first = 0, {"len": len(image), "sha": hashlib.sha256(image).digest(), "image": 0}
        for _ in range(100):
            room = max(size - 60, 32) if off == 0 else size
            values = {"off": off, "data": image[off : off + room], **(first if off == 0 else {})}
            answer = self.ask(smp.UPLOAD, smp.encode(values))
            if not isinstance(answer, dict) or "off" not in answer:
                return answer
            off = answer["off"]
            if off >= len(image) or (until is not None and off >= until):
                return answer
        raise AssertionError("off never moves")

    def update(self, image: bytes) -> None:
        """Do all of an update: upload, trial, restart, confirm."""
        digest = digest_of(image)
        if self.about()[0] != digest:
            assert self.upload(image) == {"off": len(image), "match": True}
            assert "images" in self.ask(smp.SET_STATE, smp.start(digest))
            assert self.about()[1] & PENDING
            self.ask(smp.RESTART)
            self.open()
        assert self.about()[0] == digest
        if self.about()[1] & ON_TRIAL:
            self.ask(smp.SET_STATE, smp.CONFIRM)
        assert not self.about()[1] & (ON_TRIAL | PENDING)


def test_an_update_is_uploaded_tried_and_confirmed() -> None:
    desk = Board.make()
    version = bytes([1, 0, 0, 0, 0, 0, 0, 0])
    assert desk.about() == (digest_of(OLD), MANAGES | SIGNED | COUNTER, version, "host/loadcell")
    before = desk.shown()
    assert desk.ask(smp.PARAMETERS)["buf_size"] == 1024 - 53
    assert desk.ask(smp.ECHO, smp.encode({"d": "hello"})) == {"r": "hello"}
    assert desk.ask(smp.BOOT_LOADER) == {"rc": 8}, "listed and not built: SMP's own error"
    assert desk.ask(smp.SLOTS)["images"][0]["max_image_size"] == SLOT
    states = desk.ask(smp.STATES)["images"]
    assert [(state["slot"], state["version"], state["active"]) for state in states] == [(0, "1.0.0", True)]
    desk.upload(NEW)
    states = desk.ask(smp.STATES)["images"]
    assert [state["version"] for state in states] == ["1.0.0", "1.2.3.45"]
    assert states[1]["hash"] == digest_of(NEW)
    desk.ask(smp.SET_STATE, smp.start(digest_of(NEW)))
    assert desk.about()[1] & PENDING
    desk.ask(smp.RESTART)
    assert desk.about()[:3] == (
        digest_of(NEW), MANAGES | SIGNED | COUNTER | ON_TRIAL, bytes([1, 2, 0, 3, 0, 0, 0, 45])
    )  # fmt: skip
    desk.open()
    states = desk.ask(smp.STATES)["images"]
    assert [(state["active"], state["confirmed"]) for state in states] == [(True, False), (False, True)]
    assert desk.upload(OLD) == Reason.BUSY
    desk.ask(smp.SET_STATE, smp.CONFIRM)
    assert desk.about()[1] == MANAGES | SIGNED | COUNTER
    desk.restart()
    assert desk.about()[0] == digest_of(NEW)
    assert desk.shown() == before


def test_a_trial_that_is_not_confirmed_reverts_at_the_next_restart() -> None:
    desk = Board.make()
    desk.upload(NEW)
    desk.ask(smp.SET_STATE, smp.start(digest_of(NEW)))
    desk.ask(smp.RESTART)
    assert desk.about()[0] == digest_of(NEW)
    desk.restart()
    assert desk.about()[:2] == (digest_of(OLD), MANAGES | SIGNED | COUNTER)
    desk.open()
    desk.now += 20
    desk.update(NEW)


def test_an_upload_that_was_cut_goes_on_where_it_ended() -> None:
    desk = Board.make()
    assert desk.upload(NEW, until=1500)["off"] == 1726
    desk.node.link_lost("nfc")
    desk.open()
    sent: list[int] = []
    manage = desk.manage
    desk.manage = lambda octets: (sent.append(len(octets)), manage(octets))[1]  # type: ignore[method-assign]
    assert desk.upload(NEW) == {"off": len(NEW), "match": True}
    assert sum(sent) < len(NEW) - 1726 + 1200, "but for the first packet nothing came twice"
    assert digest_of(NEW) == desk.ask(smp.STATES)["images"][1]["hash"]


@pytest.mark.parametrize("size", [9, 100, 640, 890])
def test_pieces_may_have_any_length(size: int) -> None:
    desk = Board.make(counter=False)
    image = OWNER.image(payload=b"short")
    assert desk.upload(image, size=size) == {"off": len(image), "match": True}
    assert not desk.node.misused


def test_an_image_that_came_wrong_says_so() -> None:
    desk = Board.make()
    values = {"off": 0, "len": 600, "sha": bytes(32), "data": NEW[:600]}
    assert desk.ask(smp.UPLOAD, smp.encode(values)) == {"off": 600, "match": False}
    desk.now += 10
    for wrong, rc in [
        ({"len": 600, "data": NEW[:31]}, 22),
        ({"len": 600, "data": b"ELF" + NEW[3:600]}, 23),
        ({"len": SLOT + 1, "data": NEW[:600]}, 30),
        ({"len": 100, "data": NEW[:600]}, 31),
    ]:
        assert desk.ask(smp.UPLOAD, smp.encode({"off": 0, **wrong})) == {"err": {"group": 1, "rc": rc}}
        desk.now += 10
    assert desk.ask(smp.SET_STATE, smp.start(bytes(32))) == {"err": {"group": 1, "rc": 8}}
    assert desk.ask(smp.SET_STATE, smp.start(digest_of(OLD))) == {"err": {"group": 1, "rc": 33}}


def _bent(image: bytes, at: int) -> bytes:
    return image[:at] + bytes([image[at] ^ 1]) + image[at + 1 :]


@pytest.mark.parametrize(
    "image",
    [
        Owner().image((9, 0, 0, 0), counter=9),
        OWNER.image((9, 0, 0, 0), counter=9, signed=False),
        OWNER.image((9, 0, 0, 0)),
        OWNER.image((9, 0, 0, 0), counter=2),
        _bent(NEW, 0x200 + 5),
        _bent(NEW, len(NEW) - 3),
        NEW[: -len(NEW) // 2],
    ],
    ids=["another owner", "not signed", "no counter", "older counter", "bent payload", "bent signature", "truncated"],
)
def test_an_image_that_may_not_run_never_does(image: bytes) -> None:
    desk = Board.make()
    before = desk.shown()
    desk.upload(image)
    answer = desk.ask(smp.SET_STATE, smp.start(digest_of(image if len(image) > len(NEW) // 2 + 1 else NEW)))
    if "err" not in answer:
        desk.ask(smp.RESTART)
    assert desk.about()[:2] == (digest_of(OLD), MANAGES | SIGNED | COUNTER)
    assert desk.shown() == before


def test_the_counter_of_a_confirmed_image_keeps_older_ones_out() -> None:
    """As MCUboot has it: an older version with the same or a higher counter may come back, any other does not."""
    desk = Board.make()
    desk.update(NEW)
    desk.restart()
    desk.open()
    desk.now += 20
    desk.upload(OLD)
    desk.ask(smp.SET_STATE, smp.start(digest_of(OLD)))
    desk.ask(smp.RESTART)
    assert desk.about()[0] == digest_of(NEW)
    desk.open()
    desk.now += 20
    desk.update(OWNER.image((0, 9, 0, 0), counter=4))


def test_records_go_round_both_pages() -> None:
    """Each update takes three records of sixteen octets; two pages hold 512."""
    desk = Board.make(counter=False)
    images = [OWNER.image((1, 0, number, 0), payload=b"x") for number in (1, 2)]
    for turn in range(190):
        desk.now += 20
        desk.update(images[turn % 2])
        desk.open()
    assert desk.about()[0] == digest_of(images[1])
    assert not desk.node.misused
    records = desk.node.images[2 * SLOT :]
    assert [len(page.rstrip(b"\xff")) > 0 for page in (records[:4096], records[4096:])] == [True, True], (
        "the page before is erased when the one after it is full: a cut in between loses nothing"
    )


def test_without_an_image_of_its_owner_a_board_does_not_start() -> None:
    desk = CDesk()
    desk.node.has_images(OWNER.public, Owner().image())
    assert desk.node.start() == NO_IMAGE
    desk.node.images = b"\xff" * len(desk.node.images)
    assert desk.node.start() == NO_IMAGE


_COUNTS_3 = tlv(0x50, struct.pack("<I", 3))


@pytest.mark.parametrize(
    ("image", "counter", "starts"),
    [
        (OWNER.image(), False, True),
        (OWNER.image(counter=3), True, True),
        (OWNER.image(), True, False),
        (OWNER.image(beside=_COUNTS_3), True, False),
        (OWNER.image(beside=_COUNTS_3), False, False),
        (OWNER.image(protected=tlv(0x50, b"\3\0")), True, False),
        (OWNER.image(flags=0x04), False, False),
        (OWNER.image(flags=0x08), False, False),
        (OWNER.image(flags=0x10), False, False),
        (OWNER.image(flags=0x20), False, True),
        (OWNER.image(named=b""), False, False),
        (OWNER.image(named=bytes(32)), False, False),
        (OWNER.image(header=0x10, octets=0x1F0 + 7), False, False),
        (OWNER.image(header=0x20, octets=0x1E0 + 7), False, True),
        (OWNER.image(beside=tlv(0x77, b"of others")), False, True),
        (OWNER.image(beside=tlv(0x77, b"")[:3]), False, False),
    ],
    ids=[
        "no counter is kept", "a counter", "no counter", "an unprotected counter", "one that nobody keeps",
        "a short counter", "AES-128", "AES-256", "not bootable", "another flag", "no key is named",
        "another key is named", "a header of 16", "a header of 32", "an unknown TLV", "a cut TLV",
    ],
)  # fmt: skip
def test_which_images_a_boot_loader_starts(image: bytes, counter: bool, starts: bool) -> None:
    desk = CDesk()
    desk.node.has_images(OWNER.public, image, counter=counter)
    assert desk.node.start() == (0 if starts else NO_IMAGE)


def test_an_image_whose_length_goes_round_is_none() -> None:
    """Header and octets together are 64 by 32 bits: its TLVs would lie inside of its own header."""
    desk, owner = CDesk(), Owner()
    whole = owner.image(header=0x200, octets=0xFFFFFE40)
    head = whole[:64]
    signed = owner.image_of(head)
    desk.node.has_images(owner.public, signed)
    assert desk.node.start() == NO_IMAGE


def test_only_a_protected_text_names_the_board() -> None:
    for image, text in (
        (OWNER.image(beside=tlv(0x54A0, b"evil")), ""),
        (OWNER.image(protected=tlv(0x54A0, b"x" * 49)), ""),
        (OWNER.image(protected=tlv(0x54A0, b"x" * 48)), "x" * 48),
    ):
        desk = CDesk()
        desk.node.has_images(OWNER.public, image)
        desk.restart()
        assert desk.plain(Command(0, 128, 21)).payload[42:].decode() == text


def test_a_board_without_a_security_counter_says_so_and_takes_an_older_image() -> None:
    desk = Board.make(counter=False)
    assert desk.about()[1] == MANAGES | SIGNED
    desk.update(NEW)
    desk.now += 20
    desk.update(OLD)


def test_an_image_that_never_starts_is_gone_afterwards() -> None:
    desk = Board.make()
    bad = _bent(NEW, 0x200 + 5)
    desk.upload(bad)
    desk.ask(smp.SET_STATE, smp.start(digest_of(NEW)))
    assert len(desk.ask(smp.STATES)["images"]) == 2
    desk.ask(smp.RESTART)
    desk.open()
    assert [state["version"] for state in desk.ask(smp.STATES)["images"]] == ["1.0.0"]


def test_a_record_of_another_form_or_a_torn_one_decides_nothing() -> None:
    desk = Board.make()
    images = desk.node.images
    record = b"B\2\1\0" + struct.pack("<II", 3, 99)
    for bad in (record + struct.pack("<I", zlib.crc32(record)), b"B\1" + record[2:] + bytes(4)):
        desk.node.images = images[: 2 * SLOT + 4096] + bad + images[2 * SLOT + 4096 + 16 :]
        assert desk.node.start() == 0
        assert desk.about()[0] == digest_of(OLD)
    good = b"B\1" + record[2:]
    good += struct.pack("<I", zlib.crc32(good))
    desk.node.images = images[: 2 * SLOT + 4096] + good + images[2 * SLOT + 4096 + 16 :]
    assert desk.node.start() == NO_IMAGE, "its slot is blank"


def first_piece(image: bytes, octets: int, **more: object) -> bytes:
    """Return the body of an upload's first piece."""
    values = {"off": 0, "len": len(image), "sha": hashlib.sha256(image).digest(), "data": image[:octets]}
    return smp.encode({name: value for name, value in (values | more).items() if value is not None})


def test_which_upload_is_carried_on_and_which_begins_anew() -> None:
    desk = Board.make()
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 500)) == {"off": 500}
    assert desk.ask(smp.UPLOAD, smp.encode({"off": 500, "data": NEW[500:800]})) == {"off": 800}
    assert desk.ask(smp.UPLOAD, smp.encode({"off": 500, "data": NEW[500:700]})) == {"off": 800}, "it is there already"
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300)) == {"off": 800}, "the same image"
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300, len=len(NEW) - 1)) == {"off": 300}, "another length"
    desk.now += 10
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 200, sha=bytes(32))) == {"off": 200}, "both"
    desk.now += 10
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 150, sha=bytes(31) + b"\1")) == {"off": 150}, "another digest"
    desk.now += 10
    for octets in (400, 100):
        assert desk.ask(smp.UPLOAD, first_piece(NEW, octets, sha=None)) == {"off": octets}, "without one: always"
    desk.now += 10
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300)) == {"off": 300}
    desk.restart()
    desk.open()
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 200)) == {"off": 200}, "nothing of it outlives a restart"
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300, len=None)) == {"err": {"group": 1, "rc": 22}}
    desk.now += 10
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300, len=SLOT, sha=b"")) == {"off": 300}, "a slot may be filled"
    assert desk.ask(smp.UPLOAD, smp.encode({"off": 300})) == {"rc": 3}


def test_an_upload_that_is_whole_begins_anew_and_its_digest_has_32_octets() -> None:
    desk = Board.make()
    assert desk.upload(NEW) == {"off": len(NEW), "match": True}
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 300)) == {"off": 300}
    desk.now += 10
    short = OWNER.image(payload=b"short", counter=3)[:600]
    digest = hashlib.sha256(short).digest()
    for sha, answer in ((digest, {"match": True}), (digest[:31], {"match": False}), (b"", {})):
        assert desk.ask(smp.UPLOAD, first_piece(short, 600, sha=sha)) == {"off": 600, **answer}
        desk.now += 10


def test_the_states_of_both_slots_are_shown_whole() -> None:
    desk = Board.make()
    old = {"version": "1.0.0", "hash": digest_of(OLD), "bootable": True, "permanent": False}
    new = {"version": "1.2.3.45", "hash": digest_of(NEW), "bootable": True, "permanent": False}
    runs, waits = {"slot": 0, "active": True, "pending": False}, {"slot": 1, "active": False}
    kept = {**old, **runs, "confirmed": True}
    assert desk.ask(smp.STATES) == {"images": [kept], "splitStatus": 0}
    desk.upload(NEW)
    there = {**new, **waits, "confirmed": False}
    assert desk.ask(smp.STATES) == {"images": [kept, {**there, "pending": False}], "splitStatus": 0}
    answer = desk.ask(smp.SET_STATE, smp.start(digest_of(NEW)))
    assert answer == {"images": [kept, {**there, "pending": True}], "splitStatus": 0}
    desk.ask(smp.RESTART)
    desk.open()
    trial = [{**new, **runs, "confirmed": False}, {**old, **waits, "pending": False, "confirmed": True}]
    assert desk.ask(smp.STATES) == {"images": trial, "splitStatus": 0}
    answer = desk.ask(smp.SET_STATE, smp.CONFIRM)
    settled = [{**new, **runs, "confirmed": True}, {**old, **waits, "pending": False, "confirmed": False}]
    assert answer == {"images": settled, "splitStatus": 0}
    assert desk.ask(smp.SLOTS) == {
        "images": [
            {
                "image": 0,
                "slots": [{"slot": 0, "size": 16384}, {"slot": 1, "size": 16384, "upload_image_id": 0}],
                "max_image_size": 16384,
            }
        ]
    }
    assert desk.ask(smp.PARAMETERS) == {"buf_size": 971, "buf_count": 1}


def test_an_upload_that_flash_did_not_take_is_over_and_begins_anew() -> None:
    desk = Board.make()
    assert desk.ask(smp.UPLOAD, first_piece(NEW, 500)) == {"off": 500}
    desk.node.fails(True)
    assert desk.ask(smp.UPLOAD, smp.encode({"off": 500, "data": NEW[500:800]})) == {"err": {"group": 1, "rc": 12}}
    desk.node.fails(False)
    before = desk.node.images
    assert desk.ask(smp.UPLOAD, smp.encode({"off": 500, "data": NEW[500:800]})) == {"off": 500}
    assert desk.node.images == before, "nothing is written behind what failed"
    assert desk.upload(NEW) == {"off": len(NEW), "match": True}


@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
def test_power_that_fails_anywhere_leaves_one_of_the_two_images_and_all_that_was_stored(torn: bool) -> None:
    desk = Board.make()
    shown, stored, images, key = desk.shown(), desk.node.image, desk.node.images, desk.key
    ran = []
    for step in range(1, 60):
        desk.node.image, desk.node.images, desk.key = stored, images, key
        desk.restart()
        desk.open()
        desk.now += 20
        desk.node.cut(step, torn=torn)
        try:
            desk.update(NEW)
        except (PowerGoneError, AssertionError):
            assert desk.node.dead
        cut = desk.node.dead
        desk.node.cut(0, torn=False)
        assert desk.node.start() == 0, f"step {step}"
        running, flags = desk.about()[:2]
        assert running in (digest_of(OLD), digest_of(NEW)), f"step {step}"
        ran.append((running, bool(flags & ON_TRIAL)))
        assert desk.shown() == shown, f"step {step}: what is stored has changed"
        assert desk.node.image == stored
        desk.open()
        desk.now += 20
        desk.update(NEW)
        assert desk.node.start() == 0
        assert desk.about()[:2] == (digest_of(NEW), MANAGES | SIGNED | COUNTER)
        assert desk.shown() == shown
        assert not desk.node.misused
        if not cut:
            break
    else:
        pytest.fail("it never came to its end")
    assert len(ran) >= 10
    assert {digest for digest, _ in ran} == {digest_of(OLD), digest_of(NEW)}
    assert ran[-1] == (digest_of(NEW), False)
    order = [digest for digest, on_trial in ran if not on_trial]
    assert order == sorted(order, key=[digest_of(OLD), digest_of(NEW)].index), "once it is the new one it stays"


@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
def test_power_may_fail_again_at_each_step_of_a_start_that_reverts(torn: bool) -> None:
    desk = Board.make()
    desk.upload(NEW)
    desk.ask(smp.SET_STATE, smp.start(digest_of(NEW)))
    pending = desk.node.images
    for first in (1, 2):
        desk.node.images = pending
        for step in [first] * 3:
            desk.node.start_cut(step, torn=torn)
        assert desk.node.start() == 0
        assert desk.about()[0] in (digest_of(OLD), digest_of(NEW))
        assert desk.node.start() == 0
        assert desk.about()[:2] == (digest_of(OLD), MANAGES | SIGNED | COUNTER) or not desk.about()[1] & PENDING


@pytest.mark.parametrize("text", ["", "x" * 48])
def test_an_image_that_imgtool_signed_starts(text: str, tmp_path: Any) -> None:
    imgtool = pytest.importorskip("imgtool.image", reason="imgtool comes with the extra update")
    keys = pytest.importorskip("imgtool.keys")
    from imgtool.version import decode_version

    keys.ECDSA256P1.generate().export_private(str(tmp_path / "key.pem"))
    key = keys.load(str(tmp_path / "key.pem"))
    (tmp_path / "app.bin").write_bytes(b"payload" * 300)
    image = imgtool.Image(
        version=decode_version("2.5.6+7"),
        header_size=0x200,
        pad_header=True,
        slot_size=SLOT,
        align=4,
        security_counter=1,
    )
    image.load(str(tmp_path / "app.bin"))
    custom = {0x54A0: text.encode()} if text else None
    image.create(key, "hash", None, custom_tlvs=custom)
    image.save(str(tmp_path / "signed.bin"))
    signed = (tmp_path / "signed.bin").read_bytes()
    desk = CDesk()
    desk.node.has_images(bytes(key.get_public_bytes()), signed, counter=True)
    desk.restart()
    payload = desk.plain(Command(0, 128, 21, b"")).payload
    assert payload[10:42] == digest_of(signed)
    assert payload[2:10] == bytes([2, 5, 0, 6, 0, 0, 0, 7])
    assert payload[42:].decode() == text
