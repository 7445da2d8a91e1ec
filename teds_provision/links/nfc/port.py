"""NFC as a port: waits for taps on a reader and carries command frames to the tapped node (profile.md, "NFC").

nfcpy's ``connect`` is not used: it swallows OSError and Ctrl-C. One thread senses, activates and exchanges.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeGuard

from teds_provision.errors import BadDataError, GarbledError, LinkError, NodeSilentError, NoNodeError, NoReaderError
from teds_provision.links.hints import BleAddress, Charging
from teds_provision.links.nfc import hints, message, tnep
from teds_provision.links.nfc.message import NdefRecord
from teds_provision.links.nfc.pcsc import PcscReader
from teds_provision.links.nfc.poller import Poller
from teds_provision.links.nfc.reader import AUTO, Reader, open_reader
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError, ReaderTag
from teds_provision.links.ports import NFC, Capabilities, Contact, Notice, NoticeSink, Trace
from teds_provision.protocol.messages.identity import Identity

# A tag on the reader: a node with the profile's service, or another tag that deserves a notice.


@dataclass(frozen=True)
class NodeInField:
    """A node in the field: its tag as activated, its service, and its unauthenticated identity."""

    tag: ReaderTag
    service: tnep.ServiceParameters
    identity: Identity
    charging: Charging | None = None
    ble: BleAddress | None = None


@dataclass(frozen=True)
class ForeignTag:
    """A tag without the profile's service; ``text`` describes it."""

    tag: ReaderTag
    text: str


def look(tag: ReaderTag) -> NodeInField | ForeignTag:
    """Read the initial message and classify the tag; raises FieldLostError and ReaderLostError."""
    try:
        records = message.decode(tag.read())
    except GarbledError as error:
        return ForeignTag(tag, _described(tag, error.message))
    service = tnep.our_service(records)
    if service is None:
        return ForeignTag(tag, _described(tag, f"It holds {_listed(records)}."))
    payload = tnep.external(records, tnep.ID_TYPE)
    if payload is None:
        return ForeignTag(tag, _described(tag, "It offers the service but gives no UUID (no id record)."))
    try:
        identity = Identity.decode(payload)
    except BadDataError as error:
        return ForeignTag(tag, _described(tag, error.message))
    return NodeInField(tag, service, identity, hints.charging(records), hints.ble_address(records))


def _described(tag: ReaderTag, what: str) -> str:
    return f"This tag is not a node of this profile: {tag.kind}, UID {tag.uid.hex().upper()}. {what}"


def _listed(records: Sequence[NdefRecord]) -> str:
    names = [f"{record.name or 'a record'} ({len(record.payload)} octets)" for record in records]
    return "the NDEF records " + ", ".join(names) if names else "an empty NDEF message"


REPEATS = 2  # of one transaction
REPEAT_WITHIN = 15.0  # seconds
RETURN_WITHIN = 3.0  # seconds within which a node that lost contact may return during a transaction
_PAUSE, _SHORT_PAUSE = 0.1, 0.03  # seconds between two polls of the field; the short one while boards are changed
_CHANGING = 2.0  # seconds after a node left in which the next one is expected
_REOPEN = 1.0  # seconds between two tries to open a lost reader
_DEBOUNCE = 0.7  # seconds: a node that returns within them does not count as gone
_LOOK_AGAIN = 1.0  # seconds until an unwanted tag is read again


def open_port(where: str, trace: Trace | None = None) -> NfcPort:
    """Open the reader that ``where`` names, as ``--nfc`` does; empty or ``auto``: the only one.

    Raises NoReaderError, UsageError.
    """
    return NfcPort(where or AUTO, trace)


