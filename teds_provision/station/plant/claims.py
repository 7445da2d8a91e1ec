"""Rows that follow from the pages that count: claims about nodes, digests of datasheets, bans, conflicts.

A row that this station believes without verifying its signer again (a digest, the lifting of a ban) has a MAC.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence

from teds_provision.station.plant.pages import Chain
from teds_provision.station.row_macs import MacRow, RowMacs
from teds_provision.station.store.database import CHUNK, places
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

_DIGITS = 16


class Claims:
    """Statements of the plant's stations, as one station has read them."""

    def __init__(self, store: Store, row_macs: RowMacs) -> None:
        self._store, self._row_macs = store, row_macs
        self._process = os.getpid()

    def known_ids(self, chain: int, ids: Sequence[int]) -> set[int]:
        """Return those of these event ids that the chain contained before."""
        known: set[int] = set()
        for start in range(0, len(ids), CHUNK):
            part = ids[start : start + CHUNK]
            rows = self._store.execute(
                f"SELECT id FROM event_ids WHERE chain = ? AND id IN ({places(part)})", (chain, *part)
            )
            known.update(row[0] for row in rows)
        return known

    def add_ids(self, chain: int, ids: Iterable[int]) -> None:
        """Note the ids of events that were folded."""
        self._store.execute_many(
            "INSERT OR IGNORE INTO event_ids VALUES(?, ?)", ((chain, event_id) for event_id in ids)
        )

    def of_station(self, chain: int, uuids: Sequence[bytes]) -> dict[bytes, str]:
        """Return what a station claims of these nodes, JSON."""
        found: dict[bytes, str] = {}
        for start in range(0, len(uuids), CHUNK):
            part = uuids[start : start + CHUNK]
            found.update(
                self._store.execute(
                    f"SELECT uuid, claim FROM claims WHERE chain = ? AND uuid IN ({places(part)})", (chain, *part)
                )
            )
        return found

    def of_nodes(self, uuids: Sequence[bytes]) -> dict[bytes, dict[str, str]]:
        """Return what stations (fingerprints) claim of a chunk of nodes, JSON."""
        found: dict[bytes, dict[str, str]] = {}
        rows = self._store.execute(
            f"SELECT uuid, station, claim FROM claims JOIN chains USING(chain) WHERE uuid IN ({places(uuids)})", uuids
        )
        for uuid, station, claim in rows:
            found.setdefault(uuid, {})[station] = claim
        return found

    def nodes(self, after: bytes, most: int) -> list[bytes]:
        """Return nodes with a claim of any station, by UUID, a chunk at a time."""
        rows = self._store.execute(
            "SELECT DISTINCT uuid FROM claims WHERE uuid > ? ORDER BY uuid LIMIT ?", (after, most)
        )
        return [row[0] for row in rows]

    def put(self, chain: int, claims: Mapping[bytes, str]) -> None:
        """Keep a station's claims about nodes, and queue those to be judged again."""
        self._store.execute_many(
            "INSERT OR REPLACE INTO claims VALUES(?, ?, ?)", ((uuid, chain, claim) for uuid, claim in claims.items())
        )
        self.queue(claims)

    def forget(self, chain: int) -> None:
        """Remove everything that was folded of a chain, to fold it again."""
        with self._store.together():
            self._store.execute("INSERT OR IGNORE INTO to_judge SELECT uuid FROM claims WHERE chain = ?", (chain,))
            self._store.execute(  # bans that this chain had lifted may count again
                "INSERT OR IGNORE INTO to_judge SELECT uuid FROM statements WHERE lifts = 0 AND uuid IS NOT NULL"
                " AND hash IN (SELECT hash FROM statements WHERE chain = ? AND lifts = 1)",
                (chain,),
            )
            self._store.execute("DELETE FROM claims WHERE chain = ?", (chain,))
            self._store.execute("DELETE FROM event_ids WHERE chain = ?", (chain,))
            self._store.execute("DELETE FROM digests WHERE chain = ?", (chain,))
            self._store.execute("DELETE FROM statements WHERE chain = ?", (chain,))

    def forget_all(self) -> None:
        """Remove everything that was folded of any chain."""
        self._store.execute("DELETE FROM event_ids")
        self._store.execute("DELETE FROM claims")
        self._store.execute("DELETE FROM digests")
        self._store.execute("DELETE FROM statements")
        self._store.execute("DELETE FROM conflicts")
        self._store.execute("DELETE FROM to_judge")

    # -- digests of datasheets that were signed, or vouched for ------------------------------------------------------

    def put_digests(self, chain: Chain, rows: Iterable[tuple[bytes, int, bool]]) -> None:
        """Keep digests of datasheets that a station signed or vouched for: digest, page, True if vouched."""
        self._store.execute_many(
            "INSERT OR IGNORE INTO digests VALUES(?, ?, ?, ?, ?)",
            [
                (digest, chain.id, n, int(vouched), self._row_macs.note(*_digest(digest, chain.station, n, vouched)))
                for digest, n, vouched in rows
            ],
        )

    def signers(self, digest: bytes) -> list[tuple[str, int, bool]]:
        """Return who signed the datasheet of this digest, on which page of its chain, and True if it was vouched for.

        Rows that another program put there are left out. May be called in a fork: a connection of SQLite is not shared.
        """
        if os.getpid() != self._process:
            self._process, self._store = os.getpid(), Store.open(self._store.home)
        rows = self._store.execute(
            "SELECT station, n, vouched, mac FROM digests JOIN chains USING(chain) WHERE digest = ?", (digest,)
        )
        return [
            (station, n, bool(vouched))
            for station, n, vouched, mac in rows
            if self._row_macs.noted(*_digest(digest, station, n, bool(vouched)), mac)
        ]

    # -- bans and their liftings -------------------------------------------------------------------------------------

    def put_ban(self, hash: str, chain: int, *, counts: bool, uuid: bytes, statement: str) -> None:
        """Keep a ban from a page (its signed text, which proves itself), and whether such a page counts."""
        self._store.execute(
            "INSERT INTO statements VALUES(?, ?, 0, ?, ?, ?, NULL) ON CONFLICT(hash, chain, lifts) DO UPDATE"
            " SET counts = max(counts, excluded.counts)",
            (hash, chain, int(counts), uuid, statement),
        )
        self.queue([uuid])

    def bans_of(self, uuids: Sequence[bytes]) -> list[tuple[bytes, str, str, bool, str]]:
        """Return the bans of a chunk of nodes: UUID, H, on whose pages, whether one of them counts, the signed text."""
        rows = self._store.execute(
            "SELECT uuid, hash, station, counts, statement FROM statements JOIN chains USING(chain)"
            f" WHERE lifts = 0 AND uuid IN ({places(uuids)}) ORDER BY uuid, hash, station",
            uuids,
        )
        return [(uuid, hash, station, bool(counts), statement) for uuid, hash, station, counts, statement in rows]

    def put_lifting(self, hash: str, chain: Chain) -> None:
        """Keep that a station lifts a ban (by H), on a page that counts."""
        mac = self._row_macs.note(*_lifting(hash, chain.station))
        self._store.execute("INSERT OR IGNORE INTO statements VALUES(?, ?, 1, 1, NULL, '', ?)", (hash, chain.id, mac))
        self._store.execute(
            "INSERT OR IGNORE INTO to_judge SELECT uuid FROM statements"
            " WHERE hash = ? AND lifts = 0 AND uuid IS NOT NULL",
            (hash,),
        )

    def lifters(self, hash: str) -> set[str]:
        """Return who lifts a ban (by H), without rows that another program put there."""
        rows = self._store.execute(
            "SELECT station, mac FROM statements JOIN chains USING(chain) WHERE hash = ? AND lifts = 1", (hash,)
        )
        return {station for station, mac in rows if self._row_macs.noted(*_lifting(hash, station), mac)}

    # -- what follows for nodes --------------------------------------------------------------------------------------

    def put_conflicts(self, conflicts: Mapping[bytes, Mapping[str, str]]) -> None:
        """Keep the conflicts of each of these nodes (a chunk of them), in place of those that were."""
        uuids = list(conflicts)
        self._store.execute(f"DELETE FROM conflicts WHERE uuid IN ({places(uuids)})", uuids)
        self._store.execute_many(
            "INSERT INTO conflicts VALUES(?, ?, ?)",
            [(uuid, name, detail) for uuid, found in conflicts.items() for name, detail in found.items()],
        )

    def conflicts(self, uuid: bytes | None = None) -> list[tuple[bytes, str, str]]:
        """Return conflicts, of one node or of all: UUID, name, detail."""
        which, values = ("", ()) if uuid is None else ("WHERE uuid = ?", (uuid,))
        return self._store.execute(f"SELECT uuid, conflict, detail FROM conflicts {which} ORDER BY uuid", values)

    def to_judge(self, most: int) -> list[bytes]:
        """Return nodes that are to be judged again."""
        return [row[0] for row in self._store.execute("SELECT uuid FROM to_judge ORDER BY uuid LIMIT ?", (most,))]

    def queue(self, uuids: Iterable[bytes]) -> None:
        """Queue nodes to be judged again."""
        self._store.execute_many("INSERT OR IGNORE INTO to_judge VALUES(?)", ((uuid,) for uuid in uuids))

    def queue_all(self) -> None:
        """Queue every node with a claim or a ban to be judged again."""
        with self._store.together():
            self._store.execute("INSERT OR IGNORE INTO to_judge SELECT DISTINCT uuid FROM claims")
            self._store.execute(
                "INSERT OR IGNORE INTO to_judge SELECT DISTINCT uuid FROM statements WHERE uuid IS NOT NULL"
            )

    def note_judged(self, uuids: Iterable[bytes]) -> None:
        """Remove these nodes from the queue."""
        self._store.execute_many("DELETE FROM to_judge WHERE uuid = ?", ((uuid,) for uuid in uuids))

    # -- for doctor --------------------------------------------------------------------------------------------------

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield digests and liftings, for a check of their MACs."""
        chosen = sample.rows(self._store, "digests", "digest")
        rows = self._store.execute(
            f"SELECT digest, station, n, vouched, mac FROM digests JOIN chains USING(chain) WHERE {chosen}"
        )
        for digest, station, n, vouched, mac in rows:
            kind, value = _digest(digest, station, n, bool(vouched))
            yield f"the digest {digest.hex()[:_DIGITS]} of a page", mac, kind, (value,)
        rows = self._store.execute("SELECT hash, station, mac FROM statements JOIN chains USING(chain) WHERE lifts = 1")
        for hash, station, mac in rows:
            kind, value = _lifting(hash, station)
            yield f"the lifting of ban {hash[:_DIGITS]} in a page", mac, kind, (value,)


def _digest(digest: bytes, station: str, n: int, vouched: bool) -> tuple[str, str]:
    return "digest", f"{digest.hex()} {station} {n} {'vouched' if vouched else 'signed'}"


def _lifting(hash: str, station: str) -> tuple[str, str]:
    return "plant lifted", f"{hash} {station}"
