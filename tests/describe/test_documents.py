"""The whole documents that ``describe`` writes of one node, member by member."""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from teds_provision.describe import ros2_control
from teds_provision.describe.described_node import DescribedNode, MissingFieldError
from teds_provision.describe.thing_description import thing_description
from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import StationFacts
from teds_provision.measure.sinks.names import Topics
from teds_provision.teds.calibration import Calibration, CalibrationInput
from teds_provision.teds.channel import Channel, ChannelKind, Timing
from teds_provision.teds.codec.model import Units
from teds_provision.teds.sheet import Meta, Sheet
from teds_provision.teds.units import parse_unit, units_of

UUID = bytes.fromhex("8d4d9da65281f7000000")
FINGERPRINT = "0123456789abcdef" * 4
DEGREE = Calibration(
    2,
    "linear",
    (CalibrationInput(2, 1, (0.0, 65535.0), (0.0,)),),
    (0.0, 360 / 65536),
    unit=parse_unit("mm"),
    uncertainty=5.0,
    date=datetime(2026, 3, 1, tzinfo=UTC),
    interval=365 * 86400.0,
)
CHANNELS = (
    Channel(
        1,
        "Opening",
        True,
        ChannelKind.ACTUATOR,
        units_of(meters=1),
        True,
        0.0,
        0.085,
        timing=Timing(period=0.02),
    ),
    Channel(
        2,
        "",
        True,
        ChannelKind.SENSOR,
        units_of(meters=1),
        True,
        0.0,
        0.1,
        0.001,
        timing=Timing(period=0.05),
        calibration=DEGREE,
    ),
    Channel(
        3,
        "Grip force",
        True,
        ChannelKind.SENSOR,
        units_of(meters=1, kilograms=1, seconds=-2),
        True,
        -10.0,
        math.nan,
        timing=Timing(period=0.1),
    ),
    Channel(4, "lamp", True, ChannelKind.EVENT_SENSOR, Units(), timing=Timing(period=9.0)),
)
PLATE = {
    "producturi": "https://example.org/gr50/0042",
    "manufacturerid": "Example Robotics",
    "productdescription": "Gripper 50",
    "ordercode": "GR-50-A",
    "articleno": "4711",
    "serialno": "0042",
    "street": "Bench 1",
    "zipcode": "12345",
    "citytown": "Lab",
    "nationalcode": "DE",
}
NODE = DescribedNode(UUID, "hand", "gripper", Sheet(UUID, Meta(name="hand"), CHANNELS, {2: DEGREE}), PLATE, FINGERPRINT)


def with_channels(*channels: Channel) -> DescribedNode:
    return replace(NODE, sheet=replace(NODE.sheet, channels=channels))


def last_value(**number: object) -> dict[str, Any]:
    value = {
        "description": "null if the last value is invalid",
        "oneOf": [{"type": "number", **number}, {"type": "null"}],
    }
    known = {"type": "object", "properties": {"value": value, "time": {"type": "number", "unit": "s"}}}
    return {"last": {"oneOf": [known, {"type": "null"}]}}


def form(channel: int, operation: str, method: str) -> list[dict[str, Any]]:
    return [
        {
            "href": f"api/v1/nodes/8d4d9da65281f7000000/channels/{channel}",
            "contentType": "application/json",
            "op": [operation],
            "htv:methodName": method,
        }
    ]


def sensor(title: str, channel: int, **number: object) -> dict[str, Any]:
    return {
        "title": title,
        "teds:channel": channel,
        "type": "object",
        "readOnly": True,
        "properties": last_value(**number),
        "unit": number["unit"],
        "forms": form(channel, "readproperty", "GET"),
    }


