"""``measure``: nodes or a group, streamed, verified, calibrated, into files and topics; ``measure recover``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from teds_provision import measure as measure_room
from teds_provision import provisioning, teds
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.measure.sample import ending, over_the_bus, where_met
from teds_provision.cli.named_files import read_file
from teds_provision.cli.options import (
    Number,
    command,
    exposure_options,
    file_units_option,
    foxglove_address,
    foxglove_options,
    link_options,
)
from teds_provision.cli.shape_options import measurement_options
from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.lazy import late
from teds_provision.links import LINKS, LinkSettings
from teds_provision.links.opening import open_ports
from teds_provision.links.streaming import measuring_links
from teds_provision.sanitize import counted
from teds_provision.shapes.measurement import OPTIONS
from teds_provision.station.store.records import COMMAND, KeptMeasurement

if TYPE_CHECKING:
    from teds_provision.cli.measure import measure_view
    from teds_provision.measure.display_units import FileUnits
    from teds_provision.measure.request import Requirements
    from teds_provision.measure.running.measurement import MeasurementEnd
    from teds_provision.measure.running.measurement_job import MeasurementJob
    from teds_provision.measure.sinks.mcap.recover import RecoveryResult
else:  # imports the sinks and numpy
    measure_view = late("teds_provision.cli.measure.measure_view")

MOST_NAMED = 3
_ABOVE = ("rate", "channels", "kind", "trigger", "test_pattern", "unsigned", "actuators", "dead_man", "require")
"""Settings whose options stand above others in the help; one that is added is the last."""

CONTINUED_WITH = {"test_pattern": "test pattern", "unsigned": "including unsigned nodes", "require": "with --require"}
"""Words for each setting of a measurement that goes on, printed beside its rate and sinks."""


@command(
    "teds-provision measure 8d4d --can socketcan:can0 --to run.csv --to run.mcap",
    "teds-provision measure hand --can socketcan:can0 --duration 60 --ros2",
    "teds-provision measure hand --can socketcan:can0 --duration 60 --to run.csv --wide",
    "teds-provision measure 8d4d --ble hci0 --duration 60 --to run.csv",
    "teds-provision measure recover run.mcap",
)
@click.argument("what", nargs=-1, required=True, metavar="NAME|UUID …")
@measurement_options("rate")
@click.option("--duration", type=Number(min=0.1), metavar="S", help="Seconds (default: until Ctrl-C).")
@measurement_options("channels", "kind", "trigger", "test_pattern", "unsigned")
@click.option(
    "--to", "files", multiple=True, metavar="FILE", help="Record to this file: .csv, .txt, .mcap, .jsonl; repeatable."
)
@click.option(
    "--wide",
    is_flag=True,
    help="Write .csv and .txt as one table: a row per time, a column per channel, no raw values.",
)
@file_units_option
@click.option("--output", "-o", type=click.Path(path_type=Path), metavar="FILE", help="With recover: the new file.")
@click.option("--ros1", is_flag=True, help="Publish to ROS 1 (ROS_MASTER_URI).")
@click.option("--ros2", is_flag=True, help="Publish to ROS 2 (ROS_DOMAIN_ID), on this machine.")
@click.option("--mqtt", metavar="URL", help="Publish to a broker: mqtt://HOST, with Home Assistant discovery.")
@foxglove_options
@exposure_options
@measurement_options("actuators", "dead_man", "require")
@click.option("--require-firmware", is_flag=True, help="Refuse nodes whose firmware their type does not accept.")
@measurement_options(but=_ABOVE)
@link_options
@pass_app
def measure(
    app: App,
    /,
    what: Sequence[str],
    links: LinkSettings,
    duration: float | None,
    files: Sequence[str],
    wide: bool,
    file_units: FileUnits,
    mqtt: str | None,
    foxglove: bool,
    foxglove_at: str | None,
    no_scalars: bool,
    allow: Sequence[str],
    certificate: Path | None,
    key: Path | None,
    require: Path | None,
    output: Path | None,
    **wished: Any,
) -> None:
    """Measure a group or nodes until Ctrl-C or --duration: open sessions, verify datasheets, claim, stream.

    `measure recover FILE` repairs a recording that was cut off. If FILE is damaged inside, it stays unchanged, and
    everything but the damaged chunks is written to FILE.recovered or --output (exit 8).
    """
    if what[0] == "recover":
        _recover(app, what[1:], output)
        return
    if click.get_current_context().get_parameter_source("output") is ParameterSource.COMMANDLINE:
        raise UsageError("--output only works with `measure recover`.", hint="To record, use --to FILE.")
    exposure = measure_room.exposure.Exposure(tuple(allow), certificate, key)
    exposure.require_pair()
    address = foxglove_address(foxglove, foxglove_at)
    if address is not None:
        measure_room.sinks.foxglove_server.address_of(address, exposure)
    if wide:
        files = _wide(files)
    files = [measure_room.sinks.in_units(name, file_units) for name in files]
    links = over_the_bus(links, streams=True)
    if mqtt is not None and not mqtt.startswith(("mqtt://", "mqtts://")):
        raise UsageError(f"--mqtt {mqtt!r} is not a broker URL.", hint="Use mqtt://HOST or mqtts://USER@HOST.")
    station = app.station()
    group, uuids = _who(station, what)
    links = where_met(station, links, uuids)
    _require_streams(links, trigger=wished["trigger"])
    ros = [name for name in ("ros1", "ros2") if wished[name]]
    sinks = [*files, *ros, *filter(None, [mqtt]), *([f"foxglove:{address}"] if address else [])]
    if no_scalars:
        sinks = [measure_room.sinks.without_scalars(sink) for sink in sinks]
    wished["channels"] = _numbers(station, uuids, wished["channels"])
    kept = _asked(group, uuids, sinks, wished | {"require": _requirements(require)})
    if group and duration is None:
        kept = _carried_on(app, station, kept)
    job = measure_room.measurement_job.MeasurementJob(
        station,
        kept,
        request=measure_room.request.MeasurementRequest(
            timeout=links.timeout, require_firmware=wished["require_firmware"]
        ),
        opened=lambda spec, take: measure_room.sinks.open_sink(spec, take, exposure),
    )
    for uuid in uuids:
        station.unlock(uuid)
    _propose_rate(app, job, uuids)
    ended = _run(app, job, links, uuids, duration)
    again = "" if ended.lower_rate is None else _at_rate(job, uuids, ended.lower_rate)
    _print_end(app, ended, job.request.requirements, file_units, again)


def _numbers(station: Station, uuids: Sequence[bytes], channels: Sequence[int | str]) -> list[int]:
    """Return the numbers of channels that were chosen by number or name, by the datasheets that the store has.

    Raises BadDataError (no channel of that name), UsageError (it has another number on another node).
    """
    numbers: list[int] = []
    for chosen in channels:
        if isinstance(chosen, int):
            numbers.append(chosen)
            continue
        found: dict[int, str] = {}
        for uuid in uuids:
            image = station.datasheets.datasheet(uuid)
            if image is None:
                raise UsageError(
                    f"The channels of node {uuid.hex()} are not known yet, so {chosen!r} cannot be looked up.",
                    hint=f"Give its number, or read the node first: teds-provision verify {uuid.hex()}",
                )
            found.setdefault(teds.sheet.Sheet.from_image(image).chosen(chosen, uuid.hex()).number, uuid.hex())
        if len(found) > 1:
            where = ", ".join(f"{number} on {uuid}" for number, uuid in found.items())
            raise UsageError(f"Channel {chosen!r} has different numbers: {where}.", hint="Measure them one by one.")
        numbers += found
    return numbers


def _require_streams(links: LinkSettings, *, trigger: bool) -> None:
    if not LINKS[links.via].capabilities.streams:
        raise UsageError(
            "Streaming needs CAN or Bluetooth.",
            hint="Add --can or --ble. For one reading over NFC: teds-provision sample UUID",
        )
    if trigger and not LINKS[links.via].capabilities.triggers:
        raise UsageError("--trigger needs a CAN bus.", hint="Omit --trigger over Bluetooth.")


def _asked(group: str, uuids: Sequence[bytes], sinks: Sequence[str], wished: Mapping[str, Any]) -> KeptMeasurement:
    """Return the request of the command line, as a group keeps it."""
    settings = {name: wished[name] for name in OPTIONS} | {
        "channels": tuple(dict.fromkeys(wished["channels"])),
        "actuators": wished["actuators"] and (wished["ros1"] or wished["ros2"]),
    }
    return KeptMeasurement(
        "",
        group=group or None,
        uuids=() if group else tuple(uuids),
        sinks=tuple(measure_room.measurement_job.whole_path(spec) for spec in sinks),
        owner=COMMAND,
        **settings,
    )


def _wide(files: Sequence[str]) -> list[str]:
    """Return the strings for text files whose rows are one grid."""
    text = [Path(name).suffix.lower() in measure_room.sinks.TEXT for name in files]
    if not any(text):
        raise UsageError("--wide only works with text files.", hint="Add --to FILE.csv")
    return [f"wide:{name}" if is_text else name for name, is_text in zip(files, text, strict=True)]


def _requirements(file: Path | None) -> str:
    """Return the task's requirements on the datasheets, "" without a file; raises BadDataError if it has none."""
    if file is None:
        return ""
    text = read_file(file).decode(errors="replace")
    teds.fits.parse_require(text, str(file))
    return text


