"""What every command shares: how it fails a line, asks, opens the station, and reads a secret."""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest
from rich.table import Table

from teds_provision.cli import context
from teds_provision.cli.context import App, read_line, to_json
from teds_provision.errors import (
    LinkError,
    NodeSilentError,
    NoPassphraseError,
    PolicyError,
    UsageError,
    WrongPassphraseError,
)

REFUSED = PolicyError("It is refused.", hint="Ask its owner.")


@pytest.fixture(autouse=True)
def no_other_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the run of another test as it was."""
    monkeypatch.setattr(App, "current", None)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the commands of a test a terminal to ask on."""
    stdin = io.StringIO()
    stdin.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdin", stdin)


@pytest.mark.parametrize(
    ("of", "line"),
    [
        ({}, "Error: It is refused."),
        ({"uuid": "8d4d", "time": "09:00", "row": 3}, "Error (8d4d, 09:00, row 3): It is refused."),
        ({"uuid": "8d4d", "time": None, "row": None}, "Error (8d4d): It is refused."),
        ({"uuid": "", "row": 0}, "Error (, row 0): It is refused."),
    ],
)
def test_an_error_of_one_of_many_names_it_and_its_cure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], of: dict[str, object], line: str
) -> None:
    App(home=tmp_path).fail_line(REFUSED, **of)
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", f"{line}\n  → Ask its owner.\n")
    App(home=tmp_path).fail_line(NodeSilentError("It is silent."))
    assert capsys.readouterr().err == "Error: It is silent.\n"
    App(home=tmp_path, as_json=True).fail_line(REFUSED, **of)
    known = {name: value for name, value in of.items() if value is not None}
    error = {"code": "refused", "message": "It is refused.", "hint": "Ask its owner."}
    assert json.loads(capsys.readouterr().out) == {**known, "error": error}


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(
    ("facts", "asks"), [({}, True), ({"no_input": True}, False), ({"as_json": True}, False), ({"quiet": True}, True)]
)
def test_a_person_is_asked_on_a_terminal_unless_a_program_reads_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, facts: dict[str, Any], asks: bool
) -> None:
    asked: list[str] = []
    monkeypatch.setattr(click, "confirm", lambda question, **_: asked.append(question) or True)
    monkeypatch.setattr(click, "prompt", lambda question, **_: asked.append(question) or "typed")
    app = App(home=tmp_path, **facts)
    assert app.interactive == asks
    assert (app.chooses_item() is not None) == asks
    if asks:
        app.confirm("Reset it?", yes=False)
        assert app.ask_secret("Passphrase: ") == "typed"
        assert asked == ["Reset it?", "Passphrase: "]
    else:
        for named, message, hint in (
            ("", "This needs confirmation, but there is no terminal to ask on.",
             "Add --yes, or --dry-run to see the plan."),
            ("--rotate", "This needs confirmation, but there is no terminal to ask on. Reset it?",
             "Add --rotate --yes."),
        ):  # fmt: skip
            with pytest.raises(PolicyError) as refused:
                app.confirm("Reset it?", yes=False, named=named)
            assert (refused.value.message, refused.value.hint) == (message, hint)
        for ask, option in (
            (app.ask_secret, "--passphrase-fd 3 3<FILE"),
            (app.ask_new, "--new-passphrase-fd 4 4<FILE"),
        ):
            with pytest.raises(NoPassphraseError) as needed:
                ask("Passphrase: ")
            assert needed.value.message == "Passphrase is needed, but there is no terminal to ask on."
            assert needed.value.hint == f"Pass it through a file descriptor: {option}."
    app.confirm("Reset it?", yes=True)
    assert len(asked) == 2 * asks


@pytest.mark.usefixtures("terminal")
def test_a_no_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(click, "confirm", lambda *_, **__: False)
    with pytest.raises(PolicyError, match=r"^Cancelled\. Nothing was changed\.$"):
        App(home=tmp_path).confirm("Reset it?", yes=False)


@pytest.mark.usefixtures("terminal")
def test_which_result_of_a_certificate_is_meant_is_asked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(click, "prompt", lambda question, **_: asked.append(question) or "as-left")
    choose = App(home=tmp_path).chooses_item()
    assert choose is not None
    items = [("as-found", "before"), ("as-left", "after")]
    for question in ("a.xml has two results", "a.xml has two results", "b.xml has two results"):
        assert choose(question, items) == "as-left"
    assert len(asked) == 2, "the same file is read again when its board arrives"


def test_a_passphrase_that_was_given_goes_before_the_agent(home: Path) -> None:
    for descriptor, agent in ((None, True), (3, False)):
        app = App(home=home, passphrase_fd=descriptor)
        station = app.station()
        assert station.use_agent == agent
        app.close()


