"""SMP packets as Manage (128.23) carries them: header, and a body that is one CBOR map (profile.md, "Manage").

cbor2 decodes; what it would take beyond plain values (tags, floating numbers, undefined) is refused here.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple, NoReturn

from teds_provision.errors import NotFoundError
from teds_provision.lazy import how_to_install

HEADER_OCTETS: Final = 8
LEAST_OCTETS: Final = HEADER_OCTETS + 1
MANAGE_OVERHEAD: Final = 53
"""Octets of a longest message that a packet in a session does not have: command frame, seal and padding."""
READ, WRITE = 0x08, 0x0A
"""First octet of a request in version 2; a reply has the next number."""
_MOST_DEPTH: Final = 8

_OS, _IMAGE = 0, 1
SMP_ERROR_KEYS: Final = ("rc", "err")
"""A reply with one of these is no success: SMP's errors of version 1 and 2."""


class SmpCommand(NamedTuple):
    """Command of a packet: first octet, group, command id."""

    first: int
    group: int
    number: int


ECHO: Final = SmpCommand(WRITE, _OS, 0)
RESTART: Final = SmpCommand(WRITE, _OS, 5)
PARAMETERS: Final = SmpCommand(READ, _OS, 6)
BOOT_LOADER: Final = SmpCommand(READ, _OS, 8)
STATES: Final = SmpCommand(READ, _IMAGE, 0)
SET_STATE: Final = SmpCommand(WRITE, _IMAGE, 0)
UPLOAD: Final = SmpCommand(WRITE, _IMAGE, 1)
SLOTS: Final = SmpCommand(READ, _IMAGE, 6)
LISTED: Final = frozenset({ECHO, RESTART, PARAMETERS, BOOT_LOADER, STATES, SET_STATE, UPLOAD, SLOTS})
"""The commands that pass; every other one gets 3."""
EMPTY_MAP: Final = b"\xa0"


class SmpPacket(NamedTuple):
    """A packet: its command, sequence number and CBOR body; ``whole``: flags are 0 and its length is right."""

    command: SmpCommand
    sequence: int
    body: bytes
    whole: bool

    @property
    def header(self) -> bytes:
        """Return the 8 octets before the body."""
        command = self.command
        head = bytes([command.first, 0]) + len(self.body).to_bytes(2, "big")
        return head + command.group.to_bytes(2, "big") + bytes([self.sequence, command.number])

    def encode(self) -> bytes:
        """Return the packet."""
        return self.header + self.body

    def reply(self, body: bytes) -> SmpPacket:
        """Return the reply to this request with another body."""
        return self._replace(command=self.command._replace(first=self.command.first + 1), body=body)


def decode_packet(octets: bytes) -> SmpPacket:
    """Read a packet of 9 octets or more; raises ValueError if it is shorter."""
    if len(octets) < LEAST_OCTETS:
        raise ValueError("an SMP packet has 9 octets or more")
    command = SmpCommand(octets[0], int.from_bytes(octets[4:6], "big"), octets[7])
    whole = octets[1] == 0 and int.from_bytes(octets[2:4], "big") == len(octets) - HEADER_OCTETS
    return SmpPacket(command, octets[6], octets[HEADER_OCTETS:], whole)


def decode_map(body: bytes) -> dict[str, Any]:
    """Read a body: one map of text to text, whole numbers, booleans, null, octets, lists and maps, and no more.

    Raises ValueError for anything else, NotFoundError if cbor2 is not installed.
    """
    try:
        import cbor2
    except ModuleNotFoundError as error:
        raise NotFoundError("Firmware updates need the package cbor2.", hint=how_to_install("update")) from error
    stream = io.BytesIO(body)
    try:
        decoder = cbor2.CBORDecoder(
            stream,
            tag_hook=_refuse_tag,
            semantic_decoders=_EveryTag(),
            max_depth=_MOST_DEPTH,
            allow_duplicate_keys=False,
            strict_hashable_types=True,
        )
        value = decoder.decode()
    except (cbor2.CBORError, ValueError, EOFError, OverflowError, MemoryError) as error:
        raise ValueError(f"the body is not the CBOR of a map: {error}") from error
    if not isinstance(value, dict) or stream.tell() != len(body):
        raise ValueError("the body is not one CBOR map")
    _require_plain(value)
    return value


def encode_map(values: Mapping[str, Any]) -> bytes:
    """Return the CBOR of a map."""
    import cbor2

    return bytes(cbor2.dumps(dict(values), canonical=True))


def _require_plain(value: object) -> None:
    if isinstance(value, dict):
        if not all(isinstance(key, str) for key in value):
            raise ValueError("a key of the map is no text")
        for entry in value.values():
            _require_plain(entry)
    elif isinstance(value, list):
        for entry in value:
            _require_plain(entry)
    elif not isinstance(value, str | int | bytes | None):
        raise ValueError(f"the map has a value of the type {type(value).__name__}")


def _refuse_tag(*_: object) -> NoReturn:
    raise ValueError("a CBOR tag")


class _EveryTag(Mapping[int, Any]):
    """Refuses every tag, also those that cbor2 turns into plain numbers and texts by itself."""

    def __getitem__(self, _tag: int) -> Any:
        return _refuse_tag

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[int]:
        return iter(())
