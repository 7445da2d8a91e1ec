"""How commands end: one object on stdout whatever happens, dry runs without a trace, no lock while someone is asked."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from rich.spinner import Spinner

from teds_provision.cli.context import App
from teds_provision.cli.rendering import LiveReporter, tidy
from teds_provision.cli.station import vault as vault_command
from teds_provision.cli.terminal_operator import TerminalOperator
from teds_provision.errors import NotAuthenticError
from teds_provision.links import Notice
from teds_provision.links.nfc.message import NdefRecord
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.sign import SignOrder, sign_image
from teds_provision.station.station import Station
from teds_provision.station.store.lock import StoreLock
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.vault import agent

from ..bench import PASSPHRASE, Board, make_station, talk
from .shell import call, clean_environment, spawn

ANGLE = BuildOrder(profile="magnetic-angular-position-sensor")


def test_a_result_and_its_error_are_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    app = App(as_json=True)
    with pytest.raises(click.exceptions.Exit) as ended:
        app.conclude({"verdict": "unsigned"}, None, NotAuthenticError("Nobody signed it.", hint="Sign it."))
    assert ended.value.exit_code == 4
    record = json.loads(capsys.readouterr().out)
    assert record["verdict"] == "unsigned"
    assert record["error"] == {"code": "not-authentic", "message": "Nobody signed it.", "hint": "Sign it."}


def test_people_see_the_result_before_the_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(NotAuthenticError):
        App().conclude({}, "all checks", NotAuthenticError("Nobody signed it."))
    assert capsys.readouterr().out == "all checks\n"


def test_a_dry_run_of_sign_against_the_node_settles_no_key(tmp_path: Path) -> None:
    station, board = make_station(tmp_path / "home"), Board()
    station.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        agree(station, node, identify(station, node))
    build(station, board.uuid, ANGLE)
    station.keys.demand_rotation(board.uuid, "a copy was handed over")
    before = station.keys.keys_of(board.uuid)
    with talk(board) as node:
        sign_image(station, SignOrder(board.uuid, dry_run=True), node)
    assert station.keys.keys_of(board.uuid) == before
    assert board.state.epoch == 1


def test_the_store_is_free_while_a_person_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "home"
    station, board, asked = make_station(home), Board(), []

    def prompt(question: str, **_: object) -> str:
        with StoreLock(home, command="another", wait=0.0):
            asked.append(question)
        return "y"

    monkeypatch.setattr(click, "prompt", prompt)
    monkeypatch.setattr(App, "interactive", True)
    operator = TerminalOperator(App(home=home, quiet=True), yes=False)
    with talk(board) as node:
        done = provision(station, node, ANGLE, operator=operator, reporter=SilentReporter())
    assert done.verified.verdict == "authentic"
    assert len(asked) == 1


def test_nothing_that_a_tag_says_steers_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    hostile = NdefRecord(4, b"x\x1b]0;mine\x07[red]").name
    assert hostile == "urn:nfc:ext:x\\x1b]0;mine\\x07[red]"
    app = App()
    app.note("a\x1b[2Jb\u202ec\u009b")
    app.warn("a\x1b[2Jb")
    app.fail_line(NotAuthenticError("a\x1b[2Jb\r", hint="c\x9bd"))
    app.emit({}, "a\x1b[2Jb\nnext [line]")
    captured = capsys.readouterr()
    assert captured.out == "a?[2Jb\nnext [line]\n"
    assert captured.err == "a?[2Jb?c?\nWarning: a?[2Jb\nError: a?[2Jb?\n  → c?d\n"


def test_what_is_waited_for_is_no_markup() -> None:
    reporter = LiveReporter(App())
    reporter._what = "Looking on udp_multicast:[ff02::1] \x1b[2J"
    shown = reporter._render()
    assert isinstance(shown, Spinner)
    assert str(shown.text).strip() == "Looking on udp_multicast:[ff02::1] ?[2J"


def test_a_step_that_ended_with_its_board_is_not_shown_while_the_next_one_is_waited_for() -> None:
    reporter = LiveReporter(App())
    reporter.started("whitelist")
    reporter.notice(Notice("node-left", "Node 8d4d was taken off the reader."))
    reporter.notice(Notice("waiting", "Place a node on the reader."))
    shown = reporter._render()
    reporter.close()
    assert isinstance(shown, Spinner)
    assert str(shown.text) == "Place a node on the reader."


@pytest.mark.parametrize("ended", [KeyboardInterrupt, click.Abort])
def test_an_interrupted_command_says_so_in_json_too(
    ended: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(_home: Path, **_: object) -> None:
        raise ended

    monkeypatch.setattr("teds_provision.station.station.Station.open", end)
    in_json = call(tmp_path, "--json", "nodes")
    assert (in_json.code, in_json.json["error"]["code"]) == (130, "interrupted")
    outcome = call(tmp_path, "nodes")
    assert (outcome.code, outcome.out, outcome.err) == (
        130,
        "",
        "Interrupted. Run the same command again to continue.\n",
    )


def test_options_are_read_from_environment_and_config_by_the_name_that_people_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_station(tmp_path).close()
    (tmp_path / "config.toml").write_text("json = true\n")
    assert call(tmp_path, "nodes").json == {"nodes": []}
    (tmp_path / "config.toml").write_text('format = "json"\n')
    assert call(tmp_path, "whitelist", "export", tmp_path / "list").code == 0
    assert json.loads((tmp_path / "list").read_text()) == {"whitelist": []}
    (tmp_path / "config.toml").unlink()
    monkeypatch.setenv("TEDS_PROVISION_FORMAT", "csv")
    assert call(tmp_path, "whitelist", "export", tmp_path / "list").code == 0
    assert (tmp_path / "list").read_text().startswith("uuid,")


def test_json_is_json_whatever_stdout_can_write(tmp_path: Path) -> None:
    make_station(tmp_path).close()
    environment = clean_environment(PYTHONIOENCODING="ascii")
    name = "fräse \N{GEAR} \U0001f916"
    for words in (["whitelist", "add", "8d4d9da65281f7000000", "--name", name], ["whitelist", "list"]):
        outcome = spawn("--home", tmp_path, "--json", *words, passphrase=PASSPHRASE, environment=environment)
        assert outcome.json["whitelist"][0]["name"] == name


def test_what_is_wrong_with_a_link_is_reported_before_a_passphrase_is_asked_for(tmp_path: Path) -> None:
    station = make_station(tmp_path)
    station.pins.put(WhitelistEntry(Board.uuid))
    station.close()
    for words in (["agree", Board.uuid.hex()], ["provision", "--profile", "load-cell", "--yes"]):
        assert call(tmp_path, "--json", *words, "--via", "can").json["error"]["code"] == "usage"


def test_files_are_written_in_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    station = make_station(tmp_path)
    station.pins.put(WhitelistEntry(Board.uuid, name="fräse \N{GEAR}"))
    station.close()
    environment = clean_environment(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    exported = spawn("--home", tmp_path, "whitelist", "export", tmp_path / "list.xml", environment=environment)
    assert exported.code == 0, exported
    assert "fräse \N{GEAR}" in (tmp_path / "list.xml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("value", "uncertainty", "seen"),
    [
        (-2.13163e-17, 1e-4, "0"),
        (0.0799951, 1e-4, "0.0799951"),
        (-1.23456789, 0.5, "-1.2346"),
        (1.23456789, None, "1.23457"),
        (3e-12, 1e-15, "3e-12"),
        (-2e-17, 0.0, "-2e-17"),
        (12345.678, 5000.0, "12346"),
    ],
)
def test_a_value_has_no_digits_that_its_uncertainty_makes_noise_of(
    value: float, uncertainty: float | None, seen: str
) -> None:
    """The lower end of a gripper's range was shown as -2.13163e-17 m."""
    assert f"{tidy(value, uncertainty):.6g}" == seen


