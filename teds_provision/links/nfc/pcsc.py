"""A PC/SC reader (``--nfc pcsc[:READER]``) in place of one of nfcpy's: its firmware does ISO-DEP, pcscd the USB.

Tags are nfcpy's classes with the exchange put in: Type 4 gets APDUs as they are, Type 2 by the pseudo-APDUs of PC/SC
part 3 (FF B0 reads 16 octets, FF D6 writes a page). The reader is held alone (SCARD_SHARE_EXCLUSIVE). Errors of the
service are named; the library (pcsclite.py) is loaded when the first such reader is opened.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc.nfcpy import QuietExchange, Type2TagCommandError, Type4ATag, nfc
from teds_provision.links.nfc.pcsc_readers import PREFIX, contactless, context_of, names
from teds_provision.links.nfc.pcsclite import GONE, SHARING_VIOLATION, PcscError, PcscLibrary, load
from teds_provision.links.nfc.tag import FieldLostError, ReaderLostError, ReaderTag, Type2, Type4Ndef
from teds_provision.links.ports import Trace

_STORAGE_CARD: Final = bytes.fromhex("A000000306")
"""Application identifier of PC/SC in the ATR of a card without a processor (PC/SC part 3, section 3.1.3.2.3)."""
_UID: Final = bytes.fromhex("FFCA000000")
_OK: Final = b"\x90\x00"
_PRESENCE: Final = bytes.fromhex("00B0000002")


class PcscReader:
    """An opened PC/SC reader, as ``links.nfc.reader.Reader``; ``path`` is ``pcsc``, or ``pcsc:PART OF A NAME``."""

    def __init__(self, path: str, trace: Trace | None = None) -> None:
        self._trace = trace
        self._library = load()
        self.name = _chosen(path.partition(":")[2])
        self.again = f"{PREFIX}:{self.name}"
        self._context: int | None = context_of(self._library)
        self._card: _Card | None = None

    def sense(self) -> ReaderTag | None:
        """Connect to the tag on the reader, field off and on before; None if there is none. Raises ReaderLostError."""
        self._disconnect()
        assert self._context is not None, "sense() before close()"
        try:
            handle, protocol = self._library.connect(self._context, self.name)
        except PcscError as error:
            if error.code == SHARING_VIOLATION:
                raise ReaderLostError("another program holds it") from error
            if error.code in GONE:
                raise ReaderLostError(str(error)) from error
            return None
        self._card = card = _Card(self._library, handle, protocol, self._trace)
        try:
            return _tag(card)
        except FieldLostError:
            return None

    def close(self) -> None:
        """Let the card and the service go; never raises."""
        self._disconnect()
        if self._context is not None:
            with suppress(PcscError):
                self._library.release(self._context)
            self._context = None

    def _disconnect(self) -> None:
        if self._card is not None:
            with suppress(PcscError):
                self._library.disconnect(self._card.handle)
            self._card.target = None
            self._card = None


def _chosen(wanted: str) -> str:
    found = names() if wanted else contactless(names())
    fitting = [wanted] if wanted in found else [name for name in found if wanted.lower() in name.lower()]
    fitting = contactless(fitting) or fitting  # the slot beside an antenna is meant only by its own name
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(fitting or found)
    if fitting:
        raise UsageError(
            f"{len(fitting)} PC/SC readers fit: {listed}.", hint="Name one: --nfc 'pcsc:PART OF ITS NAME'."
        )
    raise NoReaderError(
        f"No PC/SC reader {wanted!r} is there; there are: {listed}." if found else "No PC/SC reader is plugged in.",
        hint="Plug it in; pcsc_scan (package pcsc-tools) lists the readers of pcscd.",
    )


@dataclass
class _Target:
    """The activation facts that nfcpy's tags need."""

    uid: bytes

    @property
    def sdd_res(self) -> bytes:
        """The UID."""
        return self.uid


class _Card:
    """A connected card; replaces the front end of nfcpy's tags."""

    def __init__(self, library: PcscLibrary, handle: int, protocol: int, trace: Trace | None) -> None:
        self._library, self._trace = library, trace
        self.handle, self._protocol = handle, protocol
        self.target: _Target | None = None

    @property
    def atr(self) -> bytes:
        """Answer to reset, which the reader makes up for a card without contacts."""
        try:
            return self._library.atr(self.handle)
        except PcscError as error:
            raise FieldLostError from error

    def transmit(self, apdu: bytes) -> bytes:
        """Exchange one APDU, status word last; raises FieldLostError, ReaderLostError."""
        if self._trace is not None:
            self._trace.frame("pcsc", "out", apdu)
        try:
            answer = self._library.transmit(self.handle, self._protocol, apdu)
        except PcscError as error:
            raise (ReaderLostError(str(error)) if error.code in GONE else FieldLostError) from error
        if len(answer) < 2:
            raise FieldLostError
        if self._trace is not None:
            self._trace.frame("pcsc", "in", answer)
        return answer


def _tag(card: _Card) -> ReaderTag:
    storage = _STORAGE_CARD in card.atr
    answer = card.transmit(_UID)
    card.target = _Target(answer[:-2] if answer[-2:] == _OK else b"")
    if storage:
        return ReaderTag(_PcscType2(card, card.target), "Type 2")
    return ReaderTag(_PcscType4(card, card.target), "Type 4")


class _ApduExchange:
    """Replaces nfcpy's ISO-DEP."""

    def __init__(self, card: _Card) -> None:
        self._card = card

    def exchange(self, command: bytes | None, timeout: float | None = None) -> bytearray:
        """Exchange one APDU; the time-out is the reader's. None asks whether the card is still there."""
        del timeout
        return bytearray(self._card.transmit(_PRESENCE if command is None else bytes(command)))


class _PcscType4(QuietExchange, Type4ATag):  # type: ignore[misc]
    """Type 4 behind a PC/SC reader."""

    NDEF = Type4Ndef

    def __init__(self, card: _Card, target: _Target) -> None:
        super(Type4ATag, self).__init__(card, target)
        self._nfcid = bytearray(target.uid)
        self._dep = _ApduExchange(card)
        self._extended_length_support = False

    def _is_present(self) -> bool:
        self._dep.exchange(None)  # raises FieldLostError if the tag has left
        return True


class _PcscType2(Type2):
    """Type 2 behind a PC/SC reader: READ and WRITE as pseudo-APDUs; no second sector."""

    def transceive(self, data: bytes, timeout: float = 0.1, retries: int = 2) -> bytearray:
        """Send one command of the tag and return its answer."""
        del timeout, retries
        card: _Card = self.clf
        if data[0] == 0x30:
            answer = card.transmit(bytes((0xFF, 0xB0, 0, data[1], 16)))
            if answer[-2:] == _OK and len(answer) == 18:
                return bytearray(answer[:16])
        elif data[0] == 0xA2:
            answer = card.transmit(bytes((0xFF, 0xD6, 0, data[1], 4)) + bytes(data[2:6]))
            if answer[-2:] == _OK:
                return bytearray(b"\x0a")
        else:
            return bytearray(b"\x00")
        raise Type2TagCommandError(nfc.tag.RECEIVE_ERROR)
