"""A line's figures: evidence beside the bare signature checks, signatures of an office a second, boards an hour.

Run: ``python -m benchmarks.line [FILES]`` (default 10,000; about two minutes). Evidence is checked by the shipped
command on all cores, from its start to its last line; theirs is what ``openssl speed ecdsap256`` measures on this
machine now, times four (envelope, fields 100 and 102, the board's proof). The office answers requests that are signed
and proven by as many boards, in memory and on one core: build, guard, compare, sign, durable. A line builds boards in
memory with and without a job and evidence, in turn.

No Python program comes near the bare checks: it also prints what the libraries alone need for one file, in turns in one
process (file by the system's calls, both JSON texts and the base64 read, the form that the board signed written,
the board's key loaded, four checks).
"""

from __future__ import annotations

import binascii
import compileall
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import teds_provision
from benchmarks.bare_checks import (
    PREHASHED,
    ROW,
    FileCost,
    SignedDigest,
    cost_of_a_file,
    load_key,
    octets_of,
    signed_digest,
)
from benchmarks.machine import checks_a_second
from teds_provision.plant.jobs import take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import answer
from teds_provision.plant.verify_evidence import EvidenceAnchors, judge_files
from teds_provision.protocol.keys import (
    SoftwareKey,
    from_pem,
    node_key_message,
    prove_message,
    to_pem,
)
from teds_provision.protocol.plant.evidence import EvidenceClaim, pae, read, ready, seal
from teds_provision.protocol.plant.signing import SignRequest, challenge, seal_request
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import Board, talk
from tests.plant.owner import ANGLE, NOW, alone, job_of
from tests.plant.proofs import facts_of

CHECKS = 4
FINISHED = "2026-03-01T11:31:00Z"
AIM, OFFICE_AIM, LINE_AIM = 1.4, 50.0, 0.93
REQUESTS, BOARDS = 200, 40


def evidence(folder: Path, count: int) -> Path:
    """Make ``count`` evidence documents, each of a board with its own key; the CA's key is beside them."""
    owner = alone(folder / "home")
    owner.unlock()
    credentials, profile = owner.credentials(), load_profile(ANGLE)
    (folder / "files").mkdir()
    from teds_provision.protocol.datasheet import SignedNodeKey, digests, sign_datasheet, unsigned_datasheet

    for number in range(count):
        key, uuid = SoftwareKey.generate(), (1 + number).to_bytes(10, "big")
        keys = SignedNodeKey(uuid, key.point, key.sign(node_key_message(uuid, key.point)))
        listed = digests(profile.build(uuid).blocks)
        unsigned = unsigned_datasheet(
            keys, owner.point, owner.identity.signature, listed, ca="ca:0", sequence=1, key_epoch=1
        )
        teds = sign_datasheet(unsigned, uuid, credentials)
        claim = EvidenceClaim(uuid, teds, facts_of(owner, teds))
        nonce = os.urandom(16)
        proof = key.sign(prove_message(uuid, claim.challenge(nonce)))
        document = seal(
            credentials.key,
            credentials.station_signature,
            claim,
            nonce=nonce,
            proof=proof,
            finished="2026-03-01T11:31:00Z",
        )
        (folder / "files" / f"{uuid.hex()}.1.json").write_bytes(document)
    (folder / "ca.pem").write_text(to_pem(owner.identity.ca))
    owner.close()
    return folder / "files"


