"""``ncap``: the base station as a service: run it, query it through the socket in its home, manage API tokens."""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
from collections import deque
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from teds_provision import client
from teds_provision import measure as measure_room
from teds_provision.cli.config_file import brokers_of, config_path
from teds_provision.cli.context import App, Console, Station, pass_app, to_json
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    FileToRead,
    command,
    examples,
    exposure_options,
    file_units_option,
    foxglove_address,
    foxglove_options,
    options_given,
    tracing,
)
from teds_provision.cli.rendering import count_of, local_time, shown
from teds_provision.cli.shape_options import measurement_option, measurement_options
from teds_provision.errors import NotFoundError, PolicyError, TedsProvisionError, UsageError
from teds_provision.lazy import how_to_install, late
from teds_provision.sanitize import by_name, counted
from teds_provision.station.store.records import COMMAND, iso

if TYPE_CHECKING:
    from teds_provision.api.bodies import Mode
    from teds_provision.measure.matching import MatchSurvey
    from teds_provision.ncap import service_part, service_run, settings
    from teds_provision.ncap.web import tokens
else:
    service_run, settings = late("teds_provision.ncap.service_run"), late("teds_provision.ncap.settings")
    service_part = late("teds_provision.ncap.service_part")
    tokens = late("teds_provision.ncap.web.tokens")


MOST: Final = 1000  # lines that may wait until stdout accepts them
_MOST_NAMED: Final = 5
_MOST_REASONS: Final = 5
LEAVING: Final = 2.0  # seconds to print them at the end
_MOMENTS: Final = frozenset({"time", "since", "started", "until", "tapped"})
"""Members of events and of the status that are moments."""
_NO_LINK = "No link is configured, so no board is found. To add one: teds-provision ncap run --can socketcan:can0"
_OF_LAST_SESSION = " (of its last session: the vault is locked)"
_NEEDED = ("starlette", "uvicorn", "websockets")
_FILE = FileToRead(exists=True)


@command(
    "teds-provision ncap run --http 127.0.0.1:8351 --can socketcan:can0 --nfc usb",
    "teds-provision ncap run --measure all --can socketcan:can0 --ros2",
    "teds-provision ncap run --can socketcan:can0 --record /var/lib/measured --mqtt mqtt://broker",
    name="run",
)
@click.option("--detection", type=click.Choice(["transparent", "whitelist"]), help="Which nodes to accept.")
@click.option("--adopt", is_flag=True, help="In transparent mode, key factory nodes on a wired bus.")
@click.option("--yes", "-y", is_flag=True, help="With --adopt: also sign the datasheet that such a node"
                                                " brought, unless it has findings.")  # fmt: skip
@click.option("--unverified", is_flag=True, help="With --adopt: measure such nodes by their own unsigned"
                                                 " datasheets, under /STATION/unverified/.")  # fmt: skip
@click.option("--measure", metavar="all|GROUP|EXPR", help="Measure every authentic node that comes: all, a group, or "
              "type:PROFILE, name:GLOB, group:NAME, 'angle >= 360 deg', joined by commas.")  # fmt: skip
@measurement_option("rate", purpose="With --measure: maximum samples per second.")
@click.option("--frozen", is_flag=True, help="With --measure: only the nodes known at the start, as one group array.")
@click.option("--http", metavar="HOST:PORT", help="Serve the page and the API on this address, e.g. 127.0.0.1:8351.")
@exposure_options
@click.option(
    "--record",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Record every measurement in this directory.",
)
@click.option("--ros1", is_flag=True, help="Publish to ROS 1 (ROS_MASTER_URI).")
@click.option("--ros2", is_flag=True, help="Publish to ROS 2 (ROS_DOMAIN_ID), on this machine.")
@click.option("--mqtt", metavar="URL", help="Publish to a broker: mqtt://HOST.")
@foxglove_options
@measurement_options("actuators", "dead_man")
@click.option("--require-firmware", is_flag=True, help="Measure no nodes whose firmware their type does not accept.")
@file_units_option
@click.option("--trust-dcc", type=_FILE, multiple=True, metavar="CERT.pem",
              help="Require calibration certificates signed by this one, or under this CA; repeatable.")  # fmt: skip
