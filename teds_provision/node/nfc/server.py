"""A virtual transducer's NFC: an emulated tag on a simulated reader (nfcpy's udp frames, loopback only)."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from typing import Any, Literal

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc.nfcpy import nfc
from teds_provision.links.nfc.udp import NodeDevice, address_of, frontend
from teds_provision.node.handler import NodeHandler
from teds_provision.node.nfc import tags as nfc_type2
from teds_provision.node.nfc import tags as nfc_type4
from teds_provision.node.nfc.tnep import NO_EXTRAS, ExtraRecords, TnepTag

# The duration of ISO/IEC 14443-3 Type A frames on air at 106 kbit/s, to imitate the link in benchmarks.
#
# One etu is 128/13.56 MHz (9.44 µs). A standard frame has a start bit, 8 bits and parity per octet, and an end; the
# frame delay times are those of ISO/IEC 14443-3 clause 6.2 (n = 9, last bit 1), and of the answer in the other
# direction.

ETU = 128 / 13.56e6  # seconds
_TO_TAG, _TO_READER = (9 * 128 + 84) / 13.56e6, 1172 / 13.56e6  # frame delay times, seconds
_SPIN = 0.0003  # seconds: sleep is late by up to this
_SHORT, _ACK_BITS = 9, 6  # etu of a short frame (7 bits) and of a 4-bit acknowledge


def command_seconds(octets: bytes) -> float:
    """Return the seconds that a command takes from the reader to the tag, with CRC_A if the frame has one."""
    if len(octets) == 1 and octets in (b"\x26", b"\x52"):
        return _SHORT * ETU
    anticollision = len(octets) == 2 and octets[0] in (0x93, 0x95, 0x97) and octets[1] == 0x20
    return ((len(octets) + (0 if anticollision else 2)) * 9 + 3) * ETU


def answer_seconds(command: bytes, octets: bytes) -> float:
    """Return how long the answer to ``command`` takes from the tag to the reader."""
    if len(octets) == 1 and command[:1] in (b"\xa2", b"\xc2", b"\x30"):
        return _ACK_BITS * ETU
    bare = command in (b"\x26", b"\x52") or command[1:] == b"\x20"  # SENS_RES and SDD_RES have no CRC_A
    return ((len(octets) + (0 if bare else 2)) * 9 + 2) * ETU


class AirTime:
    """Holds each answer back until command and answer would have passed; called with every frame of a tag.

    The time of the processes themselves counts within it, so that a paced exchange lasts as long as on air.
    """

    def __init__(self) -> None:
        self._due = 0.0
        self._command = b""

    def __call__(self, octets: bytes, answering: bool) -> None:
        """Note a command, or wait until the ``answering`` frame would be there."""
        if not answering:
            self._command, self._due = octets, time.perf_counter() + command_seconds(octets) + _TO_TAG
            return
        due = self._due + answer_seconds(self._command, octets) + _TO_READER
        while (left := due - time.perf_counter()) > 0:
            if left > _SPIN:
                time.sleep(left - _SPIN)


_LISTEN = 0.25  # seconds between checks for a stop or a renewal of the initial message
_QUEUE = 0.2  # seconds between two tries to be placed on an occupied reader
_LEAVING = 1.0  # seconds for the node before to leave the reader
_SENS_RES = {4: b"\x04\x00", 7: b"\x44\x00", 10: b"\x84\x00"}
TYPE4_MAX_NDEF = 4160  # a frame of 4094 octets in one message

_Respond = Callable[[bytes], bytes | None]


class NfcServer:
    """Serves ``handler`` on ``path`` (``udp:localhost:PORT``) as a Type 4 or a Type 2 tag, in a thread.

    ``uid`` has 4, 7 or 10 octets (Type 2: 7), random when None. ``wt_int`` (0 to 63) and ``n_wait`` (0 to 15) are
    announced; ``max_ndef`` octets is the longest NDEF message, by default 4160 (Type 4) or 499 (Type 2, its most).
    ``pace`` makes every frame last as long as on air at 106 kbit/s; with ``queue`` it waits while another node is on
    the reader. ``extras`` are further records of the initial message. Raises UsageError for what does not fit.
    """

    def __init__(
        self,
        path: str,
        handler: NodeHandler,
        *,
        tag: Literal["4", "2"] = "4",
        uid: bytes | None = None,
        wt_int: int = 4,
        n_wait: int = 15,
        max_ndef: int | None = None,
        pace: bool = False,
        queue: bool = False,
        extras: ExtraRecords = NO_EXTRAS,
    ) -> None:
        self._path = path
        self._device: Any = None
        self._address = address_of(path)
        self._uid = uid or (b"\x08" + os.urandom(3) if tag == "4" else b"\x02" + os.urandom(6))
        if len(self._uid) not in ((7,) if tag == "2" else (4, 7, 10)):
            raise UsageError(f"A Type {tag} tag cannot have a UID of {len(self._uid)} octets.")
        self._type4, self._type2 = None, None
        if tag == "4":
            self._type4 = nfc_type4.Type4Memory(max_ndef or TYPE4_MAX_NDEF)
        else:
            self._type2 = nfc_type2.Type2Memory(self._uid, max_ndef or nfc_type2.MAX_NDEF)
        self._tnep = TnepTag(self._type4 or self._memory2(), handler, wt_int=wt_int, n_wait=n_wait, extras=extras)
        self._pace, self._queue, self._extras = pace, queue, extras
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="nfc-tag", daemon=True)

    def start(self) -> None:
        """Place the node on the reader. Raises NoReaderError, also if another node is on it and does not leave."""
        self._device = NodeDevice(*self._address)
        if self._pace:
            self._device.air = AirTime()
        try:
            if not self._bound() and not self._queue:
                raise NoReaderError(
                    f"Another node or program is using {self._path}.", hint="Stop it, or use another port."
                )
        except OSError as error:
            raise NoReaderError(
                f"The node cannot use {self._path}: {error.strerror}.", hint="Try another port."
            ) from error
        self._tnep.start()
        self._thread.start()

    def stop(self) -> None:
        """Leave the reader, after the command that is being run."""
        self._stop.set()
        if self._device is not None:
            self._device.wake()
            self._thread.join()
            self._tnep.stop()

    def restarted(self) -> None:
        """Begin again with a node that has restarted; earlier replies are forgotten."""
        self._tnep.lost()

    def _bound(self) -> bool:
        """Take the port; a node that is just leaving it is given a second."""
        until = time.monotonic() + _LEAVING
        while not self._device.bind():
            if self._queue or time.monotonic() > until or self._stop.wait(_QUEUE):
                return False
        return True

    def _memory2(self) -> nfc_type2.Type2Memory:
        assert self._type2 is not None
        return self._type2

    def _serve(self) -> None:
        clf = frontend(self._device, self._path)
        sak = nfc_type2.TYPE_2_SAK if self._type2 else nfc_type4.SAK
        offer = nfc.clf.LocalTarget(
            "106A",
            sens_res=bytearray(_SENS_RES[len(self._uid)]),
            sdd_res=bytearray(self._uid),
            sel_res=bytearray((sak,)),
        )
        while not self._stop.is_set():
            if not self._device.bind():
                self._stop.wait(_QUEUE)
                continue
            target = clf.listen(offer, timeout=_LISTEN)
            if target is None:
                self._tnep.idle()
            elif self._type2 is not None:
                self._activation(clf, self._type2.answer, bytes(target.tt2_cmd), b"")
            elif target.tt4_cmd:
                application = nfc_type4.NdefApplication(self._memory4(), self._tnep.ready)
                card = nfc_type4.IsoDepTag(bytes(target.tt4_cmd), application)
                self._activation(clf, card.answer, b"", nfc_type4.ATS)
        clf.close()

    def _memory4(self) -> nfc_type4.Type4Memory:
        assert self._type4 is not None
        return self._type4

    def _activation(self, clf: Any, respond: _Respond, command: bytes, answer: bytes | None) -> None:
        """Serve one activation, from its first command (or the answer to it) until the field is gone."""
        self._tnep.activated()
        self._extras.field(True)
        while not self._stop.is_set():
            if command:
                answer = respond(command)
            command = b""
            try:
                command = bytes(clf.exchange(answer, _LISTEN) or b"")
            except nfc.clf.TimeoutError:
                self._tnep.idle()
            except nfc.clf.BrokenLinkError:
                break
            except nfc.clf.CommunicationError:
                pass
            answer = None
        self._extras.field(False)
        self._tnep.lost()
