"""The lines of the daemon, and whoever does not read them."""

from __future__ import annotations

import fcntl
import json
import signal
import time
from datetime import datetime

from tests.e2e.desk import Desk
from tests.ncap.service import Service, until, virtual

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


def test_moments_are_iso_8601_as_everywhere_on_the_command_line(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    uuid = virtual(service)
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
        until(lambda: asked.node(uuid)["channels"][1]["last"])
        asked.request("PUT", f"/nodes/{uuid}/channels/1", {"value": 40, "unit": "mm", "hold": 30})
        status = service.station.ask("ncap", "status")
    [node] = status["nodes"]
    moments = [status["started"], status["time"], *(link["since"] for link in status["links"])]
    moments += [node["last_seen"], node["verified"], node["channels"][1]["last"]["time"]]
    service.end()
    lines = [json.loads(line) for line in service.process.out.splitlines()] if service.process else []
    moments += [line["time"] for line in lines if "event" in line]
    moments += [line["until"] for line in lines if line.get("event") == "actuator" and line.get("until")]
    assert len(moments) > 10
    for moment in moments:
        assert abs(datetime.fromisoformat(moment).timestamp() - time.time()) < 3600, moment
        assert moment.endswith("Z")


def test_what_waits_is_reported_at_the_end(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    with service.client() as asked:
        for mode in ("transparent", "whitelist") * 20:
            asked.request("PUT", "/detection", {"mode": mode})
    service.end()
    assert service.process is not None
    lines = [json.loads(line) for line in service.process.out.splitlines()]
    modes = [line["state"] for line in lines if line.get("event") == "detection"]
    assert modes == ["transparent", "whitelist"] * 20
