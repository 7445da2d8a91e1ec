"""A signed statement that a node is no longer trusted; every bundle carries those of its sender (member ``revoked``).

Compact JWS (ES256, ``kid`` the signer's fingerprint), ``typ`` ``teds-revocation+jws``, payload
``{"format": "teds-revocation/1", "uuid", "fingerprint", "from", "reason", "created", "why"}``; ``fingerprint`` is that
of the node's key, null if it is not known. ``why`` repeats ``reason`` for earlier versions, whose statements have no
``reason``; they stay readable (compatibility.md). Section 6 of the profile does not list it: other readers ignore it,
and a bundle without it is as good.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.strict_json import Members, dump, load_object, time_text
from teds_provision.protocol.keys import PrivateKey, fingerprint

FORMAT = "teds-revocation/1"
TYPE = "teds-revocation+jws"
MAX_OCTETS = 16384


@dataclass(frozen=True)
class Revocation:
    """A node by UUID (10 octets) and, if known, its key's fingerprint; why; when; the signer's fingerprint.

    ``statement`` is the signed text, to be kept and passed on.
    """

    uuid: bytes
    fingerprint: str | None
    why: str
    created: datetime
    sender: str
    statement: str


def seal_revocation(signer: PrivateKey, *, uuid: bytes, node: str | None, why: str, created: datetime) -> Revocation:
    """Sign that the node ``uuid`` with the key of fingerprint ``node`` (or any) is trusted no more."""
    sender = fingerprint(signer.point)
    members = {
        "format": FORMAT,
        "uuid": uuid.hex(),
        "fingerprint": node,
        "from": sender,
        "reason": why,
        "created": time_text(created),
        "why": why,
    }
    statement = jose.sign_compact(dump(members), signer, typ=TYPE).decode()
    return open_revocation(statement, lambda kid: signer.point if kid == sender else None)


def open_revocation(statement: str, trusted: Callable[[str], bytes | None]) -> Revocation:
    """Check one statement; raises NotAuthenticError (signer unknown, signature), PolicyError or BadDataError."""
    try:
        octets = statement.encode("ascii")
    except UnicodeEncodeError as error:
        raise BadDataError("A revocation is not a compact JWS.") from error
    verified = jose.verify_compact(octets, trusted, typ=TYPE, max_octets=MAX_OCTETS)
    members = Members(load_object(verified.payload, "The revocation"), "The revocation")
    if members.get("format") != FORMAT:
        raise BadDataError(f"The revocation's format is not {FORMAT}.")
    sender = members.sha256("from")
    if sender != verified.kid:
        raise NotAuthenticError("The revocation names another signer than the one who signed it.")
    return Revocation(
        members.uuid("uuid"),
        members.sha256_or_none("fingerprint"),
        members.text("why" if members.get("reason") is None else "reason"),
        members.time("created"),
        sender,
        statement,
    )


def open_revocations(
    statements: Sequence[str], trusted: Callable[[str], bytes | None]
) -> tuple[tuple[Revocation, ...], int]:
    """Read the deny list of a bundle: those of trusted signers, and how many came from signers unknown here.

    A station passes on what it was given, so an unknown signer is no fault of the bundle. Anything else that is wrong
    with a statement is, and raises.
    """
    known: list[Revocation] = []
    unknown = 0
    for statement in statements:
        strangers: list[str] = []

        def find(kid: str, strangers: list[str] = strangers) -> bytes | None:
            point = trusted(kid)
            if point is None:
                strangers.append(kid)
            return point

        try:
            known.append(open_revocation(statement, find))
        except NotAuthenticError:
            if not strangers:
                raise
            unknown += 1
    return tuple(known), unknown
