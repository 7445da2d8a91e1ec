"""Parts of the reference node bent, beside those of ``bends``: comparisons, the commit, ends of CAN, measurement."""

from __future__ import annotations

import hmac
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from teds_provision.links.can import isotp
from teds_provision.links.can.isotp import Frame, Pair
from teds_provision.node.can import endpoint, server
from teds_provision.protocol import datasheet
from teds_provision.protocol.announce import AddressClaim, Announce
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import Command, CommandRefusedError, Reason, Reply
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation import role, stream_role, streams
from teds_provision.protocol.operation.claims import Claims
from teds_provision.protocol.operation.commands import OperateCommand
from teds_provision.protocol.operation.role import OperationRole
from teds_provision.protocol.operation.stream_role import StreamRole
from teds_provision.protocol.session import NodeSession
from teds_provision.protocol.tim import node_agreement, node_sessions, teds_access
from teds_provision.protocol.tim.node import Tim
from teds_provision.protocol.tim.node_sessions import OpenedFrame, Sessions
from teds_provision.teds.codec import security

Patch = pytest.MonkeyPatch
Bend = Callable[[Patch], None]


def _compared(module: ModuleType, same: Callable[[bytes, bytes], bool]) -> Bend:
    return lambda patch: patch.setattr(module, "hmac", SimpleNamespace(compare_digest=same, digest=hmac.digest))


open_mac_of_8_octets = _compared(node_sessions, lambda left, right: left[:8] == right[:8])
key_id_of_4_octets = _compared(
    node_sessions, lambda left, right: left == right or (len(left) == 8 and left[:4] == right[:4])
)
station_tag_of_8_octets = _compared(node_agreement, lambda left, right: left[:8] == right[:8])
any_token = _compared(stream_role, lambda _left, _right: True)


# -- sessions, the commit, what is stored ------------------------------------------------------------------------------


def session_of_any_address(patch: Patch) -> None:
    original = Sessions.open_frame

    def open_frame(self: Sessions, payload: bytes, link: str) -> OpenedFrame:
        others = [other for other in self._links if other != link]
        for peer in (link, *others):
            if peer in self._links:
                try:
                    return original(self, payload, peer)
                except CommandRefusedError as refused:
                    if refused.reason != Reason.BAD_TAG:
                        raise
        raise CommandRefusedError(Reason.BAD_TAG)

    patch.setattr(Sessions, "open_frame", open_frame)
    patch.setattr(Sessions, "any_on", lambda self, link: bool(self._links))


def takes_an_older_epoch(patch: Patch) -> None:
    original = teds_access.verified_commit

    def committed(flash: Flash, staged: Mapping[Any, bytes], verify: Any) -> Flash:
        try:
            older = min(security.decode(staged[0, 128]).key_epoch, flash.epoch)
        except security.NotCanonicalError:
            older = flash.epoch
        return replace(original(replace(flash, epoch=older), staged, verify), epoch=flash.epoch)

    patch.setattr(teds_access, "verified_commit", committed)


def calibration_unchecked(patch: Patch) -> None:
    original = datasheet.passes_own_check

    def passes(block: tuple[int, int], teds: bytes) -> bool:
        return block[1] == 5 or original(block, teds)

    patch.setattr(datasheet, "passes_own_check", passes)
    patch.setattr(teds_access, "passes_own_check", passes)


def never_provisioned(patch: Patch) -> None:
    original = Tim.identity

    def identity(self: Tim) -> Identity:
        now = original(self)
        return replace(now, state=min(now.state, NodeState.KEYED))

    patch.setattr(Tim, "identity", identity)


def rotation_unprovisions(patch: Patch) -> None:
    """A Confirm of a node with a datasheet leaves a node that shows none."""
    original = node_agreement.AgreementSlot.confirm

    def confirm(self: Any, payload: bytes, origin: Any, flash: Flash) -> Flash:
        return replace(original(self, payload, origin, flash), provisioned=False)

    patch.setattr(node_agreement.AgreementSlot, "confirm", confirm)


def staging_survives_the_commit(patch: Patch) -> None:
    original = teds_access.Staging.end

    def end(self: Any, session: NodeSession | None = None) -> None:
        if session is not None:  # its session is over; a commit names none
            original(self, session)

    patch.setattr(teds_access.Staging, "end", end)


