"""Parts of the reference node bent: the node's half of the agreement and of Open as slips make them, checks left out.

What a slip changes is written here a second time, from the profile, so that the station's half stays as it is.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from teds_provision.protocol import datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import GROUP_ORDER, PrivateKey, SoftwareKey, normalise_signature, verify
from teds_provision.protocol.messages.frames import Command, CommandRefusedError, Function, Reason, Reply
from teds_provision.protocol.operation import role
from teds_provision.protocol.session import NodeSession, SessionKeys, pad
from teds_provision.protocol.tim import node, node_agreement, node_sessions, teds_access
from teds_provision.protocol.tim.node import Tim
from teds_provision.protocol.tim.node_agreement import AgreementSlot
from teds_provision.protocol.tim.node_sessions import Sessions
from teds_provision.protocol.wire_agreement import NodeAgreement, RequestPayload
from teds_provision.teds.codec import security
from tests import bench

Patch = pytest.MonkeyPatch
Bend = Callable[[Patch], None]


def sha(octets: bytes) -> bytes:
    return hashlib.sha256(octets).digest()


def mac(key: bytes, octets: bytes) -> bytes:
    return hmac.digest(key, octets, "sha256")


def hkdf(ikm: bytes, salt: bytes, info: bytes, octets: int) -> bytes:
    return HKDF(hashes.SHA256(), octets, salt, info).derive(ikm)


# -- the node's half of the agreement ----------------------------------------------------------------------------------


def agreeing_so(
    *,
    label: bytes = b"TEDS1 transcript\0",
    epoch: Callable[[int], bytes] = lambda number: number.to_bytes(4, "big"),
    offered: Callable[[int], bytes] = lambda number: number.to_bytes(4, "big"),
    digest: Callable[[bytes], bytes] = sha,
    with_one_time: bool = True,
    z: Callable[[bytes, bytes], bytes] = lambda first, second: first + second,
    identity_agrees: bool = False,
    okm: Callable[[bytes, bytes, bytes], bytes] = lambda z, nonce, info: hkdf(z, nonce, info, 64),
    info: bytes = b"TEDS1 link key\0",
    m: Callable[[bytes], bytes] = lambda okm: okm[16:48],
    k: Callable[[bytes], bytes] = lambda okm: okm[:16],
    own: bytes = b"node",
    other: bytes = b"station",
    tag: Callable[[bytes, bytes, bytes], bytes] = lambda key, label, t: mac(key, label + t)[:16],
    sign: Callable[[PrivateKey, PrivateKey, bytes, bytes], bytes] = lambda key, _e, t, _r: key.sign(
        b"TEDS1 agree\0" + t
    ),
    reply: Callable[[bytes], bytes] = lambda octets: octets,
) -> Bend:
    """Return a node that answers Request with one or more things made otherwise."""

    def answer(
        cls: type[NodeAgreement], key: PrivateKey, uuid: bytes, payload: bytes, *, teds: bytes, **more: Any
    ) -> NodeAgreement:
        request, number = RequestPayload.decode(payload), more["epoch"]
        nonce, one_time = more.get("nonce") or os.urandom(16), more.get("one_time") or SoftwareKey.generate()
        en = one_time.point if with_one_time else b""
        t = sha(label + payload + nonce + epoch(number) + en + uuid + key.point + digest(teds))
        agrees = key if identity_agrees else one_time
        made = okm(z(agrees.ecdh(request.one_time), agrees.ecdh(request.station)), nonce, info + t)
        proof = sign(key, one_time, t, payload)
        octets = reply(nonce + offered(number) + one_time.point + tag(m(made), own, t) + proof)
        station_tag = tag(m(made), other, t) if other else mac(m(made), b"station" + t)[:16]
        return cls(octets, k(made), station_tag, number, request.station, request.ca)

    return lambda patch: patch.setattr(NodeAgreement, "answer", classmethod(answer))


def only_confirm(tag: Callable[[bytes, bytes], bytes]) -> Bend:
    """Return a node that waits for another tagS."""

    def bend(patch: Patch) -> None:
        original = NodeAgreement.answer.__func__  # type: ignore[attr-defined]
        seen: dict[str, bytes] = {}

        def derive(shared: bytes, nonce: bytes, script: bytes) -> Any:
            okm = hkdf(shared, nonce, b"TEDS1 link key\0" + script, 48)
            seen["tag"] = tag(okm[16:], script)
            return kept(shared, nonce, script)

        from teds_provision.protocol import wire_agreement as protocol_agreement

        kept = protocol_agreement.derive

        def answer(cls: type[NodeAgreement], *args: Any, **more: Any) -> NodeAgreement:
            protocol_agreement.derive = derive
            try:
                made = original(cls, *args, **more)
            finally:
                protocol_agreement.derive = kept
            return replace(made, station_tag=seen["tag"])

        patch.setattr(NodeAgreement, "answer", classmethod(answer))

    return bend


def high(signature: bytes) -> bytes:
    """Return the other s of the same signature."""
    return signature[:32] + (GROUP_ORDER - int.from_bytes(signature[32:], "big")).to_bytes(32, "big")


def of_new_epoch(teds: bytes) -> bytes:
    """Return the digest of the initial Security TEDS with the epoch that is only offered."""
    shown = security.decode(teds)
    return sha(
        security.initial(
            shown.node_key, shown.node_key_signature, sequence=shown.sequence, key_epoch=shown.key_epoch + 1
        )
    )


def reversed_halves(signature: bytes) -> bytes:
    """Little-endian r and s."""
    return signature[:32][::-1] + signature[32:][::-1]


def same_one_time_key(patch: Patch) -> None:
    key, original = SoftwareKey.generate(), NodeAgreement.answer.__func__  # type: ignore[attr-defined]

    def answer(cls: type[NodeAgreement], *args: Any, **more: Any) -> NodeAgreement:
        made: NodeAgreement = original(cls, *args, **{**more, "one_time": key})
        return made

    patch.setattr(NodeAgreement, "answer", classmethod(answer))


def nonce_twice(patch: Patch) -> None:
    original = AgreementSlot.request

    def request(self: AgreementSlot, *args: Any) -> bytes:
        self._random = bytes
        return original(self, *args)

    patch.setattr(AgreementSlot, "request", request)


def _confirmed_as(change: Callable[[AgreementSlot, Any], None]) -> Bend:
    def bend(patch: Patch) -> None:
        original = AgreementSlot.confirm

        def confirm(self: AgreementSlot, payload: bytes, origin: Any, flash: Flash) -> Flash:
            if self._pending is not None:
                change(self, origin)
            return original(self, payload, origin, flash)

        patch.setattr(AgreementSlot, "confirm", confirm)

    return bend


def _from_anywhere(self: AgreementSlot, origin: Any) -> None:
    assert self._pending is not None
    self._pending.link, self._pending.session = origin.link, origin.session


def _from_any_session(self: AgreementSlot, origin: Any) -> None:
    assert self._pending is not None
    self._pending.session = origin.session if origin.session and self._pending.session else self._pending.session


def _from_any_link(self: AgreementSlot, origin: Any) -> None:
    assert self._pending is not None
    self._pending.link = origin.link


confirm_from_anywhere = _confirmed_as(_from_anywhere)
confirm_from_any_session = _confirmed_as(_from_any_session)
confirm_from_any_link = _confirmed_as(_from_any_link)


def the_first_request_stays(patch: Patch) -> None:
    original = AgreementSlot.request

    def request(self: AgreementSlot, *args: Any) -> bytes:
        before, reply = self._pending, original(self, *args)
        self._pending = before or self._pending
        return reply

    patch.setattr(AgreementSlot, "request", request)


def reset_leaves_the_request(patch: Patch) -> None:
    original = Tim._reset

    def reset(self: Tim, *args: Any) -> bytes:
        pending = self._agreeing._pending
        reply = original(self, *args)
        self._agreeing._pending = pending
        return reply

    patch.setattr(Tim, "_reset", reset)


def sessions_survive_confirm(patch: Patch) -> None:
    patch.setattr(Tim, "_end_everything", lambda self: self._agreeing.forget())


def half_open_survives_confirm(patch: Patch) -> None:
    def end_all(self: Sessions) -> None:
        for held in self._links.values():
            held.session = None

    patch.setattr(Sessions, "end_all", end_all)


def _lenient(verified: Any) -> Any:
    return lambda point, message, signature: verified(point, message, normalise_signature(signature))


def any_s_in_a_request(patch: Patch) -> None:
    original = AgreementSlot.request

    def request(self: AgreementSlot, *args: Any) -> bytes:
        self._verify = _lenient(verify)
        return original(self, *args)

    patch.setattr(AgreementSlot, "request", request)


def station_signed_as(message: Callable[[bytes], bytes]) -> Bend:
    """Return a node that looks for SIG104 over another message."""
    return lambda patch: patch.setattr(node_agreement, "station_key_message", message)


def static_keys_are_good(patch: Patch) -> None:
    """One's own point is looked for, the station's static one is not."""

    def good(point: bytes, own: bytes, *_others: bytes) -> bool:
        from teds_provision.protocol.wire_agreement import good_point

        return good_point(point, own)

    patch.setattr(node_agreement, "good_one_time", good)
    patch.setattr(node_sessions, "good_one_time", good)


def signature_before_points(patch: Patch) -> None:
    original = AgreementSlot.request

    def request(self: AgreementSlot, payload: bytes, origin: Any, flash: Flash) -> bytes:
        if len(payload) == 259:
            request = RequestPayload.decode(payload)
            if not verify(request.ca, b"TEDS1 station key\0" + request.station, request.station_signature):
                raise CommandRefusedError(Reason.BAD_SIGNATURE)
        return original(self, payload, origin, flash)

    patch.setattr(AgreementSlot, "request", request)


# -- the node's half of Open and Sealed --------------------------------------------------------------------------------


def opening_so(
    *,
    z: Callable[[bytes], bytes] = lambda z: z,
    okm: Callable[[bytes, bytes, bytes], bytes] = lambda z, key, info: hkdf(z, key, info, 96),
    label: bytes = b"TEDS1 session\0",
    points: Callable[[bytes, bytes], bytes] = lambda station, node: station + node,
    kc: Callable[[bytes], bytes] = lambda okm: okm[32:64],
    tag_label: bytes = b"node open",
    with_key_id: bool = True,
    swapped: bool = False,
) -> Bend:
    """Return a node that makes session keys or the tag of Open with one thing made otherwise."""

    def init(self: NodeSession, key: bytes, uuid: bytes, station: bytes, one_time: PrivateKey) -> None:
        own = one_time.point
        made = okm(z(one_time.ecdh(station)), key, label + uuid + points(station, own))
        identifier = sha(b"TEDS1 key id\0" + key)[:8] if with_key_id else b""
        tag = mac(kc(made), tag_label + identifier + station + own)[:16]
        to_node, to_station = (made[16:32], made[:16]) if swapped else (made[:16], made[16:32])
        self._keys = SessionKeys(to_node, to_station, made[64:], tag)
        self.reply = own + tag
        self.counter, self.good_at = 0, 0.0

    return lambda patch: patch.setattr(NodeSession, "__init__", init)


def sealing_so(
    *,
    padding: Callable[[bytes], bytes] = pad,
    nonce: Callable[[bytes], bytes] = lambda counter: bytes(9) + counter,
    head: Callable[[int], bytes] = lambda counter: counter.to_bytes(4, "big"),
    aad: bool = False,
) -> Bend:
    """Return a node that seals its replies with one thing made otherwise."""

    def seal(self: NodeSession, counter: int, frame: bytes) -> bytes:
        number = counter.to_bytes(4, "big")
        sealed = AESCCM(self._keys.to_station, tag_length=16).encrypt(
            nonce(number), padding(frame), number if aad else None
        )
        return head(counter) + sealed

    return lambda patch: patch.setattr(NodeSession, "seal", seal)


def unsealing_so(*, nonce: Callable[[bytes], bytes] = lambda c: bytes(9) + c, aad: bool = False) -> Bend:
    """Return a node that opens Sealed frames with one thing made otherwise."""

    def unseal(self: NodeSession, payload: bytes) -> bytes | None:
        counter = payload[:4]
        try:
            padded = AESCCM(self._keys.to_node, tag_length=16).decrypt(
                nonce(counter), payload[4:], counter if aad else None
            )
        except Exception:  # noqa: BLE001 - whatever is wrong with it
            return None
        return padded[: -padded[-1]]

    return lambda patch: patch.setattr(NodeSession, "unseal", unseal)


def no_full_block(frame: bytes) -> bytes:
    return frame if len(frame) % 16 == 0 else pad(frame)


def zeros(frame: bytes) -> bytes:
    return frame + bytes(-len(frame) % 16 or 16)


def any_padding(patch: Patch) -> None:
    """The tag is looked at, the padding is taken off as its last octet says."""

    def unseal(self: NodeSession, payload: bytes) -> bytes | None:
        nonce = bytes(9) + payload[:4]
        try:
            padded = AESCCM(self._keys.to_node, tag_length=16).decrypt(nonce, payload[4:], None)
        except Exception:  # noqa: BLE001 - whatever is wrong with it
            return None
        return padded[: 6 + int.from_bytes(padded[4:6], "big")]

    patch.setattr(NodeSession, "unseal", unseal)


def keys_known_as(identifier: Callable[[bytes], bytes]) -> Bend:
    """Return a node that makes keyId otherwise where it looks for it."""
    return lambda patch: patch.setattr(node_sessions, "key_id", identifier)


def opened_by(made: Callable[[bytes, bytes, bytes, bytes], bytes]) -> Bend:
    """Return a node that waits for another mac of Open."""
    return lambda patch: patch.setattr(node_sessions, "open_mac", made)


def one_time_key_twice(patch: Patch) -> None:
    key, original = SoftwareKey.generate(), NodeSession.__init__
    patch.setattr(NodeSession, "__init__", lambda self, k, uuid, es, _: original(self, k, uuid, es, key))


def _opened(change: Callable[[Sessions, str, Any], None]) -> Bend:
    def bend(patch: Patch) -> None:
        original = Sessions.open

        def opened(self: Sessions, payload: bytes, link: str, flash: Flash) -> bytes:
            before = self._links[link].half_open if link in self._links else None
            reply = original(self, payload, link, flash)
            if payload:
                change(self, link, before)
            return reply

        patch.setattr(Sessions, "open", opened)

    return bend


def _session_gone(self: Sessions, link: str, _before: Any) -> None:
    self._links[link].session = None


def _first_stays(self: Sessions, link: str, before: Any) -> None:
    self._links[link].half_open = before or self._links[link].half_open


def _by_two(self: Sessions, _link: str, _before: Any) -> None:
    self._opens += 1


open_ends_the_session = _opened(_session_gone)
the_first_open_stays = _opened(_first_stays)
c_grows_by_two = _opened(_by_two)


def c_little_endian(patch: Patch) -> None:
    def grown(self: Sessions, payload: bytes, link: str, flash: Flash) -> bytes:
        before = self._opens
        try:
            return original(self, payload, link, flash)
        finally:
            if self._opens != before:
                little = int.from_bytes(before.to_bytes(8, "big"), "little") + 1
                self._opens = int.from_bytes((little % (1 << 64)).to_bytes(8, "little"), "big")

    original = Sessions.open
    patch.setattr(Sessions, "open", grown)


def a_bad_point_costs_no_c(patch: Patch) -> None:
    original = Sessions.open

    def opened(self: Sessions, *args: Any) -> bytes:
        before = self._opens
        try:
            return original(self, *args)
        except CommandRefusedError:
            self._opens = before
            raise

    patch.setattr(Sessions, "open", opened)


def room_for_one(patch: Patch) -> None:
    original = Sessions.__init__

    def init(self: Sessions, *args: Any, **more: Any) -> None:
        original(self, *args, **{**more, "room": 1})

    patch.setattr(Sessions, "__init__", init)


def a_third_link_takes_the_place_of_a_session(patch: Patch) -> None:
    """One struct a link, two of them: what the prototype in C did."""
    original, heard = Tim.handle, list[str]()

    def handle(self: Tim, frame: bytes, *, link: str, **more: Any) -> bytes:
        if link not in heard:
            heard.append(link)
        if len(heard) > 2:
            self._sessions.lose(heard.pop(0))
        return original(self, frame, link=link, **more)

    patch.setattr(Tim, "handle", handle)


# -- TEDS, commit, address, reset --------------------------------------------------------------------------------------


def _written(change: Callable[..., Reply]) -> Bend:
    """``change`` is called with the original Write and its arguments: access, flash, command, staging, session, now."""

    def bend(patch: Patch) -> None:
        original = teds_access.TedsAccess.write

        def write(self: Any, *args: Any, **more: Any) -> Reply:
            return change(original, self, *args, **more)

        patch.setattr(teds_access.TedsAccess, "write", write)

    return bend


def _block(command: Command) -> tuple[int, int]:
    return command.channel, command.payload[0]


def _keeps_the_rest(
    original: Any, self: Any, flash: Flash, command: Command, staging: Any, *more: Any, now: float
) -> Reply:
    before = staging._images.get(_block(command), b"")
    reply: Reply = original(self, flash, command, staging, *more, now=now)
    staging._images[_block(command)] += before[len(staging._images[_block(command)]) :]
    return reply


def _any_size(original: Any, self: Any, *args: Any, now: float) -> Reply:
    reply: Reply = original(replace(self, max_teds=self.max_teds + 100), *args, now=now)
    return reply


def _refused_drops(
    original: Any, self: Any, flash: Flash, command: Command, staging: Any, *more: Any, now: float
) -> Reply:
    try:
        reply: Reply = original(self, flash, command, staging, *more, now=now)
    except CommandRefusedError:
        staging._images.pop(_block(command), None)
        raise
    return reply


def _empty_stages_nothing(
    original: Any, self: Any, flash: Flash, command: Command, staging: Any, *more: Any, now: float
) -> Reply:
    reply: Reply = original(self, flash, command, staging, *more, now=now)
    if len(command.payload) == 5:
        del staging._images[_block(command)]
    return reply


write_keeps_the_rest = _written(_keeps_the_rest)
any_size = _written(_any_size)
a_refused_write_drops = _written(_refused_drops)
an_empty_write_stages_nothing = _written(_empty_stages_nothing)


def staging_for_ever(patch: Patch) -> None:
    """It belongs to nobody, so that it goes with no session."""
    patch.setattr(teds_access.Staging, "staged_by", lambda self, session: self._images)
    patch.setattr(teds_access.Staging, "require", lambda self, session, **_: None)
    patch.setattr(teds_access.Staging, "end", lambda self, session=None: None)

    def put(self: Any, session: NodeSession, block: Any, image: bytes, now: float) -> None:
        self._images[block] = image

    patch.setattr(teds_access.Staging, "put", put)


def staging_per_session(patch: Patch) -> None:
    """One for each session, as the draft had it."""
    areas: dict[NodeSession, dict[Any, bytes]] = {}
    patch.setattr(teds_access.Staging, "staged_by", lambda self, session: areas.get(session, {}))
    patch.setattr(teds_access.Staging, "require", lambda self, session, **_: None)

    def put(self: Any, session: NodeSession, block: Any, image: bytes, now: float) -> None:
        areas.setdefault(session, {})[block] = image

    def end(self: Any, session: NodeSession | None = None) -> None:
        areas.clear() if session is None else areas.pop(session, None)

    patch.setattr(teds_access.Staging, "put", put)
    patch.setattr(teds_access.Staging, "end", end)


def staging_taken_by_the_last(patch: Patch) -> None:
    """Another session's Write throws out what is staged."""
    patch.setattr(teds_access.Staging, "require", lambda self, session, **_: None)


