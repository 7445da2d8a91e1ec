"""Remote signing: a line's request to an office, and the answer (contract/plant.md section 11).

The board takes part: it signs a challenge over the line's key, its own epoch and sequence, and every digest, so that a
datasheet can be signed only for a board that the line holds.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.protocol import datasheet
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import SIGNATURE_OCTETS, PrivateKey
from teds_provision.protocol.plant.document import (
    SIGN_REQUEST,
    SIGNED,
    Fields,
    is_name,
    is_number,
    is_text,
    open_document,
    sign_document,
)
from teds_provision.teds.image import SECURITY, BlockId, Image

NONCE_OCTETS: Final = 16
MOST_BLOCKS: Final = 2_000
REFUSALS: Final = (
    "not-line", "job", "full", "other-key", "proof", "differs", "guard", "sequence", "revoked",
)  # fmt: skip
"""Why an office signs nothing, in one word."""


def challenge(
    nonce: bytes, line: bytes, uuid: bytes, epoch: int, sequence: int, blocks: Mapping[BlockId, bytes]
) -> bytes:
    """Return what the board signs by Prove: SHA-256 over label, nonce, P(line), UUID, epoch, sequence, values of 108.

    ``blocks`` are the TEDS (without the Security TEDS), framed.
    """
    values = b"".join(
        channel.to_bytes(2, "big") + bytes([code]) + digest
        for (channel, code), digest in sorted(datasheet.digests(blocks).items())
    )
    numbers = epoch.to_bytes(4, "big") + sequence.to_bytes(4, "big")
    return hashlib.sha256(b"TEDS1 sign request\0" + nonce + line + uuid + numbers + values).digest()


@dataclass(frozen=True)
class SignRequest:
    """A line's request to an office (``to``, a fingerprint) for one board of a job.

    ``image`` holds every TEDS but the Security TEDS; ``key_signature`` is field 102; ``epoch`` and ``sequence`` were
    read in a session. ``signer``, ``line`` (its key), ``hash`` and ``octets`` are "" until it is signed.
    """

    id: str
    to: str
    created: datetime
    job: str
    image: Image
    epoch: int
    sequence: int
    name: str | None
    calibration: bytes | None
    point: bytes
    key_signature: bytes
    nonce: bytes
    proof: bytes
    hash: str = ""
    signer: str = ""
    line: bytes = b""
    octets: bytes = field(default=b"", repr=False)

    @property
    def uuid(self) -> bytes:
        """The board's, 10 octets."""
        return self.image.uuid

    def challenge(self) -> bytes:
        """Return what the board must have signed, under the line's key."""
        blocks = self.image.unsigned_blocks()
        return challenge(self.nonce, self.line, self.uuid, self.epoch, self.sequence, blocks)

    def unsigned(self) -> dict[str, Any]:
        """Return what the line signs, in the order of the contract."""
        blocks = self.image.unsigned_blocks()
        return {
            "format": SIGN_REQUEST.format,
            "id": self.id,
            "to": self.to,
            "created": time_text(self.created),
            "job": self.job,
            "uuid": self.uuid.hex(),
            "epoch": self.epoch,
            "sequence": self.sequence,
            "name": self.name,
            "image": [[channel, code, teds.hex()] for (channel, code), teds in sorted(blocks.items())],
            "calibration": None if self.calibration is None else base64.b64encode(self.calibration).decode(),
            "node": {
                "point": self.point.hex(),
                "signature": base64.b64encode(self.key_signature).decode(),
                "nonce": self.nonce.hex(),
                "proof": self.proof.hex(),
            },
        }


def seal_request(request: SignRequest, line: PrivateKey) -> bytes:
    """Sign a request; raises BadDataError if it is larger than an office reads."""
    return sign_document(request.unsigned(), line, SIGN_REQUEST)


