"""The lines of the daemon, and whoever does not read them."""

from __future__ import annotations

import fcntl
import json
import signal

from tests.e2e.desk import Desk
from tests.ncap.service import Service, until

SMALLEST_PIPE = 4096


def test_who_reads_the_first_line_alone_stops_nothing(desk: Desk) -> None:
    """A script starts the daemon with a pipe, reads that it is ready, and never again."""
    service = Service(desk, desk.station()).start()
    running = service.process
    assert running is not None
    fcntl.fcntl(running.stdout, fcntl.F_SETPIPE_SZ, SMALLEST_PIPE)
    with service.client() as asked:
        for k in range(300):
            asked.request("PUT", "/detection", {"mode": ("transparent", "whitelist")[k % 2]})
        until(lambda: asked.request("GET", "/status")["detection"] == "whitelist")
    running.signal(signal.SIGTERM)
    assert running.process.wait(60) == 0


def test_what_waits_is_told_at_the_end(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    with service.client() as asked:
        for mode in ("transparent", "whitelist") * 20:
            asked.request("PUT", "/detection", {"mode": mode})
    service.end()
    assert service.process is not None
    lines = [json.loads(line) for line in service.process.out.splitlines()]
    modes = [line["state"] for line in lines if line.get("event") == "detection"]
    assert modes == ["transparent", "whitelist"] * 20
