"""``log``: every act, whether the chain holds, and following it."""

from __future__ import annotations

import json
import re
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from teds_provision.station.store.store import Store
from tests.terminal import on_terminal

from .shell import call, clean_environment

ROOT = Path(__file__).parents[2]
ONE, TWO = "8d4d9da65281f7000000", "8d4d9da65281f7000001"


def tamper(home: Path, *statements: str) -> None:
    """Whoever may write the file can drop the triggers too."""
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection, connection:
        for name in ("changed", "shortened"):
            connection.execute(f"DROP TRIGGER audit_is_never_{name}")
        for statement in statements:
            connection.execute(statement)


def test_each_act_is_one_entry_and_the_chain_holds(home: Path) -> None:
    call(home, "whitelist", "add", ONE)
    call(home, "whitelist", "add", TWO)
    outcome = call(home, "--json", "log")
    assert (outcome.code, outcome.json["intact"], outcome.json["count"]) == (0, True, 3)
    assert [(entry["act"], entry["uuid"]) for entry in outcome.json["entries"]] == [
        ("init", None),
        ("whitelist", ONE),
        ("whitelist", TWO),
    ]
    assert [entry["uuid"] for entry in call(home, "--json", "log", TWO).json["entries"]] == [TWO]
    assert [entry["seq"] for entry in call(home, "--json", "log", "--last", 1).json["entries"]] == [3]
    shown = call(home, "log")
    assert ONE in shown.out
    assert "chain intact" in shown.err


@pytest.mark.parametrize(
    ("statement", "first_bad"),
    [
        ("UPDATE audit SET outcome = 'nothing' WHERE seq = 2", 2),
        ("DELETE FROM audit WHERE seq = 2", 2),
        ("DELETE FROM audit WHERE seq = 3", 3),
    ],
)
def test_a_broken_chain_is_exit_7_and_named(home: Path, statement: str, first_bad: int) -> None:
    call(home, "whitelist", "add", ONE)
    call(home, "whitelist", "add", TWO)
    tamper(home, statement)
    outcome = call(home, "--json", "log")
    assert (outcome.code, outcome.json["intact"], outcome.json["first_bad"]) == (7, False, first_bad)
    shown = call(home, "log")
    assert shown.code == 7
    assert "is not intact" in shown.err
    assert call(home, "log", "--follow").code == 7


def test_control_characters_in_an_entry_do_not_reach_the_terminal(home: Path) -> None:
    with Store.open(home) as store:
        store.audit.append("identify", bytes.fromhex(ONE), "odd", {"name": "a\x1b[31m\x9b\nb"})
    shown = call(home, "log").out
    assert "\x1b" not in shown
    assert "\x9b" not in shown
    assert shown.count("\n") == 2


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_following_gives_one_object_per_line_until_it_is_ended(home: Path, number: signal.Signals, code: int) -> None:
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--json", "log", "--follow"]
    follower = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=clean_environment()
    )
    try:
        assert follower.stdout is not None
        assert json.loads(follower.stdout.readline())["act"] == "init"
        call(home, "whitelist", "add", ONE)
        assert json.loads(follower.stdout.readline())["uuid"] == ONE
        follower.send_signal(number)
        _, err = follower.communicate(timeout=60)
    finally:
        follower.kill()
    assert follower.returncode == code
    assert "Traceback" not in err


def acts(home: Path, *words: object) -> list[str]:
    return [f"{entry['act']} {entry['outcome']}" for entry in call(home, "--json", "log", *words).json["entries"]]


def made_today(home: Path) -> int:
    """Return how many entries have the date that it is now where this machine is."""
    moments = [entry["at"] for entry in call(home, "--json", "log").json["entries"]]
    today = datetime.now().astimezone().date()
    return sum(datetime.fromisoformat(at).astimezone().date() == today for at in moments)


def test_entries_are_found_by_time_act_outcome_and_node(home: Path) -> None:
    with Store.open(home) as store:
        for outcome in ("authentic", "not authentic", "unproven"):
            store.audit.append("verify", bytes.fromhex(ONE), outcome)
        store.audit.append("write", bytes.fromhex(TWO), "refused", {"why": "'"})
    assert acts(home, "--failed") == ["verify not authentic", "verify unproven", "write refused"]
    assert acts(home, "--act", "verify") == ["verify authentic", "verify not authentic", "verify unproven"]
    assert acts(home, "--failed", "--last", 1) == ["write refused"]
    assert acts(home, ONE, "--failed", "--last", 1) == ["verify unproven"]
    assert acts(home, "--act", "it's") == []
    assert len(acts(home, "--since", "2h")) == 5
    before, shown, after = made_today(home), len(acts(home, "--today")), made_today(home)
    assert shown in (before, after), "midnight may pass at any time"
    assert acts(home, "--since", "2099-01-01") == []
    assert acts(home, "--last", 0) == []
    totals = call(home, "--json", "log", "--act", "verify").json["totals"]
    assert totals == {"entries": 3, "failed": 2, "acts": {"verify": 3}}
    assert "2 failed" in call(home, "log", "--act", "verify").err
    assert call(home, "log", "--today", "--since", "2h").code == 2


