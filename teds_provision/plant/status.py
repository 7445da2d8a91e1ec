"""The plant for people: the state of each station, decisions to take, events (section 8)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from operator import itemgetter
from typing import Any, Final, TypeVar

from teds_provision.errors import NotFoundError, UsageError
from teds_provision.plant.apply_pages import AT_ONCE, counted_places, heads_digest, merged_views, now, require_roster
from teds_provision.protocol.handover.strict_json import load_exact
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.merged_claims import FirmwareClaim, MergedClaims
from teds_provision.protocol.plant.roster import WARN_BEFORE, Member, Roster
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.pages import Chain
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord

SILENT: Final = timedelta(days=7)
"""A station whose newest page that counts is older than this is silent."""
SHORTEST: Final = 4
"""So many digits of a UUID name a node."""
_Stated = TypeVar("_Stated")


@dataclass(frozen=True)
class StationStanding:
    """State of a station: its newest page that counts, since when (seconds), and in a word."""

    name: str
    fingerprint: str
    roles: tuple[str, ...]
    number: int
    age: int | None
    state: str


@dataclass(frozen=True)
class PlantStatus:
    """The plant at one moment; ``standings`` of members, then of removed ones."""

    record: PlantRecord
    roster: Roster
    standings: tuple[StationStanding, ...]
    unsent: int
    conflicts: int
    alarms: tuple[Alarm, ...]
    heads: tuple[str, int]
    at: datetime

    @property
    def expired(self) -> bool:
        """True if the roster has expired."""
        return self.at >= self.roster.expires

    @property
    def expires_soon(self) -> bool:
        """True if its end is near enough for a warning."""
        return self.at >= self.roster.expires - WARN_BEFORE

    @property
    def exit_code(self) -> int:
        """0, 4 with alarms that are not seen, 6 if the roster has expired or this station was removed."""
        removed = not any(standing.state == "here" for standing in self.standings)
        return 6 if self.expired or removed else 4 if any(not alarm.seen for alarm in self.alarms) else 0


def moment(roster: Roster) -> datetime:
    """Return the present time, but none before the roster was made: a clock that was put back changes nothing."""
    return max(now(), roster.created)


def status(station: Station, record: PlantRecord, roster: Roster) -> PlantStatus:
    """Look at the store alone; no connection is opened."""
    at = moment(roster)
    chains = station.plant.pages.chains()
    return PlantStatus(
        record,
        roster,
        tuple(_standing(station, member, chains.get(member.fingerprint), at) for member in roster.by_key.values()),
        station.plant.unsent(),
        len({uuid for uuid, _, _ in station.plant.claims.conflicts()}),
        tuple(station.plant.alarms.all()),
        heads_digest(station),
        at,
    )


def _standing(station: Station, member: Any, chain: Chain | None, at: datetime) -> StationStanding:
    n = chain.counted[0] if chain is not None else 0
    age = None
    if chain is not None and n:
        created = next((c for number, h, c, _ in station.plant.pages.times(chain.id, 50)
                        if (number, h) == chain.counted and c), None)  # fmt: skip
        age = max(0, int((at - datetime.fromisoformat(created)).total_seconds())) if created else None
    if not isinstance(member, Member):
        state = member.why
    elif member.fingerprint == station.fingerprint:
        state = "here"
    elif chain is not None and chain.waits is not None:
        state = "newer version"
    elif any(
        alarm.code == "two-histories" and alarm.about == member.fingerprint for alarm in station.plant.alarms.all()
    ):
        state = "two histories"
    else:
        state = "nothing said" if not n else "silent" if age is None or age > SILENT.total_seconds() else "heard"
    roles = tuple(role for role in ("keeper", "line", "sign", "base", "audit") if role in member.roles)
    return StationStanding(member.name, member.fingerprint, roles, n, age, state)


@dataclass(frozen=True)
class StatedEvent:
    """An event as a station stated it, on page ``n``; ``counts``: the page does."""

    station: str
    number: int
    counts: bool
    event: dict[str, Any]


def log(
    station: Station, *, uuid: bytes | None = None, of: str | None = None, since: str | None = None
) -> Iterator[StatedEvent]:
    """Yield what stations stated, chain by chain in the order of their pages: verified when the page came in."""
    roster = require_roster(station)
    for fingerprint, chain in sorted(station.plant.pages.chains().items()):
        if of is not None and fingerprint != of:
            continue
        counted = counted_places(station, roster, chain)
        for page in station.plant.pages.each(chain.id):
            if since is not None and page.created < since:
                continue
            for value in load_exact(page.content, "A page").get("events", ()):
                read = event.read(value)
                if isinstance(read, event.Event) and uuid in (None, read.uuid):
                    yield StatedEvent(fingerprint, page.n, (page.n, page.hash) in counted, dict(read.members))


def resolve(station: Station, text: str) -> bytes:
    """Return the UUID that ``text`` means, looking in the own store first, then at what the plant's stations report.

    Raises NotFoundError, or UsageError if several nodes fit.
    """
    try:
        return station.nodes.resolve(text)
    except NotFoundError:
        found = find_named(station, text)
        if found is None:
            raise
        return found


def find_named(station: Station, text: str) -> bytes | None:
    """Return the UUID that ``text`` means to the plant's stations, None if no node fits; UsageError if several do."""
    roster = station.plant.roster
    if roster is None:
        return None
    name = text.strip()
    digits = name.lower().removeprefix("0x")
    found = [
        node["uuid"]
        for node in nodes(station, roster, name)
        if (len(digits) >= SHORTEST and node["uuid"].startswith(digits)) or node["name"] == name
    ]
    if len(found) > 1:
        raise UsageError(
            f"{text!r} matches {len(found)} nodes: {', '.join(found[:5])}.", hint="Give more digits of the UUID."
        )
    return bytes.fromhex(found[0]) if found else None


