"""Modules that every room uses, where the system or the installation is not as usual."""

from __future__ import annotations

import errno
import io
import json
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import files, lazy, limits, one_core, optional_rooms, portable
from teds_provision.errors import BadDataError, NotFoundError, StoreError, UsageError, VaultError
from teds_provision.files import json_files, make_folder, new_file, write_new
from teds_provision.one_core import LinuxKernel, OneCore, _capacity, _keep
from teds_provision.sanitize import counted


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


# -- limits ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the limits so small that a test reaches them."""
    few = replace(
        limits.LIMITS, text_file=20, toml_keys=2, json_depth=3, toml_depth=3, xml_elements=2, xml_attributes=3
    )
    monkeypatch.setattr(limits, "LIMITS", few)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    ("read", "why"),
    [
        (lambda: limits.check_toml("x" * 20, "a.toml"), None),
        (lambda: limits.check_toml("ä" * 10, "a.toml"), None),
        (lambda: limits.check_toml("ä" * 10 + "x", "a.toml"), "A.toml has 21 octets; at most 20 are read."),
        (lambda: limits.check_toml("a=1\nb=2", "a.toml"), None),
        (lambda: limits.check_toml("a=1\nb=2\nc=3", "a.toml"), "a.toml: there are 3 keys; at most 2 are read."),
        (lambda: limits.load_toml("a=[[[[1]]]]", "a.toml"), "A.toml nests deeper than 3 levels."),
        (lambda: limits.load_toml("a=[[1]]", "a.toml"), None),
        (lambda: limits.load_json("[[[1]]]", "the list"), None),
        (lambda: limits.load_json("[[[[[1]]]]]", "the list"), "The list nests deeper than 3 levels."),
        (lambda: limits.load_json('{"a": [{"b": [[1]]}]}', "the list"), "The list nests deeper than 3 levels."),
        (lambda: limits.load_json("[[], [], [], []]", "the list"), None),
        (lambda: limits.check_xml(b"<a b='' c='' d=''>", "the set"), None),
        (lambda: limits.check_xml(b"<a b='' c='' d='' e=''>", "the set"),
         "There are 4 attributes in the set here; at most 3 are read."),
        (lambda: limits.check_xml(b"<a><b>", "the set"), None),
        (lambda: limits.check_xml(b"<a><b></b>", "the set"), "There are 3 tags in the set here; at most 2 are read."),
    ],
)  # fmt: skip
def test_a_document_is_as_large_as_its_limit_and_no_larger(read: Callable[[], Any], why: str | None) -> None:
    if why is None:
        read()
        return
    with pytest.raises(BadDataError) as refused:
        read()
    assert refused.value.message == why


@pytest.mark.parametrize("lost", [ValueError("4300 digits"), RecursionError("too deep")])
def test_toml_that_python_cannot_read_is_no_valid_toml(monkeypatch: pytest.MonkeyPatch, lost: Exception) -> None:
    monkeypatch.setattr(limits.tomllib, "loads", raises(lost))
    with pytest.raises(BadDataError) as refused:
        limits.load_toml("a = 1", "a.toml")
    assert refused.value.message == f"a.toml is not valid TOML: {lost}."


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("x", "'x'"), ("x" * 40, f"'{'x' * 40}'"), ("x" * 41, f"'{'x' * 12}… (41 characters)'"), ("1.5", "'1.5'"),
        ("", "''"), ("٣", "'٣'"), ("+-1", "'+-1'"),
    ],
)  # fmt: skip
def test_what_is_no_whole_number_is_shown_in_forty_characters(text: str, shown: str) -> None:
    with pytest.raises(BadDataError) as refused:
        limits.whole_number(text, "the epoch")
    assert refused.value.message == f"The epoch is no whole number: {shown}."
    assert [limits.whole_number(good, "the epoch") for good in ("7", " -7\n", "+007")] == [7, -7, 7]


# -- files that are odd ------------------------------------------------------------------------------------------------


