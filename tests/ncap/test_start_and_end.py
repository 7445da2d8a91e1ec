"""The service's own start and end without a service: one for each home, its socket, what systemd hears, its signals."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NewerStoreError, StoreLockedError, UsageError
from teds_provision.ncap import service_run
from teds_provision.ncap.service_run import DaemonLock, _ending, _watchdog, notify
from teds_provision.ncap.settings import Settings
from teds_provision.ncap.waits import USUAL


def test_there_is_one_service_for_each_home_and_the_second_hears_which(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    with DaemonLock(tmp_path) as first, DaemonLock(tmp_path / "other"):
        listener = first.listen()
        assert (tmp_path / "ncap.sock").stat().st_mode & 0o777 == 0o600
        assert (tmp_path / "ncap.lock").read_text() == f"{os.getpid()}\n"
        with pytest.raises(StoreLockedError) as refused, DaemonLock(tmp_path):
            pass
        assert refused.value.exit_code == 7
        assert refused.value.message == f"A base station is already running for {tmp_path} (pid {os.getpid()})."
        assert refused.value.hint == "Show it: teds-provision ncap status. Stop it: kill -TERM PID."
        assert (tmp_path / "ncap.sock").exists(), "the one that was refused removes nothing"
        (tmp_path / "ncap.lock").write_text("")
        with pytest.raises(StoreLockedError, match=r"\(pid unknown\)"), DaemonLock(tmp_path):
            pass
        (tmp_path / "ncap.lock").write_text("4711\n")
        listener.close()
    assert not (tmp_path / "ncap.sock").exists()
    assert (tmp_path / "ncap.lock").read_text() == "", "the pid is another process's by and by"
    (tmp_path / "ncap.lock").write_text("123456789\n")  # of one that was killed
    with DaemonLock(tmp_path):
        assert (tmp_path / "ncap.lock").read_text() == f"{os.getpid()}\n"


def test_the_socket_of_a_service_that_was_killed_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(tmp_path / "ncap.sock"))
    with DaemonLock(tmp_path) as lock, lock.listen(), socket.socket(socket.AF_UNIX) as caller:
        caller.connect(str(tmp_path / "ncap.sock"))


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_hears_one_datagram_at_the_socket_that_it_names(
    abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"@{tmp_path}" if abstract else str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", name)
    notify("READY=1")  # nobody listens yet
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind("\0" + name[1:] if abstract else name)
        systemd.setblocking(False)
        notify("READY=1")
        assert systemd.recv(99) == b"READY=1"
        monkeypatch.chdir(tmp_path)
        for other in ("notify", "", None):
            if other is None:
                monkeypatch.delenv("NOTIFY_SOCKET")
            else:
                monkeypatch.setenv("NOTIFY_SOCKET", other)
            notify("READY=1")
        with pytest.raises(BlockingIOError):
            systemd.recv(99)


@pytest.mark.parametrize(
    ("allowed", "pause"), [("2000000", 1.0), ("500000", 0.25), ("0", None), ("", None), ("-1", None), ("x", None)]
)
def test_the_watchdog_of_systemd_hears_of_the_service_twice_in_its_time(
    allowed: str, pause: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    course: list[object] = []

    async def sleep(seconds: float) -> None:
        course.append(seconds)
        if len(course) > 3:
            raise asyncio.CancelledError

    monkeypatch.setenv("WATCHDOG_USEC", allowed)
    monkeypatch.setattr(service_run, "notify", course.append)
    monkeypatch.setattr("teds_provision.ncap.service_run.asyncio.sleep", sleep)

    async def run() -> None:
        try:
            await _watchdog()
        except asyncio.CancelledError:
            course.append("cancelled")

    asyncio.run(run())
    assert course == ([] if pause is None else ["WATCHDOG=1", pause, "WATCHDOG=1", pause, "cancelled"])


def test_the_first_signal_ends_the_service_in_order_and_the_second_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr("teds_provision.ncap.service_run.os._exit", codes.append)
    stop = asyncio.Event()
    end = _ending(stop)
    end()
    assert (stop.is_set(), codes) == (True, [])
    end()
    assert codes == [130]


# -- the whole of it, of mocks -----------------------------------------------------------------------------------------


class Stage:
    """All that a service is made of, each of which notes in ``course`` what becomes of it."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.course: list[Any] = []
        self.station: Any = SimpleNamespace(home=folder, name="bench", accept_masters=None)
        self.failure: Exception | None = None
        self.settings = Settings(places=("can:a", "nfc:b"))
        self.live = SimpleNamespace(on_event=None)
        self.tokens, self.foxglove, self.url = "tokens", None, None
        self.stop_event: Any = None
        for name, replaced in {
            "FoxgloveServer": self._foxglove, "listen": self._listen, "Daemon": self._daemon,
            "MasterSocket": self._part("masters"), "one_core": nullcontext, "build": lambda _daemon: "app",
            "Guard": lambda application, tokens, named: (application, tokens, named), "Servers": lambda: self,
            "notify": self.course.append, "front": self._front,
        }.items():  # fmt: skip
            monkeypatch.setattr(service_run, name, replaced)

    def _part(self, name: str) -> Any:
        @contextmanager
        def part(*_given: Any) -> Iterator[None]:
            self.course.append(f"{name} begin")
            yield
            self.course.append(f"{name} end")

        return part

    def _listen(self, host: str, port: int) -> Any:
        self.course.append(("listen", host, port))
        self.tcp = SimpleNamespace(
            getsockname=lambda: (host, 4711, 0, 0), close=lambda: self.course.append("listener closed")
        )
        return self.tcp

    def _front(self, hosts: tuple[str, ...], port: int, *, tls: bool) -> Any:
        return (hosts, port, tls)

    def _foxglove(self, where: str, _exposure: object) -> Any:
        return SimpleNamespace(
            url=f"ws://{where}",
            start=lambda name: self.course.append(("foxglove", name)),
            stop=lambda: self.course.append("foxglove stopped"),
        )

    def _daemon(self, station: object, settings: Settings, foxglove: Any, waits: object) -> Any:
        assert (station, settings, waits) == (self.station, self.settings, USUAL)
        self.foxglove = foxglove
        return self

    # -- the daemon

    def running(self) -> Any:
        self.live.on_event({"event": "early"})
        return self._part("daemon")()

    async def serve(self, *given: Any) -> None:
        """Serve: of the daemon until it is to end, of the servers one listener."""
        first, second, *settings = given
        if not callable(first):
            self.course.append(("serves", first, "socket" if isinstance(second, socket.socket) else second, *settings))
            return
        await first()
        self.live.on_event({"event": "late"})
        self.stop_event = second

    async def stop(self) -> None:
        self.course.append("servers stopped")

    def run(self) -> None:
        service_run.run(self.station, self.settings, self.course.append)


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stage:
    return Stage(tmp_path, monkeypatch)


