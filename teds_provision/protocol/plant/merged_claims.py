"""The result of many stations' claims about a node: a pure function of the claims, the roster and one's own store.

Order in time does not matter (contract/plant.md sections 2 and 3), so every station that has the same pages comes to
the same view, in whatever order they reached it. Statements of others inform, and hold back what this station would do
for the first time; they take nothing away (rule 2).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.handover.revocation import Revocation
from teds_provision.protocol.plant.claim import Claim, Key, Runs
from teds_provision.protocol.plant.roster import Roster

TWO_KEYS: Final = "two keys"
TWO_HOLDERS: Final = "two holders"
OTHER_PIN: Final = "other pin"
BY_CONTACT: Final = frozenset({"tap", "bus"})


@dataclass(frozen=True)
class LocalState:
    """State of the node in this station's own store.

    ``pin`` is the key that the UUID is pinned to here, ``assurance`` how ("" for none), ``met``: the node itself showed
    it here. ``holds``: it has a link key. ``holders``: the stations that, by this store, hold or were given the node's
    key. ``lifted``: bans (H) that an operator withdrew here.
    """

    station: str
    pin: str | None = None
    assurance: str = ""
    met: bool = False
    holds: bool = False
    holders: frozenset[str] = frozenset()
    lifted: frozenset[str] = frozenset()


@dataclass(frozen=True)
class BanStatement:
    """A ban on a station's page: H, whose page, whether that page counts, what is banned and by whom."""

    hash: str
    page_of: str
    counts: bool
    revocation: Revocation


@dataclass(frozen=True)
class FirmwareClaim:
    """The firmware that a node last reported to a station in a session; ``runs`` None: it reports none."""

    station: str
    runs: Runs | None
    at: str


@dataclass(frozen=True)
class MergedClaims:
    """The plant's view of a node; stations are fingerprints.

    ``pin`` is the key that all keepers who pin it name, ``pins`` each station's pin. ``held``: which member holds which
    key; ``holder``: the highest epoch that any station claims, and who claims which key of it. ``made``: who agreed the
    key that it holds. ``conflicts`` by name, with a sentence. ``key_it``: this station may agree a key with it.
    """

    pin: str | None
    pins: Mapping[str, str]
    held: Mapping[str, Key]
    made: frozenset[str]
    holder: tuple[int, Mapping[str, tuple[str, ...]]] | None
    written: Mapping[str, tuple[int, str, str | None]]
    gave: frozenset[tuple[str, int, str, str, str, str]]
    resets: frozenset[tuple[str, int]]
    bans: tuple[BanStatement, ...]
    name: str | None
    groups: Mapping[str, bool]
    conflicts: Mapping[str, str]
    key_it: bool
    left: Mapping[str, Key] = field(default_factory=dict)
    """Removed stations that agreed the last key that they had."""
    keeper_groups: Mapping[str, bool] = field(default_factory=dict)
    own_groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    firmware: tuple[FirmwareClaim, ...] = ()
    """What each station last saw, the newest first; that of a lost or stolen station after all others'."""


def merge_claims(
    roster: Roster,
    claims: Mapping[str, Claim],
    own: LocalState,
    statements: Sequence[BanStatement] = (),
    liftings: Mapping[str, Collection[str]] = {},
) -> MergedClaims:
    """Return the view of one node.

    ``claims`` by station, of pages that count; ``liftings``: by H of a ban, who lifted it on a page that counts.
    """
    counted = {station: claim for station, claim in sorted(claims.items()) if roster.roles_of(station) - {"audit"}}
    keepers = {station for station in counted if "keeper" in roster.roles_of(station)}
    pins = {station: claim.pin[0] for station, claim in counted.items() if claim.pin is not None}
    keepers_pins = {pins[station] for station in keepers if station in pins}
    pin = next(iter(keepers_pins)) if len(keepers_pins) == 1 else None

    resets = _resets(counted, own.pin if own.pin is not None else pin)
    holdings = _holdings(roster, counted, max((epoch for _, epoch in resets), default=-1))
    epoch, holders = _holders(roster, holdings.held)
    conflicts = _pin_conflicts(roster, counted, own, pins, keepers)
    if len(holders) > 1:
        conflicts[TWO_HOLDERS] = f"epoch {epoch}: " + "; ".join(
            f"{', '.join(map(roster.name_of, stations))} hold {key_id}" for key_id, stations in holders.items()
        )
    own_word = own.met or own.holds or (own.pin is not None and own.assurance != "registry")

    names = [
        (_weight(roster, fingerprint, claim.name[1]), claim.name[0])
        for fingerprint, claim in counted.items()
        if claim.name
    ]
    return MergedClaims(
        pin=pin,
        pins=pins,
        held=holdings.held,
        made=frozenset(holdings.made),
        holder=None if epoch is None else (epoch, holders),
        written={s: (c.written[0], c.written[1], c.written[3]) for s, c in counted.items() if c.written is not None},
        gave=frozenset(
            (station, epoch, key_id, peer, mode, bundle)
            for station, claim in counted.items()
            for bundle, peer, epoch, key_id, mode in claim.given_keys()
        ),
        resets=resets,
        bans=tuple(ban for ban in sorted(statements, key=lambda seen: (seen.revocation.created, seen.hash))
                   if bans(roster, ban, own, liftings)),
        name=max(names)[1] if names else None,
        groups=_groups(roster, counted),
        conflicts=conflicts,
        key_it=TWO_KEYS not in conflicts or own_word,
        left=holdings.left,
        keeper_groups=_groups(roster, {keeper: counted[keeper] for keeper in keepers}),
        own_groups={
            station: tuple(sorted(group for group, (member, _) in claim.groups.items() if member))
            for station, claim in counted.items()
            if claim.groups
        },
        firmware=_firmware(roster, counted),
    )  # fmt: skip


