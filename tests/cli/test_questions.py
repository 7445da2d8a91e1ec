"""What a command asks and says: questions, passphrases, notes and warnings, asked of ``App`` itself."""

from __future__ import annotations

import ast
import math
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import click
import pytest

import teds_provision
from teds_provision.cli.context import App
from teds_provision.cli.rendering import LineReporter, LiveReporter, reporter_for
from teds_provision.cli.terminal_operator import TerminalOperator, show_brought
from teds_provision.errors import NotWhitelistedError, PolicyError, WrongPassphraseError
from teds_provision.protocol.fingerprints import read_fingerprint, same_key
from teds_provision.protocol.keys import SoftwareKey, fingerprint, to_pem
from teds_provision.provisioning.adoption import FactoryDatasheet, NotAdoptedError
from teds_provision.provisioning.batch_sheet import DeclinedError
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import UnrequestedChangeError
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from tests.bench import PASSPHRASE
from tests.parsed import parsed

from .shell import call
from .shown import image_of

UUID, KEY = "8d4d9da65281f7000000", "0123456789abcdef" * 4
OTHER = KEY[:20] + "f" + KEY[21:]


@pytest.fixture
def app(tmp_path: Path) -> Iterator[Callable[..., App]]:
    before = App.current
    yield lambda **options: App(home=tmp_path, **options)
    App.current = before


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[dict[str, Any]]]:
    """Let answers be typed at a terminal; returns the questions as they were asked."""

    def answer(*answers: str) -> list[dict[str, Any]]:
        asked: list[dict[str, Any]] = []
        left = list(answers)

        def prompt(question: str, **how: Any) -> str:
            asked.append({"question": question, **how})
            return left.pop(0)

        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
        monkeypatch.setattr(click, "prompt", prompt)
        monkeypatch.setattr(click, "confirm", lambda question, **how: prompt(question, **how) == "y")
        return asked

    return answer


def descriptor_with(text: str) -> int:
    read, write = os.pipe()
    os.write(write, text.encode())
    os.close(write)
    return read


# -- notes and warnings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "shown"),
    [
        ({}, "a note\nWarning: a warning\n"),
        ({"as_json": True}, "Warning: a warning\n"),
        ({"quiet": True}, ""),
        ({"quiet": True, "as_json": True}, ""),
    ],
)
def test_a_warning_is_printed_beside_json_and_a_note_for_people_alone(
    app: Callable[..., App], capsys: pytest.CaptureFixture[str], options: dict[str, bool], shown: str
) -> None:
    one = app(**options)
    one.note("a note")
    one.note("with -v", level=1)
    one.warn("a warning")
    assert capsys.readouterr() == ("", shown)


@pytest.mark.parametrize(
    ("options", "terminal", "several", "kind"),
    [
        ({"as_json": True}, True, False, SilentReporter),
        ({"quiet": True}, True, False, SilentReporter),
        ({}, False, False, LineReporter),
        ({}, True, True, LineReporter),
        ({}, True, False, LiveReporter),
    ],
)
def test_progress_is_live_on_a_terminal_lines_in_a_pipe_and_none_with_json(
    app: Callable[..., App],
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, bool],
    terminal: bool,
    several: bool,
    kind: type,
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    assert type(reporter_for(app(**options), several=several)) is kind


# -- passphrases -------------------------------------------------------------------------------------------------------


def test_one_line_of_the_descriptor_is_the_passphrase_and_is_read_once(app: Callable[..., App]) -> None:
    read = descriptor_with("first line\nsecond line\n")
    one = app(passphrase_fd=read)
    assert one.has_passphrase
    assert [one.ask_secret("Passphrase"), one.ask_secret("Again", confirm=True)] == ["first line"] * 2
    os.close(read)
    empty = descriptor_with("\nsecond line\n")
    with pytest.raises(WrongPassphraseError):
        app(passphrase_fd=empty).ask_secret("Passphrase")
    os.close(empty)