def test_an_entry_of_an_earlier_clock_hides_no_other_entry(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store.open(home) as store:
        for day in ("2026-05-04", "2026-05-05", "2026-05-04", "2026-05-05"):
            monkeypatch.setattr("teds_provision.station.store.audit.utc_now", lambda day=day: f"{day}T12:00:00Z")
            store.audit.append("verify", bytes.fromhex(ONE), f"of {day}")
    since = ("--since", "2026-05-05T00:00:00+00:00", "--act", "verify")
    shown = call(home, "--json", "log", *since)
    assert [entry["seq"] for entry in shown.json["entries"]] == [3, 5], "filtered by time, in the order of the chain"
    assert (shown.json["intact"], shown.json["totals"]["entries"]) == (True, 2)
    assert [entry["seq"] for entry in call(home, "--json", "log", *since, "--last", 1).json["entries"]] == [5]
    assert len(call(home, "log", *since).out.splitlines()) == 2
    tamper(home, "UPDATE audit SET detail = '{\"a\":1}' WHERE seq = 4")
    assert call(home, "log", *since).code == 7, "the chain is checked from the first entry shown on"


def errors() -> set[str]:
    """Return the code of every error of the tree, those that rooms add to it too, whichever of them are imported."""
    code = re.compile(r'^    code(?:: [\w\[\], ]+)? = "([a-z-]+)"', re.MULTILINE)
    texts = (path.read_text() for path in (ROOT / "teds_provision").rglob("*.py"))
    classes = (part for text in texts for part in re.findall(r"^class \w+Error\(.*?(?=^\S|\Z)", text, re.M | re.S))
    return {found[1] for part in classes if (found := code.search(part))}


def test_what_ended_with_an_error_of_any_kind_is_among_the_failed(home: Path) -> None:
    """A "no" at the question, a board of another owner, one that fell silent: they were left out."""
    codes = errors()
    assert {
        "declined",
        "unclear-item",
        "missing-field",
        "wrong-board",
        "not-named",
        "node-refused",
        "node-silent",
        "not-whitelisted",
        "bad-data",
    } <= codes
    with Store.open(home) as store:
        for code in sorted(codes):
            store.audit.append("provision", bytes.fromhex(ONE), code)
        for outcome in ("done", "begun", "pending", "active", "nothing", "authentic", "new passphrase", "locked"):
            store.audit.append("provision", bytes.fromhex(TWO), outcome)
    assert acts(home, "--failed") == [f"provision {code}" for code in sorted(codes)]
    assert call(home, "--json", "log").json["totals"]["failed"] == len(codes)


def test_a_part_of_the_log_is_checked_from_its_first_entry_on(home: Path) -> None:
    with Store.open(home) as store:
        for number in range(6):
            store.audit.append("test", None, str(number))
    tamper(home, "UPDATE audit SET outcome = 'nothing' WHERE seq = 3")
    assert call(home, "log").code == 7
    assert call(home, "log", "--last", 5).code == 7
    outcome = call(home, "--json", "log", "--last", 3)
    assert (outcome.code, outcome.json["intact"], outcome.json["checked"]) == (0, True, {"after": 4, "to": 7})
    tamper_again = "DELETE FROM audit WHERE seq = 7"
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection, connection:
        connection.execute(tamper_again)
    assert call(home, "log", "--last", 1).code == 7  # the end that was cut off is noticed from anywhere


def test_times_are_shown_in_local_time_with_offset(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Store.open(home) as store:
        store.audit.append("test", None, "done")
        at = next(iter(store.audit.entries(1))).at
    monkeypatch.setenv("TZ", "Asia/Kolkata")
    time.tzset()
    try:
        out = call(home, "log", "--last", 1).out
    finally:
        monkeypatch.undo()
        time.tzset()
    moment = datetime.fromisoformat(at).astimezone(ZoneInfo("Asia/Kolkata"))
    assert moment.isoformat(sep=" ", timespec="seconds") in out
    assert "+05:30" in out


def test_a_terminal_of_80_columns_cuts_nothing_off(home: Path) -> None:
    call(home, "whitelist", "add", ONE, "--name", "a rather long name of a finger", "--fingerprint", "ab" * 32)
    outcome = on_terminal(home, "log", columns=80, environment=clean_environment(TERM="xterm"))
    assert outcome.code == 0
    lines = outcome.screen.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(ONE in line and "whitelist" in line and "added" in line for line in lines)
    assert "assurance" in outcome.screen
