"""``describe``: a signed datasheet as Thing Description, ros2_control files and Asset Administration Shell."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest
import yaml

from teds_provision.describe import described_node as of_node
from teds_provision.describe import ros2_control
from teds_provision.describe.described_node import DescribedNode, MissingFieldError, described_node
from teds_provision.describe.thing_description import thing_description
from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError
from teds_provision.handover.life import revoke
from teds_provision.measure.running.measurement_job import station_facts
from teds_provision.measure.sinks.names import Topics
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station
from teds_provision.teds.channel import Timing
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image
from teds_provision.teds.profile.load import shipped_profiles
from tests.bench import Board, talk
from tests.cli.shell import call

SCHEMA = json.loads((Path(__file__).parent / "td-json-schema-validation.json").read_text())
NAMEPLATE = """<MetaIdentificationTEDSDataBlock xmlns="urn:example">
<ManufacturerId>Example Robotics</ManufacturerId><ProductDescription>Gripper 50</ProductDescription>
<OrderCode>GR-50-A</OrderCode><ArticleNo>4711</ArticleNo><SerialNo>0042</SerialNo>
<ProductUri>https://example.org/gr50/0042</ProductUri>
<Street>Bench 1</Street><ZipCode>12345</ZipCode><CityTown>Lab</CityTown><NationalCode>DE</NationalCode>
</MetaIdentificationTEDSDataBlock>"""


def gripper(station: Station, board: Board, folder: Path, nameplate: str = NAMEPLATE) -> DescribedNode:
    text = f"\n[[text]]\nkind = \"meta-identification\"\nxml = '''{nameplate}'''\n" if nameplate else ""
    own = folder / "own-gripper.toml"
    own.write_text((shipped_profiles() / "gripper.toml").read_text() + text)
    with talk(board) as node:
        provision(
            station,
            node,
            BuildOrder(str(own), name="hand"),
            operator=AcceptingOperator(),
            reporter=SilentReporter(),
        )
    return described_node(station, board.uuid)


def test_a_thing_description_validates_and_its_forms_are_the_api(
    station: Station, board: Board, tmp_path: Path
) -> None:
    node = gripper(station, board, tmp_path)
    description = thing_description(node, "https://bench:8443")
    jsonschema.validate(description, SCHEMA)
    assert description["security"] in description["securityDefinitions"]  # the W3C schema does not check it
    assert description["title"] == "hand"
    sensors = [channel for channel in node.sheet.channels if not channel.actuator]
    assert len(description["properties"]) == len(sensors)
    [action] = description["actions"].values()
    assert (action["safe"], action["idempotent"]) == (False, True), (
        "it moves something; the same value twice does no more"
    )
    [form] = action["forms"]
    assert (form["op"], form["htv:methodName"]) == (["invokeaction"], "PUT")
    actuator = next(channel for channel in node.sheet.channels if channel.actuator)
    assert form["href"] == f"api/v1/nodes/{board.uuid.hex()}/channels/{actuator.number}"
    value = action["input"]["properties"]["value"]
    assert (value["minimum"], value["maximum"], value["unit"]) == (actuator.low, actuator.high, actuator.si_unit)


def test_each_channel_has_a_property_of_its_own_whatever_the_channels_are_called(
    station: Station, board: Board, tmp_path: Path
) -> None:
    """The third "flow" took the name of "flow 3", which was described no more."""
    node = gripper(station, board, tmp_path)
    sensor = next(channel for channel in node.sheet.channels if not channel.actuator)
    names = ("Flow", "flow 3", "flow", "", "!")
    channels = tuple(replace(sensor, number=number, name=name) for number, name in enumerate(names, 1))
    described = thing_description(replace(node, sheet=replace(node.sheet, channels=channels)))["properties"]
    numbers = {name: found["teds:channel"] for name, found in described.items()}
    assert numbers == {"flow": 1, "flow_3": 2, "flow_3_3": 3, "channel_4": 4, "channel_5": 5}


def test_xacro_expands_the_macro_with_the_limits_of_the_datasheet(
    station: Station, board: Board, tmp_path: Path
) -> None:
    node = gripper(station, board, tmp_path)
    topics = Topics(station_facts(station))
    [joint] = ros2_control.joints(node, topics)
    (tmp_path / "hand.xacro").write_text(ros2_control.xacro(node, [joint], topics))
    (tmp_path / "robot.xacro").write_text(
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        f'<xacro:include filename="{tmp_path}/hand.xacro"/><xacro:teds_hand/></robot>'
    )
    done = subprocess.run(
        [str(Path(sys.executable).parent / "xacro"), str(tmp_path / "robot.xacro")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    actuator = node.sheet.channel(joint.actuator)
    assert actuator is not None
    assert f'<param name="max">{actuator.high!r}</param>' in done.stdout
    assert '<joint name="hand">' in done.stdout
    files = yaml.safe_load(ros2_control.controllers(node, [joint], topics))
    manager = files["controller_manager"]["ros__parameters"]
    assert files[f"hand_{joint.command}_controller"]["ros__parameters"]["joints"] == ["hand"]
    periods = [
        channel.period for channel in node.sheet.channels if channel.number in {joint.actuator, *joint.state.values()}
    ]
    assert manager["update_rate"] <= 1 / max(period for period in periods if period == period) + 1


@pytest.mark.parametrize(("of_the_actuator", "of_the_sensors"), [(0.01, 0.1), (0.1, 0.01)])
def test_the_update_rate_is_that_of_the_slowest_channel_of_a_joint(
    station: Station, board: Board, tmp_path: Path, of_the_actuator: float, of_the_sensors: float
) -> None:
    node = gripper(station, board, tmp_path)
    channels = tuple(
        replace(channel, timing=Timing(period=of_the_actuator if channel.actuator else of_the_sensors))
        for channel in node.sheet.channels
    )
    node = replace(node, sheet=replace(node.sheet, channels=channels))
    topics = Topics(station_facts(station))
    found = ros2_control.joints(node, topics)
    assert any(joint.state for joint in found), "a joint without a sensor has one rate alone"
    files = yaml.safe_load(ros2_control.controllers(node, found, topics))
    assert files["controller_manager"]["ros__parameters"]["update_rate"] == 10


def test_the_set_point_is_the_state_of_a_joint_that_no_sensor_measures(
    station: Station, board: Board, tmp_path: Path
) -> None:
    node = gripper(station, board, tmp_path)
    topics = Topics(station_facts(station))
    [joint] = ros2_control.joints(node, topics)
    lines = ros2_control.xacro(node, [replace(joint, state={})], topics).splitlines()
    states = [line.strip() for line in lines if "state_interface" in line]
    assert states == [f'<state_interface name="{joint.command}"/>']


def test_an_asset_shell_is_read_back_by_basyx_and_is_the_same_twice(
    station: Station, board: Board, tmp_path: Path
) -> None:
    adapter = pytest.importorskip("basyx.aas.adapter.json")
    from teds_provision.describe.asset_shell import asset_shell

    node = gripper(station, board, tmp_path)
    text = asset_shell(node)
    assert text == asset_shell(node)
    (tmp_path / "shell.json").write_text(text)
    with (tmp_path / "shell.json").open() as file:
        found = adapter.read_aas_json_file(file, failsafe=False)
    plate = found.get(f"urn:teds:{board.uuid.hex()}:nameplate")
    assert plate.get_referable("OrderCodeOfManufacturer").value == "GR-50-A"
    assert plate.get_referable("AddressInformation").get_referable("CityTown").value["en"] == "Lab"
    technical = found.get(f"urn:teds:{board.uuid.hex()}:technical-data")
    section = technical.get_referable("TechnicalProperties").get_referable("Channel1")
    channel = node.sheet.channel(1)
    assert channel is not None
    assert section.get_referable("HighLimit").value == channel.high


def test_a_missing_field_is_named_with_its_profile_key_and_nothing_is_written(
    station: Station, board: Board, tmp_path: Path
) -> None:
    pytest.importorskip("basyx")
    from teds_provision.describe.asset_shell import asset_shell

    without = NAMEPLATE.replace("<OrderCode>GR-50-A</OrderCode>", "")
    node = gripper(station, board, tmp_path, without)
    with pytest.raises(MissingFieldError, match="OrderCodeOfManufacturer") as caught:
        asset_shell(node)
    assert "<OrderCode>" in str(caught.value.hint)
    assert "meta-identification" in str(caught.value.hint)
    built_in = replace(node, profile="gripper").missing("The Digital Nameplate", "SerialNumber", "<SerialNo>")
    assert "profile new my-type --extends gripper -o my-type.toml" in str(built_in.hint)
    out = tmp_path / "out"  # is made where something is written
    done = call(station.home, "--json", "describe", board.uuid.hex(), "--as", "aas", "--output", str(out))
    assert (done.code, out.exists()) == (8, False)
    assert done.json["error"]["code"] == "missing-field"
    assert call(station.home, "describe", board.uuid.hex(), "--as", "td", "--output", "-").code == 2
    done = call(
        station.home,
        "--json",
        "describe",
        board.uuid.hex(),
        *("--as", "td", "--as", "ros2-control"),
        "--output",
        str(out),
    )
    assert done.code == 0, done.err
    assert [Path(name).name for name in done.json["files"]] == [
        f"{board.uuid.hex()}.td.json",
        "hand.ros2_control.xacro",
        "hand.controllers.yaml",
    ]
    assert (out / f"{board.uuid.hex()}.td.json").is_file()


def test_a_hostile_nameplate_is_no_nameplate(station: Station, board: Board, tmp_path: Path) -> None:
    node = gripper(station, board, tmp_path, '<!DOCTYPE a [<!ENTITY b "c">]><a><OrderCode>&b;</OrderCode></a>')
    assert node.nameplate == {}


def test_of_a_nameplate_in_several_languages_each_field_is_the_first_that_has_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    texts = (
        b"<a><ManufacturerId>Example</ManufacturerId><OrderCode> </OrderCode></a>",
        b"<a><b><SerialNo>42</SerialNo><OrderCode>GR-50</OrderCode></b></a>",
        b"no XML",
        b"<a><ManufacturerId>Beispiel</ManufacturerId><OrderCode>other</OrderCode><SerialNo>43</SerialNo></a>",
    )
    monkeypatch.setattr(of_node, "decode", lambda _octets: SimpleNamespace(text=texts))
    image = Image(bytes(10), {(0, AccessCode.META_ID): b"any"})
    assert of_node.nameplate_of(image) == {"manufacturerid": "Example", "ordercode": "GR-50", "serialno": "42"}
    assert of_node.nameplate_of(Image(bytes(10), {})) == {}


def test_a_node_is_described_under_the_stations_name_for_it_else_under_its_own(
    station: Station, board: Board, tmp_path: Path
) -> None:
    assert gripper(station, board, tmp_path).name == "hand"
    station.nodes.remember(board.uuid, name="left hand")
    assert described_node(station, board.uuid).name == "left hand"
    station.nodes.remember(board.uuid, name=None)
    node = described_node(station, board.uuid)
    assert node.name == node.sheet.meta.name == "hand"


def test_only_an_authentic_datasheet_is_described(station: Station, board: Board, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        described_node(station, board.uuid)
    gripper(station, board, tmp_path, "")
    revoke(station, board.uuid, "stolen")
    with pytest.raises(NotAuthenticError, match="revoked"):
        described_node(station, board.uuid)


def test_a_sensor_alone_has_no_joint(station: Station, board: Board, tmp_path: Path) -> None:
    node = gripper(station, board, tmp_path, "")
    sensors = tuple(channel for channel in node.sheet.channels if not channel.actuator)
    from dataclasses import replace

    with pytest.raises(BadDataError, match="no joint"):
        ros2_control.joints(replace(node, sheet=replace(node.sheet, channels=sensors)), Topics(station_facts(station)))


@pytest.mark.parametrize(
    ("record", "name", "profile"),
    [
        (None, "own", ""),
        (SimpleNamespace(name="", profile=None), "own", ""),
        (SimpleNamespace(name="left", profile="gripper"), "left", "gripper"),
    ],
)
@pytest.mark.parametrize("security", [b"sealed", None])
def test_what_is_described_is_the_last_reading_as_it_is_shown_here(
    monkeypatch: pytest.MonkeyPatch, record: Any, name: str, profile: str, security: bytes | None
) -> None:
    required: list[Any] = []
    image: Any = SimpleNamespace(security=security)
    shown = SimpleNamespace(meta=SimpleNamespace(name="own"))
    sheet = SimpleNamespace(shown_in=lambda units: shown if units == "mm" else None)
    station: Any = SimpleNamespace(
        datasheets=SimpleNamespace(datasheet=lambda _uuid: image), nodes=SimpleNamespace(get=lambda _uuid: record)
    )
    verdict: Any = SimpleNamespace(verified="today")
    monkeypatch.setattr(of_node, "verdict_of", lambda _station, _uuid: verdict)
    monkeypatch.setattr(of_node, "require_authentic", required.append)
    monkeypatch.setattr(of_node, "shown_units", lambda _station, _uuid: "mm")
    monkeypatch.setattr(of_node, "Sheet", SimpleNamespace(from_image=lambda _image: sheet))
    monkeypatch.setattr(of_node, "nameplate_of", lambda _image: {"serialno": "1"})
    found = described_node(station, bytes(10))
    digest = hashlib.sha256(security or b"").hexdigest()
    assert found == DescribedNode(bytes(10), name, profile, shown, {"serialno": "1"}, digest)  # type: ignore[arg-type]
    assert required == ["today"]
    verdict = None
    with pytest.raises(NotFoundError) as refused:
        described_node(station, bytes(10))
    assert refused.value.message == f"No datasheet of node {bytes(10).hex()} is known here."
    assert refused.value.hint == f"Read it first: verify {bytes(10).hex()}"
