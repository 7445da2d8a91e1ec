"""Sources of a virtual transducer: what they give at which time of the node's clock, and what a bad line does."""

from __future__ import annotations

import json
import math
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NoReaderError, NotFoundError, TedsProvisionError, UsageError
from teds_provision.node.sources import SOURCES, make_source
from teds_provision.node.sources.base import Reading, SourceChannel
from teds_provision.node.sources.lines import LONGEST_LINE, LineSource, StandardInput, feed

ANGLE, FORCE = SourceChannel(1, "angle", -180.0, 180.0), SourceChannel(2, "force", 0.0, 5.0)
PLACES = (ANGLE, FORCE, SourceChannel(3, "bare"))


class Clock:
    """The node's clock as a source drives it."""

    def __init__(self) -> None:
        self.seconds, self.own, self.steps = 0.0, False, []
        self.ended = threading.Event()

    def now(self) -> float:
        return self.seconds

    def own_clock(self) -> None:
        self.own = True

    def advance(self, seconds: float, change: Callable[[], None]) -> None:
        assert seconds >= self.seconds
        self.seconds = seconds
        change()
        self.steps.append(seconds)

    def host_clock(self) -> None:
        self.own = False
        self.ended.set()


def test_generated_values_keep_to_the_range_and_the_period() -> None:
    sine = make_source("sine:4", PLACES, print)
    assert sine.at(1, 0.0) == Reading(value=0.0)
    assert sine.at(1, 1.0) == Reading(value=180.0)
    assert sine.at(9, 1.0) is None
    ramp = make_source("ramp:20ms", PLACES, print)
    assert [ramp.at(2, seconds).value for seconds in (0.0, 0.005, 0.01, 0.02)] == pytest.approx([0, 1.25, 2.5, 0])
    noise = make_source("noise", PLACES, print)
    seen = {noise.at(3, 0.0).value for _ in range(50)}
    assert len(seen) > 40
    assert all(0 <= value <= 1 for value in seen)


def test_each_channel_of_a_sine_lags_the_one_before_by_a_twelfth_of_the_period() -> None:
    sine = make_source("sine:12", PLACES, print)
    assert [sine.at(2, seconds).value for seconds in (1.0, 4.0, 10.0)] == pytest.approx([2.5, 5.0, 0.0])
    assert sine.at(3, 5.0).value == pytest.approx(1.0), "a channel without a range goes from 0 to 1"


def test_a_period_has_a_unit_or_is_in_seconds_and_is_10_s_if_none_is_given() -> None:
    for text, seconds in (("ramp", 5.0), ("ramp:10s", 5.0), ("ramp:1min", 30.0), ("ramp: 0.5 ms", 0.00025)):
        assert make_source(text, PLACES, print).at(2, seconds).value == pytest.approx(2.5), text
    assert make_source("sine", PLACES, print).at(1, 2.5).value == pytest.approx(180.0)


@pytest.mark.parametrize(("low", "high"), [(math.nan, math.nan), (2.0, math.nan), (-math.inf, 5.0), (2.0, math.inf)])
def test_a_range_with_one_end_is_none(low: float, high: float) -> None:
    assert SourceChannel(1, "bare", low, high).span == (0.0, 1.0)


def test_noise_fills_the_range_of_its_channel() -> None:
    noise = make_source("noise", PLACES, print)
    force = [noise.at(2, 0.0).value for _ in range(50)]
    angle = [noise.at(1, 0.0).value for _ in range(50)]
    assert all(0 <= value <= 5 for value in force)
    assert max(force) > 1, "once in 10^35 runs none is"
    assert min(angle) < 0 < max(angle)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("sinus", UsageError),
        ("sine:0", UsageError),
        ("sine:-1", UsageError),
        ("ramp:fast", UsageError),
        ("ramp:nan", UsageError),
        ("sine:inf", UsageError),
        ("noise:3", UsageError),
        ("unix:", UsageError),
        ("exec:", UsageError),
        ("exec:'a", UsageError),
        ("file:", UsageError),
        ("file:/nowhere.csv", NotFoundError),
    ],
)
def test_a_source_that_cannot_be_names_the_cure(text: str, error: type[TedsProvisionError]) -> None:
    with pytest.raises(error):
        make_source(text, PLACES, print)


