"""The registry of links, and the only way to open a port: a place ``LINK:WHERE``, e.g. ``can:socketcan:can0``.

A new link touches its own folder, a line of :data:`LINKS`, and a check of the doctor. Its library is loaded when its
first port is opened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from teds_provision.errors import UsageError
from teds_provision.links.ports import BLE, CAN, NFC, Capabilities, LinkSettings, Port, Trace


@dataclass(frozen=True)
class LinkKind:
    """One kind of link: ``module`` has a function ``open_port(where, trace)``; ``example`` is a place of that kind.

    ``needs`` is the message if the place is left out and there is no default.
    """

    name: str
    module: str
    capabilities: Capabilities
    example: str
    needs: str = ""


LINKS: Final = {
    kind.name: kind
    for kind in (
        LinkKind("nfc", "teds_provision.links.nfc.port", NFC, "nfc:usb"),
        LinkKind(
            "can",
            "teds_provision.links.can.port",
            CAN,
            "can:socketcan:can0",
            needs="--via can requires --can, e.g. --can socketcan:can0?bitrate=500000.",
        ),
        LinkKind("ble", "teds_provision.links.ble.port", BLE, "ble:hci0"),
    )
}


def open_place(place: str, trace: Trace | None = None) -> Port:
    """Open the reader or bus at ``LINK:WHERE``; raises NoReaderError with the remedy, or UsageError.

    Its frames are written to ``trace``.
    """
    name, _, where = place.partition(":")
    kind = LINKS.get(name)
    if kind is None:
        known = " or ".join(f"--via {known}" for known in LINKS)
        raise UsageError(f"The link {name!r} is not part of this version.", hint=f"Use {known}.")
    if kind.needs and not where:
        problem, _, cure = kind.needs.partition(". ")
        raise UsageError(f"{problem}.", hint=cure)
    opened: Callable[[str, Trace | None], Port] = import_module(kind.module).open_port
    return opened(where, trace)


def open_port(settings: LinkSettings) -> Port:
    """Open the one reader or bus that ``settings`` name; raises NoReaderError with the cure, or UsageError."""
    places = settings.places
    if len(places) > 1:
        named = ", ".join(place.partition(":")[2] for place in places)
        raise UsageError(
            f"{len(places)} {'readers' if settings.via == 'nfc' else 'buses'} are named ({named}), "
            "but this command works with one.",
            hint=f"Choose one with --{settings.via}; several only work with --watch and measure.",
        )
    return open_place(places[0], settings.trace)


def open_ports(settings: LinkSettings) -> list[Port]:
    """Open every reader or bus that ``settings`` name; if one fails to open, none stays open."""
    ports: list[Port] = []
    try:
        for place in settings.places:
            ports.append(open_place(place, settings.trace))
    except BaseException:
        for port in ports:
            port.close()
        raise
    return ports
