"""stdout that is closed, full, or a pipe whose reader went away; text from outside on a terminal; memory of secrets."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.control import Control
from rich.text import Text

from teds_provision.cli import main, stdout
from teds_provision.cli.console import CleanConsole
from teds_provision.cli.context import App
from teds_provision.cli.stdout import CleanText
from teds_provision.errors import StoreError
from teds_provision.sanitize import printable, sanitize, sanitize_json
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from teds_provision.station.store.store import Store
from tests.bench import PASSPHRASE
from tests.cli.shell import call, clean_environment
from tests.terminal import on_terminal

UUID = bytes.fromhex("8d4d9da65281f7000000")


@pytest.fixture
def run(home: Path, tmp_path: Path) -> str:
    """Return the start of a command line in a shell, with the passphrase on descriptor 9."""
    (tmp_path / "words").write_text(PASSPHRASE + "\n")
    return f"9<{tmp_path / 'words'} {sys.executable} -m teds_provision --passphrase-fd 9 --home {home}"


def shell(command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False, env=clean_environment()
    )


def listed(home: Path) -> list[str]:
    return [entry["uuid"] for entry in call(home, "--json", "whitelist", "list").json["whitelist"]]


@pytest.mark.parametrize(
    ("sink", "code"),
    [(">&-", 0), (">/dev/full", 0), (">&- 2>&-", 0), ("<&- >&- 2>&-", 0)],
)
def test_the_work_keeps_its_own_exit_code(home: Path, run: str, sink: str, code: int) -> None:
    done = shell(f"{run} whitelist add {UUID.hex()} {sink}")
    assert done.returncode == code, done.stderr
    assert "bug" not in done.stderr
    assert listed(home) == [UUID.hex()]
    assert shell(f"{run} nodes 1234 {sink}").returncode == 3
    with Store.open(home) as store:
        assert store.damage() is None


def test_json_that_a_full_disk_does_not_take_is_7_after_the_work(home: Path, run: str) -> None:
    done = shell(f"{run} --json whitelist add {UUID.hex()} >/dev/full")
    assert done.returncode == 7
    assert "The work is done, but its result could not be written to stdout: No space left" in done.stderr
    assert listed(home) == [UUID.hex()]
    assert shell(f"{run} --json nodes 1234 >/dev/full").returncode == 3


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("nodes", 7),
        ("--quiet whitelist list", 7),
        ("whitelist --quiet list", 7),
        ("log", 7),
        ("whitelist export -", 7),
        ("--help", 7),
        ("", 7),
        (f"whitelist remove {UUID.hex()} --yes", 0),
        (f"label {UUID.hex()} -o FOLDER/label.svg", 0),
        (f"label {UUID.hex()} --output=FOLDER/label.svg", 0),
        ("nodes 1234", 3),
    ],
)
def test_a_list_that_a_full_disk_does_not_take_is_7(
    home: Path, run: str, words: str, code: int, tmp_path: Path
) -> None:
    """What was called for its output alone has done nothing: a file that was cut short is no list."""
    assert call(home, "whitelist", "add", UUID.hex(), "--fingerprint", "ab" * 32).code == 0
    done = shell(f"{run} {words.replace('FOLDER', str(tmp_path))} >/dev/full")
    assert done.returncode == code, done.stderr
    assert ("could not be written to stdout: No space left" in done.stderr) == (code != 3)
    assert ("The work is done" in done.stderr) == (code == 0), "only a command that changes something has done it"


@pytest.mark.parametrize("option", ["", "--json"])
def test_a_broken_pipe_ends_quietly_with_141_after_the_work(home: Path, run: str, option: str) -> None:
    done = shell(f"set -o pipefail; (sleep 0.2; {run} {option} whitelist add {UUID.hex()}; echo $? >&2) | :")
    assert done.stderr == "141\n"
    assert listed(home) == [UUID.hex()]


def test_a_long_list_into_head(home: Path, run: str) -> None:
    with Station.inspect(home) as store, store.transaction():
        for number in range(2000):
            store.nodes.restore(NodeRecord(number.to_bytes(10, "big"), name=f"node {number} " + "x" * 80))
    for option in ("", "--json"):
        done = shell(f"set -o pipefail; ({run} {option} nodes; echo $? >&2) | head -c 100 >/dev/null")
        assert done.stderr == "141\n"


# -- text from outside -------------------------------------------------------------------------------------------------

STEERING = "\x1b[31mred\x9b2J\u202etxt\x07"


STEERS = [*range(0x09), 0x0B, 0x0C, *range(0x0E, 0x1B), *range(0x1C, 0x20), *range(0x7F, 0xA0), *range(0x200B, 0x2010)]
STEERS += [*range(0x202A, 0x202F), *range(0x2060, 0x2065), *range(0x2066, 0x2070), 0xFEFF, 0xD800, 0xDFFF]


def test_each_character_that_steers_a_terminal_or_the_direction_of_text_leaves_as_an_escape() -> None:
    """Control characters (C0, C1), zero-width characters, marks of direction, isolates, halves of surrogate pairs."""

    def written(text: str) -> str:
        octets = io.BytesIO()
        out = CleanText(octets, encoding="utf-8", write_through=True)
        assert out.write(text) == len(text)
        return octets.getvalue().decode()

    for code in STEERS:
        assert written(f"a{chr(code)}b") == f"a\\u{code:04x}b"
    for code in (0x09, 0x0A, 0x1B, 0x20, 0x7E, 0xA0, 0xB0, 0xE4, 0x200A, 0x2010, 0x2026, 0x2212, 0xFFFD, 0x1F600):
        assert written(f"a{chr(code)}b") == f"a{chr(code)}b", hex(code)


def test_cleaned_text_steers_nothing_and_json_still_says_the_same() -> None:
    for clean in (printable(STEERING), sanitize(STEERING)):
        assert clean.isprintable()
    cleaned = sanitize_json(json.dumps({"name": STEERING}, ensure_ascii=False))
    assert cleaned.isprintable()
    assert json.loads(cleaned) == {"name": STEERING}
    assert sanitize_json('{"ä": "ö"}') == '{"ä": "ö"}'
    assert sanitize("two\n\tlines") == "two\n\tlines"


@pytest.mark.parametrize(
    "words", [("nodes",), ("--json", "nodes"), ("nodes", UUID.hex()), ("--json", "nodes", UUID.hex())]
)
def test_a_name_that_steers_terminals_is_cleaned_on_one(home: Path, words: tuple[str, ...]) -> None:
    with Station.inspect(home) as store:
        store.nodes.restore(NodeRecord(UUID, name=STEERING, profile=STEERING, retired=STEERING))
    environment = clean_environment(TERM="xterm", NO_COLOR="1", COLUMNS="200")
    outcome = on_terminal(home, *words, environment=environment)
    assert outcome.code == 0
    assert "red" in outcome.screen
    for character in ("\x9b", "\u202e", "\x07", "\x1b[31m"):
        assert character not in outcome.screen


# -- memory ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["", "--debug"])
def test_a_process_that_holds_secrets_dumps_no_core_and_is_not_traced(home: Path, tmp_path: Path, option: str) -> None:
    (tmp_path / "words").write_text(PASSPHRASE + "\n")
    code = f"""
