"""Images as they lie in the store: octets, deflated, with what their Security TEDS says beside them."""

from __future__ import annotations

import struct
import zlib
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from teds_provision.errors import BadData
from teds_provision.lazy import late
from teds_provision.store.records import iso
from teds_provision.teds.image import BlockId, Image

if TYPE_CHECKING:
    from teds_provision.teds.codec import security
else:  # commands that only list decode no TEDS
    security = late("teds_provision.teds.codec.security")

_BLOCK = struct.Struct(">HBI")
_MAX_OCTETS = 64 << 20


def datasheet_row(image: Image, profile: str | None, seen: str) -> tuple[Any, ...]:
    """The row of an image: what its Security TEDS says of sequence, epoch and time, its digest, its octets."""
    sequence = epoch = 0
    signed: str | None = None
    if image.security is not None:
        try:
            said = security.decode(image.security)
        except BadData:
            pass
        else:
            sequence, epoch = said.sequence, said.key_epoch
            if said.signed:
                signed = iso(datetime.fromtimestamp(int.from_bytes(said.last_modified[:4], "big"), UTC))
    return image.uuid, sequence, epoch, signed, profile, seen, bytes.fromhex(image.digest()), packed(image)


def packed(image: Image) -> bytes:
    """The blocks of an image, ascending, deflated: channel u16, access code u8, length u32, octets."""
    parts = (_BLOCK.pack(channel, code, len(image.blocks[channel, code])) for channel, code in image)
    whole = b"".join(head + image.blocks[block] for head, block in zip(parts, image, strict=True))
    return _deflated(whole)


@lru_cache(maxsize=4)
def _deflated(whole: bytes) -> bytes:
    """An image is kept as a draft, and as it is written a moment later."""
    return zlib.compress(whole, 9)


def unpacked(uuid: bytes, octets: bytes) -> Image:
    """What :func:`packed` gave; raises ValueError for anything else."""
    inflate = zlib.decompressobj()
    try:
        whole = inflate.decompress(octets, _MAX_OCTETS)
    except zlib.error as error:
        raise ValueError from error
    if not inflate.eof:
        raise ValueError
    blocks: dict[BlockId, bytes] = {}
    place = 0
    while place < len(whole):
        try:
            channel, code, length = _BLOCK.unpack_from(whole, place)
        except struct.error as error:
            raise ValueError from error
        place += _BLOCK.size
        if place + length > len(whole):
            raise ValueError
        blocks[channel, code] = whole[place : place + length]
        place += length
    return Image(uuid, blocks)
