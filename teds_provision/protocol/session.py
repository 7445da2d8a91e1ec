"""Sessions under a link key: Open, Sealed, counters (profile.md, "Sessions"). Pure, both roles.

Open makes session keys from one-time P-256 keys of both sides, so K alone, stolen later, opens no recorded session.
AES-128-CCM of RFC 3610 with a 16-octet tag, PKCS #7 padding, HKDF and HMAC as in the key agreement. Python cannot wipe
memory reliably: Z and OKM live in local names only, and a one-time key goes with the object that made it.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from dataclasses import dataclass, field

from teds_provision.errors import GarbledError, NotAuthenticError
from teds_provision.protocol.keys import POINT_OCTETS, PrivateKey, SoftwareKey
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, security_command
from teds_provision.protocol.primitives import aead, exceptions, hashes, hkdf
from teds_provision.protocol.wire_agreement import good_one_time, key_id

COUNTER_OCTETS = 8
KEY_ID_OCTETS = 8
TAG_OCTETS = 16
OPEN_OCTETS = KEY_ID_OCTETS + POINT_OCTETS + TAG_OCTETS
OPEN_REPLY_OCTETS = POINT_OCTETS + TAG_OCTETS
SEALED_HEAD_OCTETS = 4 + TAG_OCTETS
LAST_COUNTER = 0xFFFFFFFF
BLOCK_OCTETS = 16
OneTime = Callable[[], PrivateKey]
"""Makes a one-time key pair; each is for one Open."""


def pad(octets: bytes) -> bytes:
    """Return the octets with PKCS #7 padding to 16 octets (RFC 5652 section 6.3)."""
    count = BLOCK_OCTETS - len(octets) % BLOCK_OCTETS
    return octets + bytes([count]) * count


def unpad(octets: bytes) -> bytes | None:
    """Remove the padding; None if it is wrong."""
    count = octets[-1] if octets else 0
    if len(octets) % BLOCK_OCTETS or not 1 <= count <= BLOCK_OCTETS or octets[-count:] != bytes([count]) * count:
        return None
    return octets[:-count]


def open_mac(key: bytes, uuid: bytes, counter: bytes, station: bytes) -> bytes:
    """Return the mac of Open: HMAC-SHA-256(K, "station open" ‖ UUID ‖ c ‖ Es)[0:16].

    ``counter`` is c as the node gave it (8 octets), ``station`` Es (65 octets). It makes each Open good once, and lets
    a node refuse a stranger without point arithmetic.
    """
    return hmac.digest(key, b"station open" + uuid + counter + station, "sha256")[:TAG_OCTETS]


@dataclass(frozen=True)
class SessionKeys:
    """Keys of one Open: k_sn, k_ns (16 octets each), k_m (32, for operation messages) and the node's tag."""

    to_node: bytes = field(repr=False)
    to_station: bytes = field(repr=False)
    messages: bytes = field(repr=False)
    node_tag: bytes = field(repr=False)

    @classmethod
    def derive(cls, key: bytes, uuid: bytes, shared: bytes, station: bytes, node: bytes) -> SessionKeys:
        """Derive HKDF-SHA-256(Z, salt K, info "TEDS1 session" ‖ 00 ‖ UUID ‖ Es ‖ En, 96 octets); ``shared`` is Z."""
        okm = hkdf.HKDF(hashes.SHA256(), 96, key, b"TEDS1 session\0" + uuid + station + node).derive(shared)
        tag = hmac.digest(okm[32:64], b"node open" + key_id(key) + station + node, "sha256")
        return cls(okm[:16], okm[16:32], okm[64:], tag[:TAG_OCTETS])


def _seal(key: bytes, counter: int, octets: bytes) -> bytes:
    return _seal_padded(key, counter, pad(octets))


def _seal_padded(key: bytes, counter: int, padded: bytes) -> bytes:
    nonce = bytes(9) + counter.to_bytes(4, "big")
    return counter.to_bytes(4, "big") + aead.AESCCM(key, tag_length=TAG_OCTETS).encrypt(nonce, padded, None)


def _decrypt(key: bytes, payload: bytes) -> bytes | None:
    """Return the padded octets if the tag is right, else None."""
    try:
        return aead.AESCCM(key, tag_length=TAG_OCTETS).decrypt(bytes(9) + payload[:4], payload[4:], None)
    except (exceptions.InvalidTag, ValueError):
        return None