def test_a_device_is_a_name_that_is_taken_for_a_new_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileExistsError), files.whole_file(tmp_path / "pipe", replace=False):
        pass
    why = "it is a device, pipe or socket"
    with pytest.raises(OSError, match=why) as error, files.whole_file(tmp_path / "pipe", replace=True):
        pass
    assert error.value.errno == errno.EINVAL
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


@pytest.mark.parametrize("replaces", [True, False])
def test_a_file_is_on_the_disk_before_its_name_and_the_name_before_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replaces: bool
) -> None:
    synced: list[Any] = []
    path = tmp_path / "a"

    def sync(descriptor: int) -> None:
        place = os.readlink(f"/proc/self/fd/{descriptor}")
        synced.append(("folder" if place == str(tmp_path) else "file", path.exists()))

    monkeypatch.setattr(files.os, "fsync", sync)
    with files.whole_file(path, replace=replaces) as file:
        file.write(b"whole")
    assert synced == [("file", False), ("folder", True)]


def test_a_link_to_nothing_is_a_name_that_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "none")
    for refused in (link, tmp_path):
        with pytest.raises(UsageError, match="already exists and is not overwritten"):
            files.require_new(refused)
    with pytest.raises(NotFoundError) as error:
        files.require_new(tmp_path / "none" / "a")
    assert (error.value.message, error.value.hint) == (
        f"There is no folder {tmp_path / 'none'}.",
        "Create it, or choose another path.",
    )
    monkeypatch.setattr(os, "link", raises(OSError(errno.EPERM, "Operation not permitted")))
    draft = tmp_path / "draft"
    draft.write_bytes(b"new")
    with pytest.raises(FileExistsError):
        files._publish(draft, link, replace=False)
    assert (link.is_symlink(), draft.exists()) == (True, True)
    monkeypatch.setattr(os, "link", raises(OSError(errno.EIO, "Input/output error")))
    with pytest.raises(OSError, match="Input/output"):
        files._publish(draft, tmp_path / "new", replace=False)


@pytest.mark.parametrize(
    ("what", "article"), [("key", "a key"), ("image", "an image"), ("EDS file", "an EDS file"), ("URL", "an URL")]
)
def test_what_a_file_is_too_large_for_is_named(tmp_path: Path, what: str, article: str) -> None:
    (tmp_path / "a").write_bytes(b"12")
    with pytest.raises(BadDataError) as refused:
        files.read_limited(tmp_path / "a", 1, what)
    assert refused.value.message == f"{tmp_path / 'a'} is larger than 1 octets, which is too large for {article}."


def test_the_pipe_of_a_shell_is_read_by_its_descriptor_and_waited_for(tmp_path: Path) -> None:
    read, write = os.pipe()
    try:
        for place in (f"/dev/fd/{read}", f"/proc/self/fd/{read}"):
            files.require_no_pipe(Path(place))
            descriptor, size = files._opened(place)
            assert (os.get_blocking(descriptor), size) == (True, 0)
            os.close(descriptor)
    finally:
        os.close(read)
        os.close(write)
    files.require_no_pipe(Path("a\0b"))
    files.require_no_pipe(tmp_path / "none")
    (tmp_path / "a").write_bytes(b"123")
    descriptor, size = files._opened(tmp_path / "a")
    os.close(descriptor)
    assert size == 3


