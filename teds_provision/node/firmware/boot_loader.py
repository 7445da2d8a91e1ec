"""Two image slots in files, and what MCUboot does with them at each start of a board.

An image that was chosen starts once, on trial; at the next start the other one runs again unless it was confirmed.
Which slot runs is one small file that is replaced whole, so a loss of power at any moment leaves the old image or the
new one.
A virtual node executes no image: which one runs decides what it reports, and an image of tests how it fails
(:meth:`ImageSlots.behaves`).
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, NotAuthenticError, StoreError
from teds_provision.files import read_limited, sync_folder, write_whole
from teds_provision.firmware_image import FirmwareImage, load_firmware_image, load_key, public_pem, read_firmware_image
from teds_provision.limits import load_json

FOLDER: Final = "firmware"
SLOT_OCTETS: Final = 1 << 20
_FORMAT: Final = "teds-virtual-firmware/1"
_STATE, _KEY = "boot.json", "owner.pem"
_SLOTS: Final = {"a": "slot-a.bin", "b": "slot-b.bin"}
_OTHER: Final = {"a": "b", "b": "a"}


@dataclass(frozen=True)
class BootState:
    """State of the boot loader: the slot that runs, whether on trial, the image that starts next, the counter.

    ``pending`` is the digest (hex) of the image in the other slot that starts at the next start.
    """

    running: str = "a"
    trial: bool = False
    pending: str | None = None
    counter: int = 0


class ImageSlots:
    """The slots of the node in ``folder``; :meth:`start` is the boot loader's step. Used by one thread at a time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / FOLDER
        self._key = load_key(self._folder / _KEY)
        self._state = self._read_state()
        self._running: FirmwareImage | None = None
        self._other: tuple[FirmwareImage | None] | None = None

    @classmethod
    def create(cls, folder: Path, image: Path, key: Path) -> ImageSlots:
        """Make the slots of a node whose first image is in a file, checked by the owner's key as at a start.

        Raises NotFoundError, BadDataError, NotAuthenticError, StoreError.
        """
        first = load_firmware_image(image, key)
        if not cls.exist_in(folder):
            own = folder / FOLDER
            try:
                own.mkdir(mode=0o700, exist_ok=True)
            except OSError as error:
                raise StoreError(f"The folder {own} cannot be made: {error.strerror}.") from error
            write_whole(own / _KEY, public_pem(load_key(key)))
            write_whole(own / _SLOTS["a"], first.octets)
            write_whole(own / _SLOTS["b"], b"")
            # written last: the slots exist only with a complete state
            _write_state(own, BootState(counter=first.security_counter or 0))
        slots = cls(folder)
        slots.start()
        return slots

    @staticmethod
    def exist_in(folder: Path) -> bool:
        """Return True if the node in ``folder`` has slots."""
        return (folder / FOLDER / _STATE).exists()

    # -- the boot loader -------------------------------------------------------------------------------------------

    def start(self) -> FirmwareImage:
        """Choose the image to run, as at a start of the board, and return it.

        Raises BadDataError, NotAuthenticError if the only image does not verify: such a board does not start.
        """
        state = self._state
        if state.trial:  # it was not confirmed during its trial
            state = replace(state, running=_OTHER[state.running], trial=False, pending=None)
        else:
            state = replace(state, counter=max(state.counter, self._verified(state.running).security_counter or 0))
            if state.pending is not None:
                state = self._tried(state)
        if state != self._state:
            self._put(state)
        self._running, self._other = self._verified(state.running), None
        return self._running

    def _tried(self, state: BootState) -> BootState:
        """Return the state after the chosen image was looked at: it runs on trial, or is forgotten."""
        other = _OTHER[state.running]
        try:
            image = self._verified(other)
        except (BadDataError, NotAuthenticError):
            return replace(state, pending=None)
        if image.digest.hex() != state.pending or (image.security_counter or 0) < state.counter:
            return replace(state, pending=None)
        return replace(state, running=other, trial=True, pending=None)

    def _verified(self, slot: str) -> FirmwareImage:
        return read_firmware_image(self._octets(slot), self._key)

    # -- for the running image -------------------------------------------------------------------------------------

    @property
    def running(self) -> FirmwareImage:
        """The image that runs since :meth:`start`."""
        assert self._running is not None, "start() before running"
        return self._running

    @property
    def other(self) -> FirmwareImage | None:
        """The image in the other slot, None if there is no whole one; its signature is the boot loader's matter."""
        if self._other is None:
            try:
                self._other = (read_firmware_image(self._octets(_OTHER[self._state.running])),)
            except BadDataError:
                self._other = (None,)
        return self._other[0]

    @property
    def on_trial(self) -> bool:
        """True if the running image is on trial."""
        return self._state.trial

    @property
    def pending(self) -> bool:
        """True if the other image starts at the next start."""
        return self._state.pending is not None

    def behaves(self, how: str) -> bool:
        """Return True if the running image is one of tests that is to fail so: its payload begins with a line #!HOW."""
        return self.running.octets[self.running.header_octets :].startswith(f"#!{how}\n".encode())

    def confirm(self) -> None:
        """Keep the running image; durable when it returns."""
        self._put(replace(self._state, trial=False))

    def start_next(self, digest: bytes) -> bool:
        """Have the other image start next, on trial; False if that is no image of this digest."""
        other = self.other
        if other is None or other.digest != digest:
            return False
        self._put(replace(self._state, pending=digest.hex()))
        return True

    def write(self, offset: int, octets: bytes) -> None:
        """Write octets into the other slot; offset 0 erases it first. Raises OSError."""
        self._other = None
        path = self._folder / _SLOTS[_OTHER[self._state.running]]
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | (os.O_TRUNC if offset == 0 else 0)
        descriptor = os.open(path, flags, 0o600)
        try:
            os.pwrite(descriptor, octets, offset)
        finally:
            os.close(descriptor)

    def flush(self) -> bytes:
        """Bring the other slot to the disk and return its octets. Raises OSError."""
        path = self._folder / _SLOTS[_OTHER[self._state.running]]
        with path.open("rb+") as file:
            os.fsync(file.fileno())
            octets = file.read()
        sync_folder(self._folder)
        return octets

    # -- files -----------------------------------------------------------------------------------------------------

    def _octets(self, slot: str) -> bytes:
        path = self._folder / _SLOTS[slot]
        return read_limited(path, SLOT_OCTETS, "image slot", failure=BadDataError)

    def _put(self, state: BootState) -> None:
        _write_state(self._folder, state)
        self._state = state

    def _read_state(self) -> BootState:
        path = self._folder / _STATE
        try:
            document = load_json(read_limited(path, 1 << 16, "boot state"), "the boot state")
            if document.pop("format") != _FORMAT:
                raise ValueError
            whole = document["running"] in _SLOTS and isinstance(document["trial"], bool)
            if not whole or not isinstance(document["counter"], int) or not isinstance(document["pending"], str | None):
                raise ValueError
            state = BootState(**document)
        except (BadDataError, AttributeError, KeyError, TypeError, ValueError):
            raise BadDataError(f"{path} is not the boot state of a virtual node, or it is damaged.") from None
        return state


def _write_state(folder: Path, state: BootState) -> None:
    write_whole(folder / _STATE, json.dumps({"format": _FORMAT, **asdict(state)}).encode())
