"""The service's own start and end without a service: one for each home, its socket, what systemd hears, its signals."""

from __future__ import annotations

import asyncio
import os
import socket
from pathlib import Path

import pytest

from teds_provision.errors import StoreLockedError
from teds_provision.ncap import service_run
from teds_provision.ncap.service_run import DaemonLock, _ending, _watchdog, notify


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