def test_a_new_passphrase_is_typed_twice_and_hidden(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]]
) -> None:
    asked = typed("old", "new", "newer")
    assert [app().ask_secret("Old"), app().ask_secret("New", confirm=True), app().ask_new("Newer")] == [
        "old", "new", "newer",
    ]  # fmt: skip
    assert [(how["hide_input"], how["confirmation_prompt"], how["err"]) for how in asked] == [
        (True, False, True), (True, True, True), (True, True, True),
    ]  # fmt: skip


# -- keys --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answers", "agreed"),
    [
        (["y"], True),
        (["YES"], True),
        (["n"], False),
        (["", "No"], False),
        ([KEY], True),
        ([KEY[:32]], True),
        ([KEY[:31], "n"], False),
        ([KEY.upper()], True),
        ([" ".join(KEY[at : at + 4] for at in range(0, 64, 4))], True),
        (["-".join(KEY[at : at + 4] for at in range(0, 32, 4))], True),
        ([OTHER], False),
        ([OTHER[:32]], False),
        ([f"TEDS1:{UUID}:{KEY}".upper()], True),
        ([f"TEDS1:{UUID}:{OTHER}".upper()], False),
        ([KEY + "0", "n"], False),
    ],
)
def test_a_key_is_agreed_to_with_yes_or_with_its_digits(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]], answers: list[str], agreed: bool
) -> None:
    asked = typed(*answers)
    assert app().ask_for_key("Trust it?", KEY) is agreed
    assert len(asked) == len(answers)
    assert {how["default"] for how in asked} == {"n"}


def test_two_fingerprints_are_of_one_key_from_32_digits_on() -> None:
    assert same_key(KEY, KEY[:32])
    assert same_key(KEY[:32], KEY)
    assert not same_key(KEY[:31], KEY)
    assert not same_key(OTHER[:32], KEY)
    texts = (
        "0x" + KEY,
        KEY[:32],
        KEY.upper(),
        ":".join(KEY[at : at + 2] for at in range(0, 64, 2)),
        KEY[:31],
        KEY + "0",
    )
    assert [read_fingerprint(text) for text in texts] == [KEY, KEY[:32], KEY, KEY, None, None]
    assert read_fingerprint("-".join(KEY[at : at + 8] for at in range(0, 64, 8))) == KEY


# -- the operator ------------------------------------------------------------------------------------------------------

WHO: Any = SimpleNamespace(uuid=bytes.fromhex(UUID), fingerprint=KEY)


def test_a_board_is_accepted_by_a_person_or_by_yes_which_adds_no_strangers_of_a_bus(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]]
) -> None:
    TerminalOperator(app(no_input=True), yes=True).accept(WHO)
    for operator in (
        TerminalOperator(app(no_input=True), yes=False),
        TerminalOperator(app(no_input=True), yes=True, strangers=False),
    ):
        with pytest.raises(NotWhitelistedError) as refused:
            operator.accept(WHO)
        assert refused.value.hint == f"Add --yes, or: teds-provision whitelist add {UUID} --fingerprint {KEY}"
    asked = typed("y", "n", "n")
    person = TerminalOperator(app(), yes=False)
    person.accept(WHO)
    person.accept(WHO)
    assert len(asked) == 1, "a board that is lost before it has a key is not asked about again"
    assert KEY[:32] in asked[0]["question"]
    assert KEY[:33] not in asked[0]["question"]
    with pytest.raises(DeclinedError):
        person.accept(cast("Any", SimpleNamespace(uuid=WHO.uuid, fingerprint=OTHER)))
    with pytest.raises(DeclinedError):
        TerminalOperator(app(), yes=True, strangers=False).accept(WHO)


def test_another_stations_key_is_taken_over_by_a_person_alone(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]]
) -> None:
    refusal = PolicyError("It has another station's key.")
    with pytest.raises(PolicyError, match="another station's key"):
        TerminalOperator(app(no_input=True), yes=True).take_over("Take it over?", refusal)
    typed("y", "n")
    TerminalOperator(app(), yes=True).take_over("Take it over?", refusal)
    with pytest.raises(DeclinedError):
        TerminalOperator(app(), yes=True).take_over("Take it over?", refusal)


