"""``profile list | show | check | new`` as their users meet them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from teds_provision.cli.main import run
from teds_provision.cli.station import profile as profile_command


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def json_of(capsys: pytest.CaptureFixture[str], *arguments: str, exit_code: int = 0) -> dict[str, Any]:
    assert run(["--home", "home", "--json", *arguments]) == exit_code
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    result: dict[str, Any] = json.loads(out)
    return result


def test_list_names_the_shipped_types(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [entry["name"] for entry in json_of(capsys, "profile", "list")["profiles"]]
    assert {"tactile-finger-sensor", "magnetic-angular-position-sensor"} < set(names)
    assert run(["--home", "home", "profile", "list"]) == 0
    shown = capsys.readouterr().out
    assert "magnetic-angular-position-sensor" in shown
    assert "smart-sensor" not in shown.split()


def test_show_gives_ranges_in_the_units_of_the_file(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (entry,) = json_of(capsys, "profile", "show", "magnetic-angular-position-sensor")["profiles"]
    (channel,) = entry["channels"]
    assert (channel["unit"], channel["high_limit"], channel["uncertainty"]) == ("degree", 360.0, 1.0)
    assert run(["--home", "home", "profile", "show", "tactile-finger-sensor"]) == 0
    assert "taxel 1 to taxel 12" in capsys.readouterr().out


def test_check_exits_8_and_names_every_mistake(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.toml").write_text('extends = "gripper"\n[channel.1]\nunit = "newtn"\nfoo = 1\n')
    error = json_of(capsys, "profile", "check", "bad.toml", exit_code=8)["error"]
    assert error["code"] == "bad-data"
    assert "bad.toml:3: channel.1.unit" in error["message"]
    assert run(["--home", "home", "profile", "check", "bad.toml"]) == 8
    stderr = capsys.readouterr().err
    assert "bad.toml:3: channel.1.unit" in stderr
    assert "bad.toml:4: channel.1.foo" in stderr
    assert json_of(capsys, "profile", "check", "gripper", "load-cell")["profiles"][1]["ok"] is True


def test_an_unknown_type_exits_3(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert json_of(capsys, "profile", "show", "gipper", exit_code=3)["error"]["code"] == "not-found"


def test_new_writes_a_profile_once(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert json_of(capsys, "profile", "new", "wrist", "--dry-run")["text"].startswith("# Transducer type wrist")
    assert not Path("home/profiles/wrist.toml").exists()
    made = json_of(capsys, "profile", "new", "wrist")["profiles"][0]["file"]
    assert Path(made) == Path("home/profiles/wrist.toml")
    before = Path(made).read_bytes()
    json_of(capsys, "profile", "new", "wrist")
    assert Path(made).read_bytes() == before
    assert json_of(capsys, "profile", "check", "wrist")["profiles"][0]["ok"] is True
    Path(made).write_text("title = 'mine'\n")
    json_of(capsys, "profile", "new", "wrist", exit_code=2)
    json_of(capsys, "profile", "new", "../evil", exit_code=2)


def test_new_may_extend_another_type(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("profiles").mkdir()
    json_of(capsys, "profile", "new", "my-gripper", "--extends", "gripper")
    (entry,) = json_of(capsys, "profile", "show", "my-gripper")["profiles"]
    assert entry["extends"] == ["gripper", "smart-sensor"]
    assert Path("profiles/my-gripper.toml").exists()


THIN = """\
title = "Thin [wire]"
links = ["can", "nfc"]
extends = "smart-sensor"

[channel.1-3]
name = "wire {channel}"
type = "sensor"
unit = "degC"
low-limit = -40.0
high-limit = 125.0
uncertainty = 0.5
sample = { model = "unsigned", octets = 2, bits = 16 }
sampling = { modes = ["trigger", "continuous"], default = "continuous" }
sampling-period = "20 ms"

[channel.1-2.calibration]
required = true
method = "table"
monotone = true
interval = "30 d"

