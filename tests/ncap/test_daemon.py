"""What the service decides at its top, in this process and without links: detection, groups, the vault, the store."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import FrozenError, NewerStoreError, NotFoundError, StoreError, UsageError, VaultLockedError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.nodes.link_watch import LinkState
from teds_provision.ncap.settings import Settings, own_source, parse_http, require_safe
from teds_provision.ncap.waits import Waits
from teds_provision.station.store.audit import AuditFilter
from tests.bench import copied_station
from tests.pace import PATIENCE

NODE, OTHER = "ab" * 10, "cd" * 10


class Watched:
    """A link that is asked to look at all of its nodes."""

    place = "can:x"

    def __init__(self) -> None:
        self.looks, self.state = 0, LinkState(self.place)

    def look_at_all(self) -> None:
        self.looks += 1


class Bench:
    """A daemon that was made and does not run, the events that it sends, and who was selected again how often."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.station = copied_station(folder)
        self.daemon = Daemon(self.station, Settings())
        self.events: list[tuple[str, str | None]] = []
        self.daemon.live.on_event = lambda event: self.events.append((event["event"], event.get("state")))
        self.watch, self.selected = Watched(), list[str]()
        self.daemon.watches = [self.watch]  # type: ignore[list-item]
        patch.setattr(self.daemon.measuring, "look_who_is_meant", lambda: self.selected.append("again"))

    def outcomes(self, act: str) -> list[str]:
        return [entry.outcome for entry in self.station.audit_log.chosen(AuditFilter(act=act))]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(tmp_path / "home", monkeypatch)
    yield made
    made.daemon.buses.close()
    made.station.close()


def test_every_setting_reaches_the_part_that_it_is_for(tmp_path: Path) -> None:
    """A setting that got lost on its way was its default, without a word."""
    station, waits, trace = copied_station(tmp_path / "home"), Waits(link=7.0), cast("Any", SimpleNamespace())
    settings = Settings(
        places=("can:virtual:a", "can:virtual:b?source=0xF1"), trust_dcc=(tmp_path,), file_units="shown", yes=True,
        record=tmp_path / "record", sinks=("ros2",), scalars=False, brokers={"lab": "mqtt://lab"}, dead_man=250,
        require_firmware=True, trace=trace,
    )  # fmt: skip
    foxglove: Any = SimpleNamespace(url="ws://x")
    daemon = Daemon(station, settings, foxglove, waits)
    sinks, measuring = daemon.measuring._sinks, daemon.measuring
    assert (sinks._specs, sinks._record, sinks._brokers) == (("ros2",), tmp_path / "record", {"lab": "mqtt://lab"})
    assert (sinks._units, sinks._scalars, sinks._foxglove, sinks.actuators) == ("shown", False, foxglove, True)
    assert (measuring._dead_man, daemon.leases._dead_man, measuring._require_firmware) == (250, 250, True)
    assert (measuring._waits, daemon.waits) == (waits, waits)
    assert (daemon.provisioning._trusted, daemon.adopting._signs) == ((tmp_path,), True)
    own = f"source=0x{own_source(station.id):02X}"
    assert [watch.place for watch in daemon.watches] == [f"can:virtual:a?{own}", "can:virtual:b?source=0xF1"]
    assert [(watch._trace, watch._waits) for watch in daemon.watches] == [(trace, waits)] * 2
    assert (daemon.status()["actuators"], daemon.status()["dead_man"], daemon.status()["adopt"]) == (True, 250, False)
    daemon.buses.close()
    other = Daemon(station, Settings(actuators=False, adopt=True, sinks=("ros2",)))
    assert (other.measuring._sinks.actuators, other.status()["actuators"], other.status()["adopt"]) == (
        False, False, True,
    )  # fmt: skip
    other.buses.close()
    station.close()


