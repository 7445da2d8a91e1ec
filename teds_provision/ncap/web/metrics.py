"""`/metrics` for Prometheus, in its text format 0.0.4; off by default; it needs a token as everything else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.service_part import Line, ServicePart
from teds_provision.ncap.sinks import for_readers
from teds_provision.ncap.web.guard import CALLER, Caller

TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

_HELP: Final = {
    "teds_info": ("gauge", "Version and name of the station."),
    "teds_link_up": ("gauge", "1 where a link works."),
    "teds_nodes_present": ("gauge", "Nodes that are there, by link."),
    "teds_strangers": ("gauge", "Nodes that are not taken up, by link."),
    "teds_node_measuring": ("gauge", "1 where values of a node come."),
    "teds_samples_total": ("counter", "Values of a node in this measurement."),
    "teds_lost_total": ("counter", "Messages of a node that were lost."),
    "teds_late_total": ("counter", "Messages of a node that came too late."),
    "teds_bad_total": ("counter", "Messages of a node whose tag or form was wrong."),
    "teds_invalid_total": ("counter", "Values of a node that are not valid."),
    "teds_clock_error_seconds": ("gauge", "Bound of the error of a node's times."),
    "teds_sink_written_total": ("counter", "Values that a sink wrote."),
    "teds_sink_dropped_total": ("counter", "Values that a sink dropped."),
    "teds_sink_failed": ("gauge", "1 where a sink has ended with an error."),
    "teds_messages_per_second": ("gauge", "Messages to ROS and MQTT now."),
    "teds_live_clients": ("gauge", "Clients of the live channel."),
}


def route(daemon: Daemon) -> Route:
    """GET /metrics."""

    def metrics(request: Request) -> Response:
        caller: Caller = request.scope[CALLER]
        status = for_readers(daemon.status()) if caller.read_only else daemon.status()
        return Response(text(status, daemon.parts.values()), media_type=TYPE)

    return Route("/metrics", metrics)


def text(status: dict[str, Any], parts: Iterable[ServicePart] = ()) -> str:
    """Return the status, and the metrics of parts that optional rooms bring, in Prometheus's form."""
    parts = tuple(parts)
    help_of = {**_HELP, **{name: told for part in parts for name, told in part.metric_help.items()}}
    # one line for equal labels: a duplicate would make the whole scrape fail
    lines: dict[str, dict[str, float]] = {name: {} for name in help_of}
    for name, labels, value in chain(_lines(status), *(part.metrics() for part in parts)):
        inner = ",".join(f'{key}="{_escaped(word)}"' for key, word in labels.items())
        lines[name].setdefault(f"{name}{{{inner}}}" if inner else name, value)
    out = []
    for name, found in lines.items():
        if found:
            kind, words = help_of[name]
            out += [f"# HELP {name} {words}", f"# TYPE {name} {kind}"]
            out += [f"{what} {_number(value)}" for what, value in found.items()]
    return "\n".join(out) + "\n"


def _number(value: float) -> str:
    """Return all digits: a counter of a million with six of them stops, and then jumps."""
    return repr(int(value)) if float(value).is_integer() else repr(float(value))


def _lines(status: dict[str, Any]) -> Iterator[Line]:
    yield "teds_info", {"version": status["version"], "station": status["station"]["name"]}, 1
    for link in status["links"]:
        labels = {"link": link["place"]}
        yield "teds_link_up", labels, link["state"] == "up"
        yield "teds_nodes_present", labels, link["nodes"]
        yield "teds_strangers", labels, link["strangers"]
    for measurement in status["measurements"]:
        for report in measurement["nodes"]:
            labels = {"node": report["uuid"], "measurement": measurement["id"]}
            yield "teds_node_measuring", labels, report["state"] == "running"
            for name in ("samples", "lost", "late", "bad", "invalid"):
                yield f"teds_{name}_total", labels, report.get(name, 0)
            if report.get("clock_error") is not None:
                yield "teds_clock_error_seconds", labels, report["clock_error"]
    for sink in status["sinks"]:
        labels = {"sink": sink["name"], "measurement": sink["measurement"]}
        yield "teds_sink_written_total", labels, sink["written"]
        yield "teds_sink_dropped_total", labels, sink["dropped"]
        yield "teds_sink_failed", labels, sink["state"] == "failed"
    yield "teds_messages_per_second", {}, status["budget"]["used"]
    yield "teds_live_clients", {}, status["clients"]


def _escaped(word: str) -> str:
    return word.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
