"""A node and the cryptography of the profile, put together from a vector file alone with plain primitives."""

from __future__ import annotations

import hashlib
import hmac
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import SoftwareKey, node_key_message
from teds_provision.protocol.tim import Tim

from .memory import RamFlash

FOLDER = Path(__file__).parent.parent / "vectors" / "profile"
HALF_ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551 // 2
Entry = dict[str, Any]


def load(name: str) -> Entry:
    """Return one file."""
    document: Entry = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    assert document["format"] == "teds1-vectors/1"
    return document


def entries(*names: str) -> Iterator[tuple[str, Entry, Entry]]:
    """Yield every entry of these files: its id, its file, itself."""
    for name in names:
        document = load(name)
        for entry in document["entries"]:
            yield f"{name}-{entry['name']}", document, entry


def cases(*names: str) -> pytest.MarkDecorator:
    """Return a test with every entry of these files, and its file."""
    found = list(entries(*names))
    return pytest.mark.parametrize(("document", "entry"), [pytest.param(d, e, id=i) for i, d, e in found])


def flash_of(document: Entry, state: Entry) -> Flash:
    """Return the flash that a state of a file describes."""
    node, uuid = SoftwareKey(int(document["keys"]["node"]["d"], 16)), bytes.fromhex(document["uuid"])
    blocks = {(block["channel"], block["access_code"]): block for block in state["blocks"]}
    return Flash(
        uuid,
        node.point,
        node.sign(node_key_message(uuid, node.point)),
        blocks={key: bytes.fromhex(block["teds"]) for key, block in blocks.items()},
        read_only=frozenset(key for key, block in blocks.items() if block["read_only"]),
        epoch=state["epoch"],
        sequence=state["sequence"],
        key=_octets(state["K"]),
        station=_octets(state["station"]),
        ca=_octets(state["ca"]),
        provisioned=state["state"] == "provisioned",
        can_address=state["can_address"],
    )


def _octets(text: str | None) -> bytes | None:
    return None if text is None else bytes.fromhex(text)


class Replay:
    """The reference node under one entry: clock, randomness and events as they are written down."""

    def __init__(self, document: Entry, entry: Entry) -> None:
        start = entry["start"]
        self.now = 0.0
        self.drawn: Entry = start
        self.memory = RamFlash(flash_of(document, start))
        self._key = SoftwareKey(int(document["keys"]["node"]["d"], 16))
        self._limits = {"max_message": start["max_message"], "max_teds": start["max_teds"]}
        self.restart()

    def restart(self) -> None:
        """Power off and on."""
        self.tim = Tim(
            self._key, self.memory, lambda: self.now, random=self._random, one_time=self._one_time, **self._limits
        )

    def _random(self, size: int) -> bytes:
        return bytes.fromhex(self.drawn["c" if size == 8 else "nonceN"])

    def _one_time(self) -> SoftwareKey:
        return SoftwareKey(int(self.drawn["En"], 16))

    def run(self, step: Entry) -> bytes | None:
        """Do one step; the reply frame where it is a command."""
        self.now, self.drawn = step["at"], step
        match step.get("event"):
            case None:
                return self.tim.handle(bytes.fromhex(step["command"]), link=step["link"], tapped=step["tapped"])
            case "link_lost":
                self.tim.link_lost(step["link"])
            case "restart":
                self.restart()
            case "reset_by_hand":
                self.tim.reset_by_hand()
            case "flash_fails" | "flash_works" as event:
                self.memory.fail = event == "flash_fails"
            case other:
                raise AssertionError(other)
        return None


# -- the profile's cryptography, again and from the standards --------------------------------------------------------


def point(octets: bytes) -> ec.EllipticCurvePublicKey:
    """Return a public key."""
    return ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), octets)


def ecdh(secret: str, peer: bytes) -> bytes:
    """x-coordinate."""
    return ec.derive_private_key(int(secret, 16), ec.SECP256R1()).exchange(ec.ECDH(), point(peer))


def check_signature(signer: bytes, message: bytes, signature: bytes) -> None:
    """ECDSA P-256 with SHA-256, r ‖ s, low s; raises InvalidSignature."""
    assert len(signature) == 64
    r, s = int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big")
    assert s <= HALF_ORDER
    point(signer).verify(encode_dss_signature(r, s), message, ec.ECDSA(hashes.SHA256()))


def hkdf(ikm: bytes, salt: bytes, info: bytes, length: int) -> bytes:
    """HKDF-SHA-256."""
    return HKDF(hashes.SHA256(), length, salt, info).derive(ikm)


def mac(key: bytes, message: bytes) -> bytes:
    """HMAC-SHA-256, cut to 16 octets."""
    return hmac.new(key, message, hashlib.sha256).digest()[:16]


def unseal(key: bytes, payload: bytes) -> bytes:
    """Return the padded inner frame of a Sealed payload."""
    return AESCCM(key, tag_length=16).decrypt(bytes(9) + payload[:4], payload[4:], None)


def padded(frame: bytes) -> bytes:
    """PKCS #7."""
    count = 16 - len(frame) % 16
    return frame + bytes([count] * count)


def open_message(message_key: bytes, run: int, message: bytes) -> bytes | None:
    """The plain octets of a data message of this run, None for a bad tag."""
    key = HKDFExpand(hashes.SHA256(), 16, b"TEDS1 stream\0" + run.to_bytes(2, "big")).derive(message_key)
    try:
        return AESCCM(key, tag_length=8).decrypt(bytes(9) + message[:4], message[4:], None)
    except InvalidTag:
        return None
