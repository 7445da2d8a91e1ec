"""A node and a station without links: frames in, frames out."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

from teds_provision.protocol.datasheet import SignedNodeKey, digests, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import Credentials, SoftwareKey, fingerprint, node_key_message, station_key_message
from teds_provision.protocol.messages.frames import Command, Reply, decode_reply, update_teds, write_teds
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, BlockId

from .memory import RamFlash

UUID = bytes.fromhex("8d4d9da65281f7000000")
CA = SoftwareKey(3)
STATION = SoftwareKey(5)
NODE = SoftwareKey(7)
CREDENTIALS = Credentials(STATION, CA.sign(station_key_message(STATION.point)), CA.point)
META = frame(bytes.fromhex("030400010101040a") + UUID + bytes.fromhex("0a043f8000000c043f0000000d020001"))
NAME = frame(bytes.fromhex("0304000c0101040100050d") + b"boom strain 7")


@dataclass
class Desk:
    """One node; a clock that the test moves; the station's present link key and session."""

    now: float = 0.0
    max_message: int = 2048
    blocks: dict[BlockId, bytes] = field(default_factory=dict)
    read_only: frozenset[BlockId] = frozenset()

    def __post_init__(self) -> None:
        flash = Flash(
            UUID,
            NODE.point,
            NODE.sign(node_key_message(UUID, NODE.point)),
            can_address=192,
            blocks=self.blocks,
            read_only=self.read_only,
        )
        self.memory = RamFlash(flash)
        self.key = b""
        self.session: StationSession | None = None
        self.restart()

    def restart(self) -> None:
        """Power off and on: RAM is gone."""
        self.tim = Tim(NODE, self.memory, lambda: self.now, max_message=self.max_message)

    @property
    def flash(self) -> Flash:
        return self.memory.state

    # -- sending ---------------------------------------------------------------------------------------------------

    def raw(self, octets: bytes, *, link: str = "nfc", tapped: bool = True) -> Reply:
        return decode_reply(self.tim.handle(octets, link=link, tapped=tapped))

    def plain(self, command: Command, *, link: str = "nfc", tapped: bool = True) -> Reply:
        return self.raw(command.encode(), link=link, tapped=tapped)

    def sealed(self, command: Command, *, link: str = "nfc") -> Reply:
        assert self.session is not None
        outer = self.plain(self.session.seal(command), link=link, tapped=link == "nfc")
        assert outer.ok, f"outer refusal {outer.reason}"
        return self.session.unseal(outer.payload)

    # -- states ----------------------------------------------------------------------------------------------------

    def agree(self, credentials: Credentials = CREDENTIALS, *, link: str = "nfc", tapped: bool = True) -> Desk:
        """Plain Request and Confirm."""
        agreement = StationAgreement(credentials, UUID)
        reply = self.plain(agreement.request(), link=link, tapped=tapped)
        assert reply.ok, f"Request refused: {reply.reason}"
        teds, epoch = self.flash.security_teds(), self.flash.epoch
        agreed = agreement.accept(reply.payload, teds, pinned=fingerprint(NODE.point), epoch=epoch)
        assert self.plain(agreed.confirm, link=link, tapped=tapped) == Reply(True)
        self.key = agreed.key
        return self

    def open(self, *, link: str = "nfc") -> Desk:
        """Open a session on a link."""
        self.session = StationSession(self.key, UUID)
        counter = self.plain(self.session.request_counter(), link=link, tapped=link == "nfc")
        reply = self.plain(self.session.open(counter.payload), link=link, tapped=link == "nfc")
        assert reply.ok, f"Open refused: {reply.reason}"
        self.session.accept(reply.payload)
        return self

    def provision(self, blocks: dict[BlockId, bytes] | None = None) -> Desk:
        """Agree, open, write Meta and Name, commit."""
        self.agree().open()
        reply = self.commit(blocks or {(0, 1): META, (1, 12): NAME})
        assert reply.ok, f"commit refused: {reply.reason}"
        return self

    # -- datasheets ------------------------------------------------------------------------------------------------

    def signed(self, listed: dict[BlockId, bytes], **changes: object) -> bytes:
        """Return a Security TEDS over these blocks, next sequence, present epoch; ``changes`` replace its values."""
        values: dict[str, object] = {
            "ca": security.ca_hint("peer", fingerprint(CA.point)),
            "last_modified": bytes(8),
            "sequence": self.flash.sequence + 1,
            "key_epoch": self.flash.epoch,
            **changes,
        }
        keys = SignedNodeKey(UUID, NODE.point, self.flash.node_key_signature)
        sheet = unsigned_datasheet(keys, STATION.point, CREDENTIALS.station_signature, digests(listed), **values)
        return sign_datasheet(sheet, UUID, CREDENTIALS)

    def stage(self, block: BlockId, teds: bytes) -> Reply:
        return self.sealed(write_teds(*block, 0, teds))

    def commit(self, blocks: dict[BlockId, bytes], teds: bytes | None = None) -> Reply:
        """Stage these blocks and a Security TEDS (default: signed over them), and commit."""
        for block, octets in blocks.items():
            assert self.stage(block, octets).ok
        assert self.stage(SECURITY, self.signed(blocks) if teds is None else teds).ok
        return self.sealed(update_teds(*SECURITY))

    def commit_in_pieces(self, blocks: dict[BlockId, bytes], *, piece: int) -> None:
        """Stage and commit in Writes of at most so many octets."""
        for block, octets in {**blocks, SECURITY: self.signed(blocks)}.items():
            for at in range(0, len(octets), piece):
                assert self.sealed(write_teds(*block, at, octets[at : at + piece])).ok
        assert self.sealed(update_teds(*SECURITY)).ok

    def agree_in_session(self) -> None:
        """Rotate inside the open session."""
        agreement, teds = StationAgreement(CREDENTIALS, UUID), self.flash.security_teds()
        reply = self.sealed(agreement.request())
        agreed = agreement.accept(reply.payload, teds, pinned=None, epoch=self.flash.epoch)
        assert self.sealed(agreed.confirm) == Reply(True)
        self.key = agreed.key


def digest(teds: bytes) -> bytes:
    return hashlib.sha256(teds).digest()