def test_a_whole_thing_description() -> None:
    expected = {
        "@context": ["https://www.w3.org/2022/wot/td/v1.1", {"teds": "urn:iso:std:iso-iec-ieee:21450:"}],
        "id": "urn:teds:8d4d9da65281f7000000",
        "title": "hand",
        "description": "Transducer node 8d4d9da65281f7000000; its datasheet is signed (SHA-256 of the Security TEDS: "
        "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef).",
        "securityDefinitions": {
            "token": {"scheme": "bearer", "format": "opaque", "in": "header", "name": "Authorization"}
        },
        "security": "token",
        "properties": {
            "channel_2": sensor(
                "Channel 2", 2, unit="m", minimum=0.0, maximum=0.1, **{"teds:uncertainty": pytest.approx(0.005)}
            ),
            "grip_force": sensor("Grip force", 3, unit="N", minimum=-10.0),
            "lamp": sensor("lamp", 4, unit="count"),
        },
        "actions": {
            "set_opening": {
                "title": "Set Opening",
                "description": "The node brings the actuator to its safe state unless the set point is repeated.",
                "teds:channel": 1,
                "input": {
                    "type": "object",
                    "properties": {
                        "value": {"type": "number", "unit": "m", "minimum": 0.0, "maximum": 0.085},
                        "hold": {
                            "type": "number",
                            "minimum": 0,
                            "unit": "s",
                            "description": "held for so long; 0 releases it",
                        },
                    },
                },
                "safe": False,
                "idempotent": True,
                "forms": form(1, "invokeaction", "PUT"),
            }
        },
    }
    assert thing_description(NODE) == expected
    for base in ("https://bench:8443", "https://bench:8443/"):
        assert thing_description(NODE, base) == {**expected, "base": "https://bench:8443/"}
    bare = thing_description(with_channels(replace(CHANNELS[0], name="")))
    assert "properties" not in bare
    assert bare["actions"]["set_channel_1"]["title"] == "Set channel 1"
    assert "actions" not in thing_description(with_channels(CHANNELS[1]))
    with pytest.raises(
        MissingFieldError, match=r"^A Thing Description requires title, which the datasheet of node 8d4"
    ):
        thing_description(replace(NODE, name=""))


XACRO = """<?xml version="1.0"?>
<!-- Node 8d4d9da65281f7000000, from its signed datasheet 0123456789abcdef. \
Made by teds-provision describe; change the datasheet instead. -->
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="teds_hand">
    <ros2_control name="hand" type="system">
      <hardware>
        <plugin>topic_based_ros2_control/TopicBasedSystem</plugin>
        <param name="joint_states_topic">/bench/joint_states</param>
        <param name="joint_commands_topic">/bench/joint_commands</param>
        <!-- A command in every cycle: repeated set points keep the actuator alive. -->
        <param name="trigger_joint_command_threshold">-1.0</param>
      </hardware>
      <joint name="hand">
        <command_interface name="position">
          <param name="min">0.0</param>
          <param name="max">0.085</param>
        </command_interface>
        <state_interface name="position"/>
        <state_interface name="effort"/>
      </joint>
    </ros2_control>
  </xacro:macro>
</robot>
"""
CONTROLLERS = """controller_manager:
  ros__parameters:
    update_rate: 10
    joint_state_broadcaster:
      type: joint_state_broadcaster/JointStateBroadcaster
    hand_position_controller:
      type: forward_command_controller/ForwardCommandController
    hand_velocity_controller:
      type: forward_command_controller/ForwardCommandController
hand_position_controller:
  ros__parameters:
    joints: [hand_opening, hand_wrist]
    interface_name: position
hand_velocity_controller:
  ros__parameters:
    joints: [hand_wheel]
    interface_name: velocity
"""


def test_whole_files_for_ros2_control() -> None:
    topics = Topics(StationFacts("bench"))
    assert ros2_control.xacro(NODE, ros2_control.joints(NODE, topics), topics) == XACRO
    wrist = replace(CHANNELS[0], number=5, name="wrist", units=units_of(radians=1), timing=Timing(period=0.1))
    wheel = replace(CHANNELS[0], number=6, name="wheel", units=units_of(radians=1, seconds=-1))
    node = with_channels(*CHANNELS, wrist, wheel)
    assert ros2_control.controllers(node, ros2_control.joints(node, topics), topics) == CONTROLLERS


@pytest.mark.parametrize(
    ("periods", "rate"),
    [
        ((0.02, 0.05, 0.1), 10), ((0.001, 0.3, 0.2), 3), ((3.0, 0.1, 0.1), 1), ((0.01, math.nan, 0.0), 100),
        ((0.02, 0.05, struct.unpack("f", struct.pack("f", 0.1))[0]), 10),  # as a datasheet holds it
    ],
)  # fmt: skip
def test_the_rate_is_whole_hertz_of_the_slowest_channel_of_a_joint_and_never_0(
    periods: tuple[float, ...], rate: int
) -> None:
    topics = Topics(StationFacts("bench"))
    timed = [replace(channel, timing=Timing(period=time)) for channel, time in zip(CHANNELS, periods, strict=False)]
    node = with_channels(*timed, CHANNELS[3])
    text = ros2_control.controllers(node, ros2_control.joints(node, topics), topics)
    assert f"    update_rate: {rate}\n" in text