@pytest.mark.parametrize(
    ("options", "yes", "several", "asks"),
    [
        ({}, False, False, True),
        ({}, True, False, False),
        ({}, False, True, False),
        ({"no_input": True}, False, False, False),
        ({"as_json": True}, False, False, False),
    ],
)
def test_a_yes_to_the_differences_retypes_one_board_and_nothing_else_does(
    app: Callable[..., App],
    typed: Callable[..., list[dict[str, Any]]],
    options: dict[str, bool],
    yes: bool,
    several: bool,
    asks: bool,
) -> None:
    differences: Sequence[str] = ("Channel 1 is in N, not in rad.",)
    asked = typed("y", "n")
    operator = TerminalOperator(app(**options), yes=yes, several=several)
    if not asks:
        with pytest.raises(WrongBoardError) as refused:
            operator.retype(WHO.uuid, tuple(differences))
        assert refused.value.hint.endswith("--retype")
        assert asked == []
        return
    operator.retype(WHO.uuid, tuple(differences))
    with pytest.raises(PolicyError, match="keeps its type"):
        operator.retype(WHO.uuid, tuple(differences))
    assert len(asked) == 2


CHANGES: Any = tuple(SimpleNamespace(text=f"change {number}") for number in range(22))


@pytest.mark.parametrize("yes", [False, True])
def test_a_change_that_was_not_named_is_shown_and_asked_whatever_was_answered_already(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]], capsys: pytest.CaptureFixture[str], yes: bool
) -> None:
    for options in ({"no_input": True}, {"as_json": True}):
        with pytest.raises(UnrequestedChangeError) as refused:
            TerminalOperator(app(**options), yes=yes).confirm(WHO.uuid, CHANGES)
        assert refused.value.changes == CHANGES
        assert refused.value.message.endswith("would change: change 0 change 1 change 2 And 19 more.")
    asked = typed("y", "n")
    TerminalOperator(app(), yes=yes).confirm(WHO.uuid, CHANGES)
    shown = capsys.readouterr().err.splitlines()
    assert shown[0].startswith(f"Node {UUID} has a different datasheet.")
    assert shown[1:] == [*(f"  change {number}" for number in range(20)), "  and 2 more"]
    with pytest.raises(DeclinedError, match=f"Node {UUID} keeps its datasheet"):
        TerminalOperator(app(), yes=yes).confirm(WHO.uuid, CHANGES[:20])
    assert "more" not in capsys.readouterr().err.splitlines()[-1]
    assert [question["question"] for question in asked] == ["Write it?"] * 2


def test_a_datasheet_that_a_board_brought_is_shown_before_it_is_signed(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]], capsys: pytest.CaptureFixture[str]
) -> None:
    brought: Any = FactoryDatasheet(Image(WHO.uuid, {}), "finger", (), ("It is overdue.",), ("It is old.",))
    lines = [f"Node {UUID} brought its own datasheet: finger", "  error: It is overdue.", "  warning: It is old."]
    for options in ({"no_input": True}, {"as_json": True}):
        with pytest.raises(NotAdoptedError):
            TerminalOperator(app(**options), yes=False).adopt(brought)
    assert capsys.readouterr().err == ""
    TerminalOperator(app(no_input=True), yes=True).adopt(brought)
    assert capsys.readouterr().err.splitlines() == lines
    asked = typed("y", "n")
    TerminalOperator(app(), yes=True).adopt(brought)
    assert asked == []
    capsys.readouterr()
    TerminalOperator(app(), yes=False).adopt(brought)
    assert capsys.readouterr().err.splitlines() == lines
    with pytest.raises(DeclinedError, match="was not signed"):
        TerminalOperator(app(), yes=False).adopt(brought)
    assert len(asked) == 2


