"""A station's rows about its plant: roster, pages, and what follows from them (contract/plant.md).

Stations are named by fingerprint here and by a small number (``chain``) in the rows: there may be a million of them.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

from teds_provision.station.store.database import PAGE, Database, places
from teds_provision.station.store.records import utc_now

_LEVEL: Final = 3  # zlib: a page of 500 kB in 5 ms, to a fifth of its octets


@dataclass(frozen=True)
class PlantRecord:
    """Membership of this station in a registry (a UUIDv4): since when, and how far it has read.

    ``left``: since when it no longer takes part. ``url``: where PostgreSQL is, ``file:`` and a folder, or None.
    ``acknowledged``: the number of its newest page that was seen in the registry. ``restored``: since when the home is
    one that a backup rebuilt and that has not adopted its own pages yet.
    """

    registry: str
    joined: str = field(default_factory=utc_now)
    left: str | None = None
    url: str | None = None
    synced: str | None = None
    acknowledged: int = 0
    restored: str | None = None
    restored_mac: bytes | None = field(default=None, repr=False, compare=False)
    mac: bytes | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class RosterRow:
    """A roster that the CA signed; ``held``: the one that counts. Others are kept as proof of two of one version."""

    version: int
    hash: str
    octets: bytes = field(repr=False)
    held: bool
    at: str
    mac: bytes | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Alarm:
    """Something that a person has to decide, or must know: junk, fork, two histories, two rosters, rolled back."""

    code: str
    about: str
    n: int
    why: str
    at: str = field(default_factory=utc_now)
    seen: bool = False


@dataclass(frozen=True)
class Chain:
    """Pages of one station: ``counted`` of them count (the newest by number and H), ``folded`` are in the claims.

    ``accepted``: the branch that an operator chose if there are two histories. ``waits``: why it is not read on.
    """

    chain: int
    station: str
    counted: tuple[int, str] = (0, "")
    folded: tuple[int, str] = (0, "")
    accepted: tuple[int, str] | None = None
    waits: str | None = None


@dataclass(frozen=True)
class PageRow:
    """A signed page as it is kept: its parts give the octets that came (``protocol.plant.document.join``)."""

    n: int
    hash: str
    previous: str
    created: str
    home: str
    header: bytes = field(repr=False)
    content: bytes = field(repr=False)
    signature: bytes = field(repr=False)


_PLANT = ", ".join(column.name for column in fields(PlantRecord))
_ALARM = ", ".join(column.name for column in fields(Alarm))
_CHAIN = "chain, station, counted, counted_hash, folded, folded_hash, accepted, accepted_hash, waits"


class PlantTables:
    """The part of the store that is about the plant; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    # -- what this station has to do with it -----------------------------------------------------------------------

    def plant(self) -> PlantRecord | None:
        """Return the plant that this station joined, None if it never did."""
        return self._database.read_one(PlantRecord, f"SELECT {_PLANT} FROM plant WHERE one = 1")

    def put_plant(self, record: PlantRecord) -> None:
        """Keep what this station joined."""
        values = tuple(getattr(record, column.name) for column in fields(PlantRecord))
        self._database.execute(f"INSERT OR REPLACE INTO plant(one, {_PLANT}) VALUES(1, {places(values)})", values)

    def forget_plant(self) -> None:
        """Take away everything of a registry: this station joins another one. Jobs, units and evidence stay."""
        with self._database.together():
            for table in (
                "plant", "rosters", "alarms", "outbox", "heads", "event_ids", "claims", "digests", "statements",
                "conflicts", "to_judge", "pages", "chains", "parcels", "shared",
            ):  # fmt: skip
                self._database.execute(f"DELETE FROM {table}")
            self._database.execute("DELETE FROM meta WHERE name IN ('plant-returned', 'plant-seen-heads')")

    def returned_state(self) -> str:
        """Return the digest of what the database and this store had of stations that left, at the last comparison."""
        rows = self._database.execute("SELECT value FROM meta WHERE name = 'plant-returned'")
        return str(rows[0][0]) if rows else ""

    def put_returned_state(self, digest: str) -> None:
        """Keep that digest: while it stays the same, there is nothing to take and nothing to hand in."""
        self._database.execute("INSERT OR REPLACE INTO meta VALUES('plant-returned', ?)", (digest,))

    def held_roster(self) -> RosterRow | None:
        """Return the roster that counts."""
        return self._database.read_one(
            _roster, "SELECT version, hash, octets, held, at, mac FROM rosters WHERE held = 1"
        )

    def rosters(self) -> list[RosterRow]:
        """Return every roster that is kept, by version."""
        return self._database.read(
            _roster, "SELECT version, hash, octets, held, at, mac FROM rosters ORDER BY version, hash"
        )

    def put_roster(self, row: RosterRow) -> None:
        """Keep a roster; one that is ``held`` takes the place of the one that was."""
        with self._database.together():
            if row.held:
                self._database.execute("UPDATE rosters SET held = 0 WHERE held = 1")
            values = (row.version, row.hash, row.octets, int(row.held), row.at, row.mac)
            self._database.execute("INSERT OR REPLACE INTO rosters VALUES(?, ?, ?, ?, ?, ?)", values)

    def alarms(self) -> list[Alarm]:
        """Return every alarm, oldest first."""
        return self._database.read(_alarm, f"SELECT {_ALARM} FROM alarms ORDER BY at, code, about, n")

    def put_alarm(self, alarm: Alarm, *, again: bool = False) -> bool:
        """Keep an alarm; False if it exists already (it keeps its time, and stays seen).

        ``again``: this is one more occurrence, and no state that lasts, so one that was seen is raised again.
        """
        values = (alarm.code, alarm.about, alarm.n, alarm.why, alarm.at, int(alarm.seen))
        with self._database.together():
            if again:
                self._database.execute(
                    "DELETE FROM alarms WHERE code = ? AND about = ? AND n = ? AND seen = 1", values[:3]
                )
            return self._database.change(f"INSERT OR IGNORE INTO alarms({_ALARM}) VALUES({places(values)})", values) > 0

    def end_alarm(self, alarm: Alarm) -> None:
        """Take one alarm away whose cause is gone."""
        self._database.execute(
            "DELETE FROM alarms WHERE code = ? AND about = ? AND n = ?", (alarm.code, alarm.about, alarm.n)
        )

    def end_alarms(self, code: str, about: str) -> int:
        """Take alarms away whose cause is gone; returns how many."""
        return self._database.change("DELETE FROM alarms WHERE code = ? AND about = ?", (code, about))

    def end_alarms_of(self, code: str) -> int:
        """Take all alarms of one code away; returns how many."""
        return self._database.change("DELETE FROM alarms WHERE code = ?", (code,))

    def see_alarms(self) -> int:
        """Note that a person knows of every alarm; returns of how many he did not."""
        return self._database.change("UPDATE alarms SET seen = 1 WHERE seen = 0", ())

    def seen_heads(self) -> set[tuple[str, str, int, str]]:
        """Return the heads (see :meth:`heads`) that a person has acknowledged."""
        row = self._database.one("SELECT value FROM meta WHERE name = 'plant-seen-heads'")
        return {(who, about, n, hash) for who, about, n, hash in json.loads(row[0])} if row is not None else set()

    def see_heads(self, heads: Iterable[tuple[str, str, int, str]]) -> None:
        """Note the heads that a person knows of, in place of those before."""
        value = json.dumps(sorted(heads), separators=(",", ":"))
        self._database.execute("INSERT OR REPLACE INTO meta VALUES('plant-seen-heads', ?)", (value,))

    def login(self) -> tuple[bytes, bytes] | None:
        """Return the wrapped secret of this station's login and the request that was made with it."""
        rows = self._database.execute("SELECT name, value FROM meta WHERE name LIKE 'registry-%'")
        kept = dict(rows)
        if "registry-login" not in kept or "registry-request" not in kept:
            return None
        return bytes.fromhex(kept["registry-login"]), kept["registry-request"].encode()

    def put_login(self, wrapped: bytes, request: bytes) -> None:
        """Keep the wrapped secret of this station's login, and the request that was made with it."""
        with self._database.together():
            for name, value in (("registry-login", wrapped.hex()), ("registry-request", request.decode())):
                self._database.execute("INSERT OR REPLACE INTO meta VALUES(?, ?)", (name, value))

    def doors(self) -> list[str]:
        """Return what the database allowed and should not, at the last sync that looked."""
        row = self._database.one("SELECT value FROM meta WHERE name = 'plant-doors'")
        return list(json.loads(row[0])) if row is not None else []

    def put_doors(self, doors: Sequence[str]) -> None:
        """Keep what the database allows and should not."""
        if self.doors() != list(doors):
            self._database.execute("INSERT OR REPLACE INTO meta VALUES('plant-doors', ?)", (json.dumps(list(doors)),))

    # -- what this station says ------------------------------------------------------------------------------------

    def add_event(self, id: str, event: str, uuid: bytes | None) -> None:
        """Keep an event until a page contains it; its node is judged again at the next fold."""
        with self._database.together():
            self._database.execute("INSERT INTO outbox(id, event) VALUES(?, ?)", (id, event))
            if uuid is not None:
                self._database.execute("INSERT OR IGNORE INTO to_judge VALUES(?)", (uuid,))

    def outbox(self, most: int) -> list[tuple[int, str, str]]:
        """Return the oldest events that wait for a page: number, id, JSON."""
        return self._database.execute("SELECT seq, id, event FROM outbox ORDER BY seq LIMIT ?", (most,))

    def unsent(self, station: str) -> int:
        """Return how many events of this station (a fingerprint) the registry has not acknowledged.

        They wait for a page, or are in a page newer than the last acknowledged one. A station that is connected to no
        registry gets no acknowledgement, so only the events without a page count.
        """
        waiting = int(self._database.execute("SELECT count(*) FROM outbox")[0][0])
        record, chain = self.plant(), self.chains().get(station)
        if record is None or record.url is None or chain is None:
            return waiting
        pages = self.each_page(chain.chain, record.acknowledged)
        return waiting + sum(len(json.loads(page.content).get("events", ())) for page in pages)

    def drop_events(self, ids: Iterable[str]) -> None:
        """Remove events that a page contains from the outbox."""
        self._database.execute_many("DELETE FROM outbox WHERE id = ?", [(event_id,) for event_id in ids])

    # -- chains and pages ------------------------------------------------------------------------------------------

    def chains(self) -> dict[str, Chain]:
        """Return every chain, by the fingerprint of its station."""
        return {chain.station: chain for chain in self._database.recall(_chain, f"SELECT {_CHAIN} FROM chains")}

    def chain(self, station: str) -> Chain:
        """Return one chain, which begins here if there is none."""
        found = self.chains().get(station)
        if found is not None:
            return found
        with self._database.together():
            self._database.execute("INSERT OR IGNORE INTO chains(station) VALUES(?)", (station,))
            return self.chains()[station]

    def put_chain(self, chain: Chain) -> None:
        """Keep how far a chain counts."""
        accepted = chain.accepted or (None, None)
        values = (chain.chain, chain.station, *chain.counted, *chain.folded, *accepted, chain.waits)
        self._database.execute(
            f"INSERT INTO chains({_CHAIN}) VALUES({places(values)}) ON CONFLICT(chain) DO UPDATE SET "
            + ", ".join(f"{name} = excluded.{name}" for name in _CHAIN.split(", ")[2:]),
            values,
        )

    def add_page(self, chain: int, page: PageRow) -> None:
        """Keep a page; the same again changes nothing."""
        content = zlib.compress(page.content, _LEVEL)
        self._database.execute(
            "INSERT OR IGNORE INTO pages VALUES(?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (chain, page.n, page.hash, page.previous, page.created, page.home, page.header, content, page.signature,
             utc_now()),
        )  # fmt: skip

    def page_names(self, chain: int) -> list[tuple[int, str, str]]:
        """Return number, H and ``previous`` of every page of a chain, both histories if there are two."""
        return self._database.execute("SELECT n, hash, previous FROM pages WHERE chain = ? ORDER BY n, hash", (chain,))

    def page_times(self, chain: int, most: int) -> list[tuple[int, str, str, str]]:
        """Return number, H, ``created`` and ``home`` of the newest pages of a chain, newest first."""
        return self._database.execute(
            "SELECT n, hash, created, home FROM pages WHERE chain = ? ORDER BY n DESC, hash LIMIT ?", (chain, most)
        )

    def page_newest(self) -> list[tuple[str, str]]:
        """Return the own time of every station's newest page: the one of the highest number."""
        found = self._database.execute(
            "SELECT station, created, max(n) FROM pages JOIN chains USING(chain) GROUP BY station"
        )
        return [(station, created) for station, created, _ in found]

    def page(self, chain: int, n: int, hash: str) -> PageRow | None:
        """Return one page."""
        rows = self._database.read(
            _page,
            "SELECT n, hash, previous, created, home, header, content, signature FROM pages"
            " WHERE chain = ? AND n = ? AND hash = ?",
            (chain, n, hash),
        )
        return rows[0] if rows else None

    def each_page(self, chain: int, after: int = 0) -> Iterator[PageRow]:
        """Give the pages of a chain above a number, both histories, one at a time."""
        for n, hash, _ in self.page_names(chain):
            if n > after and (page := self.page(chain, n, hash)) is not None:
                yield page

    def put_heads(self, chain: int, heads: Mapping[str, tuple[int, str]]) -> None:
        """Keep the heads that a station reports as verified, the greatest of each chain."""
        self._database.execute_many(
            "INSERT INTO heads VALUES(?, ?, ?, ?) ON CONFLICT(chain, about) DO UPDATE SET n = excluded.n,"
            " hash = excluded.hash WHERE excluded.n > heads.n",
            [(chain, about, n, hash) for about, (n, hash) in heads.items()],
        )

    def heads(self) -> list[tuple[str, str, int, str]]:
        """Return what stations report of each other: reporter, chain, the newest page that it verified and its H."""
        return self._database.execute(
            "SELECT station, about, n, hash FROM heads JOIN chains USING(chain) ORDER BY about, n DESC, station"
        )

    # -- claims ----------------------------------------------------------------------------------------------------

    def known_ids(self, chain: int, ids: Sequence[int]) -> set[int]:
        """Return those of these event ids that the chain contained before."""
        known: set[int] = set()
        for start in range(0, len(ids), PAGE):
            part = ids[start : start + PAGE]
            rows = self._database.execute(
                f"SELECT id FROM event_ids WHERE chain = ? AND id IN ({places(part)})", (chain, *part)
            )
            known.update(row[0] for row in rows)
        return known

    def add_ids(self, chain: int, ids: Iterable[int]) -> None:
        """Note the ids of events that were folded."""
        self._database.execute_many(
            "INSERT OR IGNORE INTO event_ids VALUES(?, ?)", ((chain, event_id) for event_id in ids)
        )

    def claims_of_chain(self, chain: int, uuids: Sequence[bytes]) -> dict[bytes, str]:
        """Return what a station claims of these nodes, JSON."""
        found: dict[bytes, str] = {}
        for start in range(0, len(uuids), PAGE):
            part = uuids[start : start + PAGE]
            found.update(
                self._database.execute(
                    f"SELECT uuid, claim FROM claims WHERE chain = ? AND uuid IN ({places(part)})", (chain, *part)
                )
            )
        return found

    def claims_of(self, uuids: Sequence[bytes]) -> dict[bytes, dict[str, str]]:
        """Return what stations (fingerprints) claim of a page of nodes, JSON."""
        found: dict[bytes, dict[str, str]] = {}
        rows = self._database.execute(
            f"SELECT uuid, station, claim FROM claims JOIN chains USING(chain) WHERE uuid IN ({places(uuids)})", uuids
        )
        for uuid, station, claim in rows:
            found.setdefault(uuid, {})[station] = claim
        return found

    def claimed_nodes(self, after: bytes, most: int) -> list[bytes]:
        """Return nodes with a claim of any station, by UUID, a batch at a time."""
        rows = self._database.execute(
            "SELECT DISTINCT uuid FROM claims WHERE uuid > ? ORDER BY uuid LIMIT ?", (after, most)
        )
        return [row[0] for row in rows]

    def put_claims(self, chain: int, claims: Mapping[bytes, str]) -> None:
        """Keep a station's claims about nodes, and queue those to be judged again."""
        self._database.execute_many(
            "INSERT OR REPLACE INTO claims VALUES(?, ?, ?)", ((uuid, chain, claim) for uuid, claim in claims.items())
        )
        self._database.execute_many("INSERT OR IGNORE INTO to_judge VALUES(?)", ((uuid,) for uuid in claims))

    def forget_claims(self, chain: int) -> None:
        """Remove everything that was folded of a chain, to fold it again."""
        with self._database.together():
            self._database.execute("INSERT OR IGNORE INTO to_judge SELECT uuid FROM claims WHERE chain = ?", (chain,))
            for table in ("claims", "event_ids", "digests", "statements"):
                self._database.execute(f"DELETE FROM {table} WHERE chain = ?", (chain,))

    def put_digests(self, chain: int, rows: Iterable[tuple[bytes, int, bool, bytes | None]]) -> None:
        """Keep digests of datasheets that a station signed or vouched for: digest, page, vouched, seal."""
        self._database.execute_many(
            "INSERT OR IGNORE INTO digests VALUES(?, ?, ?, ?, ?)",
            ((digest, chain, n, int(vouched), mac) for digest, n, vouched, mac in rows),
        )

    def digest_words(self, digest: bytes) -> list[tuple[str, int, bool, bytes | None]]:
        """Return who signed (or vouched for) the datasheet of this digest, on which page of its chain."""
        rows = self._database.execute(
            "SELECT station, n, vouched, mac FROM digests JOIN chains USING(chain) WHERE digest = ?", (digest,)
        )
        return [(station, n, bool(vouched), mac) for station, n, vouched, mac in rows]

    def all_digests(self) -> Iterator[tuple[bytes, str, int, bool, bytes | None]]:
        """Return every digest: who signed (or vouched for) it, on which page, and the seal."""
        rows = self._database.execute("SELECT digest, station, n, vouched, mac FROM digests JOIN chains USING(chain)")
        return ((digest, station, n, bool(vouched), mac) for digest, station, n, vouched, mac in rows)

    def all_liftings(self) -> list[tuple[str, str, bytes | None]]:
        """Return every lifting: H of the ban, who lifted it, and the seal."""
        return self._database.execute(
            "SELECT hash, station, mac FROM statements JOIN chains USING(chain) WHERE lifts = 1"
        )

    def put_ban(self, hash: str, chain: int, *, counts: bool, uuid: bytes, statement: str) -> None:
        """Keep a ban from a page (its signed text, which proves itself), and whether such a page counts."""
        self._database.execute(
            "INSERT INTO statements VALUES(?, ?, 0, ?, ?, ?, NULL) ON CONFLICT(hash, chain, lifts) DO UPDATE"
            " SET counts = max(counts, excluded.counts)",
            (hash, chain, int(counts), uuid, statement),
        )
        self._database.execute("INSERT OR IGNORE INTO to_judge VALUES(?)", (uuid,))

    def put_lifting(self, hash: str, chain: int, mac: bytes) -> None:
        """Keep that a station lifts a ban (by H), on a page that counts."""
        self._database.execute("INSERT OR IGNORE INTO statements VALUES(?, ?, 1, 1, NULL, '', ?)", (hash, chain, mac))
        self._database.execute(
            "INSERT OR IGNORE INTO to_judge SELECT uuid FROM statements"
            " WHERE hash = ? AND lifts = 0 AND uuid IS NOT NULL",
            (hash,),
        )

    def bans_of(self, uuids: Sequence[bytes]) -> list[tuple[bytes, str, str, bool, str]]:
        """Return the bans of a page of nodes: UUID, H, on whose pages, whether one of them counts, the signed text."""
        rows = self._database.execute(
            "SELECT uuid, hash, station, counts, statement FROM statements JOIN chains USING(chain)"
            f" WHERE lifts = 0 AND uuid IN ({places(uuids)}) ORDER BY uuid, hash, station",
            uuids,
        )
        return [(uuid, hash, station, bool(counts), statement) for uuid, hash, station, counts, statement in rows]

    def liftings_of(self, hash: str) -> list[tuple[str, bytes | None]]:
        """Return who lifts a ban (by H), and the seal of that row."""
        return self._database.execute(
            "SELECT station, mac FROM statements JOIN chains USING(chain) WHERE hash = ? AND lifts = 1", (hash,)
        )

    def put_conflicts(self, conflicts: Mapping[bytes, Mapping[str, str]]) -> None:
        """Keep the conflicts of each of these nodes (a page of them), in place of those that were."""
        uuids = list(conflicts)
        self._database.execute(f"DELETE FROM conflicts WHERE uuid IN ({places(uuids)})", uuids)
        self._database.execute_many(
            "INSERT INTO conflicts VALUES(?, ?, ?)",
            [(uuid, name, detail) for uuid, found in conflicts.items() for name, detail in found.items()],
        )

    def conflicts(self, uuid: bytes | None = None) -> list[tuple[bytes, str, str]]:
        """Return conflicts, of one node or of all: UUID, name, detail."""
        which, values = ("", ()) if uuid is None else ("WHERE uuid = ?", (uuid,))
        return self._database.execute(f"SELECT uuid, conflict, detail FROM conflicts {which} ORDER BY uuid", values)

    def to_judge(self, most: int) -> list[bytes]:
        """Return nodes that are to be judged again."""
        return [row[0] for row in self._database.execute("SELECT uuid FROM to_judge ORDER BY uuid LIMIT ?", (most,))]

    def queue_judging_of_all(self) -> None:
        """Queue every node with a claim or a ban to be judged again."""
        with self._database.together():
            self._database.execute("INSERT OR IGNORE INTO to_judge SELECT DISTINCT uuid FROM claims")
            self._database.execute(
                "INSERT OR IGNORE INTO to_judge SELECT DISTINCT uuid FROM statements WHERE uuid IS NOT NULL"
            )

    def note_judged(self, uuids: Iterable[bytes]) -> None:
        """Remove these nodes from the queue."""
        self._database.execute_many("DELETE FROM to_judge WHERE uuid = ?", ((uuid,) for uuid in uuids))


def _roster(version: int, hash: str, octets: bytes, held: int, at: str, mac: bytes | None) -> RosterRow:
    return RosterRow(version, hash, octets, bool(held), at, mac)


def _alarm(*row: Any) -> Alarm:
    return Alarm(row[0], row[1], row[2], row[3], row[4], bool(row[5]))


def _chain(*row: Any) -> Chain:
    accepted = (row[6], row[7]) if row[6] is not None else None
    return Chain(row[0], row[1], (row[2], row[3]), (row[4], row[5]), accepted, row[8])


def _page(*row: Any) -> PageRow:
    n, hash, previous, created, home, header, content, signature = row
    return PageRow(n, hash, previous, created, home, header, zlib.decompress(content), signature)
