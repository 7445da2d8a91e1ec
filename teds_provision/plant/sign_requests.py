"""Sign requests of a line to an office: the request, its transport, and the answer (contract/plant.md section 11)."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol
from uuid import UUID, uuid4

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    UnprovenError,
    UsageError,
)
from teds_provision.files import SHARED, read_limited, write_whole
from teds_provision.links import LinkSettings
from teds_provision.plant import connecting, parcels, postgres
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.jobs import find_job, now_of, roster_of
from teds_provision.plant.transport import SMALL, Parcel, Transport
from teds_provision.protocol import datasheet
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import CONTENT_TYPE
from teds_provision.protocol.handover.strict_json import decode_base64url, load_object, time_text
from teds_provision.protocol.keys import fingerprint, prove_message, verify
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.plant.document import SIGNED, DocumentKind, hash_of
from teds_provision.protocol.plant.job import Job
from teds_provision.protocol.plant.roster import MOST_AHEAD, Roster
from teds_provision.protocol.plant.signing import (
    NONCE_OCTETS,
    Answer,
    SignRequest,
    challenge,
    open_answer,
    open_request,
    seal_request,
)
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.build import own_name
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.sign import SignResult
from teds_provision.provisioning.teds_read import read_identity
from teds_provision.provisioning.visit import at_node
from teds_provision.station.plant.line import SignRequestRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, Image

DAYS: Final = 7
_LOOK_SECONDS: Final = 0.05
_MOST_LOOK_SECONDS: Final = 1.0


class OfficeRefusedError(PolicyError):
    """The office signs nothing; the message has its reason."""

    code = "office-refused"


class OfficeSilentError(UnprovenError):
    """The office did not answer in time; the request stays, and the same command carries on."""

    code = "no-answer"


# -- the transport: documents of a line, each sealed for its receiver --------------------------------------------------


def transport_for(station: Station, folder: Path | None) -> Transport:
    """Return the transport between the stations: the folder, or the registry that this station is connected to."""
    transport = FolderTransport(folder) if folder is not None else connecting.open_transport(station)
    if transport is None:
        raise PolicyError(
            "This station has no way to reach the other stations.", hint="Give a transfer folder: --files DIR"
        )
    return transport


def send(station: Station, transport: Transport, to: str, document: bytes, name: str) -> None:
    """Seal a signed document for a member and hand it over; ``name`` (a UUID) makes the same one the same parcel.

    Raises PolicyError (no member, no room), LinkError.
    """
    member = roster_of(station).member(to)
    if member is None:
        raise PolicyError(f"Station {to[:16]} is not a member of the plant.", hint="See: registry status")
    sealed = jose.encrypt(document, [member.point], cty=CONTENT_TYPE)
    until = time_text(datetime.now(UTC) + timedelta(days=DAYS))
    transport.send(Parcel(name, to, sealed, until, station.identity.fingerprint))


@dataclass(frozen=True)
class Delivery:
    """A document of a line that came for this station; ``drop`` throws its parcel away."""

    document: bytes
    drop: Callable[[], object]


class Inbox:
    """The documents of one kind for this station: those that a sync kept here, and those in the registry.

    Each is given once until it is dropped, and nothing is read twice; other parcels remain in the registry. ``collect``
    and ``wait`` are for one thread at a time.
    """

    def __init__(self, station: Station, transport: Transport, kind: DocumentKind) -> None:
        self._station, self._transport, self._kind = station, transport, kind
        self._known: set[str] = set()
        self._listener: postgres.Registry | None = None
        self._hears = isinstance(transport, postgres.PostgresTransport)

    def collect(self) -> list[Delivery]:
        """Return what came since; raises LinkError."""
        station, own = self._station, self._station.identity.fingerprint
        found = []
        for row, document in parcels.received(station, parcels.OF_A_LINE[self._kind.typ]):
            if row.id not in self._known:
                self._known.add(row.id)
                found.append(Delivery(document, partial(self._drop, row.id, station.plant.parcels.drop, "in")))
        for parcel in self._transport.new_parcels(own, self._known):
            self._known.add(parcel.id)
            opened = self._opened(parcel.octets)
            if opened is not None:
                found.append(Delivery(opened, partial(self._drop, parcel.id, self._transport.drop, own)))
        return found

    def _drop(self, parcel: str, drop: Callable[[str, Any], object], of: str) -> None:
        drop(parcel, of)
        self._known.discard(parcel)  # a repeated request has the same parcel ID

    def wait(self, seconds: float, pause: float) -> None:
        """Wait until a database notifies of a parcel, ``seconds`` at most; ``pause`` without notifications."""
        if self._hears:
            try:
                # parcels that arrived before the first listen cause no notification: look at once
                if self._listener is None:
                    self._listener = connecting.listener(self._station)
                    if self._listener is not None:
                        self._listener.listen()
                        return
                else:
                    self._listener.wait(seconds, parcel_to=self._station.identity.fingerprint)
                    return
            # the station has no connection left, or the server is shutting down: the next look shows this
            except LinkError:
                self.close()
            self._hears = False
        time.sleep(min(seconds, pause))

    def interrupt(self) -> None:
        """End what another thread waits for here."""
        if self._listener is not None:
            self._listener.interrupt()

    def start_over(self) -> None:
        """Give everything that is still there once more: the registry or the folder was out of reach meanwhile."""
        self.close()
        self._known.clear()
        self._hears = isinstance(self._transport, postgres.PostgresTransport)

    def close(self) -> None:
        """Let go of the connection that listens."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _opened(self, octets: bytes) -> bytes | None:
        if not octets.startswith(b"{"):
            return None
        try:
            document = jose.decrypt(octets, self._station.credentials().key, cty=CONTENT_TYPE, max_octets=SMALL)
            header = load_object(decode_base64url(document.partition(b".")[0], "The header"), "The header")
        except (BadDataError, NotAuthenticError, PolicyError):
            return None
        return document if header.get("typ") == self._kind.typ else None


