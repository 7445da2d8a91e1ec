"""``record`` by command: pairs with a recorder that writes, one that was killed, and itself."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.measure.blocks import ChannelFacts, ClockSet, NodeReport
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.sinks import Sink, open_sink
from teds_provision.teds.units import parse_units
from tests.cli.shell import call, unmeasured_environment
from tests.measure.recordings.test_converting import content, recorded
from tests.measure.sinks.parts import ANGLE, ARM, STATION, block
from tests.pace import until

WRITER = """
import sys, time
from teds_provision.measure.sinks import open_sink
from tests.measure.sinks.parts import ANGLE, STATION, block
sink = open_sink(sys.argv[1])
sink.open((ANGLE,), STATION)
for k in range(0, 1_000_000, 3):
    sink.write(block(index=k))
    if k % 30 == 0:
        time.sleep(0.01)
"""


def rows_in(path: Path) -> int:
    return sum(len(entry.time) for entry in open_recording(path).entries() if hasattr(entry, "value"))


@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".mcap"])
def test_a_recorder_that_is_killed_in_the_middle_leaves_what_info_and_convert_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    writer = subprocess.Popen([sys.executable, "-c", WRITER, path], env=unmeasured_environment())
    try:
        until(lambda: path.exists() and path.stat().st_size > 30_000)
        info = json.loads(call(tmp_path / "home", "--json", "record", "info", str(path)).out)
        assert info["being_written"] is True
        assert info["messages"] > 0
        early = call(tmp_path / "home", "record", "convert", str(path), str(tmp_path / f"early{suffix}"))
        assert early.code == 0
        assert "still being written" in early.err
    finally:
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
    octets = path.read_bytes()
    done = call(tmp_path / "home", "--json", "record", "convert", str(path), str(tmp_path / "whole.mcap"))
    assert done.code == 0, done.err
    told_of = json.loads(done.out)
    assert told_of["being_written"] is False
    assert path.read_bytes() == octets, "the recording itself is only read"
    assert (
        info["messages"]
        <= rows_in(tmp_path / f"early{suffix}")
        <= told_of["messages"]
        == rows_in(tmp_path / "whole.mcap")
    )
    assert content(tmp_path / "whole.mcap")["missing"] == 0, "all of it, from the first sample on"
    if suffix == ".mcap":
        assert told_of["complete"] is False
        assert "was cut off" in done.err
        assert call(tmp_path / "home", "measure", "recover", str(path)).code == 0
        assert json.loads(call(tmp_path / "home", "--json", "record", "info", str(path)).out)["complete"] is True


def test_two_conversions_to_one_name_leave_one_whole_file(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", [block(index=k) for k in range(0, 15_000, 3)])
    words = [sys.executable, "-m", "teds_provision", "record", "convert", str(source), str(tmp_path / "to.csv")]
    both = [subprocess.Popen(words, env=unmeasured_environment(), stderr=subprocess.PIPE) for _ in range(2)]
    codes = sorted((process.communicate()[0], process.returncode)[1] for process in both)
    assert codes == [0, 2]
    assert rows_in(tmp_path / "to.csv") == 15_000
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "to.csv"}


def test_what_a_killed_conversion_left_is_removed_by_the_next_one(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", [block(index=k) for k in range(0, 45_000, 3)])
    words = [sys.executable, "-m", "teds_provision", "record", "convert", str(source), str(tmp_path / "to.csv")]
    killed = subprocess.Popen(words, env=unmeasured_environment())
    until(lambda: any(found.name.endswith(".teds-part") for found in tmp_path.iterdir()))
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    if not (tmp_path / "to.csv").exists():
        assert call(tmp_path / "home", "record", "convert", str(source), str(tmp_path / "to.csv")).code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "to.csv"}


def test_show_speaks_peoples_units_and_json_speaks_si(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap")
    lines = call(tmp_path / "home", "record", "show", str(path), "--limit", "2").out.splitlines()
    assert len(lines) == 2
    assert lines[1].endswith("arm/angle 5.72958 °")
    printed = call(tmp_path / "home", "--json", "record", "show", path, "--channel", "3").out
    *events, end = [json.loads(line) for line in printed.splitlines()]
    assert {(event["event"], event["channel"], event["unit"]) for event in events} == {("data", 3, "K")}
    assert sum(len(event["time"]) for event in events) == 40
    assert end["event"] == "end"
    assert end["samples"] == 120, "the end counts the whole recording"


def test_show_limits_what_is_shown_and_never_what_is_counted(tmp_path: Path) -> None:
    """Twenty instants unless asked otherwise, of all channels or the chosen ones; with JSON all of them."""
    path, home = recorded(tmp_path / "run.mcap"), tmp_path / "home"
    plain = call(home, "record", "show", str(path))
    assert len(plain.out.splitlines()) == 20
    assert plain.err.strip() == "80 time stamps in all; use --limit to show more."
    whole = call(home, "record", "show", str(path), "--limit", "80")
    assert (len(whole.out.splitlines()), whole.err) == (80, "")
    assert sum(line.endswith("arm/angle not valid") for line in whole.out.splitlines()) == 1
    two = call(home, "record", "show", str(path), "--limit", "80", "--channel", "3", "--channel", "ANGLE").out
    assert {cell.split()[0] for line in two.splitlines() for cell in line.split("  ")[1].split(", ")} == {
        "arm/angle",
        "hand/oil",
    }
    *events, end = map(json.loads, call(home, "--json", "record", "show", str(path), "--limit", "3").out.splitlines())
    assert sum(len(event["time"]) for event in events if event["channel"] == 1) == 3
    assert (end["messages"], end["samples"]) == (80, 120)
    every = call(home, "--json", "record", "show", str(path)).out.splitlines()[:-1]
    assert sum(len(json.loads(line)["time"]) for line in every) == 120
    named, angle = tmp_path / "named.csv", replace(ANGLE, name="Shaft Angle")
    fill_with(open_sink(str(named)), [angle], [block(), NodeReport(ARM, "ended", samples=3)])
    assert len(call(home, "record", "show", str(named), "--channel", "shaft angle").out.splitlines()) == 3
    assert "; lost: 0 messages, missing: 0 samples" in call(home, "record", "info", str(named)).out
    for chosen in (("--channel", "3", "--channel", "palm"), ("--channel", "palm", "--channel", "3")):
        unknown = call(home, "record", "show", str(path), *chosen)
        assert unknown.code == 3
        assert f"{path} has no channel 'palm'." in " ".join(unknown.err.split())
        assert "It has 1 (angle), 2 (force), 3 (oil)." in " ".join(unknown.err.split())
    unknown = call(home, "--json", "record", "show", str(path), "--channel", "9")
    message, hint = (
        json.loads(unknown.out.splitlines()[-1])["error"]["message"],
        "It has 1 (angle), 2 (force), 3 (oil).",
    )
    assert (message, json.loads(unknown.out.splitlines()[-1])["error"]["hint"]) == (f"{path} has no channel 9.", hint)
    assert call(home, "record", "show", str(path), "--channel", "OIL", "--limit", "1").code == 0


def test_a_line_has_the_local_time_with_its_zone_and_milliseconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TZ", "CET-1")
    time.tzset()
    try:
        first, *_ = call(tmp_path / "home", "record", "show", str(recorded(tmp_path / "run.mcap"))).out.splitlines()
        until_when = call(tmp_path / "home", "record", "info", str(tmp_path / "run.mcap")).out.splitlines()[1]
    finally:
        monkeypatch.undo()
        time.tzset()
    assert re.fullmatch(r"2026-11-18 12:06:40\.\d{3}\+01:00  \S+/\S+ .+", first), first
    assert re.fullmatch(r"From 2026-11-18 12:06:40\.\d{3}\+01:00 until 2026-11-18 \S+\+01:00", until_when), until_when


def test_what_info_prints_of_a_recording(tmp_path: Path) -> None:
    path, home = tmp_path / "run.csv", tmp_path / "home"
    cut, pattern, empty = tmp_path / "cut.csv", tmp_path / "pattern.csv", tmp_path / "empty.csv"
    sent = [block(valid=[[True], [False], [True]]), block(index=5)]
    fill_with(open_sink(str(path)), [ANGLE], [*sent, NodeReport(ARM, "ended", samples=6, lost=1)])
    head, dates, *lines = call(home, "record", "info", str(path)).out.splitlines()
    assert head == f"{path}: CSV, station bench, group crane"
    assert (dates[:5], " until " in dates) == ("From ", True)
    assert lines[:2] == [
        "6 time stamps, 6 values, 1 invalid; lost: 1 message, missing: 2 samples",
        "  arm/angle: 6 values, 1 invalid, 5.72958 to 17.1887 °",
    ]
    cut.write_bytes(path.read_bytes().partition(b"\n1795000000.070")[0] + b"\n17950")
    _, _, counts, end, *_ = call(home, "record", "info", str(cut)).out.splitlines()
    assert counts == "5 time stamps, 5 values, 1 invalid; lost: not recorded, missing: 2 samples"
    assert end == "It was cut off: no end was written, and the last 5 octets are incomplete."
    sink = open_sink(str(pattern))
    sink.open([ANGLE], replace(STATION, test_pattern=True))
    sink.write(block(test_pattern=True))
    sink.close()
    printed = call(home, "record", "info", str(pattern)).out.splitlines()
    assert printed[1] == "TEST PATTERN: these are not measurements."
    fill_with(open_sink(str(empty)), [ANGLE], [])
    assert call(home, "record", "info", str(empty)).out.splitlines()[1] == "It contains no values."


CHUNK, MAGIC_OCTETS, HEAD_OCTETS = 6, 8, 9


def end_of_last_chunk(octets: bytes) -> int:
    """Return where the last chunk of an MCAP file ends: each record has an opcode, a length (u64) and its octets."""
    place, end = MAGIC_OCTETS, 0
    while place < len(octets) - MAGIC_OCTETS:
        opcode, length = octets[place], int.from_bytes(octets[place + 1 : place + HEAD_OCTETS], "little")
        place += HEAD_OCTETS + length
        end = place if opcode == CHUNK else end
    return end


@pytest.mark.parametrize(("more", "words"), [(0, ""), (5, ", and the last 5 octets are incomplete")])
def test_what_info_prints_of_a_file_that_was_cut_behind_a_chunk(tmp_path: Path, more: int, words: str) -> None:
    path = recorded(tmp_path / "run.mcap", [block(), block(index=3)])
    octets = path.read_bytes()
    path.write_bytes(octets[: end_of_last_chunk(octets) + more])
    printed = call(tmp_path / "home", "record", "info", str(path)).out.splitlines()
    assert printed[2] == "6 time stamps, 6 values, 0 invalid; lost: not recorded, missing: 0 samples"
    assert printed[3] == f"It was cut off: no end was written{words}."


def test_a_file_that_may_not_grow_ends_a_conversion_with_words_and_leaves_nothing(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", [block(index=k) for k in range(0, 15_000, 3)])
    program = f"{sys.executable} -m teds_provision record convert {source} {tmp_path / 'to.csv'}"
    words = ["bash", "-c", f"ulimit -f 200; trap '' XFSZ; exec {program}"]
    done = subprocess.run(
        words,
        env=unmeasured_environment() | {"PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 7
    assert "cannot grow" in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap"}


def test_wide_needs_a_file_of_text(tmp_path: Path) -> None:
    done = call(tmp_path / "home", "measure", "8d4d", "--to", str(tmp_path / "run.mcap"), "--wide")
    assert done.code == 2
    assert "--to FILE.csv" in done.err


def test_an_angle_at_the_end_of_its_turn_spans_no_turn(tmp_path: Path) -> None:
    path, turn = tmp_path / "run.csv", 2 * math.pi
    angle = replace(ANGLE, units=parse_units("rad"), high=turn)
    for values, span in (([turn - 1e-9] * 3, "0 to 0 °"), ([1.0, 2.0, turn - 1e-9], "57.2958 to 360 °")):
        path.unlink(missing_ok=True)
        sink = open_sink(str(path))
        sink.open((angle,), STATION)
        sink.write(block(value=[[value] for value in values]))
        sink.close()
        assert span in call(tmp_path / "home", "record", "info", str(path)).out


def info_of(folder: Path, path: Path) -> dict[str, Any]:
    done = call(folder / "home", "--json", "record", "info", str(path))
    assert done.code == 0, done
    found: dict[str, Any] = json.loads(done.out)
    return found


@pytest.mark.parametrize("name", ["run.csv", "run.txt", "run.jsonl", "run.mcap", "wide:run.csv"])
def test_a_measurement_that_ended_before_a_value_came_leaves_a_file_that_says_why(tmp_path: Path, name: str) -> None:
    """Text was a file without an octet, which everything refused."""
    spec, _, file = name.rpartition(":")
    path = tmp_path / file
    sink = open_sink(f"{spec}:{path}" if spec else str(path))
    fill_with(sink, [], [NodeReport(ARM, "waiting"), NodeReport(ARM, "refused", "it did not answer within 3 s")])
    info = info_of(tmp_path, path)
    assert (info["messages"], info["lost"], info["complete"], info["station"]) == (0, 0, True, "bench")
    [node] = info["nodes"]
    assert (node["uuid"], node["state"], node["why"]) == (ARM, "refused", "it did not answer within 3 s")
    converted = call(tmp_path / "home", "--json", "record", "convert", str(path), str(tmp_path / "again.csv"))
    assert converted.code == 0
    assert info_of(tmp_path, tmp_path / "again.csv")["messages"] == 0


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".jsonl", ".mcap"])
def test_each_part_reports_its_own_losses_and_so_does_what_is_made_of_it(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run{suffix}"
    first = NodeReport(ARM, "running", samples=30, lost=5, late=1, bad=2, invalid=3)
    last = NodeReport(ARM, "ended", samples=33, lost=7, late=1, bad=2, invalid=4)
    news = ClockSet(by=3600.0, time=1_795_003_600.0)
    items = [NodeReport(ARM, "waiting"), *(block(index=k) for k in range(0, 30, 3)), first, news]
    fill_with(open_sink(str(path)), [ANGLE], [*items, block(index=33), last])
    for place in (path, path.with_suffix(f".2{suffix}")):
        [node] = info_of(tmp_path, place)["nodes"]
        own = (30, 5, 1, 2, 3) if place == path else (3, 2, 0, 0, 1)
        assert tuple(node[name] for name in ("samples", "lost", "late", "bad", "invalid")) == own, place
        for to in (".csv", ".jsonl", ".mcap"):
            made = place.with_suffix(f".made{to}")
            assert call(tmp_path / "home", "record", "convert", str(place), str(made)).code == 0
            assert info_of(tmp_path, made)["nodes"][0]["lost"] == own[1], made


def fill_with(sink: Sink, facts: list[ChannelFacts], items: list[Any]) -> None:
    sink.open(facts, STATION)
    for item in items:
        if isinstance(item, ClockSet):
            sink.clock_set(item)
        elif isinstance(item, NodeReport):
            sink.report(item)
        else:
            sink.write(item)
    sink.close()
    assert sink.stats.error == ""


def test_a_recording_that_was_cut_off_before_its_first_value_says_that_it_holds_none(tmp_path: Path) -> None:
    path, part = tmp_path / "run.csv", tmp_path / "part.csv"
    fill_with(open_sink(str(path)), [ANGLE], [block(index=0)])
    head, columns, rows = path.read_bytes().partition(b"\ntime,")
    names, end, rows = rows.partition(b"\n")
    part.write_bytes(head + columns + names + end + rows[:5])
    done = call(tmp_path / "home", "record", "convert", str(part), str(tmp_path / "made.jsonl"))
    assert done.code == 0
    assert "was cut off: the result holds no values." in done.err
