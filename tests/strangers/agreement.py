"""KeyAgreement 2 by pyca/cryptography alone, from the contract (profile.md, "Key agreement"): both roles.

The node has one fault at most; :data:`FAULTS` names them. It lies in memory: what it says is what would cross a wire.
"""

from __future__ import annotations

import base64
import hashlib
import os
import struct
from dataclasses import dataclass, field

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from tests.strangers.crypto import CURVE, ORDER, Keys, key_id, mac, point, seal, signature, unseal

FAULTS = frozenset(
    """
sigN without the 00 of its label
sigN as a proof of Prove
sigN by another key
sigN with a high s
sigN as DER
halves of Z swapped
Z of the identity key
salt and ikm swapped
tagN of the station's label
tagN with 00 behind its label
En not in T
digest over the data block only
En is P(node)
En is P(station)
En is E
En off the curve
the same epoch again
the epoch little-endian
a reply without its last octet
the reply to the Request before
the TEDS changes with every Read
field 102 is signed anew for every Read
KeyAgreement 1
KeyAgreement 1 in the reply alone
""".strip().splitlines()
)


class RefusalError(Exception):
    """A refusal."""

    def __init__(self, reason: int) -> None:
        super().__init__(reason)
        self.reason = reason


def shared(own: ec.EllipticCurvePrivateKey, theirs: bytes) -> bytes:
    """x-coordinate."""
    return own.exchange(ec.ECDH(), ec.EllipticCurvePublicKey.from_encoded_point(CURVE, theirs))


def okm(z: bytes, nonce: bytes, script: bytes) -> tuple[bytes, bytes]:
    """K and M."""
    made = HKDF(hashes.SHA256(), 48, nonce, b"TEDS1 link key\0" + script).derive(z)
    return made[:16], made[16:]


def holds(signer: bytes, words: bytes, signed: bytes) -> None:
    """Raises InvalidSignature, or AssertionError for a high s."""
    r, s = int.from_bytes(signed[:32], "big"), int.from_bytes(signed[32:], "big")
    assert len(signed) == 64
    assert s <= ORDER // 2
    key = ec.EllipticCurvePublicKey.from_encoded_point(CURVE, signer)
    key.verify(encode_dss_signature(r, s), words, ec.ECDSA(hashes.SHA256()))


def framed(block: bytes) -> bytes:
    """Length, block, checksum."""
    head = (len(block) + 2).to_bytes(4, "big") + block
    return head + (0xFFFF - sum(head) & 0xFFFF).to_bytes(2, "big")


