"""The Security TEDS of the profile: canonical form, fields, what is signed (profile.md, "The Security TEDS").

Pure octets: no cryptography here. Signing and verifying is ``protocol.datasheet``. Access code 128 (ours); the Security
TEDS of the 2024 edition (access code 16) is another thing.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from struct import Struct
from types import MappingProxyType
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import frame, raw_tuple, unframe
from teds_provision.teds.image import BlockId, Image

TEDSID_TUPLE: Final = bytes.fromhex("030400800101")

SIGNATURE, NODE_KEY, NODE_KEY_SIGNATURE, STATION_KEY, STATION_KEY_SIGNATURE = 100, 101, 102, 103, 104
SIGNED_BLOCK, PROFILE_VERSION, SESSION_SUITE, KEY_AGREEMENT = 108, 105, 109, 110

# The profile's values for Tables 2 to 5, ProfileVersion, SessionSuite and KeyAgreement; no others are built or
# accepted.
OUR_VALUES: Final[Mapping[int, int]] = MappingProxyType({1: 4, 2: 2, 3: 0, 4: 1, 105: 1, 109: 2, 110: 2})
_U8 = (1, 2, 3, 4, 105, 109, 110)
_BASE64 = {100: 64, 101: 65, 102: 64, 103: 65, 104: 64}
_OCTETS = dict.fromkeys(_U8, 1) | dict.fromkeys(_BASE64, 88) | {6: 8, 106: 4, 107: 4}
_KNOWN = {1, 2, 3, 4, 5, 6, *range(100, 111)}
INITIAL_FIELDS: Final = frozenset({1, 2, 3, 4, 5, 6, 101, 102, 105, 106, 107, 109, 110})


CA_OCTETS = 64
CA_NAME_OCTETS = 47


class NotCanonicalError(BadDataError):
    """The octets are not a canonical Security TEDS of profile version 1."""

    code = "not-canonical"


@dataclass(frozen=True)
class SecurityTeds:
    """Fields of a canonical Security TEDS, keys and signatures raw (points 65 octets, signatures 64).

    ``last_modified`` is the 8-octet TimeInstance (u32 s, u32 ns, UTC); ``signed_blocks`` maps (channel, access code) to
    the 32-octet SHA-256 of that TEDS; ``extra`` holds types 111 to 255, which are skipped but covered by the signature.
    A field that is None or absent is not written: the initial Security TEDS has no 100, 103, 104.
    """

    node_key: bytes
    node_key_signature: bytes
    sequence: int = 0
    key_epoch: int = 0
    ca: str = ""
    last_modified: bytes = bytes(8)
    signature: bytes | None = None
    station_key: bytes | None = None
    station_key_signature: bytes | None = None
    signed_blocks: Mapping[BlockId, bytes] = field(default_factory=lambda: MappingProxyType({}))
    values: Mapping[int, int] = field(default_factory=lambda: OUR_VALUES)
    extra: Mapping[int, bytes] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def signed(self) -> bool:
        """True if it holds the signature and the keys that a signed one must hold."""
        return None not in (self.signature, self.station_key, self.station_key_signature)

    def block(self) -> bytes:
        """Return the data block, TEDSID tuple included."""
        out = {number: bytes([value]) for number, value in self.values.items()}
        out |= {5: self.ca.encode(), 6: self.last_modified}
        out |= {106: self.sequence.to_bytes(4, "big"), 107: self.key_epoch.to_bytes(4, "big")}
        keys = (self.signature, self.node_key, self.node_key_signature, self.station_key, self.station_key_signature)
        out |= {n: base64.b64encode(key) for n, key in zip(range(100, 105), keys, strict=True) if key is not None}
        parts = [(number, value) for number, value in {**out, **self.extra}.items()]
        parts += [
            (SIGNED_BLOCK, channel.to_bytes(2, "big") + bytes([access_code]) + digest)
            for (channel, access_code), digest in self.signed_blocks.items()
        ]
        return TEDSID_TUPLE + b"".join(raw_tuple(number, value) for number, value in sorted(parts))

    def encode(self) -> bytes:
        """Return the framed TEDS."""
        return frame(self.block())

    def with_signature(self, signature: bytes) -> SecurityTeds:
        """Return this TEDS with field 100 filled in."""
        return replace(self, signature=signature)

    def __repr__(self) -> str:
        shown = (f.name for f in fields(self) if f.name in {"sequence", "key_epoch", "ca"})
        return f"SecurityTeds({', '.join(f'{name}={getattr(self, name)!r}' for name in shown)})"


def initial(node_key: bytes, node_key_signature: bytes, *, sequence: int, key_epoch: int) -> bytes:
    """Return the initial Security TEDS that a node shows until the first commit after its last reset."""
    return SecurityTeds(node_key, node_key_signature, sequence=sequence, key_epoch=key_epoch).encode()


def other_wire(shown: SecurityTeds) -> str:
    """Name the unsupported ProfileVersion, SessionSuite or KeyAgreement; empty if all are supported."""
    named = {PROFILE_VERSION: "ProfileVersion", SESSION_SUITE: "SessionSuite", KEY_AGREEMENT: "KeyAgreement"}
    for number, name in named.items():
        if shown.values[number] != OUR_VALUES[number]:
            return f"{name} {shown.values[number]}; {OUR_VALUES[number]} is spoken here"
    return ""


def require_our_wire(image: Image) -> Image:
    """Return an image of a supported wire.

    Raises BadDataError, by name, for one whose Security TEDS needs an unsupported one.

    An image without, or with a foreign kind of Security TEDS, is left to the caller to judge.
    """
    octets = image.security
    try:
        other = other_wire(decode(octets)) if octets is not None else ""
    except NotCanonicalError:
        other = ""
    if other:
        raise BadDataError(
            f"The image names {other}.",
            hint="It is of a time before this wire; nothing of it was released. Read or build the datasheet again.",
        )
    return image


def ca_hint(name: str, ca_fingerprint: str) -> str:
    """Return field 5: ``name:`` and the first 16 hex digits; the name is cut to 47 octets at a character."""
    cut = name.encode()[:CA_NAME_OCTETS].decode(errors="ignore")
    return f"{cut}:{ca_fingerprint[:16]}"


@lru_cache(maxsize=128)  # more than the 64 files that are verified together
def decode(teds: bytes) -> SecurityTeds:
    """Decode a framed Security TEDS in canonical form; raises NotCanonicalError with the rule that it breaks.

    Every step of a provisioning decodes the same octets, so the last results are cached: they are immutable.
    """
    try:
        block, layout, values = _walked(teds)
    except BadDataError as error:
        raise NotCanonicalError(error.message) from error
    return _read(block, layout, values)


@lru_cache(maxsize=128)  # cached too: after decode, the same octets are verified
def _walked(teds: bytes) -> tuple[bytes, _Layout, tuple[bytes, ...]]:
    """Return the data block of a framed Security TEDS, its layout and the values; raises BadDataError."""
    block = unframe(teds)
    return block, *_cut(block)


def decode_block(block: bytes) -> SecurityTeds:
    """Read the data block of a Security TEDS; raises NotCanonicalError."""
    try:
        layout, values = _cut(block)
    except BadDataError as error:
        raise NotCanonicalError(error.message) from error
    return _read(block, layout, values)


def decode_with_tbs(uuid: bytes, teds: bytes) -> tuple[SecurityTeds, bytes]:
    """Decode and compute :func:`tbs` in one pass, for callers that check many TEDS once each."""
    block = unframe(teds)
    layout, values = _cut(block)
    return _read(block, layout, values), _without_signature(uuid, block, layout)


def _read(block: bytes, layout: _Layout, found: tuple[bytes, ...]) -> SecurityTeds:
    if block[:6] != TEDSID_TUPLE:
        raise NotCanonicalError("The first tuple of the Security TEDS is not exactly 03 04 00 80 01 01.")
    if layout.fault:
        raise NotCanonicalError(layout.fault)
    values = {number: found[place] for number, place in layout.fields}
    raw = {number: _base64(number, values[number]) for number in _BASE64 if number in values}
    return SecurityTeds(
        node_key=raw[NODE_KEY],
        node_key_signature=raw[NODE_KEY_SIGNATURE],
        sequence=int.from_bytes(values[106], "big"),
        key_epoch=int.from_bytes(values[107], "big"),
        ca=_text(values[5]),
        last_modified=values[6],
        signature=raw.get(SIGNATURE),
        station_key=raw.get(STATION_KEY),
        station_key_signature=raw.get(STATION_KEY_SIGNATURE),
        signed_blocks=MappingProxyType(_signed_blocks(found[layout.blocks])),
        values=MappingProxyType({number: values[number][0] for number in _U8}),
        extra=MappingProxyType({number: values[number] for number in layout.extra}),
    )


def tbs(uuid: bytes, teds: bytes) -> bytes:
    """Return what field 100 signs: label ‖ UUID ‖ the data block without the tuple of type 100, cut from the octets."""
    block, layout, _ = _walked(teds)
    return _without_signature(uuid, block, layout)


def _without_signature(uuid: bytes, block: bytes, layout: _Layout) -> bytes:
    return b"".join([b"TEDS1 datasheet\0", uuid, *(block[part] for part in layout.signed)])


def has_profile_version(teds: bytes) -> bool:
    """Return True if the tuples close and field 105 is there: such a TEDS is canonical or refused."""
    try:
        return any(number == PROFILE_VERSION for number, _, _ in _places(unframe(teds)))
    except BadDataError:
        return False


_MOST_TUPLES: Final = 256
"""Longer blocks are walked each time: their layouts would take much memory."""
_LAYOUTS: Final[dict[int, _Layout]] = {}
"""The last layout of each length of a data block."""
_MOST_LAYOUTS: Final = 64


@dataclass(frozen=True, eq=False, repr=False)
class _Layout:
    """Types and lengths of a data block's tuples, and all that follows from them alone.

    The datasheets of a line differ in values, so that this is worked out once for thousands of them. ``heads``: type
    and length of each tuple; ``fault``: why no such block is canonical, empty if it may be; ``fields``: number and
    place of every field but the SignedBlocks, which lie at ``blocks``; ``extra``: numbers from 111 on; ``signed``: the
    parts of the block that field 100 signs.
    """

    parts: Struct
    heads: tuple[bytes, ...]
    fault: str
    fields: tuple[tuple[int, int], ...]
    blocks: slice
    extra: tuple[int, ...]
    signed: tuple[slice, ...]


def _cut(block: bytes) -> tuple[_Layout, tuple[bytes, ...]]:
    """Return the layout of a data block and the value of each tuple; raises BadDataError for a cut one."""
    layout = _LAYOUTS.get(len(block))
    if layout is not None:
        parts = layout.parts.unpack(block)
        # Each head determines the next offset; if all heads are equal, so are all offsets.
        if parts[::2] == layout.heads:
            return layout, parts[1::2]
    places = _places(block)
    layout = _layout(block, places)
    if len(places) <= _MOST_TUPLES:
        if len(_LAYOUTS) >= _MOST_LAYOUTS:
            _LAYOUTS.clear()
        _LAYOUTS[len(block)] = layout
    return layout, tuple(block[start:end] for _, start, end in places)


def _layout(block: bytes, places: list[tuple[int, int, int]]) -> _Layout:
    numbers = [number for number, _, _ in places]
    first = next((place for place, number in enumerate(numbers) if place and number == SIGNED_BLOCK), 0)
    signed, done = [], 0
    for number, start, end in places:
        if number == SIGNATURE:
            signed.append(slice(done, start - 2))
            done = end
    fields = tuple((number, place) for place, number in enumerate(numbers) if place and number != SIGNED_BLOCK)
    return _Layout(
        parts=Struct("".join(f"2s{end - start}s" for _, start, end in places)),
        heads=tuple(block[start - 2 : start] for _, start, _ in places),
        fault=_fault(places[1:]),
        fields=fields,
        blocks=slice(first, first + numbers[1:].count(SIGNED_BLOCK)),
        extra=tuple(number for number, _ in fields if number >= 111),
        signed=(*signed, slice(done, len(block))),
    )


def _places(block: bytes) -> list[tuple[int, int, int]]:
    """Return type, start and end of every tuple's value (one length octet each); raises BadDataError for a cut one."""
    places, at, size = [], 0, len(block)
    try:
        while at < size:
            start = at + 2
            end = start + block[at + 1]
            places.append((block[at], start, end))
            at = end
    except IndexError:  # a type alone, without its length
        places.append((block[at], start, start))
        at = size + 1
    if at > size:
        raise BadDataError(f"The tuple of type {places[-1][0]} runs past the end of the data block.")
    return places


