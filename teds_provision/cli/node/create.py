"""``node create``: a virtual transducer in a folder, bare or from a datasheet."""

from __future__ import annotations

from pathlib import Path

import click

from teds_provision import node, protocol
from teds_provision import teds as teds_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, WholeNumber, command
from teds_provision.errors import UsageFailure

_NAME_OCTETS = 120


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


def _name(_ctx: click.Context, _parameter: click.Parameter, text: str) -> str:
    try:
        octets = len(text.encode())
    except UnicodeEncodeError:
        raise click.BadParameter("it is not valid text in this terminal's encoding.") from None
    if octets > _NAME_OCTETS or not (text.isprintable() or not text):
        raise click.BadParameter(f"a name has at most {_NAME_OCTETS} octets of printable text; this one has {octets}.")
    return text


@command(
    "teds-provision node create bench/finger",
    "teds-provision node create bench/angle --profile magnetic-angular-position-sensor --name angle",
    "teds-provision node create bench/copy --teds angle.json",
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.option("--uuid", callback=_uuid, metavar="HEX", help="Its UUID, 20 hex digits (default: the file's, or random).")
@click.option("--name", default="", callback=_name, help="What its maker calls it, at most 120 octets.")
@click.option(
    "--teds",
    type=FileToRead(),
    metavar="FILE",
    help="Its datasheet and hardware: an image, XML, JSON, hex or binary file.",
)
@click.option("--profile", metavar="P", help="Its datasheet and hardware: those of a transducer type.")
@click.option(
    "--max-message",
    type=WholeNumber(512, 4094),
    default=2048,
    show_default=True,
    metavar="OCTETS",
    help="Length of its longest frame.",
)
@pass_app
def create(
    app: App,
    folder: Path,
    uuid: bytes | None,
    name: str,
    teds: Path | None,
    profile: str | None,
    max_message: int,
) -> None:
    """Make a virtual node in DIR, in factory state, with its own key.

    With --teds or --profile the channels of that datasheet are its hardware; the TEDS lie on it unsigned.
    """
    if teds is not None and profile is not None:
        raise UsageFailure("A node has one datasheet.", hint="Give --teds or --profile, not both.")
    made = node.described.create(
        folder,
        uuid=uuid,
        name=name,
        max_message=max_message,
        teds=teds,
        profile=profile,
        folders=teds_room.profile.default_folders(app.home),
    )
    flash = made.load()
    print_of_key = protocol.keys.fingerprint(flash.node_key)
    channels = [
        {
            "channel": channel.number,
            "name": channel.name,
            "kind": channel.kind.word if channel.kind is not None else None,
            "unit": channel.unit.text,
        }
        for channel in teds_room.sheet.Sheet.of_blocks(made.hardware).channels
    ]
    app.emit(
        {
            "uuid": flash.uuid.hex(),
            "fingerprint": print_of_key,
            "name": made.name,
            "can_address": flash.can_address,
            "channels": channels,
        },
        f"Node {flash.uuid.hex()} in {folder}, key {print_of_key[:16]}, CAN address 0x{flash.can_address:02x}"
        + (f", {len(channels)} channel{'' if len(channels) == 1 else 's'}." if channels else "."),
    )
