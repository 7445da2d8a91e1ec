"""``ncap``: what its commands print of a running base station, whole, and the lines of the daemon."""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import measure as measure_room
from teds_provision.cli.rendering import local_time
from teds_provision.cli.service import ncap as commands
from teds_provision.cli.service.ncap import DaemonLog
from teds_provision.errors import LinkError
from teds_provision.measure.matching import MatchSurvey
from teds_provision.ncap.web.tokens import Token, Tokens
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.pace import PATIENCE, until

from .shell import call

A, B, C = ("0a" * 10, "0b" * 10, "0c" * 10)
NO_LINK = "No link is configured, so no board is found. To add one: teds-provision ncap run --can socketcan:can0"


class Running:
    """Stands for the service that runs: what it answers, and what it was asked for."""

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}
        self.shown: list[dict[str, Any]] = []
        self.kept: list[dict[str, Any]] = []
        self.asked: list[Any] = []

    def status(self) -> dict[str, Any]:
        return self.found

    def nodes(self) -> list[dict[str, Any]]:
        return self.shown

    def measurements(self) -> list[dict[str, Any]]:
        return self.kept

    def measure(self, **how: Any) -> dict[str, Any]:
        self.asked.append(how)
        return {"id": "m1"}

    def end_measurement(self, id_: str) -> None:
        self.asked.append(id_)

    def set_detection(self, mode: str) -> str:
        return f"{mode} now"

    def login_url(self, *, read_only: bool) -> str:
        return f"http://x/?read_only={read_only}"


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> Running:
    made = Running()

    @contextmanager
    def connect(home: Path) -> Iterator[Running]:
        yield made

    monkeypatch.setattr(commands, "client", SimpleNamespace(connect=connect))
    return made


def link(place: str, *, virtual: bool = False, **changes: Any) -> dict[str, Any]:
    usual = {"place": place, "state": "open", "nodes": 1, "strangers": 0, "problem": None, "virtual": virtual}
    return usual | changes


def node(uuid: str, name: str | None, **changes: Any) -> dict[str, Any]:
    usual = {"uuid": uuid, "name": name, "present": True, "last_seen": None, "problem": None, "measuring": None,
             "verdict": {"verdict": "authentic", "from": "session"}}  # fmt: skip
    return usual | changes


def test_the_status_of_a_busy_station(home: Path, running: Running) -> None:
    seen = "2026-01-31T12:00:00Z"
    running.found = {
        "station": {"name": "hall"}, "detection": "whitelist", "url": "http://127.0.0.1:8351", "links": [
            link("can:socketcan:can0", nodes=2, strangers=3),
            link("nfc:usb", state="missing", nodes=0, problem={"message": "It is unplugged."}),
            link("virtual", virtual=True),
        ],
        "vault": {"problem": {"message": "Another passphrase.", "hint": "Unlock it."}},
        "measurements": [
            {"id": "m1", "match": "all", "why": "", "owner": "ncap", "state": "running", "nodes": [
                {"uuid": A, "state": "running", "why": ""},
                {"uuid": B, "state": "waiting", "why": "no room on the bus"}]},
            {"id": "m2", "match": None, "why": "ended", "owner": "command", "state": "stopped", "nodes": [
                {"uuid": A, "state": "running", "why": "x"}]},
        ],
        "foxglove": "ws://127.0.0.1:8765",
        "sinks": [{"name": "csv", "error": "disk full", "detail": "x", "state": "failed", "dropped": 3},
                  {"name": "mqtt", "error": "", "detail": "", "state": "ok", "dropped": 0}],
        "started": 1_767_225_600.5,
    }  # fmt: skip
    running.shown = [
        node(B, "b2", present=False, last_seen=seen, problem={"message": "It is silent."}),
        node(A, "b10", verdict={"verdict": "authentic", "from": "kept"}),
        node(C, None, present=False, verdict=None),
        node("0d" * 10, "d", verdict={"verdict": "unproven", "from": "kept"}, unverified=True),
        node("0e" * 10, "e", measuring={"state": "running"}),
    ]
    stale = " (of its last session: the vault is locked)"
    lines = call(home, "ncap", "status").out.splitlines()
    assert lines[:5] == [
        "hall: whitelist mode, http://127.0.0.1:8351",
        "The vault is locked: Another passphrase. Unlock it.",
        "can:socketcan:can0: open, 2 nodes, 3 not on the whitelist",
        "nfc:usb: missing, 0 nodes: It is unplugged.",
        "virtual: open, 1 node",
    ]
    assert sorted(lines[5:10]) == sorted([
        f"{B}  b2  away, last seen {local_time(seen)}  authentic{stale}: It is silent.",
        f"{A}  b10  there  authentic (stored copy, except the Security TEDS){stale}",
        f"{C}  no name  away  not verified yet",
        f"{'0d' * 10}  d  there  unverified (its datasheet is not signed){stale}",
        f"{'0e' * 10}  e  there  authentic",
    ])  # fmt: skip
    assert lines.index(f"{B}  b2  away, last seen {local_time(seen)}  authentic{stale}: It is silent.") < next(
        at for at, line in enumerate(lines) if line.startswith(A)
    ), "b2 comes before b10"
    assert lines[10:] == [
        "measurement m1 of all: running",
        f"  {A} running",
        f"  {B} waiting: no room on the bus",
        "  → Running streams are not slowed down. A lower --rate leaves room for all.",
        "measurement m2 (command): stopped: ended",
        "Foxglove: ws://127.0.0.1:8765",
        "csv: failed, 3 dropped: disk full",
        "mqtt: ok, 0 dropped",
    ]
    assert call(home, "--json", "ncap", "status").json["started"] == "2026-01-01T00:00:00.500Z"


