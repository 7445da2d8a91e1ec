"""NFC Forum TNEP 1.0, as much of it as the profile uses: its three records and its waiting time (profile.md, "NFC").

Layouts and constants after three public implementations (nRF Connect SDK, Multipaz, SpruceID isomdl); the text of the
specification itself was not at hand. Pure; imports no NFC library.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from teds_provision.errors import GarbledError
from teds_provision.links.nfc.message import EXTERNAL, WELL_KNOWN, NdefRecord

SERVICE = b"urn:nfc:xsn:teds-provision:tim"
ID_TYPE = b"teds-provision:id"
TIM_TYPE = b"teds-provision:tim"

SUCCESS, PROTOCOL_ERROR, GARBLED_REQUEST = 0x00, 0x01, 0x80
_SINGLE_RESPONSE = 0


@dataclass(frozen=True)
class ServiceParameters:
    """The ``Tp`` record: a tag's parameters of one of its services.

    ``wt_int`` 0 to 63, ``n_wait`` 0 to 15, ``max_ndef`` octets of the longest NDEF message that the tag takes or gives.
    """

    uri: bytes
    wt_int: int
    n_wait: int
    max_ndef: int
    mode: int = _SINGLE_RESPONSE
    version: int = 0x10

    @property
    def t_wait(self) -> float:
        """Least time between writing and reading, in seconds: 2^(WT_INT/4 - 1) ms."""
        return float(2.0 ** (self.wt_int / 4 - 1) / 1000.0)

    def record(self) -> NdefRecord:
        """Return version ‖ length of the URI ‖ URI ‖ mode ‖ WT_INT ‖ N_wait ‖ maximum (u16, big endian)."""
        tail = struct.pack(">BBBH", self.mode, self.wt_int, self.n_wait, self.max_ndef)
        return NdefRecord(WELL_KNOWN, b"Tp", bytes((self.version, len(self.uri))) + self.uri + tail)

    @classmethod
    def decode(cls, payload: bytes) -> ServiceParameters:
        """Read the payload of a ``Tp`` record; raises GarbledError when its length does not add up."""
        if len(payload) < 7 or len(payload) != 7 + payload[1]:
            raise GarbledError("A TNEP service record has a wrong length.")
        uri = bytes(payload[2 : 2 + payload[1]])
        mode, wt_int, n_wait, max_ndef = struct.unpack(">BBBH", payload[-5:])
        return cls(uri, wt_int & 63, min(n_wait, 15), max_ndef, mode, payload[0])


def our_service(records: Sequence[NdefRecord]) -> ServiceParameters | None:
    """Find the profile's service in an initial message; other services and broken ``Tp`` records are passed over."""
    for record in records:
        if record.is_well_known(b"Tp"):
            try:
                service = ServiceParameters.decode(record.payload)
            except GarbledError:
                continue
            if service.uri == SERVICE and service.version >> 4 == 1 and service.mode == _SINGLE_RESPONSE:
                return service
    return None


def select(uri: bytes) -> NdefRecord:
    """Return the ``Ts`` record that selects the service ``uri``, or deselects when it is empty."""
    return NdefRecord(WELL_KNOWN, b"Ts", bytes((len(uri),)) + uri)


def selection(records: Sequence[NdefRecord]) -> bytes | None:
    """Return the URI that a message selects (empty: deselects), None when it holds no ``Ts`` record.

    Raises GarbledError when the record's length does not add up.
    """
    for record in records:
        if record.is_well_known(b"Ts"):
            if not record.payload or len(record.payload) != 1 + record.payload[0]:
                raise GarbledError("A TNEP select record has a wrong length.")
            return record.payload[1:]
    return None


def status(code: int) -> NdefRecord:
    """Return the ``Te`` record: 0 success, 1 protocol error, 0x80 to 0xFE the service's own errors."""
    return NdefRecord(WELL_KNOWN, b"Te", bytes((code,)))


def status_of(records: Sequence[NdefRecord]) -> int | None:
    """Return the code of a message's ``Te`` record, None when it has none."""
    for record in records:
        if record.is_well_known(b"Te") and record.payload:
            return record.payload[0]
    return None


def external(records: Sequence[NdefRecord], name: bytes) -> bytes | None:
    """Return the payload of the first external record of type ``name``, None when there is none."""
    return next((record.payload for record in records if record.is_external(name)), None)


def payload_record(payload: bytes) -> NdefRecord:
    """Return the profile's payload record around one encoded piece."""
    return NdefRecord(EXTERNAL, TIM_TYPE, payload)


def id_record(identify: bytes) -> NdefRecord:
    """Return the record of the initial message that holds the payload of Identify."""
    return NdefRecord(EXTERNAL, ID_TYPE, identify)