def _who(station: Station, what: Sequence[str]) -> tuple[str, list[bytes]]:
    """Return the group's name ("" if nodes are named) and the UUIDs."""
    if len(what) == 1 and (group := station.groups.find(what[0])) is not None:
        if not group.uuids:
            raise UsageError(f"Group {group.name!r} has no nodes.", hint=f"Add one: group add {quote(group.name)} UUID")
        return group.name, list(group.uuids)
    try:
        return "", list(dict.fromkeys(station.nodes.resolve(text) for text in what))
    except NotFoundError as error:
        if len(what) > 1:
            raise
        groups = ", ".join(quote(group.name) for group in station.groups.all()) or "none"
        raise NotFoundError(
            f"No node or group is known as {what[0]!r}.",
            hint=f"Groups: {groups}. To make one: group create {quote(what[0])} UUID … Nodes: see nodes.",
        ) from error


def _carried_on(app: App, station: Station, asked: KeptMeasurement) -> KeptMeasurement:
    """Return what is kept of the group, if nothing else was requested; else the request."""
    kept = station.measurements.settings_to_continue(asked.group or "")
    plain = replace(KeptMeasurement("", group=asked.group, owner=COMMAND), created=asked.created)
    if kept is None or asked != plain:
        return asked
    rate = f"{kept.rate:g} Hz" if kept.rate else "the datasheets' rates"
    to = f" to {', '.join(kept.sinks)}" if kept.sinks else ""
    beside = "".join(f", {words}" for name, words in CONTINUED_WITH.items() if getattr(kept, name))
    app.note(f"Continuing the measurement started at {kept.created}: {rate}{to}{beside}.")
    return kept


