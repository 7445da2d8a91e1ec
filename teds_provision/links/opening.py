"""The registry of links, and the only way to open a port: a place ``LINK:WHERE``, e.g. ``can:socketcan:can0``.

A new link touches its own folder, a line of :data:`LINKS`, and a check of the doctor. Its library is loaded when its
first port is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from teds_provision.errors import UsageError
from teds_provision.links.ports import BLE, CAN, NFC, Capabilities, LinkSettings, LinkSpec, Port, SharedBus, Trace


@dataclass(frozen=True)
class LinkKind:
    """One kind of link: ``module`` has a function ``open_port(where, trace)``; ``example`` is a place of that kind.

    ``needs`` is the message if the place is left out and there is no default. ``spec`` is the module whose
    ``parse_spec(where)`` reads WHERE, or raises UsageError; "" if there is nothing to read.
    """

    name: str
    module: str
    capabilities: Capabilities
    example: str
    needs: str = ""
    spec: str = ""


LINKS: Final = {
    kind.name: kind
    for kind in (
        LinkKind("nfc", "teds_provision.links.nfc.port", NFC, "nfc:usb"),
        LinkKind(
            "can",
            "teds_provision.links.can.port",
            CAN,
            "can:socketcan:can0",
            needs="--via can requires --can. For example --can socketcan:can0?bitrate=500000.",
            spec="teds_provision.links.can.spec",
        ),
        LinkKind("ble", "teds_provision.links.ble.port", BLE, "ble:hci0", spec="teds_provision.links.ble.spec"),
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


def capabilities_at(place: str) -> Capabilities:
    """Return what the link at ``LINK:WHERE`` can do, without opening it; nothing for an unknown link."""
    kind = LINKS.get(place.partition(":")[0])
    return Capabilities() if kind is None else kind.capabilities


def plugged_in() -> Iterator[str]:
    """Yield the place of each NFC reader that is plugged in; none of them is opened."""
    if import_module("teds_provision.links.nfc.usb_listing").may_have_reader():
        paths = import_module("teds_provision.links.nfc.reader").plugged_in()
    else:
        paths = import_module("teds_provision.links.nfc.pcsc_readers").paths()
    return (f"nfc:{path}" for path in paths)


def require_known_place(place: str) -> None:
    """Raise UsageError for a WHERE that cannot be meant: no new try helps, as it may with a link that is missing."""
    spec = _spec_of(place)
    if spec is not None:
        spec.require_known()


def shared_bus(place: str) -> SharedBus | None:
    """Return the bus and this station's address on it, without opening it; None if no other station shares the link.

    Raises UsageError.
    """
    spec = _spec_of(place) if capabilities_at(place).shared else None
    return spec if isinstance(spec, SharedBus) else None


def with_source(place: str, source: int) -> str:
    """Return the place with this source address in it, unless it names one, or its link has none."""
    query = place.partition("?")[2]
    if not capabilities_at(place).shared or "source=" in query:
        return place
    return f"{place}{'&' if '?' in place else '?'}source=0x{source:02X}"


def without_source(place: str) -> str:
    """Return the place without a source address: another process chooses its own."""
    where, _, query = place.partition("?")
    rest = "&".join(part for part in query.split("&") if part and not part.startswith("source="))
    return f"{where}?{rest}" if rest else where


def _spec_of(place: str) -> LinkSpec | None:
    name, _, where = place.partition(":")
    kind = LINKS.get(name)
    if kind is None or not kind.spec:
        return None
    read: Callable[[str], LinkSpec] = import_module(kind.spec).parse_spec
    return read(where)


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