@click.option("--metrics", is_flag=True, help="Serve /metrics for Prometheus.")
@click.option("--http-1451", "clause_12", is_flag=True, help="Serve the paths of IEEE 1451.0 clause 12, read-only.")
@click.option("--nfc", multiple=True, metavar="PATH", help="Reader: auto, usb, udp:localhost:54321; repeatable.")
@click.option("--can", multiple=True, metavar="INTERFACE:CHANNEL", help="Bus: socketcan:can0; repeatable.")
@click.option("--ble", multiple=True, metavar="ADAPTER", help="Bluetooth: auto, hci0; repeatable.")
@click.option(
    "--trace",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Record every frame of every link; the file grows without limit. See: trace show.",
)
@pass_app
def run(
    app: App,
    /,
    nfc: Sequence[str],
    can: Sequence[str],
    ble: Sequence[str],
    http: str | None,
    ros1: bool,
    ros2: bool,
    mqtt: str | None,
    foxglove: bool,
    foxglove_at: str | None,
    no_scalars: bool,
    trace: Path | None,
    **wished: Any,
) -> None:
    """Run the base station until SIGTERM or Ctrl-C.

    Prints one line when it is ready, then one line per event.
    """
    missing = [name for name in _NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(f"ncap run needs {', '.join(missing)}.", hint=how_to_install("ncap"))
    if options_given("yes") and not wished["adopt"]:
        raise UsageError("--yes requires --adopt.", hint="Add --adopt --detection transparent.")
    if options_given("unverified") and not wished["adopt"]:
        raise UsageError("--unverified requires --adopt.", hint="Add --adopt --detection transparent.")
    wished["unverified"] = wished["unverified"] and wished["adopt"]
    if wished["measure"] is None and not wished["unverified"] and (wished["rate"] is not None or wished["frozen"]):
        raise UsageError("--rate and --frozen require --measure.", hint="Add --measure all.")
    places = [f"{link}:{place}" for link, named in (("can", can), ("nfc", nfc), ("ble", ble)) for place in named]
    sinks = [name for name, asked in (("ros1", ros1), ("ros2", ros2), (mqtt or "", mqtt)) if asked]
    wanted = settings.Settings(
        places=tuple(dict.fromkeys(places)),
        http=None if http is None else settings.parse_http(http),
        sinks=tuple(sinks),
        foxglove=foxglove_address(foxglove, foxglove_at),
        scalars=not no_scalars,
        brokers=brokers_of(config_path(app.home)),
        **wished,
    )
    settings.require_safe(wanted)
    settings.require_places(wanted)
    station = app.station()
    for kind in service_part.KINDS.parts() if wanted.parts else ():
        if kind.name in wanted.parts:
            kind.require(station)
    if wanted.measure is not None:
        match = measure_room.matching.NodeMatch.parse(wanted.measure)
        match.require_groups(station)
        unknown = match.unknown_type(station)
        if unknown:
            app.warn(f"Nothing is measured until a node of that type comes: {unknown}.")
    station.unlock()  # so that no passphrase is asked for later
    lines = DaemonLog(app)
    try:
        with tracing(trace) as opened:
            service_run.run(station, replace(wanted, trace=opened), lines.write_event)
    except TedsProvisionError:  # the caller prints its message, after the last event
        lines.end()
        raise
    if not lines.end():
        os._exit(0)  # everything ended in order; the blocked writer thread would delay the exit for ever


class DaemonLog:
    """The daemon's lines: JSON on stdout, or sentences on stderr, written by a thread.

    A reader that stops, a script that wanted the first one or a terminal that is held by Ctrl-S, stops nothing: of more
    than MOST that wait the oldest go, and the next line has their number.
    """

    def __init__(self, app: App) -> None:
        self._app = app
        self._waiting: deque[dict[str, Any]] = deque()
        self._news = threading.Condition()
        self._dropped = 0
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="lines", daemon=True)
        self._thread.start()

    def write_event(self, event: dict[str, Any]) -> None:
        """Queue one event for writing, from any thread; returns at once."""
        with self._news:
            if len(self._waiting) >= MOST:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(event)
            self._news.notify()

    def end(self) -> bool:
        """Write what waits; False if it is not read within LEAVING seconds."""
        with self._news:
            self._ending = True
            self._news.notify()
        self._thread.join(LEAVING)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._ending)
                if not self._waiting:
                    return
                events = [*self._waiting]
                if self._dropped:
                    events.insert(0, {"event": "lines", "state": "dropped", "count": self._dropped})
                self._waiting.clear()
                self._dropped = 0
            for event in events:
                self._write(event)

    def _write(self, event: dict[str, Any]) -> None:
        with suppress(OSError, ValueError):
            if self._app.json:
                sys.stdout.write(to_json(_dated(event)) + "\n")
                sys.stdout.flush()
            else:
                self._app.note(_sentence(event))