def name_of(hash: str) -> str:
    """Return the id of the parcel that carries the document of this H: a UUIDv4 made from it."""
    return str(UUID(bytes=bytes.fromhex(hash)[:16], version=4))


def receivers(station: Station, job: Job) -> list[str]:
    """Return fingerprints of all stations that a job is for, but this one."""
    named = [*job.stations, *([job.office] if job.office is not None else [])]
    return [fromkey for fromkey in dict.fromkeys(named) if fromkey != station.identity.fingerprint]


def send_job(station: Station, transport: Transport, job: Job) -> None:
    """Send a job to all stations that it is for; the same again changes nothing."""
    for receiver in receivers(station, job):
        send(
            station,
            transport,
            receiver,
            job.octets,
            name_of(hashlib.sha256(f"{job.hash}{receiver}".encode()).hexdigest()),
        )


# -- making requests ---------------------------------------------------------------------------------------------------


class Office(Protocol):
    """Sends requests to an office, and receives its answers."""

    def request_signature(self, request: SignRequest) -> bytes | None:
        """Return the answer to a request, None if none came in time; a repetition is the same request."""


class RemoteOffice:
    """An office behind a registry or a folder; waits ``timeout`` seconds.

    Boards on several readers may wait at once: one thread checks the inbox, and stores answers for the others.
    """

    def __init__(self, station: Station, transport: Transport, timeout: float) -> None:
        self.station, self.transport, self.timeout = station, transport, timeout
        self._inbox = Inbox(station, transport, SIGNED)
        self._news = threading.Condition()
        self._came: dict[tuple[str, str], Delivery] = {}
        self._looking = False

    def request_signature(self, request: SignRequest) -> bytes | None:
        """Send the request and wait for its answer; what others than that office signed answers nothing."""
        send(self.station, self.transport, request.to, request.octets, name_of(request.hash))
        wanted = request.to, request.hash
        until, pause = time.monotonic() + self.timeout, _LOOK_SECONDS
        while True:
            with self._news:
                while self._looking and wanted not in self._came:
                    self._news.wait(max(0.0, until - time.monotonic()) + _LOOK_SECONDS)
                come = self._came.pop(wanted, None)
                self._looking = come is None
            if come is not None:
                come.drop()
                return come.document
            found: list[Delivery] = []
            try:
                found = self._inbox.collect()
                if not found:
                    self._inbox.wait(max(0.0, min(_MOST_LOOK_SECONDS, until - time.monotonic())), pause)
                    pause = min(2 * pause, _MOST_LOOK_SECONDS)
            finally:
                with self._news:
                    self._came |= {self._answered(delivery.document): delivery for delivery in found}
                    self._looking = False
                    self._news.notify_all()
            if not found and time.monotonic() >= until:
                return None

    def _answered(self, document: bytes) -> tuple[str, str]:
        """Return who signed an answer, and the H of its request; "" for an unknown signer."""
        try:
            payload = jose.verify_compact(
                document.strip(), roster_of(self.station).point_of, typ=SIGNED.typ, max_octets=SIGNED.most
            )
            return payload.kid, str(load_object(payload.payload, "The answer").get("of"))
        except (BadDataError, NotAuthenticError, PolicyError):
            return "", ""

    def close(self) -> None:
        """Let go of what carries."""
        self._inbox.close()
        self.transport.close()