def test_what_was_opened_last_is_closed_first_and_once(tmp_path: Path) -> None:
    app, closed = App(home=tmp_path), list[int]()
    for number in (1, 2, 3):
        app.closing(lambda number=number: closed.append(number))  # type: ignore[misc]
    app.close()
    app.close()
    assert closed == [3, 2, 1]


@pytest.mark.parametrize(
    ("octets", "secret"),
    [
        (b"correct horse\n", "correct horse"),
        (b" correct horse \t\n", " correct horse \t"),  # blanks are part of it
        (b"correct\r\nsecond line\n", "correct"),
        (b"no end", "no end"),
        ("schön\n".encode(), "schön"),
        (b"sch\xf6n\n", "sch\udcf6n"),
    ],
)
def test_a_secret_is_one_line_of_a_descriptor_as_it_is(octets: bytes, secret: str) -> None:
    read, write = os.pipe()
    os.write(write, octets)
    os.close(write)
    try:
        assert read_line(read) == secret
        os.fstat(read)  # its owner closes it
    finally:
        os.close(read)


@pytest.mark.parametrize("octets", [b"", b"\n", b"\r\n"])
def test_an_empty_line_is_no_secret(octets: bytes) -> None:
    read, write = os.pipe()
    os.write(write, octets)
    os.close(write)
    with pytest.raises(WrongPassphraseError, match=rf"^--passphrase-fd {read} returned an empty line\.$"):
        read_line(read)
    os.close(read)
    with pytest.raises(UsageError, match=rf"^Cannot read --passphrase-fd {read}: "):
        read_line(read)


def test_a_service_runs_if_it_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Service:
        """A client of a service that answers, or has just ended."""

        def __init__(self, error: Exception | None) -> None:
            self.error = error

        def __enter__(self) -> None:
            """Nothing is opened."""

        def __exit__(self, *_: object) -> None:
            """Nothing is closed."""

        def status(self) -> None:
            if self.error is not None:
                raise self.error

    app = App(home=tmp_path)
    for service, runs in ((None, False), (Service(LinkError("It has ended.")), False), (Service(None), True)):
        monkeypatch.setattr(app, "running_service", lambda service=service, **_: service)
        assert app._service_runs() == runs
    monkeypatch.setattr(app, "running_service", lambda **_: Service(UsageError("not that")))
    with pytest.raises(UsageError):
        app._service_runs()


@pytest.mark.parametrize(
    ("encoding", "text"),
    [("utf-8", '{"name": "schön"}'), ("UTF8", '{"name": "schön"}'), ("latin-1", '{"name": "sch\\u00f6n"}'),
     ("ascii", '{"name": "sch\\u00f6n"}'), (None, '{"name": "schön"}')],
)  # fmt: skip
def test_json_is_escaped_for_an_output_that_takes_no_utf_8(
    monkeypatch: pytest.MonkeyPatch, encoding: str | None, text: str
) -> None:
    class Output(io.StringIO):
        """An output with an encoding."""

    output: Any = Output()
    monkeypatch.setattr(Output, "encoding", encoding, raising=False)
    monkeypatch.setattr(context.sys, "stdout", output)
    assert to_json({"name": "schön"}) == text


