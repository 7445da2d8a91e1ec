"""Actions of the owner of the CA key: the registry, and every version of its roster (contract/plant.md section 1).

A version is derived from the current one here. If the CA key is elsewhere it is drafted here and signed there.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from shlex import quote
from typing import Any
from uuid import uuid4

from teds_provision.errors import BadDataError, NotFoundError, PolicyError, UsageError
from teds_provision.plant.apply_pages import now, put_roster, require_roster
from teds_provision.plant.backlog import PastEvent, backlog
from teds_provision.protocol.handover.strict_json import load_exact, time_text
from teds_provision.protocol.keys import fingerprint, station_key_message, verify
from teds_provision.protocol.plant.document import MemberRequest, payload
from teds_provision.protocol.plant.roster import (
    MOST_AHEAD,
    NOWHERE,
    USUAL,
    Member,
    Place,
    RemovedMember,
    Role,
    Roster,
    Share,
    Why,
    open_roster,
    read_roster,
    seal_roster,
)
from teds_provision.station.station import Station

_SAME_END = timedelta(hours=1)
FIRST_ROLES: frozenset[Role] = frozenset({"keeper", "sign", "line", "base"})


def _to_the_second(moment: datetime) -> datetime:
    return moment.replace(microsecond=0)


def draft_first(station: Station, name: str, days: timedelta = USUAL) -> Roster:
    """Return roster 1 of a new registry, with this station alone; raises PolicyError if one was joined."""
    if station.plant.joined is not None:
        raise PolicyError("This station already belongs to a registry.", hint="See: teds-provision registry status")
    own = Member(station.name, station.point, station.identity.signature, frozenset(FIRST_ROLES))
    moment = _to_the_second(now())
    return Roster(str(uuid4()), name, 1, "", moment, moment + days, (own,))


def signed(station: Station, draft: Roster) -> Roster:
    """Return a draft, signed by the CA.

    Raises NotFoundError if its key is not here, BadDataError for an invalid draft.
    """
    ca = station.vault.ca()
    if ca is None or ca.point != station.ca:
        raise NotFoundError(
            "The CA key is not in this vault.",
            hint="Add --draft FILE, then sign the draft on the station with the CA key: registry sign FILE",
        )
    return open_roster(seal_roster(draft, ca), station.ca)


def join(station: Station, roster: Roster, *, url: str | None, events: Sequence[PastEvent]) -> int:
    """Join a registry, and record the store's existing facts as events; return how many."""
    if roster.member(station.fingerprint) is None:
        raise PolicyError(
            f"The roster of {roster.name} does not name this station.",
            hint="Send its owner a request (registry request --output FILE); the owner then runs: registry add"
            " FILE --role …",
        )
    station.unlock()
    with station.transaction():
        station.plant.join(roster.registry, url)
        put_roster(station, roster)
        for act, uuid, members in events:
            station.plant.record_event(act, uuid, **members)
        station.audit("registry", None, "joined", registry=roster.registry, version=roster.version, events=len(events))
    return len(events)


def create(station: Station, name: str, days: timedelta = USUAL) -> tuple[Roster, int]:
    """Make a registry with this station as its first member; returns roster 1 and how many events the past made."""
    roster = signed(station, draft_first(station, name, days))
    return roster, join(station, roster, url=None, events=list(backlog(station)))


# -- the next version --------------------------------------------------------------------------------------------------


def following(station: Station, **change: Any) -> Roster:
    """Return the version after the current one, not signed yet; dates unchanged but for ``created``."""
    own = require_roster(station)
    created = max(_to_the_second(now()), own.created)
    change.setdefault("expires", max(own.expires, created + timedelta(days=1)))
    return replace(own, version=own.version + 1, previous=own.hash, created=created, hash="", octets=b"", **change)


