"""Where global options may stand, what a run is for, and how its errors are printed."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from types import SimpleNamespace

import click
import pytest

from teds_provision.cli import main
from teds_provision.cli.context import App
from teds_provision.cli.main import cli, in_front, purpose_of, run


@pytest.fixture(autouse=True)
def no_other_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the run of another test as it was."""
    monkeypatch.setattr(App, "current", None)


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("nodes --json", "--json nodes"),
        ("--json nodes", "--json nodes"),
        ("nodes --home h 8d4d -q", "--home h -q nodes 8d4d"),
        ("nodes --home=h -vv", "--home=h -vv nodes"),
        ("nodes --home=h 8d4d", "--home=h nodes 8d4d"),
        ("nodes --passphrase-fd=3 --no-input --debug", "--passphrase-fd=3 --no-input --debug nodes"),
        ("--home nodes nodes --json", "--home nodes --json nodes"),
        ("--passphrase-fd 3 verify --json 8d4d --verbose", "--passphrase-fd 3 --json --verbose verify 8d4d"),
        ("whitelist add 8d4d --json --name a", "--json whitelist add 8d4d --name a"),
        # the value of an option of the command is no option
        ("provision --name --json", "provision --name --json"),
        ("provision --name=x --json", "--json provision --name=x"),
        ("whitelist add 8d4d --name -v --quiet", "--quiet whitelist add 8d4d --name -v"),
        ("provision --watch --json", "--json provision --watch"),
        # nor is what follows --
        ("set 8d4d 1 --json -- -5 --quiet", "--json set 8d4d 1 -- -5 --quiet"),
        ("-- nodes --json", "-- nodes --json"),
        # a value that is missing is for click to report
        ("nodes --home", "nodes --home"),
        ("no-such-command --json x", "--json no-such-command x"),
        ("", ""),
        ("--json", "--json"),
    ],
)
def test_a_global_option_may_stand_before_or_after_the_command(typed: str, meant: str) -> None:
    found = in_front(typed.split(), lambda name: cli.get_command(click.Context(cli), name))
    assert " ".join(found) == meant


def test_a_command_is_looked_up_only_if_a_global_option_follows_it() -> None:
    asked: list[str] = []
    in_front(["--json", "nodes", "8d4d", "--state", "keyed"], asked.append)
    assert asked == []
    in_front(["nodes", "-q"], asked.append)
    assert asked == ["nodes"]


@pytest.mark.parametrize(
    ("typed", "only_shows", "must_print"),
    [
        ("", True, True),
        ("nodes", True, True),
        ("whitelist list", True, True),
        ("--quiet log --failed", True, True),
        ("read 8d4d", True, True),
        ("read 8d4d --output node.json", False, False),
        ("read 8d4d -o node.json", False, False),
        ("--json read 8d4d -onode.json", False, True),
        ("whitelist export -", True, True),
        ("whitelist export a.csv", False, False),
        ("provision --watch", False, False),
        ("provision --watch --json", False, True),
        ("whitelist add list", False, False),
        ("config set name list", False, False),
    ],
)
def test_a_run_that_shows_or_that_a_program_reads_has_failed_without_its_output(
    typed: str, only_shows: bool, must_print: bool
) -> None:
    purpose = purpose_of(typed.split())
    assert (purpose.only_shows, purpose.must_print) == (only_shows, must_print)


@pytest.mark.parametrize(
    ("setting", "wants"), [
        ("1", True), ("true", True), ("0", False), ("no", False), ("yes", True), ("ON", True), ("t", True), ("Y", True),
        ("", False), ("2", False),
    ],
)  # fmt: skip
def test_json_may_be_asked_for_by_variable(monkeypatch: pytest.MonkeyPatch, setting: str, wants: bool) -> None:
    monkeypatch.setenv("TEDS_PROVISION_JSON", setting)
    assert purpose_of(["provision"]).must_print == wants


def failed(capsys: pytest.CaptureFixture[str], error: Exception, monkeypatch: pytest.MonkeyPatch, *typed: str) -> str:
    def invoke(_ctx: object) -> None:
        raise error

    monkeypatch.setattr(cli, "invoke", invoke)
    code = run(list(typed))
    shown = capsys.readouterr()
    return f"{code} {shown.out or shown.err}"