class NfcPort:
    """A reader, on which nodes are found by tapping them. One tap at a time: calls from several threads take turns.

    ``path`` is ``udp:localhost:PORT``, a path of nfcpy, or ``auto``. Raises NoReaderError when the reader cannot be
    opened, UsageError if ``auto`` finds several.
    """

    def __init__(self, path: str, trace: Trace | None = None) -> None:
        self.trace = trace
        self._reader: Reader | PcscReader | None = open_reader(path, trace)
        self._again = self._reader.again
        self._named = f" ({self._reader.name} at {self._again})" if path == AUTO else ""
        self.place = f"nfc:{self._again}"
        self._transaction = secrets.randbelow(0x10000)
        self._lost = False
        self._failures = 0  # failures of the reader since it last polled the field
        self.turn = threading.RLock()

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of a reader."""
        return NFC

    @property
    def via(self) -> str:
        """``nfc``."""
        return "nfc"

    def find(
        self, wanted: Callable[[Identity], bool], *, seconds: float, notice: NoticeSink, address: int | None = None
    ) -> Contact:
        """Wait for the tap of a node for which ``wanted`` is true.

        Other tags and unwanted nodes are reported once through ``notice``, and then ignored.
        Raises NoNodeError after ``seconds``, NoReaderError when the reader is gone by then. ``address`` is of no use
        here.
        """
        until, reported, never = time.monotonic() + seconds, "", threading.Event()
        waiting = False
        seen: NodeInField | ForeignTag | None = None
        while (left := until - time.monotonic()) > 0:
            seen = self._look(notice, never)
            if isinstance(seen, NodeInField) and wanted(seen.identity):
                return self._contact(seen, notice)
            if seen is not None:
                reported = _report_tag(seen, reported, notice)
                self._stay(seen, never, _LOOK_AGAIN)
                continue
            if not waiting:
                waiting = True
                notice(Notice("waiting", f"Place the node on the reader{self._named}.", left))
            time.sleep(_PAUSE)
        if self._reader is None:
            raise NoReaderError("The reader was unplugged.", hint="Plug it in again.")
        if isinstance(seen, NodeInField):
            raise NoNodeError(
                f"Node {seen.identity.uuid.hex()} is on the reader, but another node was requested.",
                hint="Place the requested node on the reader, or name the one that is on it.",
            )
        raise NoNodeError(
            f"No node was placed on the reader within {seconds:.0f} s.",
            hint="Place the node's NFC antenna flat on the reader, or allow more time with --timeout.",
        )

    def find_all(self, *, seconds: float, notice: NoticeSink, listen: float = 0.0) -> list[Contact]:
        """Return the tapped node: a reader sees one at a time; see ``Port.find_all``."""
        return [self.find(lambda _: True, seconds=seconds, notice=notice)]

    def watch(self, *, stop: threading.Event, notice: NoticeSink) -> Iterator[Contact]:
        """Yield each node that is held to the reader, once per visit, until ``stop`` is set (within 0.3 s).

        A reader that is unplugged is opened again when it is back. A node counts as gone when it did not answer for
        0.7 s.
        """
        here: bytes | None = None  # the node whose visit has not ended
        link: NfcLink | None = None
        gone_at, reported = -_CHANGING, ""
        waiting = Notice("waiting", f"Place a node on the reader{self._named}.")
        notice(waiting)
        while not stop.is_set():
            seen = self._look(notice, stop)
            same = isinstance(seen, NodeInField) and seen.identity.uuid == here
            if not same and _has_left(here, seen, gone_at):
                notice(_left(here))
                notice(waiting)
                here = None
            if seen is None:
                # A short pause while boards are being changed, so that the next one is seen at once.
                stop.wait(_SHORT_PAUSE if time.monotonic() - gone_at < _CHANGING else _PAUSE)
                continue
            if isinstance(seen, ForeignTag):
                reported = _report_tag(seen, reported, notice)
                self._stay(seen, stop, _LOOK_AGAIN)
                continue
            reported = ""
            if not same:
                here = seen.identity.uuid
                link = NfcLink(self, seen, notice)
                yield _contact(seen, link, self.trace)
                link.close()
                seen = link.seen
            if link is not None and link.lost:  # the next tag starts a new visit, even if it is the same node
                notice(_left(seen.identity.uuid))
                notice(waiting)
                here, link = None, None
            else:
                self._stay(seen, stop, None)
            gone_at = time.monotonic()

    def close(self) -> None:
        """Switch the field off and release the reader; never raises."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def next_transaction(self) -> int:
        """Return the next transaction number, u16; the first of a process is random."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        return self._transaction

    def back(self, uuid: bytes, seconds: float) -> NodeInField:
        """Activate the node ``uuid`` again.

        Raises NodeSilentError when it, or any node, is not there within ``seconds``.
        """
        until = time.monotonic() + seconds
        while True:
            try:
                seen = self._sense_and_look()
            except FieldLostError:
                seen = None
            if isinstance(seen, NodeInField) and seen.identity.uuid == uuid:
                return seen
            if isinstance(seen, NodeInField):
                raise NodeSilentError(
                    f"The node was removed; another one ({seen.identity.uuid.hex()}) is on the reader now.",
                    hint=f"Put node {uuid.hex()} back and run the command again.",
                )
            if time.monotonic() > until:
                raise FieldLostError
            time.sleep(_PAUSE)

    def reopen(self) -> None:
        """Open the reader again after it failed; raises NoReaderError when it is gone."""
        with self.turn:
            if self._reader is None:
                self._reader = open_reader(self._again, self.trace)

    def lose_reader(self) -> None:
        """Close a reader that failed, so that the next look opens it again."""
        self.close()

    def _contact(self, visit: NodeInField, notice: NoticeSink) -> Contact:
        return _contact(visit, NfcLink(self, visit, notice), self.trace)

    def _look(self, notice: NoticeSink, stop: threading.Event) -> NodeInField | ForeignTag | None:
        """Poll once; None if there is no tag or the reader is away (which is reported once)."""
        try:
            with self.turn:
                if self._reader is None:
                    self._reader = open_reader(self._again, self.trace)
                if self._lost:
                    self._lost = False
                    notice(Notice("reader-ready", f"The reader is back: {self._reader.name}."))
                return self._sense_and_look()
        except FieldLostError:
            return None
        except NoReaderError as error:
            self.lose_reader()
            self._failures += 1
            if self._failures == 1 and not self._lost:
                return None  # after a single error, the next look reopens the reader without a notice
            if not self._lost:
                self._lost = True
                notice(Notice("reader-lost", f"{error.message} Waiting for it."))
            stop.wait(_REOPEN)
            return None

    def _sense_and_look(self) -> NodeInField | ForeignTag | None:
        with self.turn:
            if self._reader is None:
                raise ReaderLostError("it was closed")
            tag = self._reader.sense()
            self._failures = 0
            return None if tag is None else look(tag)

    def _stay(self, seen: NodeInField | ForeignTag, stop: threading.Event, seconds: float | None) -> None:
        """Wait until the tag does not answer (one miss: the next look finds who is there), at most ``seconds``."""
        until = None if seconds is None else time.monotonic() + seconds
        while not stop.is_set() and (until is None or time.monotonic() < until):
            try:
                with self.turn:
                    if self._reader is None or not seen.tag.is_present:
                        return
            except ReaderLostError:
                return  # the next look reports it
            stop.wait(_SHORT_PAUSE)


class NfcLink:
    """The link to the node on the reader; selects the service when it is first used."""

    def __init__(self, port: NfcPort, visit: NodeInField, notice: NoticeSink) -> None:
        self._port = port
        self._notice = notice
        self._poller: Poller | None = Poller(visit.tag, visit.service)
        self.seen = visit
        self._last = 0
        self.lost = False
        """True if the node left in the middle of an exchange and did not come back in time."""

    @property
    def via(self) -> str:
        """``nfc``."""
        return "nfc"

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of a tap."""
        return NFC

    @property
    def announced(self) -> dict[str, int]:
        """Content of the node's service record; see ``AnnouncingLink``."""
        service = self.seen.service
        return {"WT_INT": service.wt_int, "N_wait": service.n_wait, "maxNdef": service.max_ndef}

    def exchange(self, frame: bytes) -> bytes:
        """Send one whole command frame and return its whole reply frame.

        A failed transaction is repeated unchanged, at most twice within 15 s; a node that left the field for a moment
        is activated again (its session is gone then, which the layer above notices by the reply), and a reader that
        failed is opened again once. Raises NodeSilentError, GarbledError or NoReaderError.
        """
        with self._port.turn:
            self._last = self._port.next_transaction()
            return self._exchange(frame, self._last)

    def resend(self, frame: bytes) -> bytes:
        """Send the last frame once more under its transaction; see ``ResendLink.resend``."""
        with self._port.turn:
            return self._exchange(frame, self._last)

    def _exchange(self, frame: bytes, transaction: int) -> bytes:
        started = time.monotonic()
        reopened = False
        attempt = 0
        while True:
            try:
                poller = self._ready_poller()  # raises if the node has left
                try:
                    return poller.transact(transaction, frame)
                except (NodeSilentError, GarbledError) as error:
                    # Go on in the same activation if the tag still answers, else in a new one.
                    if self._poller is not None and not isinstance(error, FieldLostError) and self.seen.tag.is_present:
                        self._poller.restart()
                    else:
                        self._poller = None
                    if attempt == REPEATS or time.monotonic() - started > REPEAT_WITHIN:
                        raise
                    self._notice(Notice("retry", f"{error.message} Trying again."))
            except ReaderLostError:
                self._poller = None
                self._port.lose_reader()
                if reopened or attempt == REPEATS or time.monotonic() - started > REPEAT_WITHIN:
                    raise
                reopened = True  # a single error gets no notice
                self._port.reopen()
            except NoReaderError:
                self._poller = None
                self._port.lose_reader()
                raise
            attempt += 1

    def close(self) -> None:
        """Deselect the service, unless nothing was sent; never raises."""
        try:
            with self._port.turn:
                if self._poller is not None:
                    self._poller.deselect()
        except LinkError:
            self._poller = None

    def _ready_poller(self) -> Poller:
        if self._poller is None:
            self.lost = True
            self.seen = self._port.back(self.seen.identity.uuid, RETURN_WITHIN)
            self.lost = False
            self._poller = Poller(self.seen.tag, self.seen.service)
        return self._poller


def _contact(visit: NodeInField, link: NfcLink, trace: Trace | None) -> Contact:
    return Contact(visit.identity, link, visit.tag.uid, charging=visit.charging, ble=visit.ble, trace=trace)


def _report_tag(seen: NodeInField | ForeignTag, reported: str, notice: NoticeSink) -> str:
    """Report a foreign tag, unless it was the last one reported; return the reported text."""
    if isinstance(seen, ForeignTag):
        text = seen.text
        if text != reported:
            notice(Notice("foreign-tag", text))
    else:
        text = f"Node {seen.identity.uuid.hex()} is not the one that is expected."
        if text != reported:
            notice(Notice("waiting", text))
    return text


def _has_left(here: bytes | None, seen: NodeInField | ForeignTag | None, gone_at: float) -> TypeGuard[bytes]:
    """Return True if the node ``here``, which is not ``seen``, is gone: another tag is there, or none for a while."""
    return here is not None and (seen is not None or time.monotonic() - gone_at > _DEBOUNCE)


def _left(uuid: bytes) -> Notice:
    return Notice("node-left", f"Node {uuid.hex()} was taken off the reader.", uuid=uuid)
