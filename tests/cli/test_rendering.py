"""Texts for people and moments of the command line: each form by itself."""

from __future__ import annotations

import io
import json
import math
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import pytest

from teds_provision.cli import rendering
from teds_provision.cli.options import (
    CalibrationFile,
    ChannelName,
    Day,
    FileToRead,
    Number,
    Seconds,
    WholeNumber,
    foxglove_address,
)
from teds_provision.cli.rendering import (
    LineReporter,
    aligned,
    duration,
    firmware_words,
    line_of,
    local_time,
    moment,
    print_json_list,
    shown,
    tidy,
    time_for,
)
from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.links.ports import Notice
from teds_provision.provisioning.progress import StepResult


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


# -- moments -----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("berlin")
def test_a_moment_is_local_for_people_and_utc_for_programs() -> None:
    for as_json, shown_at in ((False, "2026-06-10 14:00:00+02:00"), (True, "2026-06-10T12:00:00Z")):
        app = cast("Any", SimpleNamespace(json=as_json))
        assert time_for(app, "2026-06-10T12:00:00Z") == shown_at


@pytest.mark.parametrize(
    ("text", "now", "found"),
    [
        ("today", "2026-06-10T12:00:00+00:00", "2026-06-09T22:00:00Z"),
        (" Yesterday ", "2026-06-10T12:00:00+00:00", "2026-06-08T22:00:00Z"),
        ("today", "2026-03-29T10:00:00+00:00", "2026-03-28T23:00:00Z"),
        ("yesterday", "2026-03-30T10:00:00+00:00", "2026-03-28T23:00:00Z"),
        ("today", "2026-10-25T11:00:00+00:00", "2026-10-24T22:00:00Z"),
        ("today", "2026-06-09T22:30:00+00:00", "2026-06-09T22:00:00Z"),
        ("90s", "2026-06-10T12:00:00+00:00", "2026-06-10T11:58:30Z"),
        ("2h", "2026-06-10T12:00:00+00:00", "2026-06-10T10:00:00Z"),
        ("3 D", "2026-03-30T10:00:00+00:00", "2026-03-27T10:00:00Z"),
        ("1w", "2026-06-10T12:00:00+00:00", "2026-06-03T12:00:00Z"),
        ("2026-01-31", "2026-06-10T12:00:00+00:00", "2026-01-30T23:00:00Z"),
        ("2026-07-31T12:00", "2026-06-10T12:00:00+00:00", "2026-07-31T10:00:00Z"),
        ("2026-07-31T12:00:00-05:00", "2026-06-10T12:00:00+00:00", "2026-07-31T17:00:00Z"),
    ],
)
@pytest.mark.usefixtures("berlin")
def test_a_moment_in_words(text: str, now: str, found: str) -> None:
    """Today begins at midnight of this place, on the days too on which its clocks are put forward and back."""
    assert moment(text, datetime.fromisoformat(now)) == found


@pytest.mark.parametrize("text", ["", "tomorrow", "2x", "1234567s", "-2h", "2026-13-01", "0001-01-01T00:00:00+14:00"])
@pytest.mark.usefixtures("berlin")
def test_what_is_no_moment_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a valid time"):
        moment(text, datetime(2026, 6, 10, tzinfo=UTC))


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("15m", 900), ("2H", 7200), (" 3 d ", 259200), ("1w", 604800), ("0s", 0)]
)
def test_a_span_of_time(text: str, seconds: float) -> None:
    assert duration(text) == seconds
    for wrong in ("", "s", "1.5h", "2y", "1234567s", "-1s"):
        with pytest.raises(UsageError, match="not a valid time span"):
            duration(wrong)


@pytest.mark.usefixtures("berlin")
def test_a_moment_of_the_store_in_local_time() -> None:
    assert local_time("2026-01-31T12:00:00Z") == "2026-01-31 13:00:00+01:00"
    assert local_time("2026-07-31T12:00:00.9Z") == "2026-07-31 14:00:00+02:00"
    for other in ("not signed", "9999-12-31T23:59:59Z"):
        assert local_time(other) == other