[channel.3.calibration]
monotone = "decreasing"
"""


def text_of(capsys: pytest.CaptureFixture[str], *arguments: str, exit_code: int = 0) -> tuple[list[str], str]:
    """Return the lines of stdout without the spaces that align them, and stderr."""
    assert run(["--home", "home", *arguments]) == exit_code
    shown = capsys.readouterr()
    return [" ".join(line.split()) for line in shown.out.splitlines()], shown.err


def test_a_type_is_shown_whole_and_channels_that_are_alike_in_one_line(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    Path("thin.toml").write_text(THIN)
    lines, _ = text_of(capsys, "profile", "show", "./thin.toml")
    assert lines[:2] == ["Thin [wire] thin.toml", "extends smart-sensor"]
    assert lines[lines.index("Links: can, nfc") + 1 :] == [
        "Ch Name Type Range Uncertainty Period Calibration",
        "1-2 wire 1 to wire 2 sensor -40 to 125 °C 0.5 °C 20 ms required, table, monotone, every 30 d",
        "3 wire 3 sensor -40 to 125 °C 0.5 °C 20 ms decreasing, every 365 d",
    ]


def test_types_are_listed_with_their_links_and_one_that_cannot_be_read_with_why(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A base for others is only in the JSON; of two of one name the home's is listed."""
    monkeypatch.setenv("COLUMNS", "300")
    for folder, name, text in (
        ("profiles", "broken", "title = [\n"),
        ("profiles", "thin", THIN.replace("Thin", "The working folder's")),
        ("home/profiles", "thin", THIN),
        ("home/profiles", "load-cell", THIN.replace("Thin [wire]", "Own load cell")),
    ):
        Path(folder).mkdir(parents=True, exist_ok=True)
        Path(folder, f"{name}.toml").write_text(text)
    lines, _ = text_of(capsys, "profile", "list")
    assert lines[0] == "Profile Channels Links Title"
    assert "thin 3 can, nfc Thin [wire]" in lines
    assert "load-cell 3 can, nfc Own load cell" in lines
    [broken] = [line for line in lines if line.startswith("broken")]
    assert broken.startswith("broken cannot be read: profiles/broken.toml:")
    assert len([line for line in lines if line.startswith(("thin", "load-cell"))]) == 2
    assert not [line for line in lines if line.startswith("smart-sensor")]
    found = {entry["name"]: entry for entry in json_of(capsys, "profile", "list")["profiles"]}
    assert found["smart-sensor"]["abstract"] is True
    assert set(found["broken"]) == {"name", "file", "error"}