@pytest.mark.parametrize(
    ("change", "message", "key"),
    [
        ({"low": math.nan}, "LowLimit of channel 1", "low-limit in [channel.1]"),
        ({"high": math.inf}, "HiLimit of channel 1", "high-limit in [channel.1]"),
        ({"timing": Timing(period=0.0)}, "SPeriod of a joint's channel", "sampling-period in [channel.1]"),
        ({"timing": Timing()}, "SPeriod of a joint's channel", "sampling-period in [channel.1]"),
    ],
)
def test_a_joint_without_a_limit_or_a_period_is_refused_by_name(change: dict[str, Any], message: str, key: str) -> None:
    topics = Topics(StationFacts("bench"))
    node = with_channels(replace(CHANNELS[0], **change))
    found = ros2_control.joints(node, topics)
    write = ros2_control.controllers if "timing" in change else ros2_control.xacro
    with pytest.raises(MissingFieldError) as refused:
        write(node, found, topics)
    assert refused.value.message == (
        f"ros2_control requires {message}, which the datasheet of node 8d4d9da65281f7000000 lacks."
    )
    assert refused.value.hint == (
        "Make a type of your own: profile new my-type --extends gripper -o my-type.toml."
        f" Add {key} to its profile my-type.toml, then: provision 8d4d9da65281f7000000 --profile my-type.toml"
    )
    for profile, place in (("own.toml", "its profile own.toml"), ("", "its profile")):
        hint = replace(NODE, profile=profile).missing("X", "y", "z").hint
        file = profile or "NAME"
        assert hint == f"Add z to {place}, then: provision 8d4d9da65281f7000000 --profile {file}"


def lines(elements: list[dict[str, Any]], place: str = "") -> list[str]:
    """Return each element as a line: its place, value or type of the value, and semantic id."""
    found = []
    for element in sorted(elements, key=lambda part: part["idShort"]):
        semantic = "".join(key["value"] for key in element.get("semanticId", {}).get("keys", []))
        inside = element.get("submodelElements", element.get("value"))
        where = f"{place}{element['idShort']}"
        if element["modelType"] in ("Submodel", "SubmodelElementCollection"):
            found += [f"{where}/ <{semantic}>", *lines(inside, f"{where}/")]
        elif element["modelType"] == "MultiLanguageProperty":
            (text,) = inside
            found.append(f"{where} = {text['language']} {text['text']} <{semantic}>")
        else:
            found.append(f"{where} = {element['valueType'].removeprefix('xs:')} {inside} <{semantic}>")
    return found


def test_a_whole_asset_administration_shell() -> None:
    pytest.importorskip("basyx")
    from teds_provision.describe.asset_shell import asset_shell

    document = json.loads(asset_shell(NODE))
    (shell,) = document["assetAdministrationShells"]
    assert (shell["id"], shell["idShort"]) == ("urn:teds:8d4d9da65281f7000000:shell", "Node_8d4d9da65281f7000000")
    assert shell["assetInformation"] == {"assetKind": "Instance", "globalAssetId": "urn:teds:8d4d9da65281f7000000"}
    assert [submodel["keys"][0]["value"] for submodel in shell["submodels"]] == [
        "urn:teds:8d4d9da65281f7000000:nameplate",
        "urn:teds:8d4d9da65281f7000000:technical-data",
    ]
    plate, technical = sorted(document["submodels"], key=lambda submodel: submodel["id"])
    assert plate["id"] == "urn:teds:8d4d9da65281f7000000:nameplate"
    assert technical["id"] == "urn:teds:8d4d9da65281f7000000:technical-data"
    assert lines([plate]) == PLATE_LINES
    assert lines([technical]) == TECHNICAL_LINES
    more = replace(NODE, nameplate={**PLATE, "modelno": "50", "versioncode": "B"})
    added = set(lines(json.loads(asset_shell(more))["submodels"])) - set(PLATE_LINES + TECHNICAL_LINES)
    assert added == {
        "Nameplate/ManufacturerProductType = string 50 <0112/2///61987#ABA300#008>",
        "Nameplate/HardwareVersion = string B <0112/2///61987#ABA926#008>",
    }


