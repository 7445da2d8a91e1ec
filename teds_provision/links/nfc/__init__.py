"""NFC: TNEP over NDEF on Type 4 and Type 2 tags, through nfcpy."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.links.nfc import (
        hints,
        message,
        nfcpy,
        pcsc,
        pcsc_readers,
        pieces,
        poller,
        port,
        reader,
        tag,
        tnep,
        udp,
        usb_listing,
    )
else:
    __getattr__ = lazy(__name__)
