"""The settings with which `ncap run` was started."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from teds_provision.errors import UsageError
from teds_provision.links import Trace
from teds_provision.links.opening import require_known_place
from teds_provision.measure.display_units import FileUnits
from teds_provision.measure.exposure import Exposure
from teds_provision.measure.sinks.foxglove_server import address_of
from teds_provision.measure.verified_session import DEAD_MAN

Detection = Literal["transparent", "whitelist"]
_FIRST, _SOURCES = 0xF2, 6
"""Addresses of daemons on a bus, 0xF2 to 0xF7: the command line, with 0xF1 by default, works beside."""


@dataclass(frozen=True)
class Settings:
    """``places`` are links as ``can:…`` and ``nfc:…``; ``detection`` None: as it was last set, else ``whitelist``.

    ``adopt``: factory nodes of a wired bus get a key; ``yes``: such a node's own datasheet is signed at once.
    ``trust_dcc``: files with certificates (PEM), one of which must have signed a calibration certificate.
    ``unverified``: they are measured by their own datasheet, marked so. ``http`` is (host, port) or None: then only the
    Unix socket of the home is served. ``sinks`` take what is measured, beside those of each measurement; ``brokers``
    are URLs by the names under which a measurement may name them; ``foxglove`` is HOST:PORT of a Foxglove server for
    all measurements; without ``scalars`` it and MCAP have no topics of single channels. ``record`` is a folder for a
    recording of each measurement. ``actuators``: set points may come by topics of ROS. ``measure`` selects nodes to
    measure as they come, at ``rate`` in Hz at most; ``frozen``: only those selected at the start. ``dead_man`` in ms is
    for all actuators whose measurement has no other. ``require_firmware``: only nodes whose firmware their type
    accepts. ``parts`` names parts of optional rooms that run beside it. ``trace`` is an open one: every frame of every
    link is written.
    """

    places: tuple[str, ...] = ()
    detection: Detection | None = None
    adopt: bool = False
    trust_dcc: tuple[Path, ...] = ()
    file_units: FileUnits = "si"
    yes: bool = False
    unverified: bool = False
    http: tuple[str, int] | None = None
    allow: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    record: Path | None = None
    sinks: tuple[str, ...] = ()
    foxglove: str | None = None
    scalars: bool = True
    brokers: Mapping[str, str] = field(default_factory=dict)
    actuators: bool = True
    dead_man: int = DEAD_MAN
    measure: str | None = None
    rate: float | None = None
    frozen: bool = False
    require_firmware: bool = False
    parts: frozenset[str] = frozenset()
    metrics: bool = False
    clause_12: bool = False
    trace: Trace | None = None

    @property
    def exposure(self) -> Exposure:
        """How servers beyond loopback are protected."""
        return Exposure(self.allow, self.certificate, self.key)


def own_source(station_id: str) -> int:
    """Return a daemon's address on a bus, by the identity of its store: two stations on one bus seldom collide."""
    return _FIRST + zlib.crc32(station_id.encode()) % _SOURCES


def parse_http(text: str) -> tuple[str, int]:
    """Parse ``HOST:PORT``, ``[::1]:PORT`` or ``PORT`` alone (this machine); raises UsageError."""
    host, colon, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if colon else "127.0.0.1"
    if not port.isdecimal() or int(port) > 0xFFFF or not host:
        raise UsageError(f"--http {text!r} is not HOST:PORT.", hint="Use, for example, 127.0.0.1:8351.")
    return host, int(port)


def require_places(settings: Settings) -> None:
    """Raise UsageError for a link whose words are wrong: that does not mend itself, as a missing one may."""
    for place in settings.places:
        require_known_place(place)


def require_safe(settings: Settings) -> None:
    """Raise UsageError if the page would go to other machines without TLS, or with half of it."""
    settings.exposure.require_pair()
    if settings.http is not None:
        settings.exposure.require_safe("--http", settings.http[0], sends="values and tokens", clients="browsers")
    if settings.foxglove is not None:
        address_of(settings.foxglove, settings.exposure)