def test_each_channel_of_a_datasheet_that_a_board_brought_is_one_line(
    app: Callable[..., App], capsys: pytest.CaptureFixture[str]
) -> None:
    image = Image(WHO.uuid, load_profile("magnetic-angular-position-sensor").build(WHO.uuid).blocks)
    [first, *_] = Sheet.from_image(image).channels
    [calibrated, *_] = Sheet.from_image(Image.from_json(image_of("magnetic-angular-position-sensor"))).channels
    shown: dict[tuple[Any, ...], str] = {
        (): "angle, sensor, 0 ° to 180 °",
        (("name", ""),): "(no name), sensor, 0 ° to 180 °",
        (("kind", None),): "angle, of unknown kind, 0 ° to 180 °",
        (("kind", ChannelKind.ACTUATOR),): "angle, actuator, 0 ° to 180 °",
        (("uncertainty", math.pi / 90),): "angle, sensor, 0 ° to 180 °, ± 2 °",
        (("uncertainty", 0.0),): "angle, sensor, 0 ° to 180 °",
        (("calibration", calibrated.calibration),): "angle, sensor, 0 ° to 180 °, calibrated 2020-01-02",
    }
    base = replace(first, name="angle", low=0.0, high=math.pi, uncertainty=0.0)
    channels = tuple(replace(base, **dict(changes)) for changes in shown)
    show_brought(app(), FactoryDatasheet(image, "", channels))
    head, *lines = capsys.readouterr().err.splitlines()
    assert head == f"Node {UUID} brought its own datasheet: (no name)"
    assert lines == [f"  channel 1: {line}" for line in shown.values()]
    for count, last in ((20, "  channel 20: "), (23, "  and 3 more channels")):
        many = tuple(replace(base, number=number) for number in range(1, count + 1))
        findings = tuple(f"finding {number}" for number in range(1, 30))
        show_brought(app(), FactoryDatasheet(image, "", many, findings))
        _, *lines = capsys.readouterr().err.splitlines()
        assert [line for line in lines if "finding" not in line][-1].startswith(last)
        assert [line for line in lines if "finding" in line] == [f"  error: finding {one}" for one in range(1, 21)]


@pytest.mark.parametrize("what", ["low_battery", "jump"])
def test_a_low_battery_and_a_jump_are_asked_about_unless_yes_was_said(
    app: Callable[..., App], typed: Callable[..., list[dict[str, Any]]], what: str
) -> None:
    def ask(**facts: Any) -> None:
        yes = facts.pop("yes", False)
        getattr(TerminalOperator(app(**facts), yes=yes), what)("Go on?")

    with pytest.raises(PolicyError, match="there is no terminal to ask on"):
        ask(no_input=True)
    ask(no_input=True, yes=True)
    asked = typed("y", "n")
    ask(yes=True)
    assert asked == []
    ask()
    with pytest.raises(PolicyError, match="Nothing was changed"):
        ask()
    assert [question["question"] for question in asked] == ["Go on?"] * 2


# -- locks -------------------------------------------------------------------------------------------------------------

ASKS = frozenset(["confirm", "ask_yes_no", "ask_text", "ask_for_key", "ask_secret", "ask_new", "unlock", "_reset"])


def test_no_command_holds_the_store_while_it_asks() -> None:
    """A person may take an hour; read from the sources, as no test reaches every question."""
    found = []
    package = Path(teds_provision.__file__).parent
    for file in (*package.glob("cli/**/*.py"), *package.glob("*/commands.py"), *package.glob("*/commands/*.py")):
        for block in ast.walk(parsed(file)):
            if not isinstance(block, ast.With):
                continue
            held = [ast.unparse(item.context_expr) for item in block.items]
            if not any(re.search(r"\.(lock|durable|transaction)\(", text) for text in held):
                continue
            calls = [call.func for call in ast.walk(block) if isinstance(call, ast.Call)]
            names = [getattr(func, "attr", getattr(func, "id", "")) for func in calls]
            found += [f"{file.name}:{block.lineno} {name}" for name in names if name in ASKS]
    assert found == []


