"""What a profile says about one transducer type, checked and in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from teds_provision.teds.calibration.samples import raw_range
from teds_provision.teds.codec.model import Edition, Units
from teds_provision.teds.units.units import WrittenUnit

if TYPE_CHECKING:
    from datetime import datetime

    from teds_provision.teds.calibration import Calibration
    from teds_provision.teds.image import BlockId

Pairs = tuple[tuple[str, object], ...]
"""Fields of a TEDS by name, in order; repeated names are repeated fields."""

Monotone = Literal["increasing", "decreasing", "either"]


@dataclass(frozen=True)
class CalibrationDemand:
    """What the profile asks of a channel's calibration.

    ``raw_range`` is what the channel's electronics can deliver where that is less than its data model allows;
    ``interval`` is in seconds; ``zero_offset`` says whether the offset may be adjusted in use; ``standard_deviation``
    (in the channel's unit, informative) is a figure that a TEDS has no field for.
    """

    required: bool = False
    method: str | None = None
    degree: int | None = None
    monotone: Monotone | None = None
    interval: float | None = None
    raw_range: tuple[float, float] | None = None
    zero_offset: bool = False
    standard_deviation: float | None = None


@dataclass(frozen=True)
class ChannelProfile:
    """One TransducerChannel; ``fields`` by TEDS name are ready to be composed (SI units); CalKey is not in it."""

    number: int
    name: str
    unit: WrittenUnit
    fields: Mapping[str, object]
    calibration: CalibrationDemand = CalibrationDemand()
    calibration_key: int | None = None
    display: str | None = None

    @property
    def units(self) -> Units:
        """Exponents of PhyUnits."""
        return self.unit.units

    @property
    def type(self) -> int:
        """ChanType: 0 sensor, 1 actuator, 2 event sensor."""
        return self._int(self.fields["ChanType"])

    @property
    def low_limit(self) -> float:
        """LowLimit in SI units."""
        return self._float("LowLimit")

    @property
    def high_limit(self) -> float:
        """HiLimit in SI units."""
        return self._float("HiLimit")

    @property
    def uncertainty(self) -> float:
        """OError in SI units."""
        return self._float("OError")

    @property
    def raw_range(self) -> tuple[float, float] | None:
        """Raw values the channel can give: the profile's ``raw-range``, else all that the data model allows."""
        if self.calibration.raw_range:
            return self.calibration.raw_range
        sample = self.fields["Sample"]
        if not isinstance(sample, Mapping):
            return None
        return raw_range(*(self._int(sample[name]) for name in ("DatModel", "ModLenth", "SigBits")))

    @staticmethod
    def _int(value: object) -> int:
        return value if isinstance(value, int) else 0

    def _float(self, name: str) -> float:
        value = self.fields[name]
        return float(value) if isinstance(value, (int, float)) else float("nan")


@dataclass(frozen=True)
class TextProfile:
    """One text-based TEDS (classes 2, 4, 6, 10, 11, 14): its XML text and language."""

    access_code: int
    channel: int
    text: str
    language: str = "en"


@dataclass(frozen=True)
class BuiltDatasheet:
    """Framed TEDS by (channel, access code), and what a person should know about them before they are signed."""

    blocks: dict[BlockId, bytes]
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Profile:
    """A transducer type: ``meta`` are the fields of its Meta-TEDS without UUID and MaxChan."""

    name: str
    title: str
    description: str
    file: str
    lineage: tuple[str, ...]
    tim_name: str
    links: tuple[str, ...]
    meta: Pairs
    channels: tuple[ChannelProfile, ...]
    phy: Pairs = ()
    texts: tuple[TextProfile, ...] = ()
    abstract: bool = False
    warnings: tuple[str, ...] = field(default=())

    def channel(self, number: int) -> ChannelProfile | None:
        """Channel of that number, None where the type has none."""
        return next((channel for channel in self.channels if channel.number == number), None)

    def build(
        self,
        uuid: bytes,
        *,
        calibration: Mapping[int, Calibration] | None = None,
        name: str | None = None,
        edition: Edition = 2007,
        now: datetime | None = None,
    ) -> BuiltDatasheet:
        """TEDS of this type for one node: Meta, TransducerChannel, names, calibrations (by channel), PHY and texts.

        ``uuid`` has 10 octets (16 in the 2024 form; 10 are put at the end of 16 there, with a warning). Raises BadData
        for an abstract profile, a UUID of another length, or a calibration that does not belong to a channel.
        """
        from teds_provision.teds.profile.build import build

        return build(self, uuid, calibration=calibration or {}, name=name, edition=edition, now=now)