import ctypes, os, resource, signal, sys
from teds_provision.cli.main import run
most = resource.getrlimit(resource.RLIMIT_CORE)[1]
resource.setrlimit(resource.RLIMIT_CORE, (most, most))
options = [{option!r}] if {option!r} else []
assert ctypes.CDLL(None).prctl(3, 0, 0, 0, 0) == 1
assert run(["--home", {str(home)!r}, "--passphrase-fd", "3", *options, "vault", "rewrap"]) == 0
print(ctypes.CDLL(None).prctl(3, 0, 0, 0, 0), resource.getrlimit(resource.RLIMIT_CORE), flush=True)
os.abort()
"""
    with (tmp_path / "words").open("rb") as words:
        done = subprocess.run(
            ["bash", "-c", f'exec "$0" -c "$1" 3<&{words.fileno()}', sys.executable, code],
            pass_fds=(words.fileno(),),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            cwd=tmp_path,
            env=clean_environment(PYTHONPATH=str(Path(__file__).parents[2])),
        )
    assert done.stdout.endswith("0 (0, 0)\n"), done
    assert [path.name for path in tmp_path.glob("core*")] == []


@pytest.mark.parametrize(
    ("code", "only_shows", "done", "ends"), [(0, False, True, 7), (4, False, False, 4), (0, True, False, 7)]
)
def test_work_that_failed_is_not_called_done(
    capsys: pytest.CaptureFixture[str], code: int, only_shows: bool, done: bool, ends: int
) -> None:
    output: Any = SimpleNamespace(failure="No space left on device")
    assert stdout.ended(code, output, purpose=lambda: stdout.Purpose(only_shows, must_print=True)) == ends
    assert ("The work is done" in capsys.readouterr().err) is done


def test_after_a_full_stdout_what_is_buffered_goes_nowhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The interpreter flushes it at its end, and would fail once more, with an exit code of its own."""
    with open("/dev/full", "w") as full:
        full.write("a result")
        with pytest.raises(OSError, match="No space left") as failure:
            full.flush()
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(App, "current", None)
        assert main._system_error([], failure.value) == 7
        full.flush()
    assert capsys.readouterr().err == "Error: Cannot write the result to stdout: No space left on device.\n"


