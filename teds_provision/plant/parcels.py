"""Automatic handover of keys: copies by the roster's shares, receipts, and what waits for an operator.

A parcel is a bundle as ``export-keys`` seals it, for one receiver; its receipt; or a document of a line, sealed the
same way. An outgoing parcel is in the store before it is sent, and an incoming one before it is removed from the
registry, so the same sync may follow an interrupted one: a parcel of a known id is sent once more, a bundle that was
taken in gives its receipt once more (contract/plant.md section 4).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import chain
from shlex import quote
from typing import Final
from uuid import uuid4

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError, TedsProvisionError
from teds_provision.handover import incoming, outgoing, pending
from teds_provision.plant.folder_transport import LARGEST_PARCEL
from teds_provision.plant.transport import SMALL, Parcel, Transport
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import CLOCK_TOLERANCE, CONTENT_TYPE
from teds_provision.protocol.handover.strict_json import decode_base64url, load_object, time_text
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.plant import sharing
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.document import JOB, SIGN_REQUEST, SIGNED, open_document
from teds_provision.protocol.plant.merged_claims import MergedClaims
from teds_provision.protocol.plant.roster import Roster
from teds_provision.sanitize import counted
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.parcels import ParcelKind, ParcelRow
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import Handover, TrustRecord

NODES: Final = 10_000
"""So many nodes go into one copy."""
DAYS: Final = 7
_DAYS_OF_A_LINE: Final = 31
"""Time for which a request or an answer is kept here: registries keep none longer."""
_COMMAND: Final = "registry sync"
_KEPT: Final = 64
"""Limit of parcels of one sender that wait here for an operator; the others stay in the registry."""
_BY_SHARE: Final = "share"
"""Detail of an outgoing copy that was made for a share of the roster, not by ``export-keys``."""
OF_A_LINE: Final[dict[str, ParcelKind]] = {JOB.typ: "job", SIGN_REQUEST.typ: "sign-request", SIGNED.typ: "signed"}
_KINDS: Final = {JOB.typ: JOB, SIGN_REQUEST.typ: SIGN_REQUEST, SIGNED.typ: SIGNED}

Views = Callable[[Sequence[bytes]], Mapping[bytes, MergedClaims]]
"""The plant's view of some nodes, by UUID."""


# -- incoming ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ParcelCounts:
    """Numbers of parcels of a sync: handled ones, and those that wait for the operator."""

    taken: int
    waiting: int


def take_in(station: Station, transport: Transport, views: Views, now: datetime) -> ParcelCounts:
    """Take in the parcels for this station; those that need an operator are kept for ``import-keys --received``."""
    roster = station.plant.roster
    if roster is None:
        return ParcelCounts(0, 0)
    _drop_outlived(station, now)
    reader = _Reader(station, roster, views, now)
    taken = sum(reader.judge_again(row) for row in station.plant.parcels.all("in", "later"))
    for parcel in transport.parcels(station.fingerprint):
        done = reader.process_parcel(parcel)
        if done is not None:
            transport.drop(parcel.id, station.fingerprint)
            taken += done
    return ParcelCounts(taken, sum(row.kind == "bundle" for row in station.plant.parcels.all("in", "waiting", "later")))


def _drop_outlived(station: Station, now: datetime) -> None:
    """Drop waiting parcels that are useless: a bundle that has expired, an old request or answer.

    A sender makes an expired copy again, a line repeats its request; what stayed would take the room of new ones (64 of
    one).
    """
    parcels, oldest = station.plant.parcels, time_text(now - timedelta(days=_DAYS_OF_A_LINE))
    for row in parcels.all("in", "waiting", "later"):
        if row.kind == "bundle":
            over = bool(row.expires) and row.expires <= time_text(now)
        else:
            over = row.kind in ("sign-request", "signed") and row.created < oldest
        if over:
            with station.durable(_COMMAND):
                parcels.drop(row.id, "in")
                station.audit("import", None, "expired", parcel=row.id, handover=row.about)