def listed_is_enough(patch: Patch) -> None:
    """Commit looks whether what 108 lists is there, and not at its digest."""

    def listed(flash: Flash, staged: Any, signed: Any) -> dict[Any, bytes]:
        found = {block: staged.get(block) or flash.teds(block) for block in signed.signed_blocks}
        if None in found.values() or staged.keys() - {(0, 128)} - found.keys():
            raise CommandRefusedError(Reason.DIGEST_MISMATCH)
        return {block: teds for block, teds in found.items() if teds is not None}

    patch.setattr(teds_access, "_listed_blocks", listed)


def digest_of_data_blocks(patch: Patch) -> None:
    """Commit compares the digests of 108 with those of the data blocks."""
    original = teds_access._listed_blocks

    def listed(flash: Flash, staged: Any, signed: Any) -> dict[Any, bytes]:
        blocks = {block: staged.get(block) or flash.teds(block) for block in signed.signed_blocks}
        for block, teds in blocks.items():
            if teds is None or sha(teds[4:-2]) != signed.signed_blocks[block]:
                raise CommandRefusedError(Reason.DIGEST_MISMATCH)
        right = {block: sha(teds) for block, teds in blocks.items() if teds is not None}
        return original(flash, staged, replace(signed, signed_blocks=right))

    patch.setattr(teds_access, "_listed_blocks", listed)