# -- texts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "uncertainty", "found"),
    [
        (20.123456789, 0.5, 20.1235), (20.123456789, 5.0, 20.123), (20.123456789, 50.0, 20.12),
        (123456.0, 99999.0, 123460.0), (-1e-9, 0.5, 0.0), (20.123456789, None, 20.123456789),
        (20.123456789, 0.0, 20.123456789), (20.123456789, math.inf, 20.123456789), (20.123456789, -1.0, 20.123456789),
    ],
)  # fmt: skip
def test_a_value_has_digits_to_a_thousandth_of_its_uncertainty(
    value: float, uncertainty: float | None, found: float
) -> None:
    assert str(tidy(value, uncertainty)) == str(found)
    assert math.isnan(tidy(math.nan, 0.5))


def test_foreign_text_for_a_terminal() -> None:
    assert shown("left\x1b[31m hand\u202e") == "left?[31m hand?"
    assert shown(None) == ""


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "board/app 1.2.3+4"),
        ({"build": 0}, "board/app 1.2.3"),
        ({"text": ""}, "1.2.3+4"),
        ({"state": "unjudged"}, "board/app 1.2.3+4"),
        ({"state": "outdated"}, "board/app 1.2.3+4, outdated"),
        ({"from": "identify"}, "board/app 1.2.3+4 (not verified)"),
        ({"changed": True, "state": "refused", "from": "x"},
         "board/app 1.2.3+4, refused (not verified); firmware changed since calibration"),
        ({"version": None, "state": "not-reported"}, "firmware not reported"),
    ],
)  # fmt: skip
def test_firmware_in_words(changes: dict[str, Any], words: str) -> None:
    usual = {"text": "board/app", "version": "1.2.3", "build": 4, "state": "good", "from": "session", "changed": False}
    assert firmware_words(usual | changes) == words
    assert firmware_words(None) == ""


def test_rows_are_aligned_by_the_longest_of_each_column() -> None:
    rows = [("name", "n"), ("a", "12345"), ("longer name", "")]
    assert aligned(rows) == ["name         n", "a            12345", "longer name"]


@pytest.mark.parametrize(
    ("step", "line"),
    [
        (StepResult("agree", "done", 0.05, "key epoch 1"), "✓ agree         0.05 s  key epoch 1"),
        (StepResult("write", "nothing to do", 12.0), "write        12.00 s  nothing to do"),
        (StepResult("write", "nothing to do", 0.0, "it is there"), "write         0.00 s  nothing to do: it is there"),
        (StepResult("verify", "done", 1.0, "", of="left"), "left: ✓ verify        1.00 s"),
    ],
)
def test_a_step_is_one_line(step: StepResult, line: str) -> None:
    assert line_of(step).endswith(line)


def test_a_notice_is_printed_once_in_a_row() -> None:
    notes: list[str] = []
    lines = LineReporter(cast("Any", SimpleNamespace(note=notes.append)))
    for text, seconds in (("Waiting", 59.6), ("Waiting", 58.0), ("Tap it", None), ("Waiting", 1.0)):
        lines.notice(Notice("waiting", text, seconds))
    assert notes == ["… Waiting (up to 60 s)", "… Tap it", "… Waiting (up to 1 s)"]


def test_a_list_that_ends_in_an_error_is_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    def entries(fails: bool) -> Iterator[dict[str, Any]]:
        yield {"name": "ä"}
        yield {"n": 2}
        if fails:
            raise PolicyError("Not allowed.", hint="Ask.")

    for encoding, fails, text in (
        ("utf-8", False, '{"list": [{"name": "ä"}, {"n": 2}]}\n'),
        ("ascii", False, '{"list": [{"name": "\\u00e4"}, {"n": 2}]}\n'),
    ):
        out = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
        monkeypatch.setattr(sys, "stdout", out)
        print_json_list("list", entries(fails))
        out.seek(0)
        assert out.read() == text
    out = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", out)
    with pytest.raises(click.exceptions.Exit) as ended:
        print_json_list("list", entries(True))
    out.seek(0)
    found = json.loads(out.read())
    assert (ended.value.exit_code, found["list"], found["error"]["message"]) == (
        6,
        [{"name": "ä"}, {"n": 2}],
        "Not allowed.",
    )
    assert rendering.count_of(1) == "1 node"


