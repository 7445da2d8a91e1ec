"""Updates that the service keeps, without boards: one that could not be kept, and how many that are over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import LinkError, StoreError
from teds_provision.ncap.nodes import update_actions, updates
from teds_provision.ncap.nodes.update_actions import (
    FOLDER,
    KEPT,
    BoardRow,
    UpdateAction,
    UpdateFolder,
    UpdateRequest,
)
from teds_provision.ncap.nodes.updates import Updates

NODE = "ab" * 10


def updates_of(folder: Path) -> Updates:
    none: Any = None
    quiet: Any = SimpleNamespace(home=folder, audit=lambda *_words, **_facts: None)
    return Updates(quiet, none, none, none, bus_of=lambda _uuid: None, measured=none, lent=none, held=none)


def test_an_update_that_could_not_be_kept_does_not_keep_others_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = SimpleNamespace(version_text="1.1.0", digest=b"d", board=None, octets=b"x", security_counter=None)
    monkeypatch.setattr(updates, "_image_of", lambda _octets: image)
    made = updates_of(tmp_path)

    def full(*_words: Any) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(made._kept, "keep_new", full)
    for _ in range(2):
        with pytest.raises(StoreError):
            made.begin(b"x", UpdateRequest((NODE,)), owner="a person")
    assert made.all() == []


def test_of_the_updates_that_are_over_the_newest_are_kept(tmp_path: Path) -> None:
    (tmp_path / FOLDER).mkdir(mode=0o700)
    made = updates_of(tmp_path)
    names = [f"{number:02}" for number in range(KEPT + 2)]
    for began, name in enumerate(names):
        action = UpdateAction(name, UpdateRequest((NODE,)), {"version": "1.1.0"}, {}, "a person", None, float(began))
        made._actions[name] = action
        made._end(action, "done")
    assert [action["id"] for action in made.all()] == names[:1:-1]
    assert sorted(path.stem for path in (tmp_path / FOLDER).glob("*.json")) == names[2:]


def test_an_update_that_runs_learns_that_the_service_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails from then on is no result of the board: the log called it lost, and it was updated after the start."""
    (tmp_path / FOLDER).mkdir(mode=0o700)
    made, ends = updates_of(tmp_path), list[bool]()
    port = SimpleNamespace(place="can:x", capabilities=SimpleNamespace(max_parallel=1))
    policy = SimpleNamespace(require_whitelisted=lambda _uuid: None)
    monkeypatch.setattr(made._station, "policy", policy, raising=False)
    monkeypatch.setattr(made, "_live", SimpleNamespace(event=lambda *_words, **_facts: None))
    monkeypatch.setattr(made, "_bus_of", lambda _uuid: port)

    def update_at(*_words: Any, is_ending: Callable[[], bool], **_facts: Any) -> None:
        ends.append(is_ending())
        made.stop()
        ends.append(is_ending())
        raise LinkError("Its bus is closed.")

    monkeypatch.setattr(updates, "update_at", update_at)
    row, image = BoardRow(NODE), cast(Any, object())
    action = UpdateAction("00", UpdateRequest((NODE,)), {"version": "1.1.0"}, {NODE: row}, "a person", None, 0.0)
    assert made._update(action, image, NODE).result == "lost"
    assert ends == [False, True]


def test_the_image_of_an_update_is_on_the_disk_before_its_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in between, the other way round, the next start would find an update that it cannot go on with."""
    written: list[str] = []
    monkeypatch.setattr(update_actions, "write_whole", lambda path, _octets: written.append(path.name))
    action = UpdateAction("a1", UpdateRequest((NODE,)), {"version": "1.1.0"}, {}, "a person", None, 0.0)
    UpdateFolder(tmp_path).keep_new(action, b"image")
    assert written == ["a1.image", "a1.json"]


def test_boards_that_a_cancel_left_out_stay_so_after_a_restart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / FOLDER).mkdir(mode=0o700)
    made, dropped = updates_of(tmp_path), list[bool]()
    monkeypatch.setattr(made, "_live", SimpleNamespace(event=lambda *_words, **_facts: None))
    rows = {
        node: BoardRow(node, state=state) for node, state in (("ab", "running"), ("cd", "waiting"), ("ef", "ended"))
    }
    made._actions["a1"] = UpdateAction("a1", UpdateRequest(tuple(rows)), {"version": "1"}, rows, "page", None, 0.0)
    made._work = cast(Any, SimpleNamespace(drop_waiting=lambda: dropped.append(True)))
    made.cancel("a1")
    [kept] = UpdateFolder(tmp_path).read()
    assert [row.state for row in kept.rows.values()] == ["running", "skipped", "ended"]
    assert dropped == [True]
