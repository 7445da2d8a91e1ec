"""Selection of the nodes that a measurement takes in as they come (``ncap run --measure EXPR``).

EXPR is ``all``, or terms joined by ``,`` that must all hold: ``type:PROFILE``, ``name:GLOB``, ``group:NAME``, a bound
of ``nodes --fits`` (``angle >= 360 deg``; all bounds together are one requirement); a bare word is a group. The
expression does not decide who may be measured: a node must have a key here, and neither be banned nor given away.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path

from teds_provision.errors import BadDataError, NotFoundError, PolicyError, UsageError
from teds_provision.measure.planning import BusTime, plan_node, sensors_of
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.sinks.base import ROWS
from teds_provision.measure.standing import why_not_measured
from teds_provision.provisioning.board_type import misfit
from teds_provision.provisioning.readings import verdict_of
from teds_provision.station.groups import ALL
from teds_provision.station.overview import Search
from teds_provision.station.station import Station
from teds_provision.teds.fits import Requirement, judge, met, parse_fits
from teds_provision.teds.profile.load import (
    default_folders,
    find_profile,
    is_profile_name,
    list_profiles,
    load_profile,
)
from teds_provision.teds.profile.model import Profile
from teds_provision.teds.sheet import Sheet

_BOUND = re.compile(r"[<>]")
_KINDS = ("type", "name", "group")
_LONGEST = 64  # longest name that is searched for, in characters


@dataclass(frozen=True)
class NodeMatch:
    """A parsed expression: ``types`` by name, ``names`` as patterns, ``groups``, and requirements on the datasheet.

    ``text`` is the expression as it was given.
    """

    text: str
    types: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    fits: Requirement | None = None

    @classmethod
    def parse(cls, text: str) -> NodeMatch:
        """Read an expression; raises UsageError with the term that is wrong."""
        parts = [part.strip() for part in text.split(",")]
        if parts == [ALL]:
            return cls(ALL)
        found: dict[str, list[str]] = {kind: [] for kind in _KINDS}
        bounds = []
        for part in parts:
            kind, colon, value = part.partition(":")
            if not part or part == ALL or (colon and kind in _KINDS and not value.strip()):
                raise _wrong(part, text)
            if colon and kind in _KINDS:
                found[kind].append(value.strip())
            elif _BOUND.search(part):
                bounds.append(part)
            elif colon:
                raise _wrong(part, text)
            else:
                found["group"].append(part)
        try:
            fits = parse_fits(", ".join(bounds)) if bounds else None
        except BadDataError as error:
            raise UsageError(f"{text!r}: {error.message}", hint=error.hint) from error
        return cls(text, tuple(found["type"]), tuple(found["name"]), tuple(found["group"]), fits)

    def require_groups(self, station: Station) -> None:
        """Raise NotFoundError if the expression names a group that does not exist."""
        for group in self.groups:
            station.groups.get(group)

    def unknown_type(self, station: Station) -> str:
        """Return half a sentence on a type that is neither a profile here nor that of a known node.

        "" if there is none.

        Not certainly a mistake: a node of that type may be handed over later.
        """
        for kind in self.types:
            if not _is_profile(kind, station) and not station.overview.find(Search(profile=kind)):
                return f"no profile and no known node is called {kind!r}"
        return ""

    def why_not(self, station: Station, uuid: bytes) -> str:
        """Return why this expression does not select a node, in half a sentence; "" if it does."""
        record = station.nodes.get(uuid)
        profile, name = (record.profile or "", record.name or "") if record is not None else ("", "")
        for kind in self.types:
            if profile and profile != kind:
                return f"its type is {profile}, not {kind}"
            unlike = "" if profile else _unlike(station, uuid, kind)
            if unlike:
                return f"its type is unknown, and its datasheet does not fit {kind}: {unlike}"
        for pattern in self.names:
            if not fnmatchcase(name, pattern):
                return f"its name {name!r} is not {pattern}"
        for group in self.groups:
            members = station.groups.find(group)
            if members is None or uuid not in members.uuids:
                return f"it is not in group {group}"
        if self.fits is None:
            return ""
        image = station.datasheets.datasheet(uuid)
        judged = judge(self.fits, Sheet.from_image(image), datetime.now(UTC)) if image is not None else ()
        if met(self.fits, judged):
            return ""
        return next((fit.why.rstrip(".") for fit in judged), "its datasheet is unknown")


def known_nodes(station: Station, expression: str) -> list[bytes]:
    """Return the nodes whose key the station holds and that an expression selects; raises UsageError, NotFoundError."""
    match = NodeMatch.parse(expression)
    match.require_groups(station)
    found = [
        record.uuid
        for record in station.nodes.all()
        if station.keys.held(record.uuid) and not match.why_not(station, record.uuid)
    ]
    if not found:
        raise NotFoundError(
            f"No node whose key this station holds matches {expression!r}.", hint="See the nodes: teds-provision nodes"
        )
    return found


@dataclass(frozen=True)
class MatchSurvey:
    """The known nodes that an expression matches now (UUIDs in hex), and why others are not measured."""

    matching: tuple[str, ...]
    others: Mapping[str, str]


def survey(station: Station, match: NodeMatch) -> MatchSurvey:
    """Hold every node that the station knows against an expression."""
    matching, others = [], {}
    for record in station.nodes.all():
        why = why_not_measured(station, record.uuid) or match.why_not(station, record.uuid)
        if why:
            others[record.uuid.hex()] = why
        else:
            matching.append(record.uuid.hex())
    return MatchSurvey(tuple(matching), others)


def nearest_types(kind: str, station: Station) -> list[str]:
    """Return profiles with a name much like this one, the nearest first."""
    names = [
        entry.name
        for entry in list_profiles(default_folders(station.home))
        if not (entry.profile and entry.profile.abstract)
    ]
    return get_close_matches(kind[:_LONGEST], names, n=2, cutoff=0.6)


@dataclass(frozen=True)
class UnsignedNodes:
    """Every node that describes itself without a signature: ``ncap run --adopt --unverified``."""

    text: str = "unverified"

    def why_not(self, station: Station, uuid: bytes) -> str:
        """Return why not, as :meth:`NodeMatch.why_not` does."""
        if station.measurements.detection != "transparent":
            return "detection is not transparent"
        judged = verdict_of(station, uuid)
        if judged is None:
            return "its datasheet was not read in a session"
        if judged.origin == "plain" or judged.verified.verdict != "unsigned":
            return f"its datasheet is {judged.verified.verdict}"
        image = station.datasheets.datasheet(uuid)
        return "" if image is not None and Sheet.from_image(image).channels else "it has no datasheet of its own"


@dataclass(frozen=True)
class ListedNodes:
    """The nodes of a list that grows: those that were adopted while they were measured."""

    uuids: Set[bytes]
    text: str = "adopted"

    def why_not(self, station: Station, uuid: bytes) -> str:
        """Return why not, as :meth:`NodeMatch.why_not` does."""
        judged = verdict_of(station, uuid) if uuid in self.uuids else None
        return "" if judged is not None and judged.verified.verdict == "authentic" else "it was not adopted here"


@dataclass(frozen=True)
class NodeLoad:
    """Load of a node by its stored datasheet.

    ``bus`` is the share of an empty one (None: not known), ``rate`` that of the fastest channel in Hz.
    """

    bus: float | None = None
    channels: int = 0
    rate: float = 0.0

    def messages(self, scalar_rate: float, rows: bool) -> float:
        """Return the messages a second on topics: each channel's, and two for each row of the array with ``rows``."""
        return self.channels * min(scalar_rate, self.rate) + (2 * min(self.rate, ROWS) if rows else 0)


