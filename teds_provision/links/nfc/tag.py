"""A tag in the field: activation and its NDEF message, on nfcpy, whose exceptions are translated.

Exceptions of nfcpy become :class:`FieldLostError` (the tag does not answer) or :class:`ReaderLostError` (the reader
does not).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from teds_provision.errors import GarbledError, NodeSilentError, NoReaderError
from teds_provision.links.nfc.nfcpy import (
    NfcpyType2Ndef,
    NfcpyType4Ndef,
    QuietExchange,
    Type2Tag,
    Type2TagCommandError,
    Type4ATag,
    Type4TagCommandError,
    nfc,
)

_TRIES = 3  # reads before the message counts as unreadable
_PRESENCE_WAIT = 0.06  # seconds for a Type 4 tag to answer a presence check
_ANSWER = 78  # octets of an NDEF message with the shortest sealed answer (profile: wire, "NFC")
_APDU_SECONDS = 5.0  # for one command of the tag and its answer: as long as for a reply
_FSC = (16, 24, 32, 40, 48, 64, 96, 128, 256)  # octets by FSCI (ISO/IEC 14443-4, table 1)


class FieldLostError(NodeSilentError):
    """The tag left the field or does not answer its reader any more."""

    def __init__(self) -> None:
        super().__init__(
            "The node was removed from the reader.", hint="Hold it still on the reader and run the command again."
        )


class ReaderLostError(NoReaderError):
    """The reader itself went away while it was used."""

    def __init__(self, cause: object) -> None:
        super().__init__(f"The reader no longer answers ({cause}).", hint="Plug it in again.")


@contextmanager
def translated() -> Iterator[None]:
    """Turn what nfcpy raises into LinkFailures."""
    try:
        yield
    except (NodeSilentError, NoReaderError, GarbledError):
        raise
    except OSError as error:
        raise ReaderLostError(error.strerror or error) from error
    except Exception as error:  # nfcpy: nfc.clf.Error, TagCommandError, Chipset.Error, ValueError, RuntimeError, …
        raise FieldLostError from error


class Type4Ndef(NfcpyType4Ndef):  # type: ignore[misc]
    """NDEF on Type 4: lengths that fit a short APDU, and the file selected once, not before every read.

    The first read after a write fetches the length of the message and as much of it as the shortest sealed answer has:
    most answers are no longer, and come with one command instead of two.
    """

    _chosen: bytes | None = None
    _max_le: int
    _max_lc: int
    _nlen_size: int
    _capacity: int
    _ahead = 0
    _takes_more = True

    def _read_ndef_data(self) -> bytearray | None:
        ahead, self._ahead = self._ahead, 0
        if not ahead:
            octets: bytearray | None = super()._read_ndef_data()
            return octets
        try:
            return self._read_from_start(ahead)
        except Type4TagCommandError as error:
            self._takes_more = error.errno <= 0  # some tags refuse a read beyond their message
            return self._read_ndef_data()

    def _read_from_start(self, ahead: int) -> bytearray | None:
        head = self._nlen_size
        octets = bytearray(self._read_binary(0, head + ahead))
        if len(octets) < head:
            return None
        end = head + int.from_bytes(octets[:head], "big")
        while len(octets) < end:
            more = self._read_binary(len(octets), end - len(octets))
            if not more:
                return None
            octets += more
        return octets[head:end]

    def _write_ndef_data(self, data: bytearray) -> None:
        super()._write_ndef_data(data)
        self._ahead = min(_ANSWER, self._capacity) if self._takes_more else 0

    def _select_fid(self, fid: bytes) -> bool | None:
        if self._chosen == bytes(fid):
            return True
        self._chosen = None
        done: bool | None = super()._select_fid(fid)
        if done:
            self._chosen = bytes(fid)
        return done

    def _discover_ndef(self) -> bool:
        found = bool(super()._discover_ndef())
        if found:
            self._max_le = max(1, min(self._max_le, 255))
            self._max_lc = max(1, min(self._max_lc, 255))
        return found


class _BufferedFrontend:
    """The front end for one command at a time: whatever the tag asks for, its answer is there by ``until``."""

    def __init__(self, clf: Any) -> None:
        self._clf = clf
        self.until = 0.0  # time.monotonic()

    def exchange(self, octets: bytes, timeout: float) -> Any:
        left = self.until - time.monotonic()
        if left <= 0:
            raise Type4TagCommandError(nfc.tag.TIMEOUT_ERROR)
        return self._clf.exchange(octets, min(timeout, left))


class IsoDep(nfc.tag.tt4.IsoDepInitiator):  # type: ignore[misc]
    """ISO-DEP, the reader's side, with an end: nfcpy follows endless S(WTX), R(ACK) or chaining."""

    def __init__(self, clf: Any, fsc: int, fwt: float) -> None:
        self._air = _BufferedFrontend(clf)
        super().__init__(self._air, fsc, fwt)

    def exchange(self, command: bytes | None, timeout: float | None = None) -> Any:
        """Exchange one command; raises Type4TagCommandError after 5 s, and if a block of the answer is cut short."""
        self._air.until = time.monotonic() + _APDU_SECONDS
        try:
            return super().exchange(command, timeout)
        except IndexError as error:  # S(WTX) without its octet
            raise Type4TagCommandError(nfc.tag.PROTOCOL_ERROR) from error


