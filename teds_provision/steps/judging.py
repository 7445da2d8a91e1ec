"""What a datasheet is judged by: keys, pins and the deny list of a station, asked one by one or remembered for many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from teds_provision.protocol.agreement import other_key
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import Revocation, WhitelistEntry


class PinsAsked(Protocol):
    """Which key a UUID is pinned to."""

    def check(self, uuid: bytes, point: bytes) -> None:
        """Raise OtherKey where this UUID is known with another key."""

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        """The whitelist entry of a node."""


class PolicyAsked(Protocol):
    """Whose signatures count, and who is denied."""

    def revocation(self, uuid: bytes) -> Revocation | None:
        """Why a node is denied, None if it is not."""

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        """CA keys that count for a node."""

    def trusted_stations(self) -> list[bytes]:
        """Station keys that count."""


class Judging(Protocol):
    """A station, or what was remembered of one."""

    @property
    def point(self) -> bytes:
        """The station's own key."""

    @property
    def pins(self) -> PinsAsked:
        """Pinned keys."""

    @property
    def policy(self) -> PolicyAsked:
        """Trust and denials."""


@dataclass(frozen=True)
class _Pins:
    by_uuid: Mapping[bytes, str]
    entries: Mapping[bytes, WhitelistEntry]

    def check(self, uuid: bytes, point: bytes) -> None:
        pinned = self.by_uuid.get(uuid)
        if pinned is not None and not same_key(pinned, fingerprint(point)):
            raise other_key(pinned, point)

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        return self.entries.get(uuid)


@dataclass(frozen=True)
class _Policy:
    denied: Mapping[bytes, Revocation]
    cas: tuple[bytes, ...]
    cas_of_nodes: Mapping[bytes, bytes]
    stations: tuple[bytes, ...]

    def revocation(self, uuid: bytes) -> Revocation | None:
        return self.denied.get(uuid)

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        kept = self.cas_of_nodes.get(uuid) if uuid is not None else None
        return [*self.cas, *([kept] if kept is not None and kept not in self.cas else [])]

    def trusted_stations(self) -> list[bytes]:
        return list(self.stations)


@dataclass(frozen=True)
class Remembered:
    """What a station said at one moment: plain data, so that other processes can judge by it too."""

    point: bytes
    pins: _Pins
    policy: _Policy


def remember(station: Station) -> Remembered:
    """Take down everything that judging images asks a station for; raises StoreChanged as the station does."""
    return Remembered(
        station.point,
        _Pins(station.pins.all(), {entry.uuid: entry for entry in station.pins.whitelist()}),
        _Policy(
            {revocation.uuid: revocation for revocation in station.policy.revocations()},
            tuple(station.policy.trusted_cas()),
            _counting(station, station.keys.cas_of_nodes()),
            tuple(station.policy.trusted_stations()),
        ),
    )


def remember_page(station: Station, uuids: Sequence[bytes]) -> Remembered:
    """As :func:`remember`, of what is asked for a page of nodes alone: a list of 100,000 is never held whole."""
    entries = station.pins.of_page(uuids)
    return Remembered(
        station.point,
        _Pins(station.pins.among(station.nodes.of_page(uuids).values(), entries.values()), entries),
        _Policy(
            {uuid: revocation for uuid in uuids if (revocation := station.policy.revocation(uuid)) is not None},
            tuple(station.policy.trusted_cas()),
            _counting(station, station.keys.cas_of_page(uuids)),
            tuple(station.policy.trusted_stations()),
        ),
    )


def _counting(station: Station, cas: Mapping[bytes, bytes]) -> dict[bytes, bytes]:
    """Those of the CAs that nodes keep in which trust was not ended; a CA is asked about once."""
    counts = {ca: station.policy.counts(ca) for ca in set(cas.values())}
    return {uuid: ca for uuid, ca in cas.items() if counts[ca]}