def test_notes_and_warnings_of_each_kind_of_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--quiet silences both, --json notes alone; -v brings the second level."""
    for verbose, facts, shown in (
        (0, {}, ["a", "Warning: w"]),
        (1, {}, ["a", "b", "Warning: w"]),
        (1, {"quiet": True}, []),
        (1, {"as_json": True}, ["Warning: w"]),
        (0, {"as_json": True, "quiet": True}, []),
    ):
        app = App(home=tmp_path, **facts)  # type: ignore[arg-type]
        app.verbose = verbose  # as an option it would log from here on
        app.note("a")
        app.note("b", level=1)
        app.warn("w")
        assert capsys.readouterr().err.splitlines() == shown, facts


@pytest.mark.parametrize(
    ("facts", "do"),
    [
        ({}, lambda app: app.emit({}, "done")),
        ({}, lambda app: app.emit({}, Table("done"))),
        ({}, lambda app: app.emit({}, lambda console: console.print("done"))),
        ({"as_json": True}, lambda app: app.emit({"done": True})),
        ({}, lambda app: app.lines(["done"])),
        ({}, lambda app: app.note("done")),
        ({}, lambda app: app.warn("done")),
        ({}, lambda app: app.fail_line(REFUSED)),
        ({"as_json": True}, lambda app: app.fail_line(REFUSED)),
        ({}, lambda app: app.ask_yes_no("done?")),
        ({}, lambda app: app.ask_text("done?", "")),
        ({}, lambda app: app.ask_for_key("done?", "ab" * 32)),
        ({}, lambda app: app.ask_secret("done?")),
        ({}, lambda app: app.ask_new("done?")),
    ],
)
@pytest.mark.usefixtures("terminal")
def test_the_live_line_is_removed_before_anything_is_printed_or_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, facts: dict[str, Any], do: Any
) -> None:
    """What came behind it would stand in the same line, and be overwritten."""
    course: list[str] = []

    class Stream(io.StringIO):
        def write(self, text: str) -> int:
            course.extend(["shown"] if text.strip() else [])
            return len(text)

    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, Stream())
    for name in ("confirm", "prompt"):
        monkeypatch.setattr(click, name, lambda *_, **__: course.append("shown") or "n")
    app = App(home=tmp_path, **facts)
    app.live_line = lambda: course.append("removed")
    do(app)
    assert (course[0], "shown" in course) == ("removed", True)


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(
    ("default", "answer", "question", "text"),
    [
        ("", " left thumb ", "Its name", "left thumb"),
        ("thumb", "", "Its name [thumb]", "thumb"),
        ("thumb", " index\t", "Its name [thumb]", "index"),
        ("", "", "Its name", ""),
    ],
)
def test_a_text_that_is_typed_has_no_blanks_around_it_and_an_empty_one_is_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, default: str, answer: str, question: str, text: str
) -> None:
    asked: list[tuple[str, dict[str, Any]]] = []

    def prompt(shown: str, **how: Any) -> str:
        asked.append((shown, how))
        return answer or how["default"]

    monkeypatch.setattr(click, "prompt", prompt)
    assert App(home=tmp_path).ask_text("Its name", default) == text
    assert asked == [(question, {"default": default, "err": True, "show_default": False})]


def test_messages_and_questions_are_broken_at_the_edge_of_stderr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """stdout may be a file meanwhile, or another terminal."""
    asked: list[Any] = []
    monkeypatch.setattr(context, "folded", lambda text, stream, **how: asked.append((stream, how)) or text)
    for name in ("confirm", "prompt"):
        monkeypatch.setattr(click, name, lambda *_, **__: "n")
    app = App(home=tmp_path)
    app.note("a note")
    app.ask_yes_no("Reset it?")
    app.ask_text("Its name", "")
    assert asked == [
        (sys.stderr, {}),
        (sys.stderr, {"spare": len(" [y/N]: ")}),
        (sys.stderr, {"spare": len(" [y/N]: ")}),
    ]


def test_a_station_that_a_command_opens_warns_notes_and_is_closed_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[str] = []
    asked: list[Any] = []
    station: Any = SimpleNamespace(close=lambda: closed.append("station"))
    monkeypatch.setattr(context.stations.Station, "open", lambda *words, **how: asked.append((words, how)) or station)
    app = App(home=tmp_path)
    assert app.station() is station
    assert asked == [((tmp_path,), {"ask": app.ask_secret, "notify": app.warn})]
    assert (station.notice, station.released, station.service_runs) == (app.note, app._released, app._service_runs)
    assert (station.use_agent, closed) == (True, [])
    app.close()
    assert closed == ["station"]


@pytest.mark.usefixtures("terminal")
def test_the_results_of_a_certificate_are_listed_and_one_of_them_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[Any] = []

    def prompt(question: str, **how: Any) -> str:
        course.append((question, list(how["type"].choices), how["err"]))
        return "as-left"

    monkeypatch.setattr(click, "prompt", prompt)
    app = App(home=tmp_path)
    monkeypatch.setattr(app, "note", course.append)
    app.live_line = lambda: course.append("removed")
    choose = app.chooses_item()
    assert choose is not None
    assert choose("a.xml has two results", [("as-found", "before"), ("as-left", "after")]) == "as-left"
    assert course == [
        "a.xml has two results:", "  as-found: before", "  as-left: after", "removed",
        ("Which one", ["as-found", "as-left"], True),
    ]  # fmt: skip
    assert App(home=tmp_path, no_input=True).chooses_item() is None


def test_json_is_indented_if_asked_for_and_steers_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(context.sys, "stdout", io.StringIO())
    assert to_json({"a": [1]}, indent=1) == '{\n "a": [\n  1\n ]\n}'
    assert to_json({"a": "\u202eä"}) == '{"a": "\\u202eä"}'


@pytest.mark.parametrize(
    ("facts", "logged", "no_input"),
    [
        ({}, [], False),
        ({"verbose": 1}, [{"logging_level": 20, "libraries": False}], False),
        ({"verbose": 2, "as_json": True}, [{"logging_level": 10, "libraries": False}], True),
        ({"debug": True, "no_input": True}, [{"logging_level": 10, "libraries": True}], True),
        ({"verbose": 1, "debug": True}, [{"logging_level": 10, "libraries": True}], False),
    ],
)
def test_what_is_logged_and_whether_a_person_is_asked_follow_from_the_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, facts: dict[str, Any], logged: list[Any], no_input: bool
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(context, "_log_to_stderr", lambda **how: asked.append(how))
    app = App(home=tmp_path, **facts)
    assert (asked, app.no_input, App.current) == (logged, no_input, app)