class JoinedOffice:
    """An office behind the registry that this station is connected to, wherever ``registry connect`` moves it.

    A request that waits for its answer ends at the place at which it was made; the next one goes to the new place.
    """

    def __init__(self, station: Station, timeout: float) -> None:
        self._station, self._timeout = station, timeout
        self._lock = threading.Lock()
        self._place = connecting.place_of(station)
        self._offices = [RemoteOffice(station, transport_for(station, None), timeout)]

    def request_signature(self, request: SignRequest) -> bytes | None:
        """Return the answer to a request, None if none came in time; raises PolicyError if no registry is joined."""
        with self._lock:
            place = connecting.place_of(self._station)
            if place != self._place:
                self._offices.append(RemoteOffice(self._station, transport_for(self._station, None), self._timeout))
                self._place = place
            office = self._offices[-1]
        return office.request_signature(request)

    def close(self) -> None:
        """Close what was opened for each place; other readers may have waited at an earlier one until now."""
        for office in self._offices:
            office.close()


@dataclass
class FileOffice:
    """No office at hand: the request is written to a file, and nothing comes back."""

    path: Path

    def request_signature(self, request: SignRequest) -> bytes | None:
        """Write it down."""
        write_whole(self.path, request.octets + b"\n", mode=SHARED)
        return None


@dataclass(frozen=True)
class SignatureOrder:
    """Order to an office: the image without its Security TEDS, for which job, with which name, from what.

    ``profile`` is kept with the draft.
    """

    job: str
    office: str
    image: Image
    name: str | None
    calibration: bytes | None
    epoch: int
    sequence: int
    profile: str | None = None


def by_office(
    station: Station,
    office: Office,
    node: Conversation,
    keys: SignedNodeKey,
    wanted: SignatureOrder,
    on_node: bytes | None,
) -> SignResult:
    """Have the office sign, and keep the draft meanwhile; an earlier signature, and the node's, is not requested again.

    ``on_node``: the node's Security TEDS if its other TEDS are those of the image. An earlier request for the very same
    datasheet is repeated unchanged, so that no second one is made. Raises OfficeSilentError (5), OfficeRefusedError
    (6), NotAuthenticError (the answer is not the office's, or signs something else).
    """
    roster = roster_of(station)
    if on_node is not None and _says_the_same(station, roster, keys, wanted, on_node):
        return SignResult(wanted.image.with_block(SECURITY, on_node), security.decode(on_node).sequence, reused=True)
    earlier = _earlier(station, wanted)
    if earlier is not None and earlier.answer is not None:
        signed = _taken(station, roster, keys, wanted, earlier.request, earlier.answer)
        if signed.sequence > wanted.sequence:
            return SignResult(signed.image, signed.sequence, reused=True)
        earlier = None
    if earlier is not None:
        request = open_request(earlier.request, lambda kid: station.point)
    else:
        request = _new_request(station, node, keys, wanted)
    answer = office.request_signature(request)
    if answer is None:
        raise OfficeSilentError(
            f"The office {roster.name_of(wanted.office)} has not answered yet.",
            hint="The request is kept. Run the same command again once the office has signed.",
        )
    signed = _taken(station, roster, keys, wanted, request.octets, answer)
    row = SignRequestRow(
        request.hash, "out", wanted.job, keys.uuid, wanted.office, request.octets, answer, signed.sequence
    )
    with station.durable("sign"):
        station.plant.line.put_sign_request(row)
        station.datasheets.keep_draft(Draft(keys.uuid, signed.image, "signed", wanted.profile))
        station.nodes.remember(keys.uuid, sequence=signed.sequence)
        station.audit("sign", keys.uuid, "by office", sequence=signed.sequence, office=wanted.office)
    return signed