def _fault(places: list[tuple[int, int, int]]) -> str:
    """Return which rule about order, fields and lengths the tuples after the TEDSID break; empty for none."""
    lengths: dict[int, int] = {}
    last = 0
    for number, start, end in places:
        if number < last or (number == last and number != SIGNED_BLOCK):
            return f"Field {number} of the Security TEDS is out of ascending order or occurs twice."
        last = number
        if number == SIGNED_BLOCK:
            continue
        lengths[number] = end - start
        wanted = _OCTETS.get(number)
        if wanted is not None and end - start != wanted:
            return f"Field {number} of the Security TEDS has {end - start} octets, not {wanted}."
    unknown = lengths.keys() - _KNOWN
    if unknown and min(unknown) < 111:
        return f"The Security TEDS holds a field {min(unknown)} that the profile does not know."
    if lengths.get(5, 0) > CA_OCTETS:
        return f"Field 5 (CA) has {lengths[5]} octets; at most {CA_OCTETS} are allowed."
    missing = INITIAL_FIELDS - lengths.keys()
    if missing:
        return f"The Security TEDS lacks field {min(missing)}."
    return ""


def _signed_blocks(values: Sequence[bytes]) -> dict[BlockId, bytes]:
    blocks: dict[BlockId, bytes] = {}
    last = b""
    for value in values:
        if len(value) != 35:
            raise NotCanonicalError(f"A SignedBlock has {len(value)} octets, not 35.")
        if value[:3] <= last:
            raise NotCanonicalError("The SignedBlocks do not ascend by channel and access code.")
        last = value[:3]
        if value[:3] == b"\x00\x00\x80":
            raise NotCanonicalError("The Security TEDS lists itself as a SignedBlock.")
        blocks[int.from_bytes(value[:2], "big"), value[2]] = value[3:]
    return blocks


def _base64(number: int, value: bytes) -> bytes:
    try:
        raw = binascii.a2b_base64(value, strict_mode=True)
    except binascii.Error as error:
        raise NotCanonicalError(f"Field {number} of the Security TEDS is not base64.") from error
    if len(raw) != _BASE64[number] or binascii.b2a_base64(raw, newline=False) != value:
        raise NotCanonicalError(
            f"Field {number} of the Security TEDS is not canonical base64 of {_BASE64[number]} octets."
        )
    return raw


def _text(value: bytes) -> str:
    try:
        return value.decode()
    except UnicodeDecodeError as error:
        raise NotCanonicalError("Field 5 (CA) of the Security TEDS is not UTF-8.") from error