def a_refused_commit_counts(patch: Patch) -> None:
    original = teds_access.verified_commit

    def committed(flash: Flash, *args: Any) -> Flash:
        try:
            return original(flash, *args)
        except CommandRefusedError:
            object.__setattr__(flash, "sequence", flash.sequence + 1)
            raise

    patch.setattr(teds_access, "verified_commit", committed)


def takes_an_old_sequence(patch: Patch) -> None:
    original = teds_access.verified_commit

    def forgetful(flash: Flash, staged: Any, verify: Any) -> Flash:
        return original(replace(flash, sequence=flash.sequence - 1), staged, verify)

    patch.setattr(teds_access, "verified_commit", forgetful)


def any_s_in_a_datasheet(patch: Patch) -> None:
    original = teds_access.verified_commit

    def lenient(flash: Flash, staged: Any, verified: Any) -> Flash:
        return original(flash, staged, _lenient(verified))

    patch.setattr(teds_access, "verified_commit", lenient)


def _decoded(text: Callable[[bytes], bytes]) -> Bend:
    """The node's own reading of a Security TEDS is laxer: ``text`` mends the octets before it looks."""

    def bend(patch: Patch) -> None:
        original = security.decode

        class LaxSecurity:
            NotCanonical = security.NotCanonicalError

            @staticmethod
            def decode(teds: bytes) -> Any:
                from teds_provision.teds.codec.frame import frame

                return original(frame(text(teds[4:-2])))

        patch.setattr(teds_access, "security", LaxSecurity)

    return bend


