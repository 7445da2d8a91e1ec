"""Updates that the service keeps, without boards: one that could not be kept, and how many that are over."""

from __future__ import annotations

import json
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    FrozenError,
    LinkError,
    NodeBusyError,
    NoNodeError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
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
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.update import BoardUpdate
from teds_provision.station.store.audit import ACTOR

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


OTHER = "cd" * 10


class Bench:
    """Updates of a home, with the events and the log that they leave; boards and links are mocks."""

    def __init__(self, folder: Path) -> None:
        self.events: list[tuple[Any, ...]] = []
        self.log: list[tuple[Any, ...]] = []
        self.looked: list[Any] = []
        self.locked: list[Any] = []
        self.whitelisted, self.held, self.trusted = True, list[int](), cast(Any, None)
        self.port: Any = SimpleNamespace(place="can:x", capabilities=SimpleNamespace(max_parallel=2))
        station: Any = SimpleNamespace(
            home=folder,
            policy=SimpleNamespace(require_whitelisted=self._require_whitelisted),
            audit=lambda act, node, outcome, **facts: self.log.append((act, node, outcome, ACTOR.get(), facts)),
        )
        directory: Any = SimpleNamespace(
            refresh=self.looked.append,
            note=lambda *words, **facts: self.looked.append((words, facts)),
        )
        live: Any = SimpleNamespace(event=lambda kind, **facts: self.events.append((kind, facts)))
        self.updates = Updates(
            station,
            directory,
            live,
            cast(Any, SimpleNamespace(hold=self._hold)),
            bus_of=lambda _uuid: self.port,
            measured=self._measured,
            lent=self._lend,
            held=lambda _uuid: self.held,
        )

    def _require_whitelisted(self, _uuid: bytes) -> None:
        if not self.whitelisted:
            raise PolicyError("It is not on the whitelist.")

    @contextmanager
    def _hold(self, uuid: str, what: str) -> Iterator[None]:
        self.locked.append((uuid, what))
        yield

    @contextmanager
    def _measured(self, _uuid: str) -> Iterator[Any]:
        if isinstance(self.trusted, Exception):
            raise self.trusted
        yield self.trusted

    @contextmanager
    def _lend(self, uuid: str, why: str) -> Iterator[bool]:
        self.locked.append((uuid, why))
        yield True

    def action(self, *rows: BoardRow, name: str = "a1", state: str = "running", began: float = 0.0) -> UpdateAction:
        every = {row.uuid: row for row in rows}
        request, image = UpdateRequest(tuple(every)), {"version": "1.1.0", "digest": "ab"}
        return UpdateAction(name, request, image, every, "api:robot", "robot", began, state)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    (tmp_path / FOLDER).mkdir(mode=0o700)
    return Bench(tmp_path)


