"""The ``--can`` option: ``INTERFACE:CHANNEL[?key=value&…]`` (command-line contract, "Links")."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final
from urllib.parse import unquote

from teds_provision.errors import UsageError
from teds_provision.links.can.interface_keys import known_keys

FIRST_STATION: Final = 0xF1
LAST_STATION: Final = 0xF7
"""Addresses of base stations (profile.md, "CAN")."""
LAST_NODE: Final = 0xEF
"""Nodes have 0x01 to 0xEF."""
DEFAULT_BITRATE: Final = 500_000
DEFAULT_DATA_BITRATE: Final = 2_000_000

OptionValue = int | float | str | bool

_HINT: Final = "Examples: socketcan:can0?bitrate=500000 or udp_multicast:239.74.163.2?node=0x21."
_RESERVED: Final = frozenset({"interface", "channel", "can_filters", "ignore_config", "config_context"})
_HOW: Final = frozenset({"bitrate", "data_bitrate", "hop_limit", "fd", "receive_own_messages", "timing"})
"""Options about how a bus is used, not which one it is."""
_TRUE: Final = frozenset({"1", "true", "yes", "on"})
_FALSE: Final = frozenset({"0", "false", "no", "off"})


@dataclass(frozen=True)
class CanSpec:
    """A CAN bus as the user named it.

    ``node`` 1 to 239 is the only node to talk to, None for any; ``source`` is the station's own address, 0xF1 to 0xF7;
    ``bitrate`` and ``data_bitrate`` in bit/s (the latter for the fast part of an FD frame); ``pace`` holds every sent
    frame back for the time it would take on a wire; ``options`` go to the python-can interface as they are.
    """

    interface: str
    channel: str
    fd: bool = False
    node: int | None = None
    source: int = FIRST_STATION
    source_named: bool = field(default=False, compare=False)
    bitrate: int = DEFAULT_BITRATE
    data_bitrate: int = DEFAULT_DATA_BITRATE
    pace: bool = False
    options: tuple[tuple[str, OptionValue], ...] = ()

    @property
    def text(self) -> str:
        """Interface and channel, to name the bus in a message."""
        return f"{self.interface}:{self.channel}"

    @property
    def sources(self) -> tuple[int, ...]:
        """The source addresses to use, the first choice first: a named one alone."""
        others = [address for address in range(FIRST_STATION, LAST_STATION + 1) if address != self.source]
        return (self.source,) if self.source_named else (self.source, *others)

    @property
    def wire(self) -> str:
        """Identity of this bus: interface, channel, and the options that locate it."""
        where = sorted(f"{key}={value}" for key, value in self.options if key not in _HOW)
        return "?".join([self.text, *(["&".join(where)] if where else [])])

    def require_known(self) -> None:
        """Raise UsageError for a key that the interface does not have: python-can silently ignores it."""
        if not self.options:
            return
        known = known_keys(self.interface)
        for key, _ in self.options:
            if known and key not in known:
                own = ", ".join(sorted(known | {"node", "source", "pace", "fd"}))
                raise UsageError(f"--can {self.interface} has no key {key!r}.", hint=f"It has: {own}.")


def parse_spec(text: str) -> CanSpec:
    """Read the ``--can`` option; raises UsageError that names the part which is wrong.

    The interface ends at the first colon, so that an IPv6 multicast group may be a channel. ``bitrate`` and
    ``data_bitrate`` are used here and passed on as well.
    """
    place, _, query = text.partition("?")
    interface, colon, channel = place.partition(":")
    if not interface.isidentifier() or not colon or not channel:
        raise UsageError(f"--can {text!r} does not name an interface and a channel.", hint=_HINT)
    values = _pairs(query)
    fd = _flag(values, "fd")
    pace = _flag(values, "pace")
    node = _number(values, "node", 1, LAST_NODE)
    source = _number(values, "source", FIRST_STATION, LAST_STATION)
    options: dict[str, OptionValue] = {key: _guess(value) for key, value in values.items()}
    bitrate = _number(values, "bitrate", 1, 1_000_000)
    data_bitrate = _number(values, "data_bitrate", 1, 20_000_000)
    if interface == "udp_multicast":
        options.setdefault("hop_limit", 0)  # with python-can's default of 1, every frame would reach the local network
    return CanSpec(
        interface,
        channel,
        fd=fd,
        node=node,
        source=FIRST_STATION if source is None else source,
        source_named=source is not None,
        bitrate=bitrate or DEFAULT_BITRATE,
        data_bitrate=data_bitrate or DEFAULT_DATA_BITRATE,
        pace=pace,
        options=tuple(options.items()),
    )


def _pairs(query: str) -> dict[str, str]:
    values: dict[str, str] = {}
    for part in query.split("&") if query else []:
        key, equals, value = part.partition("=")
        if not equals or not key.isidentifier() or key in _RESERVED:
            raise UsageError(f"--can has an option {part!r} that is not of the form key=value.", hint=_HINT)
        if key in values:
            raise UsageError(f"--can names {key} twice.", hint="Give each option once.")
        values[key] = unquote(value)
    return values


def _flag(values: dict[str, str], key: str) -> bool:
    value = values.pop(key, "0").lower()
    if value not in _TRUE | _FALSE:
        raise UsageError(f"--can {key}={value!r} is neither 1 nor 0.", hint=f"Write {key}=1 or omit it.")
    return value in _TRUE


def _number(values: dict[str, str], key: str, least: int, most: int) -> int | None:
    """Take ``key`` as a whole number within bounds; bit rates stay behind for the interface."""
    value = values.get(key) if key.endswith("bitrate") else values.pop(key, None)
    if value is None:
        return None
    number = _guess(value)
    if not isinstance(number, int) or not least <= number <= most:
        bounds = f"0x{least:02X} to 0x{most:02X}" if most <= 0xFF else f"{least} to {most}"
        raise UsageError(
            f"--can {key}={value!r} is not a whole number from {bounds}.", hint=f"Write, for example, {key}={least:#x}."
        )
    return number


def _guess(value: str) -> int | float | str:
    """Return what looks like a number as a number: 500000, 0x21, 0.5."""
    if not value.isascii():
        return value
    for read in (lambda: int(value, 0), lambda: int(value), lambda: float(value)):
        try:
            return read()
        except ValueError:
            continue
    return value