def read_gives_what_is_staged(patch: Patch) -> None:
    """Read and Query look into the staging area first."""
    latest: list[Any] = []
    put = teds_access.Staging.put
    read = teds_access.TedsAccess.read

    def put_and_note(self: Any, session: NodeSession, block: Any, image: bytes, now: float) -> None:
        put(self, session, block, image, now)
        latest[:] = [self]

    def read_staged(self: Any, flash: Flash, command: Command) -> Reply:
        staged = latest[0]._images if latest else {}
        block = (command.channel, command.payload[0]) if command.payload else None
        if block in staged:
            return read(self, replace(flash, blocks={**flash.blocks, block: staged[block]}), command)
        return read(self, flash, command)

    patch.setattr(teds_access.Staging, "put", put_and_note)
    patch.setattr(teds_access.TedsAccess, "read", read_staged)


def update_stores_at_once(patch: Patch) -> None:
    """Update of any TEDS stores it, whatever datasheet covers it."""
    original = teds_access.TedsAccess.update

    def update(self: Any, flash: Flash, command: Command, staging: Any, session: NodeSession, **more: Any) -> Any:
        reply, state = original(self, flash, command, staging, session, **more)
        block = (command.channel, command.payload[0])
        staged = staging.staged_by(session)
        if state is None and block in staged:
            state = replace(flash, blocks={**flash.blocks, block: staged[block]})
        return reply, state

    patch.setattr(teds_access.TedsAccess, "update", update)


def writes_read_only(patch: Patch) -> None:
    original = teds_access.TedsAccess.write

    def write(self: Any, flash: Flash, *args: Any, **more: Any) -> Reply:
        return original(self, replace(flash, read_only=frozenset()), *args, **more)

    patch.setattr(teds_access.TedsAccess, "write", write)


# -- the node's end of CAN ---------------------------------------------------------------------------------------------


def answers_for_any_address(patch: Patch) -> None:
    patch.setattr(server.EndpointTable, "at", lambda self, _address: list(self._endpoints))


def runs_what_everyone_is_asked(patch: Patch) -> None:
    original = server.CanServer._from_station

    def from_station(self: Any, station: int, frame: Frame) -> None:
        identify = isotp.read_single(frame.data) or b""
        if frame.identifier & 0x1FFFFF00 == isotp.FUNCTIONAL and identify[3:5] != b"\x80\x07":
            frame = replace(frame, identifier=isotp.physical_id(self._endpoints[0].address, station))
        original(self, station, frame)

    patch.setattr(server.CanServer, "_from_station", from_station)


def _heard(change: Callable[[Pair, bytes], bytes]) -> Bend:
    """Each frame is changed before the node's end of ISO-TP looks at it."""

    def bend(patch: Patch) -> None:
        original = Pair.handle_frame

        def handle(self: Pair, frame: Frame) -> bool:
            return original(self, replace(frame, data=change(self, frame.data)))

        patch.setattr(Pair, "handle_frame", handle)

    return bend


def _next_in_sequence(pair: Pair, data: bytes) -> bytes:
    if data[:1] and data[0] >> 4 == 2 and pair.receiving:
        return bytes([0x20 | (pair._logic.last_seqnum + 1) & 0xF]) + data[1:]
    return data


def _flow_with(at: int, octet: int) -> Callable[[Pair, bytes], bytes]:
    def change(_pair: Pair, data: bytes) -> bytes:
        return data[:at] + bytes([octet]) + data[at + 1 :] if data[:1] and data[0] >> 4 == 3 else data

    return change


any_sequence_number = _heard(_next_in_sequence)
wait_is_go_on = _heard(_flow_with(0, 0x30))
block_size_ignored = _heard(_flow_with(1, 0))
stmin_ignored = _heard(_flow_with(2, 0))


def short_first_frame(patch: Patch) -> None:
    patch.setattr(isotp, "_least_length", lambda _first: 1)


def escape_in_a_classic_frame(patch: Patch) -> None:
    original = isotp.read_single

    def read(data: bytes) -> bytes | None:
        if len(data) == 8 and data[0] == 0 and 0 < data[1] <= 6:
            return data[2 : 2 + data[1]]
        return original(data)

    patch.setattr(isotp, "read_single", read)


def announces_another_crc(patch: Patch) -> None:
    def announce(address: int, state: int, crc: int, pressed: bool = False) -> Announce:
        return Announce(address, state, crc ^ 1, pressed)

    patch.setattr(endpoint, "Announce", announce)


