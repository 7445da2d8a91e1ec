"""``sample``, ``set``, ``mode``: one node, one moment."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final

import click

from teds_provision import measure, provisioning
from teds_provision.cli.context import App, Console, Station, pass_app
from teds_provision.cli.options import ChannelName, Number, command, link_options, options_given
from teds_provision.cli.rendering import print_table, reporter_for, shown, tidy
from teds_provision.cli.shape_options import measurement_option
from teds_provision.errors import NodeRefusedError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.protocol.operation.commands import POWER, ChannelState, OperationReply, PowerReply, bit_words
from teds_provision.provisioning.conversation import Conversation
from teds_provision.teds.channel import within_turn
from teds_provision.teds.sheet import Channel


def over_the_bus(links: LinkSettings, *, streams: bool = False) -> LinkSettings:
    """Return the links of a command for which a named bus is meant, also without ``--via can``.

    A bus on this command line takes precedence over a reader in config.toml or a variable. ``streams``: so does every
    named bus, as a reader carries none.
    """
    named_options = options_given("via", "nfc", "can", "ble")
    bus = _bus_meant(links, named_options)
    reader_is_meant = named_options & {"via", "nfc"} or (links.nfc and not streams and bus not in named_options)
    if bus is not None and links.via == "nfc" and not reader_is_meant:
        return replace(links, via=bus)
    return links.after_agreeing()


def _bus_meant(links: LinkSettings, named_options: set[str]) -> str | None:
    """Return the bus, or the air, that is named; of both the one on the command line, else the bus."""
    named = [name for name, given in (("can", links.can), ("ble", links.ble)) if given]
    here = [name for name in named if name in named_options]
    return next(iter(here or named), None)


def where_met(station: Station, links: LinkSettings, uuids: Sequence[bytes]) -> LinkSettings:
    """Return the links with the bus of these nodes' last contact, if none is named; all of them on the same kind."""
    places = provisioning.meeting.likely_places(station, links, uuids)
    kinds = {place.partition(":")[0] for place in places}
    if len(kinds) != 1:
        return links
    wheres = tuple(place.partition(":")[2] for place in places)
    return replace(links.at(places[0]), can=wheres) if kinds == {"can"} else links.at(places[0])


@contextmanager
def trusted_node(
    app: App, station: Station, links: LinkSettings, uuid: bytes, *, by: str
) -> Iterator[measure.verified_session.VerifiedSession]:
    """Yield a node in a session, its datasheet verified for the command ``by``; left in order."""
    reporter = reporter_for(app)
    with provisioning.meeting.meet(
        station, over_the_bus(links), uuid, reporter, before=lambda: station.unlock(uuid)
    ) as node:
        try:
            yield measure.verified_session.open_trusted(station, node, by=by)
        except provisioning.conversation.SessionLostError as lost:
            raise lost.cause from lost


@command(
    "teds-provision sample 8d4d --can socketcan:can0",
    "teds-provision sample 8d4d 1 3 --nfc usb",
)
@click.argument("node", metavar="UUID")
@click.argument("channels", nargs=-1, type=ChannelName(), metavar="[CHANNEL …]")
@link_options
@pass_app
def sample(app: App, node: str, channels: Sequence[int | str], links: LinkSettings) -> None:
    """Take one reading, with the datasheet verified and the values calibrated. By default every sensor is read.

    If the node has restarted since its datasheet was read, only the Security TEDS is read again ("from": "kept" with
    --json); values come from the signed copy. verify UUID reads all of it.
    """
    station = app.station()
    uuid = station.nodes.resolve(node)
    standing = measure.standing.NodeStanding(station, uuid)
    with trusted_node(app, station, links, uuid, by="sample") as trusted:
        samples = measure.sampling.take_samples(trusted, [trusted.channel(chosen).number for chosen in channels])
        standing.require()
    origin = "kept" if trusted.kept else "session"
    result = {"uuid": uuid.hex(), "from": origin, "samples": [sample.as_json() for sample in samples]}
    app.emit(result, lambda console: _samples(console, samples))