NOT_NOW = "not verified now (authentic when last read)"


@pytest.mark.parametrize(
    ("changes", "shown"),
    [
        ({"problem": {"message": "It has another key."}}, f"{NOT_NOW}: It has another key."),
        ({"heard": {"verdict": "authentic"}}, NOT_NOW),
        ({"problem": {"message": "It is silent."}, "present": False}, "authentic: It is silent."),
        ({"problem": {"message": "No reply."}, "measuring": {"state": "running"}}, "authentic: No reply."),
        ({"problem": {"message": "No reply."}, "measuring": {"state": "waiting"}}, f"{NOT_NOW}: No reply."),
    ],
)  # fmt: skip
def test_a_board_that_did_not_prove_itself_is_not_shown_as_authentic(
    home: Path, running: Running, changes: dict[str, Any], shown: str
) -> None:
    """A board with another key under a known UUID stood there as authentic, with the reason behind it."""
    running.found = {"station": {"name": "hall"}, "detection": "whitelist", "url": None, "links": [link("can:x")]}
    running.shown = [node(A, "arm", **changes)]
    line = call(home, "ncap", "status").out.splitlines()[-1]
    assert line.split("  ", 3)[-1] == shown


def test_the_status_without_page_and_links(home: Path, running: Running) -> None:
    running.found = {"station": {"name": "hall"}, "detection": "transparent", "url": None, "links": [
        link("virtual", virtual=True, nodes=0)]}  # fmt: skip
    assert call(home, "ncap", "status").out.splitlines() == [
        "hall: transparent mode, no page (start it with --http)", NO_LINK, "virtual: open, 0 nodes"
    ]  # fmt: skip


def measured(id_: str, *, match: str | None = None, owner: str = "ncap", **more: Any) -> dict[str, Any]:
    return {"id": id_, "match": match, "group": None, "uuids": [], "owner": owner, "process": None} | more


@pytest.mark.parametrize(
    ("wanted", "ended", "text"),
    [
        ("all", ["m1", "m2", "m3"], "Ended: m1 (all); m2 (arm); m3 (0a, 0b)."),
        ("m1", ["m1"], "Ended: m1 (all)."),
        ("arm", ["m2"], "Ended: m2 (arm)."),
        ("0a, 0b", ["m3"], "Ended: m3 (0a, 0b)."),
    ],
)
def test_measurements_are_ended_by_expression_group_or_id(
    home: Path, running: Running, wanted: str, ended: list[str], text: str
) -> None:
    running.kept = [measured("m1", match="all"), measured("m2", group="arm"), measured("m3", uuids=["0a", "0b"]),
                    measured("m4", match="x", owner="command", process={"id": 77})]  # fmt: skip
    outcome = call(home, "ncap", "measure", wanted, "--stop")
    assert (outcome.out, running.asked) == (f"{text}\n", ended)
    assert call(home, "--json", "ncap", "measure", wanted, "--stop").json == {"stopped": ended}


