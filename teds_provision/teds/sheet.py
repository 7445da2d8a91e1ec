"""The typed datasheet: the content of one node's TEDS, as values with types and units.

:meth:`Sheet.from_image` never raises, whatever the octets. Missing values are None, NaN or "", faults are in
``findings`` beside the values. Trust is another question: a Sheet is made from verified and foreign TEDS alike
(``protocol.datasheet`` judges the signature).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import Calibration, from_decoded, is_finite
from teds_provision.teds.certificate import certificate_reference_of
from teds_provision.teds.channel import (
    NOT_STATED,
    Channel,
    ChannelKind,
    Sampling,
    Timing,
    channel_from,
    described,
    number_of,
    read_channel,
)
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Conformity, DecodedTeds, Severity
from teds_provision.teds.codec.tables import name_of
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.origin import Origin, origin_of
from teds_provision.teds.value_table import read_value_table

__all__ = [
    "NOT_STATED",
    "Channel",
    "ChannelKind",
    "Meta",
    "Sampling",
    "Sheet",
    "SheetFinding",
    "Timing",
    "channel_from",
    "channel_of",
    "computable",
    "described",
    "name_among",
    "node_name",
]

_DAMAGED: Final = (Conformity.MALFORMED, Conformity.FRAME_BAD, Conformity.FRAME_AND_CONTENT_BAD, Conformity.MESSAGE)


@dataclass(frozen=True)
class SheetFinding:
    """A fault in one TEDS of the sheet, or between them; ``offset`` counts from its first octet."""

    channel: int
    access_code: int
    severity: Severity
    code: str
    message: str
    offset: int | None = None


@dataclass(frozen=True)
class Meta:
    """The node as a whole: Meta-TEDS and its name. Times in seconds, NaN if not stated.

    ``uuid`` has 10 octets (2007) or 16 (2024), ``channels`` is MaxChan; None if not stated. ``vectors`` are the
    members of each vector group, in their order. ``origin`` is what a wrapped node has its values from.
    """

    uuid: bytes | None = None
    name: str = ""
    channels: int | None = None
    operation_timeout: float = NOT_STATED
    slow_access_timeout: float = NOT_STATED
    self_test_time: float = NOT_STATED
    vectors: tuple[tuple[int, ...], ...] = ()
    origin: Origin | None = None


@dataclass(frozen=True)
class Sheet:
    """The datasheet of one node; ``channels`` ascend by number and are those that have a TransducerChannel TEDS.

    ``calibrations`` holds every calibration that is understood, also one that cannot be computed, or one of a channel
    that nothing describes.
    """

    uuid: bytes
    meta: Meta
    channels: tuple[Channel, ...]
    calibrations: Mapping[int, Calibration]
    findings: tuple[SheetFinding, ...] = ()

    @classmethod
    def from_image(cls, image: Image) -> Sheet:
        """Return the datasheet of an image; never raises."""
        return _Reader(image.uuid, image.blocks).sheet()

    @classmethod
    def from_blocks(cls, blocks: Mapping[BlockId, bytes]) -> Sheet:
        """Return the datasheet of framed TEDS by (channel, access code); its UUID is the Meta-TEDS's, or empty."""
        return _Reader(b"", blocks).sheet()

    def shown_in(self, units: Mapping[int, str]) -> Sheet:
        """Return the same datasheet, with the values of these channels in these display units, if they fit."""
        if not units:
            return self
        return replace(
            self, channels=tuple(replace(channel, display=units.get(channel.number, "")) for channel in self.channels)
        )

    def channel(self, number: int) -> Channel | None:
        """Return the channel of that number, None if it is not described."""
        return next((channel for channel in self.channels if channel.number == number), None)

    def named(self, name: str) -> Channel | None:
        """Return the only channel of that name, None if there is none or more than one."""
        found = [channel for channel in self.channels if channel.name == name]
        return found[0] if len(found) == 1 else None

    def chosen(self, channel: int | str, node: str) -> Channel:
        """Return the channel that a person chose by number or name; ``node`` names the node in errors.

        Case counts only if two names differ by it. Raises BadDataError with the channels that there are.
        """
        if isinstance(channel, int):
            found = self.channel(channel)
        else:
            alike = [known for known in self.channels if known.name.casefold() == channel.casefold()]
            found = self.named(channel) or (alike[0] if len(alike) == 1 else None)
        if found is None:
            listed = ", ".join(
                f"{known.number} ({known.name})" if known.name else str(known.number) for known in self.channels
            )
            which = channel if isinstance(channel, int) else repr(channel)
            raise BadDataError(f"Node {node} has no channel {which}; its datasheet has {listed or 'none'}.")
        return found

    @property
    def errors(self) -> tuple[SheetFinding, ...]:
        """Findings of severity error."""
        return tuple(finding for finding in self.findings if finding.severity == "error")