def _dated(members: Any) -> Any:
    """Return the API's answer with moments as everywhere on the command line: ISO 8601 in place of unix seconds."""
    if isinstance(members, list):
        return [_dated(element) for element in members]
    if not isinstance(members, dict):
        return members
    return {
        key: _moment(element) if key in _MOMENTS and _is_number(element) else _dated(element)
        for key, element in members.items()
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _moment(unix: float) -> str:
    return f"{datetime.fromtimestamp(unix, UTC).replace(tzinfo=None).isoformat(timespec='milliseconds')}Z"


def _sentence(event: dict[str, Any]) -> str:
    if event.get("ready"):
        where = event["url"] or f"the Unix socket {event['api'].removeprefix('unix:')}"
        ready = f"Ready on {where}. To open the page: teds-provision ncap open"
        if event.get("foxglove"):
            ready += f"\nFoxglove: {event['foxglove']}"
        return ready if event.get("links") else f"{ready}\n{_NO_LINK}"
    facts = {key: value for key, value in event.items() if key not in ("event", "time", "state") and value}
    text = ", ".join(f"{key} {_text(value)}" for key, value in facts.items())
    what = f"{event['event']} {event.get('state', '')}".rstrip()
    return f"{what}: {text}" if text else what


def _text(value: Any) -> str:
    return str(value.get("message", value)) if isinstance(value, dict) else str(value)


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision ncap run --http 127.0.0.1:8351 --can socketcan:can0",
        "teds-provision ncap open",
        "teds-provision ncap status",
    ),
)
def ncap() -> None:
    """Run the base station as a service that finds nodes, measures them, and serves a page and an API."""


@command("teds-provision ncap status", name="status")
@pass_app
def status(app: App) -> None:
    """Show what the running base station is doing."""
    with client.connect(home=app.home) as station:
        found = {**station.status(), "nodes": station.nodes()}
    app.emit(_dated(found), lambda console: _status(console, found))


def _status(console: Console, found: dict[str, Any]) -> None:
    served = found["url"] or "no page (start it with --http)"
    console.print(f"{found['station']['name']}: {found['detection']} mode, {served}", markup=False)
    locked = found.get("vault", {}).get("problem")
    if locked:
        console.print(f"The vault is locked: {locked['message']} {locked['hint']}", markup=False)
    if all(link["virtual"] for link in found["links"]):
        console.print(_NO_LINK, markup=False)
    for link in found["links"]:
        console.print(_link(link), markup=False)
    for node in sorted(found["nodes"], key=lambda node: by_name(node["name"], node["uuid"])):
        there = "there" if node["present"] else _away(node["last_seen"])
        name = shown(node["name"]) or "no name"
        problem = f": {node['problem']['message']}" if node["problem"] else ""
        console.print(f"{node['uuid']}  {name}  {there}  {_verdict(node, locked=bool(locked))}{problem}", markup=False)
    for known in found.get("measurements", ()):
        what = f" of {known['match']}" if known.get("match") else ""
        why = f": {known['why']}" if known["why"] else ""
        owner = "" if known["owner"] == "ncap" else f" ({known['owner']})"
        console.print(f"measurement {known['id']}{what}{owner}: {known['state']}{why}", markup=False)
        for node in known["nodes"] if what else ():
            why = f": {node['why']}" if node["why"] else ""
            console.print(f"  {node['uuid']} {node['state']}{why}", markup=False)
        if any(node["why"] == "no room on the bus" for node in known["nodes"]):
            console.print("  → Running streams are not slowed down. A lower --rate leaves room for all.", markup=False)
    if found.get("foxglove"):
        console.print(f"Foxglove: {found['foxglove']}", markup=False)
    for known in found.get("sinks", ()):
        why = known["error"] or known["detail"]
        text = f"{known['state']}, {known['dropped']} dropped{f': {why}' if why else ''}"
        console.print(f"{shown(known['name'])}: {text}", markup=False)


def _away(last_seen: str | None) -> str:
    return f"away, last seen {local_time(last_seen)}" if last_seen else "away"