def test_the_first_line_of_a_service_says_that_it_is_ready_and_where(stage: Stage) -> None:
    stage.run()
    assert stage.course == [
        "masters begin",
        "daemon begin",
        ("serves", ("app", "tokens", None), "socket"),
        {
            "ready": True, "url": None, "api": f"unix:{stage.station.home}/ncap.sock", "pid": os.getpid(),
            "links": ["can:a", "nfc:b"], "foxglove": None,
        },
        {"event": "early"},
        "READY=1",
        {"event": "late"},
        "STOPPING=1",
        "servers stopped",
        "daemon end",
        "servers stopped",
        "masters end",
    ]  # fmt: skip
    assert not (stage.station.home / "ncap.sock").exists()


def test_a_page_is_served_under_the_names_that_were_allowed_and_its_listeners_are_closed(stage: Stage) -> None:
    stage.settings = Settings(http=("127.0.0.1", 0), allow=("bench.example",), foxglove="127.0.0.1:8765")
    stage.run()
    assert stage.course[:2] == [("listen", "127.0.0.1", 0), ("foxglove", "bench")]
    assert ("serves", ("app", "tokens", (("bench.example",), 4711, False)), stage.tcp, stage.settings) in stage.course
    ready = next(line for line in stage.course if isinstance(line, dict))
    assert (ready["url"], ready["foxglove"]) == ("http://127.0.0.1:4711", "ws://127.0.0.1:8765")
    assert stage.url == ready["url"]
    assert stage.course[-2:] == ["foxglove stopped", "listener closed"]


def test_a_service_that_ends_by_itself_says_why_and_closes_its_listeners(stage: Stage) -> None:
    stage.settings = Settings(http=("127.0.0.1", 0), foxglove="127.0.0.1:8765")
    stage.failure = NewerStoreError("The store is of a newer version.")
    with pytest.raises(NewerStoreError):
        stage.run()
    assert stage.course[-3:] == ["masters end", "foxglove stopped", "listener closed"]
    with DaemonLock(stage.station.home):
        """The home is free again."""


@pytest.mark.parametrize("hangup", [signal.SIG_DFL, signal.SIG_IGN])
def test_a_signal_ends_the_service_and_so_does_the_end_of_its_terminal_unless_it_is_ignored(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, hangup: Any
) -> None:
    handlers: dict[int, Any] = {}
    loop = SimpleNamespace(add_signal_handler=handlers.setdefault)
    monkeypatch.setattr("teds_provision.ncap.service_run.asyncio.get_running_loop", lambda: loop)
    monkeypatch.setattr("teds_provision.ncap.service_run.signal.getsignal", lambda _number: hangup)
    stage.run()
    ignored = hangup == signal.SIG_IGN
    assert set(handlers) == {signal.SIGTERM, signal.SIGINT} | (set() if ignored else {signal.SIGHUP})
    for handler in handlers.values():
        assert not stage.stop_event.is_set()
        handler()
        assert stage.stop_event.is_set()
        stage.stop_event.clear()


def test_settings_that_are_not_safe_start_nothing(stage: Stage) -> None:
    stage.settings = Settings(http=("0.0.0.0", 0))
    with pytest.raises(UsageError):
        stage.run()
    assert stage.course == []
    assert not (stage.station.home / "ncap.lock").exists()
    assert not hasattr(stage.station, "released")


def test_a_node_is_released_by_the_node_locks_of_this_process_alone(stage: Stage) -> None:
    stage.run()
    with stage.station.released(bytes(10), "measure"):
        """Nothing is asked of anybody: the node locks of this process do it."""