@pytest.mark.parametrize("mode", [0o710, 0o701, 0o750, 0o704])
def test_a_private_folder_is_closed_to_the_group_too(tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(PermissionError):
        files.private_folder(folder)


@pytest.mark.parametrize(("name", "long"), [("x" * 99, False), ("x" * 100, True), ("ä" * 49, False), ("ä" * 50, True)])
def test_a_socket_is_named_by_its_octets(name: str, long: bool) -> None:
    """The system takes 100 octets, not 100 characters; a longer path is named by its open folder."""
    with files.short_path(Path("/") / name) as short:
        assert (short == f"/{name}") is not long
        assert not long or (short.startswith("/proc/self/fd/") and short.endswith(f"/{name}"))


def test_a_socket_that_cannot_be_bound_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[str] = []
    real = files.socket.socket

    class Listener:
        def __init__(self, *words: Any) -> None:
            course.append("made")

        def bind(self, _name: str) -> None:
            raise OSError(errno.EADDRINUSE, "Address already in use")

        def close(self) -> None:
            course.append("closed")

    monkeypatch.setattr(files.socket, "socket", Listener)
    before = os.umask(0o022)
    try:
        with pytest.raises(StoreError, match="cannot be written: Address already in use"):
            files.listen_alone(tmp_path / "s", 1)
        assert os.umask(0o022) == 0o022, "the mask is as it was"
    finally:
        os.umask(before)
    assert course == ["made", "closed"]
    monkeypatch.setattr(files.socket, "socket", real)
    listener = files.listen_alone(tmp_path / "s", 1)
    assert (tmp_path / "s").stat().st_mode & 0o777 == 0o600
    listener.close()


@pytest.mark.parametrize(
    ("error", "failure", "kind", "message"),
    [
        (FileNotFoundError(2, "x"), StoreError, NotFoundError, "There is no folder /a."),
        (NotADirectoryError(20, "x"), StoreError, NotFoundError, "There is no folder /a."),
        (FileNotFoundError(2, "x"), VaultError, VaultError, "/a/b cannot be written: x."),
        (IsADirectoryError(21, "x"), StoreError, UsageError, "/a/b is a folder, not a file."),
        (OSError(28, "x"), StoreError, StoreError, "/a/b cannot be written: x."),
    ],
)
def test_why_a_file_cannot_be_written(error: OSError, failure: Any, kind: type[Exception], message: str) -> None:
    found = files._cannot_write(Path("/a/b"), error, failure)
    assert (type(found), found.message) == (kind, message)


def test_a_folder_of_another_user_is_not_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "is_mine", lambda _status: False)
    with pytest.raises(PermissionError, match="it is not a folder of this user alone") as refused:
        files.private_folder(tmp_path / "a")
    assert (refused.value.errno, refused.value.filename) == (errno.EPERM, str(tmp_path / "a"))


def test_the_folder_of_a_long_name_of_a_socket_is_open_for_the_block_alone(tmp_path: Path) -> None:
    deep = tmp_path / ("x" * 100)
    deep.mkdir()
    with files.short_path(deep / "s") as short:
        descriptor = int(short.split("/")[4])
        assert os.path.samestat(os.fstat(descriptor), deep.stat())
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)


@pytest.mark.parametrize("path", [Path("/"), Path()])
def test_what_has_no_name_is_a_folder(path: Path) -> None:
    with pytest.raises(IsADirectoryError), files.whole_file(path, replace=True):
        pass


@pytest.mark.parametrize("error", [BlockingIOError(errno.EAGAIN, "busy"), OSError(errno.ENOLCK, "no locks")])
def test_a_file_is_written_whole_in_a_folder_without_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(files, "lock", raises(error))
    with files.whole_file(tmp_path / "a", replace=False) as file:
        file.write(b"whole")
    assert (tmp_path / "a").read_bytes() == b"whole"


def test_a_lock_is_of_the_kind_that_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    import fcntl

    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(portable, "_FLOCK", lambda *words: asked.append(words))
    portable.lock(3)
    portable.lock(3, shared=True)
    portable.lock(3, wait=True)
    portable.lock(4, shared=True, wait=True)
    assert asked == [
        (3, fcntl.LOCK_EX | fcntl.LOCK_NB),
        (3, fcntl.LOCK_SH | fcntl.LOCK_NB),
        (3, fcntl.LOCK_EX),
        (4, fcntl.LOCK_SH),
    ]
    monkeypatch.setattr(portable, "_FLOCK", None)
    with pytest.raises(OSError, match="this system has no locks of files") as none:
        portable.lock(3)
    assert none.value.errno == errno.ENOLCK
    assert portable._find_flock() is fcntl.flock
    monkeypatch.setitem(sys.modules, "fcntl", None)
    assert portable._find_flock() is None


