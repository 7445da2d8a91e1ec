"""Modules that every room uses, where the system or the installation is not as usual."""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import files, lazy, limits, one_core, optional_rooms, portable
from teds_provision.errors import StoreError, UsageError
from teds_provision.files import json_files, make_folder, new_file, write_new
from teds_provision.one_core import OneCore, _capacity, _keep


def raises(error: Exception) -> Callable[..., Any]:
    def raised(*_: Any, **__: Any) -> Any:
        raise error

    return raised


# -- files -------------------------------------------------------------------------------------------------------------


def test_a_name_that_another_process_takes_meanwhile_stays_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "result"
    monkeypatch.setattr(files, "require_new", lambda _: path.write_bytes(b"of another process"))
    with pytest.raises(UsageError, match="already exists"):
        write_new(path, b"mine")
    assert path.read_bytes() == b"of another process"
    assert [entry.name for entry in tmp_path.iterdir()] == ["result"], "no draft is left"


@pytest.mark.parametrize("renames", [True, False])
def test_a_draft_gets_its_name_open_or_closed_as_the_system_wants(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: bool
) -> None:
    opened, published = list[Any](), list[bool]()
    publish = files._publish

    def noted(draft: Path, path: Path, *, replace: bool) -> None:
        published.append(opened[0].closed)
        publish(draft, path, replace=replace)

    monkeypatch.setattr(files, "RENAMES_OPEN_FILES", renames)
    monkeypatch.setattr(files, "_publish", noted)
    with new_file(tmp_path / "result") as file:
        opened.append(file)
        file.write(b"whole")
    assert published == [not renames]
    assert (tmp_path / "result").read_bytes() == b"whole"
    assert [entry.name for entry in tmp_path.iterdir()] == ["result"]


def test_an_entry_that_the_system_does_not_tell_of_is_neither_file_nor_folder() -> None:
    lost = OSError(errno.EIO, "Input/output error")
    entry: Any = SimpleNamespace(is_dir=raises(lost), is_file=raises(lost))
    assert (files._is_folder(entry), files._is_file(entry)) == (False, False)


def test_evidence_below_a_folder_is_found_and_links_to_folders_are_not_followed(tmp_path: Path) -> None:
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    for path in (tmp_path / "1.json", below / "2.json", below / "note.txt"):
        path.write_bytes(b"{}")
    (tmp_path / "3.json").symlink_to(below / "2.json")
    (tmp_path / "round").symlink_to(tmp_path)
    (tmp_path / "4.json").mkdir()
    found = sorted(str(Path(name).relative_to(tmp_path)) for name in json_files([tmp_path], "evidence"))
    assert found == ["1.json", "3.json", "a/b/2.json"]


def test_a_folder_that_cannot_be_made_is_named_with_its_cause(tmp_path: Path) -> None:
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StoreError) as error:
        make_folder(tmp_path / "file" / "below")
    assert error.value.message == f"Cannot create folder {tmp_path / 'file' / 'below'}: Not a directory."


# -- one core ----------------------------------------------------------------------------------------------------------


class Kernel:
    """Two idle cores; ``lost`` is raised when the load is read."""

    def __init__(self, cores: set[int], lost: Exception | None = None) -> None:
        self.cores, self.lost, self.placed, self.looks = cores, lost, list[set[int]](), 0

    def allowed(self) -> set[int]:
        return self.placed[-1] if self.placed else self.cores

    def fastest(self, cores: Any) -> Any:
        return cores

    def busy(self) -> dict[int, float]:
        self.looks += 1
        if self.looks > 1 and self.lost is not None:
            raise self.lost
        return dict.fromkeys(self.cores, 0.0)

    def own(self) -> float:
        return 0.0

    def now(self) -> float:
        return float(self.looks)

    def threads(self) -> set[int]:
        return {1}

    def place(self, thread: int, cores: set[int]) -> None:
        self.placed.append(set(cores))


@pytest.mark.parametrize("lost", [OSError("gone"), ValueError("no figure"), KeyError(1)])
def test_a_core_that_is_taken_offline_ends_the_watch_and_gives_all_cores_back(lost: Exception) -> None:
    kernel = Kernel({0, 1}, lost)
    kept = OneCore(cast("Any", kernel))
    pauses = list[float]()

    def wait(pause: float) -> bool:
        pauses.append(pause)
        return len(pauses) > 3  # so that a watch that goes on ends, too

    kept._end = cast("Any", SimpleNamespace(wait=wait, set=lambda: None))
    kept._run()
    assert kept.left
    assert kernel.placed == [{0, 1}]
    assert len(pauses) == 1
    kept._run()
    assert len(pauses) == 2, "it looks no more"
    assert len(kernel.placed) == 1


