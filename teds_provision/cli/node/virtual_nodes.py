"""``node``: a virtual transducer for trying things out, for tests, and as the other side for firmware authors."""

from __future__ import annotations

import functools
import itertools
import secrets
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import node as node_room
from teds_provision import provisioning, teds
from teds_provision import teds as teds_room
from teds_provision.cli.context import SOCKET, App, pass_app
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    FileToRead,
    Number,
    WholeNumber,
    command,
    dry_run_option,
    examples,
)
from teds_provision.errors import KnownUuidError, StoreError, TedsProvisionError, UsageError
from teds_provision.lazy import late
from teds_provision.node.flash_file import FlashFile
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.store.sqlite import has_store

if TYPE_CHECKING:
    from teds_provision import client
    from teds_provision.node.ble.server import BleServer
    from teds_provision.node.can.server import CanServer
    from teds_provision.node.hardware.board import ActuatorReading, Board
    from teds_provision.node.nfc.tnep import ExtraRecords
    from teds_provision.node.virtual import LinkServer, VirtualNode
    from teds_provision.node.wrapped.running import SensorPlace, WrappedRun
    from teds_provision.protocol.operation.streams import DataFrame
else:
    client = late("teds_provision.client")  # HTTP


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision node create bench/finger",
        "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    ),
)
def node() -> None:
    """Create and run virtual transducers: the complete node side of the profile, with flash in a file."""


_NAME_OCTETS = 120


def _uuid(_ctx: click.Context, _parameter: click.Parameter, text: str | None) -> bytes | None:
    if text is None:
        return None
    try:
        octets = bytes.fromhex(text.removeprefix("0x").removeprefix("0X"))
    except ValueError:
        octets = b""
    if len(octets) != 10:
        raise click.BadParameter("a UUID has 20 hex digits.")
    return octets


def _name(_ctx: click.Context, _parameter: click.Parameter, text: str) -> str:
    try:
        octets = len(text.encode())
    except UnicodeEncodeError:
        raise click.BadParameter("the name is not valid text in this terminal's encoding.") from None
    if octets > _NAME_OCTETS or not (text.isprintable() or not text):
        raise click.BadParameter(f"a name has at most {_NAME_OCTETS} octets of printable text; this one has {octets}.")
    return text