def test_a_spare_takes_over_what_the_person_was_asked_about_or_nothing(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spare = "8d4d9da65281f70000ff"
    call(home, "whitelist", "add", UUID, "--name", "elbow")
    call(home, "whitelist", "add", spare)
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        station.nodes.remember(bytes.fromhex(UUID), name="elbow")
        station.nodes.remember(bytes.fromhex(spare))

    def renamed_meanwhile(_app: App, _question: str, *, yes: bool) -> None:
        assert yes
        with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as other, other.durable("names set"):
            other.nodes.remember(bytes.fromhex(UUID), name="knee")

    with monkeypatch.context() as patch:
        patch.setattr(App, "confirm", renamed_meanwhile)
        refused = call(home, "--json", "replace", UUID, spare, "--yes")
    assert (refused.code, refused.json["error"]["message"]) == (
        6,
        "Another command changed the plan while this one was waiting.",
    )
    found = {node["uuid"]: (node["name"], node["retired"]) for node in call(home, "--json", "nodes").json["nodes"]}
    assert found == {UUID: ("knee", None), spare: (None, None)}
    done = call(home, "--json", "replace", UUID, spare, "--yes")
    assert (done.code, done.json["name"], done.json["fresh"]) == (0, "knee", True)


def test_a_key_is_distrusted_and_a_ban_lifted_as_the_person_was_asked_or_not(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a person thinks, another command may give the name to another key, or ban the node for something else."""
    for name, secret in (("lab", 41), ("west", 42)):
        (tmp_path / f"{name}.pem").write_text(to_pem(SoftwareKey(secret).point))
    call(home, "trust", "add", "lab", tmp_path / "lab.pem", "--yes")
    call(home, "revoke", UUID, "--why", "lost", "--yes")

    def refused(words: Sequence[str], *meanwhile: Sequence[object] | Holder) -> bool:
        def confirm(_app: App, _question: str, *, yes: bool) -> None:
            assert yes
            for other in meanwhile:
                if isinstance(other, Holder):
                    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
                        station.keys.put_holder(other)
                    continue
                with monkeypatch.context() as same:
                    same.setattr(App, "confirm", lambda _app, _question, *, yes: None)
                    assert call(home, *other).code == 0

        with monkeypatch.context() as patch:
            patch.setattr(App, "confirm", confirm)
            outcome = call(home, "--json", *words, "--yes")
        return outcome.code == 6 and outcome.json["error"]["message"] == (
            "Another command changed the plan while this one was waiting."
        )

    west = fingerprint(SoftwareKey(42).point)
    assert refused(
        ["trust", "remove", "lab"],
        ["trust", "remove", "lab", "--yes"],
        ["trust", "add", "lab", tmp_path / "west.pem", "--yes"],
    )
    trusted = call(home, "--json", "trust", "list").json["trusted"]
    assert [key["fingerprint"] for key in trusted if key["name"] == "lab"] == [west]
    assert refused(["trust", "remove", "lab"], Holder(bytes.fromhex(UUID), west, "2026-11-28T00:00:00Z"))
    again = (["revoke", "--lift", UUID, "--yes"], ["revoke", UUID, "--why", "cloned", "--yes"])
    assert refused(["revoke", "--lift", UUID], *again)
    assert call(home, "--json", "revoke", "--lift", UUID, "--dry-run").json["why"] == "cloned"
    assert not refused(["trust", "remove", "lab"])
    assert not refused(["revoke", "--lift", UUID])


@pytest.mark.parametrize("words", [("trust", "remove", "lab"), ("revoke", "--lift", UUID)], ids=["trust", "ban"])
def test_of_two_runs_at_once_the_later_one_has_nothing_to_do(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    """Both asked, and the other one was answered first: that is no error."""
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(41).point))
    call(home, "trust", "add", "lab", tmp_path / "lab.pem", "--yes")
    call(home, "revoke", UUID, "--why", "lost", "--yes")
    first = []

    def confirm(_app: App, _question: str, *, yes: bool) -> None:
        with monkeypatch.context() as same:
            same.setattr(App, "confirm", lambda _app, _question, *, yes: None)
            first.append(call(home, "--json", *words, "--yes"))

    with monkeypatch.context() as patch:
        patch.setattr(App, "confirm", confirm)
        later = call(home, "--json", *words, "--yes")
    assert [(done.code, done.json["fresh"]) for done in (*first, later)] == [(0, True), (0, False)]
