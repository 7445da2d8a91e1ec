"""Small plants in memory: stations with keys, a CA, pages; and what a reader of some of the pages makes of them."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from teds_provision.protocol.handover.revocation import open_revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.chain import CountedPages, counting
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.merged_claims import BanStatement, LocalState, MergedClaims, merge_claims
from teds_provision.protocol.plant.page import Page, PageDraft, open_page, sign_page
from teds_provision.protocol.plant.roster import Member, Place, RemovedMember, Roster, open_roster, seal_roster
from teds_provision.protocol.plant.signer import SignatureClaim, SignerVerdict, signing

REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
CA = SoftwareKey(0xCA)
NODES = [bytes([n] * 10) for n in range(1, 4)]


def certificate(key: SoftwareKey) -> bytes:
    return CA.sign(station_key_message(key.point))


def at(second: int) -> str:
    return (NOW + timedelta(seconds=second)).strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass
class Speaker:
    """A station that writes pages: its key, roles, and all pages, of two histories where it has two."""

    name: str
    key: SoftwareKey
    roles: frozenset[str]
    pages: list[bytes] = field(default_factory=list)
    head: Place = (0, "")
    ids: int = 0

    @property
    def fingerprint(self) -> str:
        return fingerprint(self.key.point)

    def event(self, act: str, uuid: bytes | None, second: int = 0, **members: Any) -> dict[str, Any]:
        self.ids += 1
        return event.made(act, f"{self.ids:016x}", at(second), uuid, members)

    def page(self, *events: Mapping[str, Any], heads: Mapping[str, Place] = {}, after: Place | None = None) -> Place:
        """Write the next page, or another one after an earlier place."""
        n, previous = self.head if after is None else after
        draft = PageDraft(REGISTRY, n + 1, previous, "0" * 16, NOW, heads, (1, "0" * 64))
        octets = sign_page(draft, events, self.key)
        self.pages.append(octets)
        opened = open_page(octets, REGISTRY, lambda kid: self.key.point)
        self.head = opened.number, opened.hash
        return self.head


def speaker(name: str, *roles: str) -> Speaker:
    return Speaker(name, SoftwareKey(1 + int.from_bytes(name.encode(), "big") % (1 << 200)), frozenset(roles))


def roster_of(
    members: Sequence[Speaker], removed: Sequence[tuple[Speaker, Place]] = (), *, version: int = 1, **signed: Place
) -> Roster:
    draft = Roster(
        REGISTRY, "plant", version, "" if version == 1 else "ab" * 32, NOW, NOW + timedelta(days=90),
        tuple(Member(speaker.name, speaker.key.point, certificate(speaker.key), speaker.roles, signed.get(speaker.name))
              for speaker in members),
        tuple(RemovedMember(speaker.name, speaker.key.point, speaker.roles, "stolen", last, signed.get(speaker.name))
              for speaker, last in removed),
    )  # fmt: skip
    return open_roster(seal_roster(draft, CA), CA.point)


class Reader:
    """What somebody makes of a set of pages, with the pure functions alone: the oracle of the store's fold."""

    def __init__(self, roster: Roster, pages: Iterable[bytes], accepted: Mapping[str, Place] = {}) -> None:
        self.roster = roster
        self.pages: dict[str, dict[Place, Page]] = {}
        for octets in pages:
            page = open_page(octets, REGISTRY, roster.point_of)
            self.pages.setdefault(page.station, {})[page.number, page.hash] = page
        self.counting: dict[str, CountedPages] = {}
        self.claims: dict[bytes, dict[str, Claim]] = {}
        self.words: dict[str, list[SignatureClaim]] = {}
        self.statements: dict[bytes, list[BanStatement]] = {}
        self.liftings: dict[str, set[str]] = {}
        for station, there in sorted(self.pages.items()):
            self._fold(station, there, accepted.get(station))

    def _fold(self, station: str, there: dict[Place, Page], accepted: Place | None) -> None:
        removed = self.roster.removed_one(station)
        names = [(page.number, page.hash, page.previous) for page in there.values()]
        counts = counting(names, last=removed.last if removed else None, accepted=accepted)
        self.counting[station] = counts
        seen: set[str] = set()
        for place in counts.pages:
            for item in map(event.read, there[place].events):
                if not isinstance(item, event.Event) or item.id in seen:
                    continue
                seen.add(item.id)
                self._take(station, place, item)
        for place, page in sorted(there.items()):
            for read_event in map(event.read, page.events):
                if isinstance(read_event, event.Event) and read_event.act == "revoked" and read_event.uuid is not None:
                    revocation = open_revocation(read_event.members["statement"], self.roster.point_of)
                    held = BanStatement(
                        event.hash_of_statement(revocation.statement), station, place in counts.pages, revocation
                    )
                    if held not in self.statements.setdefault(read_event.uuid, []):
                        self.statements[read_event.uuid].append(held)

    def _take(self, station: str, place: Place, stated: event.Event) -> None:
        if stated.act in ("signed", "vouched"):
            word = SignatureClaim(station, place[0], stated.act == "vouched")
            self.words.setdefault(stated.members["teds_sha256"], []).append(word)
        elif stated.act == "lifted":
            self.liftings.setdefault(stated.members["of"], set()).add(station)
        elif stated.uuid is not None:
            self.claims.setdefault(stated.uuid, {}).setdefault(station, Claim()).apply_event(stated)

    def view(self, uuid: bytes, own: LocalState | None = None) -> MergedClaims:
        own = own or LocalState("f" * 64)
        claims, statements = self.claims.get(uuid, {}), self.statements.get(uuid, [])
        return merge_claims(self.roster, claims, own, statements, self.liftings)

    def signing(self, signer: str, digest: str) -> SignerVerdict:
        behind = any(
            place[0] > self.counted(about)
            for station, pages in self.pages.items()
            if self.roster.member(station)
            for page in pages.values()
            for about, place in page.heads.items()
            if "keeper" in self.roster.roles_of(about)
        )
        counted = {station: counts.newest[0] for station, counts in self.counting.items()}
        words = self.words.get(digest, [])
        return signing(
            self.roster,
            signer,
            words,
            counted=counted,
            keepers_behind="a page is missing" if behind else "",
            added=False,
        )

    def counted(self, station: str) -> int:
        return self.counting[station].newest[0] if station in self.counting else 0


def shuffled(pages: Sequence[bytes], seed: int) -> list[bytes]:
    mixed = list(pages)
    random.Random(seed).shuffle(mixed)
    return mixed
