"""The framing of NDEF messages (NFC Forum NDEF 1.0, section 3.2): octets to records and back.

The content of foreign records is ignored, so that one bad text record on a tag cannot hide the records that matter.
Pure; imports no NFC library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from teds_provision.errors import GarbledError

WELL_KNOWN, EXTERNAL = 1, 4
_NAMES = ("empty", "urn:nfc:wkt:", "", "", "urn:nfc:ext:", "unknown", "unchanged", "reserved")


@dataclass(frozen=True)
class NdefRecord:
    """One NDEF record: ``tnf`` 0 to 7 (type name format), type, payload and id as octets."""

    tnf: int
    type: bytes
    payload: bytes = b""
    id: bytes = b""

    @property
    def name(self) -> str:
        """The type as people write it, e.g. ``urn:nfc:wkt:U`` or ``text/plain``; all but printable ASCII escaped."""
        return _NAMES[self.tnf] + "".join(chr(octet) if 32 <= octet < 127 else f"\\x{octet:02x}" for octet in self.type)

    def is_external(self, name: bytes) -> bool:
        """Return True if this is the external type ``name`` (compared without case, as the NFC Forum requires)."""
        return self.tnf == EXTERNAL and self.type.lower() == name.lower()

    def is_well_known(self, name: bytes) -> bool:
        """Return True if this is the well-known type ``name``."""
        return self.tnf == WELL_KNOWN and self.type == name


def encode(records: Sequence[NdefRecord]) -> bytes:
    """Return the NDEF message of ``records``: short records for payloads of at most 255 octets, no chunks."""
    octets = bytearray()
    for number, record in enumerate(records):
        short = len(record.payload) < 256
        head = record.tnf | (0x80 if number == 0 else 0) | (0x40 if number == len(records) - 1 else 0)
        head |= (0x10 if short else 0) | (0x08 if record.id else 0)
        octets += bytes((head, len(record.type))) + len(record.payload).to_bytes(1 if short else 4, "big")
        octets += (bytes((len(record.id),)) if record.id else b"") + record.type + record.id + record.payload
    return bytes(octets)


def decode(octets: bytes) -> tuple[NdefRecord, ...]:
    """Split an NDEF message into its records, chunks put together; an empty message gives none.

    Raises GarbledError when the framing is broken: begin or end mark missing, a record longer than the message, octets
    left over, chunks out of order.
    """
    records: list[NdefRecord] = []
    chunk: NdefRecord | None = None
    at, ended = 0, not octets
    while not ended:
        flags, record, at = _record(octets, at)
        if bool(flags & 0x80) != (not records and chunk is None):
            raise GarbledError("The NDEF message has no valid beginning.")
        ended = bool(flags & 0x40)
        # A record continues a chunk if one is open, and only then.
        if (chunk is not None) != (record.tnf == 6) or (chunk is not None and record.type):
            raise GarbledError("The NDEF message has a chunk out of order.")
        if chunk is not None:
            record = NdefRecord(chunk.tnf, chunk.type, chunk.payload + record.payload, chunk.id)
        chunk = record if flags & 0x20 else None
        if chunk is None:
            records.append(record)
    if chunk is not None or at != len(octets):
        raise GarbledError("The NDEF message has no valid end.")
    return tuple(records)


def _record(octets: bytes, at: int) -> tuple[int, NdefRecord, int]:
    """Read one record at ``at``; return its flags octet, the record and where the next one begins."""
    try:
        flags, type_octets = octets[at], octets[at + 1]
        wide = 1 if flags & 0x10 else 4
        size = int.from_bytes(octets[at + 2 : at + 2 + wide], "big")
        id_octets = octets[at + 2 + wide] if flags & 0x08 else 0
    except IndexError:
        raise GarbledError("The NDEF message is cut off.") from None
    start = at + 2 + wide + (1 if flags & 0x08 else 0)
    end = start + type_octets + id_octets + size
    if end > len(octets):
        raise GarbledError("The NDEF message is cut off.")
    kind = octets[start : start + type_octets]
    ident = octets[start + type_octets : start + type_octets + id_octets]
    return flags, NdefRecord(flags & 7, bytes(kind), bytes(octets[end - size : end]), bytes(ident)), end