def test_the_parts_of_a_service_ask_each_other(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, asked = bench.daemon, list[Any]()
    monkeypatch.setattr(daemon.measuring, "on_sighting", lambda uuid: asked.append(("sighting", uuid)))
    daemon.directory.note(NODE, present=True)
    for uuid in (NODE, OTHER):
        daemon.node_locks.acquire(uuid, "it is looked at")
        daemon.node_locks.release(uuid)
    assert asked == [("sighting", NODE)], "one that is there may be measured now"
    assert not daemon.directory.virtual(NODE)
    daemon.virtuals._all[NODE] = cast("Any", SimpleNamespace(uuid=NODE))
    assert daemon.directory.virtual(NODE)
    assert daemon.directory.topic == daemon.names.topic
    assert daemon.directory.actuator == daemon.leases.state
    bench.events.clear()
    daemon.buses.presence.report("One node answers twice.")
    assert bench.events == [("link", "notice")]


def test_a_vault_that_is_open_again_has_all_nodes_selected_and_looked_at_anew(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = [False, True, True, False, False]

    def current_vault() -> None:
        if closed.pop(0):
            raise VaultLockedError("Another process has a new master key.", hint="unlock")

    monkeypatch.setattr(bench.station, "current_vault", current_vault)
    states = []
    for _ in range(5):
        bench.daemon._look_at_vault()
        states.append(bench.daemon.status()["vault"]["state"])
    assert states == ["open", "locked", "locked", "open", "open"]
    assert bench.events == [("vault", "locked"), ("vault", "open")]
    assert (bench.selected, bench.watch.looks) == (["again"], 1)


def test_another_mode_of_detection_forgets_the_nodes_that_were_found_in_the_one_before(bench: Bench) -> None:
    directory = bench.daemon.directory
    before = bench.daemon.detection
    for mode in (before, "transparent" if before == "whitelist" else "whitelist"):
        directory.note(NODE, "came", place="can:x", present=True)
        bench.daemon.set_detection(mode)
        assert (bench.daemon.detection, directory.seen(NODE).present) == (mode, mode == before)
    assert (bench.selected, bench.watch.looks, bench.outcomes("detection")) == (["again"] * 2, 2, ["set", "set"])
    with pytest.raises(UsageError, match="not a detection mode"):
        bench.daemon.set_detection("all")


def test_a_group_that_is_measured_keeps_its_nodes(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, measured = bench.daemon, list[str]()
    monkeypatch.setattr(daemon.measuring, "measured_as", lambda _name: measured)
    daemon.make_group("arm", [NODE])
    daemon.change_group("arm", [NODE, OTHER])
    daemon.change_group("arm", [OTHER])
    assert [(group["name"], group["uuids"], group["measuring"]) for group in daemon.groups()] == [
        ("arm", [OTHER], False)
    ]
    assert (bench.events, bench.selected) == ([("group", "changed")] * 3, ["again"] * 3)
    measured.append("m1")
    for change in (lambda: daemon.change_group("arm", [NODE]), lambda: daemon.drop_group("arm")):
        with pytest.raises(FrozenError, match=r"is being measured \(m1\)"):
            change()
    assert [(group["uuids"], group["measuring"]) for group in daemon.groups()] == [([OTHER], True)]
    measured.clear()
    daemon.drop_group("arm")
    assert daemon.groups() == []
    with pytest.raises(NotFoundError):
        daemon.change_group("arm", [])


def looks(bench: Bench, count: int) -> None:
    """Let the daemon look at its store so many times."""
    left = [False] * count + [True]
    bench.daemon._stop = SimpleNamespace(wait=lambda _seconds: left.pop(0))  # type: ignore[assignment]
    bench.daemon._observe()


def test_what_another_process_changed_in_the_store_is_read_again_names_of_topics_too(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, version, done = bench.daemon, [daemon_version := object()], list[str]()
    daemon._version = daemon_version
    monkeypatch.setattr(bench.station, "version", lambda: version[0])
    readable = [False, True]
    monkeypatch.setattr(daemon.directory, "refresh", lambda *_uuids: done.append("nodes") or readable.pop(0))
    monkeypatch.setattr(daemon.names, "forget", lambda: done.append("names"))
    monkeypatch.setattr(daemon.directory, "follow_profiles", lambda: [NODE])
    looks(bench, 1)
    assert (done, bench.events) == ([], [("node", "changed")])
    version[0] = object()
    looks(bench, 3)
    assert (done, bench.events.count(("store", "changed"))) == (["nodes", "nodes", "names"], 1), "until it can be read"


def test_a_store_that_fails_is_looked_at_again_and_one_of_a_newer_version_ends_the_service(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures: list[Exception | None] = [
        StoreError("The disk is away."),
        OSError(),
        None,
        NewerStoreError("Schema 99.", hint="x"),
    ]
    ended: list[bool] = []
    bench.daemon._ends = lambda: ended.append(True)

    def current_vault() -> None:
        if failure := failures.pop(0):
            raise failure

    monkeypatch.setattr(bench.daemon, "_look_at_vault", current_vault)
    looks(bench, 9)
    assert (failures, ended, bench.events) == ([], [True], [("store", "newer")])
    assert isinstance(bench.daemon.failure, NewerStoreError)


def test_a_node_is_named_by_its_uuid_a_piece_of_it_or_its_name(bench: Bench) -> None:
    daemon = bench.daemon
    bench.station.nodes.remember(bytes.fromhex(NODE), name="hand")
    daemon.directory.note(OTHER, "came", present=True)
    for text, uuid in (("hand", NODE), ("0x" + NODE.upper(), NODE), (OTHER, OTHER), (OTHER[:4], OTHER)):
        assert daemon.known(text) == uuid
    for text in (OTHER[:3], "ef" * 10, "foot"):
        with pytest.raises((NotFoundError, UsageError)):
            daemon.known(text)


def test_a_node_is_told_to_blink_in_the_session_in_which_it_is_measured(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(
        "teds_provision.ncap.daemon.locate_measured", lambda node, seconds: told.append((node, seconds))
    )
    monkeypatch.setattr(bench.daemon.node_jobs, "with_node", lambda uuid, what, _work: told.append((uuid, what)))
    node = SimpleNamespace(sealed=True)

    class Session:
        def __enter__(self) -> Any:
            return SimpleNamespace(node=node)

        def __exit__(self, *_: object) -> None:
            pass

    monkeypatch.setattr(bench.daemon.measuring, "session", lambda _uuid, *, streaming: Session() if streaming else None)
    bench.daemon.locate(NODE, 3)
    node.sealed = False
    bench.daemon.locate(NODE, 3)
    assert told == [(node, 3), (NODE, "locate")]


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("8351", ("127.0.0.1", 8351)),
        ("127.0.0.1:8351", ("127.0.0.1", 8351)),
        ("[::1]:0", ("::1", 0)),
        ("bench:65535", ("bench", 65535)),
        ("bench:65536", None),
        (":8351", None),
        ("[]:8351", None),
        ("bench", None),
        ("bench:", None),
        ("bench:-1", None),
        ("", None),
    ],
)
def test_the_address_of_the_page_is_host_and_port_or_a_port_of_this_machine(
    text: str, address: tuple[str, int] | None
) -> None:
    if address is None:
        with pytest.raises(UsageError, match="is not HOST:PORT"):
            parse_http(text)
    else:
        assert parse_http(text) == address


def test_a_daemons_address_on_a_bus_follows_from_its_store_and_leaves_the_command_lines_free() -> None:
    """CRC-32 of the ID, into the six addresses of daemons: two stations on one bus seldom collide."""
    assert [own_source(name) for name in ("a", "b", "bench", "")] == [0xF5, 0xF7, 0xF5, 0xF2]
    assert {own_source(str(number)) for number in range(200)} == {0xF2, 0xF3, 0xF4, 0xF5, 0xF6, 0xF7}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (Settings(http=("192.168.1.2", 8351)), "--http 192.168.1.2 would send values and tokens"),
        (Settings(foxglove="192.168.1.2:8765"), "192.168.1.2 would send values"),
        (Settings(certificate=Path("cert.pem")), "must be used together"),
        (Settings(key=Path("key.pem"), http=("127.0.0.1", 1)), "must be used together"),
        (Settings(http=("127.0.0.1", 8351), foxglove="8765"), None),
        (Settings(), None),
    ],
)
def test_a_service_that_others_could_listen_to_is_refused_at_its_start(settings: Settings, words: str | None) -> None:
    if words is None:
        require_safe(settings)
        return
    with pytest.raises(UsageError, match=words):
        require_safe(settings)


def test_the_service_ends_in_order_actuators_first_and_virtual_transducers_last(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An actuator is let go while its link is there, a measurement ends while its nodes answer."""
    daemon, course = bench.daemon, list[str]()

    def noted(owner: Any, name: str, what: str) -> None:
        monkeypatch.setattr(owner, name, lambda *_words: course.append(what))

    part, other = SimpleNamespace(), SimpleNamespace()
    daemon.parts = {"a": part, "b": other}  # type: ignore[dict-item]
    daemon.watches = [SimpleNamespace(place="can:x"), SimpleNamespace(place="nfc:y")]  # type: ignore[list-item]
    for owner, name, what in (
        (daemon.updates, "stop", "no further board"),
        (daemon.leases, "end", "actuators"),
        (daemon.measuring, "stop", "measurements"),
        (daemon.buses, "close", "buses"),
        (daemon.virtuals, "stop", "virtual transducers"),
        (daemon.live.history, "close", "history"),
        (daemon._observer, "join", "observer"),
    ):
        noted(owner, name, what)
    for number, one in enumerate((part, other)):
        monkeypatch.setattr(one, "stop", lambda number=number: course.append(f"part {number}"), raising=False)
    for number, watch in enumerate(daemon.watches):
        monkeypatch.setattr(watch, "stop", lambda number=number: course.append(f"link {number}"), raising=False)
        monkeypatch.setattr(
            watch, "join", lambda seconds: course.append(f"joined {0.1 <= seconds <= 8}"), raising=False
        )
    daemon._end()
    assert course == [
        "no further board", "part 0", "part 1", "actuators", "measurements", "link 0", "link 1", "buses",
        "joined True", "joined True", "virtual transducers", "history", "observer",
    ]  # fmt: skip
    assert daemon._stop.is_set()


@pytest.mark.parametrize(
    ("settings", "course"),
    [
        (Settings(), ["kept", "updates"]),
        (Settings(detection="whitelist"), ["kept", "updates"]),
        (Settings(detection="transparent"), ["mode transparent", "kept", "updates"]),
        (
            Settings(measure="all", rate=5.0, frozen=True, unverified=True),
            ["kept", "unverified 5.0", "all 5.0 True", "updates"],
        ),
    ],
)
def test_what_the_options_of_a_start_ask_for_begins_with_it(
    settings: Settings, course: list[str], bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, found = bench.daemon, list[str]()
    daemon.settings, daemon.watches = settings, []
    assert daemon.detection == "whitelist"
    measuring = daemon.measuring
    for owner, name in ((daemon._observer, "start"), (daemon.live.history, "start"), (daemon, "_end")):
        monkeypatch.setattr(owner, name, lambda: None)
    monkeypatch.setattr(daemon, "set_detection", lambda mode: found.append(f"mode {mode}"))
    monkeypatch.setattr(measuring, "start", lambda: found.append("kept"))
    monkeypatch.setattr(measuring, "unverified", lambda *, rate: found.append(f"unverified {rate}"))
    monkeypatch.setattr(measuring, "match", lambda text, *, rate, frozen: found.append(f"{text} {rate} {frozen}"))
    monkeypatch.setattr(daemon.updates, "start", lambda: found.append("updates"))
    with daemon.running():
        assert found == course


def test_a_node_that_answered_is_the_measurements_before_its_own_links(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another order would have a node inspected that a measurement waits for."""
    daemon, course, port = bench.daemon, list[str](), object()
    monkeypatch.setattr(daemon.measuring, "on_sighting", course.append)
    daemon.watches = [
        SimpleNamespace(port=at, on_sighting=lambda _sighting, name=name: course.append(name))  # type: ignore[list-item]
        for name, at in (("other", object()), ("own", port))
    ]
    sighting: Any = SimpleNamespace(uuid=bytes.fromhex(NODE), port=port)
    daemon._saw(sighting)
    assert course == [NODE, "own"]
    course.clear()
    daemon._free_again(NODE)
    assert course == [], "it is not there"
    daemon.directory.note(NODE, "came", present=True)
    daemon._free_again(NODE)
    assert course == [NODE]


@pytest.mark.parametrize(
    ("job", "adopted", "changes", "served", "selected"),
    [
        (True, False, False, True, 1),
        (False, True, False, True, 1),
        (False, False, True, False, 1),
        (False, False, False, False, 0),
    ],
)
def test_after_what_was_done_with_a_node_the_measurements_select_again(
    job: bool, adopted: bool, changes: bool, served: bool, selected: int, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    node: Any = SimpleNamespace(identity=SimpleNamespace(state="factory"))
    asked: list[str] = []

    def adopt(_node: Any) -> bool:
        asked.append("adopt")
        if changes:
            node.identity = SimpleNamespace(state="keyed")
        return adopted

    monkeypatch.setattr(bench.daemon.node_jobs, "serve", lambda _node: job)
    monkeypatch.setattr(bench.daemon.adopting, "serve", adopt)
    assert bench.daemon.serve_node(node) is served
    assert (len(bench.selected), asked) == (selected, [] if job else ["adopt"])


@pytest.mark.parametrize(
    ("adopt", "mode", "adopts"),
    [(True, "transparent", True), (True, "whitelist", False), (False, "transparent", False)],
)
def test_nodes_are_adopted_in_transparent_mode_alone(adopt: bool, mode: str, adopts: bool, bench: Bench) -> None:
    bench.daemon.settings = Settings(adopt=adopt)
    bench.daemon.set_detection(mode)
    assert bench.daemon._adopts is adopts


def test_the_state_of_the_service_counts_the_nodes_of_all_links(bench: Bench) -> None:
    daemon = bench.daemon
    other = Watched()
    other.place, other.state = "nfc:usb", LinkState("nfc:usb")
    daemon.watches = [bench.watch, other]  # type: ignore[list-item]
    for uuid, place in ((NODE, "can:x"), (OTHER, "nfc:usb"), ("ef" * 10, "can:x")):
        daemon.directory.note(uuid, "came", place=place, present=True)
    daemon.directory.note("ef" * 10, "left", present=False)
    status = daemon.status()
    assert [(link["place"], link["via"], link["virtual"], link["nodes"]) for link in status["links"]] == [
        ("can:x", "can", False, 1), ("nfc:usb", "nfc", False, 1),
    ]  # fmt: skip
    assert [(link["waiting"], link["notice"], link["problem"]) for link in status["links"]] == [(None, None, None)] * 2
    assert (status["nodes"], status["strangers"], status["url"], status["foxglove"]) == (2, 0, None, None)
    assert (status["plant"], status["actuators"], status["dead_man"], status["adopt"]) == (False, False, 1000, False)
    assert status["vault"] == {"state": "open", "problem": None}
    assert status["station"] == {"name": bench.station.name, "fingerprint": bench.station.fingerprint}
    hello = daemon.first_message()
    assert (hello["type"], hello["version"], hello["station"]) == ("hello", status["version"], bench.station.name)


def test_every_link_is_asked_before_the_nodes_are_given(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[tuple[int, float]] = []
    monkeypatch.setattr(bench.daemon._stop, "wait", lambda seconds: waited.append((bench.watch.looks, seconds)))
    monkeypatch.setattr(bench.daemon.directory, "nodes", lambda: [{"uuid": NODE}] if waited else [])
    assert bench.daemon.discover() == [{"uuid": NODE}]
    assert waited == [(1, bench.daemon.waits.discovery)]


@pytest.mark.parametrize("read_only", [False, True])
def test_the_pages_address_has_a_token_and_there_is_none_without_a_page(bench: Bench, read_only: bool) -> None:
    with pytest.raises(UsageError) as refused:
        bench.daemon.login_url()
    assert refused.value.hint == "Restart it with --http: ncap run --http 127.0.0.1:8351"
    bench.daemon.url = "http://127.0.0.1:8351"
    address, _, token = bench.daemon.login_url(read_only=read_only).partition("?token=")
    assert address == "http://127.0.0.1:8351/login"
    cookie = bench.daemon.tokens.login(token)
    assert cookie is not None
    found = bench.daemon.tokens.find(cookie)
    assert found is not None
    assert found.read_only is read_only


def test_a_virtual_transducer_that_is_measured_is_not_removed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, course, measured = bench.daemon, list[Any](), ["m1"]
    monkeypatch.setattr(daemon.measuring, "measurement_of", lambda _uuid: measured[0] if measured else None)
    monkeypatch.setattr(
        daemon.virtuals, "forget", lambda uuid: course.append(daemon.node_locks.holder(uuid) is not None) or uuid
    )
    monkeypatch.setattr(daemon.virtuals, "end", lambda one: course.append(("end", one)))
    daemon.directory.note(NODE, "came", present=True)
    with pytest.raises(FrozenError) as refused:
        daemon.drop_virtual(NODE)
    assert (refused.value.message, refused.value.hint) == (
        f"Node {NODE} is being measured.",
        "End the measurement first.",
    )
    assert (course, daemon.directory.seen(NODE).present) == ([], True)
    measured.clear()
    daemon.drop_virtual(NODE)
    assert (course, daemon.directory.seen(NODE).present) == ([True, ("end", NODE)], False)
    assert daemon.node_locks.holder(NODE) is None


def test_a_group_that_does_not_exist_is_neither_changed_nor_deleted_and_who_did_is_in_the_log(bench: Bench) -> None:
    daemon = bench.daemon
    for change in (lambda: daemon.change_group("arm", []), lambda: daemon.drop_group("arm")):
        with pytest.raises(NotFoundError):
            change()
    assert (bench.events, bench.selected) == ([], [])
    daemon.make_group("arm", [])
    with pytest.raises(UsageError):
        daemon.make_group("arm", [NODE])
    daemon.drop_group("arm")
    assert bench.outcomes("group")[-1:] == ["deleted"]
    assert (bench.events, len(bench.selected)) == ([("group", "changed")] * 2, 2)


def test_a_service_that_has_failed_already_ends_as_soon_as_it_serves(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    course = list[str]()

    async def fan() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            course.append("fan ended")

    async def begin() -> None:
        await asyncio.sleep(0)
        course.append("begun")

    async def serve() -> None:
        stop = asyncio.Event()
        await asyncio.wait_for(bench.daemon.serve(begin, stop), PATIENCE)

    monkeypatch.setattr(bench.daemon.live, "run", fan)
    bench.daemon.failure = NewerStoreError("newer")
    asyncio.run(serve())
    assert course == ["begun", "fan ended"]
    bench.daemon.failure = None

    async def end_later() -> None:
        stop = asyncio.Event()
        serving = asyncio.create_task(bench.daemon.serve(begin, stop))
        while len(course) < 3:
            await asyncio.sleep(0)
        assert not stop.is_set()
        bench.daemon._ends()
        await asyncio.wait_for(serving, PATIENCE)

    asyncio.run(end_later())
    assert course == ["begun", "fan ended"] * 2


def test_a_part_that_changed_the_store_has_it_looked_at_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.daemon.directory, "refresh", lambda: bench.selected.append("refreshed"))
    bench.daemon._store_changed()
    assert (bench.selected, bench.events) == (["refreshed"], [("store", "changed")])


def test_a_virtual_transducer_is_removed_while_no_measurement_can_begin_with_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon, course = bench.daemon, list[Any]()

    @contextmanager
    def lock(name: str) -> Iterator[None]:
        course.append(("lock", name))
        yield
        course.append("open")

    with monkeypatch.context() as patch:
        patch.setattr(daemon.station, "lock", lock)
        patch.setattr(daemon.measuring, "measurement_of", lambda uuid: course.append(("measured?", uuid)))
        patch.setattr(daemon.virtuals, "forget", lambda uuid: course.append(("forgotten", uuid)) or "it")
        patch.setattr(daemon.virtuals, "end", lambda one: course.append(("ended", one)))
        patch.setattr(daemon.directory, "refresh", lambda: course.append("read again"))
        daemon.drop_virtual(NODE)
    assert course == [
        ("lock", "virtual"), ("measured?", NODE), ("forgotten", NODE), "open", ("ended", "it"), "read again",
    ]  # fmt: skip
    assert bench.events == [("node", "left")]


def test_of_each_group_it_is_shown_whether_it_is_measured(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = bench.daemon
    monkeypatch.setattr(daemon.measuring, "measured_as", lambda name: ["m1"] if name == "arm" else [])
    daemon.make_group("arm", [NODE, OTHER])
    daemon.make_group("base", [OTHER])
    assert [(group["name"], group["uuids"], group["measuring"]) for group in daemon.groups()] == [
        ("arm", [NODE, OTHER], True), ("base", [OTHER], False),
    ]  # fmt: skip


def test_a_virtual_transducer_that_was_made_is_started_and_shown(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, course = bench.daemon, list[Any]()
    made = SimpleNamespace(uuid=NODE, as_json=lambda: {"uuid": NODE})
    monkeypatch.setattr(daemon.virtuals, "make", lambda **asked: course.append(asked) or made)
    monkeypatch.setattr(daemon.directory, "answering_on", lambda: {"can:x"})
    monkeypatch.setattr(daemon, "_start_virtuals", lambda: course.append("started"))
    monkeypatch.setattr(daemon.directory, "refresh", course.append)
    asked = {"name": "hand", "source": "noise", "content": "<teds/>", "profile": "gripper", "new_uuid": True}
    assert daemon.make_virtual(**asked) == {"uuid": NODE}  # type: ignore[arg-type]
    assert course == [{**asked, "on_bus": {"can:x"}}, "started", [NODE]]
