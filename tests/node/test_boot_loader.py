"""The image slots of a virtual node: trial, confirm, revert, the owner's signature, the counter, and cuts anywhere."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, StoreError
from teds_provision.firmware_image import FirmwareImage, load_firmware_image
from teds_provision.node.firmware import boot_loader
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.firmware.manager import ImageManager
from tests.firmware_images import make_key, sign


class Owner:
    """An owner's key and images, and a node whose slots hold the first of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.key = make_key(folder / "owner.pem")
        self.rival = make_key(folder / "rival.pem")
        self.old, self.old_file = self.image("1.0.0", counter=1)
        self.new, _ = self.image("1.1.0", counter=1)
        ImageSlots.create(self._made(), self.old_file, self.key)

    def _made(self) -> Path:
        (self.folder / "made").mkdir()
        return self.folder / "made"

    def image(self, version: str, *, counter: int | None, key: Path | None = None) -> tuple[FirmwareImage, Path]:
        file = sign(self.folder, version, key or self.key, counter=counter)
        return load_firmware_image(file), file


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Owner:
    return Owner(tmp_path_factory.mktemp("owner"))


@pytest.fixture
def folder(owner: Owner, tmp_path: Path) -> Path:
    return shutil.copytree(owner.folder / "made", tmp_path / "node")


def started(folder: Path) -> ImageSlots:
    """Return the slots after power off and on."""
    slots = ImageSlots(folder)
    slots.start()
    return slots


def put(slots: ImageSlots, image: FirmwareImage, *, piece: int = 700) -> None:
    for at in range(0, len(image.octets), piece):
        slots.write(at, image.octets[at : at + piece])
    assert slots.flush() == image.octets


def state(slots: ImageSlots) -> tuple[str, bool, bool]:
    return slots.running.version_text, slots.on_trial, slots.pending


def test_a_new_image_runs_once_on_trial_and_stays_if_it_is_confirmed(owner: Owner, folder: Path) -> None:
    slots = started(folder)
    assert state(slots) == ("1.0.0", False, False)
    put(slots, owner.new)
    assert not slots.start_next(owner.old.digest), "the one that runs is not in the other slot"
    assert slots.start_next(owner.new.digest)
    assert state(slots) == ("1.0.0", False, True)
    slots = started(folder)
    assert state(slots) == ("1.1.0", True, False)
    slots.confirm()
    assert state(slots) == ("1.1.0", False, False)
    assert state(started(folder)) == ("1.1.0", False, False)


def test_without_a_confirm_every_later_start_runs_the_old_one(owner: Owner, folder: Path) -> None:
    slots = started(folder)
    put(slots, owner.new)
    slots.start_next(owner.new.digest)
    started(folder)
    for _ in range(2):
        assert state(started(folder)) == ("1.0.0", False, False)
    again = started(folder)
    assert again.other is not None
    assert again.start_next(owner.new.digest), "it is still there, for another try"


def test_the_boot_loader_starts_nothing_that_the_owner_did_not_sign(owner: Owner, folder: Path) -> None:
    foreign, _ = owner.image("9.0.0", counter=9, key=owner.rival)
    slots = started(folder)
    put(slots, foreign)
    assert slots.start_next(foreign.digest), "the running image judges no signature"
    assert state(started(folder)) == ("1.0.0", False, False)
    slots = started(folder)
    put(slots, owner.new)
    slots.start_next(owner.new.digest)
    slots.write(600, b"changed after it was chosen")
    assert state(started(folder)) == ("1.0.0", False, False)


def test_the_security_counter_stops_an_older_image_and_nothing_else_does(owner: Owner, folder: Path) -> None:
    counted, _ = owner.image("2.0.0", counter=5)
    older, _ = owner.image("1.9.0", counter=4)
    equal, _ = owner.image("1.5.0", counter=5)
    bare, _ = owner.image("3.0.0", counter=None)
    slots = started(folder)
    put(slots, counted)
    slots.start_next(counted.digest)
    slots = started(folder)
    slots.confirm()
    for refused in (older, bare):
        put(slots, refused)
        slots.start_next(refused.digest)
        slots = started(folder)
        assert state(slots) == ("2.0.0", False, False)
    put(slots, equal)
    slots.start_next(equal.digest)
    assert state(started(folder)) == ("1.5.0", True, False), (
        "an older version with the same counter is the owner's matter"
    )


def test_an_image_that_was_uploaded_whole_can_be_uploaded_again(owner: Owner, folder: Path) -> None:
    """It begins at 0: what was written may have been overwritten since."""
    manager, octets = ImageManager(started(folder), lambda: None), owner.new.octets
    whole = {"len": len(octets), "sha": hashlib.sha256(octets).digest()}
    for _ in range(2):
        half = len(octets) // 2
        assert manager._upload({"off": 0, "data": octets[:half], **whole}) == {"off": half}
        assert manager._upload({"off": 0, "data": octets[:half], **whole}) == {"off": half}, "it was lost on the way"
        assert manager._upload({"off": half, "data": octets[half:]}) == {"off": len(octets), "match": True}


def test_what_the_other_slot_holds_is_looked_at_again_after_a_write_and_a_start(owner: Owner, folder: Path) -> None:
    slots = started(folder)
    assert slots.other is None
    put(slots, owner.new)
    assert slots.other is not None
    assert slots.other.version_text == "1.1.0"
    slots.start_next(owner.new.digest)
    slots.start()
    assert (slots.running.version_text, slots.other.version_text) == ("1.1.0", "1.0.0")
    slots.start()
    assert (slots.running.version_text, slots.other.version_text) == ("1.0.0", "1.1.0")