def claim_the_wrong_way_round(patch: Patch) -> None:
    original = AddressClaim.handle_announce

    def handle(self: AddressClaim, announce: Announce, own: int, now: float, *, pinned: bool = False) -> int:
        turned = replace(announce, crc=2 * self.crc - announce.crc) if announce.crc != self.crc else announce
        return original(self, turned, own, now, pinned=pinned)

    patch.setattr(AddressClaim, "handle_announce", handle)


def a_pressed_button_claims(patch: Patch) -> None:
    original = AddressClaim.handle_announce

    def handle(self: AddressClaim, announce: Announce, own: int, now: float, *, pinned: bool = False) -> int:
        return original(self, replace(announce, pressed=False), own, now, pinned=pinned)

    patch.setattr(AddressClaim, "handle_announce", handle)


# -- measurement -------------------------------------------------------------------------------------------------------


def lease_of_255(patch: Patch) -> None:
    original = OperateCommand.decode.__func__  # type: ignore[attr-defined]

    def decode(cls: type[OperateCommand], *args: Any, **more: Any) -> OperateCommand:
        asked: OperateCommand = original(cls, *args, **more)
        return replace(asked, lease=60) if asked.lease == 255 else asked

    patch.setattr(OperateCommand, "decode", classmethod(decode))


def any_digest(patch: Patch) -> None:
    class SameDigest:
        @staticmethod
        def sha256(_octets: bytes) -> Any:
            return SimpleNamespace(digest=lambda: SameDigest.asked)

        asked = b""

    original = OperateCommand.decode.__func__  # type: ignore[attr-defined]

    def decode(cls: type[OperateCommand], *args: Any, **more: Any) -> OperateCommand:
        asked: OperateCommand = original(cls, *args, **more)
        SameDigest.asked = asked.digest
        return asked

    patch.setattr(OperateCommand, "decode", classmethod(decode))
    patch.setattr(role, "hashlib", SameDigest)


def writes_under_a_claim(patch: Patch) -> None:
    patch.setattr(OperationRole, "demand_configuration", lambda self, session, **_more: None)


def values_unclaimed(patch: Patch) -> None:
    patch.setattr(OperationRole, "_demand_claimed", lambda self, session, *channels: None)


def lease_for_ever(patch: Patch) -> None:
    original = Claims.expire

    def expire(self: Claims, now: int) -> None:
        leases, self._leases = self._leases, {}
        original(self, now)
        self._leases = {session: lease for session, lease in leases.items() if self.channels_of(session)}

    patch.setattr(Claims, "expire", expire)
    patch.setattr(Claims, "next_deadline", lambda self: None)


def _sealed_under(nonce: Callable[[bytes], bytes]) -> Bend:
    class Sealer:
        def __init__(self, key: bytes) -> None:
            self._cipher = AESCCM(key, tag_length=8)

        def seal(self, counter: int, plain: bytes) -> bytes:
            head = counter.to_bytes(4, "big")
            return head + self._cipher.encrypt(nonce(head), plain, None)

    return lambda patch: patch.setattr(streams, "DatagramSealer", Sealer)


stream_nonce_counter_first = _sealed_under(lambda counter: counter + bytes(9))
stream_nonce_stands_still = _sealed_under(lambda _: bytes(13))


def run_stands_still(patch: Patch) -> None:
    original = StreamRole.subscribe

    def subscribe(self: StreamRole, payload: bytes, session: NodeSession, *more: Any) -> bytes:
        self._measuring_of(session).run = 0
        return original(self, payload, session, *more)

    patch.setattr(StreamRole, "subscribe", subscribe)


def _driven(before: Callable[[Any, int], None]) -> Bend:
    def bend(patch: Patch) -> None:
        original = StreamRole.drive_message

        def message(self: StreamRole, session: NodeSession, octets: bytes) -> None:
            run = self._measuring_of(session).drive
            if run is not None:
                before(run, int.from_bytes(octets[:4], "big"))
            original(self, session, octets)

        patch.setattr(StreamRole, "drive_message", message)

    return bend


def _any_counter(run: Any, _counter: int) -> None:
    run.last = None


def _same_counter(run: Any, counter: int) -> None:
    run.last = counter - 1 if run.last == counter else run.last


drive_replayed = _driven(_any_counter)
drive_twice = _driven(_same_counter)
