"""Manage (128.23) on the node: which SMP packets pass to the board's manager, and when (profile.md, "Manage"). Pure.

A manager is written by others and can do more than an update needs: erase storage, confirm an image that never ran,
enter recovery. So only listed commands with bodies of a known form reach it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from teds_provision.protocol.messages.frames import CommandRefusedError, Reason
from teds_provision.protocol.messages.smp import (
    ECHO,
    EMPTY_MAP,
    LEAST_OCTETS,
    LISTED,
    MANAGE_OVERHEAD,
    READ,
    RESTART,
    SET_STATE,
    SMP_ERROR_KEYS,
    UPLOAD,
    WRITE,
    SmpPacket,
    decode_map,
    decode_packet,
)
from teds_provision.protocol.session import NodeSession

UPLOAD_SECONDS: Final = 60.0
"""An upload without a good packet for so long is over."""
_ANOTHER_SECONDS: Final = 10.0
"""Seconds after the start of an upload in which another image is refused: each start erases flash."""

_SHA_OCTETS: Final = 32
_OPEN_MAP: Final = 0xBF
"""First octet of a map of indefinite length."""

_CONFIRM: Final = re.compile(rb"\xa1\x67confirm\xf5", re.DOTALL)
_START: Final = re.compile(rb"\xa1\x64hash\x58\x20.{32}|\xa2\x64hash\x58\x20.{32}\x67confirm\xf4", re.DOTALL)


class Manager(Protocol):
    """The board's SMP server, which knows nothing of sessions."""

    @property
    def offered(self) -> bool:
        """True if the boot loader checks the owner's signature, tries a new image once, and reverts by itself."""

    @property
    def buffer(self) -> int:
        """Octets of the longest packet that it takes (buf_size of 0/6)."""

    @property
    def on_trial(self) -> bool:
        """True if the running image is on trial."""

    @property
    def pending(self) -> bool:
        """True if another image starts at the next restart."""

    def manage(self, packet: bytes) -> bytes:
        """Run one packet and return its reply; an error is a reply, too."""

    def restart(self) -> None:
        """Restart the board."""


@dataclass
class _Upload:
    session: NodeSession
    good_at: float


