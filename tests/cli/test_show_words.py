"""``show``: its words for odd files, certificates and messages, asked of its own functions."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import teds
from teds_provision.cli.context import App
from teds_provision.cli.context import console as consoles
from teds_provision.cli.node import show
from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS
from teds_provision.protocol.handover.jose import encrypt
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.message import Argument, Message
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import Finding, TimeInstance
from teds_provision.teds.formats import TedsBlock
from teds_provision.teds.guard import GuardFinding
from teds_provision.teds.show import describe

from .shell import call

NAME = teds.compose(12, {"Format": 0, "TCName": "thumb"})


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what prints on a console of 200 columns, as lines."""

    def lines(do: Any) -> list[str]:
        out = io.StringIO()
        monkeypatch.setattr(sys, "stdout", out)
        console = consoles.CleanConsole(highlight=False, soft_wrap=True, width=200)
        do(console)
        return [line.rstrip() for line in out.getvalue().splitlines()]

    return lines


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("thumb", "thumb"),
        ("[red]x[/]", "\\[red]x\\[/]"),
        ("a\x07b", "a\\x07b"),
        ("a\x1b[2J", "a\\x1b[2J"),
        ("a\x9bb", "a\\x9bb"),
        ("a\u202eb", "a\\x202eb"),
        ("a\tb\nc", "a\tb\nc"),
    ],
)
def test_text_of_a_file_is_neither_markup_nor_control(text: str, shown: str) -> None:
    assert show.escape(text) == shown


@pytest.mark.parametrize(
    ("kind", "message", "found", "hint"),
    [
        ("json", "a.teds:3: this is not JSON.", "a.teds:3: this is not JSON.", "Fix it."),
        ("json", "a.teds has no UUID.", "a.teds has no UUID.", "Fix it."),
        ("json", "The image has no UUID.", "a.teds: The image has no UUID.", "Fix it."),
        ("json", "a.teds2 has no UUID.", "a.teds: a.teds2 has no UUID.", "Fix it."),
        (None, "Line 1 holds 'x'.", "a.teds: Line 1 holds 'x'.", "Fix it."),
        ("hex", "Line 2 holds 'x'.", "a.teds: Line 2 holds 'x'.", "Fix it."),
        (
            "hex",
            "Line 1 holds 'x', which is no hex digit.",
            "a.teds holds no TEDS: it is neither binary nor hex (read as hex: line 1 holds 'x', which is no hex"
            " digit).",
            "TEDS come as binary, hex, Intel HEX, JSON, XML, an image, a profile or a bundle.",
        ),
    ],
)
def test_an_error_names_its_file_once(kind: Any, message: str, found: str, hint: str) -> None:
    error = show._of_file("a.teds", kind, BadDataError(message, hint="Fix it."))
    assert (error.message, error.hint) == (found, hint)


@pytest.mark.parametrize(
    ("before", "sealed", "most", "is_bundle"),
    [
        (b"", True, 10, True),
        (b" \r\n\t", True, 10, True),
        (b"[", True, 10, False),
        (b"{", False, 10, False),
        (b"", False, 10, False),
        (b"", True, 1 << 20, False),
    ],
)
def test_a_file_that_is_too_long_may_still_be_a_bundle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: bytes, sealed: bool, most: int, is_bundle: bool
) -> None:
    monkeypatch.setattr(show, "LIMITS", replace(LIMITS, teds_file=most))
    file = tmp_path / "long"
    file.write_bytes(before + (encrypt(b"x", [SoftwareKey(7).point], cty="JWS") if sealed else b"0" * 900))
    header = show._long_bundle(str(file))
    assert (header is not None) is is_bundle
    if header is not None:
        assert header.content_type == "JWS"
    for other in ("-", str(tmp_path / "none"), "a\0b"):
        assert show._long_bundle(other) is None