def add(station: Station, request: MemberRequest, roles: frozenset[Role]) -> Roster:
    """Draft a roster with one member more; raises PolicyError for a key of another CA or one that was removed."""
    own = require_roster(station)
    if not verify(station.ca, station_key_message(request.point), request.certificate):
        raise PolicyError(
            f"Station {request.name} is not certified by this owner's CA and cannot join.",
            hint="A station without nodes can be set up again: init --request, trust ca sign, init --certificate",
        )
    if request.created > max(now(), own.created) + MOST_AHEAD:
        raise PolicyError(
            f"The request of {request.name} is dated {request.created:%Y-%m-%d}, in the future.",
            hint="Set the clock of that station, or of this one.",
        )
    there = own.by_key.get(request.fingerprint)
    if isinstance(there, RemovedMember):
        raise PolicyError(
            f"{there.name} was removed with this key, and a removed key cannot return.",
            hint="Create a new station on that machine: init in another --home",
        )
    member = Member(request.name, request.point, request.certificate, roles)
    if there is not None:
        if replace(there, signed=None) == member:
            return following(station)
        raise PolicyError(f"{there.name} is already a member.", hint="Change its roles: registry role")
    if any(member.name == request.name for member in own.members):
        raise PolicyError(f"There is already a member called {request.name!r}.", hint="Choose another name: --name")
    return following(station, members=(*own.members, member))


def with_roles(station: Station, name: str, roles: frozenset[Role], last: Place | None) -> Roster:
    """Draft a roster in which a member has these roles; one that loses ``sign`` keeps what it signed up to ``last``."""
    own = require_roster(station)
    member = require_member(own, name)
    if "keeper" in member.roles and "keeper" not in roles:
        raise PolicyError(
            f"{member.name} is a keeper, and that is taken by a removal alone: else its bans would end in silence.",
            hint=f"registry remove {quote(member.name)} --retired",
        )
    place = member.signed
    if "sign" in roles:
        place = None
    elif "sign" in member.roles:
        place = last if last is not None else station.plant.pages.chain(member.fingerprint).counted
    changed = replace(member, roles=roles, signed=place)
    return following(station, members=tuple(changed if current is member else current for current in own.members))


def draft_removal(station: Station, name: str, why: Why, last: int | None) -> Roster:
    """Draft a roster in which a member is removed; ``last`` is the number of its last page that counts.

    For a retired one that is the newest page here by default; for a lost or stolen one it must be given.
    """
    own = require_roster(station)
    gone = own.named(name)
    if isinstance(gone, RemovedMember) and gone.why == why and last in (None, gone.last[0]):
        return following(station)
    member = require_member(own, name)
    chain = station.plant.pages.chain(member.fingerprint)
    if last is None and why != "retired":
        raise UsageError(
            f"Which is the last page of {member.name} that you trust?",
            hint="Add --last N; registry log lists its pages.",
        )
    place = chain.counted if last is None else page_place(station, member.fingerprint, last)
    removed = RemovedMember(member.name, member.point, member.roles, why, place, member.signed)
    members = tuple(current for current in own.members if current is not member)
    share = tuple(replace(share, to=tuple(to for to in share.to if to != member.fingerprint)) for share in own.share)
    return following(
        station,
        members=members,
        removed=(*own.removed, removed),
        share=tuple(listed_share for listed_share in share if listed_share.to),
    )


def page_place(station: Station, of: str, n: int) -> Place:
    """Return number and H of a page that counts here; raises NotFoundError."""
    if n == 0:
        return NOWHERE
    chain = station.plant.pages.chain(of)
    found = [hash for number, hash, _ in station.plant.pages.chain_links(chain.id) if number == n]
    if not found or n > chain.counted[0]:
        raise NotFoundError(f"Page {n} of that station is missing here or does not count.", hint="See: registry status")
    for number, hash, previous in station.plant.pages.chain_links(chain.id):
        if number == n + 1 and len(found) > 1 and previous in found:
            return n, previous
        if number == n and len(found) == 1:
            return n, hash
    return n, found[0]


def shared(station: Station, share: Share) -> Roster:
    """Draft a roster that shares keys so; a share of the same nodes is replaced."""
    own = require_roster(station)
    for to in share.to:
        member = own.member(to)
        if member is None or "base" not in member.roles:
            raise PolicyError(
                f"{own.name_of(to)} does not have the role 'base', so it cannot receive keys.", hint="registry role"
            )
    return following(
        station, share=(*(listed_share for listed_share in own.share if listed_share.what != share.what), share)
    )


def unshared(station: Station, what: tuple[str, str]) -> Roster:
    """Draft a roster that shares these nodes no more."""
    own = require_roster(station)
    return following(station, share=tuple(share for share in own.share if share.what != what))


def renewed(station: Station, days: timedelta, *, redate: bool = False) -> Roster:
    """Draft the same roster with a new end.

    ``redate``: dated by this clock alone, by a person's word, since a wrong clock dated the present one too far ahead.
    """
    moment = _to_the_second(now())
    if redate:
        return replace(following(station, expires=moment + days), created=moment)
    return following(station, expires=max(moment, require_roster(station).created) + days)


