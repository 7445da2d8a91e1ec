"""ROS 2 messages as Cyclone DDS types: names and octets as a ROS 2 middleware writes them, and their type hashes.

Loaded late, by sinks.ros2 alone: Cyclone DDS is an extra. No postponed annotations here, for Cyclone reads them.
"""

import struct
import sys
from array import array as packed
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final, cast

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int32, sequence, uint8, uint32

TYPE_HASHES: Final = {
    "std_msgs/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_msgs/Float64": "705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    "sensor_msgs/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/Temperature": "72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8",
    "sensor_msgs/FluidPressure": "22dfb2b145a0bd5a31a1ac3882a1b32148b51d9b2f3bab250290d66f3595bc32",
    "sensor_msgs/RelativeHumidity": "8687c99b4fb393cb2e545e407b5ea7fd0b5d8960bcd849a0f86c544740138839",
    "sensor_msgs/Illuminance": "b954b25f452fcf81a91c9c2a7e3b3fd85c4c873d452aecb3cfd8fd1da732a22d",
    "sensor_msgs/MagneticField": "e80f32f56a20486c9923008fc1a1db07bbb273cbbf6a5b3bfa00835ee00e4dff",
    "sensor_msgs/Imu": "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "geometry_msgs/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "sensor_msgs/Range": "b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
    "diagnostic_msgs/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "rmw_dds_common/ParticipantEntitiesInfo": "e725f4a506958c79f95dd693b965722c57b19cd18e7eff984f49561b93dc985d",
}
"""RIHS01 hashes of the definitions (REP 2016), the same from Humble to Lyrical but for those in HUMBLE_HASHES."""
HUMBLE_HASHES: Final = {
    "rmw_dds_common/ParticipantEntitiesInfo": "2b40df2d2f4d5cd690221a503f406fe3673efcc4151a9f049b4d3569ecf5c4e4",
    "sensor_msgs/Range": "9430b1915b94d4268ff903679e8ecd09b6a67d331bd028738ec1eeb592891ebd",
}


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

    def serialize(self, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None) -> bytes:
        """Return the octets that Cyclone DDS makes of it number by number and name by name: XCDR1, all at once.

        A group's row has hundreds of names, the same in every row; one by one they took most of a millisecond.
        """
        if buffer is not None or endianness is not None or use_version_2 is not False or sys.byteorder != "little":
            octets: bytes = super().serialize(buffer, endianness, use_version_2)
            return octets
        stamp = self.header.stamp
        octets = _STAMP.pack(b"\0\1\0\0", stamp.sec, stamp.nanosec)
        # Cyclone's own cast names the sequence, but not its element type.
        names, *numbers = cast("tuple[Sequence[Any], ...]", (self.name, self.position, self.velocity, self.effort))
        octets += _names_in_cdr(self.header.frame_id, tuple(names))
        for part in numbers:
            octets += _numbers_in_cdr(part, len(octets) - _CDR_HEAD)
        return octets


_CDR_HEAD: Final = 4
_STAMP: Final = struct.Struct("<4siI")


@lru_cache(maxsize=64)
def _names_in_cdr(frame: str, names: tuple[str, ...]) -> bytes:
    """Return the octets between stamp and positions, each text at a multiple of four; the stamp has eight octets."""
    return _text_in_cdr(frame) + struct.pack("<I", len(names)) + b"".join(map(_text_in_cdr, names))


def _text_in_cdr(text: str) -> bytes:
    octets = text.encode() + b"\0"
    return struct.pack("<I", len(octets)) + octets + bytes(-len(octets) % 4)


def _numbers_in_cdr(numbers: Sequence[float], at: int) -> bytes:
    """Return a sequence of float64 that begins ``at`` so many octets of the message, a multiple of four."""
    count = struct.pack("<I", len(numbers))
    return count + bytes(-(at + 4) % 8) + packed("d", numbers).tobytes() if len(numbers) else count


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
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """geometry_msgs/Vector3."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """geometry_msgs/Quaternion."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


def _zeros() -> list[float]:
    return [0.0] * 9


@dataclass
class MagneticField(IdlStruct, typename="sensor_msgs::msg::dds_::MagneticField_"):
    """sensor_msgs/MagneticField, T."""

    header: Header = field(default_factory=Header)
    magnetic_field: Vector3 = field(default_factory=Vector3)
    magnetic_field_covariance: array[float64, 9] = field(default_factory=_zeros)


@dataclass
class Imu(IdlStruct, typename="sensor_msgs::msg::dds_::Imu_"):
    """sensor_msgs/Imu, rad/s and m/s²."""

    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: array[float64, 9] = field(default_factory=_zeros)
    angular_velocity: Vector3 = field(default_factory=Vector3)
    angular_velocity_covariance: array[float64, 9] = field(default_factory=_zeros)
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    linear_acceleration_covariance: array[float64, 9] = field(default_factory=_zeros)


@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    """geometry_msgs/Wrench, N and N·m."""

    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    """geometry_msgs/WrenchStamped."""

    header: Header = field(default_factory=Header)
    wrench: Wrench = field(default_factory=Wrench)


@dataclass
class Range(IdlStruct, typename="sensor_msgs::msg::dds_::Range_"):
    """sensor_msgs/Range, m, as from Jazzy on."""

    header: Header = field(default_factory=Header)
    radiation_type: uint8 = 0
    field_of_view: float32 = 0.0
    min_range: float32 = 0.0
    max_range: float32 = 0.0
    range: float32 = 0.0
    variance: float32 = 0.0


@dataclass
class HumbleRange(IdlStruct, typename="sensor_msgs::msg::dds_::Range_"):
    """As Range, without the variance, of Humble."""

    header: Header = field(default_factory=Header)
    radiation_type: uint8 = 0
    field_of_view: float32 = 0.0
    min_range: float32 = 0.0
    max_range: float32 = 0.0
    range: float32 = 0.0


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
    "sensor_msgs/MagneticField": MagneticField,
    "sensor_msgs/Imu": Imu,
    "geometry_msgs/WrenchStamped": WrenchStamped,
    "sensor_msgs/Range": Range,
    "diagnostic_msgs/DiagnosticArray": DiagnosticArray,
    "rmw_dds_common/ParticipantEntitiesInfo": ParticipantEntitiesInfo,
}
HUMBLE_TYPES: Final = {
    "rmw_dds_common/ParticipantEntitiesInfo": HumbleParticipantEntitiesInfo,
    "sensor_msgs/Range": HumbleRange,
}
