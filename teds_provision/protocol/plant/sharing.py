"""Decides which keys are copied to which stations, and which are accepted (contract/plant.md section 4). Pure.

A copy makes no new key, and only who made a key shares it: so nothing goes round in circles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.plant.merged_claims import MergedClaims
from teds_provision.protocol.plant.roster import Roster, Share

SILENT: Final = timedelta(days=7)
"""A station without a page for so long is not waited for: another holder shares in its place."""


def receivers(roster: Roster, sender: str, share: Share) -> tuple[str, ...]:
    """Return who gets copies by a share: its stations that are members with ``base``, except the sender."""
    return tuple(
        receiver
        for receiver in share.to
        if receiver != sender and "base" in roster.roles_of(receiver) and roster.member(receiver)
    )


def shares_any(shares: Iterable[Share], view: MergedClaims, sender: str) -> bool:
    """Return True if any share covers the node: all, a profile that the sender wrote on it, a group.

    A group is the sender's own, or a keeper's: else any member could add a node to a group that shares its key.
    """
    profile = view.written[sender][2] if sender in view.written else None
    groups = {*view.own_groups.get(sender, ()), *(group for group, member in view.keeper_groups.items() if member)}
    return any(
        kind == "all" or (kind == "profile" and name == profile) or (kind == "group" and name in groups)
        for kind, name in (share.what for share in shares)
    )


def gave_away(view: MergedClaims, station: str) -> bool:
    """Return True if a station gave the node away by a move that is still in force."""
    return any(giver == station and mode == "move" for giver, _, _, _, mode, _ in view.gave)


def sharer(roster: Roster, view: MergedClaims, key: tuple[int, str], silent: AbstractSet[str]) -> str | None:
    """Return who shares a key (epoch, key id): its maker, else the holder with the lowest fingerprint; None if unknown.

    ``silent`` are stations of which no page came for :data:`SILENT`. A removed one shares nothing.
    """
    holders = sorted(station for station, held in view.held.items() if held == key)
    makers = [station for station in holders if station in view.made and station not in silent]
    if makers:
        return makers[0]
    gone = key in view.left.values() or any(station in view.made for station in holders)
    return next((station for station in holders if station not in silent), None) if gone else None


def rotator(view: MergedClaims, key: tuple[int, str], me: str) -> str:
    """Return the station that rotates a key (epoch, key id) first once another one that held it was removed.

    The member that made the key if it still holds it, else the holder with the lowest fingerprint. ``me`` holds it.
    """
    holders = sorted({me} | {station for station, held in view.held.items() if held == key})
    return next((station for station in holders if station in view.made), holders[0])


def silent(created: Mapping[str, datetime | None], now: datetime) -> set[str]:
    """Return the stations whose newest counted page was made more than :data:`SILENT` before now."""
    return {station for station, at in created.items() if at is None or now - at > SILENT}


@dataclass(frozen=True)
class Offer:
    """One node of a bundle that came: its key's epoch and id, and the fingerprint of the node's own key."""

    uuid: bytes
    epoch: int
    key_id: str
    node: str


LATER: Final = "the sender's pages are not here yet"


def why_not(
    roster: Roster,
    view: MergedClaims,
    offer: Offer,
    *,
    sender: str,
    receiver: str,
    pin: str | None,
    quiet: AbstractSet[str],
) -> str:
    """Return why a copy of one node is not accepted automatically, "" if it is.

    ``pin``: the node's key by one's own store; ``quiet``: the silent stations. :data:`LATER` is tried once more.
    """
    fits = [share for share in roster.share if receiver in receivers(roster, sender, share)]
    if not fits:
        return "no share of the roster sends it here"
    if view.conflicts:
        return "; ".join(f"{name}: {why}" for name, why in sorted(view.conflicts.items()))
    named = pin or view.pin
    if named is not None and not same_key(named, offer.node):
        return "it comes with another node key than the one that it is pinned to"
    key = (offer.epoch, offer.key_id)
    if view.held.get(sender) != key:
        return LATER
    if sharer(roster, view, key, quiet) != sender:
        return f"{roster.name_of(sender)} did not make this key, and others of its holders can be asked"
    if named is None and not _claims(view, sender, offer.node):
        return LATER
    if not shares_any(fits, view, sender):
        return "no share of the roster is of this node"
    return ""


def _claims(view: MergedClaims, sender: str, node: str) -> bool:
    """Return True if the sender names this node key, else any station.

    As there is no conflict, none names another one.
    """
    named = [view.pins[sender]] if sender in view.pins else list(view.pins.values())
    return any(same_key(fingerprint, node) for fingerprint in named)


def forgets(roster: Roster, me: str, fitting: Iterable[Share], taken: Collection[str]) -> bool:
    """Return True if a key may be deleted here.

    That needs shares that allow it, none that names me, and receipts of all their receivers.
    """
    shares = list(fitting)
    if not any(share.forget for share in shares) or any(me in share.to for share in shares):
        return False
    wanted = {receiver for share in shares if share.forget for receiver in receivers(roster, me, share)}
    return bool(wanted) and wanted <= set(taken)