def test_every_file_is_checked_and_one_mistake_in_any_of_them_is_enough(
    workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("good.toml").write_text(THIN)
    Path("thin.toml").write_text(THIN.replace('name = "wire {channel}"\n', ""))
    Path("bad.toml").write_text(THIN.replace('unit = "degC"', 'unit = "degX"'))
    for names in (["bad.toml", "good.toml"], ["good.toml", "bad.toml"], ["thin.toml", "bad.toml", "good.toml"]):
        _, noted = text_of(capsys, "profile", "check", *names, exit_code=8)
        assert "error: bad.toml:8: channel." in noted
        assert ("warning: thin.toml" in noted) is ("thin.toml" in names)
    lines, noted = text_of(capsys, "profile", "check", "good.toml", "thin.toml")
    assert lines == ["good, thin: no mistakes found."]
    assert "warning: thin.toml" in noted, "which is no mistake"
    assert "good.toml" not in noted
    good, thin = json_of(capsys, "profile", "check", "good.toml", "thin.toml")["profiles"]
    assert (good, thin["ok"]) == ({"name": "good", "file": "good.toml", "ok": True, "problems": []}, True)
    assert {problem["severity"] for problem in thin["problems"]} == {"warning"}
    assert set(thin["problems"][0]) == {"file", "line", "field", "message", "severity"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["Wrist"], '"Wrist" is not a valid profile name.'),
        (["-wrist"], ""),
        (["a" * 65], "is not a valid profile name."),
        (["x", "--from", "y.xml"], "--from needs --map, and no --extends."),
        (["x", "--map", "map.toml"], "--from needs --map, and no --extends."),
        (
            ["x", "--from", "y.xml", "--map", "map.toml", "--extends", "gripper"],
            "--from needs --map, and no --extends.",
        ),
        (["x", "--from", "dbc:y.dbc", "--map", "map.toml"], "--map reads XML."),
        (["x", "--message", "Torque"], "--message needs --from dbc:FILE."),
        (["x", "--from", "y.xml", "--map", "map.toml", "--message", "Torque"], "--message needs --from dbc:FILE."),
    ],
)
def test_what_new_refuses_writes_nothing(
    workspace: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    Path("map.toml").write_text("")
    Path("y.xml").write_text("<a/>")
    error = json_of(capsys, "profile", "new", *words, exit_code=2)["error"]
    assert message in error["message"]
    assert not list(workspace.rglob("profiles"))


def test_new_writes_into_the_working_folders_profiles_else_the_homes_and_says_where(
    workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert text_of(capsys, "profile", "new", "a")[0] == ["home/profiles/a.toml written."]
    assert text_of(capsys, "profile", "new", "a")[0] == ["home/profiles/a.toml already exists."]
    Path("profiles").write_text("a file of this name is no folder\n")
    assert text_of(capsys, "profile", "new", "c")[0] == ["home/profiles/c.toml written."]
    Path("profiles").unlink()
    Path("profiles").mkdir()
    assert text_of(capsys, "profile", "new", "a")[0] == ["profiles/a.toml written."]
    assert text_of(capsys, "profile", "new", "a", "-o", "mine.toml")[0] == ["mine.toml written."]
    lines, _ = text_of(capsys, "profile", "new", "b", "--dry-run", "--extends", "gripper")
    assert lines[0] == "# Transducer type b: like gripper, except for the settings below."
    assert not Path("profiles/b.toml").exists()
    assert 'extends = "gripper"' in lines


MAPPED = """\
[values]
title = "title"
"""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--from", "a.xml"], "--from needs --map, and no --extends."),
        (["--map", "a.xml"], "--from needs --map, and no --extends."),
        (["--from", "a.xml", "--map", "a.xml", "--extends", "gripper"], "--from needs --map, and no --extends."),
        (["--from", "a.xml", "--message", "x"], "--message needs --from dbc:FILE."),
    ],
)
def test_a_new_type_comes_from_one_source(
    workspace: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    Path("a.xml").write_text("<a/>")
    error = json_of(capsys, "profile", "new", "mine", *words, exit_code=2)["error"]
    assert error["message"] == message
    assert not Path("home/profiles").exists()


def test_what_a_mapping_makes_is_checked_like_any_profile(
    workspace: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("a.xml").write_text("<a/>")
    Path("map.toml").write_text(MAPPED)
    given: list[Any] = []
    texts = ['title = "Mine"\nextends = "gripper"\n', 'title = "Mine"\nfoo = 1\n']

    def made(octets: bytes, rules: str, **how: Any) -> str:
        given.append((octets, rules, how))
        return texts.pop(0)

    monkeypatch.setattr(profile_command, "profile_from_xml", made)
    words = ("profile", "new", "mine", "--from", "a.xml", "--map", "map.toml")
    assert json_of(capsys, *words)["profiles"][0]["name"] == "mine"
    assert given == [(b"<a/>", MAPPED, {"name": "mine", "file": "a.xml", "by": "map.toml"})]
    before = Path("home/profiles/mine.toml").read_bytes()
    assert "there is no channel" in json_of(capsys, *words, exit_code=8)["error"]["message"]
    assert Path("home/profiles/mine.toml").read_bytes() == before


def test_a_new_type_may_have_the_64_characters_of_a_name_and_a_folder_that_can_be_made(
    workspace: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, code in (("a" * 64, 0), ("0.a-b_c", 0), ("a" * 65, 2), ("-a", 2), ("A", 2), ("", 2)):
        json_of(capsys, "profile", "new", "--dry-run", "--", name, exit_code=code)
    Path("home").mkdir(exist_ok=True)
    Path("home/profiles").write_text("a file")
    error = json_of(capsys, "profile", "new", "mine", exit_code=7)["error"]
    assert error["message"] == "Cannot create home/profiles: File exists."