def names(station: Station, roster: Roster, uuids: Sequence[bytes]) -> dict[bytes, str]:
    """Return the names that the plant's stations gave to these nodes; nodes without one are left out."""
    found: dict[bytes, str] = {}
    for start in range(0, len(uuids), AT_ONCE):
        page = merged_views(station, roster, uuids[start : start + AT_ONCE])
        found.update((uuid, seen.name) for uuid, seen in page.items() if seen.name)
    return found


def nodes(station: Station, roster: Roster, text: str | None = None) -> Iterator[dict[str, Any]]:
    """Yield the plant's view of every node with a claim, by UUID, a batch at a time.

    ``text`` is the beginning of a UUID, or a part of the name.
    """
    after, wanted = b"", (text or "").lower()
    digits = wanted.removeprefix("0x")
    while uuids := station.plant.claims.nodes(after, AT_ONCE):
        after = uuids[-1]
        here = station.nodes.get_many(uuids)
        for uuid, seen in merged_views(station, roster, uuids).items():
            name = seen.name or ""
            if wanted and not uuid.hex().startswith(digits) and wanted not in name.lower():
                continue
            holders = {} if seen.holder is None else seen.holder[1]
            newest = max(  # a machine that joined again may have the name of its removed self
                ((w[0], roster.name_of(fingerprint), w[2]) for fingerprint, w in sorted(seen.written.items())),
                key=itemgetter(0, 1),
                default=None,
            )
            yield {
                "uuid": uuid.hex(),
                "name": seen.name,
                "says": {
                    "epoch": seen.holder[0] if seen.holder is not None else None,
                    "holders": {
                        key: [roster.name_of(fingerprint) for fingerprint in who] for key, who in holders.items()
                    },
                    "fingerprint": seen.pin,
                    "pinned_by": _by_name(roster, seen.pins),
                    "sequence": newest[0] if newest is not None else None,
                    "written_by": newest[1] if newest is not None else None,
                    "profile": newest[2] if newest is not None else None,
                    "older_than": _older_than(roster, seen, here.get(uuid)),
                    "firmware": _firmware_to_json(roster, seen.firmware[0]) if seen.firmware else None,
                    "firmware_by": _by_name(
                        roster,
                        {reported.station: _firmware_to_json(roster, reported) for reported in seen.firmware},
                    ),
                    "revoked": [roster.name_of(statement.revocation.sender) for statement in seen.bans],
                },
                "conflicts": [{"name": conflict, "why": why} for conflict, why in seen.conflicts.items()],
            }


def _by_name(roster: Roster, stated: Mapping[str, _Stated]) -> dict[str, _Stated]:
    """Return what stations stated, by their names.

    A member's name is unique; a removed station whose name the roster has twice is named with 16 digits of its key.
    """
    names = Counter(found.name for found in roster.by_key.values())
    by_name: dict[str, _Stated] = {}
    for fingerprint, value in stated.items():
        name = roster.name_of(fingerprint)
        unique = names[name] < 2 or roster.member(fingerprint) is not None
        by_name[name if unique else f"{name} ({fingerprint[:16]})"] = value
    return by_name


def _older_than(roster: Roster, seen: MergedClaims, node: NodeRecord | None) -> str | None:
    """Return the member with ``sign`` that wrote a newer datasheet than the one known here, None for none.

    It informs: a sequence is chosen by what the store and the node have, never by a claim.
    """
    if node is None or not node.sequence:
        return None
    newer = [
        (sequence, station)
        for station, (sequence, _, _) in seen.written.items()
        if sequence > node.sequence and roster.has(station, "sign")
    ]
    return roster.name_of(max(newer)[1]) if newer else None


def _firmware_to_json(roster: Roster, reported: FirmwareClaim) -> dict[str, Any]:
    """Return what a node last reported to a station; all but ``by`` and ``at`` null: it reports no firmware."""
    text, version, image = reported.runs or (None, None, None)
    number, build = version.split("+") if version is not None else (None, None)
    return {
        "text": text,
        "version": number,
        "build": None if build is None else int(build),
        "image": image,
        "by": roster.name_of(reported.station),
        "at": reported.at,
    }


def page_list(station: Station, of: str, most: int = 20) -> list[tuple[int, str, str]]:
    """Return number, H and time of the newest pages of a station, newest first: to choose a last one from."""
    chain = station.plant.pages.chain(of)
    return [(n, hash, created) for n, hash, created, _ in station.plant.pages.times(chain.id, most)]