def _firmware(roster: Roster, claims: Mapping[str, Claim]) -> tuple[FirmwareClaim, ...]:
    """Return the reports of a node's firmware in the order in which they are shown; no decision rests on them."""

    def place(claim: FirmwareClaim) -> tuple[bool, str, str]:
        gone = roster.removed_one(claim.station)
        return gone is None or gone.why == "retired", claim.at, claim.station

    found = [FirmwareClaim(station, *claim.firmware) for station, claim in claims.items() if claim.firmware is not None]
    return tuple(sorted(found, key=place, reverse=True))


def _resets(claims: Mapping[str, Claim], pinned: str | None) -> frozenset[tuple[str, int]]:
    """Return resets whose proof is of the key that the node is pinned to, as any owner of a board can reset it."""
    return frozenset(
        reset
        for claim in claims.values()
        for reset in claim.resets
        if pinned is not None and same_key(reset[0], pinned)
    )


@dataclass
class _Holdings:
    """Keys by station: those that members hold, who of them agreed on his himself, and what former members took."""

    held: dict[str, Key] = field(default_factory=dict)
    made: set[str] = field(default_factory=set)
    left: dict[str, Key] = field(default_factory=dict)


def _holdings(roster: Roster, claims: Mapping[str, Claim], reset_to: int) -> _Holdings:
    """Return the keys that still count: not forgotten, not given away, newer than the newest reset."""
    found = _Holdings()
    for station, claim in claims.items():
        key = claim.key()
        if key is None:
            continue
        agreed = claim.agreed is not None and claim.agreed[:2] == key
        if roster.member(station) is None:
            if agreed:
                found.left[station] = key
            continue
        given_away = any((epoch, key_id) == key and mode == "move" for _, _, epoch, key_id, mode in claim.given_keys())
        if key[0] > max(claim.forgot, reset_to) and not given_away:
            found.held[station] = key
            if agreed:
                found.made.add(station)
    return found


def _holders(roster: Roster, held: Mapping[str, Key]) -> tuple[int | None, dict[str, tuple[str, ...]]]:
    """Return the newest epoch that a station that works with nodes claims to hold, and who holds which key of it."""
    heard = {holder: key for holder, key in held.items() if roster.roles_of(holder) & {"line", "base", "keeper"}}
    newest = max((epoch for epoch, _ in heard.values()), default=None)
    found: dict[str, tuple[str, ...]] = {}
    for station, (epoch, key_id) in heard.items():
        if epoch == newest:
            found[key_id] = (*found.get(key_id, ()), station)
    return newest, found


def _pin_conflicts(
    roster: Roster, claims: Mapping[str, Claim], own: LocalState, pins: Mapping[str, str], keepers: Collection[str]
) -> dict[str, str]:
    """Return conflicts about the board's key: keepers among themselves, or any stations if no keeper has pinned it."""
    by_keepers = {station: pins[station] for station in keepers if station in pins}
    if len(set(by_keepers.values())) > 1:
        return {TWO_KEYS: "keepers pin " + _who(roster, by_keepers)}
    if by_keepers:
        pin = next(iter(by_keepers.values()))
        if own.pin is not None and not same_key(pin, own.pin):
            return {OTHER_PIN: f"keepers pin {pin[:16]}, and {own.pin[:16]} is pinned here"}
        return {}
    named = {**{s: c.agreed[2] for s, c in claims.items() if c.agreed is not None}, **pins}
    if own.pin is not None:
        named[own.station] = own.pin
    if not own.met and len(_keys(named.values())) > 1:
        return {TWO_KEYS: _who(roster, named)}
    return {}


def bans(roster: Roster, statement: BanStatement, own: LocalState, liftings: Mapping[str, Collection[str]]) -> bool:
    """Return True if a statement bans its node here.

    Its signer is a keeper, or by one's own store holds or was given the node's key; a removed one's statement counts
    only from its own pages, up to ``last``. It ends when a keeper lifts it, its signer, or here an operator.
    """
    signer = statement.revocation.sender
    if roster.member(signer) is None and (statement.page_of != signer or not statement.counts):
        return False
    if "keeper" not in roster.roles_of(signer) and signer != own.station and signer not in own.holders:
        return False
    if (
        own.pin is not None
        and statement.revocation.fingerprint is not None
        and not same_key(own.pin, statement.revocation.fingerprint)
    ):
        return False
    lifted = any(lifter == signer or "keeper" in roster.roles_of(lifter) for lifter in liftings.get(statement.hash, ()))
    return not lifted and statement.hash not in own.lifted


def _keys(named: Collection[str]) -> list[str]:
    """Return the distinct keys among fingerprints, some of which may be shortened to their first digits."""
    found: list[str] = []
    for fingerprint in sorted(named, key=lambda digits: (-len(digits), digits)):
        if not any(same_key(fingerprint, other) for other in found):
            found.append(fingerprint)
    return found


def _who(roster: Roster, named: Mapping[str, str]) -> str:
    return ", ".join(f"{key[:16]} ({roster.name_of(station)})" for station, key in sorted(named.items()))


def _weight(roster: Roster, station: str, at: str) -> tuple[bool, str, str]:
    """Return a statement's sort key: a keeper's before others', then the later time, then the higher fingerprint."""
    return "keeper" in roster.roles_of(station), at, station


def _groups(roster: Roster, claims: Mapping[str, Claim]) -> dict[str, bool]:
    statements: dict[str, list[tuple[tuple[bool, str, str], bool]]] = {}
    for station, claim in claims.items():
        for group, (member, at) in claim.groups.items():
            statements.setdefault(group, []).append((_weight(roster, station, at), member))
    return {group: max(words)[1] for group, words in sorted(statements.items())}