def _verdict(node: dict[str, Any], *, locked: bool) -> str:
    if node["verdict"] is None:
        return "not verified yet"
    running = node["measuring"] is not None and node["measuring"]["state"] == "running"
    stale = _OF_LAST_SESSION if locked and not running else ""
    if node.get("unverified"):
        return f"unverified (its datasheet is not signed){stale}"
    verdict = node["verdict"]["verdict"]
    if node["present"] and not running and not stale and (node["problem"] or node.get("heard")):
        # what answers there now opened no session, so it may be another board under this UUID
        return f"not verified now ({verdict} when last read)"
    kept = " (stored copy, except the Security TEDS)" if node["verdict"]["from"] == "kept" else ""
    return f"{verdict}{kept}{stale}"


def _link(link: dict[str, Any]) -> str:
    problem = f": {link['problem']['message']}" if link["problem"] else ""
    others = f", {link['strangers']} not on the whitelist" if link["strangers"] else ""
    return f"{link['place']}: {link['state']}, {counted(link['nodes'], 'node')}{others}{problem}"


@command(
    "teds-provision ncap measure all",
    "teds-provision ncap measure type:magnetic-angular-position-sensor --rate 100",
    "teds-provision ncap measure 'group:arm,angle >= 360 deg' --frozen",
    "teds-provision ncap measure all --stop",
    name="measure",
)
@click.argument("expression", metavar="EXPR")
@measurement_option("rate", purpose="Maximum samples per second.")
@click.option("--frozen", is_flag=True, help="Only the nodes that match now, as one group array; none joins or leaves.")
@click.option("--to", "files", multiple=True, metavar="NAME", help="Record to NAME.mcap, .jsonl, .csv; repeatable.")
@click.option("--stop", is_flag=True, help="End the measurement of EXPR or with this id; all ends every one.")
@pass_app
def measure(app: App, expression: str, rate: float | None, frozen: bool, files: Sequence[str], stop: bool) -> None:
    """Measure every authentic node that matches, or --stop.

    Runs on the base station that is already running. EXPR is all, a group, or terms joined by commas, all of which must
    match: type:PROFILE, name:GLOB, group:NAME and bounds such as 'angle >= 360 deg'. The measurement is kept, across
    restarts too, until --stop, or until it is ended on the page or through the API.
    """
    if stop:
        if rate is not None or frozen or files:
            raise UsageError("--stop ends a measurement.", hint="Omit --rate, --frozen and --to.")
        _stop(app, expression)
        return
    with client.connect(home=app.home) as running:
        made = running.measure(match=expression, rate=rate, frozen=frozen, sinks=files)
        present = {node["uuid"] for node in running.nodes() if node["present"]}
    station, match = app.station(), measure_room.matching.NodeMatch.parse(expression)
    found = measure_room.matching.survey(station, match)
    unknown = match.unknown_type(station)
    if unknown:
        near = [name for kind in match.types for name in measure_room.matching.nearest_types(kind, station)]
        meant = f" Did you mean type:{near[0]}?" if near else ""
        app.warn(f"The measurement waits: {unknown}.{meant} To list the profiles: teds-provision profile list")
    others = [{"uuid": uuid, "why": why} for uuid, why in found.others.items()]
    app.emit(
        {**made, "matching": list(found.matching), "others": others},
        "\n".join((f"Measuring {expression} (measurement {made['id']}).", *_match_lines(station, found, present))),
    )


def _stop(app: App, wanted: str) -> None:
    """End the measurements of an expression or group, or the one with an id; raises NotFoundError, PolicyError."""
    with client.connect(home=app.home) as running:
        kept = {measured["id"]: measured for measured in running.measurements()}
        named = {
            id_: measured["match"] or measured["group"] or ", ".join(measured["uuids"])
            for id_, measured in kept.items()
        }
        meant = [id_ for id_, what in named.items() if wanted in (id_, what, "all")]
        commands = [id_ for id_ in meant if kept[id_]["owner"] == COMMAND]
        ends = [id_ for id_ in meant if id_ not in commands]
        if commands and not ends:
            process = kept[commands[0]]["process"]
            which = f" (process {process['id']})" if process is not None else ""
            raise PolicyError(f"{wanted} is measured by a command{which}.", hint="End it there: Ctrl-C, or SIGTERM.")
        if not meant and wanted != "all":
            known = "; ".join(f"{id_} ({what})" for id_, what in named.items()) or "none"
            raise NotFoundError(f"No measurement {wanted!r} is kept.", hint=f"Kept: {known}.")
        for id_ in ends:
            running.end_measurement(id_)
    text = "; ".join(f"{id_} ({named[id_]})" for id_ in ends)
    app.emit({"stopped": ends}, f"Ended: {text}." if ends else "Nothing to do: no measurement is kept.")