class _Reader:
    """Deals with parcels one by one."""

    def __init__(self, station: Station, roster: Roster, views: Views, now: datetime) -> None:
        self.station, self.roster, self.views, self.now = station, roster, views, now
        self.quiet = silent_stations(station, roster, now)

    def judge_again(self, row: ParcelRow) -> bool:
        """Judge once more what came before its sender's pages did.

        A sender that is still unknown is for an operator.
        """
        octets = self.station.plant.parcels.document(row.id, "in")
        with self.station.lock(_COMMAND):
            try:
                plan = incoming.plan_import(self.station, octets, self.now)
            except TedsProvisionError as error:
                if isinstance(error, incoming.NothingImportedError):
                    refuse_bundle(self.station, error)
                self.station.plant.parcels.drop(row.id, "in")
                return True
            why = "" if isinstance(plan, incoming.ImportResult) else self._why_not(plan)
            if why:
                self.station.plant.parcels.set_state(row.id, "in", "waiting", why)
                return False
            import_parcel(self.station, row, plan)
            return True

    def process_parcel(self, parcel: Parcel) -> bool | None:
        """Process a parcel: True if it is done, False if it is kept here, None if it stays in the registry."""
        parcels = self.station.plant.parcels
        if parcels.get(parcel.id, "in") is not None:
            return False
        try:
            typ, inner = _inner(parcel.octets, self.station)
            if typ in OF_A_LINE:
                return self._keep_document(parcel, typ, inner)
            if not parcel.octets.startswith(b"{"):
                return self._receipt(parcel)
            return self._bundle(parcel)
        except TedsProvisionError as error:
            return self._junk(parcel, error)

    def _bundle(self, parcel: Parcel) -> bool | None:
        with self.station.lock(_COMMAND):
            try:
                plan = incoming.plan_import(self.station, parcel.octets, self.now)
            except incoming.NothingImportedError as error:
                refuse_bundle(self.station, error)
                return True
            row = self._row(parcel, "bundle")
            if isinstance(plan, incoming.ImportResult):
                import_parcel(self.station, replace(row, peer=plan.row.peers[0], about=plan.row.id), plan)
                return True
            bundle = plan.opened.bundle
            row = replace(row, peer=bundle.sender, about=bundle.id, expires=time_text(bundle.expires))
            why = self._why_not(plan)
            if not why:
                import_parcel(self.station, row, plan)
                return True
            return self._keep(replace(row, state="later" if why == sharing.LATER else "waiting", detail=why), parcel)

    def _why_not(self, plan: incoming.ImportPlan) -> str:
        """Return why a bundle needs an operator's confirmation, "" if it does not."""
        bundle, roster, me = plan.opened.bundle, self.roster, self.station.fingerprint
        if bundle.mode != "copy":
            return "a move needs confirmation"
        if self.now >= roster.expires:
            return "the roster has expired"
        if roster.member(bundle.sender) is None:
            return "its sender is not a member"
        if bundle.ca != self.station.ca:
            return "its nodes belong to another CA"
        later = ""
        for page in chunks(plan.taken):
            held = self._unproven_of(bundle.sender, [planned.node.uuid for planned in page])
            pins = self.station.pins.get_many([planned.node.uuid for planned in page])
            seen = self.views([planned.node.uuid for planned in page])
            for planned in page:
                node, pin = planned.node, pins.get(planned.node.uuid)
                if any(key_id != node.kid for key_id in held.get(node.uuid, ())):
                    return f"{node.uuid.hex()}: a key of it from this sender was never proven"
                offer = sharing.Offer(node.uuid, node.epoch, node.kid, fingerprint(node.node_key))
                why = sharing.why_not(
                    roster,
                    seen[node.uuid],
                    offer,
                    sender=bundle.sender,
                    receiver=me,
                    pin=pin.fingerprint if pin is not None else None,
                    quiet=self.quiet,
                )
                if why and why != sharing.LATER:
                    return f"{node.uuid.hex()}: {why}"
                later = later or why
        return later

    def _unproven_of(self, sender: str, page: Sequence[bytes]) -> dict[bytes, list[str]]:
        """Return the keys that came from this sender and were never proven, by node."""
        held: dict[bytes, list[str]] = {}
        for key in self.station.keys.get_many(page):
            if key.state == "pending" and key.source == "import":
                held.setdefault(key.uuid, []).append(key.key_id)
        return {
            uuid: keys
            for uuid, keys in held.items()
            if any(holder.fingerprint == sender for holder in self.station.keys.holders(uuid))
        }

    def _receipt(self, parcel: Parcel) -> bool:
        with self.station.lock(_COMMAND):
            closed = pending.close(self.station, parcel.octets)
            receipt = closed.receipt
            parcels = self.station.plant.parcels
            with self.station.transaction():
                for row in parcels.all("out", "ready", "sent"):
                    if row.kind == "bundle" and row.about == receipt.id and row.peer == receipt.sender:
                        parcels.turn_shared(row.id, "taken")
                        parcels.turn_shared(row.id, "refused", [refused.uuid for refused in receipt.refused])
                        parcels.drop(row.id, "out")
        return True

    def _keep_document(self, parcel: Parcel, typ: str, inner: bytes) -> bool | None:
        """Keep a job, a request or an answer for its command; a member signed it.

        A repeated answer, or one without a request, is for no command: it would wait here in vain.
        """
        document = open_document(inner, self._member, _KINDS[typ])
        if _KINDS[typ] is SIGNED:
            asked = self.station.plant.line.sign_request(str(document.members.get("of")), "out")
            if asked is None or asked.answer is not None or asked.peer != document.signer:
                return True
        row = replace(self._row(parcel, OF_A_LINE[typ]), peer=document.signer, about=document.hash, state="waiting")
        with self.station.durable(_COMMAND):
            return self._keep(row, replace(parcel, octets=inner))

    def _member(self, digits: str) -> bytes | None:
        member = self.roster.member(digits)
        return None if member is None else member.point

    def _keep(self, row: ParcelRow, parcel: Parcel) -> bool | None:
        parcels = self.station.plant.parcels
        if sum(parcel_row.peer == row.peer for parcel_row in parcels.all("in", "waiting", "later")) >= _KEPT:
            return None
        with self.station.transaction():
            parcels.put(row, parcel.octets)
        return False

    def _junk(self, parcel: Parcel, error: TedsProvisionError) -> bool:
        """Discard a parcel that is of no use, which would stay there until it expires; an alarm if it is suspicious.

        It is not if a removed station signed it, or if it came too late: both happen in the ordinary course of a theft
        or of a long absence.
        """
        if not isinstance(error, (BadDataError, NotAuthenticError, NotFoundError, PolicyError)):
            raise error
        suspicious = isinstance(error, (BadDataError, NotAuthenticError)) and not self._is_from_removed(parcel)
        with self.station.durable(_COMMAND):
            if suspicious:
                why = f"a parcel was discarded: {error.message.rstrip('.')}"
                self.station.plant.alarms.put(Alarm("parcel", parcel.sender, 0, why), again=True)
            self.station.audit("import", None, "parcel discarded", parcel=parcel.id, why=error.message)
        return True

    def _is_from_removed(self, parcel: Parcel) -> bool:
        """Return True if a station that was removed signed what is in a parcel."""
        octets = parcel.octets
        try:
            if octets.startswith(b"{"):
                octets = jose.decrypt(
                    octets, self.station.vault.identity(), cty=CONTENT_TYPE, max_octets=LARGEST_PARCEL
                )
            header = load_object(decode_base64url(octets.partition(b".")[0], "The JWS header"), "The JWS header")
            jose.verify_compact(octets, self._removed_point, typ=str(header.get("typ")), max_octets=LARGEST_PARCEL)
        except TedsProvisionError:
            return False
        return True

    def _removed_point(self, digits: str) -> bytes | None:
        removed = self.roster.removed_one(digits)
        return None if removed is None else removed.point

    def _row(self, parcel: Parcel, kind: ParcelKind) -> ParcelRow:
        return ParcelRow(parcel.id, "in", parcel.sender or "0" * 64, kind, "later", parcel.expires)