@dataclass(frozen=True)
class OfficeOrder:
    """A request to ``sign --by``: a node, the office by name, the job by id, the calibration; and the transport.

    ``output``: the request is written there, without a wait.
    """

    node: str
    by: str
    job: str | None
    calibration: Path | None
    files: Path | None
    output: Path | None


def sign_by_office(station: Station, links: LinkSettings, order: OfficeOrder, reporter: Reporter) -> SignResult:
    """Have an office sign the draft of the node at hand, and keep it, signed, until it is written.

    Raises UsageError (no job), NotFoundError (no draft), and what :func:`by_office` raises.
    """
    if order.job is None:
        raise UsageError("An office only signs for a job.", hint="Name it: --job ID; see: teds-provision job list")
    job = find_job(station, order.job)
    member = roster_of(station).named(order.by)
    if member is None or member.fingerprint != job.office:
        raise PolicyError(f"The job “{job.title}” names another office than {order.by}.")
    uuid = station.nodes.resolve(order.node)
    draft = station.datasheets.draft(uuid)
    if draft is None:
        raise NotFoundError(
            f"Nothing has been built for node {uuid.hex()}.", hint=f"To build it: teds-provision build {uuid.hex()}"
        )
    with ExitStack() as stack:
        office: Office
        if order.output is not None:
            office = FileOffice(order.output)
        else:
            office = RemoteOffice(station, transport_for(station, order.files), links.timeout)
            stack.callback(office.close)
        with at_node(station, links, uuid, reporter, unlock="always") as visit:
            require_session(station, visit.node)
            identity, image = read_identity(visit.node), Image(uuid, draft.image.unsigned_blocks())
            keys = SignedNodeKey(uuid, visit.who.point, visit.who.key_signature)
            octets = read_limited(order.calibration, 1 << 20, "calibration") if order.calibration is not None else None
            name = own_name(station, image, draft.profile)
            wanted = SignatureOrder(
                job.id, job.office, image, name, octets, identity.epoch, identity.sequence, draft.profile
            )
            signed = by_office(station, office, visit.node, keys, wanted, None)
    with station.durable("sign"):
        station.datasheets.keep_draft(Draft(uuid, signed.image, "signed", draft.profile))
    return signed


def _earlier(station: Station, wanted: SignatureOrder) -> SignRequestRow | None:
    """Return the newest request for exactly this epoch, name and content if it still holds, else None.

    The newest is that of the highest sequence: a clock that was set back does not bring an older one to the front. One
    without an answer that a wrong clock dated too far ahead does not hold: no office takes it before its time.
    """
    found: tuple[int, bool, SignRequestRow] | None = None
    latest = now_of(roster_of(station)) + MOST_AHEAD
    for row in station.plant.line.sign_requests(wanted.job, wanted.image.uuid, "out"):
        if row.peer != wanted.office:
            continue
        request = open_request(row.request, lambda kid: station.point)
        if row.answer is None and request.created > latest:
            continue
        same = (request.epoch, request.name, request.calibration) == (wanted.epoch, wanted.name, wanted.calibration)
        if same and request.image.unsigned_blocks() == wanted.image.unsigned_blocks():
            place = (request.sequence, row.answer is not None)
            if found is None or place > found[:2]:
                found = (*place, row)
    if found is None:
        return None
    sequence, answered, newest = found
    return newest if answered or sequence == wanted.sequence else None