@command(
    "teds-provision node create bench/finger",
    "teds-provision node create bench/angle --profile magnetic-angular-position-sensor --name angle",
    "teds-provision node create bench/copy --teds angle.json",
    "teds-provision node create bench/torque --from dbc:torque.dbc --message Torque",
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--uuid", callback=_uuid, metavar="HEX", help="UUID, 20 hex digits (default: from the file, or random).")
@click.option(
    "--new-uuid", is_flag=True, help="Replace the UUID in the file: two nodes with one UUID cannot be distinguished."
)
@click.option(
    "--name",
    default="",
    callback=_name,
    help="Manufacturer's name for it, at most 120 octets (default: the one in the file).",
)
@click.option(
    "--teds",
    type=FileToRead(),
    metavar="FILE",
    help="File with its datasheet and hardware: image, XML, JSON, hex or binary.",
)
@click.option("--profile", metavar="P", help="Transducer type that defines its datasheet and hardware.")
@click.option(
    "--from",
    "wrapped",
    metavar="SENSOR",
    help="Sensor that it wraps: dbc:FILE, eds:FILE or iio:DEVICE; channels, units and scaling come from there.",
)
@click.option("--message", metavar="NAME", help="Message of the DBC file (default: the only one).")
@click.option(
    "--max-message",
    type=WholeNumber(512, 4094),
    default=2048,
    show_default=True,
    metavar="OCTETS",
    help="Maximum frame length.",
)
@click.option("--firmware", type=FileToRead(), metavar="IMAGE", help="MCUboot image that it runs; with --firmware-key.")
@click.option(
    "--firmware-key", type=FileToRead(), metavar="PEM", help="Owner's public key, which its boot loader checks."
)
@pass_app
def create(
    app: App,
    folder: Path,
    uuid: bytes | None,
    new_uuid: bool,
    name: str,
    teds: Path | None,
    profile: str | None,
    wrapped: str | None,
    message: str | None,
    max_message: int,
    firmware: Path | None,
    firmware_key: Path | None,
) -> None:
    """Create a virtual node in DIR, in factory state, with its own key.

    With --teds or --profile, it has the channels of that datasheet and carries its TEDS unsigned. If this station or
    its running ncap knows the UUID in the file, you are asked for a new one (--new-uuid, or --uuid to name one
    yourself). With --from it wraps
    an existing sensor, whose values `node run --source` reads, and is marked as wrapped.
    """
    named = {"--teds": teds, "--profile": profile, "--from": wrapped}
    given = [name for name, value in named.items() if value is not None]
    if len(given) > 1:
        raise UsageError(
            f"{' and '.join(given)} cannot be combined.", hint="A node has one datasheet: use one of them."
        )
    if message is not None and wrapped is None:
        raise UsageError("--message needs --from dbc:FILE.")
    if new_uuid and (uuid is not None or teds is None):
        raise UsageError("--new-uuid replaces the UUID in a file.", hint="Give it with --teds FILE and without --uuid.")
    uuid = _free_uuid(app, folder, uuid, teds, new_uuid)
    if (firmware is None) != (firmware_key is None):
        raise UsageError("--firmware and --firmware-key belong together.", hint="The boot loader checks each image.")
    sensor = node_room.wrapped.reading.describe(wrapped, message) if wrapped is not None else None
    for note in sensor.notes if sensor is not None else ():
        app.note(note)
    made = node_room.node_template.create(
        folder,
        uuid=uuid,
        name=name,
        max_message=max_message,
        teds=teds,
        profile=profile,
        folders=teds_room.profile.default_folders(app.home),
        sensor=sensor,
    )
    image = None
    if firmware is not None and firmware_key is not None:
        image = node_room.firmware.boot_loader.ImageSlots.create(folder, firmware, firmware_key).running
    flash = made.load()  # if the command is repeated, this is the node that it made before
    print_of_key = fingerprint(flash.node_key)
    channels: list[dict[str, object]] = [
        {
            "channel": channel.number,
            "name": channel.name,
            "kind": channel.kind.word if channel.kind is not None else None,
            "unit": channel.unit.text,
        }
        for channel in teds_room.sheet.Sheet.from_blocks(made.hardware).channels
    ]
    for channel, described in zip(channels, sensor.channels if sensor is not None else (), strict=False):
        channel.update(node_room.wrapped.description.facts(described))
    origin = teds_room.origin.origin_of(made.hardware)
    app.emit(
        {
            "uuid": flash.uuid.hex(),
            "fingerprint": print_of_key,
            "name": made.name,
            "can_address": flash.can_address,
            "channels": channels,
            "origin": origin.to_json() if origin is not None else None,
            "firmware": {"version": image.version_text, "image": image.digest.hex()} if image is not None else None,
        },
        f"Node {flash.uuid.hex()} in {folder}, key {print_of_key[:16]}, CAN address 0x{flash.can_address:02x}"
        + (f", {len(channels)} channel{'' if len(channels) == 1 else 's'}" if channels else "")
        + (f", wraps {origin.text}" if origin is not None else "")
        + (f", firmware {image.version_text}." if image is not None else "."),
    )


def _free_uuid(app: App, folder: Path, uuid: bytes | None, teds: Path | None, new_uuid: bool) -> bytes | None:
    """Return the UUID of a new node: ``uuid``, None for the file's, or a new one if the file's is another node's.

    Raises KnownUuidError without a terminal to ask on.
    """
    made = node_room.flash_file.FlashFile
    if (folder / node_room.flash_file.FILE).exists():
        return made(folder).load().uuid if new_uuid else uuid
    own = secrets.token_bytes(teds_room.formats.UUID_OCTETS)
    if new_uuid:
        return own
    stated = uuid or (node_room.node_template.from_file(teds).uuid if teds is not None else None)
    known = _known_as(app, stated) if stated is not None else None
    if stated is None or known is None:
        return uuid
    if uuid is not None:
        app.warn(f"{known} has this UUID: two nodes with one UUID cannot be distinguished. Run only one of them.")
        return uuid
    found = f"{known} has the UUID {stated.hex()} of {teds}; two nodes with one UUID cannot be distinguished."
    if not app.interactive:
        raise KnownUuidError(
            found,
            hint=f"Add --new-uuid to give the new node its own, or --uuid {stated.hex()} to copy it as it is.",
        )
    app.note(found)
    if not app.ask_yes_no("Create the node with a new UUID?"):
        raise KnownUuidError("Cancelled. Nothing was created.", hint=f"To make the copy anyway: --uuid {stated.hex()}")
    return own


def _known_as(app: App, uuid: bytes) -> str | None:
    """Return what has a UUID already: a node of this home's station, or one on a link of its running ncap."""
    if not has_store(app.home):
        return None
    with suppress(StoreError):  # an unreadable store must not prevent a virtual node
        station = app.station()
        if station.overview.is_known(uuid):
            known = station.nodes.get(uuid)
            return f"Node {known.name!r}" if known is not None and known.name else "A node of this station"
    if (app.home / SOCKET).exists():
        with suppress(TedsProvisionError):
            client.connect(home=app.home).node(uuid.hex())
            return "A node on a link of the running ncap"
    return None


@node.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Reset the node in DIR by hand.",
    epilog=examples("teds-provision node reset bench/finger"),
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@dry_run_option
@pass_app
def reset(app: App, folder: Path, *, dry_run: bool) -> None:
    """Reset the node in DIR by hand (button held for 5 s) while it is not running."""
    node = node_room.virtual.VirtualNode(folder, exclusive=True)
    uuid = node.tim.flash.uuid.hex()
    if dry_run:
        app.emit({"uuid": uuid, "plan": "reset"}, f"Plan: reset node {uuid} to factory state.")
        return
    node.reset_by_hand()
    app.emit({"uuid": uuid, "state": "factory"}, f"Node {uuid} is back in factory state.")


_DEFAULT_SOURCE = "noise"


@command(
    "teds-provision node run bench/finger --nfc udp:localhost:54321",
    "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    "teds-provision node run bench/angle --can udp_multicast:239.74.163.2 --source sine:2",
    "teds-provision node run bench/a bench/b bench/c --can udp_multicast:239.74.163.2",
    "teds-provision node run bench/torque --can socketcan:can0 --source dbc:torque.dbc --bus socketcan:can1",
    "teds-provision node run b --can socketcan:can0 --source canopen:c.eds --bus socketcan:can1 --node-id 5",
    short_help="Run the nodes in DIR … until SIGTERM or Ctrl-C.",
)
@click.argument("folders", metavar="DIR…", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False))
@click.option("--nfc", metavar="PATH", help="Simulated reader to place the node on: udp:localhost:54321 (one node).")
@click.option("--tag", type=click.Choice(["4", "2"]), default="4", show_default=True, help="NFC Forum tag type.")
@click.option(
    "--can", metavar="INTERFACE:CHANNEL", help="Bus to connect to; without --nfc, a factory node counts as tapped."
)
@click.option(
    "--ble",
    metavar="CONTROLLER",
    help="Advertise on this Bluetooth controller, as bumble names it: usb:0, tcp-client:127.0.0.1:46100 (one node).",
)
@click.option(
    "--source",
    default=_DEFAULT_SOURCE,
    show_default=True,
    metavar="SOURCE",
    help="Source of the values: noise, sine:PERIOD, ramp:PERIOD, file:CSV, -, unix:PATH, exec:COMMAND; of a wrapped"
    " node: dbc:FILE, canopen:FILE, iio:DEVICE.",
)
@click.option("--bus", metavar="INTERFACE:CHANNEL", help="Bus of the wrapped CAN sensors.")
@click.option(
    "--node-id",
    "node_ids",
    type=WholeNumber(1, 127),
    multiple=True,
    metavar="N",
    help="CANopen node id; one for each DIR, in their order.",
)
@click.option("--crypto-delay", type=Number(min=0), default=0, metavar="MS", help="Milliseconds per point operation.")
@click.option("--flash-delay", type=Number(min=0), default=0, metavar="MS", help="Milliseconds per flash commit.")
@click.option(
    "--wait-time",
    type=WholeNumber(4, 60),
    default=4,
    show_default=True,
    metavar="WT_INT",
    help="TNEP minimum waiting time, a multiple of 4 (4 is 1 ms, 20 is 16 ms).",
)
@click.option(
    "--battery",
    type=Number(0, 100),
    metavar="PERCENT",
    help="Battery level: a reader's field charges it (2 % a minute), otherwise it drains (0.1 %).",
)
@click.option("--pace", is_flag=True, help="Make every NFC frame take as long as at 106 kbit/s.")
@pass_app
def run(
    app: App,
    /,
    folders: Sequence[Path],
    crypto_delay: float,
    flash_delay: float,
    source: str,
    battery: float | None,
    bus: str | None,
    node_ids: Sequence[int],
    **links: Any,
) -> None:
    """Run the nodes in DIR … until SIGTERM or Ctrl-C; SIGUSR1 resets them by hand, SIGUSR2 presses their button.

    Prints one line when the links are up, then one line per actuator change, one when a node blinks to be found or
    was reset, and for a wrapped node one line when a channel becomes invalid, with the reason, or valid again.
    """
    place = node_room.wrapped.running.SensorPlace(source, bus, tuple(node_ids), links["can"])
    _check_options(len(folders), place, **links)
    delays = node_room.virtual.Delays(crypto_delay / 1000, flash_delay / 1000)
    lines, pulse = ActuatorLines(app), node_room.realtime_loop.RealtimeLoop()
    wrapped = _wrapped(app, lines, folders, place)
    make = _boards(app, lines, source, battery, wrapped)
    uuids = [node_room.flash_file.FlashFile(folder).load().uuid.hex() for folder in folders]
    nodes = [
        node_room.virtual.VirtualNode(
            folder,
            delays=delays,
            exclusive=True,
            board=make,
            pulse=pulse,
            has_can=bool(links["can"]),
            located=lines.locate_of(uuid),
        )
        for folder, uuid in zip(folders, uuids, strict=True)
    ]
    stop = provisioning.meeting.IdleStop(None)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.request_stop())
    signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=_reset_all, args=(nodes, lines)).start())
    signal.signal(signal.SIGUSR2, lambda *_: threading.Thread(target=_press_all, args=(nodes,)).start())
    running: list[Any] = []
    try:
        boards = [node.board for node in nodes if node.board is not None]
        readers = [wrapped] if wrapped is not None else []
        parts: list[LinkServer] = [pulse, *readers, *boards, *_servers(app, nodes, **links)]
        for part in parts:
            part.start()
            running.append(part)
        _say_ready(app, nodes, [links[kind] for kind in ("nfc", "can", "ble") if links[kind]], source)
        lines.start()
        running.insert(0, lines)  # ends last, because it reports that actuators are safe
        while not stop.wait(0.5):
            pass
    finally:
        for part in reversed(running):
            part.stop()


