"""One transducer type from a profile, checked and in SI units; and the TEDS of a node that it gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import Calibration, Monotone
from teds_provision.teds.calibration.samples import raw_range
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.composer import compose
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Edition, Units
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile.firmware import FirmwareDemand
from teds_provision.teds.units import WrittenUnit

USER_DEFINED_NAME: Final = 0
_CAL_NONE, _CAL_SUPPLIED = 0, 1
_UUID_OCTETS: Final = {2007: 10, 2024: 16}

Pairs = tuple[tuple[str, object], ...]
"""Fields of a TEDS by name, in order; repeated names are repeated fields."""


@dataclass(frozen=True)
class CalibrationDemand:
    """A profile's requirements on a channel's calibration.

    ``raw_range`` is what the channel's electronics can deliver if that is less than its data model allows; ``interval``
    is in seconds; ``zero_offset``: the offset may be adjusted in use; ``standard_deviation`` (in the channel's unit,
    informative) is a figure that a TEDS has no field for; ``indication`` is slope and intercept from the raw number to
    the value that the sensor indicates before it is calibrated, in the channel's unit.
    """

    required: bool = False
    method: str | None = None
    degree: int | None = None
    monotone: Monotone | None = None
    interval: float | None = None
    raw_range: tuple[float, float] | None = None
    zero_offset: bool = False
    standard_deviation: float | None = None
    indication: tuple[float, float] | None = field(default=None, repr=False)
    """Not in the profile's digest, which is made of the repr: it changes how a certificate is read, nothing else."""


@dataclass(frozen=True)
class ChannelProfile:
    """One TransducerChannel; ``fields`` by TEDS name are ready to be composed (SI units); CalKey is not in it.

    ``frame`` is the coordinate frame of its values for robots, ``{node}`` in it is replaced by the node's name.
    """

    number: int
    name: str
    unit: WrittenUnit
    fields: Mapping[str, object]
    calibration: CalibrationDemand = CalibrationDemand()
    calibration_key: int | None = None
    display: str | None = None
    frame: str = ""

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
    firmware: FirmwareDemand | None = None
    composed: dict[tuple[object, ...], bytes] = field(init=False, default_factory=dict, repr=False, compare=False)
    """Parts that are equal for every node of this type, made for the first one: TEDS, and the profile's digest."""

    def channel(self, number: int) -> ChannelProfile | None:
        """Return the channel of that number, None if the type has none."""
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
        """Build a node's TEDS of this type: Meta, TransducerChannel, names, calibrations (by channel), PHY, texts.

        ``uuid`` has 10 octets (16 in the 2024 form; 10 are put at the end of 16 there, with a warning). Raises
        BadDataError for an abstract profile, a UUID of another length, or a calibration that does not belong to a
        channel.
        """
        return _build(self, uuid, calibration=calibration or {}, name=name, edition=edition, now=now)


def _build(
    profile: Profile,
    uuid: bytes,
    *,
    calibration: Mapping[int, Calibration],
    name: str | None,
    edition: Edition,
    now: datetime | None,
) -> BuiltDatasheet:
    """See :meth:`Profile.build`."""
    _require_buildable(profile, calibration)
    warnings: list[str] = []
    uuid = _uuid(uuid, edition, warnings)
    meta = (("UUID", uuid), *profile.meta, ("MaxChan", len(profile.channels)))
    blocks: dict[BlockId, bytes] = {(0, AccessCode.META): compose(AccessCode.META, meta, edition=edition)}
    for channel in profile.channels:
        given = calibration.get(channel.number)
        blocks[channel.number, AccessCode.CHANNEL] = _described(profile, channel, given, edition)
        if given is not None:
            blocks[channel.number, AccessCode.CALIBRATION] = compose(
                AccessCode.CALIBRATION, given.fields(edition), edition=edition
            )
            if given.certificate is not None:
                blocks[channel.number, AccessCode.CERTIFICATE] = given.certificate.encode()
        if channel.name:
            blocks[channel.number, AccessCode.NAME] = _name(channel.name, edition)
        warnings += _calibration_warnings(channel, given, now or datetime.now(UTC))
    blocks[0, AccessCode.NAME] = _name(name or profile.tim_name, edition)
    if profile.phy:
        blocks[0, AccessCode.PHY] = compose(AccessCode.PHY, profile.phy, edition=edition)
    for text in profile.texts:
        block = (("Text", {"LangCode": text.language, "Text": text.text}),)
        blocks[text.channel, text.access_code] = compose(text.access_code, block, edition=edition)
    return BuiltDatasheet(dict(sorted(blocks.items())), tuple(warnings))


