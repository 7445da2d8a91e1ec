"""Does the board match the profile: its own claims about its type, and its hardware's acceptance of the datasheet.

Before anything is written, every channel of the wanted datasheet is compared with what the board claims about it,
signed or not: kind, form of a value, dimension of the unit. An unsigned claim may refuse here, it permits nothing. At
the end the firmware itself is asked, which no TEDS commands (operation.md section 1): Operate with lease 0 gets 19 if
the channel accepts its datasheet, 6 if it does not, and claims nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

from teds_provision.errors import BadDataError, NodeRefusedError, PolicyError, TedsProvisionError
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.operation.commands import (
    DIGEST_OCTETS,
    FIRST_DEAD_MAN,
    MOST_SAMPLE_CHANNELS,
    OPERATION,
    ChannelState,
    OperateCommand,
    OperationReply,
    SampleReply,
    idle,
    sample,
)
from teds_provision.provisioning.conversation import Conversation, SessionLostError, is_busy
from teds_provision.provisioning.teds_read import list_blocks, read_block
from teds_provision.station.station import Station
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import Units
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile.model import ChannelProfile, Profile
from teds_provision.teds.sheet import Channel, Sheet
from teds_provision.teds.units import PRODUCT, name_of_units, units_of

_LEASE: Final = 5
_TRIED: Final = 8
"""Sensors that are asked for a valid value, one after the other: a probe may be unplugged."""
_ROOM: Final = 180  # octets of data sets in one reply, so that it fits the maxMessage of any node


class WrongBoardError(PolicyError):
    """The board is of another type than what it would be given; ``differences`` has a sentence for each."""

    code = "wrong-board"

    def __init__(self, message: str, differences: tuple[str, ...] = (), *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.differences = differences


Retype = Callable[[bytes, tuple[str, ...]], None]
"""Asks before a board becomes one of another type: its UUID and the differences; raises if the answer is no."""


def require_board_type(uuid: bytes, differences: tuple[str, ...]) -> None:
    """Refuse, as without a terminal there is no confirmation. Raises WrongBoardError."""
    more = f" (and {len(differences) - 1} more)" if len(differences) > 1 else ""
    raise WrongBoardError(
        f"Board {uuid.hex()} is of a different type: {differences[0].rstrip('.')}{more}. Nothing was written.",
        differences,
        hint="Use the right board or the right profile. To change the board's type: --retype",
    )


class _ChannelStatement(NamedTuple):
    """Known claims about one channel; None: no claim."""

    kind: int | None
    form: tuple[int, int] | None
    units: Units | None
    calibrated: bool

    @classmethod
    def from_teds(cls, channel: Channel, blocks: Mapping[BlockId, bytes]) -> _ChannelStatement:
        form = None if channel.sample is None else (channel.sample.model, channel.sample.octets)
        units = channel.units if channel.units_stated else None
        return cls(channel.kind, form, units, (channel.number, AccessCode.CALIBRATION) in blocks)

    @classmethod
    def wanted(cls, channel: ChannelProfile) -> _ChannelStatement:
        taken = channel.fields.get("Sample")
        form: tuple[int, int] | None = None
        if isinstance(taken, Mapping) and isinstance(taken.get("DatModel"), int):
            form = (taken["DatModel"], taken["ModLenth"])
        return cls(channel.type, form, channel.units, channel.calibration.required)


def differences(
    has: Mapping[BlockId, bytes], wanted: Image | Profile, calibrated: Collection[int] = ()
) -> tuple[str, ...]:
    """Return how the type of a board differs from what it would be given, a sentence for each; empty if it does not.

    ``has`` are TEDS of the board. A board without a TransducerChannel TEDS makes no claim; more channels than are
    wanted are no difference. A unit of counts, a ratio, a digital one, V or A is no claim if a calibration is wanted;
    ``calibrated`` are channels that get one, whatever the type.
    """
    if not _describes(has):
        return ()
    own = {channel.number: _ChannelStatement.from_teds(channel, has) for channel in Sheet.from_blocks(has).channels}
    if not own:
        return ()
    if isinstance(wanted, Image):
        meant = {
            channel.number: _ChannelStatement.from_teds(channel, wanted.blocks)
            for channel in Sheet.from_image(wanted).channels
        }
    else:
        meant = {channel.number: _ChannelStatement.wanted(channel) for channel in wanted.channels}
    meant |= {number: meant[number]._replace(calibrated=True) for number in calibrated if number in meant}
    return tuple(text for number in sorted(meant) for text in _between(number, own.get(number), meant[number]))


def misfit(image: Image, profile: Profile) -> str:
    """Return why a datasheet is none of this type, a sentence; "" if it is one.

    Stricter than :func:`differences`, because a datasheet of which the profile is not known is recognised by it: it has
    exactly these channels, and states exactly these units.
    """
    own = {channel.number: channel for channel in Sheet.from_image(image).channels if channel.described}
    wanted = {channel.number: channel for channel in profile.channels}
    if own.keys() != wanted.keys() or not own:
        return f"Its channels are {_listed(own)}, not {_listed(wanted)}."
    changes = differences(image.blocks, profile)
    if changes:
        return changes[0]
    for number, channel in sorted(own.items()):
        mine, meant = replace(channel.units, extension=0), replace(wanted[number].units, extension=0)
        if not channel.units_stated or mine != meant:
            return f"Channel {number} is in {name_of_units(mine)}, not in {name_of_units(meant)}."
    return ""


def _listed(numbers: Collection[int]) -> str:
    return ", ".join(map(str, sorted(numbers))) or "none"


def topic_warnings(station: Station, has: Image | None, wanted: Image) -> tuple[str, ...]:
    """Return a warning for each chosen topic name whose channel will measure another quantity, or be gone.

    ``has``: what the board has; without channels in it, what it was last known to have.
    """
    names = station.measurements.names_of(wanted.uuid)
    if not any(names):
        return ()
    before = has if has is not None and _describes(has.blocks) else station.datasheets.datasheet(wanted.uuid)
    if before is None:
        return ()
    old, new = ({channel.number: channel for channel in Sheet.from_image(image).channels} for image in (before, wanted))
    warnings = []
    for number, name in sorted(names.items()):
        if number not in old or not number:
            continue
        was, now = name_of_units(old[number].units), new.get(number)
        if now is None:
            change = "which the new datasheet does not have"
        elif replace(now.units, extension=0) != replace(old[number].units, extension=0):
            change = f"which was in {was} and is in {name_of_units(now.units)} now"
        else:
            continue
        warnings.append(
            f"The chosen topic name {name!r} stays with channel {number}, {change}. "
            f"To change it: names set {wanted.uuid.hex()[:8]} {number} NAME"
        )
    return tuple(warnings)


def _describes(has: Mapping[BlockId, bytes]) -> bool:
    """Return True if these TEDS describe any channel; a new board usually has none."""
    return any(code == AccessCode.CHANNEL for _, code in has)


def further(has: Mapping[BlockId, bytes], wanted: Image) -> tuple[str, ...]:
    """Return a warning for the channels that the board describes and the datasheet omits, if there are any."""
    if not _describes(has):
        return ()
    channels = {channel.number for channel in Sheet.from_blocks(has).channels} - {
        channel.number for channel in Sheet.from_image(wanted).channels
    }
    named = ", ".join(map(str, sorted(channels)))
    return (f"The board has more channels than the profile: {named}.",) if channels else ()


def _between(number: int, own: _ChannelStatement | None, wanted: _ChannelStatement) -> Iterator[str]:
    if own is None:
        yield f"Channel {number} is missing."
        return
    if None not in (own.kind, wanted.kind) and own.kind != wanted.kind:
        yield f"Channel {number} is {_kind(own.kind)}, not {_kind(wanted.kind)}."
    if own.units is not None and wanted.units is not None and not (wanted.calibrated and _says_nothing(own.units)):
        mine, meant = replace(own.units, extension=0), replace(wanted.units, extension=0)
        if mine != meant:
            yield f"Channel {number} is in {name_of_units(mine)}, not in {name_of_units(meant)}."
    if own.form is not None and wanted.form is not None and own.form != wanted.form:
        yield f"Channel {number} gives {_form(own.form)}, not {_form(wanted.form)}."


def _says_nothing(units: Units) -> bool:
    """Return True for counts, digital, a ratio, V, A: the raw unit of any quantity."""
    bare = replace(units, extension=0)
    return units.interpretation != PRODUCT or bare in (Units(), _VOLT, _AMPERE)


_VOLT: Final = units_of(meters=2, kilograms=1, seconds=-3, amperes=-1)
_AMPERE: Final = units_of(amperes=1)


def _kind(kind: int | None) -> str:
    return f"an {ChannelKind(kind).word}" if kind in (ChannelKind.ACTUATOR, ChannelKind.EVENT_SENSOR) else "a sensor"


def _form(form: tuple[int, int]) -> str:
    return f"values of {SampleForm(*form).name}"


def is_remembered(station: Station, uuid: bytes, wanted: str | None, *, factory: bool) -> bool:
    """Return True if this station knows the board as one of that profile, or as its own that was reset.

    Then it is no retype. ``wanted`` None: of the profile that it was given before.

    An image that was merely built does not count; one that was written, or came in a bundle, does.
    """
    history = station.datasheets.history(uuid)
    if factory and history:
        return True
    written = next((record.profile for record in history if record.profile is not None), None)
    record = station.nodes.get(uuid)
    known = record.profile if record is not None else None
    wanted = wanted or known
    brought = written is None and known == wanted and station.datasheets.draft(uuid) is None
    return wanted is not None and (written == wanted or brought)


def shown_by(node: Conversation, channels: Collection[int]) -> dict[BlockId, bytes]:
    """Return the TransducerChannel TEDS that a board shows for these channels; in a session, or plainly."""
    listed = list_blocks(node) if node.sealed or node.early is None else node.early.listed
    wanted = [block for block in listed if block[1] == AccessCode.CHANNEL and block[0] in channels]
    return {block: read_block(node, block) for block in wanted}


# -- checking the hardware -------------------------------------------------------------------------------------------


def operate(node: Conversation, channel: int, digest: bytes, *, lease: int, dead_man: int | None = None) -> None:
    """Claim a channel (0: every sensor); ``digest`` is that of the Security TEDS, ``lease`` in s, ``dead_man`` in ms.

    Raises NodeRefusedError with specific messages for 6 and 23.
    """
    named = f"channel {channel}" if channel else "any sensor"
    try:
        node.request(
            OperateCommand(channel, digest[:DIGEST_OCTETS], lease, dead_man).command(),
            f"to measure with {named}" if channel else "to measure",
        )
    except NodeRefusedError as refusal:
        reason_text = next(
            (reason_text for reason, reason_text in _OF_OPERATE.items() if reason == refusal.reason), None
        )
        if reason_text is None:
            raise
        words = f"{reason_text[0].format(named)} (reason {refusal.reason})."
        raise NodeRefusedError(words, reason=refusal.reason, hint=reason_text[1]) from None


_OF_OPERATE: Final = {
    Reason.DIGEST_MISMATCH: (
        "The board's hardware does not match its datasheet on {}: the kind, format or length of a value differs",
        "Its type differs from its datasheet, or the datasheet has just been rewritten. Run verify UUID, then"
        " provision it again.",
    ),
    Reason.FAULT: (
        "The node cannot measure with {} now: its hardware reports a fault, or it has too little power",
        "Check its self-test and battery: mode UUID.",
    ),
}


@dataclass(frozen=True)
class HardwareCheck:
    """The firmware's answer for each channel: True accepts its datasheet, None does not measure; and one reading."""

    channels: dict[int, bool | None]
    samples: tuple[dict[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def asked(self) -> bool:
        """True if the node measures."""
        return any(self.channels.values())


def check_hardware(node: Conversation, image: Image, shown: Mapping[int, str] | None = None) -> HardwareCheck:
    """Ask a node, in its session, for each channel's acceptance of ``image``, and its sensors for one reading.

    ``shown`` are the display units of channels, if the profile names them. Nothing stays claimed. Sensors that another
    session claims are left alone. A session that was lost meanwhile (a measuring station opened another one, its bus
    was cut) is opened again, once. Raises WrongBoardError with the channel that refuses it, NodeRefusedError,
    LinkError.
    """
    try:
        return _borne(node, image, shown)
    except SessionLostError as lost:
        if is_busy(lost.cause):
            raise lost.cause from lost
    node.reopen()
    try:
        return _borne(node, image, shown)
    except SessionLostError as lost:
        raise lost.cause from lost


def _borne(node: Conversation, image: Image, shown: Mapping[int, str] | None) -> HardwareCheck:
    # without the Security TEDS, which was checked already
    described = Sheet.from_image(Image(image.uuid, image.unsigned_blocks()))
    sheet, digest = described.shown_in(shown or {}), hashlib.sha256(image.security or b"").digest()
    try:
        states = OperationReply.decode(node.request(OPERATION, "to report its mode")).channels
    except (NodeRefusedError, BadDataError) as error:
        if isinstance(error, NodeRefusedError) and error.reason == Reason.UNKNOWN_COMMAND:
            return HardwareCheck(dict.fromkeys((channel.number for channel in sheet.channels), None))
        found = {channel.number: _bears(node, channel, digest).accepts for channel in sheet.channels}
        asked = any(found[channel.number] for channel in sheet.channels if not channel.actuator)
        return HardwareCheck(found, warnings=(_no_reading(error),) if asked else ())
    taken = {number for number, (state, _) in states.items() if state & ChannelState.CLAIMED_BY_OTHER}
    free = [channel for channel in sheet.channels if not channel.actuator and channel.number not in taken]
    answers: dict[int, _Answer] = {}
    samples: tuple[dict[str, Any], ...] = ()
    trouble: TedsProvisionError | None = None
    try:
        for channel in sheet.channels:
            answers[channel.number] = _bears(node, channel, digest, lease=_LEASE if channel in free else 0)
        trouble = next((answer.not_claimed for answer in answers.values() if answer.not_claimed is not None), None)
        if trouble is None:
            claimed = [channel for channel in free if answers[channel.number].accepts]
            samples = tuple(_read(node, sheet, claimed))
    except (NodeRefusedError, BadDataError) as error:  # the datasheet remains valid; a warning gives the reason
        trouble = error
    finally:
        if free:
            node.request(idle(0), "to let go")
    found = {number: answer.accepts for number, answer in answers.items()}
    if trouble is not None:  # busy or faulty
        return HardwareCheck(found, warnings=(_no_reading(trouble),))
    bad = [str(entry["channel"]) for entry in samples if not entry["valid"]]
    return HardwareCheck(found, samples, (invalid_readings(bad),) if bad else ())


def _no_reading(error: TedsProvisionError) -> str:
    return f"No reading was taken: {error.message}"


def invalid_readings(channels: Sequence[str]) -> str:
    """Return the warning about channels whose reading was invalid."""
    if len(channels) == 1:
        return f"The reading of channel {channels[0]} is invalid."
    return f"The readings of channels {', '.join(channels)} are invalid."


class _Answer(NamedTuple):
    """Answer of a channel: it accepts its datasheet, None: it does not measure; and why it was not claimed."""

    accepts: bool | None
    not_claimed: NodeRefusedError | None = None


def _bears(node: Conversation, channel: Channel, digest: bytes, *, lease: int = 0) -> _Answer:
    """Ask a channel whether its hardware accepts its datasheet; with a ``lease`` in s by claiming it."""
    dead_man = FIRST_DEAD_MAN if channel.actuator else None
    try:
        operate(node, channel.number, digest, lease=lease, dead_man=dead_man)
    except NodeRefusedError as refusal:
        # BAD_FORM (4): a sensor instead of an actuator, or the reverse
        if refusal.reason in (Reason.DIGEST_MISMATCH, Reason.BAD_FORM):
            raise WrongBoardError(
                f"Channel {channel.number} ({channel.name or 'no name'}) of the board does not match this"
                " datasheet: its hardware is of a different kind, or delivers values in a different format.",
                hint="The board is of a different type. Provision it with the profile of its own type.",
            ) from refusal
        if refusal.reason == Reason.OUT_OF_RANGE and not lease:
            return _Answer(True)
        if refusal.reason in (Reason.BUSY, Reason.FAULT) and lease:  # these are checked last, so the datasheet matches
            return _Answer(True, refusal)
        return _Answer(None)
    return _Answer(True if lease else None)  # a lease of 0 was accepted: the firmware does not follow the profile


def _read(node: Conversation, sheet: Sheet, sensors: list[Channel]) -> Iterator[dict[str, Any]]:
    """Sample claimed sensors."""
    readers = {channel.number: ChannelInterpreter(sheet, channel.number) for channel in sensors}
    for part in _parts(readers):
        width = sum(readers[number].octets for number in part)
        reply = SampleReply.decode(node.request(sample(part), "to sample"), width)
        at, raws = 0, {}
        for number in part:
            one = readers[number]
            raws[number] = one.reader.raw(reply.data[at : at + one.octets])
            at += one.octets
        for number in part:
            yield _to_json(readers[number], raws, valid=reply.valid)


def require_working_hardware(node: Conversation, image: Image) -> None:
    """Have new firmware show, in its session, that it serves each channel of ``image``, and one sensor one valid value.

    Sensors that another session claims are left alone; nothing stays claimed. Raises WrongBoardError with the channel
    that it does not serve, BadDataError if no free sensor gives a valid value; NodeRefusedError, LinkError,
    SessionLostError.
    """
    sheet = Sheet.from_image(Image(image.uuid, image.unsigned_blocks()))
    digest = hashlib.sha256(image.security or b"").digest()
    served = [channel for channel in sheet.channels if _bears(node, channel, digest).accepts]
    if not served:
        return
    channels = OperationReply.decode(node.request(OPERATION, "to report its mode")).channels
    taken = {number for number, (state, _) in channels.items() if state & ChannelState.CLAIMED_BY_OTHER}
    free = [channel for channel in served if not channel.actuator and channel.number not in taken]
    if free and not any(_gives_value(node, channel, digest) for channel in free[:_TRIED]):
        raise BadDataError("No sensor of the board gives a valid value.")


def _gives_value(node: Conversation, channel: Channel, digest: bytes) -> bool:
    """Return True if a sensor gives a valid value, calibrated or not; a faulty one gives none."""
    if channel.sample is None:
        return False
    try:
        operate(node, channel.number, digest, lease=_LEASE)
        return SampleReply.decode(node.request(sample([channel.number]), "to sample"), channel.sample.octets).valid
    except NodeRefusedError:
        return False
    finally:
        node.request(idle(0), "to let go")


def _parts(readers: dict[int, ChannelInterpreter]) -> list[list[int]]:
    parts: list[list[int]] = [[]]
    for number, interpreter in readers.items():
        if parts[-1] and (
            sum(readers[other].octets for other in parts[-1]) + interpreter.octets > _ROOM
            or len(parts[-1]) == MOST_SAMPLE_CHANNELS
        ):
            parts.append([])
        parts[-1].append(number)
    return [part for part in parts if part]


def _to_json(interpreter: ChannelInterpreter, raws: dict[int, Any], *, valid: bool) -> dict[str, Any]:
    channel, value = interpreter.channel, math.nan
    if not interpreter.problem and all(other in raws for other in interpreter.others):
        found = interpreter.values(raws[channel.number], {other: raws[other] for other in interpreter.others})
        value, valid = interpreter.unit.to_si(float(found.value[0])), valid and bool(found.valid[0])
    valid = valid and math.isfinite(value)
    return {
        "channel": channel.number,
        "name": channel.name,
        "value": value if valid else None,
        "unit": channel.si_unit,
        "valid": valid,
        "shown": {"value": channel.shown.from_si(value) if valid else None, "unit": channel.shown.text},
    }
