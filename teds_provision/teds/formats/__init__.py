"""TEDS in files: recognised, read and written in every format that is known here.

==========  =======================================  ==========================================================
kind        what                                     holds
==========  =======================================  ==========================================================
binary      octets, one TEDS after the other         octets; no channels
hex         hex digits with comments                 everything
ihex        Intel HEX                                octets; no channels
json        field tree with names (``teds/1``)       everything
xml         the same as XML (``schema/teds-1.xsd``)  everything
image       all TEDS of one node (``teds-image/1``)  framed TEDS with channels; needs a Meta-TEDS with the UUID
toml        profile of a transducer type             what a type has: see :func:`lost`
==========  =======================================  ==========================================================

A sealed handover ``bundle`` is recognised, but holds no TEDS that could be read here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Literal, get_args

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count, check_size, load_json
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.formats.intelhex import looks_like_hex, read_hex, read_intel_hex, write_hex, write_intel_hex
from teds_provision.teds.formats.jsonform import read_json, write_json
from teds_provision.teds.formats.profileform import read_profile, write_profile
from teds_provision.teds.formats.xmlform import read_xml, write_xml
from teds_provision.teds.image import BlockId, Image, TedsBlock, class_of, is_run, split_run, with_class
from teds_provision.teds.sheet import Sheet

__all__ = [
    "FORMATS",
    "Format",
    "Kind",
    "TedsBlock",
    "class_of",
    "detect",
    "lost",
    "read_blocks",
    "with_class",
    "write_blocks",
]

Format = Literal["binary", "hex", "ihex", "json", "xml", "image", "toml"]
Kind = Literal["binary", "hex", "ihex", "json", "xml", "image", "toml", "bundle"]
FORMATS: Final[tuple[str, ...]] = get_args(Format)
# A JSON list; in TOML, "[" would begin the name of a table.
_JSON_LIST: Final = re.compile(r"\[\s*(?:\{|\]|\[\s*[\[\]{])")
_CONTROL: Final = re.compile(r"[\x00-\x08\x0b\x0e-\x1f]")


def detect(octets: bytes) -> Kind:
    """Return what a file holds, by its content alone; non-text is binary. Raises BadDataError for an empty file."""
    if not octets:
        raise BadDataError("The file is empty.")
    text = _text(octets)
    if text is None:
        return "binary"
    stripped = text.lstrip()
    if stripped.startswith("<"):
        return "xml"
    if stripped.startswith("{") or _JSON_LIST.match(stripped):
        return _json_kind(text)
    if stripped.startswith(":"):
        return "ihex"

    if looks_like_hex(text):
        return "hex"
    return "toml" if "=" in text or stripped.startswith("[") else "hex"


def _text(octets: bytes) -> str | None:
    """Return the text of a file, None if it holds control characters or is no UTF-8."""
    try:
        text = octets[: LIMITS.teds_file].decode("utf-8-sig")
    except UnicodeDecodeError:
        return None
    return None if _CONTROL.search(text) else text


def _json_kind(text: str) -> Kind:
    try:
        data = load_json(text, "the file")
    except BadDataError:
        return "json"
    if isinstance(data, dict) and data.get("format") == "teds-image/1":
        return "image"
    return "bundle" if isinstance(data, dict) and "ciphertext" in data else "json"


def read_blocks(octets: bytes, kind: Kind | None = None, *, path: Path | None = None) -> list[TedsBlock]:
    """Return the TEDS of a file as (channel or None, access code or None, octets).

    ``path`` is the path of a profile, so that what it extends is found beside it. Raises BadDataError for a file that
    does not match its kind, with the place of the fault. Octets that make no TEDS are no fault here: decoding them
    gives the findings.
    """
    check_size(len(octets), LIMITS.teds_file, "the file")
    blocks = _read(octets, kind or detect(octets), path)
    check_count(len(blocks), LIMITS.teds_of_a_file, "TEDS")
    return blocks


def _read(octets: bytes, kind: Kind, path: Path | None) -> list[TedsBlock]:
    if kind == "binary":
        return [with_class(piece) for piece in split_run(octets)]
    if kind == "xml":
        return read_xml(octets)
    try:
        text = octets.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadDataError(f"Octet {error.start} of the file is not UTF-8 text.") from error
    return _read_text(text, kind, path)


def _read_text(text: str, kind: Kind, path: Path | None) -> list[TedsBlock]:
    if kind == "hex":
        return read_hex(text)
    if kind == "ihex":
        return read_intel_hex(text)
    if kind == "json":
        return read_json(text)
    if kind == "image":
        image = Image.from_json(text)
        return [TedsBlock(channel, code, image.blocks[channel, code]) for channel, code in image]
    if kind == "toml":
        return read_profile(text, path)
    raise BadDataError("A sealed bundle holds keys for other stations, no TEDS that can be read here.")


def write_blocks(blocks: Sequence[TedsBlock], format: Format) -> bytes | str:
    """Write TEDS: octets for binary, text for every other format; :func:`lost` lists what the format cannot hold.

    Raises BadDataError if nothing sensible can be written: several TEDS that would run into each other in a binary
    file, an image of a node without UUID.
    """
    if format == "binary":
        if len(blocks) > 1 and not is_run(blocks):
            raise BadDataError(
                "Several TEDS can be in one binary file only if each has a right Length and checksum.",
                hint="Use hex, json or xml.",
            )
        return b"".join(block.octets for block in blocks)
    if format == "hex":
        return write_hex(blocks)
    if format == "ihex":
        return write_intel_hex(blocks)
    if format == "json":
        return write_json(blocks)
    if format == "xml":
        return write_xml(blocks)
    if format == "image":
        return _image(blocks)

    return write_profile(blocks)[0]


def lost(blocks: Sequence[TedsBlock], format: Format) -> tuple[str, ...]:
    """Return what the format cannot hold of these TEDS, one sentence each; empty if writing loses nothing."""
    if format == "toml":
        return write_profile(blocks)[1]
    if format in {"binary", "ihex"} and any(block.channel is not None for block in blocks):
        return ("the channels of the TEDS.",)
    return ()


def _image(blocks: Sequence[TedsBlock]) -> str:
    placed: dict[tuple[int, int], bytes] = {}
    for channel, code, octets in blocks:
        if channel is None or code is None:
            raise BadDataError("An image holds TEDS with channel and access code.", hint="Use hex, json or xml.")
        if (channel, code) in placed:
            raise BadDataError(f"Two TEDS stand at channel {channel}, access code {code}; an image holds one of each.")
        placed[channel, code] = octets
    uuid = decode(placed[0, 1]).get("UUID") if (0, 1) in placed else None
    if not isinstance(uuid, bytes) or len(uuid) != 10:
        raise BadDataError(
            "An image needs a Meta-TEDS on channel 0 with a UUID of 10 octets.", hint="Use hex, json or xml."
        )
    return Image(uuid, placed).to_json()


# Finds the TEDS of one node in a document: the channel of each, and the UUID of the node.

UUID_OCTETS: Final = 10
_META: Final[BlockId] = (0, AccessCode.META)
_UUID_FIELD: Final = 4
_OF_A_CHANNEL: Final = frozenset({AccessCode.CHANNEL, AccessCode.CALIBRATION})


def placed(octets: bytes, kind: Kind | None = None, *, path: Path | None = None) -> dict[BlockId, bytes]:
    """Return the TEDS of a document by channel and access code, without the Security TEDS.

    TEDS of a channel alone are of channel 1. ``path`` is the path of a profile, for what it extends. Raises
    BadDataError for a file without TEDS, or two of one place.
    """
    found: dict[BlockId, bytes] = {}
    for channel, code, teds in read_blocks(octets, kind or detect(octets), path=path):
        if code is None:
            raise BadDataError(
                "There are octets in it that are no TEDS.", hint="See what it holds: teds-provision show FILE"
            )
        usual = 1 if code in _OF_A_CHANNEL else 0
        key = (usual if channel is None else channel, int(code))
        if key in found:
            raise BadDataError(f"It holds two TEDS of access code {code} for channel {key[0]}.")
        found[key] = teds
    found = {key: teds for key, teds in found.items() if key[1] != AccessCode.SECURITY}
    if not found:
        raise BadDataError("It holds no TEDS.")
    return found


def stated_uuid(blocks: Mapping[BlockId, bytes]) -> bytes | None:
    """Return the UUID in the Meta-TEDS, 10 octets; None if it has none, or zeros."""
    stated = Sheet.from_blocks(blocks).meta.uuid
    return stated if stated and len(stated) == UUID_OCTETS and any(stated) else None


def under(blocks: Mapping[BlockId, bytes], uuid: bytes) -> dict[BlockId, bytes]:
    """Return the same TEDS with another UUID in field 4 of a Meta-TEDS of the 2007 form."""
    meta = blocks.get(_META)
    if meta is None or stated_uuid(blocks) == uuid:
        return dict(blocks)
    parts = [
        raw_tuple(part.type, uuid if part.type == _UUID_FIELD and len(part.value) == UUID_OCTETS else part.value)
        for part in tuples(unframe(meta))
    ]
    return {**blocks, _META: frame(b"".join(parts))}