def _inner(octets: bytes, station: Station) -> tuple[str, bytes]:
    """Return ``typ`` and octets of what a small parcel seals; "" for a bundle and for what is not sealed."""
    if not octets.startswith(b"{") or len(octets) > SMALL:
        return "", b""
    inner = jose.decrypt(octets, station.vault.identity(), cty=CONTENT_TYPE, max_octets=SMALL)
    header = load_object(decode_base64url(inner.partition(b".")[0], "The JWS header"), "The JWS header")
    typ = header.get("typ")
    return (typ, inner) if isinstance(typ, str) and typ in OF_A_LINE else ("", b"")


def import_parcel(
    station: Station, row: ParcelRow, plan: incoming.ImportPlan | incoming.ImportResult
) -> incoming.ImportResult:
    """Take a bundle in and put its receipt among what leaves, all in one transaction; the caller holds the lock."""
    with station.transaction():
        done = plan if isinstance(plan, incoming.ImportResult) else incoming.import_bundle(station, plan)
        station.plant.parcels.drop(row.id, "in")
        _put_out(station, "receipt", done.row.peers[0], done.receipt.strip(), done.row.id)
    return done


def refuse_bundle(station: Station, error: incoming.NothingImportedError, parcel: str = "") -> None:
    """Record on the next page that a bundle was refused whole: it is never sent again for these keys.

    ``parcel`` is the waiting parcel that held it, which is then dropped. The caller holds the lock.
    """
    with station.transaction():
        for planned in error.nodes:
            facts = {"bundle": error.bundle.id, "peer": error.bundle.sender, "why": planned.why}
            station.plant.record_event("refused", planned.node.uuid, **facts)
        if parcel:
            station.plant.parcels.drop(parcel, "in")
        station.audit("import", None, "refused", handover=error.bundle.id, why=error.message)