def open_request(octets: bytes, find_key: Callable[[str], bytes | None]) -> SignRequest:
    """Read a request under its line's signature; nothing else of it is verified.

    Raises NotAuthenticError, BadDataError.
    """
    document = open_document(octets.strip(), find_key, SIGN_REQUEST)
    fields = Fields(document.members, "The sign request")
    node = Fields(document.members.get("node"), "The node of the sign request")
    name, uuid = document.members.get("name"), bytes.fromhex(fields.text_of_form("uuid", "uuid"))
    blocks: dict[BlockId, bytes] = {}
    listed = fields.list_of("image", MOST_BLOCKS)
    for item in listed:
        block, teds = _block(fields, item)
        blocks[block] = teds
    if len(blocks) != len(listed) or SECURITY in blocks or not blocks:
        raise fields.bad("image", "is empty, names a TEDS twice, or holds the Security TEDS")
    calibration = document.members.get("calibration")
    return SignRequest(
        fields.text_of_form("random_id", "id"),
        fields.text_of_form("sha256", "to"),
        fields.time("created"),
        fields.text_of_form("random_id", "job"),
        Image(uuid, blocks),
        fields.number("epoch"),
        fields.number("sequence"),
        None if name is None else fields.name("name"),
        None if calibration is None else _base64(fields, "calibration"),
        node.point("point"),
        _sized(node, _base64(node, "signature"), SIGNATURE_OCTETS, "signature"),
        _hex(node, "nonce", NONCE_OCTETS),
        _hex(node, "proof", SIGNATURE_OCTETS),
        document.hash,
        document.signer,
        document.point,
        document.octets,
    )


@dataclass(frozen=True)
class Answer:
    """An office's answer to the request of this H: a Security TEDS (framed), or a code and the reason."""

    of: str
    sequence: int = 0
    security: bytes = b""
    refused: str = ""
    why: str = ""

    def unsigned(self) -> dict[str, Any]:
        """Return what the office signs, in the order of the contract."""
        members: dict[str, Any] = {"format": SIGNED.format, "of": self.of}
        if self.refused:
            return {**members, "refused": self.refused, "why": self.why}
        return {**members, "sequence": self.sequence, "security": base64.b64encode(self.security).decode()}


def seal_answer(answer: Answer, office: PrivateKey) -> bytes:
    """Sign an answer."""
    return sign_document(answer.unsigned(), office, SIGNED)


def open_answer(octets: bytes, find_key: Callable[[str], bytes | None]) -> Answer:
    """Read an answer under the office's signature; raises NotAuthenticError, BadDataError."""
    fields = Fields(open_document(octets.strip(), find_key, SIGNED).members, "The office's answer")
    of = fields.text_of_form("sha256", "of")
    if "refused" in fields.members:
        why = fields.members.get("why")
        return Answer(of, refused=fields.one_of("refused", REFUSALS), why=str(why) if is_text(why) else "")
    return Answer(of, fields.number("sequence", 1), _base64(fields, "security"))


def _block(fields: Fields, value: object) -> tuple[BlockId, bytes]:
    match value:
        case [int(channel), int(code), str(teds)] if is_number(channel) and is_number(code):
            block = channel, code
            if datasheet.can_be_stored(block) and _is_hex(teds):
                return block, bytes.fromhex(teds)
    raise fields.bad("image", "is no list of [channel, access code, hex]")


def _is_hex(text: str) -> bool:
    return len(text) % 2 == 0 and set(text) <= set("0123456789abcdef")


def _hex(fields: Fields, name: str, octets: int) -> bytes:
    text = fields.members.get(name)
    if not isinstance(text, str) or not _is_hex(text):
        raise fields.bad(name, "is not hex in lower case")
    return _sized(fields, bytes.fromhex(text), octets, name)


def _base64(fields: Fields, name: str) -> bytes:
    text = fields.members.get(name)
    try:
        octets = binascii.a2b_base64(text, strict_mode=True) if isinstance(text, str) else None
    except ValueError as error:
        raise fields.bad(name, "is not base64") from error
    if octets is None or base64.b64encode(octets).decode() != text:
        raise fields.bad(name, "is not base64 in its one spelling")
    return octets


def _sized(fields: Fields, octets: bytes, wanted: int, name: str) -> bytes:
    if len(octets) != wanted:
        raise fields.bad(name, f"has {len(octets)} octets, not {wanted}")
    return octets


def require_name(name: str | None) -> None:
    """Raise BadDataError for a name that no request may hold."""
    if name is not None and not is_name(name):
        raise BadDataError(f"The name {name!r} is none of 1 to 100 printable characters without space at either end.")
