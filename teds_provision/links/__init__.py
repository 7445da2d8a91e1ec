"""Links: the ways on which a command frame travels to a node and its reply back (profile.md, "NFC", "CAN", "BLE").

A :class:`Port` is the reader or the bus; it finds nodes. A :class:`Contact` is one node found on it, with the
:class:`Link` that carries one command frame and its one reply at a time. Everything above this package is the same
code for NFC and CAN; everything above the opening of a port is the same code for simulated and real hardware.
Importing this package loads neither nfcpy nor python-can.
"""

from __future__ import annotations

from teds_provision.links.opening import LINKS, open_place, open_port, open_ports
from teds_provision.links.ports import Capabilities, Contact, Link, LinkSettings, Notice, Port, Trace

__all__ = [
    "LINKS",
    "Capabilities",
    "Contact",
    "Link",
    "LinkSettings",
    "Notice",
    "Port",
    "Trace",
    "open_place",
    "open_port",
    "open_ports",
]
