"""What a roster says against evidence, and how files of it are counted: each case by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.plant import verify_evidence
from teds_provision.plant.commands import line as commands
from teds_provision.plant.verify_evidence import EvidenceAnchors, EvidenceTotals, JudgedEvidence, _wrong_members
from teds_provision.protocol.keys import SoftwareKey, fingerprint, to_pem
from teds_provision.protocol.plant.roster import Member, RemovedMember, Role, Roster, Why
from tests.cli.shell import call
from tests.plant.plants import NOW, REGISTRY

LINE, OFFICE, STRANGER = (SoftwareKey(number) for number in (81, 82, 83))


def roster(
    *,
    line: tuple[Role, ...] = ("line",),
    office: tuple[Role, ...] = ("sign",),
    signed: tuple[int, str] | None = None,
    gone: Why | None = None,
    office_gone: Why | None = None,
) -> Roster:
    members, removed = list[Member](), list[RemovedMember]()
    for key, name, roles, why in ((LINE, "line", line, gone), (OFFICE, "office", office, office_gone)):
        if why is None:
            members.append(Member(name, key.point, b"", frozenset(roles), signed if name == "office" else None))
        else:
            removed.append(RemovedMember(name, key.point, frozenset(roles), why, (3, "ab" * 32)))
    return Roster(REGISTRY, "plant", 1, "", NOW, NOW, tuple(members), tuple(removed))


def faults(
    monkeypatch: pytest.MonkeyPatch, held: Roster, *, by: SoftwareKey = LINE, signer: SoftwareKey | None = OFFICE,
    verdict: str = "passed", readable: bool = True,
) -> list[str]:  # fmt: skip
    def decode(_teds: bytes) -> Any:
        if not readable:
            raise BadDataError("no TEDS")
        return SimpleNamespace(station_key=None if signer is None else signer.point)

    monkeypatch.setattr(verify_evidence, "security", SimpleNamespace(decode=decode))
    evidence = SimpleNamespace(facts=SimpleNamespace(station=fingerprint(by.point)), verdict=verdict, teds=b"")
    return list(_wrong_members(cast("Any", evidence), held))


def test_members_with_their_roles_are_good(monkeypatch: pytest.MonkeyPatch) -> None:
    assert faults(monkeypatch, roster()) == []
    assert faults(monkeypatch, roster(line=("base", "audit"))) == []
    assert faults(monkeypatch, roster(gone="retired", office_gone="retired")) == [], "it was one when it signed"
    assert faults(monkeypatch, roster(office=("base",), signed=(7, "ab" * 32))) == [], "what it signed stays"
    assert faults(monkeypatch, roster(line=("line", "sign")), signer=LINE) == []


ROLE = "the station that signed the datasheet does not have the role 'sign'"


@pytest.mark.parametrize(
    ("held", "how", "found"),
    [
        (roster(line=("audit",)), {}, ["its station has no role for working on boards"]),
        (roster(line=()), {}, ["its station has no role for working on boards"]),
        (roster(gone="lost"), {}, ["its station was removed: lost"]),
        (roster(gone="stolen"), {}, ["its station was removed: stolen"]),
        (roster(line=("line", "sign"), gone="lost"), {"signer": LINE}, ["its station was removed: lost"]),
        (roster(), {"by": STRANGER}, ["its station is not in the roster"]),
        (roster(office_gone="stolen"), {}, ["the station that signed the datasheet was removed: stolen"]),
        (roster(), {"signer": STRANGER}, ["the station that signed the datasheet is not in the roster"]),
        (roster(), {"signer": None}, ["the station that signed the datasheet is not in the roster"]),
        (roster(office=("base",)), {}, [ROLE]),
        (roster(office=("base",), signed=(0, "")), {}, [ROLE]),
        (roster(), {"signer": LINE}, [ROLE]),
        (roster(gone="lost"), {"verdict": "failed", "signer": STRANGER}, ["its station was removed: lost"]),
        (roster(), {"readable": False}, []),
    ],
)
def test_what_the_roster_says_against_evidence(
    monkeypatch: pytest.MonkeyPatch, held: Roster, how: dict[str, Any], found: list[str]
) -> None:
    assert faults(monkeypatch, held, **how) == found


def judged(verdict: str | None = "passed", *faults: str, error: Any = None) -> JudgedEvidence:
    facts = SimpleNamespace(station="ab", job="j", unit=3, attempt=2)
    evidence = SimpleNamespace(verdict=verdict, uuid=bytes(10), facts=facts, finished="then")
    return JudgedEvidence("f.json", None if verdict is None else cast("Any", evidence), faults, error)


@pytest.mark.parametrize(
    ("found", "good", "code", "word"),
    [
        (judged(), True, 0, "passed"),
        (judged("failed"), True, 0, "failed"),
        (judged("passed", "a fault"), False, 4, "not authentic"),
        (judged(None, error=BadDataError("x")), False, 8, "unreadable"),
        (judged(None, error=NotFoundError("x")), False, 3, "unreadable"),
    ],
)
def test_one_file_in_a_word(found: JudgedEvidence, good: bool, code: int, word: str) -> None:
    assert (found.good, found.exit_code, found.word) == (good, code, word)


def test_one_file_as_json() -> None:
    assert judged("passed", "a fault").to_json() == {
        "file": "f.json", "good": False, "faults": ["a fault"], "uuid": "00" * 10, "verdict": "passed", "station": "ab",
        "job": "j", "unit": 3, "attempt": 2, "finished": "then",
    }  # fmt: skip
    unreadable = judged(None, error=BadDataError("It is none.")).to_json()
    assert (unreadable["file"], unreadable["good"], unreadable["faults"]) == ("f.json", False, [])
    assert unreadable["error"]["message"] == "It is none."


def test_totals_have_the_exit_code_of_the_worst() -> None:
    """Not authentic is worse than unreadable, and that worse than a file that is not there."""
    missing, unreadable = judged(None, error=NotFoundError("x")), judged(None, error=BadDataError("x"))
    for order, code in (
        ([judged(), judged("failed")], 0),
        ([missing, judged()], 3),
        ([unreadable, missing, judged()], 8),
        ([judged("passed", "a fault"), unreadable, missing], 4),
        ([missing, unreadable, judged("passed", "a fault")], 4),
    ):
        totals, joined = EvidenceTotals(), EvidenceTotals()
        for each in order:
            totals.add(each)
            one = EvidenceTotals()
            one.add(each)
            joined.join(one)
        assert (totals.exit_code, joined) == (code, totals)
    assert totals.to_json() == {"totals": {"files": 3, "not authentic": 1, "unreadable": 2}}


@pytest.mark.parametrize(
    ("found", "line"),
    [
        (judged(), f"passed         {'00' * 10}  f.json"),
        (judged("failed"), f"failed         {'00' * 10}  f.json: the attempt ended with no-node"),
        (judged("failed", "one", "two"), f"not authentic  {'00' * 10}  f.json: one; two"),
        (judged(None, error=BadDataError("It is none.")), "unreadable     -                     f.json: It is none."),
    ],
)
def test_one_file_as_a_line(found: JudgedEvidence, line: str) -> None:
    if found.evidence is not None:
        failure = "no-node" if found.evidence.verdict == "failed" else None
        facts: Any = SimpleNamespace(failure=failure)
        evidence: Any = SimpleNamespace(verdict=found.evidence.verdict, uuid=bytes(10), facts=facts)
        found = replace(found, evidence=evidence)
    assert commands._line(found) == line


@pytest.mark.parametrize("roster", [True, False])
@pytest.mark.parametrize("words", [(), ("--json",), ("--quiet",)])
def test_who_verifies_without_a_roster_is_told_what_that_leaves_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], roster: bool
) -> None:
    file, ca = tmp_path / "a.json", tmp_path / "ca.pem"
    file.write_text("{}")
    ca.write_text(to_pem(LINE.point))
    given: list[tuple[object, ...]] = []
    monkeypatch.setattr(EvidenceAnchors, "from_files", lambda *anchors: given.append(anchors))
    monkeypatch.setattr(verify_evidence, "verify_evidence", lambda *_: [(["a line"], EvidenceTotals(1, {"passed": 1}))])
    more = ("--roster", file) if roster else ()
    done = call(tmp_path, *words, "evidence", "verify", file, "--ca", ca, *more, passphrase=None)
    assert (done.code, given) == (0, [(LINE.point, None, file if roster else None)])
    note = "Without --roster, evidence from a stolen station counts as valid too.\n"
    assert done.err == ("" if roster or words else note)