def place(block: bytes, field: int) -> int:
    """Return where the value of a field begins, 1 for none."""
    at = 6
    while at < len(block):
        if block[at] == field:
            return at + 2
        at += 2 + block[at + 1]
    return 1


def _any_text(block: bytes) -> bytes:
    at = place(block, 5) - 2
    size = block[at + 1]
    lenient = block[at + 2 : at + 2 + size].decode("utf-8", "replace").encode("ascii", "replace")[:size]
    return block[: at + 2] + lenient.ljust(size, b"?") + block[at + 2 + size :]


def _any_base64(block: bytes) -> bytes:
    out = block
    for field in (100, 101, 103, 104):
        at = place(out, field) - 2
        if at >= 0:
            text = out[at + 2 : at + 90]
            raw = base64.b64decode(text.replace(b"\n", b"A"))
            out = out[: at + 2] + base64.b64encode(raw).ljust(88, b"=")[:88] + out[at + 90 :]
    return out


any_text = _decoded(_any_text)
any_base64 = _decoded(_any_base64)


def refuses_111(patch: Patch) -> None:
    original = security.decode

    class StrictSecurity:
        NotCanonical = security.NotCanonicalError

        @staticmethod
        def decode(teds: bytes) -> Any:
            shown = original(teds)
            if shown.extra:
                raise security.NotCanonicalError("A field 111 is unknown here.")
            return shown

    patch.setattr(teds_access, "security", StrictSecurity)


