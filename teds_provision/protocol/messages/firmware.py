"""About, Locate and the number of Manage (128.21 to 128.23): what runs on a node (profile.md, "About and Locate").

About is a statement: in a session by the holder of the node's key, outside one unauthenticated. It measures no image.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import IntFlag
from typing import Final, Protocol

from teds_provision.errors import GarbledError
from teds_provision.protocol.messages.frames import Function, security_command

_LAYOUT: Final = struct.Struct(">BBBBHI32s")
_FORM: Final = 1
_NO_IMAGE: Final = bytes(32)
_TEXT: Final = re.compile(r"[A-Za-z0-9._+/-]{0,48}")
_VERSION: Final = re.compile(r"(\d{1,3})\.(\d{1,3})\.(\d{1,5})")
LOCATE_SECONDS: Final = 60
"""Longest time that one Locate makes a board blink or beep."""

ABOUT: Final = security_command(Function.ABOUT)
"""128.21: which firmware runs. Changes nothing."""

Version = tuple[int, int, int]
"""Major, minor, patch; compared as numbers, in this order."""


class FirmwareFlag(IntFlag):
    """Bits of the flags of About; 6 and 7 are ignored."""

    LOCATE = 0x01
    MANAGE = 0x02
    ON_TRIAL = 0x04
    PENDING = 0x08
    SIGNATURE = 0x10
    COUNTER = 0x20


NO_FLAGS: Final = FirmwareFlag(0)
_FLAGS: Final = 0x3F


@dataclass(frozen=True)
class FirmwareReport:
    """Payload of the reply to About.

    ``image`` is the digest of the running image (32 octets), None if the node has none; ``text`` names board and
    application. Raises ValueError for what the payload cannot carry.
    """

    text: str = ""
    version: Version = (0, 0, 0)
    build: int = 0
    image: bytes | None = None
    flags: FirmwareFlag = NO_FLAGS

    def __post_init__(self) -> None:
        if not _TEXT.fullmatch(self.text):
            raise ValueError("A firmware's text has at most 48 characters of A-Z a-z 0-9 . _ + - /.")
        if not all(0 <= number <= most for number, most in zip(self.version, (0xFF, 0xFF, 0xFFFF), strict=True)):
            raise ValueError("A version goes from 0.0.0 to 255.255.65535.")
        if not 0 <= self.build <= 0xFFFFFFFF:
            raise ValueError("A build is a number from 0 to 4294967295.")
        if self.image is not None and (len(self.image) != len(_NO_IMAGE) or self.image == _NO_IMAGE):
            raise ValueError("An image's digest has 32 octets, not all of them 0.")

    @property
    def board(self) -> str | None:
        """The text before its last slash, None if it has none."""
        board, slash, _ = self.text.rpartition("/")
        return board if slash else None

    @property
    def application(self) -> str:
        """The text after its last slash."""
        return self.text.rpartition("/")[2]

    @property
    def version_text(self) -> str:
        """The version as people write it, without the build: 1.2.3."""
        return ".".join(map(str, self.version))

    @property
    def stated(self) -> tuple[str, str, str | None]:
        """Text, version with build and image digest in hex: what identifies the firmware; a plant's pages hold it."""
        image = None if self.image is None else self.image.hex()
        return self.text, f"{self.version_text}+{self.build}", image

    def encode(self) -> bytes:
        """Return the 42 to 90 octets: form ‖ flags ‖ major ‖ minor ‖ patch ‖ build ‖ image ‖ text."""
        head = _LAYOUT.pack(_FORM, self.flags & _FLAGS, *self.version, self.build, self.image or _NO_IMAGE)
        return head + self.text.encode("ascii")

    @classmethod
    def decode(cls, octets: bytes) -> FirmwareReport:
        """Read the payload; raises GarbledError for another form, length or character: "firmware not reported"."""
        if len(octets) < _LAYOUT.size:
            raise GarbledError(f"A reply to About has at least {_LAYOUT.size} octets, this one {len(octets)}.")
        form, flags, major, minor, patch, build, image = _LAYOUT.unpack_from(octets)
        if form != _FORM:
            raise GarbledError(f"About has form {form}; this tool reads form {_FORM}.")
        text = octets[_LAYOUT.size :].decode("latin-1")
        if not _TEXT.fullmatch(text):
            raise GarbledError(
                "About ends in text of more than 48 octets, or with other characters than A-Za-z0-9._+-/."
            )
        named = None if image == _NO_IMAGE else image
        return cls(text, (major, minor, patch), build, named, FirmwareFlag(flags & _FLAGS))


def is_stated(value: object) -> bool:
    """Return True if a value read from JSON is of the form of :attr:`FirmwareReport.stated`."""
    if not isinstance(value, list) or len(value) != len(("text", "version", "image")):
        return False
    text, version, image = value
    if not isinstance(text, str) or not isinstance(version, str) or not isinstance(image, str | None):
        return False
    number, _, build = version.partition("+")
    try:
        read = FirmwareReport(text, parse_version(number), int(build), None if image is None else bytes.fromhex(image))
    except ValueError:
        return False
    return read.stated == (text, version, image)


def parse_version(text: str) -> Version:
    """Read a version such as 1.2.3; raises ValueError."""
    found = _VERSION.fullmatch(text)
    version = (int(found[1]), int(found[2]), int(found[3])) if found else (256, 0, 0)
    if version > (0xFF, 0xFF, 0xFFFF) or version[1] > 0xFF or version[2] > 0xFFFF:
        raise ValueError(f"{text!r} is not a version such as 1.2.3 (at most 255.255.65535).")
    return version


class Firmware(Protocol):
    """The running firmware as a node's commands see it."""

    def about(self) -> FirmwareReport | None:
        """Return the report as it is now; None if the board does not report its firmware."""

    def locate(self, seconds: int) -> None:
        """Blink or beep for so many seconds, 0 stops; replaces what runs. Called only with bit 0 of the report."""