class _Type4Tag(QuietExchange, Type4ATag):  # type: ignore[misc]
    """Type 4A, its answer to select read as ISO/IEC 14443-4 clause 5.2 lays it out (nfcpy takes fixed positions)."""

    NDEF = Type4Ndef

    def __init__(self, clf: Any, target: Any) -> None:
        super(Type4ATag, self).__init__(clf, target)
        self._nfcid = bytearray(target.sdd_res)
        fsdi = 8 if clf.max_recv_data_size >= 256 else 7
        fsci, fwi = _frame_limits(bytes(clf.exchange(bytearray((0xE0, fsdi << 4)), timeout=0.03)))
        fsc = min(_FSC[min(fsci, 8)], clf.max_send_data_size)
        self._dep = IsoDep(clf, fsc, 4096 / 13.56e6 * 2 ** (fwi if fwi < 15 else 4))
        self._extended_length_support = False

    def _is_present(self) -> bool:
        try:
            self.clf.exchange(bytearray((0xB2 | self._dep.pni,)), min(self._dep.fwt, _PRESENCE_WAIT))
        except nfc.clf.CommunicationError:
            return False
        return True


class _Type2Ndef(NfcpyType2Ndef):  # type: ignore[misc]
    """NDEF on Type 2: once nfcpy has located the message, one READ shows whether there is one.

    nfcpy reads the capability container and every TLV again each time, and before each write. If lock or reserved
    octets are within the message, or beyond the first sector, its own way is kept.
    """

    _simple = False
    _ndef_tlv_offset: int
    _capacity: int

    def _read_ndef_data(self) -> bytearray | None:
        if not self._simple:
            octets: bytearray | None = super()._read_ndef_data()
            begin = self._ndef_tlv_offset
            end = begin + 4 + self._capacity
            whole = octets is not None and not any(begin <= octet < end for octet in self._skip_bytes)
            self._simple = whole and begin % 4 <= 2 and end <= 1024
            return octets
        try:
            return self._read_from(self._ndef_tlv_offset)
        except Type2TagCommandError:
            return None

    def _read_from(self, offset: int) -> bytearray | None:
        page = offset // 4
        octets = bytearray(self._tag.read(page))[offset % 4 :]
        if octets[0] != 0x03:
            self._simple = False
            return self._read_ndef_data()
        if octets[1] == 0:
            return bytearray()
        size, begin = (int.from_bytes(octets[2:4], "big"), 4) if octets[1] == 255 else (octets[1], 2)
        while len(octets) < begin + size:
            page += 4
            octets += self._tag.read(page)
        return octets[begin : begin + size]

    def _write_ndef_data(self, data: bytearray) -> None:
        if not self._simple:
            super()._write_ndef_data(data)
            return
        offset = self._ndef_tlv_offset
        page, before = offset // 4, offset % 4
        head = bytes((3, len(data))) if len(data) < 255 else b"\x03\xff" + len(data).to_bytes(2, "big")
        kept = bytes(self._tag.read(page)[:before]) if before else b""
        octets = kept + head + bytes(data) + (b"\xfe" if len(data) < self._capacity else b"")
        pages = [octets[at : at + 4].ljust(4, b"\0") for at in range(0, len(octets), 4)]
        self._tag.write(page, pages[0][: before + 1] + b"\0" + pages[0][before + 2 :])
        for number, four in enumerate(pages[1:], 1):
            self._tag.write(page + number, four)
        self._tag.write(page, pages[0])