def test_only_the_very_image_that_was_chosen_starts(owner: Owner, folder: Path) -> None:
    slots = started(folder)
    put(slots, owner.new)
    slots.start_next(owner.new.digest)
    other, _ = owner.image("1.2.0", counter=1)
    put(slots, other)
    assert state(started(folder)) == ("1.0.0", False, False)


def test_an_image_is_on_the_disk_before_its_upload_is_called_whole(
    owner: Owner, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    sync = os.fsync

    def watched(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").resolve().name)
        sync(descriptor)

    slots = started(folder)
    monkeypatch.setattr(os, "fsync", watched)
    put(slots, owner.new)
    assert synced == ["slot-b.bin", "firmware"]


def test_the_counter_does_not_fall_with_the_image_that_runs(owner: Owner, folder: Path) -> None:
    """Somebody put an older image into the slot that runs."""
    boot_loader._write_state(folder / boot_loader.FOLDER, boot_loader.BootState(counter=9))
    slots = started(folder)
    put(slots, owner.new)
    assert slots.start_next(owner.new.digest)
    assert state(started(folder)) == ("1.0.0", False, False)


def test_the_counter_rises_only_by_an_image_that_was_confirmed(owner: Owner, folder: Path) -> None:
    counted, _ = owner.image("2.0.1", counter=6)
    slots = started(folder)
    put(slots, counted)
    slots.start_next(counted.digest)
    started(folder)
    assert state(started(folder)) == ("1.0.0", False, False)
    slots = started(folder)
    put(slots, owner.new)
    slots.start_next(owner.new.digest)
    assert state(started(folder)) == ("1.1.0", True, False)


def test_a_node_is_made_only_with_an_image_that_its_boot_loader_would_start(owner: Owner, tmp_path: Path) -> None:
    with pytest.raises(NotAuthenticError):
        ImageSlots.create(tmp_path, owner.old_file, owner.rival)
    assert not ImageSlots.exist_in(tmp_path)
    made = ImageSlots.create(tmp_path, owner.old_file, owner.key)
    assert state(made) == ("1.0.0", False, False)
    assert b"PRIVATE" not in b"".join(file.read_bytes() for file in (tmp_path / "firmware").iterdir())
    again = ImageSlots.create(tmp_path, sign(owner.folder, "1.0.9", owner.key), owner.key)
    assert state(again) == ("1.0.0", False, False), "a second run finds what is there"


def test_damaged_boot_state_is_named(folder: Path) -> None:
    path = folder / "firmware" / "boot.json"
    whole = path.read_text()
    for damaged in (
        "",
        "{}",
        "[]",
        "7",
        whole.replace('"a"', '"c"'),
        whole.replace("false", "0"),
        whole.replace("/1", "/2"),
        whole.replace('"counter": 1', '"counter": "1"'),
        whole.replace("null", "7"),
        whole.replace('"trial"', '"on_trial"'),
        whole[:-1] + ', "more": 1}',
    ):
        assert damaged != whole
        path.write_text(damaged)
        with pytest.raises(BadDataError, match="is not the boot state of a virtual node, or it is damaged"):
            ImageSlots(folder)


class _PowerCutError(Exception):
    """The power went."""


def test_power_that_fails_at_any_step_leaves_the_old_image_or_the_new_one(
    owner: Owner, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each write of the boot state and of a slot is cut before it, or after a part of it; then the board starts."""
    image = owner.new
    pieces = [(at, image.octets[at : at + 1200]) for at in range(0, len(image.octets), 1200)]
    left = 0
    write_whole, write = boot_loader.write_whole, ImageSlots.write

    def spend() -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise _PowerCutError

    def cut_state(path: Path, octets: bytes) -> None:
        spend()
        write_whole(path, octets)

    def cut_write(slots: ImageSlots, at: int, octets: bytes) -> None:
        try:
            spend()
        except _PowerCutError:
            write(slots, at, octets[: len(octets) // 2])
            raise
        write(slots, at, octets)

    def update(slots: ImageSlots) -> None:
        for at, octets in pieces:
            slots.write(at, octets)
        slots.start_next(image.digest)
        slots = ImageSlots(node)
        slots.start()
        slots.confirm()

    monkeypatch.setattr(boot_loader, "write_whole", cut_state)
    monkeypatch.setattr(ImageSlots, "write", cut_write)
    seen = set()
    steps = len(pieces) + 3  # chosen, on trial, confirmed
    for cut in range(steps + 1):
        node = shutil.copytree(folder, tmp_path / f"cut-{cut}")
        slots, left = started(node), cut
        try:
            update(slots)
        except _PowerCutError:
            assert cut < steps
        left = 100
        back = started(node)
        seen.add((back.running.version_text, back.on_trial))
        if back.on_trial:
            back.confirm()
        else:
            update(back)
        assert state(started(node)) == ("1.1.0", False, False), "the same work once more is all that it takes"
    assert seen == {("1.0.0", False), ("1.1.0", True), ("1.1.0", False)}


def test_a_full_disk_is_an_error_and_no_half_state(owner: Owner, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    slots = started(folder)
    put(slots, owner.new)

    def full(path: Path, octets: bytes) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(boot_loader, "write_whole", full)
    with pytest.raises(StoreError):
        slots.start_next(owner.new.digest)
    assert state(slots) == ("1.0.0", False, False)
