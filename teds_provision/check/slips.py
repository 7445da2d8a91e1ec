"""Common slips of firmware authors, tried in turn to find the one that explains what a node sent.

``node check`` knows the secrets of its test agreements and sessions. If a tag or a signature is wrong, it computes
it as a node with a known slip does, and names the slip that gives the same octets. A tag has 16 octets: none fits by
chance. Up to two slips at once are found in the key agreement and in Open.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product
from typing import Final, NamedTuple

from cryptography.exceptions import InvalidSignature, InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed, encode_dss_signature
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand

from teds_provision.protocol.keys import (
    GROUP_ORDER,
    POINT_OCTETS,
    SIGNATURE_OCTETS,
    PrivateKey,
    is_point,
    normalise_signature,
    public_key,
    reset_message,
    verify,
)
from teds_provision.protocol.session import SessionKeys, pad
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.teds.codec import security

TAG_OCTETS: Final = 16


class Slip(NamedTuple):
    """A known slip: its name as in ``slip`` of ``--json``, and its description, which follows "It fits if"."""

    name: str
    words: str

    @property
    def sentence(self) -> str:
        """Return the slip as one sentence for the report."""
        return f"A known slip fits: {self.words}."


Way = tuple[Slip | None, bytes]
"""One way to make some octets: None is the right one."""


def _ways(right: bytes, **wrong: tuple[bytes, str]) -> list[Way]:
    return [(None, right), *((Slip(name.replace("_", "-"), words), made) for name, (made, words) in wrong.items())]


def _together(found: Iterable[Slip | None]) -> Slip | None:
    slips = [candidate for candidate in found if candidate is not None]
    if not slips:
        return None
    return Slip("+".join(slip.name for slip in slips), ", and ".join(slip.words for slip in slips))


def _count(*slips: Slip | None) -> int:
    return sum(slip is not None for slip in slips)


def _hmac(key: bytes, message: bytes) -> bytes:
    return hmac.digest(key, message, "sha256")


def _hkdf(ikm: bytes, salt: bytes | None, info: bytes, octets: int) -> bytes:
    return HKDF(hashes.SHA256(), octets, salt, info).derive(ikm)


def _reversed_halves(octets: bytes) -> bytes:
    return b"".join(octets[at : at + 32][::-1] for at in range(0, len(octets), 32))


# -- the key agreement -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Agreement:
    """One Request and its reply as this station knows them, with the secrets of both of its keys.

    ``request`` is the payload, 259 octets; ``teds`` the node's Security TEDS, Length to Checksum; ``one_time`` the key
    of E, ``station`` that of P(station).
    """

    request: bytes
    reply: bytes
    uuid: bytes
    node: bytes
    teds: bytes
    one_time: PrivateKey = field(repr=False)
    station: PrivateKey = field(repr=False)

    @property
    def nonce(self) -> bytes:
        """NonceN, 16 octets."""
        return self.reply[:16]

    @property
    def epoch(self) -> bytes:
        """The epoch that the reply offers, 4 octets."""
        return self.reply[16:20]

    @property
    def en(self) -> bytes:
        """En, 65 octets."""
        return self.reply[20:85]

    @property
    def tag(self) -> bytes:
        """TagN, 16 octets."""
        return self.reply[85:101]

    @property
    def signature(self) -> bytes:
        """SigN, 64 octets."""
        return self.reply[101:]

    @property
    def shared(self) -> bytes:
        """Z, 64 octets: ECDH(E, En) ‖ ECDH(station, En)."""
        return self.one_time.ecdh(self.en) + self.station.ecdh(self.en)

    def transcripts(self) -> list[Way]:
        """Return T as the profile has it, and as slips make it."""
        label, digest = b"TEDS1 transcript\0", hashlib.sha256(self.teds).digest()
        request, nonce, epoch, en, uuid, node = self.request, self.nonce, self.epoch, self.en, self.uuid, self.node
        rest = en + uuid + node
        number = int.from_bytes(epoch, "big")

        def over(*parts: bytes) -> bytes:
            return hashlib.sha256(b"".join(parts)).digest()

        def with_digest(octets: bytes) -> bytes:
            return over(label, request, nonce, epoch, rest, hashlib.sha256(octets).digest())

        # The header of the command frame that carries Request: channel 0, class 128, function 1.
        header = b"\0\0\x80\x01" + len(request).to_bytes(2, "big")
        return _ways(
            over(label, request, nonce, epoch, rest, digest),
            transcript_label_without_00=(
                over(label[:-1], request, nonce, epoch, rest, digest),
                'the label "TEDS1 transcript" of T lacks its 00',
            ),
            transcript_without_label=(over(request, nonce, epoch, rest, digest), "T has no label"),
            transcript_epoch_little_endian=(
                over(label, request, nonce, epoch[::-1], rest, digest),
                "the epoch in T is little-endian",
            ),
            transcript_epoch_not_plus_1=(
                over(label, request, nonce, max(0, number - 1).to_bytes(4, "big"), rest, digest),
                "the epoch in T is the stored one, not the stored one + 1 that the reply offers",
            ),
            transcript_epoch_plus_2=(
                over(label, request, nonce, min(number + 1, 0xFFFFFFFF).to_bytes(4, "big"), rest, digest),
                "the epoch in T is greater by one than the one that the reply offers",
            ),
            transcript_without_epoch=(over(label, request, nonce, rest, digest), "T leaves out the epoch"),
            transcript_digest_of_data_block=(
                with_digest(self.teds[4:-2]),
                "the digest of the Security TEDS in T is over its data block only, not from Length to Checksum",
            ),
            transcript_digest_without_length=(
                with_digest(self.teds[4:]),
                "the digest of the Security TEDS in T leaves out its Length",
            ),
            transcript_digest_without_checksum=(
                with_digest(self.teds[:-2]),
                "the digest of the Security TEDS in T leaves out its Checksum",
            ),
            transcript_digest_of_new_epoch=(
                with_digest(self._of_new_epoch(number)),
                "the digest in T is of a Security TEDS that has the new epoch already; due is the one that Read gives",
            ),
            transcript_teds_not_hashed=(
                over(label, request, nonce, epoch, rest, self.teds),
                "T takes the Security TEDS itself, not its SHA-256",
            ),
            transcript_without_digest=(over(label, request, nonce, epoch, rest), "T leaves out the Security TEDS"),
            transcript_without_one_time=(
                over(label, request, nonce, epoch, uuid, node, digest),
                "T leaves out En, as KeyAgreement 1 did",
            ),
            transcript_one_time_before_epoch=(
                over(label, request, nonce, en, epoch, uuid, node, digest),
                "En comes before the epoch in T",
            ),
            transcript_one_time_first=(
                over(label, request, en, nonce, epoch, uuid, node, digest),
                "En comes before nonceN in T",
            ),
            transcript_without_nonce=(over(label, request, epoch, rest, digest), "T leaves out nonceN"),
            transcript_without_uuid=(over(label, request, nonce, epoch, en, node, digest), "T leaves out the UUID"),
            transcript_node_before_uuid=(
                over(label, request, nonce, epoch, en, node, uuid, digest),
                "P(node) comes before the UUID in T",
            ),
            transcript_without_node=(over(label, request, nonce, epoch, en, uuid, digest), "T leaves out P(node)"),
            transcript_points_without_04=(
                over(label, request, nonce, epoch, en[1:], uuid, node[1:], digest),
                "En and P(node) are in T without their first octet 04",
            ),
            transcript_request_with_header=(
                over(label, header, request, nonce, epoch, rest, digest),
                "T takes the whole command frame of Request, not its payload",
            ),
            transcript_not_hashed=(
                b"".join((label, request, nonce, epoch, rest, digest)),
                "the octets of T are used as they are, not their SHA-256",
            ),
        )

    def _of_new_epoch(self, number: int) -> bytes:
        shown = security.decode(self.teds)
        return security.initial(shown.node_key, shown.node_key_signature, sequence=shown.sequence, key_epoch=number)

    def secrets(self) -> list[Way]:
        """Return Z as the profile has it, and as slips make it."""
        first, second = self.one_time.ecdh(self.en), self.station.ecdh(self.en)
        own = self.one_time.ecdh(self.node), self.station.ecdh(self.node)
        return _ways(
            first + second,
            z_halves_swapped=(second + first, "the halves of Z are swapped: ECDH(E, En) comes first"),
            z_little_endian=(_reversed_halves(first + second), "the x-coordinates in Z are little-endian"),
            z_of_one_time_alone=(first, "Z is ECDH(E, En) alone"),
            z_of_station_alone=(second, "Z is ECDH(station, En) alone"),
            z_one_time_twice=(first + first, "both halves of Z are ECDH(E, En)"),
            z_with_identity_key=(own[0] + own[1], "Z is made with the node's identity key, as KeyAgreement 1 did"),
            z_static_with_identity_key=(first + own[1], "the second half of Z is made with the node's identity key"),
            z_hashed=(hashlib.sha256(first + second).digest(), "Z is hashed before HKDF"),
        )

    def material(self, shared: bytes, script: bytes) -> list[Way]:
        """Return OKM: the profile takes 48 octets; 64 begin with the same 48, so that M of 48 octets can be tried."""
        nonce, label = self.nonce, b"TEDS1 link key\0"
        return _ways(
            _hkdf(shared, nonce, label + script, 64),
            salt_and_ikm_swapped=(_hkdf(nonce, shared, label + script, 64), "salt and ikm of HKDF are swapped"),
            info_label_without_00=(
                _hkdf(shared, nonce, label[:-1] + script, 64),
                'the label "TEDS1 link key" in info of HKDF lacks its 00',
            ),
            info_without_transcript=(_hkdf(shared, nonce, label, 64), "info of HKDF is the label without T"),
            info_without_label=(_hkdf(shared, nonce, script, 64), "info of HKDF is T without the label"),
            info_transcript_first=(_hkdf(shared, nonce, script + label, 64), "T comes before the label in info"),
            without_salt=(_hkdf(shared, None, label + script, 64), "HKDF has no salt; nonceN is due"),
            without_extract=(
                HKDFExpand(hashes.SHA256(), 64, label + script).derive(shared),
                "HKDF is Expand alone, without Extract",
            ),
        )

    def tags(self, okm: bytes, script: bytes) -> Iterator[Way]:
        """Yield TagN from OKM: each choice of M, and each way to make the tag."""
        keys = _ways(
            okm[16:48],
            m_of_48_octets=(okm[16:64], "M has 48 octets; OKM[16:48] are 32"),
            m_is_all_of_okm=(okm[:48], "M is all 48 octets of OKM; OKM[16:48] are due"),
            m_of_16_octets=(okm[16:32], "M has 16 octets; OKM[16:48] are 32"),
            m_before_k=(okm[:32], "M is OKM[0:32] and K comes after it"),
            m_is_k=(okm[:16], "the tag is made under K, not M"),
        )
        for named, key in keys:
            for slip, tag in _confirmations(key, b"node", b"station", script):
                yield _together((named, slip)), tag

    def slip_of_tag(self) -> Slip | None:
        """Return the slip, or the pair of slips, that explains a wrong tagN; None if none does."""
        # Only 2,000 of about 70,000 combinations have at most two slips; skipping the others takes 0.1 s instead of
        # seconds.
        for most in (1, 2):
            for (candidate, script), (two, shared) in product(self.transcripts(), self.secrets()):
                if _count(candidate, two) > most:
                    continue
                for three, okm in self.material(shared, script):
                    if _count(candidate, two, three) > most:
                        continue
                    for four, tag in self.tags(okm, script):
                        slips = (candidate, two, three, four)
                        if _count(*slips) <= most and hmac.compare_digest(tag, self.tag):
                            return _together(slips)
        return None

    def slip_of_signature(self) -> Slip | None:
        """Return the slip that explains a wrong sigN if tagN is right."""
        label, right = b"TEDS1 agree\0", self.transcripts()[0][1]
        for slip, script in self.transcripts():
            messages = [(slip, label + script)]
            if slip is None:
                messages += _ways(
                    b"",
                    sign_label_without_00=(label[:-1] + right, 'the label "TEDS1 agree" of sigN lacks its 00'),
                    sign_without_label=(right, "sigN is over T without its label"),
                    sign_with_uuid=(label + self.uuid + right, "sigN is over the UUID as well"),
                    sign_of_request=(label + self.request, "sigN is over the payload of Request, not over T"),
                    sign_of_one_time=(label + self.en, "sigN is over En, not over T"),
                    sign_of_tag=(label + self.tag, "sigN is over tagN, not over T"),
                    sign_of_nonce=(label + self.nonce, "sigN is over nonceN, not over T"),
                    sign_of_reply=(label + self.reply[:101], "sigN is over the reply before it, not over T"),
                    sign_transcript_label=(b"TEDS1 transcript\0" + right, "the label of sigN is that of T"),
                    sign_prove_label=(b"TEDS1 prove\0" + right, "the label of sigN is that of Prove"),
                )[1:]
            found = of_signature(self.node, self.signature, messages, digest=script)
            if found is not None:
                return _together((slip, found)) if slip is not None and slip != found else found
        if verify(self.en, label + right, normalise_signature(self.signature)):
            return Slip("sign-with-one-time-key", "sigN is made with the one-time key of En, not with the identity key")
        return None


def _confirmations(key: bytes, own: bytes, other: bytes, script: bytes) -> list[Way]:
    """Return confirmation tags under M, of the side ``own``."""
    whole = _hmac(key, own + script)
    return _ways(
        whole[:16],
        mac_label_with_00=(_hmac(key, own + b"\0" + script)[:16], "the MAC label ends in 00; MAC labels have none"),
        mac_label_of_the_other_side=(
            _hmac(key, other + script)[:16],
            f'the MAC label is "{other.decode()}"; "{own.decode()}" is due',
        ),
        mac_without_label=(_hmac(key, script)[:16], "the MAC has no label"),
        mac_label_last=(_hmac(key, script + own)[:16], "the MAC label comes after T"),
        mac_last_16_octets=(whole[16:], "the tag is the last 16 octets of the MAC, not the first"),
        mac_reversed=(whole[:16][::-1], "the tag is reversed"),
    )


def confirmations(confirmation: bytes, script: bytes) -> list[tuple[Slip, bytes]]:
    """Return wrong station tags that a node may expect, given M and T, with the slip behind each."""
    ways = _confirmations(confirmation, b"station", b"node", script)
    return [(slip, tag) for slip, tag in ways if slip is not None]


# -- signatures --------------------------------------------------------------------------------------------------------


def _is_of_digest(point: bytes, digest: bytes, signature: bytes) -> bool:
    """Return True if these 32 octets were signed as the hash."""
    r, s = int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big")
    try:
        public_key(point).verify(encode_dss_signature(r, s), digest, ec.ECDSA(Prehashed(hashes.SHA256())))
    except InvalidSignature:
        return False
    return True


def of_signature(point: bytes, signature: bytes, messages: Iterable[Way], *, digest: bytes = b"") -> Slip | None:
    """Return the slip by which ``signature`` is one of ``messages`` under ``point``, in one of the forms of chips.

    ``digest``: 32 octets that may have been signed as if they were the hash. None if nothing fits.
    """
    forms = list(_forms(signature))
    for slip, message in messages:
        for form, raw in forms:
            if verify(point, message, raw):
                return _together((slip, form))
            if _is_of_digest(point, hashlib.sha256(hashlib.sha256(message).digest()).digest(), raw):
                twice = Slip("sign-hashed-twice", "the message is hashed twice before it is signed")
                return _together((slip, form, twice))
    for form, raw in forms:
        if len(digest) == 32 and _is_of_digest(point, digest, raw):
            as_hash = Slip(
                "sign-not-hashed", "32 octets are signed as if they were the hash, without label and SHA-256"
            )
            return _together((form, as_hash))
    return None


def _forms(signature: bytes) -> Iterator[tuple[Slip | None, bytes]]:
    """Yield the signature as r ‖ s, converted from each form that chips give."""
    if len(signature) != SIGNATURE_OCTETS:
        return
    r, s = signature[:32], signature[32:]
    yield None, normalise_signature(signature)
    yield Slip("signature-little-endian", "r and s are little-endian"), normalise_signature(r[::-1] + s[::-1])
    yield Slip("signature-s-first", "s comes before r"), normalise_signature(s + r)


def of_node_key(uuid: bytes, node: bytes, signature: bytes) -> Slip | None:
    """Return the slip that explains a wrong field 102."""
    label = b"TEDS1 node key\0"
    ways = _ways(
        label + uuid + node,
        label_without_00=(label[:-1] + uuid + node, 'the label "TEDS1 node key" lacks its 00'),
        without_label=(uuid + node, "it is made without its label"),
        without_uuid=(label + node, "it leaves out the UUID"),
        uuid_last=(label + node + uuid, "the UUID comes after P(node)"),
        point_without_04=(label + uuid + node[1:], "P(node) is in it without its first octet 04"),
        station_label=(b"TEDS1 station key\0" + node, "it has label and form of field 104"),
    )
    return of_signature(node, signature, ways, digest=hashlib.sha256(node).digest())


def of_prove(uuid: bytes, node: bytes, challenge: bytes, proof: bytes) -> Slip | None:
    """Return the slip that explains a wrong reply to Prove."""
    label = b"TEDS1 prove\0"
    ways = _ways(
        label + uuid + challenge,
        label_without_00=(label[:-1] + uuid + challenge, 'the label "TEDS1 prove" lacks its 00'),
        without_label=(uuid + challenge, "it is made without its label"),
        without_uuid=(label + challenge, "it leaves out the UUID"),
        uuid_last=(label + challenge + uuid, "the UUID comes after the challenge"),
        challenge_alone=(challenge, "it is over the challenge alone: anyone could get anything signed"),
    )
    return of_signature(node, proof, ways, digest=challenge)


def of_reset(uuid: bytes, node: bytes, epoch: int, challenge: bytes, proof: bytes) -> Slip | None:
    """Return the slip that explains a wrong reply to Reset."""
    label, number = b"TEDS1 reset\0", epoch.to_bytes(4, "big")
    ways = _ways(
        reset_message(uuid, epoch, challenge),
        label_without_00=(label[:-1] + uuid + number + challenge, 'the label "TEDS1 reset" lacks its 00'),
        without_label=(uuid + number + challenge, "it is made without its label"),
        without_uuid=(label + number + challenge, "it leaves out the UUID"),
        without_epoch=(label + uuid + challenge, "it leaves out the epoch"),
        epoch_little_endian=(label + uuid + number[::-1] + challenge, "the epoch in it is little-endian"),
        epoch_plus_1=(reset_message(uuid, min(epoch + 1, 0xFFFFFFFF), challenge), "the epoch in it is one too high"),
        prove_label=(b"TEDS1 prove\0" + uuid + challenge, "it has label and form of the reply to Prove"),
    )
    return of_signature(node, proof, ways, digest=challenge)


def station_keys(station: bytes) -> list[tuple[Slip, bytes]]:
    """Return the messages over which a node with a slip verifies SIG104."""
    label = b"TEDS1 station key\0"
    ways = _ways(
        b"",
        station_label_without_00=(label[:-1] + station, "it looks for SIG104 with the label without its 00"),
        station_without_label=(station, "it looks for SIG104 without its label"),
        station_point_without_04=(
            label + station[1:],
            "it looks for SIG104 over P(station) without its first octet 04",
        ),
        station_label_of_node=(b"TEDS1 node key\0" + station, 'it looks for SIG104 with the label "TEDS1 node key"'),
    )
    return [(slip, message) for slip, message in ways if slip is not None]


def datasheets(uuid: bytes, block: bytes) -> list[tuple[Slip, bytes]]:
    """Return the messages over which a node with a slip verifies field 100; ``block`` is the data block without it."""
    label = b"TEDS1 datasheet\0"
    ways = _ways(
        b"",
        datasheet_label_without_00=(label[:-1] + uuid + block, 'TBS has the label "TEDS1 datasheet" without its 00'),
        datasheet_without_label=(uuid + block, "TBS has no label"),
        datasheet_without_uuid=(label + block, "TBS leaves out the UUID"),
        datasheet_without_tedsid=(label + uuid + block[6:], "TBS leaves out the TEDSID tuple"),
    )
    return [(slip, message) for slip, message in ways if slip is not None]


# -- sessions ----------------------------------------------------------------------------------------------------------


def opens(
    key: bytes, okm: bytes, uuid: bytes, point: bytes, *, about_key: bool
) -> list[tuple[Slip, Callable[[bytes], bytes]]]:
    """Return payloads of Open, by c, as nodes with a slip in keyId (``about_key``) or in mac expect them.

    ``okm`` is that of the agreement that gave the key, empty if it is not known; ``point`` is Es.
    """
    tries: list[tuple[Slip, Callable[[bytes], bytes]]] = []

    def add(name: str, words: str, identifier: bytes, mac: Callable[[bytes], bytes]) -> None:
        tries.append((Slip(name, words), lambda counter: identifier + point + mac(counter)))

    def right(under: bytes) -> Callable[[bytes], bytes]:
        return lambda counter: _hmac(under, b"station open" + uuid + counter + point)[:16]

    if about_key:
        whole, label = hashlib.sha256(b"TEDS1 key id\0" + key).digest(), b"TEDS1 key id"
        add("key-id-label-without-00", 'keyId has its label "TEDS1 key id" without its 00',
            hashlib.sha256(label + key).digest()[:8], right(key))  # fmt: skip
        add("key-id-without-label", "keyId has no label", hashlib.sha256(key).digest()[:8], right(key))
        add("key-id-last-8-octets", "keyId is the last 8 octets of its hash", whole[24:], right(key))
        add("key-id-reversed", "keyId is reversed", whole[:8][::-1], right(key))
        others = ((32, "OKM[32:48]"), (16, "OKM[16:32]")) if len(okm) >= 48 else ()
        for at, name in others:
            other = okm[at : at + 16]
            add("k-elsewhere-in-okm", f"K is {name}; OKM[0:16] is due", key_id(other), right(other))
        return tries
    identifier = key_id(key)

    def mac(name: str, words: str, made: Callable[[bytes], bytes]) -> None:
        add(name, words, identifier, made)

    label = b"station open"
    mac("mac-label-with-00", 'the label "station open" of mac ends in 00; MAC labels have none',
        lambda c: _hmac(key, label + b"\0" + uuid + c + point)[:16])  # fmt: skip
    mac("mac-without-label", "mac has no label", lambda c: _hmac(key, uuid + c + point)[:16])
    mac("mac-without-uuid", "mac leaves out the UUID", lambda c: _hmac(key, label + c + point)[:16])
    mac("mac-counter-little-endian", "c in mac is little-endian",
        lambda c: _hmac(key, label + uuid + c[::-1] + point)[:16])  # fmt: skip
    mac("mac-without-counter", "mac leaves out c", lambda c: _hmac(key, label + uuid + point)[:16])
    mac("mac-counter-last", "c comes after Es in mac", lambda c: _hmac(key, label + uuid + point + c)[:16])
    mac("mac-next-counter", "c in mac is one too high",
        lambda c: _hmac(key, label + uuid + _next(c) + point)[:16])  # fmt: skip
    mac("mac-without-point", "mac leaves out Es", lambda c: _hmac(key, label + uuid + c)[:16])
    mac(
        "mac-with-key-id", "mac is over keyId as well", lambda c: _hmac(key, label + uuid + c + identifier + point)[:16]
    )
    mac("mac-point-without-04", "Es is in mac without its first octet 04",
        lambda c: _hmac(key, label + uuid + c + point[1:])[:16])  # fmt: skip
    mac("mac-last-16-octets", "mac is the last 16 octets of the MAC",
        lambda c: _hmac(key, label + uuid + c + point)[16:])  # fmt: skip
    return tries


def _next(counter: bytes) -> bytes:
    return ((int.from_bytes(counter, "big") + 1) % (1 << 64)).to_bytes(8, "big")


def of_session(key: bytes, uuid: bytes, one_time: PrivateKey, reply: bytes) -> Slip | None:
    """Return the slip that explains a wrong tag in the reply to Open; ``one_time`` is the key of Es."""
    node, station, got = reply[:POINT_OCTETS], one_time.point, reply[POINT_OCTETS:]
    if len(got) != TAG_OCTETS or not is_point(node):
        return None
    z, label, both = one_time.ecdh(node), b"TEDS1 session\0", station + node
    identifier, found = key_id(key), list[tuple[int, Slip | None]]()
    for way, shared in _ways(z, z_little_endian=(z[::-1], "Z is little-endian")):
        materials = _ways(
            _hkdf(shared, key, label + uuid + both, 96),
            salt_and_ikm_swapped=(_hkdf(key, shared, label + uuid + both, 96), "salt and ikm of HKDF are swapped"),
            info_label_without_00=(
                _hkdf(shared, key, label[:-1] + uuid + both, 96),
                'the label "TEDS1 session" in info of HKDF lacks its 00',
            ),
            info_without_label=(_hkdf(shared, key, uuid + both, 96), "info of HKDF has no label"),
            info_without_uuid=(_hkdf(shared, key, label + both, 96), "info of HKDF leaves out the UUID"),
            info_node_first=(_hkdf(shared, key, label + uuid + node + station, 96), "En comes before Es in info"),
            info_without_points=(_hkdf(shared, key, label + uuid, 96), "info of HKDF leaves out Es and En"),
            without_salt=(_hkdf(shared, None, label + uuid + both, 96), "HKDF has no salt; K is due"),
            without_extract=(
                HKDFExpand(hashes.SHA256(), 96, label + uuid + both).derive(shared),
                "HKDF is Expand alone, without Extract",
            ),
        )
        for two, okm in materials:
            keys = _ways(
                okm[32:64],
                kc_of_16_octets=(okm[32:48], "k_c has 16 octets; OKM[32:64] are 32"),
                kc_is_km=(okm[64:96], "the tag is made under k_m; OKM[32:64] is k_c"),
                kc_first=(okm[:32], "k_c is OKM[0:32]; OKM[32:64] is due"),
                kc_is_k=(key, "the tag is made under K; k_c is due"),
            )
            for three, under in keys:
                for four, tag in _ways(
                    _hmac(under, b"node open" + identifier + both)[:16],
                    mac_label_with_00=(
                        _hmac(under, b"node open\0" + identifier + both)[:16],
                        'the label "node open" ends in 00; MAC labels have none',
                    ),
                    mac_without_label=(_hmac(under, identifier + both)[:16], "the tag has no label"),
                    mac_without_key_id=(_hmac(under, b"node open" + both)[:16], "the tag leaves out keyId"),
                    mac_node_first=(
                        _hmac(under, b"node open" + identifier + node + station)[:16],
                        "En comes before Es in the tag",
                    ),
                    mac_last_16_octets=(
                        _hmac(under, b"node open" + identifier + both)[16:],
                        "the tag is the last 16 octets of the MAC",
                    ),
                ):
                    if hmac.compare_digest(tag, got):
                        slips = [item for item in (way, two, three, four) if item is not None]
                        found.append((len(slips), _together(slips)))
    return min(found, key=lambda pair: pair[0])[1] if found else None


Seal = Callable[[SessionKeys, int, bytes], bytes]


def _sealing(
    *, swapped: bool = False, nonce_first: bool = False, little: bool = False, aad: bool = False, tag: int = 16
) -> Seal:
    def seal(keys: SessionKeys, counter: int, frame: bytes) -> bytes:
        number = counter.to_bytes(4, "little" if little else "big")
        nonce = number + bytes(9) if nonce_first else bytes(9) + number
        under = keys.to_station if swapped else keys.to_node
        sealed = AESCCM(under, tag_length=tag).encrypt(nonce, pad(frame), number if aad else None)
        return counter.to_bytes(4, "big") + sealed

    return seal


SEALED: Final[list[tuple[Slip, Seal]]] = [
    (Slip("session-keys-swapped", "k_sn and k_ns are swapped"), _sealing(swapped=True)),
    (Slip("nonce-counter-first", "the counter comes before the nine zero octets of the nonce"),
     _sealing(nonce_first=True)),
    (Slip("nonce-counter-little-endian", "the counter in the nonce is little-endian"), _sealing(little=True)),
    (Slip("aad-counter", "the counter is taken as AAD; the AAD is empty"), _sealing(aad=True)),
    (Slip("tag-of-8-octets", "the tag of CCM has 8 octets; 16 are due"), _sealing(tag=8)),
]  # fmt: skip
"""Sealed frames as nodes with a slip take them: keys of the session, counter, inner frame."""


def of_sealed_reply(keys: SessionKeys, payload: bytes, counter: int) -> Slip | None:
    """Return the slip that explains a sealed reply with a wrong tag or padding, or another counter than ``counter``."""
    if len(payload) < 4 + TAG_OCTETS:
        return None
    head, rest = payload[:4], payload[4:]
    if int.from_bytes(head, "little") == counter != int.from_bytes(head, "big"):
        return Slip("counter-little-endian", "the counter of a sealed reply is little-endian")
    number = counter.to_bytes(4, "big")

    def opened(key: bytes, nonce: bytes, aad: bytes | None = None) -> bytes | None:
        try:
            return AESCCM(key, tag_length=TAG_OCTETS).decrypt(nonce, rest, aad)
        except (InvalidTag, ValueError):
            return None

    right = opened(keys.to_station, bytes(9) + number)
    if right is not None:
        return _of_padding(right)
    for slip, made in (
        (Slip("session-keys-swapped", "the reply is sealed under k_sn, the command's key"),
         opened(keys.to_node, bytes(9) + number)),
        (SEALED[1][0], opened(keys.to_station, number + bytes(9))),
        (SEALED[2][0], opened(keys.to_station, bytes(9) + number[::-1])),
        (SEALED[3][0], opened(keys.to_station, bytes(9) + number, number)),
        (Slip("nonce-of-zeros", "the nonce of a sealed reply is zeros alone"), opened(keys.to_station, bytes(13))),
        (Slip("nonce-next-counter", "a sealed reply has another counter in its nonce"),
         opened(keys.to_station, bytes(9) + (counter + 1 & 0xFFFFFFFF).to_bytes(4, "big"))),
    ):  # fmt: skip
        if made is not None:
            return slip
    return None


def of_data_message(key: bytes, run: int, counter: int, message: bytes) -> Slip | None:
    """Return what would explain the wrong tag of a data message of this run and counter; ``key`` is k_m."""
    label, head, rest = b"TEDS1 stream\0", message[:4], message[4:]

    def run_key(octets: bytes, run_octets: bytes = run.to_bytes(2, "big")) -> bytes:
        return HKDFExpand(hashes.SHA256(), 16, octets + run_octets).derive(key)

    keys = _ways(
        run_key(label),
        run_label_without_00=(run_key(label[:-1]), 'the label "TEDS1 stream" of the run\'s key lacks its 00'),
        run_drive_label=(run_key(b"TEDS1 drive\0"), "the key of the stream is made with the label of Drive"),
        run_little_endian=(run_key(label, run.to_bytes(2, "little")), "run is little-endian in the run's key"),
        run_before=(run_key(label, (run - 1 & 0xFFFF).to_bytes(2, "big")), "the run's key is that of the run before"),
        run_left_out=(run_key(label, b""), "the run's key leaves out run"),
        run_key_is_km=(key[:16], "messages are sealed under k_m; each run has its own key"),
    )
    nonces = _ways(
        bytes(9) + head,
        nonce_counter_first=(head + bytes(9), SEALED[1][0].words),
        nonce_counter_little_endian=(bytes(9) + head[::-1], SEALED[2][0].words),
        nonce_of_zeros=(bytes(13), "the nonce of a data message is zeros alone: one key and nonce for many messages"),
        nonce_next_counter=(
            bytes(9) + (counter + 1 & 0xFFFFFFFF).to_bytes(4, "big"),
            "the counter in the nonce is one too high",
        ),
    )
    for (named, under), (slip, nonce) in product(keys, nonces):
        for aad in (None, head):
            right = named is None and slip is None and aad is None
            if not right and _opens(under, nonce, rest, aad):
                return _together((named, slip, SEALED[3][0] if aad else None))
    return None


def _opens(key: bytes, nonce: bytes, sealed: bytes, aad: bytes | None) -> bool:
    try:
        AESCCM(key, tag_length=8).decrypt(nonce, sealed, aad)
    except (InvalidTag, ValueError):
        return False
    return True


def _of_padding(inner: bytes) -> Slip | None:
    """Return the slip that replaced PKCS #7 padding; ``inner`` is what the good tag covers."""
    length = 3 + int.from_bytes(inner[1:3], "big")
    if length == len(inner) and not length % 16:
        return Slip("padding-no-full-block", "a reply that is a multiple of 16 octets gets no block of padding")
    if length == len(inner):
        return Slip("padding-none", "a sealed reply is not padded")
    padding = inner[length:]
    if not any(padding):
        return Slip("padding-zeros", "the padding is zeros; each octet of PKCS #7 is their number")
    if not any(padding[:-1]) and padding[-1] == len(padding):
        return Slip("padding-x923", "only the last octet of the padding is their number; in PKCS #7 each is")
    if padding == bytes([len(padding) - 1]) * len(padding):
        return Slip("padding-one-less", "the octets of the padding are their number less one")
    return None


def high_s(signature: bytes) -> bool:
    """Return True if s of r ‖ s is in the upper half of the group order."""
    return int.from_bytes(signature[32:], "big") > GROUP_ORDER // 2
