"""A station's part in a plant: the registry that it joined, the current roster, and its reports to others.

A station that joined none reports nothing, and statements of others count as before (contract/plant.md, rule 1).
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import PolicyError, StoreChangedError, StoreError
from teds_provision.files import read_limited, write_whole
from teds_provision.lazy import late
from teds_provision.station.identity import StationIdentity
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.store import LineTables, Store, utc_now
from teds_provision.station.store.tables.parcels import ParcelTables
from teds_provision.station.store.tables.plant import PlantRecord

if TYPE_CHECKING:
    from teds_provision.protocol import keys
    from teds_provision.protocol.plant import claim, document, event, roster, signer
    from teds_provision.protocol.plant.roster import Role
    from teds_provision.vault import Vault
else:  # cryptography: not for commands that only list
    keys, event = late("teds_provision.protocol.keys"), late("teds_provision.protocol.plant.event")
    claim, document = late("teds_provision.protocol.plant.claim"), late("teds_provision.protocol.plant.document")
    roster, signer = late("teds_provision.protocol.plant.roster"), late("teds_provision.protocol.plant.signer")


HOME_FILE: Final = "registry-home"


@dataclass(frozen=True)
class SignerRules:
    """Whose signature under a datasheet counts in the plant, at one moment; ``words`` looks one digest up.

    Plain data but for that: a list of 100,000 nodes never holds all digests, and other processes can judge by it.
    """

    roster: roster.Roster
    ca: bytes
    counted: Mapping[str, int]
    keepers_behind: str
    added: frozenset[str]
    words: Callable[[bytes], Collection[signer.SignatureClaim]]

    def signing(self, certifier: bytes | None, station_key: bytes, digest: bytes) -> signer.SignerVerdict | None:
        """Judge who signed a datasheet; None if the roster does not apply: another owner's CA, and a key not in it."""
        key = keys.fingerprint(station_key)
        if key not in self.roster.by_key and certifier != self.ca:
            return None
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
    """The part of a station that is about the plant.

    ``tables`` are its rows, ``parcels`` those of what leaves and comes, ``line`` those of jobs and proof.
    """

    def __init__(self, store: Store, vault: Callable[[], Vault], identity: StationIdentity, seals: RowMacs) -> None:
        self.tables: Store = store
        self._vault = vault
        self.line: LineTables = store
        self.parcels: ParcelTables = store
        self._store = store
        self._identity = identity
        self._row_macs = seals
        self._read: tuple[str, roster.Roster] | None = None
        self._process = os.getpid()
        self._elsewhere: Store | None = None

    @property
    def joined(self) -> PlantRecord | None:
        """What this station joined and has not left; None if others' statements count as without a plant."""
        record = self.tables.plant()
        return record if record is not None and record.left is None else None

    @property
    def roster(self) -> roster.Roster | None:
        """The current roster, None if none was joined. Raises StoreChangedError if another program put it there.

        The CA signed it, whatever became of the row; the row MAC detects an old one that was put back.
        """
        record, row = self.joined, self.tables.held_roster()
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

    def require_role(self, role: Role, what: str, hint: str) -> None:
        """Raise PolicyError if a plant was joined and its roster does not give this station a role."""
        held = self.roster
        if held is not None and not held.has(self._identity.fingerprint, role):
            raise PolicyError(f"This station does not have the role {role} in {held.name}, so it {what}.", hint=hint)

    def require_undisputed(self, uuid: bytes) -> None:
        """Raise PlantConflictError if stations know two keys of a node that this one would key for the first time.

        It holds until a keeper, or an operator here, pins one.
        """
        if self.joined is None:
            return
        entry = self._store.whitelisted(uuid)
        own_word = entry is not None and entry.fingerprint is not None and entry.assurance != "registry"
        disputed = next((why for _, name, why in self.tables.conflicts(uuid) if name == "two keys"), None)
        if disputed is not None and not own_word and not self._store.keys(uuid):
            raise PlantConflictError(
                f"The plant's stations know two keys for node {uuid.hex()}: {disputed}.",
                hint=f"A keeper must pin one of them, or you do: whitelist add {uuid.hex()} --fingerprint F",
            )

    def removed_had(self, uuid: bytes, epoch: int, key_id: str, holders: Collection[str]) -> bool:
        """Return True if a removed station is among ``holders`` or, by claims that count, has had this link key."""
        held = self.roster
        if held is None or not held.removed:
            return False
        claims = self.tables.claims_of([uuid]).get(uuid, {})
        said = {station: claim.Claim.from_json(text) for station, text in claims.items()}
        return any(
            removed.fingerprint in holders or claim.had_key(removed.fingerprint, (epoch, key_id), said)
            for removed in held.removed
        )

    def signer_rules(self) -> SignerRules | None:
        """Return whose signatures count; None if no plant was joined."""
        held = self.roster
        if held is None:
            return None
        counted = {station: chain.counted[0] for station, chain in self.tables.chains().items()}
        behind = next(
            (
                signer.missing_pages(f"the keeper {held.name_of(about)}", held.name_of(who), n, counted.get(about, 0))
                for who, about, n, _ in self.tables.heads()
                if n > counted.get(about, 0)
                and about != self._identity.fingerprint  # a keeper knows its own chain
                and held.member(who) is not None
                and bool(held.roles_of(who) - {"audit"})
                and "keeper" in held.roles_of(about)
            ),
            "",
        )
        added = frozenset(trusted.fingerprint for trusted in self.tables.trusted() if trusted.role == "station")
        return SignerRules(held, self._identity.ca, counted, behind, added - held.by_key.keys(), self._words)

    def _words(self, digest: bytes) -> list[signer.SignatureClaim]:
        if os.getpid() != self._process:  # a fork that judges files: a connection of SQLite is not shared
            self._process, self._elsewhere = os.getpid(), Store.open(self._store.home)
        tables = self._elsewhere or self.tables
        return [
            signer.SignatureClaim(station, n, vouched)
            for station, n, vouched, mac in tables.digest_words(digest)
            if self._row_macs.noted("digest", f"{digest.hex()} {station} {n} {'vouched' if vouched else 'signed'}", mac)
        ]

    def record_event(self, act: str, uuid: bytes | None = None, **members: object) -> None:
        """Queue an event for the plant in the transaction of the act itself: both are on the disk, or neither.

        Members as in ``protocol.plant.event.FORMS``. Nothing is written if no plant was joined.
        """
        if self.joined is None:
            return
        self.queue_event(event.made(act, secrets.token_hex(8), utc_now(), uuid, members))

    def record_name(self, uuid: bytes, name: object) -> None:
        """Report a node's name, if it is valid in a plant: 1 to 100 printable characters."""
        if self.joined is not None and document.is_name(name):
            self.record_event("named", uuid, name=name)

    def queue_event(self, told: Mapping[str, Any]) -> None:
        """Have an event that was made wait for the next page."""
        uuid = told.get("uuid")
        text = json.dumps(told, ensure_ascii=False, separators=(",", ":"))
        self.tables.add_event(told["id"], text, bytes.fromhex(uuid) if uuid is not None else None)

    # -- the login at a registry -----------------------------------------------------------------------------------

    def login(self) -> tuple[bytes, bytes] | None:
        """Return the secret of this station's login (the vault opens), and the request that was made with it."""
        kept = self.tables.login()
        return None if kept is None else (self._vault().unwrap(kept[0], context=self._context()), kept[1])

    def keep_login(self, secret: bytes, request: bytes) -> None:
        """Keep the secret of this station's login, wrapped as a link key is, and the request."""
        self.tables.put_login(self._vault().wrap(secret, context=self._context()), request)

    def rewrap(self, vault: Vault) -> None:
        """Wrap that secret under the vault's newest master key."""
        kept = self.tables.login()
        if kept is not None:
            secret = vault.unwrap(kept[0], context=self._context())
            self.tables.put_login(vault.wrap(secret, context=self._context()), kept[1])

    def _context(self) -> bytes:
        return b"TEDS1 registry login\0" + self._store.id.encode()

    # -- which home this is, and one that came back from a backup --------------------------------------------------

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
        record = self.tables.plant()
        if record is not None:
            at = utc_now()
            self.tables.put_plant(replace(record, restored=at, restored_mac=self._row_macs.note("restored", at)))

    def end_restored(self) -> None:
        """Record that this home has its own pages again."""
        record = self.tables.plant()
        if record is not None and record.restored is not None:
            self.tables.put_plant(replace(record, restored=None, restored_mac=None))