# -- values of options -------------------------------------------------------------------------------------------------


def converted(kind: click.ParamType, value: Any) -> Any:
    return kind.convert(value, None, None)


@pytest.mark.parametrize(
    ("kind", "value", "found"),
    [
        (Number(min=0), "2.5", 2.5), (Number(min=0), "0", 0.0), (WholeNumber(1, 12), " 12 ", 12),
        (WholeNumber(-3, 12), "-3", -3), (Seconds(min=0.1), "0.1", 0.1),
        (ChannelName(), "255", 255), (ChannelName(0), "0", 0), (ChannelName(), " angle ", "angle"),
        (ChannelName(), "3b", "3b"), (Day(), "2027-10-31", datetime(2027, 10, 31, tzinfo=UTC)),
        (Day(), datetime(2027, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC)),
    ],
)  # fmt: skip
def test_a_value_that_an_option_takes(kind: click.ParamType, value: Any, found: Any) -> None:
    assert converted(kind, value) == found


@pytest.mark.parametrize(
    ("kind", "value", "why"),
    [
        (Number(min=0), "nan", "is not a finite number"), (Number(), "inf", "is not a finite number"),
        (WholeNumber(1, 12), "1.5", "'1.5' is not a whole number."),
        (WholeNumber(1, 12), "13", "13 is not in the range"),
        (ChannelName(), "0", "0 is not in the range"), (ChannelName(), "256", "256 is not in the range"),
        (ChannelName(), "1.5", "'1.5' is not a channel number, 1 to 255, or a channel's name."),
        (ChannelName(0), "1.5", "'1.5' is not a channel number, 0 to 255, or a channel's name."),
        (ChannelName(), "", "'' is not a channel number"), (ChannelName(), "a\x1bb", "is not a channel number"),
        (Seconds(min=0.1), "soon", "'soon' is not a number of seconds, e.g. 30 or 2.5."),
        (Seconds(min=0.1), "0.05", "0.05 is not in the range"),
        (Day(), "31.10.2027", "'31.10.2027' is not a date; write it like 2027-10-31."),
        (CalibrationFile(), "0=x.csv", "0 is not a channel number, 1 to 255."),
        (CalibrationFile(), "256=x.csv", "256 is not a channel number, 1 to 255."),
    ],
)  # fmt: skip
def test_a_value_that_no_option_takes_is_named(kind: click.ParamType, value: str, why: str) -> None:
    with pytest.raises(click.BadParameter) as refused:
        converted(kind, value)
    assert why in refused.value.message


def test_a_file_to_read_is_no_folder_and_may_have_to_be_there(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="is a folder, not a file"):
        converted(FileToRead(), str(tmp_path))
    missing = tmp_path / "none"
    assert converted(FileToRead(), str(missing)) == missing
    with pytest.raises(NotFoundError, match="There is no file"):
        converted(FileToRead(exists=True), str(missing))
    assert converted(CalibrationFile(), f"2={missing}") == (2, missing)
    assert converted(CalibrationFile(), str(missing)) == (None, missing)


def test_where_foxglove_is_served() -> None:
    assert foxglove_address(False, None) is None
    assert foxglove_address(True, None) == "127.0.0.1:8765"
    assert foxglove_address(False, "0.0.0.0:1") == foxglove_address(True, "0.0.0.0:1") == "0.0.0.0:1"


# -- the live line -----------------------------------------------------------------------------------------------------


