"""``describe``: datasheets in formats that other tools read."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click

from teds_provision import describe as formats
from teds_provision import measure
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.named_files import write_file
from teds_provision.cli.options import command
from teds_provision.errors import UsageError
from teds_provision.files import make_folder

FORMS: Final = ("td", "ros2-control", "aas")


@command(
    "teds-provision describe 8d4d --as td",
    "teds-provision describe 8d4d c51a --as ros2-control --output robot/",
    "teds-provision describe 8d4d --as aas --output shells/",
)
@click.argument("uuids", metavar="UUID…", nargs=-1, required=True)
@click.option(
    "--as",
    "forms",
    type=click.Choice(FORMS),
    required=True,
    multiple=True,
    help="td: W3C Thing Description 1.1; ros2-control: xacro and controllers.yaml; aas: Asset Administration Shell.",
)
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(),
    show_default="the working folder",
    metavar="FOLDER",
    help="Folder for the files; it is created.",
)
@pass_app
def describe(app: App, uuids: tuple[str, ...], forms: tuple[str, ...], output: Path) -> None:
    """Export datasheets for other tools: one file per node and format.

    Only authentic datasheets are exported. If the format requires a field that the datasheet lacks, nothing is written
    and the error names the field and the profile key that provides it.
    """
    station = app.station()
    if str(output) == "-":
        raise UsageError("Files are written, each with its name, so - is no place for them.", hint="Name a folder.")
    made: dict[Path, str] = {}
    for text in uuids:
        node = formats.described_node.described_node(station, station.nodes.resolve(text))
        for form in forms:
            made |= {output / name: content for name, content in _MAKERS[form](station, node).items()}
    make_folder(output)
    for path, content in made.items():
        write_file(path, content)
    app.emit({"files": [str(path) for path in made]}, "\n".join(str(path) for path in made))


def _thing_description(_station: Station, node: formats.described_node.DescribedNode) -> dict[str, str]:
    description = formats.thing_description.thing_description(node)
    return {f"{node.uuid.hex()}.td.json": json.dumps(description, ensure_ascii=False, indent=2) + "\n"}


def _ros2_control(station: Station, node: formats.described_node.DescribedNode) -> dict[str, str]:
    ros2_control = formats.ros2_control
    topics = measure.sinks.names.Topics(measure.measurement_job.station_facts(station))
    joints = ros2_control.joints(node, topics)
    name = topics.node(node.uuid.hex())
    return {
        f"{name}.ros2_control.xacro": ros2_control.xacro(node, joints, topics),
        f"{name}.controllers.yaml": ros2_control.controllers(node, joints, topics),
    }


def _asset_shell(_station: Station, node: formats.described_node.DescribedNode) -> dict[str, str]:
    return {f"{node.uuid.hex()}.aas.json": formats.asset_shell.asset_shell(node)}


_MAKERS: Final[dict[str, Callable[[Any, Any], dict[str, str]]]] = {
    "td": _thing_description,
    "ros2-control": _ros2_control,
    "aas": _asset_shell,
}