def channel_of(number: int, blocks: Mapping[BlockId, bytes]) -> Channel:
    """Return one channel among framed TEDS by (channel, access code); without a description its facts are empty."""
    return _Reader(b"", blocks).channel(number)


def name_among(number: int, blocks: Mapping[BlockId, bytes]) -> str:
    """Return the name of a channel (0: of the node) among framed TEDS, "" if there is none that can be printed."""
    octets = blocks.get((number, AccessCode.NAME))
    return node_name(decode(octets) if octets is not None else None)


def node_name(decoded: DecodedTeds | None) -> str:
    """Return TCName of a decoded name TEDS, "" if it has none that can be printed."""
    name = decoded.get("TCName") if decoded is not None else None
    return name if isinstance(name, str) and name.isprintable() else ""


_SHORT: Final = 4096
_decoded = lru_cache(maxsize=32)(decode)
"""Boards of a type share most of their TEDS, and each one is looked at when it is built, written and read back."""


class _Reader:
    """Reads the TEDS of one node, each decoded once."""

    def __init__(self, uuid: bytes, blocks: Mapping[BlockId, bytes]) -> None:
        self.uuid, self.blocks = uuid, blocks
        self.seen: dict[BlockId, DecodedTeds] = {}
        self.understood: dict[int, Calibration] = {}

    def decoded(self, channel: int, access_code: int) -> DecodedTeds | None:
        """Return one TEDS decoded, None if it is absent."""
        key = (channel, access_code)
        if key not in self.seen:
            octets = self.blocks.get(key)
            if octets is None:
                return None
            self.seen[key] = _decoded(octets) if len(octets) <= _SHORT else decode(octets)
        return self.seen[key]

    def name(self, channel: int) -> str:
        return node_name(self.decoded(channel, AccessCode.NAME))

    def channel(self, number: int) -> Channel:
        own = read_channel(number, self.name(number), self.decoded(number, AccessCode.CHANNEL))
        table = read_value_table(self.decoded(number, AccessCode.CHANNEL_ID))
        own = replace(own, value_table=table) if table else own
        teds = self.decoded(number, AccessCode.CALIBRATION)
        if teds is None:
            return own
        if teds.verdict in _DAMAGED:
            return replace(own, calibration_problem="Its length, checksum or structure is wrong.")
        try:
            found = from_decoded(teds, channel=number, units=own.units, actuator=own.actuator)
        except BadDataError as error:
            return replace(own, calibration_problem=error.message)
        found = replace(found, certificate=certificate_reference_of(self.blocks, number))
        self.understood[number] = found
        problem = computable(found)
        return replace(own, calibration=None if problem else found, calibration_problem=problem)

    def meta(self) -> Meta:
        teds = self.decoded(0, AccessCode.META)
        if teds is None:
            return Meta(name=self.name(0), origin=origin_of(self.blocks))
        uuid, channels = teds.get("UUID"), teds.get("MaxChan")
        return Meta(
            uuid if isinstance(uuid, bytes) else None,
            self.name(0),
            channels if isinstance(channels, int) else None,
            number_of(teds, "OholdOff"),
            number_of(teds, "SHoldOff"),
            number_of(teds, "TestTime"),
            vectors=tuple(_vectors(teds)),
            origin=origin_of(self.blocks),
        )

    def sheet(self) -> Sheet:
        meta = self.meta()
        numbers = sorted({channel for channel, code in self.blocks if code in _OF_CHANNELS})
        every = [self.channel(number) for number in numbers]
        described = tuple(channel for channel in every if channel.described)
        findings = (*self.of_blocks(), *_between(self.uuid, meta, every))
        return Sheet(self.uuid or meta.uuid or b"", meta, described, self.understood, findings)

    def of_blocks(self) -> Iterator[SheetFinding]:
        """Yield the decoder's findings for each TEDS, and TEDS in a wrong place."""
        for channel, code in sorted(self.blocks):
            teds = self.decoded(channel, code)
            if teds is None:
                continue
            for finding in teds.findings:
                yield SheetFinding(channel, code, finding.severity, finding.code, finding.message, finding.offset)
            if teds.access_code not in (code, None):
                message = f"This stands where {name_of(code)} belongs; its TEDSID says {teds.name}."
                yield SheetFinding(channel, code, "error", "class", message)


