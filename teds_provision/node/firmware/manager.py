"""The SMP server of a virtual node: the commands of Manage over its image slots, as Zephyr's mcumgr answers them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from teds_provision.errors import TedsProvisionError
from teds_provision.firmware_image import FirmwareImage
from teds_provision.node.firmware.boot_loader import SLOT_OCTETS, ImageSlots
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.smp import (
    BOOT_LOADER,
    ECHO,
    PARAMETERS,
    SET_STATE,
    SLOTS,
    STATES,
    UPLOAD,
    SmpPacket,
    decode_map,
    decode_packet,
    encode_map,
)

_BUFFER: Final = 2048
_SWAP_MOVE: Final = 3
"""Mode of MCUboot that this imitates: swap without scratch, so that it can revert."""
_QUERY_HAS_NO_ANSWER: Final = 5
_OS, _IMAGE = 0, 1
_TEXT_CHARACTERS: Final = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789._+-/")
_LONGEST_TEXT: Final = 48


class ImageError(IntEnum):
    """Errors of SMP's image group (Zephyr, img_mgmt.h)."""

    UNKNOWN = 1
    FLASH_WRITE_FAILED = 12
    INVALID_OFFSET = 20
    INVALID_LENGTH = 21
    INVALID_HASH = 24
    TOO_LARGE = 30
    DATA_OVERRUN = 31
    SETTING_TEST_TO_ACTIVE_DENIED = 33


class _ReplyError(Exception):
    def __init__(self, error: int, group: int = _IMAGE) -> None:
        super().__init__(f"group {group}, error {error}")
        self.group, self.error = group, error


