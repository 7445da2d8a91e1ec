"""``node``: a virtual transducer for trying things out, for tests, and as the other side for firmware authors."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, examples
from teds_provision.errors import UsageFailure


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision node create bench/finger",
        "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    ),
)
def node() -> None:
    """A virtual transducer: the whole node half of the profile, its flash in a file."""


def _uuid(_ctx: click.Context, _parameter: click.Parameter, text: str | None) -> bytes | None:
    if text is None:
        return None
    try:
        octets = bytes.fromhex(text.removeprefix("0x").removeprefix("0X"))
    except ValueError:
        octets = b""
    if len(octets) != 10:
        raise click.BadParameter("a UUID is 20 hex digits.")
    return octets


@node.command(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision node create bench/finger",
        "teds-provision node create bench/angle --uuid 8d4d9da65281f7000000 --name angle",
    ),
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--uuid", callback=_uuid, metavar="HEX", help="Its UUID, 20 hex digits (default: random).")
@click.option("--name", default="", help="What its maker calls it.")
@click.option(
    "--max-message",
    type=click.IntRange(1024, 4094),
    default=2048,
    show_default=True,
    metavar="OCTETS",
    help="Length of its longest frame.",
)
@pass_app
def create(app: App, folder: Path, uuid: bytes | None, name: str, max_message: int) -> None:
    """Make a virtual node in DIR, in factory state, with its own key."""
    from teds_provision.node.flash_file import FlashFile
    from teds_provision.protocol.keys import fingerprint

    made = FlashFile.create(folder, uuid=uuid, name=name, max_message=max_message)
    flash = made.load()
    print_of_key = fingerprint(flash.node_key)
    app.emit(
        {"uuid": flash.uuid.hex(), "fingerprint": print_of_key, "name": made.name, "can_address": flash.can_address},
        f"Node {flash.uuid.hex()} in {folder}, key {print_of_key[:16]}, CAN address 0x{flash.can_address:02x}.",
    )


@node.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Run the node in DIR until SIGTERM or Ctrl-C.",
    epilog=examples(
        "teds-provision node run bench/finger --nfc udp:localhost:54321",
        "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    ),
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--nfc", metavar="PATH", help="Lie on this simulated reader: udp:localhost:54321.")
@click.option("--tag", type=click.Choice(["4", "2"]), default="4", show_default=True, help="NFC Forum tag type.")
@click.option(
    "--can", metavar="INTERFACE:CHANNEL", help="Hang on this bus; without --nfc it counts as tapped in factory state."
)
@click.option(
    "--crypto-delay", type=click.FloatRange(min=0), default=0, metavar="MS", help="Milliseconds per point operation."
)
@click.option(
    "--flash-delay", type=click.FloatRange(min=0), default=0, metavar="MS", help="Milliseconds per flash commit."
)
@click.option(
    "--wait-time",
    type=click.IntRange(4, 60),
    default=20,
    show_default=True,
    metavar="WT_INT",
    help="TNEP minimum waiting time, a multiple of 4 (4 is 1 ms, 20 is 16 ms).",
)
@click.option("--pace", is_flag=True, help="Let every NFC frame last as long as at 106 kbit/s.")
@pass_app
def run(app: App, /, folder: Path, crypto_delay: float, flash_delay: float, **links: Any) -> None:
    """Run the node in DIR until SIGTERM or Ctrl-C; SIGUSR1 is its reset by hand.

    Prints one line when its links are up.
    """
    from teds_provision.node.virtual import Delays, VirtualNode
    from teds_provision.protocol.keys import fingerprint

    if not links["nfc"] and not links["can"]:
        raise UsageFailure(
            "A node needs a link.", hint="Add --nfc udp:localhost:54321, --can udp_multicast:239.74.163.2, or both."
        )
    node = VirtualNode(folder, delays=Delays(crypto_delay / 1000, flash_delay / 1000), exclusive=True)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    signal.signal(signal.SIGUSR1, lambda *_: threading.Thread(target=node.reset_by_hand).start())
    servers = _servers(node, **links)
    try:
        for server in servers:
            server.start()
        flash = node.tim.flash
        up = [links[kind] for kind in ("nfc", "can") if links[kind]]
        app.emit(
            {"uuid": flash.uuid.hex(), "fingerprint": fingerprint(flash.node_key), "links": up, "ready": True},
            f"Node {flash.uuid.hex()} ready on {' and '.join(up)}.",
        )
        while not stop.wait(0.5):
            pass
    finally:
        for server in servers:
            server.stop()


def _servers(node: Any, *, nfc: str | None, tag: Any, can: str | None, pace: bool, wait_time: int) -> list[Any]:
    servers: list[Any] = []
    if nfc:
        from teds_provision.node.nfc_server import NfcServer

        servers.append(NfcServer(nfc, node, tag=tag, pace=pace, wt_int=wait_time // 4 * 4))
    if can:
        from teds_provision.node.can_server import CanServer

        without_nfc = nfc is None
        servers.append(CanServer(can, node, counts_as_tapped=lambda: without_nfc and node.in_factory_state()))
    return servers


@node.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Reset the node in DIR by hand.",
    epilog=examples("teds-provision node reset bench/finger"),
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@pass_app
def reset(app: App, folder: Path) -> None:
    """Reset the node in DIR by hand (button held 5 s) while it is not running."""
    from teds_provision.node.virtual import VirtualNode

    node = VirtualNode(folder, exclusive=True)
    node.reset_by_hand()
    uuid = node.tim.flash.uuid.hex()
    app.emit({"uuid": uuid, "state": "factory"}, f"Node {uuid} is back in factory state.")
