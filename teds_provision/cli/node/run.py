"""``node run``: virtual transducers on their links, until SIGTERM or Ctrl-C."""

from __future__ import annotations

import functools
import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import node as node_room
from teds_provision import protocol, teds
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.node.actuators import ActuatorLines
from teds_provision.cli.options import Number, WholeNumber, command
from teds_provision.errors import UsageFailure
from teds_provision.node import ble as ble_room
from teds_provision.node import can as can_room
from teds_provision.node import hardware as hardware_room
from teds_provision.node import nfc as nfc_room

if TYPE_CHECKING:
    from teds_provision.cli.node.actuators import ActuatorLines
    from teds_provision.node.ble.server import BleServer
    from teds_provision.node.can.server import CanServer
    from teds_provision.node.flash_file import FlashFile
    from teds_provision.node.hardware.board import Board
    from teds_provision.node.nfc.charging import Extras
    from teds_provision.node.virtual import LinkServer, VirtualNode
    from teds_provision.protocol.operation.streams import DataFrame

_DEFAULT_SOURCE = "noise"


@command(
    "teds-provision node run bench/finger --nfc udp:localhost:54321",
    "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    "teds-provision node run bench/angle --can udp_multicast:239.74.163.2 --source sine:2",
    "teds-provision node run bench/a bench/b bench/c --can udp_multicast:239.74.163.2",
    short_help="Run the nodes in DIR … until SIGTERM or Ctrl-C.",
)
@click.argument("folders", metavar="DIR…", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False))
@click.option("--nfc", metavar="PATH", help="Lie on this simulated reader: udp:localhost:54321 (one node).")
@click.option("--tag", type=click.Choice(["4", "2"]), default="4", show_default=True, help="NFC Forum tag type.")
@click.option(
    "--can", metavar="INTERFACE:CHANNEL", help="Hang on this bus; without --nfc it counts as tapped in factory state."
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
    help="Where values come from: noise, sine:PERIOD, ramp:PERIOD, file:CSV, -, unix:PATH, exec:COMMAND.",
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
    help="It has a battery, so full: a reader's field charges it (2 % a minute), else it empties (0.1 %).",
)
@click.option("--pace", is_flag=True, help="Let every NFC frame last as long as at 106 kbit/s.")
@pass_app
def run(
    app: App,
    /,
    folders: Sequence[Path],
    crypto_delay: float,
    flash_delay: float,
    source: str,
    battery: float | None,
    **links: Any,
) -> None:
    """Run the nodes in DIR … until SIGTERM or Ctrl-C; SIGUSR1 is their reset by hand.

    Prints one line when the links are up, then a line for what an actuator does.
    """
    _check(len(folders), source, **links)
    delays = node_room.virtual.Delays(crypto_delay / 1000, flash_delay / 1000)
    lines, pulse = ActuatorLines(app), node_room.pulse.Pulse()
    make = _boards(app, lines, source, battery)
    nodes = [
        node_room.virtual.VirtualNode(folder, delays=delays, exclusive=True, board=make, pulse=pulse)
        for folder in folders
    ]
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=_reset_all, args=(nodes,)).start())
    running: list[Any] = []
    try:
        boards = [node.board for node in nodes if node.board is not None]
        parts: list[LinkServer] = [pulse, *boards, *_servers(app, nodes, **links)]
        for part in parts:
            part.start()
            running.append(part)
        _say_ready(app, nodes, [links[kind] for kind in ("nfc", "can", "ble") if links[kind]], source)
        lines.start()
        running.insert(0, lines)  # the last to end: it tells that actuators are safe
        while not stop.wait(0.5):
            pass
    finally:
        for part in reversed(running):
            part.stop()


def _check(count: int, source: str, *, nfc: str | None, can: str | None, ble: str | None, **_: Any) -> None:
    """Raise UsageFailure where the options do not go together."""
    if not nfc and not can and not ble:
        raise UsageFailure(
            "A node needs a link.", hint="Add --nfc udp:localhost:54321, --can udp_multicast:239.74.163.2, or both."
        )
    alone = "--nfc" if nfc else "--ble" if ble else ""
    if not alone and node_room.sources.kind_of(source) in node_room.sources.ONE_NODE_ONLY:
        alone = f"--source {source}"
    if count > 1 and alone:
        raise UsageFailure(f"{alone} is for one node.", hint="Run the others in processes of their own.")


def _boards(app: App, lines: ActuatorLines, source: str, percent: float | None) -> Callable[[FlashFile], Board | None]:
    def make(file: FlashFile) -> hardware_room.board.Board | None:
        uuid, hardware = file.load().uuid, file.hardware
        if not hardware and source != _DEFAULT_SOURCE:
            app.warn(
                f"Node {uuid.hex()} has no channels, so --source is of no use: create it with --teds or --profile."
            )
        if not hardware and percent is None:
            return None
        return hardware_room.board.Board(
            teds.sheet.Sheet.of(teds.image.Image(uuid, hardware)),
            source=source,
            battery=None if percent is None else hardware_room.battery.Battery(percent),
            shown=lines.of(uuid.hex()),
            tell=app.warn,
        )

    return make


def _reset_all(nodes: Sequence[VirtualNode]) -> None:
    for node in nodes:
        node.reset_by_hand()


def _say_ready(app: App, nodes: Sequence[VirtualNode], up: list[str], source: str) -> None:
    flashes = [node.tim.flash for node in nodes]
    named = [{"uuid": flash.uuid.hex(), "fingerprint": protocol.keys.fingerprint(flash.node_key)} for flash in flashes]
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
        servers.append(
            nfc_room.server.NfcServer(
                nfc, nodes[0], tag=tag, pace=pace, wt_int=wait_time // 4 * 4, extras=_extras(nodes[0], air)
            )
        )
    if can:
        bus = can_room.server.CanServer(can, tell=app.warn)
        for node in nodes:
            tapped = node.in_factory_state if nfc is None else lambda: False
            bus.add(node, counts_as_tapped=tapped, measuring=node)
            node.streams_over(functools.partial(_send, bus, node))
        servers.append(bus)
    return servers


def _in_the_air(controller: str, node: VirtualNode) -> BleServer:
    address = ble_room.address.StaticAddress(node.flash_file.path.parent, factory=node.in_factory_state())
    server = ble_room.server.BleServer(controller, node, address)
    node.streams_over(server.send_data, ble_room.peripheral.BUS)
    return server


def _send(bus: CanServer, node: VirtualNode, frame: DataFrame) -> None:
    bus.send_data(node, frame.identifier, frame.data, fd=frame.fd)


def _extras(node: VirtualNode, air: BleServer | None) -> Extras:
    """What the initial message says beside: charge, and the address in the air; and what a reader's field does."""
    battery = node.board.battery if node.board is not None else None
    charging = nfc_room.charging

    def field(present: bool) -> None:
        if battery is not None:
            battery.field(present=present)
        if air is not None:
            air.tapped()

    return charging.Extras(
        before=lambda: charging.charge_records(battery.power()) if battery is not None else (),
        after=lambda: (charging.out_of_band_record(air.address.octets, random=True),) if air is not None else (),
        field=field,
    )
