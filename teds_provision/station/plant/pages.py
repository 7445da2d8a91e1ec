"""Pages of every station of the plant, in chains, and the heads that stations report of each other.

Stations are named by fingerprint here and by a small number (``chain``) in the rows: there may be a million of them.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from teds_provision.station.store.database import places
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.store import Store

_LEVEL: Final = 3  # zlib: compresses a page of 500 kB in 5 ms to a fifth


@dataclass(frozen=True)
class Chain:
    """Pages of one station: ``counted`` of them count (the newest by number and H), ``folded`` are in the claims.

    ``accepted``: the branch that an operator chose if there are two histories. ``waits``: why it is not read on.
    """

    id: int
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


_CHAIN = "chain, station, counted, counted_hash, folded, folded_hash, accepted, accepted_hash, waits"


class Pages:
    """The pages that one station has, its own and those of others."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def forget_all(self) -> None:
        """Remove the chains of all stations, which nothing may refer to any more."""
        self._store.execute("DELETE FROM heads")
        self._store.execute("DELETE FROM pages")
        self._store.execute("DELETE FROM chains")

    def chains(self) -> dict[str, Chain]:
        """Return every chain, by the fingerprint of its station."""
        return {chain.station: chain for chain in self._store.recall(_chain, f"SELECT {_CHAIN} FROM chains")}

    def chain(self, station: str) -> Chain:
        """Return one chain, which begins here if there is none."""
        found = self.chains().get(station)
        if found is not None:
            return found
        with self._store.together():
            self._store.execute("INSERT OR IGNORE INTO chains(station) VALUES(?)", (station,))
            return self.chains()[station]

    def put_chain(self, chain: Chain) -> None:
        """Keep how far a chain counts."""
        accepted = chain.accepted or (None, None)
        values = (chain.id, chain.station, *chain.counted, *chain.folded, *accepted, chain.waits)
        self._store.execute(
            f"INSERT INTO chains({_CHAIN}) VALUES({places(values)}) ON CONFLICT(chain) DO UPDATE SET "
            + ", ".join(f"{name} = excluded.{name}" for name in _CHAIN.split(", ")[2:]),
            values,
        )

    def add(self, chain_id: int, page: PageRow) -> None:
        """Keep a page; the same again changes nothing."""
        content = zlib.compress(page.content, _LEVEL)
        self._store.execute(
            "INSERT OR IGNORE INTO pages VALUES(?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (chain_id, page.n, page.hash, page.previous, page.created, page.home, page.header, content, page.signature,
             utc_now()),
        )  # fmt: skip

    def chain_links(self, chain_id: int) -> list[tuple[int, str, str]]:
        """Return number, H and ``previous`` of every page of a chain, both histories if there are two."""
        return self._store.execute("SELECT n, hash, previous FROM pages WHERE chain = ? ORDER BY n, hash", (chain_id,))

    def times(self, chain_id: int, most: int) -> list[tuple[int, str, str, str]]:
        """Return number, H, ``created`` and ``home`` of the newest pages of a chain, newest first."""
        return self._store.execute(
            "SELECT n, hash, created, home FROM pages WHERE chain = ? ORDER BY n DESC, hash LIMIT ?", (chain_id, most)
        )

    def newest(self) -> list[tuple[str, str]]:
        """Return the own time of every station's newest page: the one of the highest number."""
        found = self._store.execute(
            "SELECT station, created, max(n) FROM pages JOIN chains USING(chain) GROUP BY station"
        )
        return [(station, created) for station, created, _ in found]

    def get(self, chain_id: int, n: int, hash: str) -> PageRow | None:
        """Return one page."""
        rows = self._store.read(
            _page,
            "SELECT n, hash, previous, created, home, header, content, signature FROM pages"
            " WHERE chain = ? AND n = ? AND hash = ?",
            (chain_id, n, hash),
        )
        return rows[0] if rows else None

    def each(self, chain_id: int, after: int = 0) -> Iterator[PageRow]:
        """Give the pages of a chain above a number, both histories, one at a time."""
        for n, hash, _ in self.chain_links(chain_id):
            if n > after and (page := self.get(chain_id, n, hash)) is not None:
                yield page

    def put_heads(self, chain_id: int, heads: Mapping[str, tuple[int, str]]) -> None:
        """Keep the heads that a station reports as verified, the greatest of each chain."""
        self._store.execute_many(
            "INSERT INTO heads VALUES(?, ?, ?, ?) ON CONFLICT(chain, about) DO UPDATE SET n = excluded.n,"
            " hash = excluded.hash WHERE excluded.n > heads.n",
            [(chain_id, about, n, hash) for about, (n, hash) in heads.items()],
        )

    def heads(self) -> list[tuple[str, str, int, str]]:
        """Return what stations report of each other: reporter, chain, the newest page that it verified and its H."""
        return self._store.execute(
            "SELECT station, about, n, hash FROM heads JOIN chains USING(chain) ORDER BY about, n DESC, station"
        )

    def seen_heads(self) -> set[tuple[str, str, int, str]]:
        """Return the heads (see :meth:`heads`) that a person has acknowledged."""
        row = self._store.first_row("SELECT value FROM meta WHERE name = 'plant-seen-heads'")
        return {(who, about, n, hash) for who, about, n, hash in json.loads(row[0])} if row is not None else set()

    def see_heads(self, heads: Iterable[tuple[str, str, int, str]]) -> None:
        """Note the heads that a person knows of, in place of those before."""
        value = json.dumps(sorted(heads), separators=(",", ":"))
        self._store.execute("INSERT OR REPLACE INTO meta VALUES('plant-seen-heads', ?)", (value,))


def _chain(*row: Any) -> Chain:
    accepted = (row[6], row[7]) if row[6] is not None else None
    return Chain(row[0], row[1], (row[2], row[3]), (row[4], row[5]), accepted, row[8])


def _page(*row: Any) -> PageRow:
    n, hash, previous, created, home, header, content, signature = row
    return PageRow(n, hash, previous, created, home, header, zlib.decompress(content), signature)
