"""The office builds every datasheet itself and signs nothing that it did not make (contract/plant.md section 11)."""

from __future__ import annotations

import hashlib
import re
import time
import tomllib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError, TedsProvisionError
from teds_provision.plant.jobs import (
    now_of,
    profile_file,
    read_job,
    require_adopted,
    require_open,
    require_profile,
    roster_of,
)
from teds_provision.plant.sign_requests import Inbox, name_of, send
from teds_provision.plant.transport import Transport
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import fingerprint, node_key_good, prove_message, verify
from teds_provision.protocol.plant.document import hash_of
from teds_provision.protocol.plant.job import Job
from teds_provision.protocol.plant.roster import MOST_AHEAD
from teds_provision.protocol.plant.signing import Answer, SignRequest, open_answer, open_request, seal_answer
from teds_provision.provisioning.build import check_name
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.sign import sign
from teds_provision.station.plant.line import SignRequestRow, UnitRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry, utc_now
from teds_provision.teds.calibration.files import read_calibrations
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile.load import default_folders, load_profile
from teds_provision.teds.profile.model import Profile

MOST_ANSWERS: Final = 16
"""So many datasheets are signed for one unit."""
MOST_JUMP: Final = 65_535
_MAX_CALIBRATION: Final = 1 << 20


class RequestAheadError(PolicyError):
    """A request is dated further in the future than two clocks differ: it is not taken yet, and no answer is due."""


class _RefusedError(Exception):
    """The office signs nothing: one word of the contract, and why."""

    def __init__(self, word: str, why: str) -> None:
        super().__init__(why)
        self.word, self.why = word, why


def answer(station: Station, octets: bytes, jobs: Collection[str] | None = None, *, jump: bool = False) -> bytes | None:
    """Answer a request, signed by this office; None for requests without an answer (another office's, malformed).

    ``jobs``: only these ids (None: every job that is kept here). ``jump``: an operator accepts any sequence. A
    datasheet, its unit, its sequence and the ``signed`` event are durable before the answer is returned; the same
    request (H) gets the same answer again. Raises StoreError, VaultError, RequestAheadError and PolicyError (this
    station is no office now).
    """
    roster = roster_of(station)
    if not roster.has(station.identity.fingerprint, "sign"):
        raise PolicyError(
            "This station may not sign datasheets: it does not have the role 'sign' in the roster.",
            hint="Ask the owner for it: teds-provision registry role NAME sign",
        )
    require_adopted(station)
    try:
        request = open_request(octets, roster.point_of)
    except (BadDataError, NotAuthenticError):
        return None
    if request.to != station.identity.fingerprint:
        return None
    if request.created > now_of(roster) + MOST_AHEAD:
        raise RequestAheadError(
            f"{roster.name_of(request.signer)} dated this request {time_text(request.created)}, and it is"
            f" {time_text(now_of(roster))} here.",
            hint=f"Set the clock of {roster.name_of(request.signer)}, or that of this machine, and ask again.",
        )
    key = station.credentials().key
    if not roster.has(request.signer, "line"):
        return seal_answer(
            Answer(request.hash, refused="not-line", why="the sender does not have the role 'line'"), key
        )
    kept = station.plant.line.sign_request(request.hash, "in")
    if kept is not None and kept.answer is not None:
        return kept.answer
    try:
        return _signed(station, request, jobs, jump=jump)
    except _RefusedError as refused:
        with station.durable("signer"):
            facts = {"by": request.signer, "job": request.job, "why": refused.why}
            station.audit("sign-request", request.uuid, refused.word, **facts)
        return seal_answer(Answer(request.hash, refused=refused.word, why=refused.why[:1000]), key)