@pytest.mark.parametrize(
    ("lock", "words"),
    [
        ("ncap.lock", ("ncap", "run", "--can", "udp_multicast:239.74.163.2?port=1")),
        ("ncap.sock/", ("ncap", "run", "--can", "udp_multicast:239.74.163.2?port=1")),
        ("ncap-tokens.json.lock", ("ncap", "token", "add", "lab")),
        (f"measuring-{hashlib.sha256(b'hand').hexdigest()}.lock", ("group", "delete", "hand")),
    ],
)
def test_a_home_that_takes_no_lock_is_reported_as_a_store_that_fails(
    home: Path, lock: str, words: tuple[str, ...]
) -> None:
    """A disk that is read only from then on refused the lock first of all: that was "a bug" (make faults, EROFS)."""
    assert call(home, "group", "create", "hand").code == 0
    if lock.endswith("/"):
        (home / lock).mkdir()
        (home / lock / "kept").touch()
    else:
        (home / lock).symlink_to(home / lock)
    outcome = call(home, *words)
    assert outcome.code in (2, 7), outcome
    assert lock.rstrip("/") in outcome.err


def test_a_keystore_that_unlocks_itself_has_nothing_to_keep_in_memory(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent, "KINDS", ("pkcs11",))
    done = call(home, "--json", "unlock")
    assert (done.code, done.json) == (0, {"unlocked": False, "until": None, "keystore": "file"})
    assert call(home, "unlock").out == (
        "Nothing to do: this station's keys are in the file, which handles unlocking itself.\n"
    )


