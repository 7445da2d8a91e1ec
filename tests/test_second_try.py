"""Hold what a second try may clear and what it must never clear, by suites with planted failures."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import second_try
from tests.pace import PATIENCE
from tests.second_try import NOTES, Failure, Outcomes, main, refusal
from tests.zygote import Zygote

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
ONCE = """
import os, socket, subprocess, sys
import pytest


def fails_once(name="seen"):
    try:
        os.close(os.open(name, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except FileExistsError:
        return
    raise AssertionError("the machine was busy")
"""


class Suite:
    """A temporary suite of one file, and how its run ended: in this process, or by the command of the gate.

    Each pytest of the former is a fork of one that has imported pytest; those of the latter are started.
    """

    def __init__(self, folder: Path, printed: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self.code = -1
        self.printed = ""
        self._captured = printed

    def run(self, text: str, *words: str) -> None:
        self._write(text)
        self.code = main(["-q", *words])
        self.printed = "".join(self._captured.readouterr())

    def run_as_the_gate_does(self, text: str, *words: str) -> None:
        self._write(text)
        command = [sys.executable, "-m", "tests.second_try", "-q", *words]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        self.code, self.printed = ended.returncode, ended.stdout + ended.stderr

    def _write(self, text: str) -> None:
        (self.folder / "pytest.ini").write_text("[pytest]\nmarkers = link\n")
        (self.folder / "test_it.py").write_text(ONCE + text)

    def note(self) -> str:
        file = self.folder / NOTES
        return file.read_text() if file.exists() else ""


@pytest.fixture(scope="module")
def ready() -> Iterator[Zygote]:
    """Yield a process that has imported pytest: each test has three runs of it, of which most is that import."""
    made = Zygote(dict(os.environ), module="pytest")
    yield made
    made.close()


@pytest.fixture
def suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ready: Zygote) -> Suite:
    def forked(words: list[str], *, check: bool) -> SimpleNamespace:
        assert words[:3] == [sys.executable, "-m", "pytest"]
        assert not check
        run = ready.run("pytest", words[3:], dict(os.environ), out=1, err=2, cwd=tmp_path)
        return SimpleNamespace(returncode=run.wait(PATIENCE))

    monkeypatch.setattr(second_try, "subprocess", SimpleNamespace(run=forked))
    monkeypatch.chdir(tmp_path)
    for name, value in (("PYTHONPATH", str(ROOT)), ("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1"), ("PYTEST_ADDOPTS", "")):
        monkeypatch.setenv(name, value)
    return Suite(tmp_path, capfd)


def test_a_failure_in_the_first_run_only_is_cleared_and_printed(suite: Suite) -> None:
    """In a worker, as at the gate: the mark and the failure come through."""
    suite.run_as_the_gate_does(
        "@pytest.mark.link\ndef test_it(): fails_once()\ndef test_other(): pass", "-p", "xdist", "-n", "2"
    )
    assert suite.code == 0, suite.printed
    assert "NEEDED A SECOND TRY: test_it.py::test_it" in suite.note()
    assert "AssertionError: the machine was busy" in suite.note()
    assert suite.note() in suite.printed


def test_a_failure_that_stays_keeps_the_run_red(suite: Suite) -> None:
    suite.run("@pytest.mark.link\ndef test_it(): assert 1 == 2")
    assert suite.code == 1
    assert "failed alone as well" in suite.printed
    assert not suite.note()


def test_both_runs_alone_must_pass(suite: Suite) -> None:
    suite.run(
        "@pytest.mark.link\ndef test_it():\n"
        "    runs = len(open('runs', 'a+').read() or open('runs').read())\n"
        "    open('runs', 'a').write('x')\n"
        "    assert runs == 1"
    )
    assert suite.code == 1
    assert "alone, run 2 of 2" in suite.printed
    assert not suite.note()


@pytest.mark.parametrize(
    "body",
    [
        "def test_it(): subprocess.run(['true']); fails_once()",
        "def test_it(): socket.socket().bind(('127.0.0.1', 0)); fails_once()",
        "@pytest.fixture(scope='module')\ndef ran(): subprocess.run(['true'])\n"
        "def test_first(ran): pass\ndef test_it(ran): fails_once()",
        "@pytest.fixture\ndef ran():\n    subprocess.run(['true'])\n    fails_once()\ndef test_it(ran): pass",
    ],
    ids=["process", "port", "process of the module", "process of its setup"],
)
def test_a_process_or_port_of_the_test_is_noticed(suite: Suite, body: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One run alone is enough here."""
    monkeypatch.setattr(second_try, "RUNS", 1)
    suite.run(body)
    assert suite.code == 0, suite.printed
    assert "NEEDED A SECOND TRY: test_it.py::test_it" in suite.note()


def test_a_pure_test_is_never_tried_again(suite: Suite) -> None:
    """Not even beside one that starts a process."""
    suite.run("def test_other(): subprocess.run(['true'])\ndef test_it(): fails_once()")
    assert suite.code == 1
    assert "No second try: no other process or network port takes part in test_it.py::test_it." in suite.printed
    assert not suite.note()


def test_a_test_skipped_alone_does_not_pass(suite: Suite) -> None:
    suite.run("@pytest.mark.link\ndef test_it():\n    if os.path.exists('seen'): pytest.skip()\n    fails_once()")
    assert suite.code == 1
    assert not suite.note()


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ("@pytest.mark.link\ndef test_it(): os._exit(3)", "more than setup or body of a test failed: "),
        ("raise ValueError('no suite')", "pytest ended with 2"),
        (
            "@pytest.fixture\ndef made():\n    yield\n    fails_once()\n@pytest.mark.link\ndef test_it(made): pass",
            "more than setup or body of a test failed: teardown of test_it.py::test_it",
        ),
        (
            "@pytest.fixture\ndef made(): fails_once()\ndef test_it(made): pass",
            "no other process or network port takes part in test_it.py::test_it",
        ),
    ],
    ids=["worker", "collection", "teardown", "setup without a process"],
)
def test_what_is_no_failed_test_keeps_the_run_red(suite: Suite, body: str, why: str) -> None:
    suite.run(body, *(["-p", "xdist", "-n", "1"] if "_exit" in body else []))
    assert suite.code != 0
    assert f"No second try: {why}" in suite.printed
    assert not suite.note()