class ManageFilter:
    """Hands packets that may pass to the ``manager`` of a node; :meth:`run` raises CommandRefusedError for the rest.

    ``claimed`` is true while any session has a claim; ``staged_elsewhere`` raises CommandRefusedError if another
    session than the given one has something staged.
    """

    def __init__(
        self,
        manager: Manager,
        clock: Callable[[], float],
        max_message: int,
        *,
        claimed: Callable[[], bool],
        staged_elsewhere: Callable[[NodeSession], None],
    ) -> None:
        self._manager, self._clock, self._max_message = manager, clock, max_message
        self._claimed, self._staged_elsewhere = claimed, staged_elsewhere
        self._upload: _Upload | None = None
        self._started: tuple[bytes, float] | None = None
        self._started_octets = 0
        self.restart_link: str | None = None
        """The link whose next reply ends with a restart of the node."""

    @property
    def on_trial(self) -> bool:
        """True if the running image is on trial: nothing stored changes."""
        return self._manager.on_trial

    @property
    def uploading(self) -> bool:
        """True while the upload of any session lives."""
        upload = self._upload
        if upload is not None and self._clock() - upload.good_at >= UPLOAD_SECONDS:
            self._upload = upload = None
        return upload is not None

    def session_ended(self, session: NodeSession) -> None:
        """End the upload of a session that is over; what came is kept for the next one."""
        if self._upload is not None and self._upload.session is session:
            self._upload = None

    def reply_sent(self, link: str) -> None:
        """Restart the node if that was the reply to a restart."""
        if self.restart_link == link:
            self.restart_link = None
            self._manager.restart()

    def run(self, octets: bytes, session: NodeSession, link: str) -> bytes:
        """Run one packet of a session and return the reply packet; raises CommandRefusedError."""
        if not self._manager.offered:
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        packet = self._whole(octets)
        if packet.command not in LISTED:
            raise CommandRefusedError(Reason.NOT_PERMITTED)
        self._require_form(packet)
        self._require_time(packet, session)
        if packet.command == RESTART:
            self.restart_link = link
            return packet.reply(EMPTY_MAP).encode()
        reply = self._manager.manage(octets)
        answer = self._answer(packet, reply)
        if packet.command == UPLOAD:
            if not _is_count(answer.get("off", 0)):
                raise CommandRefusedError(Reason.FLASH_FAILURE)
            self._upload_piece(packet, session, answer)
        return reply

    @property
    def _most_octets(self) -> int:
        return min(self._max_message - MANAGE_OVERHEAD, self._manager.buffer)

    def _answer(self, packet: SmpPacket, reply: bytes) -> dict[str, object]:
        """Return the map of the manager's reply; raises CommandRefusedError (11) if it is no reply to this packet."""
        try:
            decoded = decode_packet(reply)
            if len(reply) <= self._most_octets and packet.reply(decoded.body).encode() == reply:
                return decode_map(decoded.body)
        except ValueError:
            pass
        raise CommandRefusedError(Reason.FLASH_FAILURE)

    def _whole(self, octets: bytes) -> SmpPacket:
        if len(octets) > self._most_octets:
            raise CommandRefusedError(Reason.TOO_LARGE)
        if len(octets) < LEAST_OCTETS:
            raise CommandRefusedError(Reason.BAD_FORM)
        packet = decode_packet(octets)
        if packet.command.first not in (READ, WRITE) or not packet.whole:
            raise CommandRefusedError(Reason.BAD_FORM)
        return packet

    def _require_form(self, packet: SmpPacket) -> None:
        """Check a body: octet for octet if it could do harm, else that it is one map (4); then 2."""
        body = packet.body
        if packet.command == RESTART:
            good = body == EMPTY_MAP
        elif packet.command == SET_STATE:
            good = bool(_CONFIRM.fullmatch(body) or _START.fullmatch(body))
        else:
            good = _is_map(body) and (packet.command != UPLOAD or _is_piece(body))
        if not good:
            raise CommandRefusedError(Reason.BAD_FORM)
        if _confirms(packet) and not self._manager.on_trial:
            raise CommandRefusedError(Reason.WRONG_STATE)

    def _require_time(self, packet: SmpPacket, session: NodeSession) -> None:
        """Refuse (17) what could disturb the work of another session, or use up the way back."""
        if packet.command.first == READ or packet.command == ECHO or _confirms(packet):
            return
        other = self.uploading and self._upload is not None and self._upload.session is not session
        if self._claimed() or other:
            raise CommandRefusedError(Reason.BUSY)
        self._staged_elsewhere(session)
        if packet.command == RESTART:
            return
        if self._manager.on_trial or self._manager.pending:
            raise CommandRefusedError(Reason.BUSY)
        if packet.command == UPLOAD:
            self._require_same_image(decode_map(packet.body))

    def _require_same_image(self, piece: dict[str, object]) -> None:
        if piece["off"] != 0:
            return
        sha, now = piece.get("sha", b""), self._clock()
        assert isinstance(sha, bytes)
        if self._started is not None and self._started[0] != sha and now - self._started[1] < _ANOTHER_SECONDS:
            raise CommandRefusedError(Reason.BUSY)
        self._started = (sha, now)

    def _upload_piece(self, packet: SmpPacket, session: NodeSession, answer: dict[str, object]) -> None:
        piece = decode_map(packet.body)
        if piece["off"] == 0:
            self._started_octets = piece.get("len", 0)
        if any(key in answer for key in SMP_ERROR_KEYS):
            return
        done = "match" in answer or self._is_whole(answer.get("off"))
        self._upload = None if done else _Upload(session, self._clock())

    def _is_whole(self, off: object) -> bool:
        """Return True if all octets came, or more: nothing can follow. Without a length an image is never whole."""
        return isinstance(off, int) and 0 < self._started_octets <= off


def _confirms(packet: SmpPacket) -> bool:
    return packet.command == SET_STATE and bool(_CONFIRM.fullmatch(packet.body))


def _is_map(body: bytes) -> bool:
    try:
        decode_map(body)
    except ValueError:
        return False
    return True


def _is_piece(body: bytes) -> bool:
    """Return True if what the filter decodes is of its type, in a map of definite length that holds no other one."""
    piece = decode_map(body)
    sha = piece.get("sha", b"")
    return (
        body[0] != _OPEN_MAP
        and _is_count(piece.get("off"))
        and _is_count(piece.get("len", 0))
        and isinstance(sha, bytes)
        and len(sha) <= _SHA_OCTETS
        and not any(isinstance(value, dict | list) for value in piece.values())
    )


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