def test_a_core_works_for_users_the_system_and_interrupts_and_not_while_it_waits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Time of guests is in that of users already; the sum of all cores is no core."""
    text = "cpu  9 9 9 9 9 9 9 9 9 9\ncpu0 100 20 30 4000 500 6 7 8 900 99\ncpu12 0 0 0 7 0 0 0 0 0 0\nintr 1\ncpu3 1\n"
    asked: list[Any] = []
    monkeypatch.setattr(one_core, "open", lambda *words, **_: asked.append(words) or io.StringIO(text), raising=False)
    monkeypatch.setattr(os, "sysconf", {"SC_CLK_TCK": 50}.__getitem__)
    assert LinuxKernel().busy() == {0: 171 / 50, 12: 0.0}
    assert asked == [("/proc/stat",)]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32-be"])
def test_json_in_octets_is_read_in_the_encoding_that_it_shows(encoding: str) -> None:
    assert limits._parsed('{"a": "ä"}'.encode(encoding)) == {"a": "ä"}


def test_a_number_has_its_noun_in_singular_or_plural() -> None:
    assert [counted(number, "day") for number in (0, 1, 2)] == ["0 days", "1 day", "2 days"]
    assert [counted(number, "entry", "entries") for number in (0, 1, 2)] == ["0 entries", "1 entry", "2 entries"]


@pytest.mark.parametrize(
    ("text", "why", "with_file"),
    [
        ("", "The list is empty.", "a.json:1: The list is empty."),
        (b" \n", "The list is empty.", "a.json:1: The list is empty."),
        ('{"a":\n}', "The list is not JSON: line 2: Expecting value.", "a.json:2: this is not JSON: Expecting value."),
        (b'["\xff"]', "The list is not text: it is binary, or not UTF-8.",
         "The list is not text: it is binary, or not UTF-8."),
        ("[" * 100_000, "The list is nested too deeply.", "a.json:1: The list is nested too deeply."),
        (b"123456789", "The list has 9 octets; at most 8 are read.", "The list has 9 octets; at most 8 are read."),
    ],
)  # fmt: skip
def test_why_json_of_a_stranger_is_refused(text: str | bytes, why: str, with_file: str) -> None:
    octets = 8 if text == b"123456789" else 1 << 20
    for file, message in (("", why), ("a.json", with_file)):
        with pytest.raises(BadDataError) as refused:
            limits.load_json(text, "the list", octets=octets, file=file)
        assert refused.value.message == message
    assert limits.load_json(b"12345678", "the list", octets=8) == 12345678


@pytest.mark.parametrize("code", ["EINVAL", "ENOTSUP", "ENOSYS", "EROFS", "EACCES", "EIO"])
def test_a_folder_that_its_file_system_cannot_bring_to_the_disk_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    synced: list[int] = []

    def refuse(descriptor: int) -> None:
        synced.append(descriptor)
        raise OSError(getattr(errno, code), "refused")

    monkeypatch.setattr(os, "fsync", refuse)
    if code == "EIO":
        with pytest.raises(OSError, match="refused"):
            files.sync_folder(tmp_path)
    else:
        files.sync_folder(tmp_path)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(synced[0])


def test_a_pipe_that_is_refused_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    opened: list[int] = []
    real = os.open

    def noted(*words: Any) -> int:
        opened.append(real(*words))
        return opened[-1]

    monkeypatch.setattr(os, "open", noted)
    with pytest.raises(NotFoundError) as refused:
        files._opened(tmp_path / "pipe")
    assert refused.value.message == f"{tmp_path / 'pipe'} is a pipe, not a file."
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(opened[0])
