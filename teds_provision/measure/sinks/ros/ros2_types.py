"""ROS 2 messages as Cyclone DDS types: names and octets as a ROS 2 middleware writes them, and their type hashes.

Loaded late, by sinks.ros2 alone: Cyclone DDS is an extra. No postponed annotations here, for Cyclone reads them.
"""

from dataclasses import dataclass, field
from typing import Final

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32

TYPE_HASHES: Final = {
    "std_msgs/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_msgs/Float64": "705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    "sensor_msgs/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/Temperature": "72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8",
    "sensor_msgs/FluidPressure": "22dfb2b145a0bd5a31a1ac3882a1b32148b51d9b2f3bab250290d66f3595bc32",
    "sensor_msgs/RelativeHumidity": "8687c99b4fb393cb2e545e407b5ea7fd0b5d8960bcd849a0f86c544740138839",
    "sensor_msgs/Illuminance": "b954b25f452fcf81a91c9c2a7e3b3fd85c4c873d452aecb3cfd8fd1da732a22d",
    "diagnostic_msgs/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "rmw_dds_common/ParticipantEntitiesInfo": "e725f4a506958c79f95dd693b965722c57b19cd18e7eff984f49561b93dc985d",
}
"""RIHS01 hashes of the definitions, the same from Humble to Lyrical but for the last one (Humble has HUMBLE_GRAPH)."""
HUMBLE_GRAPH: Final = "2b40df2d2f4d5cd690221a503f406fe3673efcc4151a9f049b4d3569ecf5c4e4"


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """builtin_interfaces/Time."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """std_msgs/Header."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """std_msgs/String."""

    data: str = ""


@dataclass
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    """std_msgs/Float64."""

    data: float64 = 0.0


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """sensor_msgs/JointState."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
class Temperature(IdlStruct, typename="sensor_msgs::msg::dds_::Temperature_"):
    """sensor_msgs/Temperature, degrees Celsius."""

    header: Header = field(default_factory=Header)
    temperature: float64 = 0.0
    variance: float64 = 0.0


@dataclass
class FluidPressure(IdlStruct, typename="sensor_msgs::msg::dds_::FluidPressure_"):
    """sensor_msgs/FluidPressure, Pa."""

    header: Header = field(default_factory=Header)
    fluid_pressure: float64 = 0.0
    variance: float64 = 0.0


@dataclass
class RelativeHumidity(IdlStruct, typename="sensor_msgs::msg::dds_::RelativeHumidity_"):
    """sensor_msgs/RelativeHumidity, 0 to 1."""

    header: Header = field(default_factory=Header)
    relative_humidity: float64 = 0.0
    variance: float64 = 0.0


@dataclass
class Illuminance(IdlStruct, typename="sensor_msgs::msg::dds_::Illuminance_"):
    """sensor_msgs/Illuminance, lux."""

    header: Header = field(default_factory=Header)
    illuminance: float64 = 0.0
    variance: float64 = 0.0


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    """diagnostic_msgs/KeyValue."""

    key: str = ""
    value: str = ""


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    """diagnostic_msgs/DiagnosticStatus."""

    level: uint8 = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: sequence[KeyValue] = field(default_factory=list)


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    """diagnostic_msgs/DiagnosticArray."""

    header: Header = field(default_factory=Header)
    status: sequence[DiagnosticStatus] = field(default_factory=list)


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """rmw_dds_common/Gid: the GUID of a DDS entity."""

    data: array[uint8, 16] = field(default_factory=lambda: [0] * 16)


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """rmw_dds_common/NodeEntitiesInfo."""

    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: sequence[Gid] = field(default_factory=list)
    writer_gid_seq: sequence[Gid] = field(default_factory=list)


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """rmw_dds_common/ParticipantEntitiesInfo: which endpoints are a node's."""

    gid: Gid = field(default_factory=Gid)
    node_entities_info_seq: sequence[NodeEntitiesInfo] = field(default_factory=list)


@dataclass
class HumbleGid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """As Gid, of 24 octets, as Humble has it: the GUID, then zeros."""

    data: array[uint8, 24] = field(default_factory=lambda: [0] * 24)


@dataclass
class HumbleNodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """As NodeEntitiesInfo, of Humble."""

    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: sequence[HumbleGid] = field(default_factory=list)
    writer_gid_seq: sequence[HumbleGid] = field(default_factory=list)


@dataclass
class HumbleParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """As ParticipantEntitiesInfo, of Humble."""

    gid: HumbleGid = field(default_factory=HumbleGid)
    node_entities_info_seq: sequence[HumbleNodeEntitiesInfo] = field(default_factory=list)


TYPES: Final = {
    "std_msgs/String": String,
    "std_msgs/Float64": Float64,
    "sensor_msgs/JointState": JointState,
    "sensor_msgs/Temperature": Temperature,
    "sensor_msgs/FluidPressure": FluidPressure,
    "sensor_msgs/RelativeHumidity": RelativeHumidity,
    "sensor_msgs/Illuminance": Illuminance,
    "diagnostic_msgs/DiagnosticArray": DiagnosticArray,
    "rmw_dds_common/ParticipantEntitiesInfo": ParticipantEntitiesInfo,
}
