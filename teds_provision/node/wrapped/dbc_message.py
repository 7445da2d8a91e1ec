"""A message of a DBC file as a wrapped sensor: its description, and the raw numbers in a frame (cantools).

cantools checks no range when it decodes and matches no J1939 identifier from another source address; both are done here
and in :mod:`latest_values`.
"""

from __future__ import annotations

import hashlib
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.files import read_limited
from teds_provision.lazy import how_to_install
from teds_provision.node.wrapped.description import DEFAULT_PERIOD, WrappedChannel, WrappedSensor, decimal, written_unit
from teds_provision.teds.origin import Origin

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

MOST_OCTETS: Final = 8 << 20
LONGEST_TEXT: Final = 1 << 20
"""Characters between two quotation marks. cantools takes 220 octets of memory for each one of a text without end."""
_SHOWN: Final = 12
_NO_MESSAGE: Final = "VECTOR__INDEPENDENT_SIG_MSG"
"""Holds signals that no message carries."""
_J1939_SIZES: Final = (8, 16, 24, 32)
_ERROR, _NOT_AVAILABLE = 0xFE, 0xFF
"""Highest octet of a J1939 parameter that is in error or not available (SAE J1939-71, table 1)."""
_PDU1: Final = 0xF0
"""PDU formats below this one carry a destination in their second octet (SAE J1939-21, 5.2)."""


OUR_GROUPS: Final = frozenset({0xDA00, 0xDB00, 0xEF00, *range(0xFF00, 0x10000)})
"""Parameter groups of the profile's own frames: commands, Drive, data, Announce and trigger (profile.md, "CAN")."""


class FrameKey(NamedTuple):
    """Key by which a frame is matched: its identifier, or for J1939 its parameter group number."""

    number: int
    extended: bool
    pgn: bool = False

    @property
    def filter(self) -> tuple[int, int, bool]:
        """Identifier, mask and ``extended`` for SocketCAN."""
        if not self.pgn:
            return self.number, 0x1FFFFFFF if self.extended else 0x7FF, self.extended
        has_destination = self.number >> 8 & 0xFF < _PDU1
        return self.number << 8, 0x03FF0000 if has_destination else 0x03FFFF00, True


def pgn_of(identifier: int) -> int:
    """Return the parameter group number of a 29-bit J1939 identifier, without a destination."""
    pgn = identifier >> 8 & 0x3FFFF
    return pgn if pgn >> 8 & 0xFF >= _PDU1 else pgn & 0x3FF00


@dataclass(frozen=True)
class DbcMessage:
    """A message that a node wraps; ``sensor`` describes it, :meth:`numbers` reads a frame.

    ``clashing`` names the messages of the file whose identifiers are those of the profile.
    """

    sensor: WrappedSensor
    message: Message
    clashing: tuple[str, ...] = ()

    @property
    def key(self) -> FrameKey:
        """Key by which its frames are matched."""
        identifier = self.message.frame_id
        if self.message.protocol == "j1939":
            return FrameKey(pgn_of(identifier), extended=True, pgn=True)
        return FrameKey(identifier, self.message.is_extended_frame)

    @cached_property
    def _plain(self) -> Message:
        """The message with the signals alone that every frame of it carries."""
        signals = [copy(signal) for signal in self.message.signals if not signal.multiplexer_ids]
        for signal in signals:
            signal.is_multiplexer = False
        return type(self.message)(
            self.message.frame_id,
            self.message.name,
            self.message.length,
            signals,
            is_extended_frame=self.message.is_extended_frame,
            strict=False,
        )

    def numbers(self, data: bytes) -> dict[str, float]:
        """Return the raw number of each signal in a frame by name; of multiplexed ones those that it carries.

        A frame whose multiplexer value the file does not name has the others. Raises BadDataError for one that is too
        short.
        """
        from cantools.database import DecodeError

        try:
            decoded = self.message.decode(data, decode_choices=False, scaling=False)
        except DecodeError as error:
            try:
                decoded = self._plain.decode(data, decode_choices=False, scaling=False)
            except DecodeError:
                raise BadDataError(f"A frame of {self.message.name} cannot be decoded: {error}.") from error
        if not isinstance(decoded, dict):
            raise BadDataError(f"A frame of {self.message.name} cannot be decoded.")
        return {name: raw for name, raw in decoded.items() if isinstance(raw, int | float)}


def j1939_state(bits: int, raw: float) -> str:
    """Return why a J1939 parameter has no value, "" if it has one."""
    if bits not in _J1939_SIZES:
        return ""
    highest = int(raw) >> bits - 8
    return {_ERROR: "the device reports an error", _NOT_AVAILABLE: "the device reports it as not available"}.get(
        highest, ""
    )