@pytest.mark.parametrize(
    ("element", "form_name", "field"),
    [
        ("ProductUri", "The Digital Nameplate", "URIOfTheProduct"),
        ("ManufacturerId", "The Digital Nameplate", "ManufacturerName"),
        ("ProductDescription", "The Digital Nameplate", "ManufacturerProductDesignation"),
        ("OrderCode", "The Digital Nameplate", "OrderCodeOfManufacturer"),
        ("ArticleNo", "Technical Data", "ManufacturerArticleNumber"),
        ("Street", "The Digital Nameplate", "AddressInformation/Street"),
        ("ZipCode", "The Digital Nameplate", "AddressInformation/Zipcode"),
        ("CityTown", "The Digital Nameplate", "AddressInformation/CityTown"),
        ("NationalCode", "The Digital Nameplate", "AddressInformation/NationalCode"),
    ],
)
def test_each_field_that_a_shell_requires_is_asked_for_by_its_element(element: str, form_name: str, field: str) -> None:
    pytest.importorskip("basyx")
    from teds_provision.describe.asset_shell import asset_shell

    lacking = {name: value for name, value in PLATE.items() if name != element.lower()}
    with pytest.raises(MissingFieldError) as refused:
        asset_shell(replace(NODE, nameplate=lacking))
    assert refused.value.message.startswith(f"{form_name} requires {field}, which")
    assert f'Add <{element}> in the xml of [[text]] with kind = "meta-identification" to' in refused.value.hint


PLATE_LINES = """Nameplate/ <https://admin-shell.io/idta/nameplate/3/0/Nameplate>
Nameplate/AddressInformation/ <https://admin-shell.io/zvei/nameplate/1/0/ContactInformations/AddressInformation>
Nameplate/AddressInformation/CityTown = en Lab <0173-1#02-AAO132#002>
Nameplate/AddressInformation/NationalCode = en DE <0173-1#02-AAO134#002>
Nameplate/AddressInformation/Street = en Bench 1 <0173-1#02-AAO128#002>
Nameplate/AddressInformation/Zipcode = en 12345 <0173-1#02-AAO129#002>
Nameplate/ManufacturerName = en Example Robotics <0112/2///61987#ABA565#009>
Nameplate/ManufacturerProductDesignation = en Gripper 50 <0112/2///61987#ABA567#009>
Nameplate/OrderCodeOfManufacturer = string GR-50-A <0112/2///61987#ABA950#008>
Nameplate/ProductArticleNumberOfManufacturer = string 4711 <0112/2///61987#ABA581#007>
Nameplate/SerialNumber = string 0042 <0112/2///61987#ABA951#009>
Nameplate/URIOfTheProduct = anyURI https://example.org/gr50/0042 <0112/2///61987#ABN590#002>""".splitlines()
TECHNICAL_LINES = """TechnicalData/ <https://admin-shell.io/ZVEI/TechnicalData/Submodel/1/2>
TechnicalData/GeneralInformation/ <https://admin-shell.io/ZVEI/TechnicalData/GeneralInformation/1/1>
TechnicalData/GeneralInformation/ManufacturerArticleNumber = string 4711 <0173-1#02-AAO676#003>
TechnicalData/GeneralInformation/ManufacturerName = string Example Robotics <0173-1#02-AAO677#002>
TechnicalData/GeneralInformation/ManufacturerOrderCode = string GR-50-A <0173-1#02-AAO227#002>
TechnicalData/GeneralInformation/ManufacturerProductDesignation = en Gripper 50 <0173-1#02-AAW338#001>
TechnicalData/TechnicalProperties/ <https://admin-shell.io/ZVEI/TechnicalData/TechnicalProperties/1/1>
TechnicalData/TechnicalProperties/Channel1/ <https://admin-shell.io/ZVEI/TechnicalData/MainSection/1/1>
TechnicalData/TechnicalProperties/Channel1/HighLimit = double 0.085 <>
TechnicalData/TechnicalProperties/Channel1/Kind = string actuator <>
TechnicalData/TechnicalProperties/Channel1/LowLimit = double 0.0 <>
TechnicalData/TechnicalProperties/Channel1/Name = string Opening <>
TechnicalData/TechnicalProperties/Channel1/SamplingPeriod = double 0.02 <>
TechnicalData/TechnicalProperties/Channel1/Unit = string m <>
TechnicalData/TechnicalProperties/Channel2/ <https://admin-shell.io/ZVEI/TechnicalData/MainSection/1/1>
TechnicalData/TechnicalProperties/Channel2/CalibrationDate = string 2026-03-01 <>
TechnicalData/TechnicalProperties/Channel2/CalibrationDue = string 2027-03-01 <>
TechnicalData/TechnicalProperties/Channel2/HighLimit = double 0.1 <>
TechnicalData/TechnicalProperties/Channel2/Kind = string sensor <>
TechnicalData/TechnicalProperties/Channel2/LowLimit = double 0.0 <>
TechnicalData/TechnicalProperties/Channel2/Name = string channel 2 <>
TechnicalData/TechnicalProperties/Channel2/SamplingPeriod = double 0.05 <>
TechnicalData/TechnicalProperties/Channel2/Uncertainty = double 0.005 <>
TechnicalData/TechnicalProperties/Channel2/Unit = string m <>
TechnicalData/TechnicalProperties/Channel3/ <https://admin-shell.io/ZVEI/TechnicalData/MainSection/1/1>
TechnicalData/TechnicalProperties/Channel3/Kind = string sensor <>
TechnicalData/TechnicalProperties/Channel3/LowLimit = double -10.0 <>
TechnicalData/TechnicalProperties/Channel3/Name = string Grip force <>
TechnicalData/TechnicalProperties/Channel3/SamplingPeriod = double 0.1 <>
TechnicalData/TechnicalProperties/Channel3/Unit = string N <>
TechnicalData/TechnicalProperties/Channel4/ <https://admin-shell.io/ZVEI/TechnicalData/MainSection/1/1>
TechnicalData/TechnicalProperties/Channel4/Kind = string event sensor <>
TechnicalData/TechnicalProperties/Channel4/Name = string lamp <>
TechnicalData/TechnicalProperties/Channel4/SamplingPeriod = double 9.0 <>
TechnicalData/TechnicalProperties/Channel4/Unit = string count <>""".splitlines()