SHARED = """
@pytest.fixture(scope='module')
def seen(): subprocess.run(['true']); fails_once('first')
@pytest.mark.link
@pytest.mark.parametrize('number', range(5))
def test_it(seen, number): pass
@pytest.mark.link
def test_other(): pass
"""


def test_the_tests_of_one_failed_fixture_count_as_one_and_run_together(suite: Suite) -> None:
    suite.run_as_the_gate_does(SHARED, "-p", "xdist", "-n", "1")
    assert suite.code == 0, suite.printed
    assert "Second try of test_it.py, 5 tests of the fixture seen, alone, run 2 of 2:" in suite.printed
    assert "NEEDED A SECOND TRY: test_it.py, 5 tests of the fixture seen" in suite.note()
    assert suite.note().count("AssertionError: the machine was busy") == 1


def test_a_shared_fixture_that_fails_alone_keeps_the_run_red(suite: Suite) -> None:
    suite.run(SHARED.replace("fails_once('first')", "assert 1 == 2"))
    assert suite.code == 1
    assert "It failed alone as well: test_it.py, 5 tests of the fixture seen" in suite.printed
    assert not suite.note()


def test_a_shared_fixture_of_pure_tests_gets_no_second_try(suite: Suite) -> None:
    suite.run("@pytest.fixture(scope='module')\ndef seen(): fails_once()\ndef test_it(seen): pass")
    assert suite.code == 1
    assert "No second try: no other process or network port takes part in test_it.py::test_it." in suite.printed


def test_four_failures_are_no_accident(suite: Suite) -> None:
    suite.run(
        "@pytest.mark.link\n@pytest.mark.parametrize('number', range(4))\ndef test_it(number): fails_once(str(number))"
    )
    assert suite.code == 1
    assert "No second try: 4 tests failed, more than 3." in suite.printed
    assert not suite.note()


def test_a_run_that_recorded_nothing_is_no_failed_test() -> None:
    assert refusal(1, None)
    assert refusal(1, Outcomes())
    assert refusal(3, Outcomes(failures=[Failure("test_it", "busy", "marked link")]))
    assert not refusal(1, Outcomes(failures=[Failure("test_it", "busy", "marked link")]))
