"""The rules that hold for every command: where output goes, how errors look, what asks, what is imported."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from teds_provision import __version__
from teds_provision.cli.main import cli
from teds_provision.cli.table import COMMANDS, GROUPS
from tests.bench import PASSPHRASE
from tests.terminal import on_terminal

from .shell import Outcome, call, clean_environment, python, spawn

ONE = "8d4d9da65281f7000000"
PRESENT = [
    name for name, entry in COMMANDS.items() if importlib.util.find_spec(f"teds_provision.{entry.room}.{entry.module}")
]
HEAVY = ("nfc", "can", "isotp", "keyring", "rich", "cryptography", "pint", "numpy", "matplotlib", "pkcs11", "sqlite3")


# -- help --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("words", [["--help"], ["--version"]])
def test_help_and_version_load_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys; sys.argv[1:] = sys.argv[1:]\n"
        "from teds_provision.__main__ import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = python(code, *words)
    assert done.err.strip() == "[]"
    assert done.out


def test_version_is_printed() -> None:
    assert spawn("--version").out == f"teds-provision {__version__}\n"
    assert call(Path("/nonexistent"), "--version").out == f"teds-provision {__version__}\n"


def test_help_names_every_command_once() -> None:
    shown = spawn("--help")
    assert shown.code == 0
    for name in COMMANDS:
        assert len(re.findall(rf"^  {name} +[A-Z]", shown.out, re.MULTILINE)) == 1, name


def test_help_begins_with_the_commands_that_people_use_first() -> None:
    listed = re.findall(
        r"^  ([a-z]+(?: [a-z]+)?) +[A-Z]", spawn("--help").out.partition("Start here:")[2], re.MULTILINE
    )
    assert listed[:6] == ["init", "provision", "verify", "nodes", "measure", "ncap run"]


@pytest.mark.parametrize("name", PRESENT)
def test_every_command_has_help_with_examples(tmp_path: Path, name: str) -> None:
    shown = call(tmp_path, name, "--help")
    assert shown.code == 0
    assert "Examples:" in shown.out
    assert f"teds-provision {name}" in shown.out or f" {name}" in shown.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", PRESENT)
def test_no_option_can_hold_a_secret(tmp_path: Path, name: str) -> None:
    options = re.findall(r"--([a-z-]+)", call(tmp_path, name, "--help").out)
    secret = {option for option in options if re.search("pass|pin$|secret|token", option)}
    assert secret <= {"passphrase-fd", "backup-passphrase-fd"}


NO_PLAN = frozenset(
    re.findall(
        r"\S+",
        "verify nodes measure completion doctor draft-list history read locate label log trace-show show "
        "describe sample set mode unlock lock demo trust-list trust-ca-create trust-ca-export profile-list "
        "profile-show profile-check config-path config-show config-set config-unset whitelist-list "
        "record-info record-show record-convert calibrate-capture calibrate-fit ncap-run ncap-status "
        "ncap-measure ncap-detection ncap-open ncap-token-add ncap-token-list ncap-token-remove group-list "
        "names-list handover-list node-create node-run node-check registry-request registry-sync "
        "registry-status registry-log registry-seen registry-sql job-list job-show job-status signer-run "
        "signer-once evidence-verify evidence-list ",
    )
)
"""Commands that show, write files, run until they are ended, or talk to a running service."""


def commands(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    if not isinstance(command, click.Group):
        yield name, command
    for word, inner in command.commands.items() if isinstance(command, click.Group) else ():
        yield from commands(f"{name}-{word}", inner)


def test_every_command_that_changes_something_takes_dry_run() -> None:
    context = click.Context(cli)
    every = [pair for name in PRESENT if (top := cli.get_command(context, name)) for pair in commands(name, top)]
    with_plan = {name for name, command in every if any("--dry-run" in option.opts for option in command.params)}
    assert {name for name, _ in every} - with_plan <= NO_PLAN
    assert {"init", "identify", "trust-ca-drop", "handover-receipt", "whitelist-import", "node-reset"} <= with_plan


def test_a_mistyped_command_is_usage_with_the_nearest_one(tmp_path: Path) -> None:
    outcome = spawn("--json", "--home", tmp_path, "whitlist")
    assert (outcome.code, outcome.json["error"]["code"]) == (2, "usage")
    assert "'whitelist'" in outcome.json["error"]["message"]


# -- results and errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "exit_code", "code"),
    [
        (["nodes", "none"], 3, "not-found"),
        (["whitelist", "remove", ONE], 0, ""),
        (["whitelist", "add", ONE, "--fingerprint", "zz"], 2, "usage"),
        (["whitelist", "import", "none.csv"], 3, "not-found"),
        (["nodes", "--nonsense"], 2, "usage"),
        (["sign", ONE], 6, "not-whitelisted"),
        (["agree", ONE], 6, "not-whitelisted"),
        (["backup", "b"], 7, "no-passphrase"),
        (["doctor", "--can", "nonsense"], 5, ""),
    ],
)
def test_json_is_one_object_on_stdout_and_nothing_else(
    home: Path, tmp_path: Path, words: list[str], exit_code: int, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = spawn("--home", home, "--json", *words)
    assert outcome.code == exit_code, outcome
    assert "Traceback" not in outcome.err
    if code:
        assert set(outcome.json) == {"error"}
        assert set(outcome.json["error"]) == {"code", "message", "hint"}
        assert outcome.json["error"]["code"] == code
        assert outcome.json["error"]["message"]


def test_without_a_station_every_command_says_init(tmp_path: Path) -> None:
    for words in (["nodes"], ["log"], ["whitelist", "list"], ["backup", "b"]):
        outcome = call(tmp_path / "none", "--json", *words)
        assert (outcome.code, outcome.json["error"]["code"]) == (3, "not-found")
        assert "teds-provision init" in outcome.json["error"]["hint"]
    assert not (tmp_path / "none").exists()


def test_an_error_for_people_is_at_most_three_lines_on_stderr(home: Path) -> None:
    outcome = spawn("--home", home, "nodes", "none")
    assert (outcome.code, outcome.out) == (3, "")
    assert outcome.err.startswith("Error: ")
    assert outcome.err.count("\n") <= 3


def test_debug_alone_shows_a_traceback(home: Path) -> None:
    assert "Traceback" not in spawn("--home", home, "nodes", "none").err
    assert "Traceback" in spawn("--home", home, "--debug", "nodes", "none").err
    environment = clean_environment(TEDS_PROVISION_DEBUG="1")
    assert "Traceback" in spawn("--home", home, "nodes", "none", environment=environment).err


def test_a_bug_is_reported_as_one_without_a_traceback(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr("teds_provision.station.station.Station.open", broken)
    outcome = call(home, "--json", "nodes")
    assert (outcome.code, outcome.json["error"]["code"]) == (1, "bug")
    assert "secret detail" not in outcome.out + outcome.err


OTHER_TABLES = pytest.mark.nightly(
    "tests/cli/test_globals.py::test_a_pipe_and_no_color_have_no_escape_codes: one table of those that are made alike"
)


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(["whitelist", "list"], marks=OTHER_TABLES),
        ["nodes"],
        pytest.param(["log"], marks=OTHER_TABLES),
        ["doctor"],
        ["--help"],
    ],
)
def test_a_pipe_and_no_color_have_no_escape_codes(home: Path, words: list[str]) -> None:
    call(home, "whitelist", "add", ONE)
    for more in ({}, {"NO_COLOR": "1"}, {"TERM": "xterm-256color", "COLORTERM": "truecolor"}):
        outcome = spawn("--home", home, *words, environment=clean_environment(**more))
        assert outcome.code == 0
        assert "\x1b" not in outcome.out + outcome.err


def test_quiet_says_nothing_but_the_result(home: Path) -> None:
    assert spawn("--home", home, "--quiet", "log").err == ""


def test_a_reader_that_stops_reading_is_no_error_message(home: Path) -> None:
    call(home, "whitelist", "add", ONE)
    command = f"{sys.executable} -m teds_provision --home {home} log | head -c 5; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False, env=clean_environment()
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_terminal_of_another_encoding_and_names_that_are_no_text_are_no_failure(home: Path, tmp_path: Path) -> None:
    home.chmod(0o755)
    outcome = spawn("--home", home, "doctor", environment=clean_environment(PYTHONIOENCODING="ascii"))
    assert (outcome.code, "chmod 700" in outcome.out) == (0, True)
    path = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.csv")
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", "--home", str(home), "--json", "whitelist", "export", path],
        capture_output=True,
        check=False,
        timeout=60,
        env=clean_environment(),
    )
    assert done.returncode == 0
    assert json.loads(done.stdout)["whitelist"] == []


# -- options from elsewhere --------------------------------------------------------------------------------------------


def test_variables_stand_for_options(home: Path, tmp_path: Path) -> None:
    environment = clean_environment(TEDS_PROVISION_HOME=str(home), TEDS_PROVISION_JSON="1")
    assert spawn("nodes", environment=environment).json == {"nodes": []}
    for words in (["nodes", "--nonsense"], ["--nonsense", "nodes"], ["nonsense"]):
        assert spawn(*words, environment=environment).json["error"]["code"] == "usage"
    environment = clean_environment(TEDS_PROVISION_HOME=str(home), TEDS_PROVISION_DRY_RUN="1")
    assert "Plan" in spawn("whitelist", "add", ONE, environment=environment).out
    environment = clean_environment(TEDS_PROVISION_HOME=str(home), TEDS_PROVISION_CAN="nonsense")
    assert spawn("doctor", environment=environment).code == 5


def test_config_toml_replaces_options_and_the_command_line_overrides_it(home: Path) -> None:
    (home / "config.toml").write_text('can = "nonsense"\ndry-run = true\n\n[log]\nlast = 0\n')
    assert call(home, "doctor").code == 5
    assert call(home, "doctor", "--can", "udp_multicast:239.74.99.8?port=47008").code == 0
    assert "Plan" in call(home, "whitelist", "add", ONE).out
    assert call(home, "--json", "log").json["entries"] == []
    assert len(call(home, "--json", "log", "--last", "1").json["entries"]) == 1


def test_a_table_of_config_toml_serves_its_command_alone(home: Path) -> None:
    (home / "config.toml").write_text(
        '[whitelist.add]\ndry-run = true\n[profile.new]\nextends = "smart-sensor"\n[identify]\nadd = true\n'
    )
    assert "Plan" in call(home, "whitelist", "add", ONE).out
    assert "1 new" in call(home, "whitelist", "add", ONE, "--name", "x").out
    assert "nothing to do" in call(home, "whitelist", "remove", ONE, "--yes").out


def test_an_option_that_is_called_like_a_command_takes_no_table_for_its_value(home: Path) -> None:
    """``profile`` is both: another value in the file must not become the profile of every node."""
    (home / "config.toml").write_text("timeout = 5\n")
    call(home, "whitelist", "add", ONE)
    outcome = call(home, "--json", "build", ONE)
    assert "timeout" not in outcome.json["error"]["message"]
    (home / "config.toml").write_text('profile = "no-such-type"\n')
    outcome = call(home, "--json", "build", ONE)
    assert (outcome.code, "no-such-type" in outcome.json["error"]["message"]) == (3, True)


def test_the_groups_of_the_table_are_those_of_the_program() -> None:
    import click

    from teds_provision.cli.main import cli

    with cli.make_context("teds-provision", ["nodes"]) as context:
        groups = {name for name in PRESENT if isinstance(cli.get_command(context, name), click.Group)}
    assert groups == GROUPS & set(PRESENT)


def test_a_config_that_is_no_toml_is_bad_data(home: Path) -> None:
    (home / "config.toml").write_text("can = \n")
    outcome = spawn("--home", home, "--json", "nodes")
    assert (outcome.code, outcome.json["error"]["code"]) == (8, "bad-data")
    assert "config.toml" in outcome.json["error"]["message"]
    (home / "config.toml").write_bytes(b"\xff\xfe")
    assert spawn("--home", home, "nodes").code == 8


# -- asking ------------------------------------------------------------------------------------------------------------


def test_a_question_can_be_answered_on_a_terminal(home: Path) -> None:
    call(home, "whitelist", "add", ONE)
    words = ("whitelist", "remove", ONE)
    outcome = on_terminal(home, *words, streams=["stdin"], answers=["n"])
    assert (outcome.code, "[y/N]" in outcome.err, "Cancelled" in outcome.err) == (6, True, True)
    outcome = on_terminal(home, *words, streams=["stdin"], answers=["y"], passphrase=PASSPHRASE)
    assert (outcome.code, "no longer on the whitelist" in outcome.out) == (0, True)


@pytest.mark.parametrize("words", [["--no-input"], ["--json"]])
def test_no_input_and_json_never_ask(home: Path, words: list[str]) -> None:
    call(home, "whitelist", "add", ONE)
    outcome = on_terminal(home, *words, "whitelist", "remove", ONE, streams=["stdin"])
    assert outcome.code == 6
    assert "--yes" in outcome.out + outcome.err
    outcome = on_terminal(home, *words, "backup", home / "b", streams=["stdin"])
    assert outcome.code == 7
    assert "--passphrase-fd" in outcome.out + outcome.err


def test_a_passphrase_that_is_typed_is_not_shown(home: Path, tmp_path: Path) -> None:
    words = "the words of the backup"
    outcome = on_terminal(home, "backup", tmp_path / "b", answers=[PASSPHRASE, words, words])
    assert outcome.code == 0, outcome
    assert PASSPHRASE not in outcome.screen
    assert words not in outcome.screen


@pytest.mark.parametrize(("line", "code"), [(b"", "wrong-passphrase"), (b"\n", "wrong-passphrase")])
def test_an_empty_passphrase_descriptor_is_reported(home: Path, tmp_path: Path, line: bytes, code: str) -> None:
    read, write = os.pipe()
    os.write(write, line)
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--json", "--home", str(home), "--passphrase-fd", str(read)]
    done = subprocess.run(
        [*command, "backup", str(tmp_path / "b")], pass_fds=(read,), capture_output=True, text=True, check=False
    )
    os.close(read)
    assert (done.returncode, json.loads(done.stdout)["error"]["code"]) == (7, code)


def test_a_passphrase_descriptor_that_is_closed_is_usage(home: Path, tmp_path: Path) -> None:
    outcome = spawn("--home", home, "--json", "--passphrase-fd", "77", "backup", tmp_path / "b")
    assert (outcome.code, outcome.json["error"]["code"]) == (2, "usage")
    assert "77" in outcome.json["error"]["message"]


def test_a_passphrase_that_is_no_text_is_reported_and_not_shown(home: Path, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.write(write, b"\xff\xfe hidden words \n")
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--json", "--home", str(home), "--passphrase-fd", str(read)]
    done = subprocess.run(
        [*command, "backup", str(tmp_path / "b")], pass_fds=(read,), capture_output=True, text=True, check=False
    )
    os.close(read)
    assert done.returncode == 7
    assert "hidden" not in done.stdout + done.stderr


# -- interruption ------------------------------------------------------------------------------------------------------


def interrupted(home: Path, *words: str, after: str) -> Outcome:
    process = subprocess.Popen(
        [sys.executable, "-m", "teds_provision", "--home", str(home), *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=clean_environment(),
    )
    try:
        stream = process.stdout if after == "out" else process.stderr
        assert stream is not None
        first = stream.readline()
        assert first
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    return Outcome(process.returncode, out, err)


def test_ctrl_c_is_130_without_a_traceback(home: Path) -> None:
    ended = interrupted(home, "log", "--follow", after="out")
    assert ended.code == 130
    assert "Traceback" not in ended.err
    assert "Interrupted" in ended.err


def test_ctrl_c_while_starting_is_130_too(home: Path) -> None:
    for delay in (0.02, 0.05, 0.1, 0.15):
        process = subprocess.Popen(
            [sys.executable, "-m", "teds_provision", "--home", str(home), "log", "--follow"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=clean_environment(),
        )
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        try:
            _, err = process.communicate(timeout=60)
        except (
            subprocess.TimeoutExpired
        ):  # Python throws away what is raised in a callback of its importer: press again
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
            continue
        if (
            '__main__.py"' in err and ", in main" in err
        ):  # else Python had not come as far as our main (site has one too)
            assert "Traceback" not in err
            assert process.returncode == 130
