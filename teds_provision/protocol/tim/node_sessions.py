"""The node's sessions: Open, Sealed, lives and ends, on every link (profile.md, "Sessions").

A link has at most one session and one half-open Open; all links together have room for so many of each.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import CommandRefusedError, Reason
from teds_provision.protocol.session import (
    BLOCK_OCTETS,
    COUNTER_OCTETS,
    KEY_ID_OCTETS,
    OPEN_OCTETS,
    SEALED_HEAD_OCTETS,
    TAG_OCTETS,
    NodeSession,
    OneTime,
    open_mac,
)
from teds_provision.protocol.wire_agreement import good_one_time, key_id

HALF_OPEN_SECONDS: Final = 60.0
"""An Open that no good Sealed frame followed gives its place up (profile.md, "Sessions")."""
IDLE_SECONDS: Final = 600.0
"""A session without a good frame for so long has lost its station: a node has room for few of them."""


@dataclass
class _LinkSessions:
    """One link: at most one session and one half-open Open."""

    session: NodeSession | None = None
    half_open: NodeSession | None = None
    half_open_at: float = 0.0


class OpenedFrame(NamedTuple):
    """A good Sealed frame: its session, counter and inner frame. ``room`` is False if a new session found none."""

    session: NodeSession
    counter: int
    inner: bytes
    room: bool = True


class Sessions:
    """Sessions by link. ``claims`` returns True if a session has a claim, ``ended`` is called for each that is over.

    ``room`` is how many sessions, and how many half-open Opens, there may be over all links, at least two.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        random: Callable[[int], bytes],
        one_time: OneTime,
        *,
        room: int,
        claims: Callable[[NodeSession], bool],
        ended: Callable[[NodeSession], None],
    ) -> None:
        self._clock, self._one_time, self._room, self._claims, self._ended = clock, one_time, room, claims, ended
        # c of Open is random at the start, so that no mac from before a restart is accepted.
        self._opens = int.from_bytes(random(COUNTER_OCTETS), "big")
        self._links: dict[str, _LinkSessions] = {}

    def open(self, payload: bytes, link: str, flash: Flash) -> bytes:
        """Open: c for an empty payload, else the checks in their order and a new half-open Open on this link."""
        counter = self._opens.to_bytes(COUNTER_OCTETS, "big")
        if not payload:
            return counter
        if len(payload) != OPEN_OCTETS:
            raise CommandRefusedError(Reason.BAD_FORM)
        key, station = flash.key, payload[KEY_ID_OCTETS:-TAG_OCTETS]
        if key is None or not hmac.compare_digest(payload[:KEY_ID_OCTETS], key_id(key)):
            raise CommandRefusedError(Reason.UNKNOWN_KEY)
        # Check the mac before the point: a station without the key causes no point arithmetic, and each Open works only
        # once.
        if not hmac.compare_digest(payload[-TAG_OCTETS:], open_mac(key, flash.uuid, counter, station)):
            raise CommandRefusedError(Reason.BAD_TAG)
        self._opens = (self._opens + 1) % (1 << 8 * COUNTER_OCTETS)
        if not good_one_time(station, flash.node_key, *([flash.station] if flash.station is not None else [])):
            raise CommandRefusedError(Reason.BAD_POINT)
        made = NodeSession(key, flash.uuid, station, self._one_time())
        held = self._links.setdefault(link, _LinkSessions())
        held.half_open, held.half_open_at = made, self._clock()
        half_open = [link for link in self._links.values() if link.half_open is not None]
        if len(half_open) > self._room:
            min(half_open, key=lambda link: link.half_open_at).half_open = None
        return made.reply

    def any_on(self, link: str) -> bool:
        """Return True if a session or half-open Open of this link lives; drops those whose time is over."""
        held = self._links.get(link)
        if held is None:
            return False
        self._drop_old(held)
        return held.session is not None or held.half_open is not None

    def on(self, link: str) -> NodeSession | None:
        """Return the session of a link."""
        held = self._links.get(link)
        return held.session if held is not None else None

    def open_frame(self, payload: bytes, link: str) -> OpenedFrame:
        """Open a Sealed frame under the session, else under the half-open Open.

        Raises CommandRefusedError and changes nothing then.

        A link must have a session or half-open Open (:meth:`any_on`).
        """
        if len(payload) < SEALED_HEAD_OCTETS + BLOCK_OCTETS:
            raise CommandRefusedError(Reason.BAD_FORM)
        held = self._links[link]
        for session in (held.session, held.half_open):
            inner = session.unseal(payload) if session is not None else None
            if session is not None and inner is not None:
                break
        else:
            raise CommandRefusedError(Reason.BAD_TAG)
        counter = int.from_bytes(payload[:4], "big")
        if counter <= session.counter:
            raise CommandRefusedError(Reason.REPLAY)
        if session is held.half_open:
            held.half_open = None
            if not self._make_room(held):
                return OpenedFrame(session, counter, inner, room=False)
            self._end(held)
            held.session = session
        session.counter, session.good_at = counter, self._clock()
        return OpenedFrame(session, counter, inner)

    def end(self, link: str, session: NodeSession) -> None:
        """End this session, if it still is the one of its link."""
        held = self._links.get(link)
        if held is not None and held.session is session:
            self._end(held)

    def lose(self, link: str) -> None:
        """End the session of a link whose field or connection is lost."""
        held = self._links.pop(link, None)
        if held is not None:
            self._end(held)

    def end_all(self) -> None:
        """End every session and half-open Open on every link."""
        links, self._links = self._links, {}
        for held in links.values():
            self._end(held)

    # -- internals -------------------------------------------------------------------------------------------------

    def _end(self, held: _LinkSessions) -> None:
        session, held.session = held.session, None
        if session is not None:
            self._ended(session)

    def _drop_old(self, held: _LinkSessions) -> None:
        now = self._clock()
        if held.session is not None and now - held.session.good_at >= IDLE_SECONDS:
            self._end(held)
        if held.half_open is not None and now - held.half_open_at >= HALF_OPEN_SECONDS:
            held.half_open = None

    def _make_room(self, held: _LinkSessions) -> bool:
        """Make room for one more session: if there is none, the longest silent one without a claim ends."""
        others = [link for link in self._links.values() if link is not held]
        for other in others:
            self._drop_old(other)
        living = [(other, other.session) for other in others if other.session is not None]
        if len(living) < self._room:
            return True
        idle = [(session.good_at, number) for number, (_, session) in enumerate(living) if not self._claims(session)]
        if not idle:
            return False
        self._end(living[min(idle)[1]][0])
        return True