def test_one_core_of_a_kernel_with_figures_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _keep(cast("Any", Kernel({3}))) is None
    assert _keep(cast("Any", SimpleNamespace(allowed=raises(OSError("refused"))))) is None
    kept = _keep(cast("Any", Kernel({0, 1})))
    assert kept is not None
    assert kept.core is None
    monkeypatch.delattr(os, "sched_setaffinity")
    assert _keep(cast("Any", Kernel({0, 1}))) is None, "another system"


def test_the_speed_of_a_core_is_0_where_all_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[str]()
    monkeypatch.setattr(one_core.Path, "read_text", lambda path: asked.append(str(path)) or "1024\n")  # type: ignore[attr-defined,func-returns-value]
    assert _capacity(7) == 1024
    assert asked == ["/sys/devices/system/cpu/cpu7/cpu_capacity"]
    for error in (FileNotFoundError(), ValueError()):
        monkeypatch.setattr(Path, "read_text", raises(error))
        assert _capacity(7) == 0


# -- the installation --------------------------------------------------------------------------------------------------


def test_a_package_gives_its_modules_and_names_and_hides_no_missing_import(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "lazypackage"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "good.py").write_text("part = 7\n")
    (folder / "broken.py").write_text("import nothing_of_this_name\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    import lazypackage  # type: ignore[import-not-found]

    load = lazy.lazy("lazypackage", {"good": "part"})
    assert (load("part"), lazypackage.part) == (7, 7)
    assert cast("Any", load("good")).part == 7
    for name in ("none", "_private"):
        with pytest.raises(AttributeError) as error:
            load(name)
        assert str(error.value) == f"module 'lazypackage' has no attribute {name!r}"
    with pytest.raises(ModuleNotFoundError, match="nothing_of_this_name"):
        load("broken")


def test_which_packages_are_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "removed_module", None)
    names = ("json", "nothing_of_this_name", "nothing_of_this_name.part", "removed_module")
    assert [lazy.is_installed(name) for name in names] == [True, False, False, False]


@pytest.mark.parametrize(
    ("requirement", "came", "words"),
    [
        ("pint", '{"url": "file:///src"}', ["pint"]),
        ("teds-provision[units]", None, ["teds-provision[units]"]),
        ("teds-provision[units]", "{}", ["teds-provision[units]"]),
        ("teds-provision[units]", '{"url": ""}', ["teds-provision[units]"]),
        ("teds-provision[units]", "no json", ["teds-provision[units]"]),
        ("teds-provision[units]", "[]", ["teds-provision[units]"]),
    ],
)
def test_an_extra_comes_from_where_the_tool_came_if_that_is_known(
    monkeypatch: pytest.MonkeyPatch, requirement: str, came: str | None, words: list[str]
) -> None:
    monkeypatch.setattr(lazy.metadata, "distribution", lambda _: SimpleNamespace(read_text=lambda _name: came))
    assert lazy._as_it_came(requirement) == words
    monkeypatch.setattr(lazy.metadata, "distribution", raises(lazy.metadata.PackageNotFoundError("teds-provision")))
    assert lazy._as_it_came(requirement) == [requirement]


def test_a_room_that_is_left_out_is_none_and_one_with_a_missing_import_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rooms = optional_rooms.rooms.__wrapped__
    assert list(rooms()) == list(optional_rooms.OPTIONAL)

    def without(missing: Callable[[str], str]) -> None:
        def imported(name: str) -> Any:
            raise ModuleNotFoundError("missing", name=missing(name))

        monkeypatch.setattr(optional_rooms, "import_module", imported)

    without(lambda name: name)
    assert rooms() == {}
    without(lambda name: name.removesuffix(".room"))
    assert rooms() == {}
    for other in ("teds_provision.plant.status", "psycopg", "teds_provision"):
        without(lambda _, other=other: other)  # type: ignore[misc]
        with pytest.raises(ModuleNotFoundError):
            rooms()


def test_the_name_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "uname", lambda: SimpleNamespace(nodename="bench"))
    assert portable.name_of_machine() == "bench"
    monkeypatch.delattr(os, "uname")
    monkeypatch.setattr(platform, "node", lambda: "BENCH")
    assert portable.name_of_machine() == "BENCH"


def test_a_text_with_a_byte_order_mark_is_refused_with_its_place() -> None:
    assert limits._parsed('{"a": 1}') == {"a": 1}
    with pytest.raises(json.JSONDecodeError) as error:
        limits._parsed('\ufeff{"a": 1}')
    assert (error.value.pos, error.value.msg) == (0, "Unexpected UTF-8 BOM (decode using utf-8-sig)")
    assert limits._parsed(b'\xef\xbb\xbf{"a": 1}'.decode("utf-8-sig")) == {"a": 1}


def test_work_is_shared_only_among_processes_that_can_inherit_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {0, 2, 5}, raising=False)
    assert portable.cores_to_share() == 3
    with monkeypatch.context() as without:
        without.delattr(os, "fork")
        assert portable.cores_to_share() == 1
    monkeypatch.delattr(os, "sched_getaffinity")
    assert portable.cores_to_share() == 1