def _wrapped(app: App, lines: ActuatorLines, folders: Sequence[Path], place: SensorPlace) -> WrappedRun | None:
    """Return the reader of the sensors that the nodes wrap, None if they wrap none; raises UsageError.

    A wrapped node gives the values of its sensor and no others: its datasheet would vouch for made-up ones.
    """
    running = node_room.wrapped.running
    files = [node_room.flash_file.FlashFile(folder) for folder in folders]
    origins = [teds_room.origin.origin_of(file.hardware) for file in files]
    if not running.is_wrapped(place.source):
        for origin, folder in zip(origins, folders, strict=True):
            if origin is not None:
                raise UsageError(
                    f"The node in {folder} wraps {origin.text}, so --source {place.source} cannot give its values.",
                    hint=f"Use --source {running.SOURCE_OF[origin.kind]}.",
                )
        return None
    running.require_match(place, origins, [str(folder) for folder in folders])
    uuids = [file.load().uuid.hex() for file in files]
    return running.WrappedRun(
        place,
        [origin for origin in origins if origin is not None],
        lambda number: lines.validity_of(uuids[number]),
        app.warn,
    )


def _check_options(
    count: int, place: SensorPlace, *, nfc: str | None, can: str | None, ble: str | None, **_: Any
) -> None:
    """Raise UsageError if the options do not go together."""
    source, wraps = place.source, node_room.wrapped.running.is_wrapped(place.source)
    if not wraps and (place.bus is not None or place.node_ids):
        raise UsageError(
            f"{'--bus' if place.bus is not None else '--node-id'} names wrapped sensors.",
            hint="Omit it, or use --source dbc:FILE or canopen:FILE.",
        )
    if not nfc and not can and not ble:
        raise UsageError(
            "A node needs a link.", hint="Add --nfc udp:localhost:54321, --can udp_multicast:239.74.163.2, or both."
        )
    alone = "--nfc" if nfc else "--ble" if ble else ""
    if not wraps and not alone and node_room.sources.kind_of(source) in node_room.sources.ONE_NODE_ONLY:
        alone = f"--source {source}"
    if count > 1 and alone:
        raise UsageError(f"{alone} supports one node only.", hint="Run the others in separate processes.")