def read(path: Path, message: str | None = None) -> DbcMessage:
    """Read a message of a DBC file; ``message`` may be left out if the file has one with signals.

    Raises NotFoundError, BadDataError, UsageError (which message?) and NotFoundError if cantools is not installed.
    """
    octets = read_limited(path, MOST_OCTETS, "DBC file")
    messages = _messages(path, octets)
    found = _chosen(path, messages, message)
    _require_sound(path, found)
    period = found.cycle_time / 1000 if found.cycle_time else 0.0
    origin = Origin("dbc", found.name, hashlib.sha256(octets).hexdigest())
    channels = tuple(_channel(found, signal, period) for signal in _in_order(found))
    title = found.comment.splitlines()[0][:60] if found.comment else found.name
    clashing = tuple(
        other.name for other in messages if other.is_extended_frame and pgn_of(other.frame_id) in OUR_GROUPS
    )
    return DbcMessage(WrappedSensor(origin, title, channels, path.name), found, clashing)


def _messages(path: Path, octets: bytes) -> list[Message]:
    try:
        from cantools import database
    except ImportError as error:
        raise NotFoundError("A DBC file needs the package cantools.", hint=how_to_install("bench")) from error
    try:
        text = octets.decode()
    except UnicodeDecodeError:
        text = octets.decode("cp1252", errors="replace")  # the encoding of the tools that write DBC files
    if max(map(len, text.replace('\\"', "''").split('"'))) > LONGEST_TEXT:
        raise BadDataError(
            f"{path} is not a DBC file that can be read: more than {LONGEST_TEXT} characters have no quotation mark.",
            hint="Check the file: the end of a text may be missing.",
        )
    try:
        # Not strict: other messages of the file may have overlapping signals; only the wrapped one is checked.
        loaded = database.load_string(text, database_format="dbc", strict=False)
    except Exception as error:  # parsers under cantools raise their own errors, KeyError and ValueError
        reason = str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
        raise BadDataError(f"{path} is not a DBC file that can be read: {reason}", hint="Check the file.") from error
    messages = getattr(loaded, "messages", ())
    return [message for message in messages if message.signals and message.name != _NO_MESSAGE]


def _require_sound(path: Path, message: Message) -> None:
    """Raise BadDataError if signals of the message overlap, or lie outside it."""
    from cantools.database.errors import Error

    try:
        message.refresh(strict=True)
    except Error as error:
        why = f"{path}: the message {message.name} cannot be decoded: {error}"
        raise BadDataError(why, hint="Check the file.") from error


def _chosen(path: Path, messages: list[Message], name: str | None) -> Message:
    if not messages:
        raise BadDataError(f"{path} has no message with signals.")
    if name is None:
        if len(messages) == 1:
            return messages[0]
        shown = ", ".join(message.name for message in messages[:_SHOWN])
        more = f" and {len(messages) - _SHOWN} more" if len(messages) > _SHOWN else ""
        raise UsageError(f"{path} has {len(messages)} messages: {shown}{more}.", hint="Choose one: --message NAME")
    for message in messages:
        if message.name == name:
            return message
    known = ", ".join(message.name for message in messages[:_SHOWN])
    raise NotFoundError(f"{path} has no message {name!r}.", hint=f"It has: {known}.")


def _in_order(message: Message) -> list[Signal]:
    return sorted(message.signals, key=lambda signal: (signal.start, signal.name))


def _channel(message: Message, signal: Signal, period: float) -> WrappedChannel:
    unit, note = written_unit(signal.unit or "")
    notes = [note] if note else []
    if not period:
        notes.append(
            f"the file states no cycle time of {message.name}, so {DEFAULT_PERIOD * 1000:g} ms is assumed"
            " (GenMsgCycleTime)"
        )
    low, high = _limits(signal)
    scale, offset = float(signal.scale), float(signal.offset)
    if not _is_linear(signal):
        notes.append("its scaling is not linear, so it is measured as a raw number")
        unit, scale, offset, low, high = "count", 1.0, 0.0, None, None
    return WrappedChannel(
        signal.name,
        unit,
        scale,
        offset,
        signal.length,
        signal.is_signed,
        signal.is_float,
        low,
        high,
        decimal((period or DEFAULT_PERIOD) * _turns(message, signal)),
        {int(raw): str(text) for raw, text in (signal.choices or {}).items()},
        " ".join((signal.comment or "").split()),
        "; ".join(notes),
        shares_frame=not message.is_multiplexed(),
    )


def _is_linear(signal: Signal) -> bool:
    """Return True if the conversion is value = raw × scale + offset; other formats also have piecewise ones."""
    conversion = signal.conversion
    return hasattr(conversion, "scale") and hasattr(conversion, "offset")


def _limits(signal: Signal) -> tuple[float | None, float | None]:
    """Return the stated range; None for [0|0], which states none."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not float(low) < float(high):
        return None, None
    return float(low), float(high)


def _turns(message: Message, signal: Signal) -> int:
    """Return how many frames it takes until a multiplexed signal comes again: each selector value has its turn."""
    if not signal.multiplexer_ids:
        return 1
    selector = signal.multiplexer_signal
    values = {
        value
        for other in message.signals
        if other.multiplexer_signal == selector
        for value in other.multiplexer_ids or ()
    }
    return max(1, len(values))
