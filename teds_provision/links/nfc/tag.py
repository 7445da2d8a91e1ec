"""A tag in the field: activation and its NDEF message, on nfcpy, with nothing foreign getting out.

Whatever nfcpy raises becomes :class:`FieldLost` (the tag does not answer) or :class:`ReaderLost` (the reader does not).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from teds_provision.errors import Garbled, NodeSilent, NoReader
from teds_provision.links.nfc.library import Type2Tag, Type4ATag, Type4Ndef, nfc

_TRIES = 3  # of a read, before the message counts as unreadable
_PRESENCE_WAIT = 0.2  # seconds that a Type 4 tag gets to say that it is still there
_FSC = (16, 24, 32, 40, 48, 64, 96, 128, 256)  # octets by FSCI (ISO/IEC 14443-4, table 1)


class FieldLost(NodeSilent):
    """The tag left the field or does not answer its reader any more."""

    def __init__(self) -> None:
        super().__init__(
            "The node moved away from the reader.", hint="Hold it still on the reader and run the command again."
        )


class ReaderLost(NoReader):
    """The reader itself went away while it was used."""

    def __init__(self, cause: object) -> None:
        super().__init__(f"The reader does not answer any more ({cause}).", hint="Plug it in again.")


@contextmanager
def translated() -> Iterator[None]:
    """Turn what nfcpy raises into LinkFailures."""
    try:
        yield
    except (NodeSilent, NoReader, Garbled):
        raise
    except OSError as error:
        raise ReaderLost(error.strerror or error) from error
    except Exception as error:  # nfcpy: nfc.clf.Error, TagCommandError, Chipset.Error, ValueError, RuntimeError, …
        raise FieldLost from error


class _Type4Ndef(Type4Ndef):  # type: ignore[misc]
    """NDEF on Type 4: lengths that a short APDU can say, and the file selected once, not before every read."""

    _chosen: bytes | None = None
    _max_le: int
    _max_lc: int

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


class _Type4Tag(Type4ATag):  # type: ignore[misc]
    """Type 4A, its answer to select read as ISO/IEC 14443-4 clause 5.2 lays it out (nfcpy takes fixed positions)."""

    NDEF = _Type4Ndef

    def __init__(self, clf: Any, target: Any) -> None:
        super(Type4ATag, self).__init__(clf, target)
        self._nfcid = bytearray(target.sdd_res)
        fsdi = 8 if clf.max_recv_data_size >= 256 else 7
        fsci, fwi = _frame_limits(bytes(clf.exchange(bytearray((0xE0, fsdi << 4)), timeout=0.03)))
        fsc = min(_FSC[min(fsci, 8)], clf.max_send_data_size)
        self._dep = nfc.tag.tt4.IsoDepInitiator(clf, fsc, 4096 / 13.56e6 * 2 ** (fwi if fwi < 15 else 4))
        self._extended_length_support = False

    def _is_present(self) -> bool:
        try:
            self.clf.exchange(bytearray((0xB2 | self._dep.pni,)), min(self._dep.fwt, _PRESENCE_WAIT))
        except nfc.clf.CommunicationError:
            return False
        return True


class _Type2Tag(Type2Tag):  # type: ignore[misc]
    """Type 2, asked once whether it is still there (nfcpy asks three times)."""

    def _is_present(self) -> bool:
        try:
            return len(self.transceive(b"\x30\x00", retries=0)) == 16
        except nfc.tag.TagCommandError:
            return False


def _frame_limits(ats: bytes) -> tuple[int, int]:
    """Return FSCI and FWI of an answer to select; 2 and 4 where it does not say."""
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
        """Whether the tag still answers; raises ReaderLost."""
        try:
            with translated():
                return bool(self._tag.is_present)
        except FieldLost:
            return False

    def read(self) -> bytes:
        """Return the NDEF message as it is on the tag now; raises FieldLost, ReaderLost, Garbled (no NDEF message)."""
        for attempt in range(_TRIES):
            if attempt:
                time.sleep(0.02)
            octets = self._read_once()
            if octets is not None:
                return octets
            if not self.is_present:
                raise FieldLost
        raise Garbled("The tag has no readable NDEF message.")

    def write(self, octets: bytes) -> None:
        """Replace the NDEF message; raises FieldLost, ReaderLost, Garbled (read-only, or too small).

        A Type 2 tag is read afresh first: nfcpy sends only the pages that differ from what it saw last, and the node
        has put another message since.
        """
        if self._ndef is None or self.kind != "Type 4":
            self.read()
        if not self._ndef.is_writeable or len(octets) > self._ndef.capacity:
            raise Garbled(f"The tag does not take an NDEF message of {len(octets)} octets.")
        with translated():
            self._ndef.octets = octets

    def _read_once(self) -> bytes | None:
        with translated():
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
                return ReaderTag(_Type2Tag(clf, target), "Type 2" if plain else f"SAK {target.sel_res[0]:02X}h")
            tag = nfc.tag.activate(clf, target)
            return None if tag is None else ReaderTag(tag, str(tag.type).replace("Tag", "").replace("Type", "Type "))
    except FieldLost:
        return None