LONG = "n" * 200


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (KeyboardInterrupt(), "130 Interrupted. Run the same command again to continue.\n"),
        (click.Abort(), "130 Interrupted. Run the same command again to continue.\n"),
        (OSError(errno.ENAMETOOLONG, "File name too long", LONG),
         f"3 Error: '{LONG[:64]}…' is not a valid file name: File name too long.\n"),
        (OSError(errno.ENAMETOOLONG, "File name too long", LONG[:100]),
         f"3 Error: '{LONG[:100]}' is not a valid file name: File name too long.\n"),
        (OSError(errno.ENAMETOOLONG, "File name too long"),
         "1 Error: Unexpected OSError.\n  → This is a bug. Please report it with the output of --debug.\n"),
        (OSError(errno.EPERM, "Operation not permitted"),
         "1 Error: Unexpected PermissionError.\n  → This is a bug. Please report it with the output of --debug.\n"),
        (ValueError("a secret"),
         "1 Error: Unexpected ValueError.\n  → This is a bug. Please report it with the output of --debug.\n"),
        (ModuleNotFoundError("no", name="fcntl"),
         "1 Error: This command needs Linux: this system has no fcntl.\n"
         "  → docs/compatibility.md lists the commands that run on other systems.\n"),
    ],
)  # fmt: skip
def test_an_error_has_its_code_and_at_most_three_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception, text: str
) -> None:
    home = ("--home", str(tmp_path))
    assert failed(capsys, error, monkeypatch, *home, "nodes") == text
    code, _, found = failed(capsys, error, monkeypatch, "--json", *home, "nodes").partition(" ")
    members = json.loads(found)["error"]
    assert set(members) == {"code", "message", "hint"}
    message = members["message"] if code == "130" else f"Error: {members['message']}"
    hint = f"  → {members['hint']}\n" if members["hint"] else ""
    assert f"{code} {message}\n{hint}" == text


@pytest.mark.parametrize(
    ("typed", "hint"),
    [
        (["nodes", "--jsn"], ""),
        (["nodes", "--version"], "--version is a global option: teds-provision --version COMMAND …"),
        (["nodes", "--profil"], ""),
    ],
)
def test_a_global_option_that_is_none_of_the_command_is_named_as_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, typed: list[str], hint: str
) -> None:
    code = main.run(["--json", "--home", str(tmp_path), *typed])
    error = json.loads(capsys.readouterr().out)["error"]
    assert (code, error["code"], error["hint"]) == (2, "usage", hint)
    assert error["message"].endswith("(see: teds-provision nodes --help)")


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (["whitlist"], "No such command 'whitlist'. Did you mean 'whitelist'?"),
        (["whitlist", "verfy"], "No such command 'whitlist'. Did you mean 'whitelist'?"),
        (["verfy", "--json", "node"], "No such command 'verfy'. Did you mean 'verify'?"),
        (["xyzzy", "verify"], "No such command 'xyzzy'."),
    ],
)
def test_the_command_that_is_nearest_to_the_one_that_was_typed_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, typed: list[str], message: str
) -> None:
    code = main.run(["--json", "--home", str(tmp_path), *typed])
    error = json.loads(capsys.readouterr().out)["error"]
    assert (code, error["message"]) == (2, f"{message} (see: teds-provision --help)")


@pytest.mark.parametrize(
    ("columns", "width"),
    [("1", 50), ("51", 50), ("60", 58), ("100", 98), ("300", 98), ("0", 76), ("-5", 76), ("wide", 76), (None, 76)],
)
def test_help_is_as_wide_as_the_terminal_within_bounds(
    monkeypatch: pytest.MonkeyPatch, columns: str | None, width: int
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setattr(main.os, "get_terminal_size", lambda _descriptor: SimpleNamespace(columns=78))
    monkeypatch.setattr(main.sys, "__stdout__", SimpleNamespace(fileno=lambda: 1))
    assert main._help_width() == width


@pytest.mark.parametrize("error", [OSError("no terminal"), ValueError("closed"), AttributeError("fileno")])
def test_help_without_a_terminal_has_80_columns_less_two(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fileno() -> int:
        raise error

    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setattr(main.sys, "__stdout__", SimpleNamespace(fileno=fileno))
    assert main._help_width() == 78


@pytest.mark.parametrize("error", [BrokenPipeError(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("words", [["--json"], []])
def test_an_error_that_nobody_can_read_has_its_code_all_the_same(
    monkeypatch: pytest.MonkeyPatch, error: Exception, words: list[str]
) -> None:
    class Full:
        encoding = "utf-8"

        def write(self, _text: str) -> None:
            raise error

        def flush(self) -> None: ...

        def isatty(self) -> bool:
            return False

    for name in ("stdout", "stderr"):
        monkeypatch.setattr(main.sys, name, Full())
    monkeypatch.setattr(App, "current", None)
    assert main._fail(words, 6, "refused", "It is refused.", "Ask.") == 6


def test_options_of_a_command_are_known_under_all_their_names() -> None:
    @click.group()
    @click.option("--level", "-l", count=True)
    @click.option("--prove/--no-prove")
    @click.option("--name", "-n")
    def outer() -> None: ...

    @outer.command()
    @click.option("--file", "-f", type=int)
    def inner() -> None: ...

    own, valued = main._options(outer, ["x", "inner"])
    assert own == {"--level", "-l", "--prove", "--no-prove", "--name", "-n", "--file", "-f"}
    assert valued == {"--name", "-n", "--file", "-f"}
    assert main._options(outer, ["x"])[1] == {"--name", "-n"}
    assert main._options(None, ["x"]) == (set(), set())