def _run(
    app: App, job: MeasurementJob, links: LinkSettings, uuids: Sequence[bytes], duration: float | None
) -> MeasurementEnd:
    station, stop = job.station, provisioning.meeting.IdleStop(None)
    group = job.kept.group or ""
    nodes = [uuid.hex() for uuid in uuids]
    ports = open_ports(links)
    streaming = list(measuring_links(ports))
    try:
        with ExitStack() as stack:
            stack.enter_context(
                measure_room.sources.sole_user(station, streaming, f"measure {group or ', '.join(nodes)}")
            )
            watcher = stack.enter_context(measure_view.watcher_for(app, station, job.sinks, stop))
            stack.enter_context(ending(stop))
            buses = stack.enter_context(measure_room.buses.Buses(streaming, note=app.warn))
            station.audit("measure", None, "begun", nodes=nodes, group=group)
            ended = job.run(buses, stop, watcher=watcher, duration=duration)
    finally:
        for port in ports:
            port.close()
    outcome = "done" if ended.error is None else ended.error.code
    station.audit("measure", None, outcome, nodes=nodes, group=group)
    return ended


def _propose_rate(app: App, job: MeasurementJob, uuids: Sequence[bytes]) -> None:
    """Propose a rate before a measurement at one that this machine may not record without losses."""
    rates = measure_room.rates
    if job.kept.rate is not None or job.kept.kind == "event":
        return
    values, busy = rates.this_machine()
    found = rates.propose(job.station, uuids, job.request, rates.Surroundings(values=values, busy=busy))
    if found is not None and found.limit != "datasheet":
        app.note(
            f"Values may be lost at the datasheet's {found.stated:g} Hz: {found.why}. To measure at {found.rate:g} Hz: "
            f"{_at_rate(job, uuids, found.rate)}"
        )


