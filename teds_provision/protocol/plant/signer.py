"""Decides if a signer's datasheets count (contract/plant.md section 1, "verify").

Being certified by the owner's CA is not enough in a plant: the roster lists who may sign, and for a station that may no
longer, the pages list what was signed before.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Literal, NamedTuple

from teds_provision.protocol.plant.roster import Member, Place, RemovedMember, Roster


class SignatureClaim(NamedTuple):
    """A claim on page ``n`` of a chain: its station signed this datasheet's digest, or vouches for it (``vouched``)."""

    station: str
    number: int
    vouched: bool


class SignerVerdict(NamedTuple):
    """Passed, failed, or unproven for want of pages; and why."""

    result: Literal["passed", "failed", "unproven"]
    why: str = ""


def missing_pages(whose: str, reporter: str, n: int, here: int) -> str:
    """Return a message about missing pages: their author, the reporting station, and the last page here."""
    return f"pages of {whose} are missing here: {reporter} names page {n}, and the last one here is {here}"


def limit_of(member: Member | RemovedMember) -> Place | None:
    """Return up to which page the ``signed`` events of a station without ``sign`` count; None: it never had it."""
    if isinstance(member, Member):
        return member.signed
    if "sign" in member.roles:
        return member.last
    return None if member.signed is None else min(member.signed, member.last, key=lambda place: place[0])


def signing(
    roster: Roster,
    signer: str,
    words: Collection[SignatureClaim],
    *,
    counted: Mapping[str, int],
    keepers_behind: str,
    added: bool,
) -> SignerVerdict:
    """Judge the signer (fingerprint) of one datasheet.

    ``words`` are those about its digest, of pages that count; ``counted``: how many pages of each chain count here;
    ``keepers_behind``: which member reports which page of a keeper that is not here, "" if none does; ``added``: a
    person trusts the signer's key here.
    """
    one = roster.by_key.get(signer)
    own = [word.number for word in words if word.station == signer and not word.vouched]
    if isinstance(one, Member) and "sign" in one.roles:
        return SignerVerdict("passed", "" if own else "in no page yet")
    if any(word.vouched and "keeper" in roster.roles_of(word.station) for word in words):
        return SignerVerdict("passed", "vouched for by a keeper")
    if one is None:
        if added:
            return SignerVerdict("passed", "trusted here")
        return SignerVerdict("failed", f"station {signer[:16]} is not in the roster")
    limit = limit_of(one)
    if limit is not None and any(n <= limit[0] for n in own):
        return SignerVerdict("passed", f"signed by {one.name} while it had the role")
    if limit is not None and counted.get(signer, 0) < limit[0]:
        return SignerVerdict("unproven", missing_pages(one.name, "the roster", limit[0], counted.get(signer, 0)))
    if isinstance(one, RemovedMember) and keepers_behind:
        return SignerVerdict("unproven", keepers_behind)
    why = "never had the role sign" if limit is None else "this datasheet is not in its pages of that time"
    return SignerVerdict(
        "failed", f"{one.name} {'was removed' if isinstance(one, RemovedMember) else 'may not sign'}: {why}"
    )