def signs_without_111(patch: Patch) -> None:
    """Field 100 is held against a data block from which 111 to 255 are left out, or the whole."""
    original = datasheet.signature_good

    def good(teds: Any, octets: bytes, uuid: bytes, check: Any = None) -> bool:
        return bool(teds.extra) or original(teds, octets, uuid, check)

    patch.setattr(datasheet, "signature_good", good)


def datasheet_signed_as(message: Callable[[bytes, bytes], bytes]) -> Bend:
    """Return a node that makes TBS otherwise; given UUID and the data block without field 100."""

    def bend(patch: Patch) -> None:
        def good(teds: Any, octets: bytes, uuid: bytes, check: Any = None) -> bool:
            block = security.tbs(uuid, octets).removeprefix(b"TEDS1 datasheet\0" + uuid)
            return verify(teds.station_key, message(uuid, block), teds.signature)

        patch.setattr(datasheet, "signature_good", good)

    return bend


def any_address(patch: Patch) -> None:
    patch.setattr(node, "LAST_ADDRESS", 255)


def reset_to(change: Callable[[Flash, Flash], Flash]) -> Bend:
    original = node.in_factory_state
    return lambda patch: patch.setattr(node, "in_factory_state", lambda flash: change(flash, original(flash)))


def any_challenge_of_reset(patch: Patch) -> None:
    original = node._length
    patch.setattr(node, "_length", lambda payload, octets: None if octets == 32 else original(payload, octets))