def _boards(
    app: App,
    lines: ActuatorLines,
    source: str,
    percent: float | None,
    wrapped: WrappedRun | None,
) -> Callable[[FlashFile], Board | None]:
    numbers = itertools.count()

    def make(file: FlashFile) -> node_room.Board | None:
        uuid, hardware = file.load().uuid, file.hardware
        if not hardware and source != _DEFAULT_SOURCE:
            app.warn(
                f"Node {uuid.hex()} has no channels, so --source has no effect: create it with --teds or --profile."
            )
        if not hardware and percent is None:
            return None
        return node_room.Board(
            teds.sheet.Sheet.from_image(teds.image.Image(uuid, hardware)),
            source=source if wrapped is None else wrapped.source(next(numbers)),
            lag=0 if wrapped is None else node_room.wrapped.wrapped_source.LAG,
            battery=None if percent is None else node_room.Battery(percent),
            shown=lines.observer_of(uuid.hex()),
            notify=app.warn,
        )

    return make


def _reset_all(nodes: Sequence[VirtualNode], lines: ActuatorLines) -> None:
    for node in nodes:
        node.reset_by_hand()
        lines.note_reset(node.tim.flash.uuid.hex())


def _press_all(nodes: Sequence[VirtualNode]) -> None:
    for node in nodes:
        node.press_button()


