"""Run pytest, and give a few tests that failed among many others a second try alone.

On a busy machine one scheduling accident among ten thousand tests must not refuse a release, but no defect may hide
behind a retry. So only tests that start processes or use network ports get one, three at most, and only if each failed
in its body or its setup. Each then runs alone, twice, and must pass both times. The tests of a file for which one
shared fixture failed (a measurement that all of them look at) count as one, and run together, without others.
Everything else keeps its failure: pure tests, more than three, an error of collection or of a teardown, and a worker
that crashed.

The failures that a second try cleared are printed, and appended to build/second-tries, which ``make test`` prints last.

Usage: python -m tests.second_try [arguments of pytest]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

MOST = 3
"""Tests of one run that may be tried again; more than that is no accident."""
RUNS = 2
"""Runs alone of which each must pass."""
NOTES = Path("build", "second-tries")

OPTION = "--outcomes"
MARKS = ("link", "realtime", "both_nodes")
PLACES = ("tests/e2e/",)
EVENTS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "tests.zygote.run"})
PORTS = frozenset({"socket.bind", "socket.connect"})


@dataclass(frozen=True)
class Failure:
    """A test that failed: its id, the text of the failure, and why it may be tried again ("" if not).

    ``fixture`` is the shared fixture that failed before it, "" if its body or its own setup did.
    """

    test: str
    text: str
    because: str
    fixture: str = ""


@dataclass
class Outcomes:
    """The outcomes of one run of pytest, as far as a second try depends on them."""

    failures: list[Failure] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    passed: list[str] = field(default_factory=list)
    reruns: int = 0

    @classmethod
    def read(cls, file: Path) -> Outcomes | None:
        """Return what the run recorded, or None if it did not get that far."""
        try:
            facts = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        facts["failures"] = [Failure(**failure) for failure in facts["failures"]]
        return cls(**facts)


def accidents(failures: list[Failure]) -> list[list[Failure]]:
    """Return the failures, those of one file by one shared fixture together."""
    together: dict[tuple[str, str], list[Failure]] = {}
    for failure in failures:
        file = failure.test.partition("::")[0]
        together.setdefault((file, failure.fixture) if failure.fixture else (failure.test, ""), []).append(failure)
    return list(together.values())


def refusal(code: int, outcomes: Outcomes | None) -> str:
    """Return why no test of a failed run is tried again, or "" if all that failed may be."""
    if outcomes is None or code != pytest.ExitCode.TESTS_FAILED:
        return f"pytest ended with {int(code)}"
    if outcomes.errors:
        return f"more than setup or body of a test failed: {'; '.join(outcomes.errors)}"
    if not outcomes.failures:
        return "no test is recorded as failed"
    if len(accidents(outcomes.failures)) > MOST:
        return f"{len(outcomes.failures)} tests failed, more than {MOST}"
    pure = [failure.test for failure in outcomes.failures if not failure.because]
    if pure:
        return f"no other process or network port takes part in {', '.join(pure)}"
    return ""


def main(arguments: list[str]) -> int:
    """Run pytest with these arguments, then the second tries; return the exit code."""
    code, outcomes = _pytest(arguments)
    if code == pytest.ExitCode.OK:
        return code
    refused = refusal(code, outcomes)
    if refused or outcomes is None:
        print(f"\nNo second try: {refused}.", flush=True)
        return code
    profile = [argument for argument in arguments if argument.startswith("--hypothesis-profile=")]
    found = accidents(outcomes.failures)
    for failures in found:
        named = _named(failures)
        for number in range(1, RUNS + 1):
            print(f"\nSecond try of {named}, alone, run {number} of {RUNS}:", flush=True)
            if not _pass_alone([failure.test for failure in failures], profile):
                print(f"\nIt failed alone as well: {named}", flush=True)
                return code
    note = "".join(map(_note, found))
    print(f"\n{note}", flush=True)
    NOTES.parent.mkdir(exist_ok=True)
    with NOTES.open("a", encoding="utf-8") as file:
        file.write(note)
    return 0


def _pass_alone(tests: list[str], options: list[str]) -> bool:
    """Run tests; True if all of them ran, and passed at once: skipped or repeated by a mark does not count."""
    code, outcomes = _pytest([*options, *tests])
    return code == 0 and outcomes is not None and sorted(outcomes.passed) == sorted(tests) and not outcomes.reruns


def _named(failures: list[Failure]) -> str:
    first = failures[0]
    if not first.fixture:
        return first.test
    file = first.test.partition("::")[0]
    return f"{file}, {len(failures)} tests of the fixture {first.fixture}"


def _note(failures: list[Failure]) -> str:
    first = failures[0]
    return (
        f"NEEDED A SECOND TRY: {_named(failures)}\n"
        f"  It failed beside other tests, and passed {RUNS} times alone ({first.because}). Find the cause.\n"
        + "".join(f"  | {line}\n" for line in first.text.splitlines())
    )


def _pytest(arguments: list[str]) -> tuple[int, Outcomes | None]:
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder, "outcomes.json")
        words = [sys.executable, "-m", "pytest", "-p", "tests.second_try", f"{OPTION}={record}", *arguments]
        return subprocess.run(words, check=False).returncode, Outcomes.read(record)


# -- the plugin of pytest ----------------------------------------------------------------------------------------------

# Of a report: why its test may be tried again, and the shared fixture that failed before the test.
_BECAUSE, _FIXTURE = "because", "fixture"


class _Watch:
    """Count the processes started and the network ports used by this interpreter, from its audit events."""

    def __init__(self) -> None:
        self.processes = 0
        self.ports = 0
        self.fixtures: dict[object, str] = {}  # those that began with either, wider than a test: which of them
        self.failed: set[object] = set()  # those wider than a test that failed
        sys.addaudithook(self._heard)

    def _heard(self, event: str, arguments: tuple[object, ...]) -> None:
        if event in EVENTS:
            self.processes += 1
        elif event in PORTS and isinstance(arguments[1], tuple):  # not a socket of Unix
            self.ports += 1

    def since(self, processes: int, ports: int) -> str:
        if self.processes > processes:
            return "starts processes"
        return "uses a network port" if self.ports > ports else ""

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[object]) -> Generator[None, object, object]:
        before = self.processes, self.ports
        try:
            value = yield
        except Exception:
            if fixturedef.scope != "function":
                self.failed.add(fixturedef)
            raise
        if found := self.since(*before):
            self.fixtures[fixturedef] = found
        return value

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        item.stash[_BEFORE] = self.processes, self.ports

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if report.failed:
            setattr(report, _BECAUSE, self._because(item))
            setattr(report, _FIXTURE, self._failed_fixture(item) if report.when == "setup" else "")
        return report

    def _failed_fixture(self, item: pytest.Item) -> str:
        return next((name for name, several in _fixtures_of(item).items() if not self.failed.isdisjoint(several)), "")

    def _because(self, item: pytest.Item) -> str:
        for mark in MARKS:
            if item.get_closest_marker(mark):
                return f"marked {mark}"
        for place in PLACES:
            if item.nodeid.startswith(place):
                return f"below {place}"
        used = _fixtures_of(item).values()
        shared = [self.fixtures[fixture] for several in used for fixture in several if fixture in self.fixtures]
        return self.since(*item.stash[_BEFORE]) or (shared[0] if shared else "")


def _fixtures_of(item: pytest.Item) -> dict[str, Sequence[object]]:
    theirs = getattr(item, "_fixtureinfo", None)
    return theirs.name2fixturedefs if theirs else {}


_BEFORE = pytest.StashKey[tuple[int, int]]()


class _Record:
    """Collect the outcomes of the whole run, and write them when it ends; not in a worker."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.outcomes = Outcomes()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if str(report.outcome) == "rerun":  # of pytest-rerunfailures
            self.outcomes.reruns += 1
        elif report.failed:
            self._record_failure(report, getattr(report, _BECAUSE, ""), getattr(report, _FIXTURE, ""))
        elif report.passed and report.when == "call":
            self.outcomes.passed.append(report.nodeid)

    def _record_failure(self, report: pytest.TestReport, because: str, fixture: str) -> None:
        if report.when in {"setup", "call"}:
            self.outcomes.failures.append(Failure(report.nodeid, report.longreprtext, because, fixture))
        else:  # teardown, or ??? for a worker that crashed
            self.outcomes.errors.append(f"{report.when} of {report.nodeid}")

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self.outcomes.errors.append(f"collection of {report.nodeid}")

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: object, error: object) -> None:
        if error:
            self.outcomes.errors.append(f"worker {getattr(getattr(node, 'gateway', None), 'id', '?')}: {error}")

    def pytest_sessionfinish(self) -> None:
        facts = vars(self.outcomes) | {"failures": [vars(failure) for failure in self.outcomes.failures]}
        self.file.write_text(json.dumps(facts), encoding="utf-8")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that names the record."""
    parser.addoption(OPTION, type=Path, help="file in which the outcomes are recorded for a second try")


def pytest_configure(config: pytest.Config) -> None:
    """Watch each test for processes and ports; record the outcomes unless this is a worker."""
    config.pluginmanager.register(_Watch(), "second-try-watch")
    if not hasattr(config, "workerinput") and config.getoption(OPTION):
        config.pluginmanager.register(_Record(config.getoption(OPTION)), "second-try-record")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