def _new_request(station: Station, node: Conversation, keys: SignedNodeKey, wanted: SignatureOrder) -> SignRequest:
    """Return a new request, signed by the board; kept before it leaves this station."""
    nonce, key = os.urandom(NONCE_OCTETS), station.credentials().key
    blocks = wanted.image.unsigned_blocks()
    asked = challenge(nonce, key.point, keys.uuid, wanted.epoch, wanted.sequence, blocks)
    proof = node.request_idempotent(security_command(Function.PROVE, asked), "to sign the request to the office")
    if not verify(keys.key, prove_message(keys.uuid, asked), proof):
        raise NotAuthenticError("The node's signature of the request does not match the key it presented.")
    unsigned = SignRequest(
        str(uuid4()),
        wanted.office,
        datetime.now(UTC).replace(microsecond=0),
        wanted.job,
        Image(keys.uuid, blocks),
        wanted.epoch,
        wanted.sequence,
        wanted.name,
        wanted.calibration,
        keys.key,
        keys.signature,
        nonce,
        proof,
    )
    octets = seal_request(unsigned, key)
    request = replace(unsigned, hash=hash_of(octets), signer=fingerprint(key.point), line=key.point, octets=octets)
    with station.durable("sign"):
        station.plant.line.put_sign_request(
            SignRequestRow(request.hash, "out", wanted.job, keys.uuid, wanted.office, octets)
        )
        station.datasheets.keep_draft(Draft(keys.uuid, wanted.image, "built", wanted.profile))
    return request


def _taken(
    station: Station, roster: Roster, keys: SignedNodeKey, wanted: SignatureOrder, request: bytes, octets: bytes
) -> SignResult:
    """Return the image with the office's signature.

    Raises OfficeRefusedError, NotAuthenticError (not its answer, or something else).
    """
    office = roster.point_of(wanted.office)
    answer = open_answer(octets, lambda kid: office if kid == wanted.office else None)
    if answer.of != hash_of(request):
        raise NotAuthenticError("The office's answer belongs to another request.")
    if answer.refused:
        raise _refusal(roster, wanted, answer)
    if not _says_the_same(station, roster, keys, wanted, answer.security, by=wanted.office):
        raise NotAuthenticError(
            "The office signed something other than what was requested.", hint="Ask the owner to check this office."
        )
    return SignResult(wanted.image.with_block(SECURITY, answer.security), answer.sequence, reused=False)


def _refusal(roster: Roster, wanted: SignatureOrder, answer: Answer) -> TedsProvisionError:
    hints = {
        "job": "Ask the operator of the office: signer run --job ID.",
        "full": "Set the board aside, or ask the keeper for another job.",
        "differs": "Station and office need the same profile and version of the program.",
        "sequence": "Someone at the office must confirm it: signer once FILE --jump",
    }
    return OfficeRefusedError(
        f"The office {roster.name_of(wanted.office)} does not sign ({answer.refused}): {answer.why.rstrip('.')}.",
        hint=hints.get(answer.refused, ""),
    )


def _says_the_same(
    station: Station,
    roster: Roster,
    keys: SignedNodeKey,
    wanted: SignatureOrder,
    octets: bytes,
    *,
    by: str | None = None,
) -> bool:
    """Return True if a Security TEDS signs exactly this for this board and epoch.

    Its signer must be a member with ``sign`` (or ``by``).
    """
    try:
        shown = security.decode(octets)
    except BadDataError:
        return False
    signer = fingerprint(shown.station_key) if shown.station_key is not None else ""
    return (
        shown.signed
        and (shown.node_key, shown.node_key_signature) == (keys.key, keys.signature)
        and roster.has(signer, "sign")
        and by in (None, signer)
        and shown.key_epoch == wanted.epoch
        and shown.signed_blocks == datasheet.digests(wanted.image.blocks)
        and datasheet.is_certified(station.identity.ca, shown.station_key, shown.station_key_signature)
        and datasheet.signature_good(shown, octets, keys.uuid)
    )