def test_what_a_command_measures_ends_there_and_what_nobody_keeps_is_named(home: Path, running: Running) -> None:
    assert call(home, "ncap", "measure", "all", "--stop").out == "Nothing to do: no measurement is kept.\n"
    running.kept = [measured("m4", match="x", owner="command", process={"id": 77})]
    refused = call(home, "--json", "ncap", "measure", "x", "--stop")
    assert (refused.code, refused.json["error"]["message"]) == (6, "x is measured by a command (process 77).")
    running.kept = [measured("m4", match="x", owner="command")]
    assert (
        call(home, "--json", "ncap", "measure", "x", "--stop").json["error"]["message"] == "x is measured by a command."
    )
    unknown = call(home, "--json", "ncap", "measure", "y", "--stop")
    assert (unknown.code, unknown.json["error"]["hint"]) == (3, "Kept: m4 (x).")
    running.kept = []
    assert call(home, "--json", "ncap", "measure", "y", "--stop").json["error"]["hint"] == "Kept: none."
    assert running.asked == []
    for more in (("--rate", "5"), ("--frozen",), ("--to", "x.csv")):
        both = call(home, "--json", "ncap", "measure", "all", "--stop", *more)
        assert (both.code, both.json["error"]["message"]) == (2, "--stop ends a measurement.")


