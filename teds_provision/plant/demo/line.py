"""A line on one machine: an order for three boards, an office that signs, a bench that builds, and proof of each.

Faults on purpose: a board of another type, one board too many, and one that is changed afterwards.
"""

from __future__ import annotations

import json
import secrets
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from teds_provision.demo.story import PROFILE, Demo, make_node, new_station, run_node, temporary_demo
from teds_provision.errors import LinkError, PolicyError
from teds_provision.handover import trust
from teds_provision.plant import apply_pages, jobs, owner
from teds_provision.plant.evidence import export
from teds_provision.plant.jobs import take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import answer
from teds_provision.plant.verify_evidence import EvidenceAnchors, EvidenceTotals, judge_file
from teds_provision.protocol.plant.document import MemberRequest
from teds_provision.protocol.plant.job import CalibrationRule, Job, seal_job
from teds_provision.protocol.plant.roster import Role
from teds_provision.protocol.plant.signing import SignRequest
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import Reporter, SilentReporter, StepResult
from teds_provision.provisioning.provision import ProvisionResult, provision, verify_only
from teds_provision.provisioning.verify import require_authentic
from teds_provision.station.station import Station
from teds_provision.teds.profile.load import default_folders, files_digest, find_profile

OTHER = "tactile-finger-sensor"
BOARDS = 3
_LOGIN = "SCRAM-SHA-256$4096:" + "A" * 22 + "==$" + "B" * 43 + "=:" + "C" * 43 + "="
"""A verifier without a password: there are no logins in the demo."""


@dataclass(frozen=True)
class LineDemoResult:
    """Result of the line: its steps, units that passed, evidence by verdict, and the boards that were refused."""

    steps: tuple[StepResult, ...]
    passed: int
    evidence: dict[str, int]
    refused: tuple[str, ...]


class _LocalOffice:
    """The office, in this process: a request goes to it directly."""

    def __init__(self, station: Station) -> None:
        self._station = station

    def request_signature(self, request: SignRequest) -> bytes | None:
        return answer(self._station, request.octets)


def run_line(reporter: Reporter, say: Callable[[str], None]) -> LineDemoResult:
    """Run it; raises whatever a step raises. The folder is gone afterwards, however it ends."""
    with temporary_demo(reporter, say) as demo:
        return _run(demo)


def _run(demo: Demo) -> LineDemoResult:
    demo.say("One owner: the office has the CA key and signs; the bench keys boards but signs nothing.")
    office, bench = _plant(demo)
    demo.say(f"The order: {BOARDS} boards of one type, a job signed by the office as keeper.")
    line = _job(demo, office, bench)
    folders, refused = {}, []
    demo.say("The bench works through it, board after board. One of them is of a different type.")
    for name, profile in (("one", PROFILE), ("other", OTHER), ("two", PROFILE), ("three", PROFILE), ("four", PROFILE)):
        folders[name] = make_node(demo, name, profile)
        with demo.steps.step(f"board {name}") as step, run_node(folders[name], "--nfc", demo.nfc) as uuid:
            try:
                step.detail = f"unit {_build(demo, line, uuid)} of {BOARDS}"
            except PolicyError as error:
                step.detail = error.message
                refused.append("wrong-board" if isinstance(error, WrongBoardError) else "one too many")
    demo.say("Then an intruder changes a TEDS in board two's flash. The office tests boards one and two.")
    _tamper(folders["two"])
    tests = LineRun(office, line.job, only_verify=True)
    for name in ("one", "two"):
        with (
            demo.steps.step(f"test {name}") as step,
            run_node(folders[name], "--nfc", demo.nfc) as uuid,
            meet(office, demo.over("nfc"), uuid, SilentReporter()) as node,
        ):
            step.detail = verify_only(office, node, tests, SilentReporter()).verified.verdict
    totals = _proof(demo, office, bench)
    return LineDemoResult(tuple(demo.steps.done), line.passed, totals.words, tuple(refused))


