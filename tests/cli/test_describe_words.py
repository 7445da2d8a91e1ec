"""``describe``: a file for each node and format, all of them or none."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.node import describe as commands
from teds_provision.describe.described_node import MissingFieldError
from teds_provision.errors import NotAuthenticError

from .shell import call

ARM, HAND = bytes(range(10)), bytes(range(10, 20))


@pytest.fixture
def described(home: Path, monkeypatch: pytest.MonkeyPatch) -> dict[tuple[str, bytes], Exception]:
    """Have two nodes, and makers that write who and what; return what is lacking, which a test fills in."""
    lacking: dict[tuple[str, bytes], Exception] = {}

    def node_of(_station: Any, uuid: bytes) -> Any:
        if ("node", uuid) in lacking:
            raise lacking["node", uuid]
        return SimpleNamespace(uuid=uuid)

    def maker(form: str, *ends: str) -> Any:
        def make(_station: Any, node: Any) -> dict[str, str]:
            if (form, node.uuid) in lacking:
                raise lacking[form, node.uuid]
            return {f"{node.uuid.hex()[:4]}.{end}": f"{form} of {node.uuid.hex()}\n" for end in ends}

        return make

    monkeypatch.setattr(commands.formats, "described_node", SimpleNamespace(described_node=node_of), raising=False)
    makers = {"td": maker("td", "td.json"), "ros2-control": maker("ros2", "xacro", "yaml"), "aas": maker("aas", "aas")}
    monkeypatch.setattr(commands, "_MAKERS", makers)
    for uuid in (ARM, HAND):
        assert call(home, "whitelist", "add", uuid.hex(), "--fingerprint", uuid.hex()[:2] * 32).code == 0
    return lacking


def test_each_node_has_a_file_for_each_format_in_a_folder_that_is_made(
    home: Path, tmp_path: Path, described: dict[tuple[str, bytes], Exception]
) -> None:
    folder = tmp_path / "robot" / "parts"
    words = ("describe", ARM.hex(), HAND.hex(), "--as", "ros2-control", "--as", "td", "--output", folder)
    done = call(home, *words)
    names = [f"{uuid.hex()[:4]}.{end}" for uuid in (ARM, HAND) for end in ("xacro", "yaml", "td.json")]
    assert (done.code, done.out.splitlines()) == (0, [str(folder / name) for name in names])
    assert call(home, "--json", *words).json == {"files": [str(folder / name) for name in names]}
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    assert (folder / f"{HAND.hex()[:4]}.yaml").read_text() == f"ros2 of {HAND.hex()}\n"
    assert not described


@pytest.mark.parametrize(
    ("lacks", "error", "code"),
    [
        (("aas", HAND), MissingFieldError("The Digital Nameplate requires Street."), 8),
        (("td", ARM), MissingFieldError("A Thing Description requires a title."), 8),
        (("node", HAND), NotAuthenticError("Its datasheet is not signed."), 4),
    ],
)
def test_if_one_node_or_format_lacks_something_nothing_is_written(
    home: Path,
    tmp_path: Path,
    described: dict[tuple[str, bytes], Exception],
    lacks: tuple[str, bytes],
    error: Any,
    code: int,
) -> None:
    described[lacks] = error
    folder = tmp_path / "robot"
    words = ("describe", ARM.hex(), HAND.hex(), "--as", "td", "--as", "aas", "--output", folder)
    done = call(home, "--json", *words)
    assert (done.code, done.json["error"]["message"]) == (code, error.message)
    assert not folder.exists()
    folder.mkdir()
    old = folder / f"{ARM.hex()[:4]}.td.json"
    old.write_text("as it was")
    assert call(home, *words).code == code
    assert ([path.name for path in folder.iterdir()], old.read_text()) == ([old.name], "as it was")


def test_files_are_no_stream_and_a_node_that_is_unknown_is_named(
    home: Path, described: dict[tuple[str, bytes], Exception]
) -> None:
    refused = call(home, "--json", "describe", ARM.hex(), "--as", "td", "--output", "-")
    assert (refused.code, refused.json["error"]["hint"]) == (2, "Name a folder.")
    assert call(home, "describe", "ffffffff", "--as", "td").code == 3
    assert call(home, "describe", ARM.hex()).code == 2, "a format is named"
    assert not described


def test_a_thing_description_is_written_as_people_read_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def made(node: Any) -> dict[str, Any]:
        asked.append(node)
        return {"title": "Größe", "unit": "m/s²"}

    monkeypatch.setattr(commands.formats, "thing_description", SimpleNamespace(thing_description=made), raising=False)
    node: Any = SimpleNamespace(uuid=ARM)
    none: Any = None
    [(name, text)] = commands._thing_description(none, node).items()
    assert (name, json.loads(text)) == (f"{ARM.hex()}.td.json", {"title": "Größe", "unit": "m/s²"})
    assert text == '{\n  "title": "Größe",\n  "unit": "m/s²"\n}\n', "relative to its station: no base is in it"
    assert asked == [node]
