"""A station's part in a plant: the registry that it joined, the current roster, and its reports to others.

A station that joined none reports nothing, and statements of others count as before (contract/plant.md, rule 1).
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import PolicyError, StoreChangedError, StoreError
from teds_provision.files import read_limited, write_whole
from teds_provision.lazy import late
from teds_provision.protocol import keys
from teds_provision.station.identity import StationIdentity
from teds_provision.station.plant.alarms import Alarms
from teds_provision.station.plant.claims import Claims
from teds_provision.station.plant.line import Line
from teds_provision.station.plant.pages import Pages
from teds_provision.station.plant.parcels import Parcels
from teds_provision.station.row_macs import MacRow, RowMacs
from teds_provision.station.store.database import places
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store
from teds_provision.vault.base import Vault

if TYPE_CHECKING:
    from teds_provision.protocol.plant import claim, document, event, roster, signer
    from teds_provision.protocol.plant.roster import Role
else:  # imports cryptography, which commands that only list do not need
    event = late("teds_provision.protocol.plant.event")
    claim, document = late("teds_provision.protocol.plant.claim"), late("teds_provision.protocol.plant.document")
    roster, signer = late("teds_provision.protocol.plant.roster"), late("teds_provision.protocol.plant.signer")


HOME_FILE: Final = "registry-home"


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


_PLANT = ", ".join(column.name for column in fields(PlantRecord))
_DIGEST_OCTETS: Final = 32  # a TEDS is longer than a digest


@dataclass(frozen=True)
class SignerRules:
    """The plant's rules for signers of datasheets, at one moment; ``words`` looks one digest up.

    Plain data but for that: a list of 100,000 nodes never holds all digests, and other processes can judge by it.
    """

    roster: roster.Roster
    ca: bytes
    counted: Mapping[str, int]
    keepers_behind: str
    added: frozenset[str]
    words: Callable[[bytes], Collection[signer.SignatureClaim]]

    def signing(self, certifier: bytes | None, station_key: bytes, security_teds: bytes) -> signer.SignerVerdict | None:
        """Judge who signed a Security TEDS, or one of this SHA-256.

        None if the roster does not apply: another owner's CA, and a key not in it.
        """
        key = keys.fingerprint(station_key)
        if key not in self.roster.by_key and certifier != self.ca:
            return None
        hashed = len(security_teds) == _DIGEST_OCTETS
        digest = security_teds if hashed else hashlib.sha256(security_teds).digest()
        return signer.signing(
            self.roster,
            key,
            self.words(digest),
            counted=self.counted,
            keepers_behind=self.keepers_behind,
            added=key in self.added,
        )


class PlantConflictError(PolicyError):
    """Stations of the plant contradict each other about a node."""

    code = "conflict"


def new_home(home: Path) -> None:
    """Give a home an identifier, in a file beside the store that is in no backup."""
    write_whole(home / HOME_FILE, secrets.token_hex(8).encode() + b"\n")


class Plant:
    """A station's part in its plant, with the rows of its membership, rosters and outbox.

    ``alarms``, ``pages`` and ``claims`` hold what came from others, ``parcels`` what leaves and comes for one station,
    ``line`` jobs and evidence.
    """

    def __init__(self, store: Store, vault: Callable[[], Vault], identity: StationIdentity, row_macs: RowMacs) -> None:
        self._store = store
        self._vault = vault
        self._identity = identity
        self._row_macs = row_macs
        self._read: tuple[str, roster.Roster] | None = None
        self.alarms = Alarms(store)
        self.pages = Pages(store)
        self.claims = Claims(store, row_macs)
        self.parcels = Parcels(store)
        self.line = Line(store)

    def record(self) -> PlantRecord | None:
        """Return the plant that this station joined, also one that it left; None if it never joined one."""
        return self._store.read_one(PlantRecord, f"SELECT {_PLANT} FROM plant WHERE one = 1")

    def put_record(self, record: PlantRecord) -> None:
        """Keep what this station joined."""
        values = tuple(getattr(record, column.name) for column in fields(PlantRecord))
        self._store.execute(f"INSERT OR REPLACE INTO plant(one, {_PLANT}) VALUES(1, {places(values)})", values)

    def forget(self) -> None:
        """Take away everything of a registry: this station joins another one. Jobs, units and evidence stay."""
        with self._store.together():
            self.alarms.forget_all()
            self.claims.forget_all()
            self.pages.forget_all()
            self.parcels.forget_all()
            self._store.execute("DELETE FROM plant")
            self._store.execute("DELETE FROM rosters")
            self._store.execute("DELETE FROM outbox")
            self._store.execute("DELETE FROM meta WHERE name IN ('plant-returned', 'plant-seen-heads', 'plant-acts')")

    def join(self, registry: str, url: str | None) -> None:
        """Take part in a registry (the vault opens); all that is kept of another one is forgotten.

        Another place for the same one has acknowledged nothing yet: that pages are not there is no sign of a rollback.
        """
        mac = self._row_macs.note("plant", registry)
        before = self.record()
        if before is not None and before.registry != registry:
            self.forget()
            before = None
        record = before or PlantRecord(registry)
        moved = url is not None and record.url is not None and url != record.url
        acknowledged = 0 if moved else record.acknowledged
        self.put_record(replace(record, left=None, url=url or record.url, acknowledged=acknowledged, mac=mac))
        if before is None:
            self.put_folded_acts(event.FORMS)

    @property
    def joined(self) -> PlantRecord | None:
        """The registry that this station joined and has not left, None for none."""
        record = self.record()
        return record if record is not None and record.left is None else None

    @property
    def roster(self) -> roster.Roster | None:
        """The current roster, None if none was joined. Raises StoreChangedError if another program put it there.

        The CA signed it, whatever became of the row; the row MAC detects an old one that was put back.
        """
        record, row = self.joined, self.held_roster()
        if record is None or row is None:
            return None
        if not self._row_macs.noted("roster", row.hash, row.mac):
            raise StoreChangedError(
                "The roster in the store was changed by another program and is not trusted.",
                hint="To get it again: teds-provision registry sync",
            )
        if self._read is None or self._read[0] != row.hash:
            self._read = row.hash, roster.open_roster(row.octets, self._identity.ca)
        return self._read[1]

    def held_roster(self) -> RosterRow | None:
        """Return the roster that this station acts by, None before the first one."""
        return self._store.read_one(_roster, "SELECT version, hash, octets, held, at, mac FROM rosters WHERE held = 1")

    def rosters(self) -> list[RosterRow]:
        """Return every roster that is kept, by version."""
        return self._store.read(
            _roster, "SELECT version, hash, octets, held, at, mac FROM rosters ORDER BY version, hash"
        )

    def put_roster(self, row: RosterRow) -> None:
        """Keep a roster; one that is ``held`` takes the place of the one that was."""
        mac = self._row_macs.note("roster", row.hash) if row.held else None
        with self._store.together():
            if row.held:
                self._store.execute("UPDATE rosters SET held = 0 WHERE held = 1")
            values = (row.version, row.hash, row.octets, int(row.held), row.at, mac)
            self._store.execute("INSERT OR REPLACE INTO rosters VALUES(?, ?, ?, ?, ?, ?)", values)

    def require_role(self, role: Role, what: str, hint: str) -> None:
        """Raise PolicyError if a plant was joined and its roster does not give this station a role."""
        held = self.roster
        if held is not None and not held.has(self._identity.fingerprint, role):
            raise PolicyError(f"This station does not have the role {role} in {held.name}, so it {what}.", hint=hint)

    def removed_had(self, uuid: bytes, epoch: int, key_id: str, holders: Collection[str]) -> bool:
        """Return True if a removed station is among ``holders`` or, by claims that count, has had this link key."""
        held = self.roster
        if held is None or not held.removed:
            return False
        claims = self.claims.of_nodes([uuid]).get(uuid, {})
        said = {station: claim.Claim.from_json(text) for station, text in claims.items()}
        return any(
            removed.fingerprint in holders or claim.had_key(removed.fingerprint, (epoch, key_id), said)
            for removed in held.removed
        )

    def signer_rules(self, added: Collection[str]) -> SignerRules | None:
        """Return whose signatures count; None if no plant was joined.

        ``added``: the fingerprints of stations that a person trusts here.
        """
        held = self.roster
        if held is None:
            return None
        counted = {station: chain.counted[0] for station, chain in self.pages.chains().items()}
        behind = next(
            (
                signer.missing_pages(f"the keeper {held.name_of(about)}", held.name_of(who), n, counted.get(about, 0))
                for who, about, n, _ in self.pages.heads()
                if n > counted.get(about, 0)
                and about != self._identity.fingerprint  # a keeper always has its own chain
                and held.member(who) is not None
                and bool(held.roles_of(who) - {"audit"})
                and "keeper" in held.roles_of(about)
            ),
            "",
        )
        return SignerRules(held, self._identity.ca, counted, behind, frozenset(added) - held.by_key.keys(), self._words)

    def _words(self, digest: bytes) -> list[signer.SignatureClaim]:
        return [signer.SignatureClaim(*signed) for signed in self.claims.signers(digest)]

    # -- events that wait for the next page --------------------------------------------------------------------------

    def record_event(self, act: str, uuid: bytes | None = None, **members: object) -> None:
        """Queue an event for the plant in the transaction of the act itself: both are on the disk, or neither.

        Members as in ``protocol.plant.event.FORMS``, and ``at`` if it happened earlier. Nothing is written if no plant
        was joined.
        """
        if self.joined is None:
            return
        at = str(members.pop("at", None) or utc_now())
        self.queue_event(event.made(act, secrets.token_hex(8), at, uuid, members))

    def reports_other_firmware(self, uuid: bytes, runs: claim.Runs | None, since: str) -> bool:
        """Return True if a member saw another firmware on a node since then, by the pages that count.

        A time that is still to come is ignored: nothing that is reported now could take its place.
        """
        held = self.roster
        if held is None:
            return False
        claims = self.claims.of_nodes([uuid]).get(uuid, {})
        return any(
            seen is not None and seen[0] != runs and since <= seen[1] <= utc_now()
            for station, text in claims.items()
            if held.roles_of(station) - {"audit"} and held.member(station) is not None
            for seen in (claim.Claim.from_json(text).firmware,)
        )

    def record_name(self, uuid: bytes, name: object) -> None:
        """Report a node's name, if it is valid in a plant: 1 to 100 printable characters."""
        if self.joined is not None and document.is_name(name):
            self.record_event("named", uuid, name=name)

    def queue_event(self, members: Mapping[str, Any]) -> None:
        """Have an event that was made wait for the next page."""
        uuid = members.get("uuid")
        text = json.dumps(members, ensure_ascii=False, separators=(",", ":"))
        with self._store.together():
            self._store.execute("INSERT INTO outbox(id, event) VALUES(?, ?)", (members["id"], text))
            if uuid is not None:  # the merged claims of its node are computed again at the next fold
                self.claims.queue([bytes.fromhex(uuid)])

    def outbox(self, most: int) -> list[tuple[int, str, str]]:
        """Return the oldest events that wait for a page: number, id, JSON."""
        return self._store.execute("SELECT seq, id, event FROM outbox ORDER BY seq LIMIT ?", (most,))

    def own_events(self) -> set[str]:
        """Return the ids of every event that this station made: those that wait, and those on its pages."""
        known = {event_id for (event_id,) in self._store.execute("SELECT id FROM outbox")}
        chain = self.pages.chains().get(self._identity.fingerprint)
        if chain is None:
            return known
        for number, hash, _ in self.pages.chain_links(chain.id):
            page = self.pages.get(chain.id, number, hash)
            events = json.loads(page.content).get("events", ()) if page is not None else ()
            known |= {str(stated.get("id")) for stated in events if isinstance(stated, dict)}
        return known

    def unsent(self) -> int:
        """Return how many events of this station the registry has not acknowledged.

        They wait for a page, or are in a page newer than the last acknowledged one. A station that is connected to no
        registry gets no acknowledgement, so only the events without a page count.
        """
        waiting = int(self._store.execute("SELECT count(*) FROM outbox")[0][0])
        record, chain = self.record(), self.pages.chains().get(self._identity.fingerprint)
        if record is None or record.url is None or chain is None:
            return waiting
        place = chain.counted  # from here back: pages of a history that was given up are not sent
        while place[0] > record.acknowledged and (page := self.pages.get(chain.id, *place)) is not None:
            waiting += len(json.loads(page.content).get("events", ()))
            place = page.n - 1, page.previous
        return waiting

    def drop_events(self, ids: Iterable[str]) -> None:
        """Remove events that a page contains from the outbox."""
        self._store.execute_many("DELETE FROM outbox WHERE id = ?", [(event_id,) for event_id in ids])

    # -- the login at a registry -----------------------------------------------------------------------------------

    def login(self) -> tuple[bytes, bytes] | None:
        """Return the secret of this station's login (the vault opens), and the request that was made with it."""
        kept = self._login()
        return None if kept is None else (self._vault().unwrap(kept[0], context=self._context()), kept[1])

    def keep_login(self, secret: bytes, request: bytes) -> None:
        """Keep the secret of this station's login, wrapped as a link key is, and the request."""
        self._put_login(self._vault().wrap(secret, context=self._context()), request)

    def rewrap(self, vault: Vault) -> None:
        """Wrap that secret under the vault's newest master key."""
        kept = self._login()
        if kept is not None:
            secret = vault.unwrap(kept[0], context=self._context())
            self._put_login(vault.wrap(secret, context=self._context()), kept[1])

    def _login(self) -> tuple[bytes, bytes] | None:
        kept = dict(self._store.execute("SELECT name, value FROM meta WHERE name LIKE 'registry-%'"))
        if "registry-login" not in kept or "registry-request" not in kept:
            return None
        return bytes.fromhex(kept["registry-login"]), kept["registry-request"].encode()

    def _put_login(self, wrapped: bytes, request: bytes) -> None:
        with self._store.together():
            for name, value in (("registry-login", wrapped.hex()), ("registry-request", request.decode())):
                self._store.execute("INSERT OR REPLACE INTO meta VALUES(?, ?)", (name, value))

    def _context(self) -> bytes:
        return b"TEDS1 registry login\0" + self._store.id.encode()

    # -- what the last sync found in the registry's database ---------------------------------------------------------

    def returned_state(self) -> str:
        """Return the digest of what the database and this store had of stations that left, at the last comparison."""
        rows = self._store.execute("SELECT value FROM meta WHERE name = 'plant-returned'")
        return str(rows[0][0]) if rows else ""

    def put_returned_state(self, digest: str) -> None:
        """Keep that digest: while it stays the same, there is nothing to take and nothing to hand in."""
        self._store.execute("INSERT OR REPLACE INTO meta VALUES('plant-returned', ?)", (digest,))

    def folded_acts(self) -> frozenset[str]:
        """Return the acts that were known when the pages here were folded; a version before them noted none."""
        row = self._store.first_row("SELECT value FROM meta WHERE name = 'plant-acts'")
        return frozenset(json.loads(row[0])) if row is not None else frozenset()

    def put_folded_acts(self, acts: Iterable[str]) -> None:
        """Keep which acts the fold of the pages here knows."""
        self._store.execute("INSERT OR REPLACE INTO meta VALUES('plant-acts', ?)", (json.dumps(sorted(acts)),))

    def doors(self) -> list[str]:
        """Return what the database allowed and should not, at the last sync that looked."""
        row = self._store.first_row("SELECT value FROM meta WHERE name = 'plant-doors'")
        return list(json.loads(row[0])) if row is not None else []

    def put_doors(self, doors: Sequence[str]) -> None:
        """Keep what the database allows and should not."""
        if self.doors() != list(doors):
            self._store.execute("INSERT OR REPLACE INTO meta VALUES('plant-doors', ?)", (json.dumps(list(doors)),))

    # -- the id of this home, and a home restored from a backup ----------------------------------------------------

    @property
    def home(self) -> str:
        """16 digits that distinguish this home from a copy of it; made if they are missing. Raises StoreError."""
        path = self._store.home / HOME_FILE
        if not path.exists():
            new_home(self._store.home)
        digits = read_limited(path, 64, "name of a home").decode("ascii", "replace").strip()
        if not document.is_form("digits", digits):
            raise StoreError(f"{path} is damaged.", hint="Remove it; the next registry sync creates a new one.")
        return digits

    @property
    def restored(self) -> bool:
        """True if a backup rebuilt this home and it has not yet adopted its pages since that backup."""
        record = self.joined
        if record is None or record.restored is None:
            return False
        return self._row_macs.noted("restored", record.restored, record.restored_mac)

    def begin_restored(self) -> None:
        """Note that a backup rebuilt this home (the vault opens): it closes no page before it looked for its own."""
        record = self.record()
        if record is not None:
            at = utc_now()
            self.put_record(replace(record, restored=at, restored_mac=self._row_macs.note("restored", at)))

    def end_restored(self) -> None:
        """Record that this home has its own pages again."""
        record = self.record()
        if record is not None and record.restored is not None:
            self.put_record(replace(record, restored=None, restored_mac=None))

    # -- for doctor --------------------------------------------------------------------------------------------------

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield the rows that this station believes without verifying their signer again, for a check of their MACs."""
        record, row = self.record(), self.held_roster()
        if record is not None:
            yield "the registry that was joined", record.mac, "plant", (record.registry,)
            if record.restored is not None:
                yield "the note of a restored home", record.restored_mac, "restored", (record.restored,)
        if row is not None:
            yield f"roster {row.version}", row.mac, "roster", (row.hash,)
        yield from self.claims.mac_rows(sample)


def _roster(version: int, hash: str, octets: bytes, held: int, at: str, mac: bytes | None) -> RosterRow:
    return RosterRow(version, hash, octets, bool(held), at, mac)