def test_every_source_of_the_contract_is_there() -> None:
    of_the_service = {"simulation"}
    assert set(SOURCES) - of_the_service == {"noise", "sine", "ramp", "file", "-", "unix", "exec"}


def test_a_file_is_played_back_and_nothing_is_valid_behind_it(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("# made by hand\nt,angle,raw:force\n10,1.5,7\n10.5,,8\n11,3,\n")
    messages: list[str] = []
    source = make_source(f"file:{path}", PLACES, messages.append)
    assert [source.at(1, seconds) for seconds in (0.0, 0.4, 0.6, 1.2)] == [
        Reading(value=1.5),
        Reading(value=1.5),
        None,
        Reading(value=3.0),
    ]
    assert source.at(2, 0.7) == Reading(raw=8.0)
    assert source.at(3, 0.0) is None
    assert [source.at(1, 1.6), source.at(1, 99.0)] == [None, None]
    assert len(messages) == 1


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("", "no row"),
        ("t,angle\n", "no row"),
        ("angle\n1\n", "no column t"),
        ("t,angel\n0,1\n", "'angel'"),
        ("t,angle,raw:angle\n0,1,1\n", "two columns"),
        ("t,angle\n0,1\n1\n", "line 3"),
        ("t,angle\n1,1\n0,1\n", "line 3"),
        ("t,angle\nx,1\n", "line 2"),
        ("t,angle\n0,x\n", "line 2"),
        ("t,angle\n\n#\n,1\n", "line 4"),
        ("t,angle\n0,1\n2,1\n1,1\n", "line 4: times must be ascending"),
        ("t,angle\n0,1,2\n", "line 2: 3 fields, the first line names 2"),
        ("# of a bench\n\nt,angle\n0,1\n\n# late\n1\n", "line 7: 1 fields, the first line names 2"),
        ("t,angle,\n0,1,2\n", "no sensor named ''"),
        ('t,angle\n0,"1\n"\n', "quotation mark"),
        (f"t,angle\n0,{'1' * 131_073}\n", "is not CSV"),
    ],
)
def test_a_bad_file_is_reported_with_its_line(tmp_path: Path, text: str, place: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(BadDataError, match=place):
        make_source(f"file:{path}", (*PLACES, SourceChannel(4, "")), print)


def test_rows_and_columns_of_a_file_are_read_as_the_page_has_them(tmp_path: Path) -> None:
    """docs/virtual-nodes.md: a value holds until the next row; the last row for as long as the one before it."""
    path = tmp_path / "run.csv"
    path.write_text(
        "#comment\n\n force , Time ,raw:angle\n 1.5 ,100, 7\n#no row\n2.5,101,inf\n3.5,101,\n,103.5,nan\n4.5,104, -8 \n"
    )
    messages: list[str] = []
    source = make_source(f"file:{path}", PLACES, messages.append)

    def force(*seconds: float) -> list[float | None]:
        return [None if (reading := source.at(2, at)) is None else reading.value for at in seconds]

    def angle(*seconds: float) -> list[float | None]:
        return [None if (reading := source.at(1, at)) is None else reading.raw for at in seconds]

    assert force(0.0, 0.99) == [1.5, 1.5]
    assert force(1.0, 3.49) == [3.5, 3.5], "of two rows of one instant the later counts"
    assert force(3.5, 3.99, 4.0, 4.5) == [None, None, 4.5, 4.5]
    assert angle(0.0, 1.0, 3.5, 4.25) == [7, None, None, -8]
    assert messages == []
    assert source.at(3, 4.6) is None, "a channel without a column hears of the end too"
    assert force(4.51, 9.0) + angle(4.51) == [None] * 3
    assert messages == ["The file of values has ended: from now on all values are invalid."]


def test_the_last_of_two_rows_is_valid_as_long_as_the_first(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,force\n5,1\n7,2\n")
    source = make_source(f"file:{path}", PLACES, print)
    assert (source.at(2, 4.0), source.at(2, 4.01)) == (Reading(value=2.0), None)


def test_a_file_of_one_row_is_valid_at_its_instant_alone(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,force\n5,1\n")
    source = make_source(f"file:{path}", PLACES, print)
    assert source.at(2, 0.0) == Reading(value=1.0)
    assert source.at(2, 0.001) is None


def test_of_a_file_of_values_256_mib_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []

    def read(_path: Path, most: int, _what: str) -> str:
        limits.append(most)
        return "t,force\n0,1\n"

    monkeypatch.setattr("teds_provision.node.sources.recorded.read_text", read)
    make_source("file:run.csv", PLACES, print)
    assert limits == [268_435_456]


def lines(messages: list[str], *, needs_time: bool = True) -> tuple[LineSource, Clock]:
    source, clock = LineSource(PLACES, messages.append, needs_time=needs_time), Clock()
    source.begin(clock)
    return source, clock


def test_lines_set_values_and_drive_the_clock() -> None:
    source, clock = lines([])
    assert clock.own
    source.feed_line(b'{"t": 0.5, "value": {"angle": 12.5}, "raw": {"force": 4000}}')
    source.feed_line(b'{"t": 0.75, "value": {"angle": null}}')
    assert clock.steps == [0.5, 0.75]
    assert source.at(1, 0.0) is None
    assert source.at(2, 0.0) == Reading(raw=4000.0)


@pytest.mark.parametrize(
    "line",
    [
        b"junk",
        b"[1]",
        b"[" * 100_000,
        b'{"value": {"angle": 1}}',
        b'{"t": true}',
        b'{"t": -1}',
        b'{"t": NaN}',
        b'{"t": 1e400}',
        b'{"t": 0.5}',
        b'{"t": 2, "value": 3}',
        b'{"t": 2, "value": {"angel": 3}}',
        b'{"t": 2, "value": {"angle": "3"}}',
        b'{"t": 2, "raw": {"angle": NaN}}',
        b'{"t": 2, "raw": {"angle": 1' + b"0" * 400 + b"}}",
    ],
)
def test_a_line_that_is_none_changes_nothing_and_is_counted(line: bytes) -> None:
    messages: list[str] = []
    source, clock = lines(messages)
    source.feed_line(b'{"t": 1, "value": {"angle": 1}}')
    source.feed_line(line)
    assert (source.dropped, len(messages), clock.seconds) == (1, 1, 1.0)
    assert source.at(1, 1.0) == Reading(value=1.0)
    source.feed_line(b'{"t": 1, "value": {"angle": 2}}')
    assert source.at(1, 1.0) == Reading(value=2.0)


def test_of_lines_that_are_none_the_first_and_each_thousandth_is_reported() -> None:
    messages: list[str] = []
    source, _ = lines(messages)
    for _ in range(2000):
        assert source.feed_line(b"[]") == "it is not a JSON object"
    assert [message.split("(")[1] for message in messages] == [
        "1 so far): it is not a JSON object.",
        "1000 so far): it is not a JSON object.",
        "2000 so far): it is not a JSON object.",
    ]
    assert source.dropped == 2000


@pytest.mark.parametrize(
    ("line", "why"),
    [
        (b"{", "it is not JSON"),
        (b"[" * 60_000, "it is not JSON"),
        (b"\xff", "it is not JSON"),
        (b"5", "it is not a JSON object"),
        (b'{"t": 1, "value": []}', '"value" is not an object of channel names and numbers'),
        (b'{"t": 1, "raw": 5}', '"raw" is not an object of channel names and numbers'),
        (b'{"t": 1, "value": {"angel": 1}}', "the node has no sensor named 'angel'"),
        (b'{"t": 1, "raw": {"angle": true}}', "the value of 'angle' is no number"),
        (b'{"t": 1, "value": {"angle": "1"}}', "the value of 'angle' is no number"),
        (b'{"value": {"angle": 1}}', '"t" is not a number of seconds of 0 or more'),
        (b'{"t": -0.1}', '"t" is not a number of seconds of 0 or more'),
        (b'{"t": true}', '"t" is not a number of seconds of 0 or more'),
        (b'{"t": 2.9}', '"t" went back from 3.0 to 2.9'),
    ],
)
def test_why_a_line_is_skipped(line: bytes, why: str) -> None:
    source, clock = lines([])
    assert source.feed_line(b'{"t": 3, "value": {"angle": 1}, "raw": {"force": 7}}') == ""
    assert source.latest == {1: Reading(value=1.0), 2: Reading(raw=7.0)}
    assert source.feed_line(line) == why
    assert (source.at(1, 0.0), clock.steps) == (Reading(value=1.0), [3.0])
    assert source.feed_line(b'{"t": 3, "value": {"angle": null}}') == "", "two lines may be of one instant"
    assert (source.at(1, 0.0), source.at(2, 0.0)) == (None, Reading(raw=7.0))
    source.end()
    assert (source.at(2, 0.0), clock.own) == (None, False)


def test_a_number_beyond_every_quantity_is_none() -> None:
    source, clock = lines([])
    for member in ("value", "raw"):
        source.feed_line(b'{"t": 1, "%s": {"angle": 1e15}}' % member.encode())
    source.feed_line(b'{"t": 1e15, "value": {"angle": 1}}')
    assert (clock.steps, source.at(1, 0.0)) == ([], None)
    source.feed_line(b'{"t": 1, "value": {"angle": -9.99e14}}')
    assert source.at(1, 1.0) == Reading(value=-9.99e14)


def test_a_line_without_an_end_takes_no_memory() -> None:
    sent = iter([*[b"x" * 65536] * 40, b"\n", b'{"a": 1}\n', b"last"])
    taken: list[bytes] = []
    feed(lambda: next(sent, b""), taken.append)
    assert max(map(len, taken)) <= LONGEST_LINE
    assert taken[-2:] == [b'{"a": 1}', b"last"]
    assert taken[:2] == [b"x" * 64] * 2


def test_a_channel_of_a_simulation_without_a_value_is_invalid_alone(tmp_path: Path) -> None:
    source, clock = make_source(f"simulation:{tmp_path / 'x'}", PLACES, print), Clock()
    assert isinstance(source, LineSource)
    source.begin(clock)
    assert not clock.own, "it needs no times"
    assert source.at(1, 0.0) is None
    assert source.feed_line(b'{"value": {"angle": 12.5}}') == ""
    assert (source.at(1, 0.0), source.at(2, 0.0)) == (Reading(value=12.5), Reading(missing=True))
    assert source.feed_line(b'{"value": {"angle": null, "force": 3}}') == ""
    assert (source.at(1, 0.0), source.at(2, 0.0)) == (Reading(missing=True), Reading(value=3.0))
    assert "no number" in source.feed_line(b'{"value": {"angle": NaN}}')
    source.end()
    assert source.at(2, 0.0) is None


@given(st.binary(max_size=60))
def test_no_octets_stop_the_source(octets: bytes) -> None:
    source, clock = lines([])
    source.feed_line(octets)
    assert clock.seconds >= 0


def test_the_next_simulation_goes_on_from_the_present_clock() -> None:
    source, clock = lines([])
    source.feed_line(b'{"t": 5, "value": {"angle": 1}}')
    source.end()
    assert not clock.own
    assert source.at(1, 5.0) is None
    clock.seconds = 8.0  # the host's clock went on
    source.begin(clock)
    source.feed_line(b'{"t": 0, "value": {"angle": 2}}')
    source.feed_line(b'{"t": 0.25, "value": {"angle": 3}}')
    assert clock.seconds == 8.25


def test_a_program_needs_no_times() -> None:
    source, clock = lines([], needs_time=False)
    source.feed_line(b'{"value": {"angle": 2}}')
    assert source.at(1, 0.0) == Reading(value=2.0)
    assert not clock.own
    source.feed_line(b'{"t": 3, "value": {"angle": 4}}')
    assert clock.own
    assert source.at(1, 0.0) == Reading(value=4.0)


def wait_for(what: Callable[[], object]) -> bool:
    until = time.monotonic() + 10
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.005)
    return True


@pytest.mark.parametrize("kind", ["pipe", "program", "socket"])
def test_no_value_is_valid_any_more_when_the_end_is_reported(tmp_path: Path, kind: str) -> None:
    """Who reads the notice and then a sample must not get the last value as a valid one."""
    line, found, reported = b'{"t": 1, "value": {"angle": 1}}\n', [], threading.Event()
    program = tmp_path / "hand.py"
    program.write_text(f"print({line.decode()!r}, flush=True, end='')\ninput()\n")

    def notified(text: str) -> None:
        found.append((text, source.at(1, 1.0)))
        reported.set()

    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as stream, socket.socket(socket.AF_UNIX) as simulation:
        path = tmp_path / "hand.sock"
        word = {"program": f"exec:{sys.executable} {program}", "socket": f"unix:{path}"}.get(kind)
        source = StandardInput(PLACES, notified, stream) if word is None else make_source(word, PLACES, notified)
        source.start(Clock())
        if kind == "pipe":
            os.write(writing, line)
        elif kind == "socket":
            simulation.connect(str(path))
            simulation.sendall(line)
        assert wait_for(lambda: source.at(1, 1.0) == Reading(value=1.0))
        os.close(writing)
        simulation.close()
        source.acted({"angle": 1.0})  # the line for which the program waits
        assert reported.wait(60)
        source.stop()
    assert found[-1][1] is None
    assert "all values are invalid" in found[-1][0]


def test_standard_input_ends_and_the_node_stays() -> None:
    reading, writing = os.pipe()
    messages: list[str] = []
    with os.fdopen(reading, "rb") as stream:
        source, clock = StandardInput(PLACES, messages.append, stream), Clock()
        source.start(clock)
        os.write(writing, b'{"t": 1, "value": {"angle": 1}}\n{"t": 2, "val')
        assert wait_for(lambda: source.at(1, 1.0) == Reading(value=1.0))
        os.write(writing, b'ue": {"angle": 2}}')
        os.close(writing)
        assert clock.ended.wait(60)
        assert clock.steps == [1.0, 2.0]
        assert source.at(1, 2.0) is None
        assert wait_for(lambda: messages)
        assert messages == ["Standard input has ended: from now on all values are invalid."]
        source.stop()


def test_a_file_at_the_path_of_a_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("mine")
    source = make_source(f"unix:{path}", PLACES, print)
    with pytest.raises(NoReaderError) as refused:
        source.start(Clock())
    source.stop()
    assert (path.read_text(), refused.value.hint) == ("mine", "Name another path.")


def test_simulations_come_and_go_at_a_unix_socket(tmp_path: Path) -> None:
    path, messages, clock = tmp_path / "hand.sock", [], Clock()
    source = make_source(f"unix:{path}", PLACES, messages.append)
    source.start(clock)
    try:
        assert path.stat().st_mode & 0o777 == 0o600
        with pytest.raises(NoReaderError, match=r"hand\.sock"):
            make_source(f"unix:{path}", PLACES, print).start(Clock())
        assert clock.ended.wait(60)  # the second node knocked, and went away
        for value in (1.0, 2.0):
            clock.ended.clear()
            with socket.socket(socket.AF_UNIX) as simulation:
                simulation.connect(str(path))
                simulation.sendall(json.dumps({"t": value, "value": {"angle": value}}).encode() + b"\n")
                assert wait_for(lambda: source.at(1, 0.0) == Reading(value=value))  # noqa: B023 - waited for here
                source.acted({"gripper": value})
                assert json.loads(simulation.recv(100)) == {"set": {"gripper": value}}
            assert clock.ended.wait(60)
            assert source.at(1, 0.0) is None
    finally:
        source.stop()
    assert not path.exists()


def test_a_socket_that_a_killed_node_left_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "hand.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    source = make_source(f"unix:{path}", PLACES, print)
    source.start(Clock())
    source.stop()


PROGRAM = """
import json, sys
print(json.dumps({"value": {"angle": 1}}), flush=True)
told = json.loads(sys.stdin.readline())
print(json.dumps({"value": {"angle": told["set"]["gripper"]}}), flush=True)
sys.stdin.readline()
sys.exit(3)
"""


def test_a_program_gives_values_is_told_what_actuators_do_and_may_end(tmp_path: Path) -> None:
    path, messages, clock = tmp_path / "hand.py", [], Clock()
    path.write_text(PROGRAM)
    source = make_source(f"exec:{sys.executable} {path}", PLACES, messages.append)
    source.start(clock)
    assert wait_for(lambda: source.at(1, 0.0) == Reading(value=1.0))
    source.acted({"gripper": 7.5})
    assert wait_for(lambda: source.at(1, 0.0) == Reading(value=7.5))
    source.acted({"gripper": 0.0})
    assert clock.ended.wait(60)
    assert source.at(1, 0.0) is None
    assert wait_for(lambda: messages)
    assert "ended with 3" in messages[0]
    source.stop()
    with pytest.raises(NotFoundError):
        make_source("exec:/no/such/program", PLACES, print).start(clock)