def _require_buildable(profile: Profile, calibration: Mapping[int, Calibration]) -> None:
    if profile.abstract:
        raise BadDataError(
            f"The profile {profile.name} is only a base for others.",
            hint="Use a profile that extends it; see profile list.",
        )
    for number in calibration:
        if profile.channel(number) is None:
            raise BadDataError(
                f"The calibration is for channel {number}; {profile.name} has {_numbered(profile.channels)}.",
                hint="Give the calibration of this type, or --no-calibration to drop the one that the node has.",
            )


def _numbered(channels: Sequence[ChannelProfile]) -> str:
    return "channel 1 only" if len(channels) == 1 else f"channels 1 to {len(channels)}"


def _uuid(uuid: bytes, edition: Edition, warnings: list[str]) -> bytes:
    asked = _UUID_OCTETS[edition]
    if edition == 2024 and len(uuid) == 10:
        warnings.append("The node's UUID has 10 octets, the 2024 form 16: it was put behind six zero octets.")
        return bytes(6) + uuid
    if len(uuid) != asked:
        raise BadDataError(f"A UUID of the {edition} edition has {asked} octets, this one {len(uuid)}.")
    return uuid


def _calibration_key(channel: ChannelProfile, given: Calibration | None) -> int:
    if channel.calibration_key is not None:
        return channel.calibration_key
    return _CAL_NONE if given is None else _CAL_SUPPLIED


def _described(profile: Profile, channel: ChannelProfile, given: Calibration | None, edition: Edition) -> bytes:
    """Return the TransducerChannel TEDS: one for all nodes of the type that are calibrated alike."""
    key = _calibration_key(channel, given)
    place = (channel.number, key, edition)
    if place not in profile.composed:
        fields = {**channel.fields, "CalKey": key}
        profile.composed[place] = compose(AccessCode.CHANNEL, fields, edition=edition)
    return profile.composed[place]


def renamed(blocks: Mapping[BlockId, bytes], name: str) -> dict[BlockId, bytes]:
    """Return the same TEDS with another name of the node, in the edition that its name TEDS has."""
    present = blocks.get((0, AccessCode.NAME))
    edition = decode(present).edition if present is not None else None
    own = compose(AccessCode.NAME, {"Format": USER_DEFINED_NAME, "TCName": name}, edition=edition or 2007)
    return {**blocks, (0, int(AccessCode.NAME)): own}


@lru_cache(maxsize=64)
def _name(name: str, edition: Edition) -> bytes:
    return compose(AccessCode.NAME, (("Format", USER_DEFINED_NAME), ("TCName", name)), edition=edition)


def _calibration_warnings(channel: ChannelProfile, given: Calibration | None, now: datetime) -> list[str]:
    demand = channel.calibration
    where = f"Channel {channel.number}" + (f" ({channel.name})" if channel.name else "")
    if given is None:
        if not demand.required:
            return []
        return [f"{where} has no calibration, and its type asks for one: give it with --calibration FILE."]
    warnings = [f"{where}: {text}" for text in given.date_warnings(now, demand.interval)]
    if given.certificate is not None:
        warnings += [f"{where}: certificate {given.certificate.number}: {text}" for text in given.certificate.notes]
    if channel.calibration_key == _CAL_NONE:
        warnings.append(f"{where} has a calibration, but its calibration key says that there is none.")
    if demand.method and demand.method != given.method:
        warnings.append(f"{where}: this type expects the calibration method {demand.method}, but got {given.method}.")
    return warnings