def verify_all(files: Path, ca: Path) -> tuple[float, float, str]:
    """Return seconds on the wall and of the processor, and the last line."""
    command = [sys.executable, "-m", "teds_provision", "-q", "evidence", "verify", str(files), "--ca", str(ca)]
    before, began = _used(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return time.perf_counter() - began, _used() - before, (done.stdout.splitlines() or [done.stderr])[-1]


def _used() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def cost(files: Path, ca: Path, count: int = 60 * ROW) -> FileCost:
    """Return what a document costs; its four bare checks have their keys loaded."""
    anchors = EvidenceAnchors(from_pem(ca.read_bytes()))
    return cost_of_a_file(
        sorted(files.iterdir())[:count],
        signed=_signed,
        ours=lambda row: judge_files(anchors, list(map(str, row))),
        libraries=_libraries,
    )


def _signed(path: Path) -> list[SignedDigest]:
    """Return the four checks of a document."""
    signed = ready(read(path.read_bytes()))
    document, shown = signed.evidence, signed.shown
    assert shown is not None
    assert shown.station_key is not None
    assert shown.signature is not None
    envelope = SignedDigest(document.station, document.signature, hashlib.sha256(pae(document.payload)).digest())
    return [
        envelope,
        signed_digest(shown.node_key, node_key_message(document.uuid, shown.node_key), shown.node_key_signature),
        signed_digest(shown.station_key, signed.datasheet, shown.signature),
        signed_digest(document.node, signed.board, document.proof),
    ]


def _libraries(row: list[Path], signed: list[list[SignedDigest]]) -> None:
    """Read and check a row of documents, and look at nothing else."""
    for path in row:
        payload = binascii.a2b_base64(json.loads(octets_of(path))["payload"], strict_mode=True)
        statement = json.loads(payload)
        bound = {"facts": statement["predicate"]["facts"], "subject": statement["subject"]}
        json.dumps(bound, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
        hashlib.sha256(payload).digest()
    station = load_key(signed[0][0].point)
    for envelope, node_key, datasheet, board in signed:
        node = load_key(board.point)
        for key, check in ((station, envelope), (node, node_key), (station, datasheet), (node, board)):
            key.verify(check.der, check.digest, PREHASHED)


def office(folder: Path, count: int) -> tuple[float, float]:
    """Return an office's signatures a second, on the wall and of the processor."""
    owner = alone(folder / "office")
    owner.unlock()
    own = owner.identity.fingerprint
    job = take_job(owner, job_of(owner, count=count, stations={own: count}, sign=own))
    key, profile, asked = owner.credentials().key, load_profile(ANGLE), []
    for number in range(count):
        node, uuid = SoftwareKey.generate(), (1 + number).to_bytes(10, "big")
        blocks = profile.build(uuid).blocks
        nonce = os.urandom(16)
        proof = node.sign(prove_message(uuid, challenge(nonce, owner.point, uuid, 1, 0, blocks)))
        signed = node.sign(node_key_message(uuid, node.point))
        id = f"{number:08x}-2222-4333-8444-555555555555"
        request = SignRequest(
            id, own, NOW, job.id, Image(uuid, blocks), 1, 0, None, None, node.point, signed, nonce, proof
        )
        asked.append(seal_request(request, key))
    answer(owner, asked[0])
    began, used = time.perf_counter(), time.process_time()
    for octets in asked[1:]:
        assert answer(owner, octets) is not None
    wall, cpu = time.perf_counter() - began, time.process_time() - used
    owner.close()
    return (count - 1) / wall, (count - 1) / cpu


def boards(folder: Path, count: int) -> tuple[float, float]:
    """Return processor seconds of a board without a line, and with job and evidence; in turn, in one store each."""
    plain, line = alone(folder / "plain"), alone(folder / "line")
    plain.unlock()
    line.unlock()
    own = line.identity.fingerprint
    run = LineRun(line, take_job(line, job_of(line, count=count, stations={own: count})))
    alike = prepare(plain, BuildOrder(ANGLE))  # once a run, as `provision --watch` does
    spent = [0.0, 0.0]
    for number in range(count):
        for place, hook in enumerate((None, run)):
            board = Board(uuid=(1 + number).to_bytes(10, "big"))
            used = time.process_time()
            with talk(board) as node:
                station, order = (plain, alike) if hook is None else (line, hook.order)
                provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter(), line=hook)
            spent[place] += time.process_time() - used
    plain.close()
    line.close()
    return spent[0] / count, spent[1] / count


def main(count: int) -> None:
    """Make, measure, print."""
    compileall.compile_dir(Path(teds_provision.__file__).parent, quiet=2)
    cores = len(os.sched_getaffinity(0))
    with tempfile.TemporaryDirectory() as name:
        files = evidence(Path(name), count)
        runs = [verify_all(files, Path(name, "ca.pem")) for _ in range(3)]
        wall, cpu, last = min(runs)
        floor, alone_floor = CHECKS * count / checks_a_second(cores), CHECKS * count / checks_a_second(1)
        print(f"{last}  {wall:.2f} s, {cpu:.2f} s of the processor; load {os.getloadavg()[0]:.1f}")
        print(f"  {CHECKS} bare checks a file on {cores} cores {floor:.2f} s: {wall / floor:.2f} ×, aim {AIM} ×")
        print(f"  by processor time {cpu / alone_floor:.2f} ×")
        print(f"  a file in one process, in turns: {cost(files, Path(name, 'ca.pem')).text}")
        a_second, by_processor = office(Path(name), REQUESTS)
        print(f"office: {a_second:.0f} signatures/s, {by_processor:.0f} by processor time; aim {OFFICE_AIM:.0f}")
        without, with_line = boards(Path(name), BOARDS)
        ratio = without / with_line
        print(f"a board: {1000 * without:.1f} ms without, {1000 * with_line:.1f} ms with job and evidence, both ends")
        print(f"  of the boards an hour without, where the processor is what bounds: {ratio:.2f}; aim {LINE_AIM}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