def same_end(held: Roster, draft: Roster) -> Roster:
    """Return a renewal with the end that the roster has now if that is less than an hour sooner: it was run before."""
    return replace(draft, expires=held.expires) if held.expires <= draft.expires < held.expires + _SAME_END else draft


def is_ahead(held: Roster) -> bool:
    """Return True if other stations do not take this roster yet, by this machine's clock: it is dated in the future."""
    return held.created > now() + MOST_AHEAD


def require_wrong_date(station: Station, held: Roster) -> None:
    """Raise PolicyError if the roster is not dated in the future, or another member's page shows a slow clock here.

    A roster dated by a slow clock would end at once everywhere.
    """
    if not is_ahead(held):
        raise PolicyError(
            f"Roster {held.version} is dated {time_text(held.created)}, not in the future.", hint="Leave --redate out."
        )
    latest = time_text(now() + MOST_AHEAD)
    for digits, created in station.plant.pages.newest():
        member = held.member(digits)
        if member is not None and digits != station.fingerprint and created > latest:
            raise PolicyError(
                f"The clock of this machine is behind: the newest page of {member.name} is dated {created}.",
                hint=f"Set the clock of this machine. If that of {member.name} is wrong, have it set, and sync first.",
            )


def require_member(roster: Roster, name: str) -> Member:
    """Return a member by name or fingerprint; raises NotFoundError."""
    found = roster.named(name)
    if not isinstance(found, Member):
        known = ", ".join(member.name for member in roster.members)
        raise NotFoundError(f"{name!r} is not a member of {roster.name}.", hint=f"Members: {known}.")
    return found


def says_the_same(before: Roster | None, after: Roster) -> bool:
    """Return True if a version would change nothing: members, removed ones, shares, end date, an earlier date."""
    same = ("members", "removed", "share", "expires")
    return (
        before is not None
        and after.created >= before.created
        and all(getattr(before, what) == getattr(after, what) for what in same)
    )


def write_draft(draft: Roster) -> bytes:
    """Return a draft as a file."""
    return payload(draft.unsigned()) + b"\n"


def read_draft(octets: bytes, ca: bytes) -> Roster:
    """Parse a draft of a file; raises BadDataError."""
    draft = read_roster(load_exact(octets, "The draft"), ca)
    if json.loads(payload(draft.unsigned())) != json.loads(octets):
        raise BadDataError(
            "The draft was written by a newer version of teds-provision.", hint="Sign it with that version."
        )
    return draft


def changes(before: Roster | None, after: Roster) -> list[str]:
    """Return the changes of a new version, in sentences; every key with all 64 digits."""
    lines = [f"roster {after.version} of {after.name} ({after.registry}), until {after.expires:%Y-%m-%d}"]
    if before is not None and after.created < before.created:
        lines.append(f"  dates it {after.created:%Y-%m-%d}; the one before was dated {before.created:%Y-%m-%d}")
    there = before.by_key if before is not None else {}
    for member in after.members:
        old = there.get(member.fingerprint)
        roles = " ".join(sorted(member.roles))
        if not isinstance(old, Member):
            lines.append(f"  adds {member.name} as {roles}")
            lines.append(f"    {fingerprint(member.point)}")
        elif old.roles != member.roles:
            lines.append(f"  {member.name}: {' '.join(sorted(old.roles))} becomes {roles}")
            if member.signed is not None:
                lines.append(f"    what it signed up to page {member.signed[0]} stays authentic")
    for left in after.removed:
        if not isinstance(there.get(left.fingerprint), RemovedMember):
            lines.append(f"  removes {left.name} ({left.why}); its pages up to {left.last[0]} count")
            lines.append(f"    {left.fingerprint}")
    shares = set(before.share) if before is not None else set()
    lines += [f"  shares {_share(share)} with {_names(after, share)}" for share in after.share if share not in shares]
    lines += [
        f"  shares {_share(share)} no more" for share in shares if share.what not in {n.what for n in after.share}
    ]
    return lines


def _share(share: Share) -> str:
    return "all nodes" if share.what[0] == "all" else f"{share.what[0]} {share.what[1]}"


def _names(roster: Roster, share: Share) -> str:
    names = ", ".join(roster.name_of(receiver) for receiver in share.to)
    return names + (", and forgets them itself" if share.forget else "")