def _say_ready(app: App, nodes: Sequence[VirtualNode], up: list[str], source: str) -> None:
    flashes = [node.tim.flash for node in nodes]
    named = [{"uuid": flash.uuid.hex(), "fingerprint": fingerprint(flash.node_key)} for flash in flashes]
    several = {"nodes": named} if len(named) > 1 else {}
    who = f"Node {named[0]['uuid']}" if len(named) == 1 else f"{len(named)} nodes"
    app.emit(
        {**named[0], **several, "links": up, "source": source, "ready": True}, f"{who} ready on {' and '.join(up)}."
    )


def _servers(
    app: App,
    nodes: Sequence[VirtualNode],
    *,
    nfc: str | None,
    tag: Any,
    can: str | None,
    ble: str | None,
    pace: bool,
    wait_time: int,
) -> list[LinkServer]:
    servers: list[LinkServer] = []
    air = _in_the_air(ble, nodes[0]) if ble else None
    if air is not None:
        servers.append(air)
    if nfc:
        reader = node_room.NfcServer(
            nfc, nodes[0], tag=tag, pace=pace, wt_int=wait_time // 4 * 4, extras=_extras(nodes[0], air)
        )
        nodes[0].when_restarted(reader.restarted)
        servers.append(reader)
    if can:
        bus = node_room.CanServer(can, notify=app.warn)
        for node in nodes:
            tapped = node.in_factory_state if nfc is None else lambda: False
            bus.add(node, counts_as_tapped=tapped, measuring_handler=node)
            node.announces_presses_over(functools.partial(bus.announce_press, node))
            node.when_restarted(functools.partial(bus.restarted, node))
            node.streams_over(functools.partial(_send, bus, node))
        servers.append(bus)
    return servers


def _in_the_air(controller: str, node: VirtualNode) -> BleServer:
    address = node_room.StaticAddress(node.flash_file.path.parent, factory=node.in_factory_state())
    server = node_room.BleServer(controller, node, address)
    node.when_restarted(server.restarted)
    node.streams_over(server.send_data, node_room.peripheral.BUS)
    return server


def _send(bus: CanServer, node: VirtualNode, frame: DataFrame) -> None:
    bus.send_data(node, frame.identifier, frame.data, fd=frame.fd)


def _extras(node: VirtualNode, air: BleServer | None) -> ExtraRecords:
    """Return the extra records of the initial message: charge, and the address in the air; and the field's effect."""
    battery = node.board.battery if node.board is not None else None
    charging = node_room.tnep

    def field(present: bool) -> None:
        if battery is not None:
            battery.field(present=present)
        if air is not None:
            air.tapped()

    return charging.ExtraRecords(
        before=lambda: charging.charge_records(battery.power()) if battery is not None else (),
        after=lambda: (charging.out_of_band_record(air.address.octets, random=True),) if air is not None else (),
        field=field,
    )