def test_a_token_with_a_pin_pad_leaves_nothing_to_keep_in_memory(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Any] = []
    monkeypatch.setattr(agent, "start", lambda *given: started.append(given))
    monkeypatch.setattr(Station, "vault", property(lambda _station: SimpleNamespace(opener=lambda: None)))
    refused = call(home, "--json", "unlock")
    assert (refused.code, refused.json["error"]["message"], started) == (
        2, "The token has its own PIN pad, so there is nothing to keep in memory.", [],
    )  # fmt: skip


@pytest.mark.parametrize(("span", "taken"), [("0s", False), ("1s", True), ("12h", True), ("43201s", False)])
def test_a_vault_stays_open_for_a_second_to_twelve_hours(
    home: Path, monkeypatch: pytest.MonkeyPatch, span: str, taken: bool
) -> None:
    started: list[Any] = []
    monkeypatch.setattr(agent, "start", lambda *given: started.append(given))
    done = call(home, "--json", "unlock", "--for", span)
    assert (done.code, len(started)) == ((0, 1) if taken else (2, 0))
    if taken:
        assert (started[0][1], started[0][3]) == ("file", 1 if span == "1s" else 43200)
    else:
        assert done.json["error"]["message"] == f"The vault can stay unlocked for 1 s to 12 h, not {span}."


@pytest.mark.parametrize(("damaged", "keys"), [(0, "0 keys"), (2, "2 keys"), (1, "1 key")])
def test_keys_that_no_master_key_opens_are_named_after_a_rewrap(
    home: Path, monkeypatch: pytest.MonkeyPatch, damaged: int, keys: str
) -> None:
    monkeypatch.setattr(vault_command, "rewrap_store", lambda _station: SimpleNamespace(damaged=damaged, keys=5))
    done = call(home, "--json", "vault", "rewrap")
    assert (done.code, done.json) == (0, {"keystore": "file", "rewrapped": 5, "damaged": damaged})
    words = f"Warning: {keys} in the store cannot be decrypted with any master key; run teds-provision doctor.\n"
    assert done.err == (words if damaged else "")
    assert call(home, "vault", "rewrap").out == "Rewrapped 5 keys under a new master key in the file keystore.\n"