@pytest.mark.parametrize(("octets", "refused"), [(20, False), (21, True)])
def test_a_file_is_as_long_as_a_file_of_teds_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, octets: int, refused: bool
) -> None:
    monkeypatch.setattr(show, "LIMITS", replace(LIMITS, teds_file=20))
    file = tmp_path / "file"
    file.write_bytes(b"x" * octets)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b"x" * octets)))
    for name, message in (
        (str(file), f"{file} holds no TEDS: it has more than 0 MiB."),
        ("-", "Standard input gives more than 0 MiB; no file of TEDS has."),
    ):
        if refused:
            with pytest.raises(BadDataError) as error:
                show.read_file(name)
            assert error.value.message == message
        else:
            assert show.read_file(name) == b"x" * octets


def test_a_set_without_teds_holds_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "empty.hex"
    file.write_text("00")
    monkeypatch.setattr(show, "read_blocks", lambda *_words, **_how: [])
    with pytest.raises(BadDataError) as error:
        show.load(str(file))
    assert error.value.message == f"{file} holds no TEDS."


@pytest.mark.parametrize(
    ("octets", "certificate"),
    [
        (b"<dcc:digitalCalibrationCertificate>", True),
        (b"\xef\xbb\xbf \r\n\t<?xml version='1.0'?><digitalCalibrationCertificate>", True),
        (b"<!--" + b"licence " * 1000 + b"--><digitalCalibrationCertificate>", True),
        (b"<!--" + b"licence " * 1100 + b"--><digitalCalibrationCertificate>", False),
        (b"<teds-set>", False),
        (b"x digitalCalibrationCertificate", False),
    ],
)
def test_a_certificate_is_known_by_its_beginning(octets: bytes, certificate: bool) -> None:
    assert show.looks_like_certificate(octets) is certificate