def signs_for(function: Function, message: Callable[[bytes, bytes, int], bytes]) -> Bend:
    """Return a node that signs another message for Prove or Reset; given UUID, challenge, epoch."""

    def bend(patch: Patch) -> None:
        name = "_prove" if function == Function.PROVE else "_reset"
        original = getattr(Tim, name)

        def signed(self: Tim, payload: bytes, origin: Any) -> bytes:
            flash = self._flash
            original(self, payload, origin)
            return self.key.sign(message(flash.uuid, payload, flash.epoch))

        patch.setattr(Tim, name, signed)

    return bend


def node_key_without_uuid(patch: Patch) -> None:
    patch.setattr(bench, "node_key_message", lambda uuid, point: b"TEDS1 node key\0" + point)


def prove_as_digest(patch: Patch) -> None:
    original = Tim._prove

    def prove(self: Tim, payload: bytes, origin: Any) -> bytes:
        original(self, payload, origin)
        return self.key.sign_digest(payload)

    patch.setattr(Tim, "_prove", prove)


def any_lease(patch: Patch) -> None:
    patch.setattr(role, "FIRST_LEASE", 0)


def no_seconds_between_addresses(patch: Patch) -> None:
    original = Tim._set_can_address

    def set_address(self: Tim, *args: Any) -> bytes:
        self._address_written_at = None
        return original(self, *args)

    patch.setattr(Tim, "_set_can_address", set_address)
