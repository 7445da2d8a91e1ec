"""The functions of PC/SC that a reader needs, from pcscd's client library by ctypes: no package, no compiler.

Types and numbers are those of pcsclite.h and wintypes.h on Linux (DWORD and LONG are as wide as long).
"""

from __future__ import annotations

import ctypes
from ctypes import POINTER, byref, c_char_p, c_long, c_ubyte, c_ulong, c_void_p, create_string_buffer
from functools import cache
from typing import Final

from teds_provision.errors import NoReaderError

LIBRARY: Final = "libpcsclite.so.1"
_SCOPE_USER: Final = 0
_SHARE_EXCLUSIVE: Final = 1
_T0_OR_T1: Final = 3
_UNPOWER: Final = 2
_MOST_ATR: Final = 33
_MOST_ANSWER: Final = 65_546  # an extended answer with its status word
_SUCCESS: Final = 0
SHARING_VIOLATION: Final = 0x8010000B
NO_READERS: Final = 0x8010002E
GONE: Final = frozenset({0x80100003, 0x80100009, 0x80100013, 0x80100017, 0x8010001D, 0x8010001E})
"""Invalid handle, unknown reader, communication error, reader unavailable, no service, service stopped."""


class PcscError(Exception):
    """PC/SC refused something; ``code`` is one of its return values."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


class _Protocol(ctypes.Structure):
    """SCARD_IO_REQUEST: the protocol of a card, and the length of this structure."""

    _fields_ = (("protocol", c_ulong), ("length", c_ulong))


class PcscLibrary:
    """The client library, loaded; every method raises PcscError."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        number, text, octets = POINTER(c_ulong), c_char_p, POINTER(c_ubyte)
        for name, arguments in {
            "SCardEstablishContext": (c_ulong, c_void_p, c_void_p, POINTER(c_long)),
            "SCardReleaseContext": (c_long,),
            "SCardListReaders": (c_long, text, text, number),
            "SCardConnect": (c_long, text, c_ulong, c_ulong, POINTER(c_long), number),
            "SCardDisconnect": (c_long, c_ulong),
            "SCardStatus": (c_long, text, number, number, number, octets, number),
            "SCardTransmit": (c_long, POINTER(_Protocol), text, c_ulong, c_void_p, octets, number),
        }.items():
            function = getattr(library, name)
            function.argtypes, function.restype = arguments, c_long
        library.pcsc_stringify_error.argtypes, library.pcsc_stringify_error.restype = (c_long,), c_char_p

    def _call(self, name: str, *arguments: object) -> None:
        code = getattr(self._library, name)(*arguments) & 0xFFFFFFFF
        if code != _SUCCESS:
            text = self._library.pcsc_stringify_error(code) or b"unknown error"
            raise PcscError(code, text.decode(errors="replace").strip().rstrip("."))

    def establish(self) -> int:
        """Connect to the service and return the context."""
        context = c_long()
        self._call("SCardEstablishContext", _SCOPE_USER, None, None, byref(context))
        return context.value

    def release(self, context: int) -> None:
        """Give a context back."""
        self._call("SCardReleaseContext", context)

    def readers(self, context: int) -> list[str]:
        """Return the names of all readers."""
        length = c_ulong()
        try:
            self._call("SCardListReaders", context, None, None, byref(length))
            names = create_string_buffer(length.value)
            self._call("SCardListReaders", context, None, names, byref(length))
        except PcscError as error:
            if error.code == NO_READERS:
                return []
            raise
        return [name.decode(errors="replace") for name in names.raw[: length.value].split(b"\0") if name]

    def connect(self, context: int, reader: str) -> tuple[int, int]:
        """Connect to the card on a reader, alone; returns its handle and protocol."""
        handle, protocol = c_long(), c_ulong()
        words = (context, reader.encode(), _SHARE_EXCLUSIVE, _T0_OR_T1, byref(handle), byref(protocol))
        self._call("SCardConnect", *words)
        return handle.value, protocol.value

    def disconnect(self, handle: int) -> None:
        """Let a card go and switch its field off."""
        self._call("SCardDisconnect", handle, _UNPOWER)

    def atr(self, handle: int) -> bytes:
        """Return the answer to reset of a card."""
        octets, length = (c_ubyte * _MOST_ATR)(), c_ulong(_MOST_ATR)
        name, state, protocol = c_ulong(0), c_ulong(), c_ulong()
        self._call("SCardStatus", handle, None, byref(name), byref(state), byref(protocol), octets, byref(length))
        return bytes(octets[: length.value])

    def transmit(self, handle: int, protocol: int, apdu: bytes) -> bytes:
        """Exchange one APDU; returns the answer with its status word."""
        answer, length = (c_ubyte * _MOST_ANSWER)(), c_ulong(_MOST_ANSWER)
        sent = _Protocol(protocol, ctypes.sizeof(_Protocol))
        self._call("SCardTransmit", handle, byref(sent), apdu, len(apdu), None, answer, byref(length))
        return bytes(answer[: length.value])


@cache
def load() -> PcscLibrary:
    """Return the client library; raises NoReaderError if it is not installed."""
    try:
        return PcscLibrary(ctypes.CDLL(LIBRARY))
    except (OSError, AttributeError) as error:
        raise NoReaderError(
            f"PC/SC readers need {LIBRARY}, which is not installed.", hint="sudo apt install pcscd"
        ) from error