def test_after_a_restart_the_oldest_update_that_was_cut_goes_on_and_no_other(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, begun = UpdateFolder(bench.updates._station.home), list[Any]()
    for name, state, began in (("d0", "done", 1.0), ("r2", "running", 3.0), ("r1", "running", 2.0)):
        folder.keep_new(bench.action(BoardRow(NODE), name=name, state=state, began=began), b"image")
    monkeypatch.setattr(UpdateFolder, "image_of", lambda _folder, action: action.id)
    monkeypatch.setattr(bench.updates, "_begin", lambda action, image: begun.append((action.id, image)))
    bench.updates.start()
    assert begun == [("r1", "r1")]
    assert [(action["id"], action["state"]) for action in bench.updates.all()] == [
        ("r2", "stopped"), ("r1", "running"), ("d0", "done"),
    ]  # fmt: skip
    assert [path.name for path in folder._folder.glob("*.image")] == ["r1.image"], "the only one that is needed"


def test_an_update_whose_image_is_gone_is_refused_for_each_board_without_a_result(bench: Bench) -> None:
    folder = UpdateFolder(bench.updates._station.home)
    rows = {
        "ended": BoardRow("aa", state="ended", result="updated"),
        "skipped": BoardRow("bb", state="skipped"),
        "running": BoardRow("cc", state="running", step="upload"),
        "waiting": BoardRow("dd"),
    }
    folder.keep_new(bench.action(*rows.values()), b"no image")
    bench.updates.start()
    [kept] = folder.read()
    assert kept.state == "stopped"
    assert {uuid: (row.state, row.result) for uuid, row in kept.rows.items()} == {
        "aa": ("ended", "updated"), "bb": ("skipped", None), "cc": ("ended", "refused"), "dd": ("ended", "refused"),
    }  # fmt: skip
    assert [row.error and row.error["code"] for row in kept.rows.values()] == [None, None, "bad-data", "bad-data"]


def test_an_update_goes_on_with_the_boards_that_have_no_result(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    class Work:
        def __init__(self, items: list[str], _work: Any, *, at_once: int, name: str) -> None:
            given.append((items, at_once))

        def results(self) -> Iterator[Any]:
            yield from ()

    monkeypatch.setattr(updates, "ParallelWork", Work)
    monkeypatch.setattr(updates.threading, "Thread", lambda **_words: SimpleNamespace(start=lambda: None))
    rows = {
        "ended": BoardRow("aa", state="ended", result="lost"),
        "skipped": BoardRow("bb", state="skipped"),
        "running": BoardRow("cc", state="running", step="upload"),
    }
    action = bench.action(*rows.values())
    bench.updates._begin(action, cast(Any, None))
    assert given == [(["cc"], 1)]
    assert [(row.state, row.step) for row in action.rows.values()] == [
        ("ended", None), ("skipped", None), ("waiting", None),
    ]  # fmt: skip


class Finished:
    """What a worker gives: the result of a board, or the failure that nobody foresaw."""

    def __init__(self, item: str, found: Any) -> None:
        self.item, self._found = item, found
        self.error = found if isinstance(found, Exception) else None

    def result(self) -> Any:
        return self._found


@pytest.mark.parametrize("skipped", [False, True])
def test_each_result_is_kept_and_shown_and_the_end_is_counted_in_the_log(skipped: bool, bench: Bench) -> None:
    rows = {name: BoardRow(name * 10, state="running", before="0.9.0", step="prove") for name in ("aa", "bb", "cc")}
    rows["dd"] = BoardRow("dd" * 10, state="skipped" if skipped else "ended", result=None if skipped else "already")
    action = bench.action(*rows.values())
    bench.updates._actions[action.id] = action
    done = [
        Finished("aa" * 10, BoardUpdate(b"", "updated", "1.0.0", 512, 2.5)),
        Finished("bb" * 10, BoardUpdate(b"", "lost", None, 0, 1.0, LinkError("Silent."))),
        Finished("cc" * 10, ZeroDivisionError()),
    ]
    bench.updates._follow(action, cast(Any, SimpleNamespace(results=lambda: iter(done))))
    state = "stopped" if skipped else "done"
    assert (action.state, action.ended is not None) == (state, True)
    found = [(row.state, row.result, row.before, row.octets, row.step) for row in list(action.rows.values())[:3]]
    assert found == [
        ("ended", "updated", "1.0.0", 512, None), ("ended", "lost", "0.9.0", 0, None),
        ("ended", "refused", "0.9.0", 0, None),
    ]  # fmt: skip
    assert [row.error and row.error["code"] for row in action.rows.values()] == [None, "link", "bug", None]
    counts = {"updated": 1, "refused": 1, "lost": 1} | ({} if skipped else {"already": 1})
    assert bench.log == [("update", None, "ended", "robot", {"id": "a1", "to": "1.1.0", **counts})]
    for name in ("aa", "bb", "cc"):
        assert [name * 10] in bench.looked
        assert ((name * 10, "updated"), {"problem": None}) in bench.looked
    shown = [
        (facts["state"], facts.get("uuid", "")[:2], facts.get("board", {}).get("result")) for _, facts in bench.events
    ]
    assert shown == [
        ("running", "", None), ("running", "aa", "updated"), ("running", "bb", "lost"), ("running", "cc", "refused"),
        (state, "", None),
    ]  # fmt: skip
    [kept] = UpdateFolder(bench.updates._station.home).read()
    assert kept.rows["aa" * 10].result == "updated"


def test_what_fails_as_the_service_ends_is_no_result_and_what_went_well_is(bench: Bench) -> None:
    rows = {name: BoardRow(name * 10, state="running") for name in ("aa", "bb", "cc")}
    action = bench.action(*rows.values())
    bench.updates.stop()
    done = [
        Finished("aa" * 10, BoardUpdate(b"", "lost", None, 0, 1.0, LinkError("Closed."))),
        Finished("cc" * 10, BoardUpdate(b"", "updated", "1.0.0", 512, 2.5)),
        Finished("bb" * 10, OSError()),
    ]
    bench.updates._follow(action, cast(Any, SimpleNamespace(results=lambda: iter(done))))
    assert [row.result for row in action.rows.values()] == [None, None, "updated"]
    assert (action.state, action.ended, bench.log) == ("running", None, [])


def test_a_second_update_is_refused_with_who_updates_how_many_and_how_far(bench: Bench) -> None:
    rows = {"a": BoardRow("aa", result="updated"), "b": BoardRow("bb", result="lost"), "c": BoardRow("cc")}
    bench.updates._actions["a0"] = bench.action(BoardRow("ee"), name="a0", state="done")
    bench.updates._require_none()
    bench.updates._actions["a1"] = bench.action(*rows.values())
    with pytest.raises(NodeBusyError) as busy:
        bench.updates._require_none()
    assert busy.value.message == "api:robot is updating 3 boards to 1.1.0 (2 of them done)."
    assert busy.value.hint == "Wait until that is over: /updates/a1."
    for ask in (bench.updates.get, bench.updates.cancel):
        with pytest.raises(NotFoundError, match="No update has the ID 'zz'"):
            ask("zz")


def test_a_cancel_of_an_update_that_is_over_changes_nothing(bench: Bench) -> None:
    bench.updates._actions["a1"] = bench.action(BoardRow(NODE), state="done")
    bench.updates._work = cast(Any, SimpleNamespace(drop_waiting=lambda: pytest.fail("the work of another update")))
    assert bench.updates.cancel("a1")["boards"][0]["state"] == "waiting"
    assert bench.events == []


PLAN = SimpleNamespace(
    report=SimpleNamespace(version=(1, 0, 0), build=0, text="virtual/finger"),
    stage="upload", octets=66_233, seconds=3.25, interrupts=("m1",), question="Another board?",
)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "raised", "locked"),
    [
        ({}, None, True),
        ({"whitelisted": False}, PolicyError("It is not on the whitelist."), False),
        ({"held": [2, 3]}, PolicyError("Actuator 2 of the board is in use; the restart would end that."), False),
        ({"trusted": SimpleNamespace(node=SimpleNamespace(sealed=True))}, None, False),
        ({"trusted": SimpleNamespace(node=SimpleNamespace(sealed=False))}, None, True),
        ({"trusted": SessionLostError(LinkError("Silent."))}, LinkError("Silent."), False),
        ({"port": None}, NoNodeError(f"Node {NODE} is on no bus of this station."), False),
        ({"plan": ("m1",)}, FrozenError(f"Node {NODE} is being measured by m1."), True),
    ],
    ids=["free", "whitelist", "held", "measured", "no session now", "session lost", "no bus", "by another process"],
)
def test_a_plan_is_made_in_the_session_of_a_measured_board_and_of_another_one_by_itself(
    change: dict[str, Any],
    raised: TedsProvisionError | None,
    locked: bool,
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here, there = object(), SimpleNamespace(interrupts=change.get("plan", ()))
    vars(bench).update(change)
    timeouts: list[float] = []

    def plan_at(*_words: Any, timeout: float) -> Any:
        timeouts.append(timeout)
        return there

    monkeypatch.setattr(updates, "plan_in", lambda *_words: here)
    monkeypatch.setattr(updates, "plan_at", plan_at)
    if raised is not None:
        with pytest.raises(type(raised)) as refused:
            bench.updates._planned(NODE, cast(Any, None))
        assert refused.value.message == raised.message
    else:
        assert bench.updates._planned(NODE, cast(Any, None)) is (there if locked else here)
    assert bench.locked == ([(NODE, "its update is planned")] if locked else [])
    assert timeouts == ([20.0] if locked else [])


@pytest.mark.parametrize(
    ("found", "row"),
    [
        (PLAN, {"result": None, "plan": "upload", "octets": 66_233, "error": None}),
        (SimpleNamespace(**{**vars(PLAN), "stage": "nothing"}), {"result": "already", "plan": "nothing"}),
        (LinkError("Silent."), {"result": "lost", "plan": None, "octets": 0}),
        (PolicyError("No."), {"result": "refused", "plan": None}),
        (ZeroDivisionError(), {"result": "refused", "plan": None}),
    ],
    ids=["upload", "nothing", "lost", "refused", "a bug"],
)
def test_a_plan_names_for_each_board_what_is_to_be_done_or_why_not(
    found: Any, row: dict[str, Any], bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = SimpleNamespace(version_text="1.1.0", digest=b"\xab", board="b", octets=b"xyz", security_counter=7)
    monkeypatch.setattr(updates, "_image_of", lambda _octets: image)

    def planned(_uuid: str, _order: Any) -> Any:
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(bench.updates, "_planned", planned)
    plan = bench.updates.plan(b"x", UpdateRequest((NODE, OTHER), allow_downgrade=True, parallel=2), owner="page")
    assert (plan["id"], plan["state"], plan["owner"], plan["ended"] is not None) == (None, "planned", "page", True)
    assert plan["image"] == {"version": "1.1.0", "digest": "ab", "board": "b", "octets": 3, "security_counter": 7}
    assert (plan["allow_downgrade"], plan["parallel"]) == (True, 2)
    assert [board["uuid"] for board in plan["boards"]] == [NODE, OTHER]
    for board in plan["boards"]:
        assert (board["state"], board["to"]) == ("planned", "1.1.0")
        assert {name: board[name] for name in row} == row
        if found is PLAN:
            shown = {name: board[name] for name in ("from", "board", "seconds", "interrupts", "question")}
            assert shown == {
                "from": "1.0.0", "board": "virtual/finger", "seconds": 3.25, "interrupts": ["m1"],
                "question": "Another board?",
            }  # fmt: skip
        elif isinstance(found, Exception):
            assert board["error"]["message"] == (getattr(found, "message", "Unexpected ZeroDivisionError."))
    assert (bench.updates.all(), bench.log, bench.events) == ([], [], [])
    with pytest.raises(UsageError, match="No board is named"):
        bench.updates.plan(b"x", UpdateRequest(()), owner="page")


@pytest.mark.parametrize(
    ("trusted", "held", "raised"),
    [
        (None, [], None),
        (SimpleNamespace(node=SimpleNamespace(sealed=True)), [], PolicyError),
        (SimpleNamespace(node=SimpleNamespace(sealed=False)), [], None),
        (FrozenError("It is suspended."), [], None),
        (SessionLostError(LinkError("Silent.")), [], LinkError),
        (None, [1], PolicyError),
    ],
)
def test_a_board_whose_actuator_somebody_holds_is_not_let_go(
    trusted: Any, held: list[int], raised: type[Exception] | None, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a request (``held``) or by a topic, in the session in which the board is measured."""
    bench.trusted, bench.held = trusted, held

    def require_free_actuators(_node: Any) -> None:
        raise PolicyError("A topic moves it.")

    monkeypatch.setattr(updates, "require_free_actuators", require_free_actuators)
    alone = bench.updates._alone(bytes.fromhex(NODE))
    with pytest.raises(raised) if raised is not None else nullcontext(), alone as lent:
        assert lent
    assert bench.locked == ([] if raised is not None else [(NODE, "let go for update")])


def test_the_upload_to_a_board_is_shown_twice_a_second_at_most(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(updates, "time", SimpleNamespace(monotonic=lambda: now[0]))
    row, other = BoardRow(NODE), BoardRow(OTHER)
    action = bench.action(row, other)
    reporter = updates._RowReporter(
        row, lambda: bench.updates._publish_progress(action, row), lambda: bench.updates._publish(action, row)
    )
    reporter.started("upload")
    for at, written in ((0.0, 10), (0.25, 20), (0.5, 30), (0.75, 40)):
        now[0] = at
        reporter.written(written, 99)
        bench.updates._publish_progress(action, other)
    shown = [(facts["uuid"][:2], facts["board"]["step"], facts["board"]["written"]) for _, facts in bench.events]
    assert [one for one in shown if one[0] == "ab"] == [("ab", "upload", 0), ("ab", "upload", 10), ("ab", "upload", 30)]
    assert [one[0] for one in shown].count("cd") == 2
    assert (row.written, row.octets) == (40, 99)


def test_a_board_that_is_on_no_bus_is_waited_for_a_minute_and_no_longer_than_the_service(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, there = [1000.0], bench.port
    bench.port = None

    def wait(seconds: float) -> bool:
        now[0] += seconds
        if now[0] >= come:
            bench.port = there
        return ends

    monkeypatch.setattr(updates, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(bench.updates, "_closing", SimpleNamespace(wait=wait))
    come, ends = 1059.0, False
    assert bench.updates._waited_for(NODE) is there
    now[0], come, bench.port = 1000.0, 9999.0, None
    with pytest.raises(NoNodeError) as absent:
        bench.updates._waited_for(NODE)
    assert now[0] == pytest.approx(1060.0, abs=0.11)
    assert absent.value.hint == "Connect it to the bus. At a reader, the command update takes it."
    now[0], ends = 1000.0, True
    with pytest.raises(NoNodeError):
        bench.updates._waited_for(NODE)
    assert now[0] < 1001.0
    slots = bench.updates._slot(there)
    assert [slots.acquire(blocking=False) for _ in range(3)] == [True, True, False], "as many as the link carries"
    assert bench.updates._slot(there) is slots
    assert bench.updates._slot(cast(Any, SimpleNamespace(**{**vars(there), "place": "can:y"}))) is not slots


def test_images_lie_in_a_folder_of_this_user_alone(tmp_path: Path, bench: Bench) -> None:
    folder = UpdateFolder(tmp_path / "home")
    (tmp_path / "home").mkdir()
    action = bench.action(BoardRow(NODE))
    folder.keep_new(action, b"image")
    assert stat.S_IMODE((tmp_path / "home" / "updates").stat().st_mode) == 0o700
    for name in ("a1.image", "a1.json"):
        assert stat.S_IMODE((tmp_path / "home" / "updates" / name).stat().st_mode) == 0o600
    (tmp_path / "home" / "updates").chmod(0o755)
    with pytest.raises(StoreError) as refused:
        folder.keep_new(action, b"image")
    assert refused.value.hint == "Give this user the folder alone, mode 0700."
    folder.forget(action)
    assert list((tmp_path / "home" / "updates").iterdir()) == []


def test_a_state_that_cannot_be_kept_ends_no_update_and_is_in_the_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder, action = UpdateFolder(bench.updates._station.home), bench.action(BoardRow(NODE))
    folder.keep_new(action, b"image")

    def full(*_words: Any) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(update_actions, "write_whole", full)
    folder.keep(action)
    assert caplog.messages == ["How the update goes cannot be kept: The disk is full."]


def test_a_record_that_is_none_is_left_out_and_what_is_kept_comes_back_whole(bench: Bench) -> None:
    home = bench.updates._station.home
    folder = UpdateFolder(home)
    for name, began in (("b2", 2.0), ("a1", 2.0), ("c3", 1.0)):
        request = UpdateRequest((NODE, OTHER), frozenset({OTHER, NODE}), allow_downgrade=True, parallel=4, wait=9.0)
        action = bench.action(BoardRow(NODE, result="lost"), BoardRow(OTHER), name=name, began=began)
        action.request = request
        folder.keep(action)
        found = next(one for one in folder.read() if one.id == name)
        assert found == action
    good = json.loads((home / FOLDER / "a1.json").read_text())
    for name, text in (
        ("0", "no JSON"), ("x1", "[]"), ("x2", json.dumps({**good, "format": "ncap-update/2", "id": "x2"})),
        ("x3", json.dumps({**good, "more": 1, "id": "x3"})), ("copy", json.dumps(good)),
    ):  # fmt: skip
        (home / FOLDER / f"{name}.json").write_text(text)
    assert [action.id for action in folder.read()] == ["c3", "a1", "b2"], "the oldest first, then by ID"


def test_an_image_that_is_another_one_than_was_asked_for_is_not_installed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, action = UpdateFolder(bench.updates._station.home), bench.action(BoardRow(NODE))
    folder.keep_new(action, b"image")
    read: Any = SimpleNamespace(digest=b"\xab")
    same: Any = folder.image_of
    monkeypatch.setattr(update_actions, "read_firmware_image", lambda octets: read if octets == b"image" else None)
    assert same(action) is read
    read.digest = b"\xac"
    with pytest.raises(BadDataError, match="is another one"):
        folder.image_of(action)


def test_an_update_is_in_the_log_with_what_was_allowed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    image = SimpleNamespace(version_text="1.1.0", digest=b"\xab", board="b", octets=b"xyz", security_counter=7)
    begun: list[str] = []
    monkeypatch.setattr(updates, "_image_of", lambda _octets: image)
    monkeypatch.setattr(bench.updates, "_begin", lambda action, _image: begun.append(action.id))
    facts = {"to": "1.1.0", "image": "ab", "boards": 2}
    for more, allowed in (
        ({}, {}),
        ({"allow_downgrade": True}, {"allow_downgrade": True}),
        ({"other_board": frozenset({OTHER, NODE})}, {"other_board": [NODE, OTHER]}),
    ):
        action = bench.updates.begin(b"x", UpdateRequest((NODE, OTHER), **cast(Any, more)), owner="page")
        assert (action["state"], action["owner"], len(action["id"])) == ("running", "page", 8)
        assert bench.log.pop()[2:] == ("begun", None, {"id": action["id"], **facts, **allowed})
        with pytest.raises(NodeBusyError):
            bench.updates.begin(b"x", UpdateRequest((NODE,)), owner="page")
        bench.updates._actions[action["id"]].state = "done"
    assert begun == [action["id"] for action in reversed(bench.updates.all())]

    def full(*_words: Any, **_facts: Any) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(bench.updates._station, "audit", full)
    before = sorted(path.name for path in (bench.updates._station.home / FOLDER).iterdir())
    with pytest.raises(StoreError):
        bench.updates.begin(b"x", UpdateRequest((NODE,)), owner="page")
    assert sorted(path.name for path in (bench.updates._station.home / FOLDER).iterdir()) == before
    assert len(bench.updates.all()) == 3


def test_each_board_gets_the_order_that_was_given_for_it(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever allowed the image on one board that it does not name did not allow it on the others."""
    given: list[Any] = []

    def update_at(_station: Any, port: Any, uuid: bytes, order: Any, _reporter: Any, **more: Any) -> BoardUpdate:
        assert (port, more["timeout"], more["release"]) == (bench.port, 60.0, bench.updates._alone)
        given.append((uuid.hex(), order.other_board, order.allow_downgrade, order.wait, action.rows[uuid.hex()].state))
        return BoardUpdate(uuid, "updated", "1.0.0", 1, 1.0)

    monkeypatch.setattr(updates, "update_at", update_at)
    action = bench.action(BoardRow(NODE), BoardRow(OTHER))
    action.request = UpdateRequest((NODE, OTHER), frozenset({OTHER}), allow_downgrade=True, wait=9.0)
    image = cast(Any, object())
    assert [bench.updates._update(action, image, uuid).result for uuid in (NODE, OTHER)] == ["updated", "updated"]
    assert given == [(NODE, False, True, 9.0, "running"), (OTHER, True, True, 9.0, "running")]
    shown = [(facts["uuid"], facts["board"]["state"]) for _, facts in bench.events]
    assert shown == [(NODE, "running"), (OTHER, "running")]
    [kept] = UpdateFolder(bench.updates._station.home).read()
    assert [row.state for row in kept.rows.values()] == ["running", "running"], "a restart finds it so"
    bench.whitelisted = False
    refused = bench.updates._update(action, image, NODE)
    assert (refused.result, refused.before, refused.error and refused.error.code) == ("refused", None, "refused")
    assert len(given) == 2


def test_without_an_image_or_a_package_nothing_is_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BadDataError) as refused:
        updates._image_of(b"")
    assert refused.value.message == "The request contains no image."
    assert refused.value.hint == "Send the file that imgtool sign wrote as the body."
    for missing in ("imgtool", "smp"):
        monkeypatch.setattr(updates, "is_installed", lambda module, missing=missing: module != missing)
        with pytest.raises(NotFoundError, match=f"Firmware updates need the package {missing}") as needed:
            updates._image_of(b"x")
        assert "[update]" in needed.value.hint


def test_a_start_without_an_update_that_was_cut_begins_none(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.updates, "_begin", lambda *_words: pytest.fail("nothing was cut"))
    bench.updates.start()
    assert bench.updates.all() == []
    UpdateFolder(bench.updates._station.home).keep_new(bench.action(BoardRow(NODE), state="done"), b"image")
    bench.updates.start()
    assert [action["state"] for action in bench.updates.all()] == ["done"]
    assert [path.name for path in (bench.updates._station.home / FOLDER).iterdir()] == ["a1.json"]


@pytest.mark.parametrize(
    ("ended", "now", "seconds"), [(None, 112.34567, 12.346), (105.5, 112.0, 5.5), (None, 90.0, 0.0)]
)
def test_an_update_lasts_until_its_end_or_until_now(
    ended: float | None, now: float, seconds: float, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that was set back makes it no shorter than nothing."""
    monkeypatch.setattr(update_actions, "time", SimpleNamespace(time=lambda: now))
    row = BoardRow(NODE, seconds=1.23456, result="updated", before="1.0.0", step=None)
    action = bench.action(row, BoardRow(OTHER, result="updated"), BoardRow("ef" * 10), began=100.0)
    action.ended, action.id = ended, ""
    shown = action.as_json()
    assert shown["totals"] == {
        "updated": 2, "already": 0, "reverted": 0, "refused": 0, "lost": 0, "seconds": seconds,
    }  # fmt: skip
    assert (shown["id"], shown["began"], shown["ended"]) == (None, 100.0, ended)
    assert shown["boards"][0] == {
        "uuid": NODE, "from": "1.0.0", "to": "1.1.0", "state": "waiting", "board": None, "plan": None, "octets": 0,
        "seconds": 1.235, "interrupts": [], "question": "", "step": None, "written": 0, "result": "updated",
        "error": None,
    }  # fmt: skip


@pytest.mark.parametrize("where", ["in the session of a measurement", "on the bus"])
def test_a_plan_that_loses_its_session_ends_with_the_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    cause, made = NoNodeError("It is silent."), updates_of(tmp_path)

    def lose(*_: Any, **__: Any) -> Any:
        raise SessionLostError(cause)

    measured = where != "on the bus"
    trusted = SimpleNamespace(node=SimpleNamespace(sealed=True)) if measured else None
    words: Any = made
    words._station = SimpleNamespace(policy=SimpleNamespace(require_whitelisted=lambda _uuid: None))
    words._measured, words._bus_of = lambda _uuid: nullcontext(trusted), lambda _uuid: object()
    words._require_unheld, words._slot = lambda _uuid: None, lambda _port: nullcontext()
    words._node_locks = SimpleNamespace(hold=lambda _uuid, _what: nullcontext())
    monkeypatch.setattr(updates, "plan_in", lose if measured else None)
    monkeypatch.setattr(updates, "plan_at", None if measured else lose)
    with pytest.raises(NoNodeError) as lost:
        made._planned(NODE, cast(Any, None))
    assert lost.value is cause


def test_a_full_disk_at_the_end_of_an_update_hides_no_result_and_a_bug_is_in_the_log(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_words: Any, **_facts: Any) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(bench.updates._station, "audit", full)
    action, bug = bench.action(BoardRow(NODE, state="running")), ZeroDivisionError("bug")
    done = [Finished(NODE, bug)]
    bench.updates._follow(action, cast(Any, SimpleNamespace(results=lambda: iter(done))))
    assert (action.state, action.rows[NODE].result) == ("done", "refused")
    assert [facts["state"] for _, facts in bench.events] == ["running", "running", "done"]
    [record] = [record for record in caplog.records if record.name == updates.__name__]
    assert record.getMessage() == f"Updating node {NODE} failed."
    assert record.exc_info is not None
    assert record.exc_info[1] is bug


def test_as_many_boards_are_planned_at_once_as_was_asked_for(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    image = SimpleNamespace(version_text="1.1.0", digest=b"d", board=None, octets=b"x", security_counter=None)
    monkeypatch.setattr(updates, "_image_of", lambda _octets: image)
    monkeypatch.setattr(bench.updates, "_planned", lambda _uuid, _order: PLAN)
    asked, work_of = list[tuple[int, int]](), updates.ParallelWork

    def work(items: Any, do: Any, *, at_once: int, name: str) -> Any:
        asked.append((len(items), at_once))
        return work_of(items, do, at_once=at_once, name=name)

    monkeypatch.setattr(updates, "ParallelWork", work)
    bench.updates.plan(b"x", UpdateRequest((NODE, OTHER, "ef" * 10), parallel=2), owner="page")
    assert asked == [(3, 2)]


def test_a_board_is_free_if_nobody_holds_an_actuator_of_its_measurement(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is suspended gets no set points from a topic, and one without a session has none to ask in."""
    asked: list[Any] = []
    monkeypatch.setattr(updates, "require_free_actuators", asked.append)
    node = SimpleNamespace(sealed=True)
    for trusted in (None, FrozenError("It is suspended."), SimpleNamespace(node=SimpleNamespace(sealed=False))):
        bench.trusted = trusted
        bench.updates.require_free(NODE)
    assert asked == []
    bench.trusted = SimpleNamespace(node=node)
    bench.updates.require_free(NODE)
    assert asked == [node]
    silent = LinkError("Silent.")
    bench.trusted = SessionLostError(silent)
    with pytest.raises(LinkError) as lost:
        bench.updates.require_free(NODE)
    assert lost.value is silent
    bench.trusted, bench.held = None, [2]
    with pytest.raises(PolicyError, match="Actuator 2 of the board is in use"):
        bench.updates.require_free(NODE)
