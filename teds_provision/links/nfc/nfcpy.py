"""nfcpy, imported once, with the side effects of its import undone, and with fixes for a hang and for needless waits.

Importing nfcpy 1.0.4 turns ``logging.captureWarnings`` on, sets its own logger to INFO and runs ``ldconfig`` and
``gcc`` from PATH to look for a libcrypto that only LLCP encryption would use. Import this module only if a reader or an
emulated tag is needed: it costs some 100 ms.

Three behaviors are fixed here; nothing above them changes:

* An exchange without a target raises: nfcpy answers None there, which its tags take for "still present", so that a node
  that was lifted off in the middle of an exchange was never missed.
* The PN53x driver sets its registers and its time-out before each exchange, three host commands for one that counts.
  Here they are set only when they change.
* Each frame is formatted for the log four times, even without a logger. Here only with one.
"""

from __future__ import annotations

import ctypes.util
import errno
import logging
import warnings
from typing import Any

from teds_provision.links.ports import Trace

_MOST_INDEX = 16  # of InCommunicateThru's time-out, 0.1 ms · 2^(n - 1)
_LATE = 0.1  # seconds beyond the chip's own time-out before nfcpy's host command times out
_TIMED_OUT = 0x01  # status of the chip: no answer from the target


def _load() -> Any:
    shown, find = warnings.showwarning, ctypes.util.find_library
    ctypes.util.find_library = lambda name: None  # LLCP is not used, so its library need not be searched
    try:
        import nfc
        import nfc.clf.udp
        import nfc.tag.tt2
        import nfc.tag.tt4
    finally:
        ctypes.util.find_library = find
    if warnings.showwarning is not shown:
        logging.captureWarnings(False)
    wordy = logging.getLogger().getEffectiveLevel() <= logging.DEBUG
    logging.getLogger("nfc").setLevel(logging.DEBUG if wordy else logging.CRITICAL)
    return nfc


nfc: Any = _load()
UdpDevice: Any = nfc.clf.udp.Device
Type2Tag: Any = nfc.tag.tt2.Type2Tag
NfcpyType2Ndef: Any = nfc.tag.tt2.Type2Tag.NDEF
Type2TagCommandError: Any = nfc.tag.tt2.Type2TagCommandError
Type4ATag: Any = nfc.tag.tt4.Type4ATag
NfcpyType4Ndef: Any = nfc.tag.tt4.Type4Tag.NDEF
Type4TagCommandError: Any = nfc.tag.tt4.Type4TagCommandError


def _logged() -> bool:
    """Return True if nfcpy's log of frames is enabled (``--debug``)."""
    return bool(nfc.clf.log.isEnabledFor(logging.DEBUG))


class QuietExchange:
    """The APDU exchange of nfcpy's Type 4 tag, without formatting it for the log."""

    _dep: Any

    def transceive(self, data: bytes, timeout: float | None = None) -> Any:
        """Exchange one APDU."""
        above: Any = super()
        return above.transceive(data, timeout) if _logged() else self._dep.exchange(data, timeout)


class Frontend(nfc.ContactlessFrontend):  # type: ignore[misc]
    """A front end that never answers for a target that is gone, and writes down what it exchanges."""

    trace: Trace | None = None

    def exchange(self, send_data: bytes, timeout: float) -> Any:
        """Exchange one frame; raises nfc.clf.TimeoutError if no target is activated."""
        if self.target is None and self.device is not None:
            raise nfc.clf.TimeoutError("no target is activated")
        if self.trace is None:
            return self._carried(send_data, timeout)
        self.trace.frame("nfc", "out", bytes(send_data))
        answer = self._carried(send_data, timeout)
        if answer is not None:
            self.trace.frame("nfc", "in", bytes(answer))
        return answer

    def _carried(self, send_data: bytes, timeout: float) -> Any:
        """Exchange as nfcpy does, which formats each frame for its log even if nothing is logged."""
        if not _logged():
            with self.lock:
                if self.device is not None and isinstance(self.target, nfc.clf.RemoteTarget):
                    return self.device.send_cmd_recv_rsp(self.target, send_data, timeout)
        return super().exchange(send_data, timeout)

    def open(self, path: str) -> bool:
        """Open the device at ``path``, a PN53x with its exchanges slimmed."""
        opened = bool(super().open(path))
        pn53x = getattr(nfc.clf, "pn53x", None)  # nfcpy imports it with its first driver
        if opened and pn53x is not None and isinstance(self.device, pn53x.Device):
            self.device.send_cmd_recv_rsp = _LeanExchange(self.device, pn53x).exchange
        return opened


class _LeanExchange:
    """The exchange of a PN53x, registers and time-out set when target, bit rate or time-out are others."""

    def __init__(self, device: Any, pn53x: Any) -> None:
        self._device, self._pn53x = device, pn53x
        self._whole = device.send_cmd_recv_rsp
        # the target of the present settings; the reference prevents another object with the same id
        self._target: Any = None
        self._rates = ("", "")
        self._index = 0

    def exchange(self, target: Any, data: bytes, timeout: float) -> Any:
        """Send a command and return the response, as ``nfc.clf.pn53x.Device.send_cmd_recv_rsp``."""
        microseconds = int(timeout * 1e6)
        index = next((n + 1 for n in range(_MOST_INDEX) if microseconds >> n <= 100), _MOST_INDEX)
        rates = (target.brty_send, target.brty_recv)
        if self._target is not target or self._rates != rates:
            self._target = None
            answer = self._whole(target, data, timeout)
            self._target, self._rates, self._index = target, rates, index
            return answer
        if self._index != index:
            self._device.chipset.rf_configuration(0x02, bytearray((10, 11, index)))
            self._index = index
        try:
            return self._send(target, bytearray(data), (100 << (index - 1)) / 1e6 + _LATE)
        except self._pn53x.Chipset.Error as error:
            self._target = None
            if error.errno == _TIMED_OUT:
                raise nfc.clf.TimeoutError from error
            raise nfc.clf.TransmissionError(str(error)) from error
        except OSError as error:
            self._target = None
            if error.errno == errno.ETIMEDOUT:
                raise nfc.clf.TimeoutError("send_cmd_recv_rsp") from error
            raise

    def _send(self, target: Any, data: bytearray, timeout: float) -> Any:
        if target.sens_res and not target.atr_res:
            if target.rid_res:
                return self._device._tt1_send_cmd_recv_rsp(data, timeout)
            if target.sel_res[0] & 0x60 == 0x00:
                return self._device._tt2_send_cmd_recv_rsp(data, timeout)
        return self._device.chipset.in_communicate_thru(data, timeout)
