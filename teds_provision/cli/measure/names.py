"""``names``: under which topics channels are published (ROS, MQTT, recordings)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

import click

from teds_provision import measure, provisioning, teds
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, ChannelName, command, dry_run_option, examples
from teds_provision.errors import NotFoundError, UsageError
from teds_provision.station.measurements import STATION
from teds_provision.station.shown_units import channel_profiles
from teds_provision.station.station import Station


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision names list", "teds-provision names set 8d4d 1 crane/slew_angle"),
)
def names() -> None:
    """Manage channel topics: /STATION/NODE/CHANNEL unless you choose others. Fixed while a node is measured."""


@names.command("list", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision names list"))
@pass_app
def list_names(app: App) -> None:
    """List the topic of every channel with a known datasheet."""
    _print_names(app, app.station())


@command(
    "teds-provision names set 8d4d 1 crane/slew_angle",
    "teds-provision names set 8d4d 0 slew",
    "teds-provision names set station 0 crane_7",
    name="set",
)
@click.argument("node", metavar="UUID|station")
@click.argument("channel", type=ChannelName(0))
@click.argument("name")
@dry_run_option
@pass_app
def set_name(app: App, node: str, channel: int | str, name: str, *, dry_run: bool) -> None:
    """Publish a channel under NAME.

    Channel 0 means the node's or station's own part of its topics.
    """
    station = app.station()
    uuid = _who(station, node)
    chosen = name.strip("/")
    if not measure.sinks.names.is_topic(chosen) or (not channel and "/" in chosen):
        raise UsageError(
            f"{name!r} is not a valid topic name.",
            hint="Use letters, digits and single _, starting with a letter; / separates the parts of a channel's name.",
        )
    channel = _require_channel(station, uuid, channel)
    if uuid != STATION:
        topics = measure.sinks.names.Topics(measure.measurement_job.station_facts(station))
        topics.learn(facts for _, _, facts in _channels(station))
        topics.require_free(uuid.hex(), channel, chosen)
    _change(app, station, partial(_rename, station, uuid, channel, chosen), dry_run=dry_run)


@command("teds-provision names reset 8d4d 1", name="reset")
@click.argument("node", metavar="UUID|station")
@click.argument("channel", type=ChannelName(0))
@dry_run_option
@pass_app
def reset_name(app: App, node: str, channel: int | str, *, dry_run: bool) -> None:
    """Publish a channel under its default name.

    Channel 0 means the node's or station's own part of its topics.
    """
    station = app.station()
    uuid = _who(station, node)
    if isinstance(channel, str):  # a number may refer to a channel that the datasheet no longer has
        channel = _require_channel(station, uuid, channel)
    _change(app, station, partial(_rename, station, uuid, channel, None), dry_run=dry_run)


@command(
    "teds-provision names frame 8d4d 1 left_gripper_tip",
    "teds-provision names frame 8d4d 0 left_gripper_base",
    name="frame",
)
@click.argument("node", metavar="UUID")
@click.argument("channel", type=ChannelName(0))
@click.argument("frame", metavar="FRAME")
@dry_run_option
@pass_app
def set_frame(app: App, node: str, channel: int | str, frame: str, *, dry_run: bool) -> None:
    """Choose the coordinate frame of a channel for ROS.

    Values are published with FRAME as their frame_id; "" restores the profile's.

    Channel 0 means every channel of the node without a frame of its own.
    """
    station = app.station()
    uuid = station.nodes.resolve(node)
    if frame and not measure.sinks.names.is_frame(frame):
        raise UsageError(
            f"{frame!r} is not a valid frame.", hint="Use letters, digits, _ and /, starting with a letter."
        )
    channel = _require_channel(station, uuid, channel)

    def change() -> None:
        station.measurements.set_frame(uuid, channel, frame or None)
        station.audit("frame", uuid, "done", channel=channel, frame=frame)

    _change(app, station, change, dry_run=dry_run)


def _who(station: Station, node: str) -> bytes:
    return STATION if node == "station" else station.nodes.resolve(node)


def _require_channel(station: Station, uuid: bytes, channel: int | str) -> int:
    """Return the number of a channel that was chosen by number or name; raises NotFoundError."""
    known = {number: facts.name for key, number, facts in _channels(station) if key == uuid}
    if isinstance(channel, str):
        alike = [number for number, name in known.items() if name.casefold() == channel.casefold()]
        if len(alike) == 1:
            return alike[0]
    elif not channel or (uuid != STATION and (not known or channel in known)):
        return channel
    has = ", ".join(f"{number} ({name})" if name else str(number) for number, name in sorted(known.items())) or "none"
    which = repr(channel) if isinstance(channel, str) else channel
    raise NotFoundError(f"{uuid.hex()} has no channel {which}.", hint=f"Channels in its datasheet: {has}.")


def _rename(station: Station, uuid: bytes, channel: int, name: str | None) -> None:
    station.measurements.rename(uuid, channel, name)
    station.audit("rename", None if uuid == STATION else uuid, "done", channel=channel, name=name)


class _PlannedError(Exception):
    """Rolls a change back that was tried out."""


def _change(app: App, station: Station, change: Callable[[], None], *, dry_run: bool) -> None:
    """Change names or frames and print them all; ``dry_run`` prints them as they would be."""
    with station.lock("names", app.note), suppress(_PlannedError), station.transaction():
        change()
        if dry_run:
            app.note("Plan, nothing is changed:")
            _print_names(app, station)
            raise _PlannedError
    if not dry_run:
        _print_names(app, station)


def _channels(station: Station) -> list[tuple[bytes, int, measure.blocks.ChannelFacts]]:
    """Return every channel of a stored datasheet, with the facts that make its name."""
    found = []
    for record in station.nodes.all():
        image = station.datasheets.datasheet(record.uuid)
        if image is None:
            continue
        sheet, judged = teds.sheet.Sheet.from_image(image), provisioning.readings.verdict_of(station, record.uuid)
        # an unsigned node has only the name from its own TEDS
        unsigned = judged is not None and judged.verified.verdict == "unsigned"
        name = sheet.meta.name if unsigned else record.name or ""
        for channel in sheet.channels:
            facts = measure.blocks.ChannelFacts(
                record.uuid.hex(), name, channel.number, channel.name, unverified=unsigned
            )
            found.append((record.uuid, channel.number, facts))
    return found


def _print_names(app: App, station: Station) -> None:
    chosen = station.measurements.names
    facts = measure.measurement_job.station_facts(station)
    topics = measure.sinks.names.Topics(facts)
    channels = _channels(station)
    topics.learn(facts for _, _, facts in channels)
    frames = station.measurements.frames
    rows: list[dict[str, Any]] = [
        {
            "uuid": uuid.hex(),
            "channel": number,
            "topic": topics.channel(uuid.hex(), number),
            "chosen": (uuid, number) in chosen or (uuid, 0) in chosen,
            "frame": _frame(station, frames, topics, uuid, number) or None,
        }
        for uuid, number, _ in channels
    ]
    lines = [
        f"{row['uuid']} {row['channel']}: {row['topic']}{' (chosen)' if row['chosen'] else ''}"
        + (f", frame {row['frame']}" if row["frame"] else "")
        for row in rows
    ]
    app.emit({"station": topics.station, "names": rows}, "\n".join(lines) or "No datasheets are known yet.")


def _frame(
    station: Station,
    chosen: Mapping[tuple[bytes, int], str],
    topics: measure.sinks.names.Topics,
    uuid: bytes,
    number: int,
) -> str:
    of_type = channel_profiles(station, uuid).get(number)
    frame = chosen.get((uuid, number)) or chosen.get((uuid, 0)) or (of_type.frame if of_type else "")
    return frame.replace("{node}", topics.node(uuid.hex()))


for subcommand in (set_name, reset_name, set_frame):
    names.add_command(subcommand)