def answer_all(
    station: Station,
    transport: Transport,
    inbox: Inbox,
    jobs: Collection[str] | None = None,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[AnsweredRequest]:
    """Answer all received requests in turn; each request's parcel is dropped only after its answer was sent."""
    for come in inbox.collect():
        if stop():
            return
        try:
            sealed = answer(station, come.document, jobs)
        except RequestAheadError as ahead:  # left in the inbox until its time has come
            station.notice(f"Not signed: {ahead.message}")
            continue
        if sealed is not None:
            request = open_request(come.document, roster_of(station).point_of)
            if roster_of(station).member(request.signer) is not None:
                send(station, transport, request.signer, sealed, name_of(hash_of(sealed)))
            answered = open_answer(sealed, lambda kid: station.point)
            yield AnsweredRequest(request, answered)
        come.drop()


@dataclass(frozen=True)
class AnsweredRequest:
    """A request and what was answered."""

    request: SignRequest
    answer: Answer


def _signed(station: Station, request: SignRequest, jobs: Collection[str] | None, *, jump: bool) -> bytes:
    """Return the answer to a good request; raises _Refused. The order of the checks is the contract's."""
    job = _job_of(station, request, jobs)
    revoked = station.policy.revocation(request.uuid)
    if revoked is not None:
        raise _RefusedError("revoked", f"the node was revoked: {revoked.why}")
    _require_its_key(station, job, request)
    if not node_key_good(request.uuid, request.point, request.key_signature):
        raise _RefusedError("proof", "field 102 does not sign this key for this UUID")
    if not verify(request.point, prove_message(request.uuid, request.challenge()), request.proof):
        raise _RefusedError("proof", "the board did not sign this request")
    _require_room(station, job, request)
    known = station.nodes.get(request.uuid)
    if not jump and request.sequence > (known.sequence if known is not None else 0) + MOST_JUMP:
        raise _RefusedError(
            "sequence", f"sequence {request.sequence} is more than {MOST_JUMP} ahead of the one known here"
        )
    image = _built(station, job, request)
    with station.durable("signer"):
        meanwhile = station.plant.line.sign_request(request.hash, "in")
        if meanwhile is not None and meanwhile.answer is not None:  # another `signer` process was faster
            return meanwhile.answer
        row = _require_room(station, job, request)  # check again: another signer may have taken the last unit
        station.plant.line.put_unit(row)
        if station.pins.entry(request.uuid) is None:
            station.pins.put(WhitelistEntry(request.uuid, fingerprint(request.point), assurance="uuid"))
            station.nodes.remember(request.uuid, point=request.point)
        signed = sign(
            station,
            SignedNodeKey(request.uuid, request.point, request.key_signature),
            image,
            epoch=request.epoch,
            node_sequence=request.sequence,
            profile=job.profile,
            unit=(job.id, row.unit),
        )
        made = Answer(request.hash, signed.sequence, signed.image.blocks[SECURITY])
        sealed = seal_answer(made, station.credentials().key)
        station.plant.line.put_sign_request(
            SignRequestRow(
                request.hash, "in", job.id, request.uuid, request.signer, request.octets, sealed, signed.sequence
            )
        )
        station.audit("sign-request", request.uuid, "signed", by=request.signer, job=job.id, unit=row.unit)
    return sealed


def _job_of(station: Station, request: SignRequest, jobs: Collection[str] | None) -> Job:
    row = station.plant.line.job(request.job)
    if row is None or (jobs is not None and request.job not in jobs):
        raise _RefusedError("job", "this office is not working on that job")
    try:
        job = read_job(station, row.octets)
        require_open(station, job, for_station=request.signer)
    except TedsProvisionError as error:
        raise _RefusedError("job", error.message) from error
    if job.office != station.identity.fingerprint:
        raise _RefusedError("job", "the job names another office")
    if job.boards and request.uuid not in job.boards:
        raise _RefusedError("job", "the board is not on the job's list")
    return job


def _require_its_key(station: Station, job: Job, request: SignRequest) -> None:
    own = fingerprint(request.point)
    listed = job.boards.get(request.uuid)
    entry = station.pins.entry(request.uuid)
    pinned = entry.fingerprint if entry is not None else None
    for known, where in ((listed, "the job lists"), (pinned, "this office knows")):
        if known is not None and not same_key(known, own):
            raise _RefusedError("other-key", f"{where} the board with another key")
    try:
        station.pins.check(request.uuid, request.point)
    except PolicyError as error:
        raise _RefusedError("other-key", error.message) from error


def _require_room(station: Station, job: Job, request: SignRequest) -> UnitRow:
    """Return the unit that the board has or gets, with one more answer; raises _Refused if there is none."""
    line = station.plant.line
    kept = line.unit(job.id, request.uuid)
    if kept is None:
        given, _, greatest = line.count_units(job.id)
        if given >= job.total:
            raise _RefusedError("full", f"all {job.total} units of the job are assigned")
        return UnitRow(job.id, request.uuid, greatest + 1, utc_now())
    answers = sum(row.sequence is not None for row in line.sign_requests(job.id, request.uuid, "in"))
    if station.identity.fingerprint not in job.stations:
        # after a restore from a backup, the pages have the count; the requests since then are not stored here
        answers = max(answers, kept.attempts)
    if answers >= MOST_ANSWERS:
        raise _RefusedError("full", f"the unit already has {MOST_ANSWERS} answers")
    return replace(kept, attempts=answers + 1)


def _built(station: Station, job: Job, request: SignRequest) -> Image:
    """Return the datasheet as this office makes it, with the read-only TEDS that the job lists; raises _Refused."""
    now = now_of(roster_of(station))
    try:
        profile = _profile(station, job)
        calibrations = _calibrations(job, request, profile, now)
        check_name(request.name)
        built = profile.build(request.uuid, calibration=calibrations, name=request.name)
    except TedsProvisionError as error:
        raise _RefusedError("differs", error.message) from error
    sent = request.image.unsigned_blocks()
    blocks = {**built.blocks, **{block: sent[block] for block in job.read_only if block in sent}}
    image = Image(request.uuid, blocks)
    try:
        guard(station, image, None, None, calibrations, profile, record=False)
    except PolicyError as error:
        raise _RefusedError("guard", error.message) from error
    wrong = sorted(block for block in sent.keys() | blocks.keys() if sent.get(block) != blocks.get(block))
    if wrong:
        named = ", ".join(f"TEDS {code} of channel {channel}" for channel, code in wrong[:5])
        raise _RefusedError("differs", f"this office would build it differently: {named}")
    _require_name(job, request)
    return image


def _require_name(job: Job, request: SignRequest) -> None:
    if job.name is None:
        return
    pattern = re.escape(job.name)
    for field, what in (("uuid8", re.escape(request.uuid.hex()[:8])), ("uuid", re.escape(request.uuid.hex()))):
        pattern = pattern.replace(re.escape(f"{{{field}}}"), what)
    pattern = re.sub(r"\\\{unit(?::0[1-9])?\\\}", r"[0-9]{1,10}", pattern)
    if request.name is None or not re.fullmatch(pattern, request.name):
        raise _RefusedError("differs", f"the name {request.name!r} does not follow the job's pattern")


def _calibrations(job: Job, request: SignRequest, profile: Profile, now: datetime) -> dict[int, Calibration]:
    octets, rule = request.calibration, job.calibration
    if rule.rule == "none":
        if octets is not None:
            raise _RefusedError("job", "the job does not allow a calibration")
        return {}
    if octets is None or len(octets) > _MAX_CALIBRATION:
        raise _RefusedError("job", "the job requires a calibration, and the request has none")
    wanted = rule.wants(request.uuid)
    if rule.rule != "any" and hashlib.sha256(octets).hexdigest() != wanted:
        raise _RefusedError("job", "the calibration is not the one the job specifies")
    found = read_calibrations(*_text_of(octets), profile)
    if rule.rule == "any":
        days = timedelta(days=rule.max_age_days or 0)
        if any(
            calibration.date is None or not now - days <= calibration.date <= now + timedelta(days=1)
            for calibration in found.values()
        ):
            raise _RefusedError("job", f"the calibration is older than {days.days} days, or has no date")
    return found


def _text_of(octets: bytes) -> tuple[str, str]:
    """Return the text of a calibration file, and a name with its kind: certificate, JSON, TOML, else CSV."""
    try:
        text = octets.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadDataError("The calibration is not UTF-8 text.") from error
    if text.lstrip()[:1] == "<":
        return text, "certificate.xml"
    if text.lstrip()[:1] in ("{", "["):
        return text, "calibration.json"
    try:
        tomllib.loads(text)
    except (ValueError, RecursionError):
        return text, "calibration.csv"
    return text, "calibration.toml"


def _profile(station: Station, job: Job) -> Profile:
    path = profile_file(station, job)
    seen = path.stat()
    state = seen.st_mtime_ns, seen.st_ino, seen.st_size
    profile = _loaded(str(path), state, int(time.monotonic()), station.home)
    require_profile(station, job, path)  # the file may have changed while it was read
    return profile


@lru_cache(maxsize=16)
def _loaded(path: str, _state: tuple[int, ...], _second: int, home: Path) -> Profile:
    """Return the profile of a job's boards; read again each second, as those that it extends may change."""
    return load_profile(Path(path), default_folders(home))