def load_of(station: Station, uuid: bytes, request: MeasurementRequest, time: BusTime) -> NodeLoad:
    """Return the load of a node; ``NodeLoad()`` if no datasheet of it is stored, or none that can be measured so."""
    image = station.datasheets.datasheet(uuid)
    if image is None:
        return NodeLoad()
    sensors = [channel for channel in Sheet.from_image(image).channels if channel.sample and not channel.actuator]
    try:
        kind = request.stream_kind
        plans = plan_node(sensors_of(sensors, (), kind), time, rate=request.rate, kind=kind, at_most=True)
    except (BadDataError, PolicyError):  # the node's session will report it
        return NodeLoad()
    rates = [1 / period for period in plans.periods().values() if period > 0]
    return NodeLoad(plans.load, len(rates), max(rates, default=0.0))


def _is_profile(kind: str, station: Station) -> bool:
    try:
        return is_profile_name(kind) and find_profile(kind, default_folders(station.home)).is_file()
    except NotFoundError:
        return False


def _unlike(station: Station, uuid: bytes, kind: str) -> str:
    """Return why a node whose profile is not known is none of this type; "" if its datasheet fits the type.

    Such a node was adopted, or came from a station that did not name its profile.
    """
    image = station.datasheets.datasheet(uuid)
    if image is None or not Sheet.from_image(image).channels:
        return "none is known"
    profile = _profile(kind, station.home)
    why = misfit(image, profile).rstrip(".") if profile is not None else f"There is no profile {kind}"
    return why[:1].lower() + why[1:]


def _profile(kind: str, home: Path) -> Profile | None:
    folders = default_folders(home)
    try:
        path = find_profile(kind, folders) if is_profile_name(kind) else None
        return None if path is None else _read_profile(path, folders, path.stat().st_mtime_ns, int(time.monotonic()))
    except (BadDataError, NotFoundError, OSError):
        return None


@lru_cache(maxsize=16)  # called for each node after each change of the store
def _read_profile(path: Path, folders: tuple[Path, ...], _changed: int, _second: int) -> Profile:
    return load_profile(path, folders)


def _wrong(part: str, text: str) -> UsageError:
    return UsageError(
        f"{part!r} in {text!r} does not select nodes.",
        hint="Use all, a group, type:PROFILE, name:GLOB, group:NAME or 'angle >= 360 deg', joined by commas.",
    )