# Virtual actuators report on stdout: at most twenty lines a second each, and always the last state.
#
# ``time`` is when the state began, not when the line was printed, so that it shows how long a dead-man switch took.

_EVERY_SECONDS = 0.05
_MOST_LINES = 1000


def _iso(moment: float) -> str:
    return datetime.fromtimestamp(moment, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class ActuatorLines:
    """Prints states in a thread, from :meth:`start` on; the first line has each one's present state."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._news: dict[tuple[str, int], ActuatorReading] = {}
        self._told: dict[tuple[str, int], ActuatorReading] = {}
        self._events: list[dict[str, object]] = []
        self._condition = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="actuators", daemon=True)

    def observer_of(self, uuid: str) -> Callable[[ActuatorReading], None]:
        """Return the receiver of a board's states."""

        def shown(state: ActuatorReading) -> None:
            with self._condition:
                self._news[uuid, state.channel] = state
                self._condition.notify()

        return shown

    def validity_of(self, uuid: str) -> Callable[[int, str, str], None]:
        """Return what a wrapped node reports its invalid channels to."""

        def report(channel: int, name: str, reason: str) -> None:
            line: dict[str, object] = {"event": "valid", "uuid": uuid, "channel": channel, "name": name}
            self._note(line | ({"event": "invalid", "reason": reason} if reason else {}))

        return report

    def locate_of(self, uuid: str) -> Callable[[int], None]:
        """Return what a node calls to be found by a person."""
        return lambda seconds: self._note({"event": "locate", "uuid": uuid, "seconds": seconds})

    def note_reset(self, uuid: str) -> None:
        """Print that a node was reset by hand."""
        self._note({"event": "reset", "uuid": uuid, "state": "factory"})

    def _note(self, line: dict[str, object]) -> None:
        with self._condition:
            self._events.append(line | {"time": _iso(time.time())})
            del self._events[:-_MOST_LINES]
            self._condition.notify()

    def start(self) -> None:
        """Begin to print."""
        self._thread.start()

    def stop(self) -> None:
        """Print what is left, and end."""
        self._stop.set()
        with self._condition:
            self._condition.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._condition:
                while not self._news and not self._events and not self._stop.is_set():
                    self._condition.wait()
            self._print_news()
            self._stop.wait(_EVERY_SECONDS)
        self._print_news()

    def _print_news(self) -> None:
        with self._condition:
            news, self._news = self._news, {}
            events, self._events = self._events, []
        try:
            for line in events:
                self._print_event(line)
        except OSError:
            self._stop.set()
            return
        for (uuid, channel), state in news.items():
            if self._told.get((uuid, channel)) != state:
                self._told[uuid, channel] = state
                try:
                    self._print_state(uuid, state)
                except OSError:  # the reader is gone or the disk is full: the node goes on
                    self._stop.set()
                    return

    def _print_event(self, line: dict[str, object]) -> None:
        if line["event"] == "locate":
            self._app.emit(
                line, f"{line['uuid']}: " + (f"blinks for {line['seconds']} s" if line["seconds"] else "stops")
            )
            return
        if line["event"] == "reset":
            self._app.emit(line, f"{line['uuid']}: reset by hand, back in factory state")
            return
        state = f"invalid: {line['reason']}" if line["event"] == "invalid" else "valid again"
        self._app.emit(line, f"{line['uuid']} {line['name']}: {state}")

    def _print_state(self, uuid: str, state: ActuatorReading) -> None:
        name = state.name or f"channel {state.channel}"
        value = f"{state.value:g} {state.unit}".rstrip() if state.value is not None else f"raw {state.raw:g}"
        self._app.emit(
            {
                "event": "actuator",
                "uuid": uuid,
                "channel": state.channel,
                "name": state.name,
                "value": state.value,
                "unit": state.unit,
                "raw": state.raw if state.raw == state.raw else None,
                "safe": state.safe,
                "time": _iso(state.time),
            },
            f"{uuid} {name}: {'safe state, ' if state.safe else ''}{value}",
        )


for subcommand in (create, run):
    node.add_command(subcommand)