def test_a_certificate_is_printed_with_its_items_and_foreign_text_is_text(
    printed: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def item(name: str, title: str, uncertainty: Any, unit: str, indicated: str | None) -> Any:
        return SimpleNamespace(
            id=name,
            title=title,
            reference=SimpleNamespace(unit=SimpleNamespace(text=unit)),
            indicated=None if indicated is None else SimpleNamespace(unit=SimpleNamespace(text=indicated)),
            to_json=lambda: {"uncertainty": uncertainty},
        )

    monkeypatch.setattr(teds.dcc.shown, "points_of", lambda one: [("1", one.id.upper())])
    certificate: Any = SimpleNamespace(
        certificate=SimpleNamespace(schema_version="3.2.1"),
        lines=lambda: [("number", "T-[b]1[/b]"), ("", "more of it")],
        items=[
            item("[i]1", "As [found]", 0.25, "N", "V"),
            item("2", "as left", [0.1, 0.2], "", None),
            item("3", "exact", 1234567.0, "", ""),
            item("4", "unknown", None, "N", "V"),
        ],
    )
    assert printed(lambda console: show._print_certificate(console, certificate)) == [
        "calibration certificate · DCC 3.2.1",
        "  number: T-[b]1[/b]",
        "    more of it",
        "",
        "item [i]1 · As [found]",
        "indication [V]  value [N]",
        "1               [I]1",
        "  standard uncertainty 0.25 N",
        "",
        "item 2 · as left",
        "coefficient  value",
        "1            2",
        "",
        "item 3 · exact",
        "raw  value",
        "1    3",
        "  standard uncertainty 1.23457e+06",
        "",
        "item 4 · unknown",
        "indication [V]  value [N]",
        "1               4",
    ]


def test_each_teds_is_printed_with_its_own_conversions(printed: Any) -> None:
    shown = tuple(describe(TedsBlock(None, 12, NAME), {}) for _ in range(2))
    lost = Finding("error", "lost", "The second one loses its name.")
    guard = GuardFinding(2, "steep", "The [curve] is steep.")
    file = show.ShownFile("a", "hex", teds=shown, guard=(guard,), conversions={1: (lost,)})
    lines = printed(lambda console: show.print_files(console, [file]))
    half = lines.index("")
    assert [line for line in lines[:half] if "conversion" in line] == []
    assert lines[-2:] == [
        "error  conversion: lost: The second one loses its name.",
        "error  guard, channel 2, steep: The [curve] is steep.",
    ]


@pytest.mark.parametrize(
    ("facts", "head"),
    [
        ({}, "Read it · command, 2007 edition"),
        ({"channel": 0}, "Read it · command, 2007 edition · channel 0"),
        ({"group_name": "[TEDS]", "name": "[x]"}, "[TEDS]: [x] · command, 2007 edition"),
        ({"name": ""}, "unknown message · command, 2007 edition"),
        ({"school": "tagged"}, "Read it · command, 2007 edition · tagged arguments"),
        ({"ok": False}, "Read it · command, 2007 edition · failed"),
        ({"ok": True}, "Read it · command, 2007 edition"),
    ],
)
def test_the_head_of_a_message(printed: Any, facts: dict[str, Any], head: str) -> None:
    message = Message(**{"octets": b"x", "kind": "command", "edition": 2007, "name": "Read it"} | facts)
    assert printed(lambda console: show._print_message(console, message)) == [head]


def test_findings_have_their_octet_also_the_first(printed: Any) -> None:
    findings = [
        Finding("error", "bad", "It is [bad].", 0),
        Finding("warning", "odd", "It is odd."),
        Finding("note", "so", "So it is.", 7),
    ]
    assert printed(lambda console: show._print_findings(console, findings, "x: ")) == [
        "error  x: octet 0, bad: It is [bad].",
        "warning  x: odd: It is odd.",
        "note  x: octet 7, so: So it is.",
    ]


@pytest.mark.parametrize(
    ("name", "kind", "value", "text"),
    [
        ("address", "octets", bytes([192, 168, 0, 7]), "192.168.0.7"),
        ("address", "octets", bytes([192, 168, 0]), "c0a800"),
        ("octets", "octets", bytes([192, 168, 0, 7]), "c0a80007"),
        ("at", "time", TimeInstance(1_795_000_000), "2026-11-18 11:06:40 UTC"),
        ("timeout", "duration", 5.0, "5.0 s"),
        ("list", "u8", (1, 2), "1, 2"),
        ("count", "u8", 0, "0"),
    ],
)
def test_an_argument_in_words(name: str, kind: str, value: Any, text: str) -> None:
    argument: Any = SimpleNamespace(name=name, type=kind, value=value)
    assert show._value(argument) == text


def test_an_argument_as_json_has_a_meaning_only_if_there_is_one() -> None:
    plain = Argument("count", "u8", 0, b"\0", 3)
    assert show._argument(plain) == {"name": "count", "type": "u8", "value": 0, "offset": 3}
    assert show._argument(replace(plain, meaning="none"))["meaning"] == "none"


@pytest.mark.parametrize(
    ("facts", "lines"),
    [
        (
            {"content_type": "JWS", "recipients": ("ab" * 32, "")},
            ["  ECDH, A256GCM, holds JWS; not opened",
             "  for the station with fingerprint abababababababab", "  for the station with fingerprint (not named)"],
        ),
        ({"content_type": "", "recipients": ()}, ["  ECDH, A256GCM, holds unknown; not opened"]),
        ({"content_type": None, "recipients": ()}, ["  ECDH, A256GCM, holds unknown; not opened"]),
    ],
)  # fmt: skip
def test_the_header_of_a_bundle(printed: Any, facts: dict[str, Any], lines: list[str]) -> None:
    bundle: Any = SimpleNamespace(octets=900, sha256="cd" * 32, algorithm="ECDH", encryption="A256GCM", **facts)
    head = "sealed handover bundle · 900 octets · sha256 cdcdcdcdcdcdcdcd…"
    assert printed(lambda console: show._print_bundle(console, bundle)) == [head, *lines]


def test_a_teds_without_a_channel_is_where_it_usually_is_and_the_first_of_a_place_counts() -> None:
    codes = (AccessCode.META, AccessCode.CHANNEL, AccessCode.CALIBRATION, AccessCode.NAME)
    blocks = [TedsBlock(None, code, b"first") for code in codes]
    blocks += [TedsBlock(None, code, b"second") for code in codes]
    blocks += [TedsBlock(2, AccessCode.CHANNEL, b"other"), TedsBlock(None, None, b"no code")]
    assert show.placed(blocks) == {
        (0, AccessCode.META): b"first",
        (1, AccessCode.CHANNEL): b"first",
        (1, AccessCode.CALIBRATION): b"first",
        (0, AccessCode.NAME): b"first",
        (2, AccessCode.CHANNEL): b"other",
    }


def test_json_has_the_keys_of_a_lone_teds_on_top_and_lists_only_what_there_is() -> None:
    one = show.ShownFile("a", "hex", teds=(describe(TedsBlock(None, 12, NAME), {}),))
    alone = show.to_json([one])
    assert (alone["format"], alone["verdict"], len(alone["teds"])) == ("teds/1", "clean", 1)
    assert alone.keys() & {"guard", "bundles", "certificates", "conversion"} == set()
    both = show.to_json([one, replace(one, name="b", guard=(GuardFinding(1, "c", "m", "warning"),))])
    assert ("verdict" in both, [entry["file"] for entry in both["teds"]]) == (False, ["a", "b"])
    assert both["guard"] == [{"severity": "warning", "channel": 1, "code": "c", "message": "m"}]
    converted = show.to_json([replace(one, conversions={0: ()})])
    assert converted["teds"][0]["conversion"] == [], "converted, and nothing was lost"


@pytest.mark.parametrize(
    ("facts", "errors"),
    [
        ({}, False),
        ({"message": Message(b"x", "command", 2007, "x", findings=(Finding("error", "c", "m"),))}, True),
        ({"message": Message(b"x", "command", 2007, "x", findings=(Finding("warning", "c", "m"),))}, False),
    ],
)
def test_an_error_in_a_message_is_one_for_strict(facts: dict[str, Any], errors: bool) -> None:
    assert show._has_errors(show.ShownFile("a", "hex", **facts)) is errors


@pytest.mark.parametrize(("kind", "malformed"), [("unknown", True), ("command", False)])
def test_a_message_that_is_unknown_is_malformed(kind: Any, malformed: bool) -> None:
    assert show.ShownFile("a", "hex", message=Message(b"x", kind, 2007, "x")).malformed is malformed
    assert show.ShownFile("a", "hex").malformed is False


def test_what_cannot_be_converted_stays_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def convert(_decoded: Any, edition: int) -> Any:
        raise BadDataError(f"It has no form in {edition}.")

    monkeypatch.setattr(show, "convert", convert)
    block = TedsBlock(None, 12, NAME)
    blocks, said = show._converted([block], 2024)
    assert (blocks, said) == ([block], {0: (Finding("error", "not-converted", "It has no form in 2024."),)})


def test_the_guard_compares_a_calibration_with_the_one_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []
    guard = GuardFinding(1, "jump", "It jumps.", "warning")
    monkeypatch.setattr(teds.guard, "check_calibration", lambda *words: asked.append(words) or (guard,))
    monkeypatch.setattr(show, "load", lambda name: SimpleNamespace(blocks=[TedsBlock(0, 12, name.encode())]))
    monkeypatch.setattr(teds.diff, "diff_blocks", lambda _old, _new: [])
    for as_json, app_json, lines in (
        (False, False, ["no difference", "warning: guard, channel 1: It jumps."]),
        (True, False, None),
        (True, True, None),
    ):
        show._diff(App(home=tmp_path, as_json=app_json), "before", "after", as_json=as_json)
        out = capsys.readouterr().out
        if lines is not None:
            assert out.splitlines() == lines
        else:
            assert (json.loads(out)["guard"][0]["code"], len(out.splitlines()) == 1) == ("jump", app_json)
    assert asked[0] == ({(0, 12): b"after"}, {(0, 12): b"before"})


@pytest.mark.parametrize("terminal", [True, False])
def test_text_in_another_format_is_harmless_on_a_terminal_and_whole_in_a_file(
    monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    out = io.BytesIO()
    stdout = SimpleNamespace(buffer=out, isatty=lambda: terminal, flush=lambda: None)
    warned: list[str] = []
    monkeypatch.setattr(show.sys, "stdout", stdout)
    monkeypatch.setattr(teds.formats, "write_blocks", lambda _blocks, _form: "name = 'a\x1b[2Jb'\n")
    monkeypatch.setattr(teds.formats, "lost", lambda _blocks, _form: ["its name", "its place"])
    show._write(SimpleNamespace(warn=warned.append), [], "toml")  # type: ignore[arg-type]
    assert out.getvalue().decode() == ("name = 'a?[2Jb'\n" if terminal else "name = 'a\x1b[2Jb'\n")
    assert warned == ["toml cannot hold its name", "toml cannot hold its place"]


def test_of_a_conversion_errors_alone_are_warned_of_beside_another_format(monkeypatch: pytest.MonkeyPatch) -> None:
    warned: list[str] = []
    written: list[Any] = []
    monkeypatch.setattr(show, "_write", lambda _app, blocks, form: written.append((len(blocks), form)))
    findings = {0: (Finding("error", "lost", "It is lost."), Finding("warning", "odd", "It is odd."))}
    file = show.ShownFile("a", "hex", teds=(describe(TedsBlock(None, 12, NAME), {}),), conversions=findings)
    show._convert(SimpleNamespace(warn=warned.append), [file, file], "xml")  # type: ignore[arg-type]
    assert (warned, written) == (["a: It is lost.", "a: It is lost."], [(2, "xml")])


def test_a_comparison_goes_with_nothing_else(home: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.hex"
    file.write_text(NAME.hex())
    why = "--diff compares two files and cannot be combined with anything else."
    for words in ((file,), ("--plot", tmp_path / "p.svg"), ("--format", "xml")):
        done = call(home, "--json", "show", "--diff", file, file, *words)
        assert (done.code, done.json["error"]["message"]) == (2, why)
    assert not (tmp_path / "p.svg").exists()
    assert call(home, "show", "--diff", file, file).out == "no difference\n"


def test_only_a_harmful_calibration_counts_for_strict(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.hex"
    file.write_text(NAME.hex())
    for severity, code in (("warning", 0), ("error", 6)):
        guard = (GuardFinding(1, "c", "m", severity),)  # type: ignore[arg-type]
        monkeypatch.setattr(show, "_guard", lambda _beside, guard=guard: guard)
        assert (call(home, "show", file, "--strict").code, call(home, "show", file).code) == (code, 0)


@pytest.mark.parametrize(
    ("octets", "verdict", "colour"),
    [(NAME, "clean", "32"), (NAME[4:-2], "block-clean", "32"), (NAME[:-1] + b"\0", "frame-bad", "31")],
)
def test_what_is_good_is_green(octets: bytes, verdict: str, colour: str) -> None:
    out = io.StringIO()
    console = consoles.CleanConsole(file=out, force_terminal=True, color_system="standard", width=200)
    show.print_teds(console, describe(TedsBlock(None, None, octets), {}))
    assert f"\x1b[{colour}m{verdict}\x1b[0m" in out.getvalue()


def test_what_a_teds_means_is_foreign_text(printed: Any) -> None:
    shown = replace(describe(TedsBlock(None, 12, NAME), {}), summary=(("name", "[red]thumb[/]"), ("unit", "m\x1b[2J")))
    lines = printed(lambda console: show.print_teds(console, shown))
    assert lines[1:3] == ["  name: [red]thumb[/]", "  unit: m\\x1b[2J"]