class Type2(Type2Tag):  # type: ignore[misc]
    """Type 2, asked once whether it is still there (nfcpy asks three times)."""

    NDEF = _Type2Ndef

    def _is_present(self) -> bool:
        try:
            return len(self.transceive(b"\x30\x00", retries=0)) == 16
        except nfc.tag.TagCommandError:
            return False


def _frame_limits(ats: bytes) -> tuple[int, int]:
    """Return FSCI and FWI of an answer to select; 2 and 4 if they are absent."""
    fsci, fwi = 2, 4
    if len(ats) > 1 and ats[0] > 1:
        fsci, at = ats[1] & 0x0F, 2
        if ats[1] & 0x10:
            at += 1
        if ats[1] & 0x20 and len(ats) > at:
            fwi = ats[at] >> 4
    return fsci, fwi


class ReaderTag:
    """One activation of one tag; an NDEF mailbox (links.nfc.poller.Mailbox)."""

    def __init__(self, tag: Any, kind: str) -> None:
        self._tag = tag
        self._ndef: Any = None
        self.kind = kind
        self.uid = bytes(tag.identifier)

    @property
    def is_present(self) -> bool:
        """True if the tag still answers, in this activation; raises ReaderLostError."""
        try:
            with self._talking():
                return bool(self._tag.is_present)
        except FieldLostError:
            return False

    def read(self) -> bytes:
        """Return the NDEF message as it is on the tag now.

        Raises FieldLostError, ReaderLostError, GarbledError (no NDEF message).
        """
        for attempt in range(_TRIES):
            if attempt:
                time.sleep(0.02)
            octets = self._read_once()
            if octets is not None:
                return octets
            if not self.is_present:
                raise FieldLostError
        raise GarbledError("The tag has no readable NDEF message.")

    def write(self, octets: bytes) -> None:
        """Replace the NDEF message; raises FieldLostError, ReaderLostError, GarbledError (read-only, or too small).

        A Type 2 tag whose pages nfcpy writes is read afresh first: it sends only those that differ from what it saw
        last, and the node has put another message since.
        """
        if self._ndef is None or not getattr(self._ndef, "_simple", self.kind == "Type 4"):
            self.read()
        if not self._ndef.is_writeable or len(octets) > self._ndef.capacity:
            raise GarbledError(f"The tag does not take an NDEF message of {len(octets)} octets.")
        with self._talking():
            self._ndef.octets = octets

    @contextmanager
    def _talking(self) -> Iterator[None]:
        """Use the tag: FieldLostError if the reader has looked for another since."""
        with translated():
            if self._tag.target is None or self._tag.clf.target is not self._tag.target:
                raise FieldLostError
            yield

    def _read_once(self) -> bytes | None:
        with self._talking():
            if self._ndef is None:
                self._ndef = self._tag.NDEF(self._tag)
            self._ndef.has_changed  # noqa: B018  (nfcpy: this property reads the tag)
            if self._ndef._data is None:
                self._ndef = None
                return None
            return bytes(self._ndef._data)


def activate(clf: Any, target: Any) -> ReaderTag | None:
    """Activate a target that was sensed; None when it left or is of no type that nfcpy knows.

    nfcpy's guesses at products of Type 2 are passed by: they cost time on air and are only guesses.
    """
    try:
        with translated():
            if target.brty == "106A" and target.sel_res and target.sel_res[0] & 0x20:
                return ReaderTag(_Type4Tag(clf, target), "Type 4")
            if target.brty == "106A" and target.sel_res and not target.sel_res[0] & 0x60:
                plain = target.sel_res[0] == 0
                return ReaderTag(Type2(clf, target), "Type 2" if plain else f"SAK {target.sel_res[0]:02X}h")
            tag = nfc.tag.activate(clf, target)
            return None if tag is None else ReaderTag(tag, str(tag.type).replace("Tag", "").replace("Type", "Type "))
    except FieldLostError:
        return None
