"""``profile list | show | check | new`` as their users meet them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from teds_provision.cli.main import run


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
