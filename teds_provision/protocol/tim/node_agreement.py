"""The node's half of the agreement: Request, Confirm, and the RAM between (profile.md, "Key agreement")."""

from __future__ import annotations

import hmac
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import PrivateKey, Verify, station_key_message, verify
from teds_provision.protocol.messages.frames import CommandRefusedError, Reason
from teds_provision.protocol.session import NodeSession, OneTime
from teds_provision.protocol.tim.permission import Origin
from teds_provision.protocol.wire_agreement import (
    LAST_EPOCH,
    NONCE_OCTETS,
    REQUEST_OCTETS,
    TAG_OCTETS,
    NodeAgreement,
    RequestPayload,
    good_one_time,
    good_point,
)

PENDING_SECONDS: Final = 60.0
"""A key that was requested and not confirmed is forgotten (profile.md, "Key agreement"): there is room for one."""


@dataclass
class _PendingAgreement:
    """State that a good Request leaves in RAM, and the link of its Confirm."""

    agreement: NodeAgreement = field(repr=False)
    link: str
    session: NodeSession | None
    at: float


class AgreementSlot:
    """One agreement at a time over all links."""

    def __init__(
        self,
        key: PrivateKey,
        clock: Callable[[], float],
        random: Callable[[int], bytes],
        one_time: OneTime,
        verify: Verify = verify,
    ) -> None:
        self._key, self._clock, self._random, self._verify = key, clock, random, verify
        self._one_time = one_time
        self._pending: _PendingAgreement | None = None

    def request(self, payload: bytes, origin: Origin, flash: Flash) -> bytes:
        """Request: length 4, points 15, P(CA) other than the kept one 14, SIG104 5; a good one replaces what pends."""
        if len(payload) != REQUEST_OCTETS:
            raise CommandRefusedError(Reason.BAD_FORM)
        request = RequestPayload.decode(payload)
        if not (good_point(request.station, flash.node_key) and good_point(request.ca, flash.node_key)):
            raise CommandRefusedError(Reason.BAD_POINT)
        if not good_one_time(request.one_time, flash.node_key, request.station):
            raise CommandRefusedError(Reason.BAD_POINT)
        if flash.ca is not None and request.ca != flash.ca:
            raise CommandRefusedError(Reason.UNTRUSTED_STATION)
        if not self._verify(request.ca, station_key_message(request.station), request.station_signature):
            raise CommandRefusedError(Reason.BAD_SIGNATURE)
        if flash.epoch == LAST_EPOCH:
            raise CommandRefusedError(Reason.WRONG_EPOCH)
        agreement = NodeAgreement.answer(
            self._key,
            flash.uuid,
            payload,
            epoch=flash.epoch + 1,
            teds=flash.security_teds(),
            nonce=self._random(NONCE_OCTETS),
            one_time=self._one_time(),
        )
        self._pending = _PendingAgreement(agreement, origin.link, origin.session, self._clock())
        return agreement.reply

    def confirm(self, payload: bytes, origin: Origin, flash: Flash) -> Flash:
        """Return the state to commit for a Confirm.

        Refusals 2 and 4 keep the pending agreement, a wrong tag (12) drops it.
        """
        pending = self._pending
        if (
            pending is None
            or self._clock() - pending.at >= PENDING_SECONDS
            or pending.link != origin.link
            or pending.session is not origin.session
        ):
            raise CommandRefusedError(Reason.WRONG_STATE)
        if len(payload) != TAG_OCTETS:
            raise CommandRefusedError(Reason.BAD_FORM)
        agreement = pending.agreement
        if not hmac.compare_digest(payload, agreement.station_tag):
            self._pending = None
            raise CommandRefusedError(Reason.BAD_TAG)
        ca = agreement.ca if flash.ca is None else flash.ca
        return replace(flash, key=agreement.key, epoch=agreement.epoch, station=agreement.station, ca=ca)

    def forget(self, link: str | None = None) -> None:
        """Drop the pending agreement of a link, or (None) of any."""
        if link is None or (self._pending is not None and self._pending.link == link):
            self._pending = None
