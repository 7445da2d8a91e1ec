"""Firmware that a node reported, judged by its type (profiles.md, "[firmware]").

It does not affect the verdict, which covers only the datasheet: both are shown side by side.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from teds_provision import teds
from teds_provision.errors import BadDataError, GarbledError, NotFoundError, StoreError
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.station.station import Station
from teds_provision.station.store.records import FirmwareRecord

if TYPE_CHECKING:
    from teds_provision.teds.profile.firmware import FirmwareDemand

CHANGED: Final = "firmware changed since calibration"
FirmwareState = Literal["not-reported", "bad", "other", "outdated", "on-trial", "pending", "good", "unjudged"]


@dataclass(frozen=True)
class FirmwareReading:
    """A node's answer to About; ``report`` None: it does not report its firmware. ``sealed``: given in a session."""

    report: FirmwareReport | None
    sealed: bool

    @property
    def payload(self) -> bytes:
        """The octets that the store keeps, empty if nothing was reported."""
        return b"" if self.report is None else self.report.encode()


def decoded_report(payload: bytes) -> FirmwareReport | None:
    """Read a reply to About; None for another form, length or character: the node does not report its firmware."""
    try:
        return FirmwareReport.decode(payload)
    except GarbledError:
        return None


def release_of(report: FirmwareReport) -> tuple[int, int, int, int]:
    """Return version and build, as numbers to compare."""
    return (*report.version, report.build)


def state_of(demand: FirmwareDemand | None, report: FirmwareReport | None) -> FirmwareState:
    """Return the first state that applies (profiles.md, "[firmware]")."""
    if demand is None:
        return "unjudged"
    if report is None:
        return "not-reported"
    if demand.is_bad(release_of(report), None if report.image is None else report.image.hex()):
        return "bad"
    if not demand.fits(report.text):
        return "other"
    if demand.is_outdated(release_of(report)):
        return "outdated"
    if FirmwareFlag.ON_TRIAL in report.flags:
        return "on-trial"
    return "pending" if FirmwareFlag.PENDING in report.flags else "good"


def same_firmware(one: FirmwareReport | None, other: FirmwareReport | None) -> bool:
    """Return True if both are the same image; without its digest, of the same text, version and build."""
    if one is None or other is None:
        return one is other
    if one.image is not None and other.image is not None:
        return one.image == other.image
    return (one.text, release_of(one), one.image) == (other.text, release_of(other), other.image)


class PlantFirmware(NamedTuple):
    """Statement to the plant about a node's firmware: text, version, digest; ``runs`` None: it reports none."""

    runs: tuple[str, str, str | None] | None

    @property
    def members(self) -> list[str | None] | None:
        """``runs`` as an event has it."""
        return None if self.runs is None else list(self.runs)


def plant_event(record: FirmwareRecord | None) -> PlantFirmware | None:
    """Return what the plant hears of a kept report, None for nothing.

    Only a report of a session counts. An image on trial is left out: it may be gone after the next restart.
    """
    if record is None or not record.in_session:
        return None
    report = decoded_report(record.report)
    if report is None:
        return PlantFirmware(None)
    return None if FirmwareFlag.ON_TRIAL in report.flags else PlantFirmware(report.stated)


@dataclass
class FirmwareDemands:
    """The demands of types, each profile read once."""

    home: Path
    _read: dict[str, FirmwareDemand | None] = field(default_factory=dict)

    def demand_of(self, profile: str | None) -> FirmwareDemand | None:
        """Return the table of a profile, None if it has none, or cannot be read (which doctor reports)."""
        if profile is None:
            return None
        if profile not in self._read:
            try:
                folders = teds.profile.default_folders(self.home)
                path = teds.profile.find_profile(profile, folders)
                demand = _demand(path, folders, path.stat().st_mtime_ns, int(time.monotonic()))
            except (NotFoundError, BadDataError, StoreError, OSError):
                demand = None
            self._read[profile] = demand
        return self._read[profile]


@lru_cache(maxsize=64)  # two hundred nodes of one type may start together, with one call each
def _demand(path: Path, folders: tuple[Path, ...], _changed: int, _second: int) -> FirmwareDemand | None:
    """Read what a profile demands of the firmware; again each second, as the profiles that it extends may change."""
    return teds.profile.load_profile(path, folders).firmware


@dataclass(frozen=True)
class KnownFirmware:
    """Firmware of a node as known; ``changed``: another image runs than at the last signature."""

    reading: FirmwareReading
    state: FirmwareState
    changed: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return ``firmware`` as commands print it."""
        report = self.reading.report
        return {
            "text": None if report is None else report.text,
            "version": None if report is None else report.version_text,
            "build": None if report is None else report.build,
            "image": None if report is None or report.image is None else report.image.hex(),
            "state": self.state,
            "from": "session" if self.reading.sealed else "plain",
            "changed": self.changed,
        }


def known_firmware(
    record: FirmwareRecord | None, demand: Callable[[], FirmwareDemand | None], now: FirmwareReading | None = None
) -> KnownFirmware | None:
    """Judge what a node reported: ``now``, else as the store has it; None if nothing is known.

    Only an answer in a session shows a change.
    """
    reading = now
    if reading is None and record is not None:
        reading = FirmwareReading(decoded_report(record.report), record.in_session)
    if reading is None:
        return None
    changed = (
        reading.sealed
        and record is not None
        and record.signed is not None
        and not same_firmware(decoded_report(record.signed), reading.report)
    )
    return KnownFirmware(reading, state_of(demand(), reading.report), changed)


def firmware_of(station: Station, uuid: bytes, now: FirmwareReading | None = None) -> KnownFirmware | None:
    """Return what is known of one node's firmware, judged by its type; ``now`` is an answer that just came."""
    known = station.nodes.get(uuid)
    profile = known.profile if known is not None else None
    return known_firmware(
        station.firmware_reports.get(uuid), lambda: FirmwareDemands(station.home).demand_of(profile), now
    )