def test_each_joint_of_a_node_has_its_interfaces_and_a_node_without_one_is_refused() -> None:
    topics = Topics(StationFacts("bench"))
    wrist = replace(CHANNELS[0], number=5, name="wrist", units=units_of(radians=1), low=-1 / 3)
    wheel = replace(CHANNELS[0], number=6, name="wheel", units=units_of(radians=1, seconds=-1))
    node = with_channels(*CHANNELS, wrist, wheel)
    text = ros2_control.xacro(node, ros2_control.joints(node, topics), topics)
    assert re.findall('<joint name="(.*?)">', text) == ["hand_opening", "hand_wheel", "hand_wrist"]
    assert re.findall('<command_interface name="(.*?)">', text) == ["position", "velocity", "position"]
    assert f'<param name="min">{-1 / 3!r}</param>' in text, "every digit"
    without = with_channels(*(replace(channel, timing=Timing()) for channel in (*CHANNELS, wrist, wheel)))
    with pytest.raises(MissingFieldError) as lacking:
        ros2_control.controllers(without, ros2_control.joints(without, topics), topics)
    assert "Add sampling-period in [channel.1] to its profile" in lacking.value.hint
    with pytest.raises(BadDataError) as refused:
        ros2_control.joints(with_channels(CHANNELS[2]), topics)
    assert (refused.value.message, refused.value.hint) == (
        f"Node {UUID.hex()} has no joint.",
        "A joint is an actuator of an angle, a length, their speeds, a force or a torque.",
    )


def test_a_shell_is_readable_text_and_has_channels_of_an_unknown_kind() -> None:
    pytest.importorskip("basyx")
    from teds_provision.describe.asset_shell import asset_shell

    text = asset_shell(with_channels(replace(CHANNELS[0], kind=None, name="Öffnung")))
    assert "TechnicalData/TechnicalProperties/Channel1/Kind = string unknown <>" in lines(json.loads(text)["submodels"])
    assert "Öffnung" in text
    assert text.endswith("\n}\n")
