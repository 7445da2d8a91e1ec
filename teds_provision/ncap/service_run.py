"""From start to end: one daemon per home, its socket and servers, its signals, its lines on stdout."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import socket
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from teds_provision.client import SOCKET
from teds_provision.errors import StoreLockedError
from teds_provision.files import listen_alone, open_lock
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.settings import Settings, require_safe
from teds_provision.ncap.waits import USUAL, Waits
from teds_provision.ncap.web.app import build
from teds_provision.ncap.web.guard import Guard, front
from teds_provision.ncap.web.server import Servers, listen
from teds_provision.one_core import one_core
from teds_provision.station.station import Station
from teds_provision.vault.master_socket import MasterSocket

LOCK: Final = "ncap.lock"


class DaemonLock:
    """``with Presence(home):`` is the one daemon of this home; raises StoreLockedError if there is one, StoreError."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._descriptor = -1

    def __enter__(self) -> DaemonLock:
        descriptor = open_lock(self._home / LOCK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.pread(descriptor, 20, 0).decode(errors="replace").strip()
            os.close(descriptor)
            raise StoreLockedError(
                f"A base station is already running for {self._home} (pid {pid or 'unknown'}).",
                hint="Show it: teds-provision ncap status. Stop it: kill -TERM PID.",
            ) from None
        with suppress(OSError):  # the pid is only information for users; a full disk is reported elsewhere
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        self._descriptor = descriptor
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            (self._home / SOCKET).unlink()
        with suppress(OSError):
            os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)

    def listen(self) -> socket.socket:
        """Return the listening Unix socket, for this user alone; that of a killed daemon is replaced."""
        return listen_alone(self._home / SOCKET, 128)


OnEvent = Callable[[dict[str, Any]], None]


def run(station: Station, settings: Settings, on_event: OnEvent, waits: Waits = USUAL) -> None:
    """Run until SIGTERM or Ctrl-C; ``on_event`` gets the ready line, then a line for each event.

    Raises StoreLockedError if this home has a daemon, LinkError if an address is taken, UsageError.
    """
    require_safe(settings)
    station.released = lambda _uuid, _command: nullcontext()  # the node locks of this process do this
    with DaemonLock(station.home) as presence, one_core():
        local = presence.listen()
        tcp = listen(*settings.http) if settings.http is not None else None
        foxglove = FoxgloveServer(settings.foxglove, settings.exposure) if settings.foxglove is not None else None
        try:
            if foxglove is not None:
                foxglove.start(station.name)
            daemon = Daemon(station, settings, foxglove, waits)
            with MasterSocket(station.home, station.accept_masters):
                asyncio.run(_serve(daemon, local, tcp, on_event))
            if daemon.failure is not None:
                raise daemon.failure
        finally:
            if foxglove is not None:
                foxglove.stop()
            for listener in (local, tcp):
                if listener is not None:
                    listener.close()


async def _serve(daemon: Daemon, local: socket.socket, tcp: socket.socket | None, on_event: OnEvent) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, _ending(stop))
    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # the terminal was closed; under nohup the signal is ignored
        loop.add_signal_handler(signal.SIGHUP, stop.set)
    servers = Servers()
    watchdog = asyncio.create_task(_watchdog())
    app = build(daemon)
    early: list[dict[str, Any]] = []
    daemon.live.on_event = early.append  # held back, because the first line must be the one that reports "ready"

    async def begin() -> None:
        await servers.serve(Guard(app, daemon.tokens, None), local)
        if tcp is not None:
            host, port = tcp.getsockname()[:2]
            exposure = daemon.settings.exposure
            named = front(exposure.allow, port, tls=exposure.tls)
            await servers.serve(Guard(app, daemon.tokens, named), tcp, daemon.settings)
            daemon.url = exposure.url("http", host, port)
        socket_path = str(Path(daemon.station.home) / SOCKET)
        links = list(daemon.settings.places)
        ready = {"ready": True, "url": daemon.url, "api": f"unix:{socket_path}", "pid": os.getpid(), "links": links}
        on_event({**ready, "foxglove": daemon.foxglove.url if daemon.foxglove is not None else None})
        daemon.live.on_event = on_event
        for event in early:
            on_event(event)
        notify("READY=1")

    try:
        with daemon.running():
            await daemon.serve(begin, stop)
            notify("STOPPING=1")
            await servers.stop()
    finally:
        watchdog.cancel()
        await servers.stop()


def _ending(stop: asyncio.Event) -> Callable[[], None]:
    """Return a handler: the first signal ends in order, a second one at once."""

    def end() -> None:
        if stop.is_set():
            os._exit(130)
        stop.set()

    return end


async def _watchdog() -> None:
    """Notify systemd that the loop lives, twice in the time that WATCHDOG_USEC allows."""
    allowed = os.environ.get("WATCHDOG_USEC", "")
    while allowed.isdecimal() and int(allowed) > 0:
        notify("WATCHDOG=1")
        await asyncio.sleep(int(allowed) / 2e6)


def notify(state: str) -> None:
    """Notify systemd (sd_notify): one datagram to the socket that NOTIFY_SOCKET names; without one nothing."""
    where = os.environ.get("NOTIFY_SOCKET", "")
    if not where.startswith(("/", "@")):
        return
    address = "\0" + where[1:] if where.startswith("@") else where
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
        out.sendto(state.encode(), address)
