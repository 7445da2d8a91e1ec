"""The image file: all TEDS of one node in one JSON document (command-line contract, "Image file")."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count, load_json
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import MINIMUM_OCTETS, checksum, teds_class

FORMAT = "teds-image/1"
_UUID_OCTETS: Final = 10

BlockId = tuple[int, int]
"""(TransducerChannel, access code), the order in which blocks are listed and signed."""
SECURITY: Final[BlockId] = (0, AccessCode.SECURITY)
"""Place of the Security TEDS of the profile."""


@dataclass(frozen=True)
class Image:
    """UUID (10 octets) and framed TEDS by (channel, access code)."""

    uuid: bytes
    blocks: Mapping[BlockId, bytes] = field(default_factory=dict)

    def __iter__(self) -> Iterator[BlockId]:
        return iter(sorted(self.blocks))

    @property
    def security(self) -> bytes | None:
        """The Security TEDS of the profile (access code 128, channel 0), if there is one."""
        return self.blocks.get(SECURITY)

    def unsigned_blocks(self) -> dict[BlockId, bytes]:
        """Return every block except the Security TEDS, ascending."""
        return {key: self.blocks[key] for key in self if key != SECURITY}

    def with_block(self, key: BlockId, teds: bytes) -> Image:
        """Return this image with one block put in."""
        return Image(self.uuid, {**self.blocks, key: teds})

    def digest(self) -> str:
        """Return the SHA-256 over all blocks with their ids and lengths, 64 hex digits."""
        whole = hashlib.sha256(self.uuid)
        for channel, access_code in self:
            teds = self.blocks[channel, access_code]
            whole.update(channel.to_bytes(2, "big") + bytes([access_code]) + len(teds).to_bytes(4, "big") + teds)
        return whole.hexdigest()

    def to_json(self) -> str:
        """Return the image file's text."""
        blocks = [{"access_code": a, "channel": c, "teds": self.blocks[c, a].hex()} for c, a in self]
        return json.dumps({"format": FORMAT, "uuid": self.uuid.hex(), "blocks": blocks}, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str | bytes) -> Image:
        """Read an image file strictly; raises BadDataError naming what is wrong."""
        plain = _plain_image(text)
        if plain is not None:
            return plain
        data = load_json(text, "the TEDS image")
        if not isinstance(data, dict) or data.get("format") != FORMAT:
            raise BadDataError(f'This is not a TEDS image: "format" is not "{FORMAT}".')
        uuid = _hex(data.get("uuid"), "uuid")
        if len(uuid) != _UUID_OCTETS:
            raise BadDataError(f'"uuid" of the image has {len(uuid)} octets, a UUID has 10.')
        entries = data.get("blocks")
        if not isinstance(entries, list):
            raise BadDataError('"blocks" of the image is not a list.')
        check_count(len(entries), LIMITS.teds_of_a_file, "TEDS in the image")
        blocks: dict[BlockId, bytes] = {}
        for number, entry in enumerate(entries):
            key, teds = _block(entry, number)
            if key in blocks:
                raise BadDataError(f"Block {number} of the image repeats access code {key[1]} on channel {key[0]}.")
            blocks[key] = teds
        return cls(uuid, blocks)


_PLAIN_OCTETS: Final = 1 << 16
_MEMBERS: Final = 3
"""Members of an image, and of each of its blocks."""
_plainly: Final = json.JSONDecoder().decode


def _plain_image(text: str | bytes) -> Image | None:
    """Read an image file that holds nothing but an image, in half of the time; None for any other, to be looked at.

    As many colons as members: no member can be there twice, since each has its own, and one in a text is one too many.
    """
    if len(text) > _PLAIN_OCTETS:
        return None
    try:
        data = _plainly(text if isinstance(text, str) else text.decode())
        if data["format"] != FORMAT or type(data["blocks"]) is not list:
            return None
        uuid, entries = bytes.fromhex(data["uuid"]), data["blocks"]
        members, blocks = len(data), {}
        for entry in entries:
            access_code, channel = entry["access_code"], entry["channel"]
            if type(access_code) is not int or type(channel) is not int:
                return None
            if not 0 <= access_code <= 0xFF or not 0 <= channel <= 0xFFFF:
                return None
            blocks[channel, access_code] = bytes.fromhex(entry["teds"])
            members += len(entry)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    counted = text.count(":") if isinstance(text, str) else text.count(b":")
    if members != counted or members != _MEMBERS * (1 + len(blocks)) or len(blocks) != len(entries):
        return None
    return Image(uuid, blocks) if len(uuid) == _UUID_OCTETS else None


def _block(entry: object, number: int) -> tuple[BlockId, bytes]:
    if not isinstance(entry, dict):
        raise BadDataError(f"Block {number} of the image is not an object.")
    access_code, channel = entry.get("access_code"), entry.get("channel")
    if type(access_code) is not int or not 0 <= access_code <= 255:
        raise BadDataError(f'"access_code" of block {number} is not a number from 0 to 255.')
    if type(channel) is not int or not 0 <= channel <= 0xFFFF:
        raise BadDataError(f'"channel" of block {number} is not a number from 0 to 65535.')
    return (channel, access_code), _hex(entry.get("teds"), f"teds of block {number}")


def _hex(value: object, name: str) -> bytes:
    if not isinstance(value, str):
        raise BadDataError(f'"{name}" is not a string of hex digits.')
    try:
        return bytes.fromhex(value)
    except ValueError as error:
        raise BadDataError(f'"{name}" is not a string of hex digits.') from error


# One TEDS with its place, and splitting a sequence of framed TEDS.


class TedsBlock(NamedTuple):
    """A TEDS or bare data block: its channel and access code if they are known, and its octets unchanged."""

    channel: int | None
    access_code: int | None
    octets: bytes


def class_of(octets: bytes) -> int | None:
    """Return the access code in the TEDSID of a framed TEDS or a bare data block, None if there is none."""
    framed = teds_class(octets[4:])
    return framed if framed is not None else teds_class(octets)


def split_run(octets: bytes) -> list[bytes]:
    """Return framed TEDS that follow one another; everything as one piece if they do not close to the octet."""
    pieces: list[bytes] = []
    at = 0
    while at < len(octets):
        end = at + 4 + int.from_bytes(octets[at : at + 4], "big")
        piece = octets[at:end]
        if len(piece) < MINIMUM_OCTETS or end > len(octets) or octets[at + 4] != 3:
            return [octets]
        if pieces or end < len(octets):
            stated = int.from_bytes(piece[-2:], "big")
            if stated != checksum(piece[:-2]):
                return [octets]
        pieces.append(piece)
        check_count(len(pieces), LIMITS.teds_of_a_file, "TEDS")
        at = end
    return pieces


def with_class(octets: bytes) -> TedsBlock:
    """Return a block whose access code is the class that its TEDSID names."""
    return TedsBlock(None, class_of(octets), octets)


def is_run(blocks: Sequence[TedsBlock]) -> bool:
    """Return True if concatenated blocks can be separated again."""
    return [block.octets for block in blocks] == split_run(b"".join(block.octets for block in blocks))