def test_what_is_measured_and_why_others_are_not(home: Path, running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    uuids = [f"{number:020x}" for number in range(20)]
    with Station.open(home, ask=lambda prompt, confirm: PASSPHRASE) as station, station.transaction():
        for number, uuid in enumerate(uuids):
            station.nodes.remember(bytes.fromhex(uuid), name=f"n{number}" if number else None)
    reasons = {uuid: f"reason {number % 7}" for number, uuid in enumerate(uuids[7:])}
    survey = MatchSurvey(tuple(uuids[:7]), reasons)
    monkeypatch.setattr(measure_room.matching, "survey", lambda *_: survey)
    running.shown = [{"uuid": uuids[0], "present": True}, {"uuid": uuids[1], "present": False},
                     {"uuid": uuids[2], "present": True}, {"uuid": uuids[8], "present": True}]  # fmt: skip
    outcome = call(home, "ncap", "measure", "all", "--rate", "50", "--to", "x.csv")
    assert outcome.out.splitlines() == [
        "Measuring all (measurement m1).",
        f"7 nodes match now, 2 present: {uuids[0]}, n1, n2, n3, n4 and 2 more.",
        "Not n7, n14: reason 0.",
        "Not n8, n15: reason 1.",
        "Not n9, n16: reason 2.",
        "Not n10, n17: reason 3.",
        "Not n11, n18: reason 4.",
        "2 more reasons are in the output of --json.",
    ]
    assert running.asked == [{"match": "all", "rate": 50.0, "frozen": False, "sinks": ("x.csv",)}]
    survey = MatchSurvey((uuids[1],), {})
    assert call(home, "ncap", "measure", "all").out.splitlines()[1:] == ["1 node matches now, 0 present: n1."]
    survey = MatchSurvey((), {})
    assert call(home, "ncap", "measure", "all").out.splitlines()[1:] == ["0 nodes match now."]
    survey = MatchSurvey(tuple(uuids[1:6]), {uuid: f"reason {number}" for number, uuid in enumerate(uuids[6:11])})
    five = call(home, "ncap", "measure", "all").out.splitlines()[1:]
    assert five == [
        "5 nodes match now, 1 present: n1, n2, n3, n4, n5.",
        *(f"Not n{number + 6}: reason {number}." for number in range(5)),
    ], "five are named without a remainder"


def test_detection_address_and_tokens(home: Path, running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call(home, "ncap", "detection", "transparent").out == "Detection: transparent now.\n"
    assert call(home, "ncap", "open", "--read-only").out == "http://x/?read_only=True\n"
    assert call(home, "--json", "ncap", "open").json == {"url": "http://x/?read_only=False"}
    none = call(home, "ncap", "token", "list")
    assert none.out == "There are no tokens. To create one: teds-provision ncap token add NAME\n"
    made = call(home, "--json", "ncap", "token", "add", "plotter", "--read-only").json
    assert (made["name"], made["read_only"], len(made["token"]) > 20) == ("plotter", True, True)
    call(home, "ncap", "token", "add", "script")
    listed = call(home, "ncap", "token", "list").out.splitlines()
    assert [line.split("  ")[0::2] for line in listed] == [["plotter", "read-only"], ["script"]]
    (plotter, _) = call(home, "--json", "ncap", "token", "list").json["tokens"]
    assert set(plotter) == {"name", "kind", "read_only", "created", "until"}
    assert plotter["created"].endswith("Z")
    assert (plotter["until"], plotter["read_only"], plotter["kind"]) == (None, True, "script"), "it has no end"
    browser = Token("browser", "browser", "ab" * 32, created=1_795_000_000.0, until=1_795_003_600.0)
    with monkeypatch.context() as patched:
        patched.setattr(Tokens, "all", lambda _tokens: [browser])
        assert call(home, "--json", "ncap", "token", "list").json["tokens"] == [
            {"name": "browser", "kind": "browser", "read_only": False, "created": "2026-11-18T11:06:40Z",
             "until": "2026-11-18T12:06:40Z"}
        ]  # fmt: skip
    assert call(home, "--json", "ncap", "token", "remove", "plotter").json == {"removed": "plotter", "count": 1}
    assert call(home, "ncap", "token", "remove", "plotter").code == 3


# -- the daemon's lines ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("event", "text"),
    [
        ({"ready": True, "url": "http://x", "api": "unix:/s", "links": ["can"]},
         "Ready on http://x. To open the page: teds-provision ncap open"),
        ({"ready": True, "url": None, "api": "unix:/run/s", "links": [], "foxglove": "ws://f"},
         "Ready on the Unix socket /run/s. To open the page: teds-provision ncap open\nFoxglove: ws://f\n" + NO_LINK),
        ({"event": "node", "state": "joined", "uuid": A, "time": 5, "why": "", "count": 0},
         f"node joined: uuid {A}"),
        ({"event": "link", "state": "missing", "problem": {"message": "gone", "hint": "x"}, "count": 2},
         "link missing: problem gone, count 2"),
        ({"event": "store", "state": "changed", "time": 5}, "store changed"),
        ({"event": "lines", "count": 3}, "lines: count 3"),
    ],
)  # fmt: skip
def test_an_event_as_a_sentence(event: dict[str, Any], text: str) -> None:
    assert commands._sentence(event) == text


def test_moments_and_nothing_else_are_dated() -> None:
    given = {"time": 0, "since": 1.5, "started": None, "until": True, "tapped": "x", "count": 5,
             "links": [{"since": 2.0004, "rate": 3.0}], "more": {"time": 1}}  # fmt: skip
    assert commands._dated(given) == {
        "time": "1970-01-01T00:00:00.000Z", "since": "1970-01-01T00:00:01.500Z", "started": None, "until": True,
        "tapped": "x", "count": 5, "links": [{"since": "1970-01-01T00:00:02.000Z", "rate": 3.0}],
        "more": {"time": "1970-01-01T00:00:01.000Z"},
    }  # fmt: skip


class Slow(io.StringIO):
    """A pipe whose reader waits at first."""

    def __init__(self) -> None:
        super().__init__()
        self.go, self.entered = threading.Event(), threading.Event()

    def write(self, text: str) -> int:
        self.entered.set()
        self.go.wait(PATIENCE)
        return super().write(text)


def test_of_lines_that_nobody_reads_the_oldest_go_and_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = Slow()
    monkeypatch.setattr(sys, "stdout", pipe)
    lines = DaemonLog(cast("Any", SimpleNamespace(json=True)))
    lines.write_event({"event": "first"})
    assert pipe.entered.wait(PATIENCE)
    for number in range(1003):
        lines.write_event({"event": "node", "number": number})
    pipe.go.set()
    until(lambda: pipe.getvalue().count("\n") == 1002)
    lines.write_event({"event": "last"})
    assert lines.end()
    *written, last = pipe.getvalue().splitlines()
    assert last == '{"event": "last"}', "what was dropped is counted once"
    assert len(written) == 1002
    assert written[0] == '{"event": "first"}'
    assert written[1] == '{"event": "lines", "state": "dropped", "count": 3}'
    assert written[2] == '{"event": "node", "number": 3}'
    assert written[-1] == '{"event": "node", "number": 1002}'


def test_the_end_does_not_wait_for_a_reader_that_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = Slow()
    monkeypatch.setattr(sys, "stdout", pipe)
    monkeypatch.setattr(commands, "LEAVING", 0.01)
    lines = DaemonLog(cast("Any", SimpleNamespace(json=True)))
    lines.write_event({"event": "first"})
    assert pipe.entered.wait(PATIENCE)
    assert not lines.end()
    pipe.go.set()
    lines._thread.join(PATIENCE)


@pytest.fixture
def ran(home: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the settings with which the service is run; it ends at once."""
    found: list[Any] = []
    monkeypatch.setattr(commands.service_run, "run", lambda _station, settings, _on_event: found.append(settings))
    return found


def test_a_service_without_its_packages_says_how_to_get_them(
    home: Path, ran: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = commands.importlib.util.find_spec
    absent = ("starlette", "websockets")
    monkeypatch.setattr(
        commands.importlib.util, "find_spec", lambda name, *more: None if name in absent else find(name, *more)
    )
    done = call(home, "--json", "ncap", "run")
    assert (done.code, done.json["error"]["message"], ran) == (2, "ncap run needs starlette, websockets.", [])
    assert "[ncap]" in done.json["error"]["hint"]


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (["--yes"], "--yes requires --adopt.", "Add --adopt --detection transparent."),
        (["--unverified"], "--unverified requires --adopt.", "Add --adopt --detection transparent."),
        (["--rate", "5"], "--rate and --frozen require --measure.", "Add --measure all."),
        (["--frozen"], "--rate and --frozen require --measure.", "Add --measure all."),
    ],
)
def test_options_of_the_service_that_need_another(
    home: Path, ran: list[Any], words: list[str], message: str, hint: str
) -> None:
    done = call(home, "--json", "ncap", "run", *words)
    assert (done.code, done.json) == (2, {"error": {"code": "usage", "message": message, "hint": hint}})
    assert ran == []


def test_the_service_gets_what_was_asked_for_and_a_type_that_nobody_knows_is_named(home: Path, ran: list[Any]) -> None:
    words = ["--measure", "type:nothing", "--rate", "5", "--ros2", "--mqtt", "mqtt://localhost", "--no-scalars"]
    done = call(home, "ncap", "run", "--can", "virtual:a", "--can", "virtual:a", "--can", "virtual:b", *words)
    assert done.code == 0, done
    assert "Warning: Nothing is measured until a node of that type comes: " in done.err
    [settings] = ran
    assert settings.places == ("can:virtual:a", "can:virtual:b")
    assert (settings.sinks, settings.scalars, settings.measure, settings.rate) == (
        ("ros2", "mqtt://localhost"), False, "type:nothing", 5.0,
    )  # fmt: skip
    assert (settings.http, settings.unverified) == (None, False)
    quiet = call(home, "ncap", "run", "--measure", "all", "--ros1")
    assert ("Nothing is measured" in quiet.err, ran[1].sinks, ran[1].places, ran[1].scalars) == (
        False,
        ("ros1",),
        (),
        True,
    )


def test_a_writer_that_hangs_at_the_end_delays_the_exit_of_no_service_that_ended_in_order(
    home: Path, ran: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[int] = []
    monkeypatch.setattr(commands.os, "_exit", ended.append)
    for written in (True, False):
        monkeypatch.setattr(DaemonLog, "end", lambda _log, written=written: written)
        assert call(home, "ncap", "run").code == 0
        assert ended == ([] if written else [0])


def test_a_service_that_fails_has_printed_its_events_before_its_error(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[str] = []

    def run(*_: Any) -> None:
        course.append("run")
        raise LinkError("The address is taken.")

    monkeypatch.setattr(commands.service_run, "run", run)
    monkeypatch.setattr(DaemonLog, "end", lambda _log: course.append("end"))
    monkeypatch.setattr(Station, "unlock", lambda _station: course.append("unlock"))
    done = call(home, "--json", "ncap", "run")
    assert (done.code, done.json["error"]["message"]) == (5, "The address is taken.")
    assert course == ["unlock", "run", "end"], "no passphrase is asked for later"


def test_a_group_that_does_not_exist_is_refused_before_the_service_begins(home: Path, ran: list[Any]) -> None:
    done = call(home, "--json", "ncap", "run", "--measure", "group:nobody")
    assert (done.code, "nobody" in done.json["error"]["message"], ran) == (3, True, [])


def test_a_part_of_an_optional_room_may_refuse_a_station(
    home: Path, ran: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    kinds = [SimpleNamespace(name=name, require=lambda _station, name=name: asked.append(name)) for name in ("a", "b")]
    monkeypatch.setattr(commands.service_part, "KINDS", SimpleNamespace(parts=lambda: kinds))
    settings_of = commands.settings.Settings
    monkeypatch.setattr(commands.settings, "Settings", lambda **how: settings_of(**how | {"parts": ("b",)}))
    assert call(home, "ncap", "run").code == 0
    assert (asked, ran[0].parts) == (["b"], ("b",))


def test_a_setting_for_unverified_nodes_counts_only_with_adopt(home: Path, ran: list[Any]) -> None:
    """In config.toml it may stand for the days on which nodes are adopted."""
    (home / "config.toml").write_text("[ncap.run]\nunverified = true\n")
    assert call(home, "ncap", "run", "--can", "virtual:a").code == 0
    assert ran[0].unverified is False
    assert call(home, "ncap", "run", "--can", "virtual:a", "--adopt", "--detection", "transparent").code == 0
    assert ran[1].unverified is True