def test_the_live_line_has_the_step_that_runs_and_what_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    above: list[str] = []
    console = SimpleNamespace(print=lambda text, **_: above.append(str(text)))
    live = rendering.LiveReporter(cast("Any", SimpleNamespace(console=lambda **_: console)))
    monkeypatch.setattr(live, "_show", lambda: None)

    def line() -> str:
        return str(cast("Any", live._render()).text)

    live.started("identify")
    assert line() == "identify"
    live.notice(Notice("waiting", "Waiting for a tap.", seconds=30))
    assert line().startswith("identify  Waiting for a tap. (")
    assert line().endswith(" s left)")
    live.notice(Notice("retry", "Again."))
    assert (line(), above) == ("identify  Again.", [])
    live.notice(Notice("reader-ready", "The bus is back."))
    assert (line(), above) == ("identify  Again.", ["… The bus is back."])
    live.started("agree")
    assert line() == "agree", "what the step before waited for is over"
    live.written(3, 7)
    assert line() == "agree  3 of 7 octets"
    live.finished(StepResult("agree", seconds=0.5))
    live.notice(Notice("node-left", "It left."))
    assert line() == "3 of 7 octets"
    assert above[1:] == ["✓ agree         0.50 s", "… It left."]


@pytest.mark.parametrize(("count", "last"), [(2, "b"), (3, "c"), (4, "  … and 1 more"), (9, "  … and 6 more")])
def test_of_a_long_list_the_first_lines_and_how_many_more_there_are(count: int, last: str) -> None:
    lines = list("abcdefghi"[:count])
    found = rendering.first_lines(lines, 3, count)
    assert found == [*lines[:3], last] if count > 3 else found == lines
    assert found[-1] == last


@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_a_value_that_is_no_number_is_shown_as_it_is(value: float) -> None:
    assert tidy(value, 0.5) == value


@pytest.mark.parametrize(
    ("value", "uncertainty", "shown"),
    [
        (math.nan, 0.5, "nan"), (math.nan, None, "nan"), (1.23456, math.nan, "1.23456"), (1.23456, math.inf, "1.23456"),
        (1.23456, 0.0, "1.23456"), (1.23456, -1.0, "1.23456"), (-1e-9, 0.5, "0.0"), (-1e-9, None, "-1e-09"),
    ],
)  # fmt: skip
def test_a_value_with_a_strange_uncertainty_is_shown_as_it_is(
    value: float, uncertainty: float | None, shown: str
) -> None:
    assert repr(tidy(value, uncertainty)) == shown


def test_a_wait_that_is_over_has_no_seconds_left(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    live: Any = rendering.LiveReporter.__new__(rendering.LiveReporter)
    live._step, live._what, live._until = "agree", "Tap it", 101.4
    monkeypatch.setattr(rendering, "time", SimpleNamespace(monotonic=lambda: now[0]))
    assert str(live._render().text) == "agree  Tap it (1 s left)"
    now[0] = 103.0
    assert str(live._render().text) == "agree  Tap it (0 s left)"


@pytest.mark.parametrize("encoding", [None, "UTF8"])
def test_a_list_that_is_empty_or_fails_at_once_is_one_object_and_is_printed_before_the_end(
    monkeypatch: pytest.MonkeyPatch, encoding: str | None
) -> None:
    flushed: list[str] = []

    class Output(io.StringIO):
        def flush(self) -> None:
            flushed.append(self.getvalue())

    def entries() -> Iterator[dict[str, Any]]:
        raise PolicyError("Höher geht es nicht.")
        yield {}

    monkeypatch.setattr(Output, "encoding", encoding, raising=False)
    monkeypatch.setattr(sys, "stdout", Output())
    print_json_list("list", [])
    assert flushed == ['{"list": []}\n']
    monkeypatch.setattr(sys, "stdout", Output())
    with pytest.raises(click.exceptions.Exit):
        print_json_list("list", entries())
    [_, text] = flushed
    assert text.startswith('{"list": [], "error": {')
    assert '"Höher geht es nicht."' in text
    assert text.endswith("}}\n")
