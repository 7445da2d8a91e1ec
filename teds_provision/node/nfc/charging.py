"""What the initial NFC message of a node says beside the profile's records: charge, and where it is in the air.

Records of NFC Forum WLC 2.0 as open sources read them (the layouts are those of operation.md section 7 and of what
sold tags show): ``WLCCAP`` stands first, ``WLCSTAI`` after it, both in static mode, so that the mailbox stays
TNEP's. All of it is a hint.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from teds_provision.links.nfc.hints import MIME, OUT_OF_BAND
from teds_provision.links.nfc.message import WELL_KNOWN, Record
from teds_provision.protocol.operation.commands import Power, PowerFlag

CAPABILITY, STATUS, POLLER = b"WLCCAP", b"WLCSTAI", b"WLCINF"
_VERSION: Final = 0x20
_STATIC, _BATTERY_FULL = 0x00, 0x80
_REPEAT_WAITS: Final = bytes((0x09, 0x1E, 0x03, 0x0A))
"""Wait between two readings 2^12 ms, NDEF read wait 300 ms, write time-out 2^8 ms, write wait 10 ms."""
_BATTERY_LEVEL: Final = 0x01


def charge_records(power: Power) -> tuple[Record, ...]:
    """``WLCCAP`` (I can be charged, or am full) and ``WLCSTAI`` (battery in per cent); none without a battery."""
    if not power.flags & PowerFlag.BATTERY or power.level is None:
        return ()
    mode = _BATTERY_FULL if power.flags & PowerFlag.FULL else _STATIC
    return (
        Record(WELL_KNOWN, CAPABILITY, bytes((_VERSION, mode | 0x01)) + _REPEAT_WAITS),
        Record(WELL_KNOWN, STATUS, bytes((_BATTERY_LEVEL, power.level))),
    )


def out_of_band_record(address: bytes, *, random: bool) -> Record:
    """Bluetooth LE out-of-band record: ``address`` 6 octets as people write them; the role is peripheral only."""
    structures = b"\x08\x1b" + address[::-1] + bytes((random,)) + b"\x02\x1c\x00"
    return Record(MIME, OUT_OF_BAND, structures)


def is_poller_information(record: Record) -> bool:
    """Whether a reader says how it charges; it may write that at any time, into the mailbox that TNEP uses."""
    return record.is_well_known(POLLER)


Records = Callable[[], tuple[Record, ...]]


def _none() -> tuple[Record, ...]:
    return ()


@dataclass(frozen=True)
class Extras:
    """Records of the initial message ``before`` ``Tp`` and ``after`` the id, asked for anew each time.

    ``field`` is told when a reader's field comes (True) and goes.
    """

    before: Records = _none
    after: Records = _none
    field: Callable[[bool], None] = lambda present: None


NO_EXTRAS: Final = Extras()
