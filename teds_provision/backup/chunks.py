"""A long secret as sealed chunks, so that neither writer nor reader ever holds more than one of them.

The STREAM construction of Hoang, Reyhanitabar, Rogaway and Vizár (CRYPTO 2015), as age uses it, over AES-256-GCM:
chunk ``i`` (from 0) is sealed under the nonce ``i`` (11 octets, big-endian) ‖ 1 for the last chunk, else 0. The key is
good for one file. Every chunk but the last is full. A chunk that was changed, moved, doubled or dropped, and an end
that was cut off or carried on, fail at a tag.
"""

from __future__ import annotations

import hashlib
from typing import BinaryIO, Final, Protocol

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.protocol.primitives import aead, exceptions

CHUNK_OCTETS: Final = 1 << 20
KEY_OCTETS: Final = 32
TAG_OCTETS: Final = 16
END: Final = b"teds-backup end\n"
"""Follows the last chunk, in the clear: a file without it was cut off, which needs another cure than a changed one."""
_NONCE_COUNTER_OCTETS: Final = 11
_FULL: Final = CHUNK_OCTETS + TAG_OCTETS


class OctetSource(Protocol):
    """A source of octets in order."""

    def read(self, size: int, /) -> bytes:
        """Return up to ``size`` octets; fewer only at the end."""


class ChunkWriter:
    """Seals what is written into chunks; :meth:`end` must follow. ``context`` is bound to every chunk."""

    def __init__(self, out: BinaryIO, key: bytes, context: bytes) -> None:
        self._out, self._cipher, self._context = out, aead.AESGCM(key), context
        self._buffer = bytearray()
        self._index = 0
        self.digest = hashlib.sha256()
        """Over everything written so far, in the clear."""

    def write(self, octets: bytes) -> None:
        """Take octets; a chunk leaves when it is full and more came after it."""
        self.digest.update(octets)
        self._buffer += octets
        while len(self._buffer) > CHUNK_OCTETS:
            self._seal(bytes(self._buffer[:CHUNK_OCTETS]), last=False)
            del self._buffer[:CHUNK_OCTETS]

    def end(self) -> None:
        """Seal the rest as the last chunk."""
        self._seal(bytes(self._buffer), last=True)
        self._buffer.clear()
        self._out.write(END)

    def _seal(self, chunk: bytes, *, last: bool) -> None:
        self._out.write(self._cipher.encrypt(_nonce(self._index, last=last), chunk, self._context))
        self._index += 1


class ChunkReader:
    """Opens what :class:`ChunkWriter` wrote, a chunk at a time.

    Raises NotAuthenticError (changed), BadDataError (cut off, or something follows the end).
    """

    def __init__(self, source: OctetSource, key: bytes, context: bytes) -> None:
        self._source, self._cipher, self._context = source, aead.AESGCM(key), context
        self._ahead = self._plain = b""
        self._place = self._index = 0
        self._done = False
        self.digest = hashlib.sha256()
        """Over everything given out so far."""

    def read(self, size: int) -> bytes:
        """Return exactly ``size`` octets; fewer raise BadDataError."""
        parts = []
        while size > 0:
            if self._place == len(self._plain) and not self._next():
                raise BadDataError("The content of the backup is incomplete.")
            part = self._plain[self._place : self._place + size]
            self._place += len(part)
            size -= len(part)
            parts.append(part)
        octets = b"".join(parts)
        self.digest.update(octets)
        return octets

    def read_line(self, limit: int) -> bytes:
        """Return the octets up to a line feed, which goes too; more than ``limit`` raise BadDataError."""
        line = bytearray()
        while (octet := self.read(1)) != b"\n":
            line += octet
            if len(line) > limit:
                raise BadDataError("The content of the backup has no header.")
        return bytes(line)

    def require_end(self) -> None:
        """Raise BadDataError unless everything was given out."""
        if self._place != len(self._plain) or self._next():
            raise BadDataError("The backup has data after its end.")

    def _next(self) -> bool:
        """Open the next chunk; False after the last."""
        if self._done:
            return False
        self._ahead += self._source.read(_FULL + len(END) + 1 - len(self._ahead))
        last = len(self._ahead) <= _FULL + len(END)
        if last and not self._ahead.endswith(END):
            raise BadDataError("The backup was cut off: its end is missing.", hint="Use another copy.")
        sealed = self._ahead[: -len(END)] if last else self._ahead[:_FULL]
        self._ahead = b"" if last else self._ahead[_FULL:]
        try:
            self._plain = self._cipher.decrypt(_nonce(self._index, last=last), sealed, self._context)
        except (exceptions.InvalidTag, ValueError):
            raise NotAuthenticError("The backup was damaged or changed.", hint="Use another copy.") from None
        self._place, self._done = 0, last
        self._index += 1
        return bool(self._plain)


def _nonce(index: int, *, last: bool) -> bytes:
    return index.to_bytes(_NONCE_COUNTER_OCTETS, "big") + (b"\1" if last else b"\0")
