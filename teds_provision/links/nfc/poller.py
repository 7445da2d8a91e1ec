"""The station's half of TNEP: write a message, wait, read until the node has put its answer (profile.md, "NFC").

Works on anything that reads and writes an NDEF message (:class:`Mailbox`), so that it runs in memory as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from teds_provision.errors import GarbledError, NodeSilentError
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.message import NdefRecord
from teds_provision.links.nfc.pieces import Piece, Requester, room

PATIENCE = 5.0  # seconds for which a station keeps reading
LONGEST_INTERVAL = 0.032  # seconds between two reads after N_wait, doubling up to this
LONGEST = 120.0  # most seconds for one transaction, even if the node keeps asking for time
_REREADS = 3  # of a torn message
STATUS_OCTETS = len(message.encode([tnep.status(0)]))


class Mailbox(Protocol):
    """An NDEF message on a tag.

    Both methods raise NodeSilentError when the tag is gone, GarbledError when it is unreadable.
    """

    def read(self) -> bytes:
        """Return the message as it is now, empty when the tag has none."""

    def write(self, octets: bytes) -> None:
        """Replace the message."""


class Poller:
    """One activation of a node: selects the service when it is first needed and carries transactions."""

    def __init__(
        self,
        mailbox: Mailbox,
        service: tnep.ServiceParameters,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._mailbox = mailbox
        self._service = service
        self._clock = clock
        self._sleep = sleep
        self._selected = False

    def transact(self, transaction: int, frame: bytes) -> bytes:
        """Send one command frame and return its reply frame.

        Raises NodeSilentError when no answer came in time, GarbledError when the node's messages stay unreadable or do
        not fit.
        """
        octets = room(self._service.max_ndef)
        if room(self._service.max_ndef, STATUS_OCTETS) < 1:
            raise GarbledError(
                f"The node takes NDEF messages of at most {self._service.max_ndef} octets, too short for the profile."
            )
        if not self._selected:
            self._exchange(message.encode([tnep.select(tnep.SERVICE)]), lambda records: True)
            self._selected = True
        requester = Requester(transaction, frame, octets)
        steps, end = 0, self._clock() + LONGEST
        while (reply := requester.reply) is None:
            if steps > requester.steps_allowed:
                raise GarbledError("The node keeps asking for the same pieces.")
            if self._clock() > end:
                raise NodeSilentError(f"The node did not finish its reply within {LONGEST:.0f} s.")
            steps += 1
            request = message.encode([tnep.payload_record(requester.next().encode())])
            self._exchange(request, lambda records: _handle_records(records, requester))
        return reply

    def deselect(self) -> None:
        """Leave the service; the node puts its initial message back and gives no answer."""
        if self._selected:
            self._selected = False
            self._mailbox.write(message.encode([tnep.select(b"")]))

    def restart(self) -> None:
        """Select the service again before the next transaction."""
        self._selected = False

    def _exchange(self, octets: bytes, take: Callable[[Sequence[NdefRecord]], bool]) -> None:
        """Write ``octets`` and read until ``take`` accepts an answer; our own message still there is "not yet"."""
        if len(octets) > self._service.max_ndef:
            raise GarbledError(f"The node takes NDEF messages of at most {self._service.max_ndef} octets.")
        self._mailbox.write(octets)
        interval = t_wait = self._service.t_wait
        patience = max(PATIENCE, min((self._service.n_wait + 1) * t_wait, 3 * PATIENCE))
        until, torn, reads = self._clock() + patience, 0, 0
        self._sleep(min(t_wait, patience))
        while True:
            reads += 1
            try:
                answer = self._mailbox.read()
                if answer and answer != octets and take(_successful(message.decode(answer))):
                    return
            except GarbledError:
                torn += 1
                if torn > _REREADS:
                    raise
            left = until - self._clock()
            if left <= 0:
                raise NodeSilentError(
                    f"The node did not answer within {patience:.0f} s.", hint="Leave it on the reader and try again."
                )
            if reads > self._service.n_wait:
                interval = max(t_wait, min(2 * interval, LONGEST_INTERVAL))
            self._sleep(min(interval, left))


def _handle_records(records: Sequence[NdefRecord], requester: Requester) -> bool:
    payload = tnep.external(records, tnep.TIM_TYPE)
    if payload is None:
        raise GarbledError("The node answered without a payload record.")
    return requester.handle_piece(Piece.decode(payload))


def _successful(records: Sequence[NdefRecord]) -> Sequence[NdefRecord]:
    code = tnep.status_of(records)
    if code is None:
        raise GarbledError("The node answered without a TNEP status.")
    if code != tnep.SUCCESS:
        raise GarbledError(f"The node answered with TNEP status 0x{code:02X}.")
    return records