def received(station: Station, kind: ParcelKind) -> list[tuple[ParcelRow, bytes]]:
    """Return the waiting parcels of a kind, oldest first, each with its document; none that was taken meanwhile."""
    parcels = station.plant.parcels
    found = ((row, parcels.document(row.id, "in")) for row in parcels.all("in", "waiting") if row.kind == kind)
    return [(row, document) for row, document in found if document]


# -- outgoing ----------------------------------------------------------------------------------------------------------


def send_export(station: Station, plan: outgoing.ExportPlan, now: datetime, *, by_share: bool = False) -> str:
    """Have a bundle of ``export-keys --send`` leave with the next sync; its id. The caller holds the lock.

    ``by_share``: it is a copy that a share of the roster asks for.

    The same order again, while its parcel waits, gives the same parcel.
    """
    peer = plan.receivers[0].fingerprint
    for row in station.plant.parcels.all("out", "ready", "sent"):
        if row.kind == "bundle" and row.about == plan.id and row.peer == peer and not _is_over(row, now):
            return row.id
    sealed = outgoing.seal_export(station, plan, now)
    with station.transaction():
        outgoing.record_export(station, sealed)
        detail = _BY_SHARE if by_share else ""
        parcel = _put_out(station, "bundle", peer, sealed.octets, plan.id, expires=plan.expires, detail=detail)
        station.plant.parcels.put_shared(
            ((leaving.uuid, leaving.epoch) for leaving in plan.nodes), peer, parcel, "sent"
        )
    return parcel


@dataclass(frozen=True)
class SentParcels:
    """Number of parcels that left in a sync, and sentences about those that are held back or were dropped."""

    count: int
    held_back: tuple[str, ...] = ()


def send_out(station: Station, transport: Transport, views: Views, now: datetime) -> SentParcels:
    """Send what waits: copies that are due, receipts, what a person sent."""
    roster = station.plant.roster
    if roster is None:
        return SentParcels(0)
    _expire(station, now)
    _note_refused(station)
    dropped = _drop_outdated(station, roster)
    if now < roster.expires:
        _make_copies(station, roster, views, now)
        _forget(station, roster, views)
    sent = _send(station, roster, transport, now)
    return replace(sent, held_back=(*dropped, *sent.held_back))


def waiting_out(station: Station) -> int:
    """Return how many parcels were made and not receipted."""
    return sum(row.kind != "receipt" for row in station.plant.parcels.all("out", "ready", "sent"))


def _put_out(
    station: Station,
    kind: ParcelKind,
    to: str,
    document: bytes,
    about: str,
    expires: datetime | None = None,
    detail: str = "",
) -> str:
    parcel = str(uuid4())
    until = time_text(expires or datetime.now(UTC) + timedelta(days=DAYS))
    station.plant.parcels.put(ParcelRow(parcel, "out", to, kind, "ready", until, about, detail), document)
    return parcel


def _send(station: Station, roster: Roster, transport: Transport, now: datetime) -> SentParcels:
    parcels, sent, held_back = station.plant.parcels, 0, Counter[str]()
    for row in parcels.all("out", "ready"):
        why = _why_held_back(station, roster, row, now)
        if why:
            held_back[why] += 1
            continue
        try:
            transport.send(Parcel(row.id, row.peer, parcels.document(row.id, "out"), row.expires, station.fingerprint))
        except PolicyError:
            break  # this station's room in the registry is full: the rest goes with the next sync
        with station.durable(_COMMAND):
            if row.kind == "bundle":
                parcels.set_state(row.id, "out", "sent")
            else:
                parcels.drop(row.id, "out")
        sent += 1
    return SentParcels(sent, tuple(f"{counted(count, 'parcel')} held back: {why}" for why, count in held_back.items()))