@dataclass
class Node:
    """A node in factory state, by whoever read the contract."""

    uuid: bytes
    fault: str = ""
    identity: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(CURVE))
    epoch: int = 0
    key: bytes = b""
    requests: int = 0
    reads: int = 0
    pending: tuple[bytes, bytes, int] | None = None
    last: bytes = b""
    c: int = 5
    keys: Keys | None = None
    counter: int = 0
    signed: bytes = b""

    def security(self) -> bytes:
        """Return the initial Security TEDS."""
        me = point(self.identity)
        if not self.signed or self.fault == "field 102 is signed anew for every Read":
            self.signed = signature(self.identity, b"TEDS1 node key\0" + self.uuid + me)
        agreement = 1 if self.fault == "KeyAgreement 1" else 2
        sequence = self.reads if self.fault == "the TEDS changes with every Read" else 0
        tuples = [(1, b"\4"), (2, b"\2"), (3, b"\0"), (4, b"\1"), (5, b""), (6, bytes(8))]
        tuples += [(101, base64.b64encode(me)), (102, base64.b64encode(self.signed)), (105, b"\1")]
        tuples += [(106, sequence.to_bytes(4, "big")), (107, self.epoch.to_bytes(4, "big")), (109, b"\2")]
        tuples += [(110, bytes([agreement]))]
        return framed(b"\x03\x04\0\x80\1\1" + b"".join(bytes([t, len(v)]) + v for t, v in tuples))

    def handle(self, frame: bytes, inside: bool = False) -> bytes:
        """Answer one command frame with one reply frame."""
        class_, function, payload = frame[2], frame[3], frame[6:]
        try:
            if (class_, function) == (1, 2):
                reply = self.read(payload)
            elif (function, inside) == (5, True):
                reply = b""  # Close
            else:
                reply = {1: self.request, 2: self.confirm, 3: self.open, 4: self.sealed, 7: self.hello, 8: self.prove}[
                    function
                ](payload)
        except RefusalError as refusal:
            return bytes([0, 0, 1, refusal.reason])
        if (class_, function, inside) == (128, 2, False):
            self.keys = None
        return b"\1" + len(reply).to_bytes(2, "big") + reply

    def hello(self, _payload: bytes) -> bytes:
        return b"\1" + self.uuid + struct.pack(">BIIHB", bool(self.key), self.epoch, 0, 512, 0)

    def prove(self, payload: bytes) -> bytes:
        return signature(self.identity, b"TEDS1 prove\0" + self.uuid + payload)

    def read(self, payload: bytes) -> bytes:
        if payload[:1] != b"\x80":
            raise RefusalError(18)
        self.reads += payload[1:] == bytes(4)
        at = int.from_bytes(payload[1:], "big")
        return payload[1:] + self.security()[at : at + 466]

    def request(self, payload: bytes) -> bytes:
        self.requests += 1
        station, _, _, e = payload[:65], payload[65:129], payload[129:194], payload[194:]
        holds(payload[129:194], b"TEDS1 station key\0" + station, payload[65:129])
        own = ec.generate_private_key(CURVE)
        en = {"En is P(node)": point(self.identity), "En is P(station)": station, "En is E": e}.get(self.fault)
        if self.fault == "En is P(node)":
            own = self.identity
        en = en or point(own)
        if self.fault == "En off the curve":
            en = b"\4" + bytes(63) + b"\1"
        nonce, number = os.urandom(16), self.epoch + (self.fault != "the same epoch again")
        order = "little" if self.fault == "the epoch little-endian" else "big"
        epoch = number.to_bytes(4, "little" if order == "little" else "big")
        teds, me = self.security(), point(self.identity)
        if self.fault == "the TEDS changes with every Read":
            self.reads += 1
            teds = self.security()
        digest = hashlib.sha256(teds[4:-2] if self.fault == "digest over the data block only" else teds).digest()
        within = b"" if self.fault == "En not in T" else en
        script = hashlib.sha256(
            b"TEDS1 transcript\0" + payload + nonce + epoch + within + self.uuid + me + digest
        ).digest()
        agreeing = self.identity if self.fault == "Z of the identity key" else own
        z = [shared(agreeing, e), shared(agreeing, station)]
        if self.fault == "halves of Z swapped":
            z.reverse()
        key, m = (
            okm(nonce, b"".join(z), script) if self.fault == "salt and ikm swapped" else okm(b"".join(z), nonce, script)
        )
        label = {"tagN of the station's label": b"station", "tagN with 00 behind its label": b"node\0"}
        tag = mac(m, label.get(self.fault, b"node"), script)
        reply = nonce + epoch + en + tag + self.proof(script)
        if self.fault == "KeyAgreement 1 in the reply alone":
            reply = nonce + epoch + tag + teds
        if self.fault == "a reply without its last octet":
            reply = reply[:-1]
        if self.fault == "the reply to the Request before":
            reply, self.last = self.last or reply, reply
            if self.requests == 1:
                reply = nonce + epoch + en + mac(m, b"node", bytes(32)) + self.proof(script)
        self.pending = key, mac(m, b"station", script), number
        return reply

    def proof(self, script: bytes) -> bytes:
        words = b"TEDS1 agree\0" + script
        if self.fault == "sigN without the 00 of its label":
            words = b"TEDS1 agree" + script
        if self.fault == "sigN as a proof of Prove":
            words = b"TEDS1 prove\0" + self.uuid + script
        signer = ec.generate_private_key(CURVE) if self.fault == "sigN by another key" else self.identity
        signed = signature(signer, words)
        if self.fault == "sigN with a high s":
            signed = signed[:32] + (ORDER - int.from_bytes(signed[32:], "big")).to_bytes(32, "big")
        if self.fault == "sigN as DER":
            signed = signer.sign(words, ec.ECDSA(hashes.SHA256()))
        return signed

    def confirm(self, payload: bytes) -> bytes:
        if self.pending is None:
            raise RefusalError(2)
        key, tag, number = self.pending
        self.pending = None
        if payload != tag:
            raise RefusalError(12)
        self.key, self.epoch = key, number
        return b""

    def open(self, payload: bytes) -> bytes:
        if not self.key:
            raise RefusalError(2)
        if not payload:
            return self.c.to_bytes(8, "big")
        es, proof = payload[8:73], payload[73:]
        if proof != mac(self.key, b"station open", self.uuid, self.c.to_bytes(8, "big"), es):
            raise RefusalError(12)
        own = ec.generate_private_key(CURVE)
        self.keys, self.counter = Keys.of(self.key, self.uuid, own, es, es, point(own)), 0
        return point(own) + self.keys.tag(self.key, es, point(own))

    def sealed(self, payload: bytes) -> bytes:
        if self.keys is None:
            raise RefusalError(2)
        try:
            counter, inner = unseal(self.keys.down, payload)
        except (InvalidTag, ValueError):
            raise RefusalError(12) from None
        return seal(self.keys.up, counter, self.handle(inner, inside=True))


