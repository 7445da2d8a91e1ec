"""The node's half of TNEP: initial message, service selection, answers (profile.md, "NFC").

The frames' thread only empties the mailbox and hands the message over; a worker thread runs the command, however slow,
and puts the answer, unless the reader wrote again or the field went in between.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from teds_provision.errors import GarbledError
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.hints import MIME, OUT_OF_BAND
from teds_provision.links.nfc.message import WELL_KNOWN, NdefRecord
from teds_provision.links.nfc.pieces import Piece, Responder, room
from teds_provision.links.nfc.poller import STATUS_OCTETS
from teds_provision.node.handler import NodeHandler
from teds_provision.protocol.operation.commands import PowerFlag, PowerReply
from teds_provision.protocol.repetition import Repetition

# Records that a node's initial NFC message adds to the profile's: charge, and its out-of-band address.
#
# Records of NFC Forum WLC 2.0 as open sources decode them (operation.md section 7 has the layouts, which agree with
# tags on the market): ``WLCCAP`` comes first, then ``WLCSTAI``, both in static mode, so that TNEP keeps the mailbox.
# All of it is a hint.

CAPABILITY, STATUS, POLLER = b"WLCCAP", b"WLCSTAI", b"WLCINF"
_VERSION: Final = 0x20
_STATIC, _BATTERY_FULL = 0x00, 0x80
_REPEAT_WAITS: Final = bytes((0x09, 0x1E, 0x03, 0x0A))
"""Wait between two readings 2^12 ms, NDEF read wait 300 ms, write time-out 2^8 ms, write wait 10 ms."""
_BATTERY_LEVEL: Final = 0x01


def charge_records(power: PowerReply) -> tuple[NdefRecord, ...]:
    """Return ``WLCCAP`` (can be charged, or is full) and ``WLCSTAI`` (battery in per cent), none without a battery."""
    if not power.flags & PowerFlag.BATTERY or power.level is None:
        return ()
    mode = _BATTERY_FULL if power.flags & PowerFlag.FULL else _STATIC
    return (
        NdefRecord(WELL_KNOWN, CAPABILITY, bytes((_VERSION, mode | 0x01)) + _REPEAT_WAITS),
        NdefRecord(WELL_KNOWN, STATUS, bytes((_BATTERY_LEVEL, power.level))),
    )


def out_of_band_record(address: bytes, *, random: bool) -> NdefRecord:
    """Return the Bluetooth LE out-of-band record; ``address`` has 6 octets as people write them; peripheral only."""
    structures = b"\x08\x1b" + address[::-1] + bytes((random,)) + b"\x02\x1c\x00"
    return NdefRecord(MIME, OUT_OF_BAND, structures)


def is_poller_information(record: NdefRecord) -> bool:
    """Return True if a reader reports how it charges.

    It may write that at any time, into the mailbox that TNEP uses.
    """
    return record.is_well_known(POLLER)


Records = Callable[[], tuple[NdefRecord, ...]]


def _none() -> tuple[NdefRecord, ...]:
    return ()


@dataclass(frozen=True)
class ExtraRecords:
    """Records of the initial message ``before`` ``Tp`` and ``after`` the id, evaluated each time.

    ``field`` is called when a reader's field comes (True) and goes.
    """

    before: Records = _none
    after: Records = _none
    field: Callable[[bool], None] = lambda present: None


NO_EXTRAS: Final = ExtraRecords()


LINE = "nfc"


class Memory(Protocol):
    """Storage of the NDEF message: a Type 4 file or a Type 2 SRAM."""

    max_ndef: int
    written: Callable[[bytes], None]

    def put(self, octets: bytes) -> None:
        """Replace the message."""


class TnepTag:
    """Serves one node's requests through the NDEF message of an emulated tag.

    ``extras`` are further records of the initial message.
    """

    def __init__(
        self,
        memory: Memory,
        handler: NodeHandler,
        *,
        wt_int: int,
        n_wait: int,
        extras: ExtraRecords = NO_EXTRAS,
    ) -> None:
        self._memory = memory
        self._handler = handler
        self._service = tnep.ServiceParameters(tnep.SERVICE, wt_int, n_wait, memory.max_ndef).record()
        self._repetition = Repetition()
        self._extras = extras
        self._responder = Responder(self._run)
        self._lock = threading.Lock()
        self._serial = 0  # number of the activation or message to which the mailbox belongs
        self._selected = False
        self._fresh = threading.Event()
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._work, name="nfc-node", daemon=True)
        self._initial = b""
        self._shown: bytes | None = None  # the initial message in the mailbox; None if it holds another one
        memory.written = self._written

    def start(self) -> None:
        """Put the initial message and start the worker."""
        self._initial = self._initial_message()
        self._show(self._initial)
        self._worker.start()

    def stop(self) -> None:
        """End the worker after what it is doing."""
        self._jobs.put(None)
        self._worker.join()

    def activated(self) -> None:
        """Show the initial message again, renewed as soon as possible: a reader selected the tag."""
        with self._lock:
            self._serial += 1
            self._selected = False
            self._show(self._initial)
            self._fresh.clear()
            self._jobs.put(self._renew)

    def lost(self) -> None:
        """Drop sessions, half requests and stored replies: the field is gone."""
        with self._lock:
            self._serial += 1
            self._selected = False
            self._jobs.put(self._forget)

    def idle(self) -> None:
        """Renew the initial message if Identify has changed; called while nothing happens on air."""
        if self._jobs.empty():
            self._jobs.put(self._renew)

    def ready(self, seconds: float) -> bool:
        """Wait until the initial message is as new as the activation; False after ``seconds``."""
        return self._fresh.wait(seconds)

    def _written(self, octets: bytes) -> None:
        """Handle a completed message of a reader.

        Empties the mailbox at once ("need more time") and lets the worker answer.
        """
        with self._lock:
            self._serial += 1
            serial = self._serial
            self._shown = None
            self._memory.put(b"")
        self._jobs.put(lambda: self._serve(serial, octets))

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()

    def _serve(self, serial: int, octets: bytes) -> None:
        if serial != self._serial:
            return
        answer = self._answer(serial, octets)
        initial = self._initial_message()
        with self._lock:
            self._initial = initial
            if serial == self._serial and answer is None:
                self._show(initial)
            elif serial == self._serial and answer is not None:
                self._memory.put(answer)

    def _answer(self, serial: int, octets: bytes) -> bytes | None:
        """Return the message that answers ``octets``, None for the initial message."""
        try:
            records = message.decode(octets)
            uri = tnep.selection(records)
            if uri is not None:
                with self._lock:
                    self._selected = uri == tnep.SERVICE and serial == self._serial
                return message.encode([tnep.status(tnep.SUCCESS)]) if uri == tnep.SERVICE else None
            if not self._selected and records and is_poller_information(records[0]):
                return None
            payload = tnep.external(records, tnep.TIM_TYPE)
            if payload is None or not self._selected:
                return message.encode([tnep.status(tnep.PROTOCOL_ERROR)])
            piece = self._responder.answer(Piece.decode(payload), room(self._memory.max_ndef, STATUS_OCTETS))
        except GarbledError:
            return message.encode([tnep.status(tnep.GARBLED_REQUEST)])
        return message.encode([tnep.status(tnep.SUCCESS), tnep.payload_record(piece.encode())])

    def _run(self, transaction: int, frame: bytes) -> bytes:
        reply = self._repetition.answer(
            transaction, frame, lambda whole: self._handler.request(LINE, whole, tapped=True), now=time.monotonic()
        )
        self._repetition.reply_sent(time.monotonic())
        return reply

    def _renew(self) -> None:
        initial = self._initial_message()
        with self._lock:
            self._initial = initial
            if self._shown is not None and self._shown != initial:
                self._show(initial)
            self._fresh.set()

    def _show(self, initial: bytes) -> None:
        self._shown = initial
        self._memory.put(initial)

    def _forget(self) -> None:
        self._responder.forget()
        self._repetition.forget()
        self._handler.lost(LINE)

    def _initial_message(self) -> bytes:
        own = (self._service, tnep.id_record(self._handler.identify()))
        return message.encode([*self._extras.before(), *own, *self._extras.after()])
