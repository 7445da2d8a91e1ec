"""The roster: the members of a plant and their roles (contract/plant.md section 1).

Signed by the owner's CA; can be read without a store.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cached_property
from typing import Any, Final, Literal

from teds_provision.errors import BadDataError
from teds_provision.protocol.handover.strict_json import base64url, decode_base64url, load_exact, time_text
from teds_provision.protocol.keys import PrivateKey, fingerprint, station_key_message, verify
from teds_provision.protocol.plant.document import ROSTER, Fields, is_form, is_name, open_document, sign_document

MOST_MEMBERS: Final = 256
MOST_REMOVED: Final = 1024
MOST_SHARES: Final = 256
MOST_ROLES: Final = 32
LONGEST: Final = timedelta(days=400)
USUAL: Final = timedelta(days=90)
WARN_BEFORE: Final = timedelta(days=14)
MOST_AHEAD: Final = timedelta(hours=24)
"""A roster, job or request that was made further in the future than this is not taken yet."""

Role = Literal["keeper", "line", "sign", "base", "audit"]
ROLES: Final[tuple[Role, ...]] = ("keeper", "line", "sign", "base", "audit")
Why = Literal["retired", "lost", "stolen"]
WHYS: Final = ("retired", "lost", "stolen")
Place = tuple[int, str]
"""A page of a chain by its number and H; (0, "") is before the first."""
NOWHERE: Final[Place] = (0, "")


@dataclass(frozen=True)
class Member:
    """A station of the plant. ``signed``: the last page whose ``signed`` events count, if it has lost ``sign``."""

    name: str
    point: bytes
    certificate: bytes = field(repr=False)
    roles: frozenset[str]
    signed: Place | None = None

    @cached_property
    def fingerprint(self) -> str:
        """Return the fingerprint of its key."""
        return fingerprint(self.point)


@dataclass(frozen=True)
class RemovedMember:
    """A station that left: its pages up to ``last`` count as ``roles`` allow, and nothing after."""

    name: str
    point: bytes
    roles: frozenset[str]
    why: Why
    last: Place
    signed: Place | None = None

    @cached_property
    def fingerprint(self) -> str:
        """Return the fingerprint of its key."""
        return fingerprint(self.point)


@dataclass(frozen=True)
class Share:
    """A rule for automatic copies of keys: of all nodes, those of a group, or those of a profile."""

    what: tuple[Literal["all", "group", "profile"], str]
    to: tuple[str, ...]
    forget: bool = False


@dataclass(frozen=True)
class Roster:
    """One version of the roster; ``octets`` and ``hash`` are "" until it is signed."""

    registry: str
    name: str
    version: int
    previous: str
    created: datetime
    expires: datetime
    members: tuple[Member, ...]
    removed: tuple[RemovedMember, ...] = ()
    share: tuple[Share, ...] = ()
    hash: str = ""
    octets: bytes = field(default=b"", repr=False)

    @cached_property
    def by_key(self) -> dict[str, Member | RemovedMember]:
        """Return all that it names, by fingerprint."""
        stations: tuple[Member | RemovedMember, ...] = (*self.members, *self.removed)
        return {station.fingerprint: station for station in stations}

    def member(self, fingerprint: str) -> Member | None:
        """Return a present member."""
        found = self.by_key.get(fingerprint)
        return found if isinstance(found, Member) else None

    def removed_one(self, fingerprint: str) -> RemovedMember | None:
        """Return a station that left."""
        found = self.by_key.get(fingerprint)
        return found if isinstance(found, RemovedMember) else None

    def point_of(self, fingerprint: str) -> bytes | None:
        """Return the key of a member or removed one."""
        found = self.by_key.get(fingerprint)
        return found.point if found is not None else None

    def roles_of(self, fingerprint: str) -> frozenset[str]:
        """Return the roles that a station has, or had when removed; none for a stranger."""
        found = self.by_key.get(fingerprint)
        return found.roles if found is not None else frozenset()

    def has(self, fingerprint: str, role: Role) -> bool:
        """Return True if a member has this role now."""
        found = self.member(fingerprint)
        return found is not None and role in found.roles

    def name_of(self, fingerprint: str) -> str:
        """Return the name of a station; 16 digits for a stranger."""
        found = self.by_key.get(fingerprint)
        return found.name if found is not None else fingerprint[:16]

    def named(self, text: str) -> Member | RemovedMember | None:
        """Return a member by name, else any by at least 16 digits of the fingerprint, else a removed one by name."""
        for member in self.members:
            if member.name == text:
                return member
        digits = text.lower()
        found = [item for key, item in self.by_key.items() if len(digits) >= 16 and key.startswith(digits)]
        if len(found) == 1:
            return found[0]
        left = [removed for removed in self.removed if removed.name == text]
        return left[-1] if left else None

    def unsigned(self) -> dict[str, Any]:
        """Return what the CA signs, in the order of the contract."""
        return {
            "format": ROSTER.format,
            "registry": self.registry,
            "name": self.name,
            "version": self.version,
            "previous": self.previous,
            "created": time_text(self.created),
            "expires": time_text(self.expires),
            "members": [
                {
                    "name": member.name,
                    "point": member.point.hex(),
                    "certificate": base64url(member.certificate).decode(),
                    "roles": [role for role in ROLES if role in member.roles],
                    **_signed_up_to(member.signed),
                }
                for member in self.members
            ],
            "removed": [
                {
                    "name": left.name,
                    "point": left.point.hex(),
                    "roles": [role for role in ROLES if role in left.roles],
                    **_signed_up_to(left.signed),
                    "why": left.why,
                    "last": list(left.last),
                }
                for left in self.removed
            ],
            "share": [
                {"what": {share.what[0]: share.what[1] or True}, "to": list(share.to), "forget": share.forget}
                for share in self.share
            ],
        }


def _signed_up_to(place: Place | None) -> dict[str, object]:
    return {} if place is None else {"signed": list(place)}


def seal_roster(roster: Roster, ca: PrivateKey) -> bytes:
    """Sign a roster; what no reader would take raises BadDataError."""
    octets = sign_document(roster.unsigned(), ca, ROSTER)
    open_roster(octets, ca.point)
    return octets


def open_roster(octets: bytes, ca: bytes) -> Roster:
    """Read a roster that this CA (65 octets) signed. Raises NotAuthenticError, BadDataError, NewerFormatError."""
    document = open_document(octets.strip(), lambda kid: ca if kid == fingerprint(ca) else None, ROSTER)
    return read_roster(document.members, ca, document.hash, document.octets)


def names_other_ca(octets: bytes, ca: bytes) -> bool:
    """Return True if a roster names another CA as its signer; nothing of it is verified."""
    header = load_exact(decode_base64url(octets.strip().partition(b".")[0], "The JWS header"), "The JWS header")
    kid = header.get("kid")
    return header.get("typ") == ROSTER.typ and is_form("sha256", kid) and kid != fingerprint(ca)


def read_roster(members: object, ca: bytes, hash: str = "", octets: bytes = b"") -> Roster:
    """Parse a roster, signed or still a draft; raises BadDataError."""
    fields = Fields(members, "The roster")
    created, expires = fields.time("created"), fields.time("expires")
    if not created < expires <= created + LONGEST:
        raise BadDataError(f"The roster: expires is not within {LONGEST.days} days after created.")
    version = fields.number("version", 1)
    previous = fields.members.get("previous")
    if version > 1 or previous != "":
        previous = fields.text_of_form("sha256", "previous")
    roster = Roster(
        fields.text_of_form("random_id", "registry"),
        fields.name("name"),
        version,
        previous,
        created,
        expires,
        tuple(_member(value, ca) for value in fields.list_of("members", MOST_MEMBERS)),
        tuple(_removed(value) for value in fields.list_of("removed", MOST_REMOVED)),
        tuple(_share(value) for value in fields.list_of("share", MOST_SHARES)),
        hash,
        octets,
    )
    if len(roster.by_key) != len(roster.members) + len(roster.removed):
        raise BadDataError("The roster names a key twice.")
    if len({member.name for member in roster.members}) != len(roster.members):
        raise BadDataError("The roster names two members alike.")
    return roster


def _roles(fields: Fields) -> frozenset[str]:
    """Return the known roles; a member without any reads, as ``audit``."""
    roles = fields.list_of("roles", MOST_ROLES)
    if not all(isinstance(role, str) for role in roles):
        raise fields.bad("roles", "is no list of words")
    return frozenset(role for role in ROLES if role in roles) or frozenset({"audit"})


def _signed(fields: Fields) -> Place | None:
    return fields.place("signed") if "signed" in fields.members else None


def _member(value: object, ca: bytes) -> Member:
    fields = Fields(value, "A member of the roster")
    point, certificate = fields.point("point"), fields.octets("certificate", 64)
    if not verify(ca, station_key_message(point), certificate):
        raise fields.bad("certificate", "is not the owner's CA's over this key")
    return Member(fields.name("name"), point, certificate, _roles(fields), _signed(fields))


def _removed(value: object) -> RemovedMember:
    fields = Fields(value, "A removed station of the roster")
    why: Any = fields.one_of("why", WHYS)
    return RemovedMember(
        fields.name("name"), fields.point("point"), _roles(fields), why, fields.place("last"), _signed(fields)
    )


def _share(value: object) -> Share:
    fields = Fields(value, "A share of the roster")
    what, to = fields.members.get("what"), fields.list_of("to", MOST_MEMBERS)
    if not all(is_form("sha256", receiver) for receiver in to):
        raise fields.bad("to", "is no list of fingerprints")
    forget = "forget" in fields.members and fields.flag("forget")
    kind, named = next(iter(what.items())) if isinstance(what, dict) and len(what) == 1 else ("", None)
    if kind == "all" and named is True:
        return Share(("all", ""), tuple(to), forget)
    if isinstance(named, str) and is_name(named):
        if kind == "group":
            return Share(("group", named), tuple(to), forget)
        if kind == "profile":
            return Share(("profile", named), tuple(to), forget)
    raise fields.bad("what", "is none of all, group, profile")


# -- which of two rosters counts ---------------------------------------------------------------------------------------

Taking = Literal["taken", "taken, two rosters", "same", "older", "two rosters", "refused"]


def taking(new: Roster, own: Roster | None, registry: str) -> tuple[Taking, str]:
    """Return whether a roster that the CA signed replaces one's own, and why not.

    ``two rosters``: the CA signed two of one version; the remedy is the next version.
    """
    if new.registry != registry:
        return "refused", "it is of another registry"
    if own is None:
        return "taken", ""
    if new.version < own.version:
        return "older", f"version {own.version} is here"
    if new.version == own.version:
        return ("same", "") if new.hash == own.hash else ("two rosters", f"two rosters have version {new.version}")
    left, there = {removed.fingerprint for removed in new.removed}, set(new.by_key)
    back = [removed.name for removed in own.removed if removed.fingerprint not in left]
    if back:
        return "refused", f"{', '.join(back)} was removed, and a removed key never comes back"
    lost = [member.name for member in own.members if member.fingerprint not in there]
    if lost:
        return "refused", f"{', '.join(lost)} is neither a member nor removed in it"
    if new.version == own.version + 1 and new.previous != own.hash:
        return "taken, two rosters", f"version {new.version} follows another version {own.version} than the one here"
    return "taken", ""


def best(rosters: Sequence[Roster], own: Roster | None, registry: str) -> list[tuple[Roster, Taking, str]]:
    """Return the rosters in the order in which they are applied, each judged by those before it."""
    judged = []
    for roster in sorted(rosters, key=lambda roster: (roster.version, roster.hash)):
        how, why = taking(roster, own, registry)
        judged.append((roster, how, why))
        if how.startswith("taken"):
            own = roster
    return judged