class ImageManager:
    """Answers SMP packets about the slots; ``restarted`` restarts the node. See protocol/tim/manage.py, Manager."""

    def __init__(self, slots: ImageSlots, restarted: Callable[[], None]) -> None:
        self._slots, self._restarted = slots, restarted
        self._sha, self._length, self._offset = b"", 0, 0
        self._commands: dict[object, Callable[[Mapping[str, Any]], Mapping[str, Any]]] = {
            ECHO: self._echo,
            PARAMETERS: lambda body: {"buf_size": _BUFFER, "buf_count": 1},
            BOOT_LOADER: self._boot_loader,
            STATES: lambda body: self._states(),
            SET_STATE: self._set_state,
            SLOTS: self._list_slots,
            UPLOAD: self._upload,
        }

    @property
    def offered(self) -> bool:
        """True: the boot loader checks signatures, tries and reverts."""
        return True

    @property
    def buffer(self) -> int:
        """Octets of the longest packet."""
        return _BUFFER

    @property
    def on_trial(self) -> bool:
        """True if the running image is on trial."""
        return self._slots.on_trial

    @property
    def pending(self) -> bool:
        """True if the other image starts next."""
        return self._slots.pending

    def restart(self) -> None:
        """Restart the node."""
        self._restarted()

    def report(self) -> FirmwareReport:
        """Return what About answers."""
        image = self._slots.running
        *version, build = image.version
        flags = FirmwareFlag.LOCATE | FirmwareFlag.MANAGE | FirmwareFlag.SIGNATURE | FirmwareFlag.COUNTER
        flags |= FirmwareFlag.ON_TRIAL if self.on_trial else FirmwareFlag(0)
        flags |= FirmwareFlag.PENDING if self.pending else FirmwareFlag(0)
        return FirmwareReport(_text(image), (version[0], version[1], version[2]), build, image.digest, flags)

    def manage(self, packet: bytes) -> bytes:
        """Run one packet and return its reply."""
        asked = decode_packet(packet)
        try:
            answer = self._commands[asked.command](decode_map(asked.body))
        except _ReplyError as failed:
            answer = {"err": {"group": failed.group, "rc": int(failed.error)}}
        except (OSError, TedsProvisionError):
            answer = {"err": {"group": _IMAGE, "rc": int(ImageError.FLASH_WRITE_FAILED)}}
        return SmpPacket.reply(asked, encode_map(answer)).encode()

    # -- commands --------------------------------------------------------------------------------------------------

    def _echo(self, body: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"r": body.get("d", "")}

    def _boot_loader(self, body: Mapping[str, Any]) -> Mapping[str, Any]:
        query = body.get("query")
        if query is None:
            return {"bootloader": "MCUboot"}
        if query == "mode":
            return {"mode": _SWAP_MOVE}
        raise _ReplyError(_QUERY_HAS_NO_ANSWER, _OS)

    def _states(self) -> Mapping[str, Any]:
        slots, other = self._slots, self._slots.other
        images = [
            _state(0, slots.running, active=True, confirmed=not slots.on_trial),
            *([_state(1, other, pending=slots.pending, confirmed=slots.on_trial)] if other is not None else []),
        ]
        return {"images": images, "splitStatus": 0}

    def _set_state(self, body: Mapping[str, Any]) -> Mapping[str, Any]:
        digest = body.get("hash")
        if digest is None:
            self._slots.confirm()
        elif digest == self._slots.running.digest:
            raise _ReplyError(ImageError.SETTING_TEST_TO_ACTIVE_DENIED)
        elif not self._slots.start_next(digest):
            raise _ReplyError(ImageError.INVALID_HASH)
        return self._states()

    def _list_slots(self, _body: Mapping[str, Any]) -> Mapping[str, Any]:
        return {"images": [{"image": 0, "slots": [{"slot": number, "size": SLOT_OCTETS} for number in (0, 1)]}]}

    def _upload(self, body: Mapping[str, Any]) -> Mapping[str, Any]:
        """Take a piece and return how far the upload is; a piece that does not fit there changes nothing."""
        offset, data, sha = body.get("off"), body.get("data", b""), body.get("sha", b"")
        if body.get("image", 0) != 0 or not isinstance(data, bytes):
            raise _ReplyError(ImageError.UNKNOWN)
        if offset == 0:
            length = body.get("len")
            if not isinstance(length, int) or isinstance(length, bool) or length < 1:
                raise _ReplyError(ImageError.INVALID_LENGTH)
            if length > SLOT_OCTETS:
                raise _ReplyError(ImageError.TOO_LARGE)
            if sha and (sha, length) == (self._sha, self._length):
                return {"off": self._offset}
            self._sha, self._length, self._offset = sha, length, 0
        if offset != self._offset or not self._length:
            return {"off": self._offset}
        if offset + len(data) > self._length:
            raise _ReplyError(ImageError.DATA_OVERRUN)
        self._slots.write(offset, data)
        self._offset += len(data)
        if self._offset < self._length:
            return {"off": self._offset}
        good = not self._sha or hashlib.sha256(self._slots.flush()).digest() == self._sha
        answer = {"off": self._offset, "match": good}
        self._sha, self._length, self._offset = b"", 0, 0
        return answer


@dataclass(frozen=True)
class ManagedFirmware:
    """The firmware that the manager reports; ``located`` shows a person the board. See Firmware."""

    manager: ImageManager
    located: Callable[[int], None]

    def about(self) -> FirmwareReport:
        """Return the present report."""
        return self.manager.report()

    def locate(self, seconds: int) -> None:
        """Make the board blink or beep."""
        self.located(seconds)


def _state(slot: int, image: FirmwareImage, **flags: bool) -> dict[str, Any]:
    entry = {"slot": slot, "version": _dotted(image), "hash": image.digest, "bootable": True}
    return entry | {name: value for name, value in flags.items() if value}


def _dotted(image: FirmwareImage) -> str:
    return ".".join(map(str, image.version if image.version[3] else image.version[:3]))


def _text(image: FirmwareImage) -> str:
    """Return board and application as the image names them; nothing if About cannot carry that."""
    text = image.board or ""
    return text if len(text) <= _LONGEST_TEXT and _TEXT_CHARACTERS.issuperset(text) else ""