def _why_held_back(station: Station, roster: Roster, row: ParcelRow, now: datetime) -> str:
    """Return why a parcel that was made earlier does not leave now, "" if it does.

    The roster may have changed or expired since: a copy of keys leaves only under one that holds, a move is the
    operator's decision.
    """
    name = roster.name_of(row.peer)
    if roster.member(row.peer) is None:
        return f"{name} is no member any more; to take back a move to it: handover undo ID"
    handover = station.handovers.get(row.about, "out") if row.kind == "bundle" else None
    if handover is None:
        return ""
    outdated = outgoing.why_outdated(station, handover)
    if outdated is not None:
        return _why_outdated(name, handover, *outdated)
    if handover.mode != "copy":
        return ""
    if now >= roster.expires:
        return f"keys for {name}, as the roster expired on {roster.expires:%Y-%m-%d}; ask its owner: registry renew"
    shares = (share for share in roster.share if row.peer in sharing.receivers(roster, station.fingerprint, share))
    if row.detail == _BY_SHARE and next(shares, None) is None:
        return f"keys for {name}, as no share of the roster sends them there any more"
    return ""


def _why_outdated(name: str, handover: Handover, uuid: bytes, why: str) -> str:
    node = f"keys for {name}, because of node {uuid.hex()}: {why}"
    if handover.mode == "move":
        return f"{node}. Take the move back, then move the others: handover undo {handover.id}"
    return f"{node}. To send what may still go: export-keys --to {quote(name)} UUID --send"


def _drop_outdated(station: Station, roster: Roster) -> tuple[str, ...]:
    """Drop parcels that must not leave any more: a move that was undone; a share's copy with a key that is outdated.

    The share then makes another copy, of what may still go. A copy that a person ordered is held back instead.
    """
    parcels, dropped = station.plant.parcels, list[str]()
    for row in parcels.all("out", "ready"):
        handover = station.handovers.get(row.about, "out") if row.kind == "bundle" else None
        if handover is None:
            continue
        name, outdated = roster.name_of(row.peer), None
        if handover.state == pending.UNDONE:
            why = f"keys for {name}, as the move {handover.id} was undone"
        elif row.detail == _BY_SHARE and (outdated := outgoing.why_outdated(station, handover)) is not None:
            why = (
                f"keys for {name}, because of node {outdated[0].hex()}: {outdated[1]}; a new copy has what may still go"
            )
        else:
            continue
        with station.durable(_COMMAND):
            parcels.forget_shared(row.id)
            _give_up(station, row)
            station.audit("export", None, "parcel dropped", parcel=row.id, handover=row.about, why=why)
        dropped.append(f"1 parcel dropped: {why}")
    return tuple(dropped)


def _expire(station: Station, now: datetime) -> None:
    """Replace what was not receipted in time: a copy by another one, a move under its old id."""
    parcels = station.plant.parcels
    for row in parcels.all("out", "ready", "sent"):
        if not _is_over(row, now):
            continue
        with station.lock(_COMMAND):
            handover = station.handovers.get(row.about, "out") if row.kind == "bundle" else None
            with station.transaction():
                parcels.forget_shared(row.id)
                _give_up(station, row)
            if handover is not None and handover.mode == "move" and handover.state == pending.OPEN:
                nodes = tuple(
                    bytes.fromhex(uuid_hex) for uuid_hex in pending.BundleNotes.from_json(handover.nodes).uuids
                )
                order = outgoing.ExportOrder((row.peer,), nodes, "move")
                with suppress(PolicyError, NotFoundError):  # revoked or forgotten since: `handover undo` reports it
                    send_export(station, outgoing.plan_export(station, order, now), now)


def _give_up(station: Station, row: ParcelRow) -> None:
    """Drop an outgoing parcel without a receipt. A copy is then over, unless it is in another parcel too.

    A move stays open: its keys rest until it is sent again or undone.
    """
    parcels = station.plant.parcels
    parcels.drop(row.id, "out")
    handover = station.handovers.get(row.about, "out") if row.kind == "bundle" else None
    if handover is None or handover.mode != "copy" or handover.state != pending.OPEN:
        return
    if not any(other.about == row.about for other in parcels.all("out", "ready", "sent")):
        station.handovers.put(replace(handover, state=pending.DROPPED))


def _is_over(row: ParcelRow, now: datetime) -> bool:
    """Return True if no receiver takes an outgoing parcel: expired, or a bundle that a clock dated ahead."""
    ahead = row.kind == "bundle" and row.created > time_text(now + CLOCK_TOLERANCE)
    return ahead or row.expires <= time_text(now)


