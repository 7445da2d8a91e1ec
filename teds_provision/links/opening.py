"""The one function that turns the user's link options into an open port; loads the libraries of that link alone."""

from __future__ import annotations

from teds_provision.errors import UsageFailure
from teds_provision.links.ports import LinkSettings, Port


def open_port(settings: LinkSettings) -> Port:
    """Open the reader or bus that ``settings`` name; raises NoReader with the cure, or UsageFailure."""
    if settings.via == "nfc":
        from teds_provision.links.nfc.reader import NfcPort

        return NfcPort(settings.nfc or "usb")
    if settings.via == "can":
        from teds_provision.links.can.port import CanPort

        if not settings.can:
            raise UsageFailure(
                "--via can needs to know the bus.", hint="Add --can, e.g. --can socketcan:can0?bitrate=500000."
            )
        return CanPort(settings.can)
    raise UsageFailure(f"The link {settings.via!r} is not part of this version.", hint="Use --via nfc or --via can.")
