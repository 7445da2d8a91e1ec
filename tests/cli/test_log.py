"""``log``: every act, whether the chain holds, and following it."""

from __future__ import annotations

import json
import os
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

import click
import pytest

from teds_provision.cli.options import tracing
from teds_provision.cli.rendering import local_time
from teds_provision.errors import LinkError
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter
from teds_provision.station.store.store import Store
from teds_provision.trace import record as record_lines
from teds_provision.trace.record import Record
from tests.bench import PASSPHRASE
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


# -- whole outputs -----------------------------------------------------------------------------------------------------

NODE = bytes(range(10))


def test_the_lines_of_a_log_and_its_sum(home: Path) -> None:
    with Station.open(home, ask=lambda prompt, confirm: PASSPHRASE) as station:
        first = station.audit_log.newest()[0]
        station.audit("verify", NODE, "authentic", digest="ab" * 32, count=3, nothing=None, name="left hand")
        station.audit("agree", NODE, "refused: other key")
        station.audit("verify", None, "done")
        entries = list(station.audit_log.chosen(AuditFilter(), first))
    outcome = call(home, "log", "--last", "3")
    heads = [f"{entry.seq:>5}  {local_time(entry.at)}  {entry.who}  " for entry in entries]
    assert outcome.out.splitlines() == [
        f"{heads[0]}verify     {NODE.hex()}  authentic  count 3, digest {'ab' * 8}, name left hand",
        f"{heads[1]}agree      {NODE.hex()}  refused: other key",
        f"{heads[2]}verify     -                     done",
    ]
    count, head = entries[-1].seq, entries[-1].hash
    assert outcome.err == f"{count} entries, chain intact from entry {first + 1} on, head {head[:16]}.\n"
    failed = call(home, "log", NODE.hex(), "--failed")
    assert len(failed.out.splitlines()) == 1
    assert failed.err.splitlines()[0] == "1 entry, 1 failed: 1 agree"
    none = call(home, "log", "--act", "nothing")
    assert (none.out, none.err.splitlines()[0]) == ("", "0 entries, 0 failed.")
    found = json.loads(call(home, "--json", "log", "--last", "3").out)
    assert found.pop("entries")[0] == {
        "seq": first + 1, "at": entries[0].at, "who": entries[0].who, "actor": entries[0].actor, "act": "verify",
        "uuid": NODE.hex(), "outcome": "authentic",
        "detail": {"digest": "ab" * 32, "count": 3, "nothing": None, "name": "left hand"}, "hash": entries[0].hash,
    }  # fmt: skip
    assert found == {
        "intact": True, "checked": {"after": first, "to": count}, "count": count, "head": head, "first_bad": None,
        "why": "", "totals": {"entries": 3, "failed": 1, "acts": {"verify": 2, "agree": 1}},
    }  # fmt: skip
    both = call(home, "log", "--today", "--since", "2h")
    assert (both.code, "--today and --since cannot be combined." in both.err) == (2, True)


def test_a_trace_is_shown_line_by_line(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "t.trace"
    records = [
        Record(1.5, "out", "can", "frame", bytes(8), "f1 to 21: x", identifier=0x18DA21F1),
        Record(2.0, "in", "nfc", "message", b"\1" * 30, "List", opened=b"\2" * 25, sealed=True, uuid=NODE.hex()),
        Record(3.0, "in", "ble", "frame", b"\3" * 24),
        Record(4.0, "out", "nfc", "message", b"\4", "Sealed, not opened", sealed=True),
    ]
    path.write_bytes(record_lines.head() + b"".join(map(record_lines.line, records)))
    times = [datetime.fromtimestamp(record.time).astimezone().strftime("%H:%M:%S") for record in records]
    shown = call(home, "trace", "show", path).out.splitlines()
    assert shown == [
        f"{times[0]}.500 can  >   f1 to 21: x  18da21f1 {'00' * 8}",
        f"{times[1]}.000 nfc  < List  sealed  {'02' * 24}…",
        f"{times[2]}.000 ble  <     {'03' * 24}",
        f"{times[3]}.000 nfc  > Sealed, not opened  sealed  04",
    ]
    whole = call(home, "trace", "show", path, "--messages", "--whole").out.splitlines()
    assert whole == [f"{times[1]}.000 nfc  < List  sealed  {'02' * 25}", shown[3]]
    frames = json.loads(call(home, "--json", "trace", "show", path, "--messages").out)["frames"]
    assert frames == [records[1].as_json(), records[3].as_json()]
    path.write_bytes(record_lines.head())
    assert call(home, "trace", "show", path).out == "The trace is empty.\n"


def test_a_command_whose_trace_is_incomplete_is_7_if_all_else_went_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_descriptor: int, _octets: bytes) -> int:
        raise OSError(28, "No space left on device")

    def traced(name: str, *, fails: bool, error: Exception | None = None) -> None:
        with monkeypatch.context() as patched, tracing(tmp_path / name) as trace:
            assert trace is not None
            if fails:
                patched.setattr(os, "write", full)
            trace.frame("can", "out", b"\2", identifier=1)
            if error is not None:
                raise error

    traced("whole", fails=False)
    with pytest.raises(click.exceptions.Exit) as ended:
        traced("cut", fails=True)
    assert ended.value.exit_code == 7
    with pytest.raises(LinkError):
        traced("both", fails=True, error=LinkError("The node is silent."))
    with tracing(None) as none:
        assert none is None


def test_a_trace_without_a_frame_is_removed_also_after_ctrl_c(tmp_path: Path) -> None:
    """The same command can be typed again."""
    for number, error in enumerate((KeyboardInterrupt(), LinkError("It is silent."), SystemExit(1))):
        path = tmp_path / f"{number}.trace"
        with pytest.raises(type(error)), tracing(path):
            raise error
        assert not path.exists()
    with tracing(tmp_path / "whole"):
        pass
    assert (tmp_path / "whole").exists(), "who recorded nothing and ended well has an empty trace"
