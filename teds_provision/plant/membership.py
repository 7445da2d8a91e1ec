"""A station's steps of membership: request, join, leave; what a keeper vouches for (contract/plant.md section 8)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import replace

from teds_provision.errors import (
    BadDataError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    RosterExpiredError,
    TedsProvisionError,
)
from teds_provision.plant import scram
from teds_provision.plant.apply_pages import now, recount, require_roster
from teds_provision.plant.transport import Transport
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.plant.chain import counting
from teds_provision.protocol.plant.document import MemberRequest, hash_of, open_request
from teds_provision.protocol.plant.roster import MOST_AHEAD, Roster, names_other_ca, open_roster
from teds_provision.provisioning.verify import snapshot_trust, verify_image
from teds_provision.shapes.verdict import Verification
from teds_provision.station.plant.pages import Chain
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds.codec import security

FILES = "file:"


def request(station: Station) -> bytes:
    """Give this station's request to be a member, signed; the same again while name and certificate are the same.

    One that a wrong clock dated too far ahead is made again, with the same login: no keeper accepts it before its date.
    """
    kept = station.plant.login()
    secret = os.urandom(scram.SECRET_OCTETS) if kept is None else kept[0]
    made = MemberRequest(
        station.name, station.point, station.identity.signature, scram.verifier(secret), now().replace(microsecond=0)
    )
    if kept is not None:
        earlier = open_request(kept[1])
        if earlier.created <= made.created + MOST_AHEAD and replace(earlier, created=made.created) == made:
            return kept[1]
    octets = made.signed(station.vault.identity())
    with station.transaction():
        station.plant.keep_login(secret, octets)
        station.audit("registry", None, "requested", fingerprint=station.fingerprint)
    return octets


def found_roster(station: Station, transport: Transport, octets: bytes | None) -> Roster:
    """Return the best roster that names this station, of a file or of the transport; an expired one is refused here.

    Raises NotFoundError, NotAuthenticError, BadDataError, PolicyError (that of another CA: its stations are not ours).
    """
    if octets is not None and names_other_ca(octets, station.ca):
        raise _other_owner("The roster")
    found = [] if octets is None else [open_roster(octets, station.ca)]
    foreign = False
    held = station.plant.roster
    if held is not None:  # the station is a member already, and changes its transport
        found.append(held)
    for roster_octets in transport.rosters() if octets is None else ():
        try:
            found.append(open_roster(roster_octets, station.ca))
        except NotAuthenticError:
            foreign = foreign or names_other_ca(roster_octets, station.ca)
        except TedsProvisionError:  # the transport is untrusted
            continue
    held = station.plant.roster
    if octets is None and held is not None:
        found.append(held)
    mine = [roster for roster in found if roster.member(station.fingerprint) is not None]
    if foreign and not found:
        raise _other_owner(f"Every roster in {transport.where}")
    if not mine:
        raise NotFoundError(
            f"No roster in {transport.where} that this owner's CA signed names this station.",
            hint="Send the owner a request (registry request --output FILE); the owner then runs: registry add"
            " FILE --role …",
        )
    registries = {roster.registry for roster in mine}
    if len(registries) > 1:
        raise PolicyError(
            f"{transport.where} contains rosters of {len(registries)} registries.", hint="Choose one: --roster FILE"
        )
    best = max(mine, key=lambda roster: (roster.version, roster.hash))
    if best is not held and best.created > now() + MOST_AHEAD:
        raise PolicyError(
            f"The roster of {best.name} is dated {best.created:%Y-%m-%d}, in the future.",
            hint="Set the clock of this machine, or have the owner set his and sign the next version: registry renew"
            " --redate",
        )
    if best.expires <= now():
        raise RosterExpiredError(
            f"The roster of {best.name} expired on {best.expires:%Y-%m-%d}.",
            hint="Ask its owner to renew it: registry renew",
        )
    return best


def _other_owner(what: str) -> PolicyError:
    return PolicyError(
        f"{what} is signed by another CA than this station's, so it cannot join.",
        hint="A station without nodes can be set up again: init --request, trust ca sign, init --certificate",
    )


def disconnect(station: Station) -> None:
    """Take no part any more; what is held is kept."""
    require_roster(station)
    with station.transaction():
        record = station.plant.joined
        assert record is not None
        station.plant.put_record(replace(record, left=utc_now(), url=None))
        station.audit("registry", None, "left", registry=record.registry)


def vouchable(station: Station, uuids: Sequence[bytes] | None) -> list[tuple[bytes, str, str]]:
    """Return datasheets that this store knows as authentic and whose signer may not or never could sign.

    Returns UUID, digest and the first digits of the signer's fingerprint. ``uuids`` None: of every node.
    """
    roster = require_roster(station)
    judging = replace(snapshot_trust(station), policy=replace(snapshot_trust(station).policy, rules=None))
    listed = [shown.uuid for shown in station.nodes.all_shown_keys()] if uuids is None else list(uuids)
    found = []
    for uuid in listed:
        image = station.datasheets.datasheet(uuid)
        octets = image.security if image is not None else None
        if image is None or octets is None:
            continue
        try:
            shown = security.decode(octets)
        except BadDataError:
            continue
        if shown.station_key is None:
            continue
        signer = fingerprint(shown.station_key)
        if roster.has(signer, "sign") or Verification(uuid, tuple(verify_image(judging, image))).verdict != "authentic":
            continue
        found.append((uuid, hashlib.sha256(octets).hexdigest(), signer[:16]))
    return found


def vouch(station: Station, found: Sequence[tuple[bytes, str, str]]) -> int:
    """Vouch as a keeper for these datasheets; return how many are new."""
    roster = require_roster(station)
    if not roster.has(station.fingerprint, "keeper"):
        raise PolicyError("Only a keeper can vouch for datasheets.", hint="See: registry status")
    fresh = 0
    with station.transaction():
        for uuid, digest, _ in found:
            words = station.plant.claims.signers(bytes.fromhex(digest))
            if any(vouched and who == station.fingerprint for who, _, vouched in words):
                continue
            station.plant.record_event("vouched", uuid, teds_sha256=digest)
            fresh += 1
    return fresh


def accept(station: Station, of: str, hash: str | None, transport: Transport | None) -> tuple[int, str]:
    """Take the branch of two histories that the registry shows, or the one that ``hash`` (16 digits or more) names.

    Local: others decide for themselves, and a roster's ``last`` goes before it. Returns the page that was taken.
    """
    n, wanted = branch(station, of, hash, transport)
    with station.transaction():
        station.plant.pages.put_chain(replace(station.plant.pages.chain(of), accepted=(n, wanted)))
        recount(station, station.plant.pages.chain(of), require_roster(station))
        station.audit("registry", None, "accepted", station=of, n=n, hash=wanted)
    return n, wanted


def branch(station: Station, of: str, hash: str | None, transport: Transport | None) -> tuple[int, str]:
    """Return the branch that :func:`accept` takes: number and H of its first page.

    An earlier choice can be changed: name the other branch by its ``hash``. Raises NotFoundError, PolicyError.
    """
    roster = require_roster(station)
    chain: Chain = station.plant.pages.chain(of)
    links = station.plant.pages.chain_links(chain.id)
    partings = [chain.counted[0] + 1]  # the undecided fork
    if chain.accepted is not None:  # and the decided fork, whose choice can be changed
        partings.append(counting(links, last=None, accepted=None).two or 0)
    by_number = {n: sorted({hash for number, hash, _ in links if number == n}) for n in partings}
    n = next((n for n in partings if len(by_number[n]) > 1 and _among(by_number[n], hash)), 0)
    n = n or next((n for n in partings if len(by_number[n]) > 1), 0)
    if not n:
        raise NotFoundError(
            f"{roster.name_of(of)} has only one history here.", hint="See: teds-provision registry status"
        )
    branches = by_number[n]
    wanted = _among(branches, hash)
    if hash is None and transport is not None and not transport.carries_all:
        shown = {carried.number: carried for carried in transport.pages(of, n - 1)}
        wanted = [branch for branch in branches if n in shown and hash_of(shown[n].octets) == branch]
    if len(wanted) != 1:
        listed = ", ".join(branch[:16] for branch in branches)
        raise PolicyError(
            f"Page {n} of {roster.name_of(of)} exists here twice: {listed}.", hint="Choose one: --page HASH"
        )
    return n, wanted[0]


def _among(branches: Sequence[str], digits: str | None) -> list[str]:
    """Return the branches whose hash begins with ``digits``."""
    return [] if digits is None else [hash for hash in branches if hash.startswith(digits.lower())]
