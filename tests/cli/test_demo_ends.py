"""The demo runs to its end in a process of its own, and leaves nothing behind, however it is ended."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.demo import page, story
from teds_provision.errors import LinkError, TedsProvisionError
from teds_provision.provisioning.progress import SilentReporter, Steps

from .shell import clean_environment


@pytest.mark.link
def test_the_whole_story_as_make_demo_starts_it(tmp_path: Path) -> None:
    """Start an interpreter: what the demo loads late, by name, is loaded by no process that forks."""
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", "--json", "demo"],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
        env=clean_environment(TMPDIR=str(tmp_path)),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    record = json.loads(done.stdout)
    assert record["verdict"] == "authentic"
    assert {"import-keys", "verify", "measure", "set"} <= {step["name"] for step in record["steps"]}
    assert list(tmp_path.iterdir()) == []


OTHER_SIGNAL = pytest.mark.nightly(
    "tests/cli/test_demo_ends.py::test_an_ended_demo_takes_its_node_and_its_folder_away[15] ends by the same way"
)


@pytest.mark.link
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=OTHER_SIGNAL)])
def test_an_ended_demo_takes_its_node_and_its_folder_away(tmp_path: Path, number: signal.Signals) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "teds_provision", "demo"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=clean_environment(TMPDIR=str(tmp_path)),
    )
    try:
        until = time.monotonic() + 60
        while not list(tmp_path.glob("*/node-flash/lock")):  # the node runs
            assert time.monotonic() < until
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        process.communicate(timeout=60)  # ends only when the node, which has the same stdout or none, lets go
    finally:
        process.kill()
    assert process.returncode == 130
    assert list(tmp_path.iterdir()) == []


# -- the page's demo, in this process ----------------------------------------------------------------------------------

REFUSED = b'{"error": {"code": "store", "message": "The disk is full.", "hint": "Free some space."}}\n'


@pytest.mark.parametrize(
    ("output", "message", "hint"),
    [
        (REFUSED, "The disk is full.", "Free some space."),
        (b"Traceback", "The base station of the demo did not start.", ""),
        (b"", "The base station of the demo did not start.", ""),
    ],
)
def test_a_demo_that_cannot_begin_says_what_its_station_said(output: bytes, message: str, hint: str) -> None:
    error = page._failure(output)
    assert (error.message, error.hint) == (message, hint)


@pytest.mark.parametrize(
    ("output", "message", "hint"),
    [
        (REFUSED.decode(), "It failed: The disk is full.", "Free some space."),
        ("Traceback\n", "It failed: Traceback", ""),
        ("", "It failed: no answer", ""),
    ],
)
def test_a_node_of_the_demo_that_does_not_start_says_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, output: str, message: str, hint: str
) -> None:
    error = story._failure("It failed", output)
    assert (error.message, error.hint) == (message, hint)
    demo: Any = SimpleNamespace(folder=tmp_path)
    asked: list[list[str]] = []

    def run(words: list[str], **_how: Any) -> Any:
        asked.append(words[3:])
        return SimpleNamespace(returncode=len(asked) - 1, stdout=output)

    monkeypatch.setattr(story.subprocess, "run", run)
    assert story.make_node(demo, "oven", "load-cell") == tmp_path / "oven-flash"
    words = ["--json", "node", "create", str(tmp_path / "oven-flash"), "--profile", "load-cell"]
    with pytest.raises(LinkError, match=message.replace("It failed", "The virtual node could not be made")):
        story.make_node(demo, "oven", "load-cell")
    assert asked == [words, words]


@pytest.mark.parametrize(
    ("line", "uuid"),
    [
        ('{"uuid": "0102030405060708090a", "ready": true}\n', bytes(range(1, 11))),
        (REFUSED.decode(), None),
        ("[1]\n", None),
        ('{"uuid": 7}\n', None),
        ("", None),
    ],
)
def test_a_node_of_the_demo_is_ready_once_it_has_printed_its_uuid(line: str, uuid: bytes | None) -> None:
    read, write = os.pipe()
    os.write(write, line.encode())
    os.close(write)
    with open(read, encoding="utf-8") as output:
        process: Any = SimpleNamespace(stdout=output)
        if uuid is not None:
            assert story._ready(process) == uuid
        else:
            with pytest.raises(LinkError, match="The virtual node did not start: "):
                story._ready(process)


class Child:
    """Mock process that prints the given lines; ``ends``: it exits on a signal."""

    def __init__(self, patch: pytest.MonkeyPatch, output: bytes, *, ends: bool = True, over: bool = False) -> None:
        self.output, self.ends, self.over, self.course = output, ends, over, list[str]()
        self.words, self.secret = list[str](), ""
        patch.setattr(page.subprocess, "Popen", self.begin)

    def begin(self, words: list[str], *, stdout: Any, pass_fds: tuple[int, ...], process_group: int, **_: Any) -> Child:
        assert process_group == 0, "Ctrl-C reaches the demo alone"
        self.words, self.secret = words[3:], os.read(pass_fds[0], 100).decode()
        stdout.write(self.output)
        stdout.flush()
        return self

    def poll(self) -> int | None:
        return 0 if self.over else None

    def terminate(self) -> None:
        self.course.append("terminate")

    def kill(self) -> None:
        self.course.append("kill")

    def wait(self, timeout: float | None = None) -> None:
        self.course.append(f"wait {timeout}")
        if timeout is not None and not self.ends:
            raise subprocess.TimeoutExpired("ncap", timeout)


@pytest.mark.parametrize("ends", [True, False])
def test_the_demos_station_gets_its_secret_by_a_descriptor_and_ends_with_the_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    child = Child(monkeypatch, b'{"ready": true}\nmore', ends=ends)
    with page._daemon(tmp_path, "words", "--http", "127.0.0.1:1"):
        assert child.course == []
    *words, given, command, verb, option, where = child.words
    assert words == ["--home", str(tmp_path), "--json", "--passphrase-fd"]
    assert (given.isdigit(), command, verb, option, where) == (True, "ncap", "run", "--http", "127.0.0.1:1")
    assert child.secret == "words\n"
    assert child.course == ["terminate", "wait 15.0", *([] if ends else ["kill", "wait None"])]


@pytest.mark.parametrize("case", ["refused", "ended", "late"])
def test_a_station_of_the_demo_that_does_not_start_ends_the_demo_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    child = Child(monkeypatch, REFUSED if case == "refused" else b"", over=case == "ended")
    now = [100.0]
    sleep = lambda seconds: now.append(now[-1] + 40.0)  # noqa: E731
    monkeypatch.setattr(page, "time", SimpleNamespace(monotonic=lambda: now[-1], sleep=sleep))
    with pytest.raises(TedsProvisionError) as failed, page._daemon(tmp_path, "words"):
        pytest.fail("it did not start")
    assert failed.value.message == (
        "The disk is full." if case == "refused" else "The base station of the demo did not start."
    )
    assert (child.course, now[-1]) == (["terminate", "wait 15.0"], 180.0 if case == "late" else 100.0)


@pytest.mark.parametrize("late", [False, True])
def test_the_demos_transducers_are_measured_as_one_group_once_they_are_authentic(
    monkeypatch: pytest.MonkeyPatch, late: bool
) -> None:
    asked, now = list[Any](), [100.0]
    verdicts = iter([None, {"verdict": "unsigned"}, *[{"verdict": "authentic"}] * 9])

    class Api:
        def request(self, method: str, path: str, body: dict[str, Any]) -> dict[str, str]:
            asked.append((method, path, body))
            return {"uuid": f"{len(asked):020x}"}

        def node(self, uuid: str) -> dict[str, Any]:
            return {"verdict": None if late else next(verdicts)}

        def measure(self, **how: Any) -> None:
            asked.append(how)

    sleep = lambda seconds: now.append(now[-1] + 25.0)  # noqa: E731
    monkeypatch.setattr(page, "time", SimpleNamespace(monotonic=lambda: now[-1], sleep=sleep))
    api: Any = Api()
    if late:
        with pytest.raises(LinkError, match="The virtual transducers were not ready within 60 s"):
            page._measured(api)
        assert now[-1] == 175.0, "the first look after a minute"
        return
    page._measured(api)
    uuids = [f"{number:020x}" for number in (1, 2, 3)]
    *made, group, measured = asked
    assert [(method, path, body["name"]) for method, path, body in made] == [
        ("POST", "/virtual", name) for name in ("slew angle", "boom", "hand")
    ]
    assert group == ("POST", "/groups", {"name": "crane", "uuids": uuids})
    assert (measured, now[-1]) == ({"group": "crane", "rate": 50.0}, 150.0)


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("http", [None, "127.0.0.1:8351"])
def test_the_demo_of_the_page_says_where_it_is_and_what_to_type_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, http: str | None, fails: bool
) -> None:
    said, ran, served = list[str](), list[Any](), list[Any]()

    @contextmanager
    def daemon(home: Path, secret: str, *options: str) -> Iterator[None]:
        served.append((home, secret, options))
        yield

    def run(words: list[str], **_how: Any) -> Any:
        ran.append(words[3:])
        return SimpleNamespace(returncode=int(fails), stdout=REFUSED)

    api = SimpleNamespace(login_url=lambda: "http://127.0.0.1:8351/login?once")
    monkeypatch.setattr(page, "_daemon", daemon)
    monkeypatch.setattr(page.client, "connect", lambda home: nullcontext(api))
    measured: list[Any] = []
    monkeypatch.setattr(page, "_measured", measured.append)
    monkeypatch.setattr(page.subprocess, "run", run)
    monkeypatch.setattr(page.tempfile, "mkdtemp", lambda prefix: str((tmp_path / prefix).mkdir() or tmp_path / prefix))
    folder = tmp_path / "teds-provision-page-"
    ending = pytest.raises(TedsProvisionError, match="The disk is full") if fails else nullcontext()
    with ending, page.page_demo(said.append, http) as demo:
        [(home, secret, options)] = served
        assert (demo.home, home, demo.url) == (folder / "home", folder / "home", api.login_url())
        assert (home / "store.sqlite3").exists()
        assert (len(secret), options[0], options[2]) == (32, "--http", "--nfc")
        assert options[1] == http if http else options[1].startswith("127.0.0.1:")
        assert demo.tap == f"teds-provision node run {folder / 'oven'} --nfc {options[3]}"
    profile = ["--profile", "temperature-sensor", "--name", "oven"]
    assert ran == [["--json", "node", "create", str(folder / "oven"), *profile]]
    assert (len(said), folder.exists(), measured) == (2, False, [api])


# -- the story's steps, without nodes ----------------------------------------------------------------------------------


def demo_in(folder: Path, **facts: Any) -> Any:
    """Return a demo whose steps are real and whose links lead nowhere."""
    return SimpleNamespace(
        folder=folder, uuid=bytes(10), can="virtual:demo", reporter=None, over=lambda via: via,
        steps=Steps(SilentReporter()), **facts,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("taken_before", "rotated", "reached"),
    [(False, False, True), (False, True, True), (True, True, True), (False, False, False)],
)
def test_the_story_says_to_whom_a_key_is_sealed_and_stops_where_the_node_was_not_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taken_before: bool, rotated: bool, reached: bool
) -> None:
    first, second = (SimpleNamespace(name=name, fingerprint=digits * 32) for name, digits in (("a", "aa"), ("b", "bb")))
    (tmp_path / "move.jwe").write_bytes(b"sealed")
    taken = story.ImportResult.__new__(story.ImportResult)
    object.__setattr__(taken, "receipt", b"receipt")
    object.__setattr__(taken, "row", SimpleNamespace(body="{}", id="7"))
    imported: Any = SimpleNamespace(receipt=b"receipt", uuids=[bytes(10)])
    proof = story.NodeProof.__new__(story.NodeProof)
    object.__setattr__(proof, "rotated", rotated)
    outcome: Any = proof if reached else SimpleNamespace(why="It is away.")
    closed: list[Any] = []
    monkeypatch.setattr(story.ImportResult, "uuids", [bytes(10)], raising=False)
    monkeypatch.setattr(story, "plan_export", lambda _station, order: order)
    monkeypatch.setattr(story, "export_bundle", lambda _station, order, path: SimpleNamespace(octets=len(order.mode)))
    monkeypatch.setattr(story, "plan_import", lambda _station, _octets: taken if taken_before else "plan")
    monkeypatch.setattr(story, "import_bundle", lambda _station, _plan: imported)
    monkeypatch.setattr(story, "prove_nodes", lambda _station, *_words: [outcome])
    monkeypatch.setattr(story, "close", lambda station, receipt: closed.append((station.name, receipt)))
    demo = demo_in(tmp_path)
    if not reached:
        with pytest.raises(LinkError, match=r"^The node was not reached after the import: It is away\.$"):
            story._send(demo, first, second, "move")  # type: ignore[arg-type]
        assert closed == []
        return
    story._send(demo, first, second, "move")  # type: ignore[arg-type]
    assert [(step.name, step.detail) for step in demo.steps.done] == [
        ("export-keys", f"move: 4 octets, sealed to {'bb' * 8}"),
        ("import-keys", f"proven in a session{', key rotated, the sender is locked out' if rotated else ''}"),
        ("receipt", "a has b's signed receipt"),
    ]
    assert closed == [("a", b"receipt")]


@pytest.mark.parametrize("error", [None, LinkError("The bus is off.")])
def test_a_measurement_of_the_story_that_fails_ends_it_and_its_bus_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception | None
) -> None:
    closed: list[str] = []
    streams = [{"samples": 30, "lost": 1}, {"samples": 12, "lost": 2}]
    ended = SimpleNamespace(error=error, nodes=[{"streams": streams[:1]}, {"streams": streams[1:]}])
    made: list[Any] = []
    monkeypatch.setattr(story, "open_port", lambda _can: SimpleNamespace(close=lambda: closed.append("port")))
    monkeypatch.setattr(story.sinks, "open_sink", lambda name: name)
    monkeypatch.setattr(story.buses_room, "Buses", lambda _ports: nullcontext("buses"))
    monkeypatch.setattr(
        story.measurement, "Measurement",
        lambda *words: made.append(words)
        or SimpleNamespace(run=lambda stop, seconds: made.append((stop.is_set(), seconds)) or ended),
    )  # fmt: skip
    monkeypatch.setattr(story, "_last_row", lambda file: f"row of {file.name}")
    groups: list[Any] = []
    station: Any = SimpleNamespace(name="a", groups=SimpleNamespace(create=lambda *words: groups.append(words)))
    demo, uuids = demo_in(tmp_path), (bytes(10), bytes(range(10)))
    if error is not None:
        with pytest.raises(LinkError, match="The bus is off"):
            story.measure_group(demo, station, uuids)
        assert (closed, demo.steps.done) == (["port"], [])
        return
    story.measure_group(demo, station, uuids)
    [step] = demo.steps.done
    assert (step.name, step.detail) == ("measure", "group robot, 2 nodes: 42 values, 3 lost; last row of run.csv")
    assert (closed, groups, made[0][5].group) == (["port"], [("robot", list(uuids))], "robot")
    _station, _buses, measured, asked, files, _facts = made[0]
    assert (measured, asked.rate, asked.timeout, files) == (uuids, 100.0, 15.0, [str(tmp_path / "run.csv")])
    assert made[1] == (False, 1.0)


def test_the_newest_value_of_each_column_with_a_unit_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    file.write_text(
        "# head\ntime,hand/opening [m],hand/force [N],arm/angle [°],note\n1,0.01,,,x\n2,0.04,2.34567,,y\n3,,,,z\n"
    )
    assert story._last_row(file) == "opening 0.04 m, force 2.346 N, angle none"


@pytest.mark.parametrize("ends", [True, False])
def test_a_node_of_the_story_ends_with_its_block_and_is_killed_if_it_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    course: list[Any] = []

    def wait(seconds: float | None = None) -> None:
        course.append(("wait", seconds))
        if seconds is not None and not ends:
            raise subprocess.TimeoutExpired("node", seconds)

    process = SimpleNamespace(
        terminate=lambda: course.append("terminate"), kill=lambda: course.append("kill"), wait=wait
    )
    monkeypatch.setattr(story.subprocess, "Popen", lambda words, **_how: course.append(words[3:]) or process)
    monkeypatch.setattr(story, "_ready", lambda _process: b"uuid")
    with story.run_node(tmp_path, "--nfc", "udp:1") as uuid:
        assert uuid == b"uuid"
        assert len(course) == 1
    assert course == [
        ["--json", "node", "run", str(tmp_path), "--nfc", "udp:1"],
        "terminate",
        ("wait", 5.0),
        *([] if ends else ["kill", ("wait", None)]),
    ]


def test_both_nodes_of_the_story_are_measured_as_one_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []
    gripper = bytes(range(10))
    monkeypatch.setattr(story, "calibrations", lambda _folder: {"gripper": "g.toml", "angle": "a.csv"})
    monkeypatch.setattr(story, "virtual_node", lambda _demo, *words: nullcontext(gripper))
    for name in ("provision_gripper", "calibrate_sensor", "measure_group", "move_gripper"):
        monkeypatch.setattr(story, name, lambda _demo, _station, *words, name=name: course.append((name, *words)))
    demo = demo_in(tmp_path, stack=ExitStack())
    story._measure(demo, None)  # type: ignore[arg-type]
    assert course == [
        ("provision_gripper", gripper, "g.toml"),
        ("calibrate_sensor", "a.csv"),
        ("measure_group", (demo.uuid, gripper)),
        ("move_gripper", gripper),
    ]


@pytest.mark.parametrize("mode", [0o700, 0o755])
def test_the_folder_of_a_demo_has_its_mode_and_is_gone_however_it_ends(mode: int) -> None:
    closed: list[str] = []
    folders: list[Path] = []

    def fail() -> None:
        with story.temporary_demo(SilentReporter(), lambda _text: None, mode=mode) as demo:
            folders.append(demo.folder)
            assert demo.folder.stat().st_mode & 0o777 == mode
            demo.stack.callback(lambda: closed.append(str(demo.folder.exists())))
            raise LinkError("The story fails.")

    with pytest.raises(LinkError):
        fail()
    assert (closed, folders[0].exists()) == (["True"], False)


@pytest.mark.parametrize(("pause", "waited", "safe"), [(0.2, 0.2, True), (9.0, 0.5, True), (0.2, 0.2, False)])
def test_the_gripper_of_the_story_is_operated_twice_and_is_safe_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pause: float, waited: float, safe: bool
) -> None:
    course: list[Any] = []

    class Hand:
        """A mock of a held actuator; whether it is safe is known once it was let go."""

        safe = False

        def __init__(self, *words: Any, unit: str) -> None:
            course.append((*words, unit))
            self.pause = pause

        def __enter__(self) -> Hand:
            return self

        def __exit__(self, *_: object) -> None:
            course.append("let go")
            self.safe = safe

        def apply(self, value: float) -> Any:
            course.append(value)
            return SimpleNamespace(value=40.12345, unit="mm")

    monkeypatch.setattr(story, "meet", lambda _station, via, uuid, _reporter: nullcontext((via, uuid)))
    monkeypatch.setattr(story.verified_session, "open_trusted", lambda _station, node, by: (*node, by))
    monkeypatch.setattr(story.held_actuator, "HeldActuator", Hand)
    monkeypatch.setattr(story, "time", SimpleNamespace(sleep=lambda seconds: course.append(("wait", seconds))))
    demo = demo_in(tmp_path)
    with nullcontext() if safe else pytest.raises(LinkError, match="is not in its safe state"):
        story.move_gripper(demo, None, bytes(10))  # type: ignore[arg-type]
    assert course == [(("can", bytes(10), "demo"), 1, "mm"), 40.0, ("wait", waited), 40.0, "let go"]
    details = [step.detail for step in demo.steps.done]
    assert details == (["hand: opening 40.12 mm, then back to its safe state"] if safe else [])


def test_the_story_rotates_the_key_over_the_bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []

    def agree(*words: Any, **how: Any) -> Any:
        course.append((words, how))
        return SimpleNamespace(epoch=2, key_id="0123")

    monkeypatch.setattr(story, "provision_over", lambda _demo, _station, via, uuid, order: course.append((via, order)))
    monkeypatch.setattr(story, "meet", lambda _station, via, uuid, _reporter: nullcontext(f"node over {via}"))
    monkeypatch.setattr(story, "identify", lambda _station, node: f"identity of {node}")
    monkeypatch.setattr(story, "agree", agree)
    demo = demo_in(tmp_path)
    story._over_can(demo, "station")  # type: ignore[arg-type]
    (via, order), agreed = course
    assert (via, order.profile, order.name) == ("can", story.PROFILE, "crane slew angle")
    assert agreed == (("station", "node over can", "identity of node over can"), {"rotate": True})
    assert [(step.name, step.detail) for step in demo.steps.done] == [("rotate", "key epoch 2, key 0123")]


def test_a_station_of_the_story_has_a_throwaway_passphrase_and_is_closed_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[Any] = []
    station = SimpleNamespace(fingerprint="ab" * 32, close=lambda: course.append("closed"))
    asked: list[str] = []

    def initialise(home: Path, *, ask: Any, **how: Any) -> Any:
        course.append((home, how))
        asked.extend((ask("new", True), ask("again", False)))
        return station, None

    monkeypatch.setattr(story, "initialise", initialise)
    with ExitStack() as stack:
        demo = demo_in(tmp_path, stack=stack)
        found: Any = story.new_station(demo, "north")
        assert found is station
        made = {"name": "north", "keystore": "file", "costs": story.THROWAWAY}
        assert course == [(tmp_path / "north", made)]
    assert course[1:] == ["closed"]
    assert asked[0] == asked[1]
    assert len(asked[0]) == 32
    assert [(step.name, step.detail) for step in demo.steps.done] == [("init", f"station north, key {'ab' * 8}")]