def _vectors(meta: DecodedTeds) -> Iterator[tuple[int, ...]]:
    """Yield the members of every VGroup that can be read."""
    for group in meta.fields:
        for part in group.children if group.name == "VGroup" else ():
            if part.name == "MemList" and isinstance(part.value, tuple | list):
                yield tuple(number for number in part.value if isinstance(number, int))


_OF_CHANNELS: Final = (AccessCode.CHANNEL, AccessCode.CALIBRATION)


def _between(uuid: bytes, meta: Meta, channels: list[Channel]) -> Iterator[SheetFinding]:
    """Yield contradictions between the TEDS of a node."""
    if uuid and meta.uuid and meta.uuid[-len(uuid) :] != uuid:
        message = f"The Meta-TEDS names the UUID {meta.uuid.hex()}, not {uuid.hex()}."
        yield SheetFinding(0, AccessCode.META, "error", "uuid", message)
    described = [channel for channel in channels if channel.described]
    if meta.channels is not None and meta.channels != len(described):
        message = f"The Meta-TEDS counts {meta.channels} channels; {len(described)} are described."
        yield SheetFinding(0, AccessCode.META, "warning", "channels", message)
    for channel in channels:
        yield from _of_calibration(channel)
    yield from _same_names(described)


def _of_calibration(channel: Channel) -> Iterator[SheetFinding]:
    if channel.calibration_problem:
        yield SheetFinding(
            channel.number, AccessCode.CALIBRATION, "warning", "calibration", channel.calibration_problem
        )
    if not channel.described:
        message = "There is a calibration, and nothing that describes the channel."
        yield SheetFinding(channel.number, AccessCode.CALIBRATION, "warning", "undescribed", message)


def _same_names(channels: list[Channel]) -> Iterator[SheetFinding]:
    """Yield channels with equal names."""
    names: dict[str, int] = {}
    for channel in channels:
        first = names.setdefault(channel.name, channel.number) if channel.name else channel.number
        if first != channel.number:
            message = f'Channels {first} and {channel.number} have the same name, "{channel.name}".'
            yield SheetFinding(channel.number, AccessCode.NAME, "warning", "same-name", message)


def computable(calibration: Calibration) -> str:
    """Return why a calibration cannot be computed; "" if it can."""
    unit = calibration.unit
    if not is_finite(calibration):
        return "A number of the calibration is not finite."
    if not all(part.ascending for part in calibration.inputs):
        return "The segment boundaries of the calibration do not ascend."
    if not math.isfinite(unit.scale) or not math.isfinite(unit.offset) or unit.scale == 0:
        return "The calibrated unit has no way into SI units: its slope is 0 or not finite."
    return ""