@dataclass
class StationAgreement:
    """What a station of strangers has after a good reply to Request."""

    key: bytes
    epoch: int
    confirm: bytes


@dataclass
class Station:
    """A station by whoever read the contract; its key, and its owner's CA."""

    key: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(CURVE))
    ca: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(CURVE))

    def request(self, e: bytes) -> bytes:
        """The payload; ``e`` is the point of a one-time key."""
        me = point(self.key)
        return me + signature(self.ca, b"TEDS1 station key\0" + me) + point(self.ca) + e

    def take(
        self, payload: bytes, one_time: ec.EllipticCurvePrivateKey, reply: bytes, uuid: bytes, teds: bytes
    ) -> StationAgreement:
        """Check a reply to Request and make tagS; raises AssertionError, InvalidSignature."""
        assert len(reply) == 165
        nonce, epoch, en, tag, proof = reply[:16], reply[16:20], reply[20:85], reply[85:101], reply[101:]
        at = teds.index(b"\x65\x58") + 2
        node = base64.b64decode(teds[at : at + 88])
        assert en not in (node, payload[194:], point(self.key))
        digest = hashlib.sha256(teds).digest()
        script = hashlib.sha256(b"TEDS1 transcript\0" + payload + nonce + epoch + en + uuid + node + digest).digest()
        key, m = okm(shared(one_time, en) + shared(self.key, en), nonce, script)
        assert tag == mac(m, b"node", script)
        holds(node, b"TEDS1 agree\0" + script, proof)
        return StationAgreement(key, int.from_bytes(epoch, "big"), mac(m, b"station", script))

    def open(self, key: bytes, uuid: bytes, c: bytes) -> tuple[bytes, ec.EllipticCurvePrivateKey]:
        """Return the payload of Open."""
        own = ec.generate_private_key(CURVE)
        return key_id(key) + point(own) + mac(key, b"station open", uuid, c, point(own)), own

    def opened(self, key: bytes, uuid: bytes, opening: bytes, own: ec.EllipticCurvePrivateKey, answer: bytes) -> Keys:
        """Return the keys of the session; raises AssertionError where the node's tag is wrong."""
        es, en, tag = opening[8:73], answer[:65], answer[65:]
        keys = Keys.of(key, uuid, own, en, es, en)
        assert tag == keys.tag(key, es, en)
        return keys