def _at_rate(job: MeasurementJob, uuids: Sequence[bytes], rate: float) -> str:
    """Return this very command with another rate."""
    words = sys.argv[1:]
    if "measure" not in words:  # called from Python, not from the command line
        words = ["measure", *([job.kept.group] if job.kept.group else [uuid.hex() for uuid in uuids])]
    kept, skip = [], False
    for word in words:
        if not skip and word != "--rate" and not word.startswith("--rate="):
            kept.append(word)
        skip = word == "--rate"
    return shlex.join(["teds-provision", *kept, "--rate", f"{rate:g}"])


def _print_end(
    app: App, ended: MeasurementEnd, require: Requirements | None, file_units: FileUnits, again: str
) -> None:
    """Print how it ended; ``again`` is the same command at a rate at which less would be lost, "" if nothing was."""
    result: dict[str, Any] = {"event": "end", "nodes": ended.nodes, "files": ended.files, "sinks": ended.sinks}
    if again:
        result["lower_rate"] = {"rate": ended.lower_rate, "command": again}
    if ended.files:
        result["unit"] = file_units
    if require is not None:
        result["fits"] = require.fits
    if ended.apart:
        result["began_apart"] = ended.apart
    lines = _end_lines(ended, require) or ["Nothing was measured."]
    if again:
        lines.append(f"Values were lost. A lower rate may help: {again}")
    app.conclude(result, "\n".join(lines), ended.error)


def _end_lines(ended: MeasurementEnd, require: Requirements | None) -> list[str]:
    lines = [_stream_line(node["uuid"], stream) for node in ended.nodes for stream in node["streams"]]
    lines += [f"Written: {name}" for name in ended.files]
    lines += [f"{sink['sink']}: {counted(sink['dropped'], 'value')} dropped" for sink in ended.sinks if sink["dropped"]]
    if require is not None and ended.error is not None:
        lines += [str(fit["why"]) for fit in require.fits if fit["result"] != "passed"]
    return lines


def _stream_line(uuid: str, stream: Mapping[str, Any]) -> str:
    lost = f"lost {stream['lost']}, late {stream['late']}, bad {stream['bad']}, invalid {stream['invalid']}"
    blocks = measure_room.blocks
    why = blocks.why_invalid([blocks.InvalidValues(**invalid) for invalid in stream["invalid_why"]])
    came = f"{counted(stream['samples'], 'value')} in {counted(stream['messages'], 'message')}"
    return f"{uuid}: {came}, {lost}{f' ({why})' if why else ''}"


def _recover(app: App, files: Sequence[str], output: Path | None) -> None:
    if len(files) != 1:
        raise UsageError("Name exactly one recording.", hint="teds-provision measure recover FILE.mcap")
    done = measure_room.sinks.mcap.recover.recover(Path(files[0]), output)
    until = measure_room.sinks.json_events.iso(done.until) if done.until is not None else None
    result: dict[str, Any] = {
        "recovered": {"messages": done.messages, "until": until},
        "file": files[0],
        "cut": done.cut,
        "damaged": [asdict(damage) for damage in done.damaged],
    }
    sentence = "is intact" if done.was_whole else f"repaired ({done.cut} octets of a torn end cut off)"
    if done.output is not None:
        result["output"] = str(done.output)
        sentence = f"is unchanged; its intact part is in {done.output}"
    error = _damage(files[0], done) if done.damaged else None
    text = f"{files[0]} {sentence}: {counted(done.messages, 'message')}" + (f" until {until}" if until else "")
    app.conclude(result, text, error)


def _damage(file: str, done: RecoveryResult) -> BadDataError:
    named = [f"{damage.what} at octet {damage.offset} ({damage.octets} octets)" for damage in done.damaged[:MOST_NAMED]]
    more = len(done.damaged) - len(named)
    return BadDataError(
        f"{file} is damaged inside: {', '.join(named)}{f' and {more} more' if more else ''}.",
        hint=f"The file is unchanged; everything else is in {done.output}. Check the disk.",
    )