def _note_refused(station: Station) -> None:
    """Record which copies their receivers report, on a page, as refused: they are not made again."""
    parcels, me = station.plant.parcels, station.fingerprint
    for row in parcels.all("out", "sent"):
        held = parcels.shared_in(row.id) if row.kind == "bundle" else []
        if not held:
            continue
        claims = station.plant.claims.of_nodes([held[0][0]]).get(held[0][0], {})
        claim = Claim.from_json(claims[row.peer]) if row.peer in claims else Claim()
        if any(bundle == row.about and peer == me for bundle, peer, _ in claim.refused):
            with station.durable(_COMMAND):
                parcels.turn_shared(row.id, "refused")
                _give_up(station, row)


def _make_copies(station: Station, roster: Roster, views: Views, now: datetime) -> None:
    """Make the copies that the roster's shares ask of this station."""
    me, quiet = station.fingerprint, silent_stations(station, roster, now)
    for receiver in sorted({to for share in roster.share for to in sharing.receivers(roster, me, share)}):
        clear, disputed = _due(station, roster, views, receiver, quiet)
        if not clear and not disputed:
            continue
        member = roster.member(receiver)
        assert member is not None
        to = TrustRecord(member.name, "station", member.point, receiver)
        with station.lock(_COMMAND):
            # apart, since disputed nodes wait for the receiver's operator and must not delay the others
            for part in (clear, disputed):
                for plan in outgoing.plan_copies(station, to, part, now, most=NODES) if part else ():
                    send_export(station, plan, now, by_share=True)


def _due(
    station: Station, roster: Roster, views: Views, receiver: str, quiet: set[str]
) -> tuple[list[bytes], list[bytes]]:
    """Return the nodes of which a receiver gets a copy from here, and apart those that stations disagree about."""
    me, parcels = station.fingerprint, station.plant.parcels
    shares = [share for share in roster.share if receiver in sharing.receivers(roster, me, share)]
    clear: list[bytes] = []
    disputed: list[bytes] = []
    own = _with_views(views, parcels.unshared(receiver))
    gone = quiet or roster.removed  # otherwise the station that made the key shares it
    others = _with_views(views, parcels.unshared(receiver, imported=True)) if gone else iter(())
    mine = (other for other in others if sharing.sharer(roster, other[3], (other[1], other[2]), quiet) == me)
    for uuid, _, _, view in chain(own, mine):
        if sharing.shares_any(shares, view, me) and not sharing.gave_away(view, receiver):
            (disputed if view.conflicts else clear).append(uuid)
    return clear, disputed


def _with_views(views: Views, rows: Sequence[tuple[bytes, int, str]]) -> Iterator[tuple[bytes, int, str, MergedClaims]]:
    """Yield nodes with the plant's view of them, a batch at a time."""
    for page in chunks(rows):
        seen = views([uuid for uuid, _, _ in page])
        yield from ((uuid, epoch, key_id, seen[uuid]) for uuid, epoch, key_id in page)


def _forget(station: Station, roster: Roster, views: Views) -> None:
    """Delete the keys of which all receivers of a share with ``forget`` have sent a receipt; a tap brings one back."""
    me, parcels = station.fingerprint, station.plant.parcels
    if not any(share.forget for share in roster.share):
        return
    for page in chunks(parcels.receipted()):
        seen = views([uuid for uuid, _, _ in page])
        for uuid, epoch, taken in page:
            shares = [share for share in roster.share if sharing.shares_any([share], seen[uuid], me)]
            if sharing.forgets(roster, me, shares, taken):
                _delete(station, uuid, epoch)


def _delete(station: Station, uuid: bytes, epoch: int) -> None:
    with station.durable(_COMMAND):
        for key in station.keys.keys_of(uuid):
            if key.epoch <= epoch:
                station.keys.remove_key(uuid, key.key_id)
        station.plant.record_event("forgot", uuid, epoch=epoch)
        station.audit("handover", uuid, "forgot", epoch=epoch)


def silent_stations(station: Station, roster: Roster, now: datetime) -> set[str]:
    """Return the other members that made no page within the last seven days, by the pages that arrived."""
    created = dict[str, datetime | None]()
    for digits, seen in station.plant.pages.chains().items():
        if roster.member(digits) is not None and digits != station.fingerprint:
            page = station.plant.pages.get(seen.id, *seen.counted) if seen.counted[0] else None
            at = page.created if page is not None else ""
            created[digits] = datetime.fromisoformat(at) if at else None
    return sharing.silent(created, now)