class StationSession:
    """The station's half: :meth:`request_counter` for c, :meth:`open` once, then sealed commands with rising counters.

    One object is one Open; after a refusal with reason 12 a new one asks for c again (another station was faster).
    ``statics`` are the static points at hand, P(station) and P(node): En is due to be none of them.
    """

    def __init__(
        self, key: bytes, uuid: bytes, *, one_time: PrivateKey | None = None, statics: tuple[bytes, ...] = ()
    ) -> None:
        self._key, self._uuid, self._statics = key, uuid, statics
        self._one_time: PrivateKey | None = one_time or SoftwareKey.generate()
        self._keys: SessionKeys | None = None
        self._counter = 0
        self.open_counter = b""
        """c of Open, as the node gave it: the mac covers it, so a good reply proves that it was the node's own."""

    def request_counter(self) -> Command:
        """Return the empty Open, whose reply is c."""
        return security_command(Function.OPEN)

    def open(self, counter: bytes) -> Command:
        """Return the Open to send for the node's c; raises GarbledError if c does not have 8 octets."""
        assert self._one_time is not None, "open() after accept()"
        if len(counter) != COUNTER_OCTETS:
            raise GarbledError(f"The node's counter for Open has {len(counter)} octets, not {COUNTER_OCTETS}.")
        self.open_counter, station = counter, self._one_time.point
        mac = open_mac(self._key, self._uuid, counter, station)
        return security_command(Function.OPEN, key_id(self._key) + station + mac)

    def accept(self, payload: bytes) -> None:
        """Check the reply to Open; raises GarbledError or NotAuthenticError (the node does not hold the key)."""
        assert self._one_time is not None, "accept() twice"
        if len(payload) != OPEN_REPLY_OCTETS:
            raise GarbledError(f"The reply to Open has {len(payload)} octets, not {OPEN_REPLY_OCTETS}.")
        node, station = payload[:POINT_OCTETS], self._one_time.point
        if not good_one_time(node, station, *self._statics):
            raise NotAuthenticError(
                "The node's one-time key in its reply to Open is not a valid point, or is no one-time key."
            )
        keys = SessionKeys.derive(self._key, self._uuid, self._one_time.ecdh(node), station, node)
        if not hmac.compare_digest(keys.node_tag, payload[POINT_OCTETS:]):
            raise NotAuthenticError("The node's tag on Open is wrong: it does not hold the key.")
        self._keys, self._one_time = keys, None

    @property
    def keys(self) -> SessionKeys:
        """The keys of Open, for testing a node."""
        assert self._keys is not None, "keys before a good accept()"
        return self._keys

    @property
    def message_key(self) -> bytes:
        """k_m, 32 octets: the root of the keys of streams and of Drive (operation.md section 3)."""
        assert self._keys is not None, "message_key before a good accept()"
        return self._keys.messages

    def seal(self, command: Command, *, counter: int | None = None) -> Command:
        """Seal one inner command under the next counter; another ``counter`` (u32) is for trying a node out."""
        assert self._keys is not None, "seal() before a good accept()"
        if counter is None and self._counter >= LAST_COUNTER:
            raise GarbledError("This session has used up its counters; open a new one.")
        self._counter = self._counter + 1 if counter is None else counter
        return security_command(Function.SEALED, _seal(self._keys.to_node, self._counter, command.encode()))

    def seal_padded(self, padded: bytes) -> Command:
        """Seal whole blocks as they are, for trying a node out with padding that is wrong."""
        assert self._keys is not None, "seal_padded() before a good accept()"
        self._counter += 1
        return security_command(Function.SEALED, _seal_padded(self._keys.to_node, self._counter, padded))

    def unseal(self, payload: bytes) -> Reply:
        """Open the sealed reply to the last command; raises GarbledError or NotAuthenticError."""
        assert self._keys is not None, "unseal() before a good accept()"
        if len(payload) < SEALED_HEAD_OCTETS + BLOCK_OCTETS or int.from_bytes(payload[:4], "big") != self._counter:
            raise NotAuthenticError("A sealed reply does not belong to the command that was sent.")
        padded = _decrypt(self._keys.to_station, payload)
        if padded is None:
            raise NotAuthenticError("The tag of a sealed reply is wrong.")
        inner = unpad(padded)
        if inner is None:
            raise NotAuthenticError(
                "The padding of a sealed reply is wrong; its tag is right.",
                hint="The node's firmware is at fault, not its key: PKCS #7 adds 1 to 16 octets, a whole block where"
                " the reply is a multiple of 16. Run: teds-provision node check",
            )
        return decode_reply(inner)


class NodeSession:
    """The node's half of one Open; ``counter`` is that of the last good frame, 0 while half-open.

    ``station`` is Es, a checked point; ``one_time`` the node's key for this Open alone.
    """

    def __init__(self, key: bytes, uuid: bytes, station: bytes, one_time: PrivateKey) -> None:
        node = one_time.point
        self._keys = SessionKeys.derive(key, uuid, one_time.ecdh(station), station, node)
        self.reply = node + self._keys.node_tag
        self.counter = 0
        self.good_at = 0.0

    @property
    def message_key(self) -> bytes:
        """k_m, 32 octets (operation.md section 3)."""
        return self._keys.messages

    def unseal(self, payload: bytes) -> bytes | None:
        """Return the inner frame if tag and padding are right, else None. Changes nothing."""
        padded = _decrypt(self._keys.to_node, payload)
        return None if padded is None else unpad(padded)

    def seal(self, counter: int, frame: bytes) -> bytes:
        """Seal the one reply of ``counter``."""
        return _seal(self._keys.to_station, counter, frame)