@pytest.mark.parametrize("error", [OSError(28, "No space left"), ValueError("closed file")])
def test_what_a_full_or_closed_stdout_does_not_take_ends_as_lost_output(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def flush() -> None:
        raise error

    silenced: list[bool] = []
    monkeypatch.setattr(stdout, "silence", lambda: silenced.append(True))
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(flush=flush))
    assert stdout.ended(3, None, purpose=lambda: stdout.Purpose(only_shows=True, must_print=True)) == 3
    assert silenced == [True]


@pytest.mark.parametrize("as_json", [False, True])
def test_a_result_that_stdout_does_not_take_is_an_error_for_a_program_and_a_note_for_people(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], as_json: bool
) -> None:
    monkeypatch.setattr(App, "current", None)
    app = App(home=tmp_path, as_json=as_json)
    for give in (lambda: app.emit({"a": 1}, "a"), lambda: app.lines(["a"])):
        with open("/dev/full", "w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            if as_json:
                with pytest.raises(StoreError, match="Cannot write the result to stdout: No space left") as refused:
                    give()
                assert refused.value.hint == "The work itself is done. Free some space before the next run."
            else:
                give()  # what is still buffered then goes nowhere, so that the end of the block does not fail
    note = "Cannot write the result to stdout: No space left on device.\n"
    assert capsys.readouterr().err == ("" if as_json else note * 2)


@pytest.mark.parametrize("terminal", [False, True])
def test_the_guarded_output_goes_on_where_the_plain_one_ended(monkeypatch: pytest.MonkeyPatch, terminal: bool) -> None:
    """A name that the encoding lacks is no error after the work is done; a person sees each line at once."""
    octets = io.BytesIO()
    plain = io.TextIOWrapper(octets, encoding="ascii")
    plain.write("early")
    monkeypatch.setattr(sys, "stdout", plain)
    monkeypatch.setattr(stdout.GuardedOutput, "isatty", lambda _: terminal)
    output = stdout.guard()
    guarded: Any = sys.stdout
    assert output is not None
    assert (octets.getvalue(), output.fileno(), type(guarded)) == (b"early", 1, CleanText)
    assert (guarded.encoding, guarded.errors, guarded.line_buffering) == ("ascii", "backslashreplace", terminal)
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    assert stdout.guard() is None


def test_a_text_of_the_console_is_cleaned_and_keeps_its_colour() -> None:
    console = CleanConsole(file=io.StringIO(), width=80)
    found = [part for part in console.render(Text("a\u202eb", style="red")) if part.text.strip()]
    assert [(part.text, str(part.style)) for part in found] == [(sanitize("a\u202eb"), "red")]
    [bell] = console.render(Control.bell())
    assert (bell.text, bell.control is None) == ("\a", False), "what rich itself steers"
    with pytest.raises(BrokenPipeError):
        console.on_broken_pipe()


def test_output_that_is_lost_counts_as_written_and_a_broken_pipe_does_not() -> None:
    with stdout.GuardedOutput("/dev/full", "w") as full:
        assert full.failure == ""
        assert full.write(memoryview(b"abcd").cast("H")) == 4, "octets, not elements"
        assert full.failure == "No space left on device"
    read, write = os.pipe()
    os.close(read)
    with stdout.GuardedOutput(write, "w") as broken:
        with pytest.raises(BrokenPipeError):
            broken.write(b"abcd")
        assert broken.failure == ""