def _plant(demo: Demo) -> tuple[Station, Station]:
    office = new_station(demo, "office")
    with demo.steps.step("registry") as step:
        owner.create(office, "demo")
        home = demo.folder / "bench"
        secret = secrets.token_hex(16)
        asked = trust.ask_for_certificate(home, name="bench", keystore="file", ask=lambda prompt, confirm: secret)
        certificate = trust.sign_request(office, trust.read_request(asked))
        bench = trust.adopt_certificate(home, certificate, ask=lambda prompt, confirm: secret)
        demo.stack.callback(bench.close)
        now = datetime.now(UTC).replace(microsecond=0)
        request = MemberRequest(bench.name, bench.point, bench.identity.signature, _LOGIN, now)
        roles: frozenset[Role] = frozenset({"line"})
        apply_pages.put_roster(office, owner.signed(office, owner.add(office, request, roles)))
        roster = jobs.roster_of(office)
        owner.join(bench, roster, url=None, events=[])
        step.detail = f"roster {roster.version}: office keeper, sign; bench line"
    office.unlock()
    bench.unlock()
    return office, bench


def _job(demo: Demo, office: Station, bench: Station) -> LineRun:
    with demo.steps.step("job") as step:
        now = datetime.now(UTC).replace(microsecond=0)
        drafted = Job(
            str(uuid.uuid4()),
            jobs.roster_of(office).registry,
            "three angles",
            PROFILE,
            files_digest(find_profile(PROFILE), default_folders()),
            CalibrationRule(),
            BOARDS,
            {},
            now - timedelta(minutes=1),
            now + timedelta(days=1),
            {bench.fingerprint: BOARDS, office.fingerprint: 0},
            "tap",
            sign=office.fingerprint,
            name="angle {unit:03}",
        )
        document = seal_job(drafted, office.credentials().key)
        take_job(office, document)
        job = take_job(bench, document)
        step.detail = f"“{job.title}”, {job.total} boards, signed by office"
    return LineRun(bench, job, office=_LocalOffice(office))


def _build(demo: Demo, line: LineRun, uuid: bytes) -> int:
    """Provision one board of the job; its unit."""
    with meet(line.station, demo.over("nfc"), uuid, SilentReporter()) as node:
        done: ProvisionResult = provision(
            line.station, node, line.order, operator=AcceptingOperator(), reporter=SilentReporter(), line=line
        )
    require_authentic(done.verified)
    return int(line.unit_to_json(uuid)["unit"])


def _tamper(folder: Path) -> None:
    """Change a digit of a TEDS in the flash of a virtual node, bypassing its station and its key."""
    file = folder / "flash.json"
    document = json.loads(file.read_text(encoding="utf-8"))
    blocks = document["flash"]["blocks"]
    place = next(at for at, (channel, code, _) in enumerate(blocks) if (channel, code) == (0, 12))
    channel, code, teds = blocks[place]
    blocks[place] = [channel, code, teds[:-6] + ("0" if teds[-6] != "0" else "1") + teds[-5:]]
    file.write_text(json.dumps(document), encoding="utf-8")


def _proof(demo: Demo, office: Station, bench: Station) -> EvidenceTotals:
    """Export the evidence of both stations, and check it with nothing but files."""
    totals = EvidenceTotals()
    demo.say("Evidence of both stations, verified from files and the CA key alone.")
    with demo.steps.step("evidence") as step:
        for station in (bench, office):
            rows = station.plant.line.evidence()
            for path in export(station, rows, demo.folder / "evidence" / station.name):
                totals.add(judge_file(EvidenceAnchors(office.ca, roster=jobs.roster_of(office)), path))
        if totals.exit_code:
            raise LinkError(f"The demo's evidence is not valid: {totals.words}")
        step.detail = f"{totals.files} files valid: " + ", ".join(f"{n} {word}" for word, n in totals.words.items())
    return totals