def _text(sample: measure.sampling.Sample, value: float) -> str:
    if sample.turn is None or sample.shown is None:
        return f"{value:.6g}"
    return within_turn(value, sample.shown, sample.turn)


def _samples(console: Console, samples: Sequence[measure.sampling.Sample]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("channel", "name", "value", "±", "unit", "raw", box=None, pad_edge=False)
    for sample in samples:
        shown_value = sample.as_json().get("shown") or {
            "value": sample.value,
            "uncertainty": sample.uncertainty,
            "unit": sample.unit,
        }
        sure = shown_value["uncertainty"]
        value = (
            _text(sample, tidy(shown_value["value"], sure))
            if shown_value["value"] is not None
            else f"not valid: {sample.why}"
        )
        value = f"{value} ({shown(sample.text)})" if sample.text else value
        uncertainty = f"{sure:.3g}" if sure is not None else ""
        name = escape(shown(sample.name))
        table.add_row(
            str(sample.channel), name, escape(value), uncertainty, escape(shown_value["unit"]), str(sample.raw)
        )
    print_table(console, table)


@command("teds-provision mode 8d4d --can socketcan:can0")
@click.argument("node", metavar="UUID")
@link_options
@pass_app
def mode(app: App, node: str, links: LinkSettings) -> None:
    """Show a node's operating mode, the state of each channel, and power."""
    station = app.station()
    uuid = station.nodes.resolve(node)
    power: PowerReply | None = None
    with trusted_node(app, station, links, uuid, by="mode") as trusted:
        found = measure.verified_session.operation(trusted.node)
        try:
            power = PowerReply.decode(trusted.node.request(POWER, "to report its power"))
        except NodeRefusedError:
            power = None
        names = {channel.number: channel.name for channel in trusted.sheet.channels}
    result = {
        "uuid": uuid.hex(),
        "mode": "measurement" if found.measuring else "configuration",
        "channels": [
            {"channel": number, "name": names.get(number, ""), "state": words(state), "claimant": claimant}
            for number, (state, claimant) in sorted(found.channels.items())
        ],
        "power": power.as_json() if power is not None else None,
        "charging": _charging(station, trusted.node),
    }
    app.emit(result, lambda console: _mode(console, found, names, power))


def words(state: int) -> list[str]:
    """Return the state bits of a channel as words."""
    return bit_words(ChannelState, state)


def _charging(station: Station, node: Conversation) -> dict[str, Any] | None:
    """Return the charge from a tap, else the last report, with the time; a hint."""
    if node.contact.charging is not None:
        return dict(node.contact.charging.to_json())
    known = station.nodes.get(node.uuid)
    return dict(json.loads(known.charging)) if known is not None and known.charging else None


def _mode(console: Console, found: OperationReply, names: dict[int, str], power: PowerReply | None) -> None:
    from rich.markup import escape
    from rich.table import Table

    console.print(f"{'measurement' if found.measuring else 'configuration'} mode")
    table = Table("channel", "name", "state", "claimed by", box=None, pad_edge=False)
    for number, (state, claimant) in sorted(found.channels.items()):
        by = f"0x{claimant:02X}" if claimant else ""
        table.add_row(str(number), escape(shown(names.get(number))), ", ".join(words(state)) or "idle", by)
    print_table(console, table)
    if power is not None and power.level is not None:
        console.print(f"Battery {power.level} %")


@command(
    "teds-provision set 91aa 1 0.5 --can socketcan:can0",
    "teds-provision set 91aa 1 45 --unit degree --hold 3 --can socketcan:can0",
    "teds-provision set hand opening 50 --unit mm --can socketcan:can0",
    "teds-provision set 91aa 1 -0.5 --can socketcan:can0",
    name="set",
    context_settings={"ignore_unknown_options": True},  # -0.5 is a value, not an option
)
@click.argument("node", metavar="UUID")
@click.argument("channel", type=ChannelName())
@click.argument("value", type=float)
@click.option("--unit", metavar="U", help="Unit of VALUE (default: the SI unit of the datasheet).")
@click.option("--hold", type=Number(min=0), metavar="S", help="Seconds to hold the value (default: until Ctrl-C).")
@measurement_option("dead_man", purpose="Time without set points before the safe state.")
@link_options
@pass_app
def set_value(
    app: App,
    node: str,
    channel: int | str,
    value: float,
    links: LinkSettings,
    unit: str | None,
    hold: float | None,
    dead_man: int,
) -> None:
    """Drive an actuator, hold the value, then return it to its safe state.

    Name the actuator, or the quantity that it sets: opening for opening set point.

    Limits come from the signed datasheet and cannot be exceeded (exit 6). This is not a safety function: see
    docs/actuators.md.
    """
    if not math.isfinite(value):
        raise UsageError("VALUE is not a finite number.")
    station = app.station()
    uuid = station.nodes.resolve(node)
    measure.standing.require_whitelisted(station, uuid)
    standing = measure.standing.NodeStanding(station, uuid)
    standing.drives = True
    stop = provisioning.meeting.IdleStop(None)
    links = where_met(station, over_the_bus(links), [uuid])
    with (
        measure.sources.own_source_address(station, links, f"set {uuid.hex()}") as own,
        trusted_node(app, station, own, uuid, by="set") as trusted,
        ending(stop),
    ):
        actuator = measure.held_actuator.HeldActuator(trusted, channel, unit=unit, dead_man=dead_man)
        driven = actuator.channel
        _require_unit(app, driven, value, unit)
        actuator.octets_of(value)  # checks the limits before the channel is claimed
        station.audit("set", uuid, "begun", channel=driven.number, value=value, unit=actuator.unit.text)
        with actuator:
            until = None if hold is None else time.monotonic() + hold
            reported = False
            while True:
                standing.require()
                applied = actuator.apply(value)
                if not reported:
                    reported = True
                    app.emit({"applied": applied.as_json()}, f"Channel {driven.label}: {_near(driven, applied)}")
                left = actuator.pause if until is None else min(actuator.pause, until - time.monotonic())
                if left <= 0 or stop.wait(left):
                    break
    station.audit("set", uuid, "done", channel=driven.number, safe=actuator.safe)
    safe = actuator.require_confirmation()
    app.emit({"event": "end", "safe": safe}, "safe" if safe else "NOT in its safe state")


_ZERO: Final = 1e-9
"""Part of a channel's range below which a set point is 0 but for rounding."""


def _near(channel: Channel, applied: measure.held_actuator.AppliedSetPoint) -> str:
    """Return a set point for people: one that rounding alone keeps from 0 is 0."""
    span = max(abs(channel.low), abs(channel.high))
    zero = math.isfinite(span) and abs(applied.value) < _ZERO * span
    return f"{0.0 if zero else applied.value:g} {applied.unit}".rstrip()


def _require_unit(app: App, channel: Channel, value: float, unit: str | None) -> None:
    """Refuse a bare number if this channel's display unit is not SI: 45 would be radians."""
    if unit is None and app.interactive and channel.shown.text != channel.si_unit:
        raise UsageError(
            f"Without --unit, {value:g} means {value:g} {channel.si_unit}, but channel {channel.label} is shown in "
            f"{channel.shown.text}.",
            hint=f"Add --unit {channel.shown.text} or --unit {channel.si_unit}.",
        )


@contextmanager
def ending(stop: provisioning.meeting.IdleStop) -> Iterator[None]:
    """End in order at the first Ctrl-C or SIGTERM, at once with 130 at a second one.

    So does a terminal that is closed (SIGHUP, twice if the shell passes it on), unless nohup has it ignored: a
    recording gets its end, and nodes are released at once.
    """

    def end(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.request_stop()

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        before[signal.SIGHUP] = signal.signal(signal.SIGHUP, lambda *_: stop.request_stop())
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