def _match_lines(station: Station, found: MatchSurvey, present: Set[str]) -> list[str]:
    """Return how many known nodes match now, and why the others do not."""
    names = {uuid.hex(): name for uuid, name in station.nodes.names().items()}

    def named(uuids: Sequence[str]) -> str:
        more = f" and {len(uuids) - _MOST_NAMED} more" if len(uuids) > _MOST_NAMED else ""
        return ", ".join(shown(names.get(uuid, uuid)) for uuid in uuids[:_MOST_NAMED]) + more

    matching = found.matching
    there = sum(uuid in present for uuid in matching)
    verb = "matches" if len(matching) == 1 else "match"
    lines = [f"{count_of(len(matching))} {verb} now{f', {there} present: {named(matching)}' if matching else ''}."]
    reasons: dict[str, list[str]] = {}
    for uuid, why in found.others.items():
        reasons.setdefault(why, []).append(uuid)
    lines += [f"Not {named(uuids)}: {why}." for why, uuids in list(reasons.items())[:_MOST_REASONS]]
    if len(reasons) > _MOST_REASONS:
        lines.append(f"{len(reasons) - _MOST_REASONS} more reasons are in the output of --json.")
    return lines


@command("teds-provision ncap detection transparent", name="detection")
@click.argument("mode", type=click.Choice(["transparent", "whitelist"]))
@pass_app
def detection(app: App, mode: Mode) -> None:
    """Set which nodes to accept: all, or those on the whitelist."""
    with client.connect(home=app.home) as station:
        now = station.set_detection(mode)
    app.emit({"detection": now}, f"Detection: {now}.")


@command("teds-provision ncap open", "teds-provision ncap open --read-only", name="open")
@click.option("--read-only", is_flag=True, help="The token may read but change nothing.")
@pass_app
def open_page(app: App, *, read_only: bool) -> None:
    """Print the page's address with a one-time token.

    The token is valid for five minutes.
    """
    with client.connect(home=app.home) as station:
        url = station.login_url(read_only=read_only)
    app.emit({"url": url}, url)


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision ncap token add plotter --read-only", "teds-provision ncap token list"),
)
def token() -> None:
    """Manage API tokens for scripts. Only their digests are stored."""


@command("teds-provision ncap token add plotter --read-only", name="add")
@click.argument("name")
@click.option("--read-only", is_flag=True, help="The token may read but change nothing.")
@pass_app
def add(app: App, name: str, *, read_only: bool) -> None:
    """Create a token and print it; it is not shown again.

    Send it as `Authorization: Bearer TOKEN`.
    """
    app.station()
    made = tokens.Tokens(app.home).add(name, read_only=read_only)
    app.emit({"name": name, "token": made, "read_only": read_only}, made)


@command("teds-provision ncap token list", name="list")
@pass_app
def list_tokens(app: App) -> None:
    """List every valid token, including those of browsers."""
    app.station()
    found = [
        {
            "name": token.name,
            "kind": token.kind,
            "read_only": token.read_only,
            "created": iso(datetime.fromtimestamp(token.created, UTC)),
            "until": iso(datetime.fromtimestamp(token.until, UTC)) if token.until else None,
        }
        for token in tokens.Tokens(app.home).all()
    ]
    lines = [f"{known['name']}  {known['kind']}{'  read-only' if known['read_only'] else ''}" for known in found]
    app.emit(
        {"tokens": found}, "\n".join(lines) or "There are no tokens. To create one: teds-provision ncap token add NAME"
    )


@command("teds-provision ncap token remove plotter", name="remove")
@click.argument("name")
@pass_app
def remove(app: App, name: str) -> None:
    """Revoke a token.

    Its user is refused from now on; the name `browser` logs out every browser.
    """
    app.station()
    gone = tokens.Tokens(app.home).remove(name)
    app.emit({"removed": name, "count": gone}, f"Removed: {name}.")


for subcommand in (add, list_tokens, remove):
    token.add_command(subcommand)

for subcommand in (run, status, measure, detection, open_page, token):
    ncap.add_command(subcommand)
