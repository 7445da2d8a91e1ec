"""The data that pass from the measurement to the sinks: facts of channels, blocks of samples, rows of a group, reports.

One vocabulary for every sink, so that a sink never asks a node, the store or a datasheet. All of it is frozen, and a
block's arrays are never written to after they were handed on: several sinks read them in their threads.

Values are in the SI unit of the datasheet (``ChannelFacts.unit``); times are unix seconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from teds_provision.arrays import NDArray
from teds_provision.teds import Units
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.channel import spans_a_turn

Kind = Literal["sensor", "event", "actuator"]
MOST_REASONS = 3  # reasons in one line
State = Literal["waiting", "running", "lost", "refused", "ended"]


@dataclass(frozen=True)
class ChannelFacts:
    """Facts of one TransducerChannel from signed datasheet and plan; constant while it is measured.

    ``unit`` is the SI unit of ``Block.value`` as text (``rad``, ``K``, ``m/s²``; empty for counts), ``units`` its
    exponents, ``shown_unit`` the display unit (``°``, ``°C``). ``uncertainty`` (OError, worst case), ``low`` and
    ``high`` are in ``unit``; None if the datasheet has none. ``calibrated`` and ``due`` are ISO dates.
    """

    uuid: str  # 20 hex digits, lower case
    node: str  # name of the node in the store; empty if it has none
    number: int  # of the TransducerChannel, 1 to 255
    name: str  # from the datasheet; empty if it has none
    kind: Kind = "sensor"
    unit: str = ""
    units: Units | None = None
    shown_unit: str = ""
    low: float | None = None
    high: float | None = None
    uncertainty: float | None = None
    calibrated: str | None = None
    due: str | None = None
    overdue: bool = False
    fingerprint: str = ""  # SHA-256 of the signed datasheet, 64 hex digits; empty if it is unsigned
    sample_form: str = ""  # of the raw value, as its SampleForm is called: "unsigned integer, 2 octets"
    period: float | None = None  # seconds between samples as measured; None for events
    unsigned: bool = False  # the datasheet is unsigned, so there are only raw values
    unverified: bool = False  # the datasheet is unsigned, but an operator confirmed that values are calibrated by it
    quantity: str = ""  # from the profile or the name, e.g. "relative humidity"; empty if unknown
    deviation: float | None = None  # standard deviation in `unit`, if the profile has one
    own_period: float | None = None  # seconds between samples as the datasheet has it (SPeriod)
    frame: str = ""  # coordinate frame of its values; {node} in it is replaced by the node's part of its topics
    calibration: Calibration | None = None
    si_unit: str = ""  # SI unit, in a file whose values are in `unit`, the display unit; empty if `unit` is SI
    si_factor: float | None = None  # SI = number × factor + offset
    si_offset: float | None = None
    wrapped: str = ""  # sensor that the node wraps: its proof ends at the wrapper; empty for every other node
    vector: tuple[int, ...] = ()  # channels of its vector group, axis by axis; empty if it is in none

    # chosen names of its topics by channel (0: the node's part); None: not newer
    chosen: tuple[tuple[int, str], ...] | None = None
    siblings: tuple[tuple[int, str], ...] = ()  # number and name of every channel of the datasheet, for topics

    @property
    def key(self) -> tuple[str, int]:
        """Node and channel, which identify a channel in a whole station."""
        return self.uuid, self.number

    @property
    def full_turn(self) -> bool:
        """True if its values wrap: an angle sensor over one turn."""
        if self.kind == "actuator" or self.units is None or self.low is None or self.high is None:
            return False
        return spans_a_turn(self.units, self.low, self.high)

    @property
    def label(self) -> str:
        """Name for people: the channel's, else its number."""
        return self.name or f"channel {self.number}"


ECHO: Final = 255
"""Number of the "stream" for the echo of applied set points; nodes use 0 to 3."""


@dataclass(frozen=True)
class Block:
    """Samples of one stream, checked and calibrated: n instants of c channels.

    ``raw`` is n × c of a dtype that holds every raw value exactly (integer, float64, else object). ``value`` is n × c
    float64, NaN exactly if ``valid`` is False. With ``test_pattern`` there are no measurements in it: every value is
    NaN, and each sink marks what it writes.
    """

    uuid: str
    stream: int
    channels: tuple[int, ...]
    index: int  # sample number of the first row in its run
    time: NDArray[Any]  # (n) float64, unix seconds; goes back within a stream only if the host's clock is set
    tick: NDArray[Any]  # (n) uint64, nanoseconds of the node's clock
    raw: NDArray[Any]  # (n, c)
    value: NDArray[Any]  # (n, c) float64
    valid: NDArray[Any]  # (n, c) bool
    age: float = 0.0  # seconds from the last instant until the block was passed on
    # bound of the error of `time` in seconds; None: unknown, or the clock is inconsistent
    clock_error: float | None = None
    test_pattern: bool = False
    run: int = 0  # number of the run of the stream in its session
    clock: int | None = None  # which setting of the host's clock `time` follows; None: the present one

    @property
    def keys(self) -> tuple[tuple[str, int], ...]:
        """(uuid, channel number) of each column."""
        return tuple((self.uuid, number) for number in self.channels)


@dataclass(frozen=True)
class GroupRows:
    """Rows of a group, or of one node, on one grid of times: the "synchronized data" of all its channels.

    ``group`` is the name of the group, or the node's UUID if :attr:`StationFacts.each_node` is true.

    ``value`` (n × c) holds each channel's last value that is not newer than the row, ``age`` how much older it is; both
    NaN after two periods without a value.
    """

    group: str
    channels: tuple[tuple[str, int], ...]  # (uuid, channel number) of each column
    time: NDArray[Any]  # (n) float64, unix seconds, one period apart
    value: NDArray[Any]  # (n, c) float64
    age: NDArray[Any]  # (n, c) float64, seconds
    test_pattern: bool = False

    @property
    def keys(self) -> tuple[tuple[str, int], ...]:
        """(uuid, channel number) of each column."""
        return self.channels


@dataclass(frozen=True)
class InvalidValues:
    """A count of invalid values of a channel, with the reason as half a sentence."""

    channel: int
    why: str
    count: int


def nearest_float(raw: object) -> float:
    """Return one raw value as the nearest float; NaN for octets, and for an integer that no float can hold.

    A sample may have 255 octets; from the 129th on, an integer can be beyond every float.
    """
    try:
        return float(raw) if isinstance(raw, int | float) else math.nan
    except OverflowError:
        return math.nan


def why_invalid(found: Sequence[InvalidValues]) -> str:
    """Return ``66 of channel 1 above its high limit, 360 °``, the largest counts first; empty if all are valid."""
    most = sorted(found, key=lambda invalid: -invalid.count)
    lines = [f"{invalid.count} of channel {invalid.channel}: {invalid.why}" for invalid in most[:MOST_REASONS]]
    more = sum(invalid.count for invalid in most[MOST_REASONS:])
    return "; ".join([*lines, *([f"{more} more"] if more else [])])


@dataclass(frozen=True)
class NodeReport:
    """State and counts of one node; sent once a second, and when its state changes."""

    uuid: str
    state: State
    why: str = ""
    samples: int = 0
    lost: int = 0
    late: int = 0
    bad: int = 0
    invalid: int = 0
    clock_error: float | None = None
    time: float = 0.0  # unix seconds
    invalid_why: tuple[InvalidValues, ...] = ()


@dataclass(frozen=True)
class StationFacts:
    """Facts of the station for a file's header, a topic's prefix and a metadata message.

    ``names`` maps (uuid, channel) to the topic that the user chose, channel 0 to the node's part of it; ``scalar_rate``
    limits topics of one value (Hz), 0 leaves them out. ``nodes`` maps a uuid to the node's name, of every node that
    this station knows: topics are unique among them all. ``each_node``: nodes come and go, and each has an array topic
    in place of the group's. ``instance`` distinguishes the measurements of one station, which may run side by side; ""
    if there is only one.
    """

    name: str
    group: str = ""
    instance: str = ""
    started: float = 0.0  # unix seconds
    clock: str = "host's wall clock, node ticks mapped to it"
    names: Mapping[tuple[str, int], str] = field(default_factory=dict)
    scalar_rate: float = 10.0
    test_pattern: bool = False
    nodes: Mapping[str, str] = field(default_factory=dict)
    each_node: bool = False


@dataclass(frozen=True)
class ClockSet:
    """The system's clock was put forward by so many seconds (back: negative), seen at ``time`` on the new clock.

    Values dated before it was passed on follow the old clock, later ones the new clock.
    """

    time: float
    by: float

    @property
    def words(self) -> str:
        """For people and the notes of a recording."""
        way = "forward" if self.by > 0 else "back"
        return f"The system clock was set {way} by {abs(self.by):.3f} s; earlier times follow the old clock."


@dataclass(frozen=True)
class Note:
    """Words of a recorder about its recording (a full disk, a clock that was set), at unix time ``at``."""

    at: float
    text: str


@dataclass(frozen=True)
class SetPointCommand:
    """A set point for an actuator that came by a sink (a ROS topic), in the SI unit of the datasheet."""

    uuid: str
    channel: int
    value: float
    received: float  # time.monotonic() at arrival


@dataclass
class SinkStats:
    """Counters of a sink. ``error`` is for people: the sink has ended and takes nothing more.

    Not frozen: each sink counts in its own, and a new one for each item took longer than to write the item.
    """

    written: int = 0  # samples (values) written or sent
    dropped: int = 0  # samples lost to a slow consumer; for a recorder, to a full disk
    octets: int = 0
    messages: int = 0
    lag: float = 0.0  # seconds that the last item waited in the queue
    state: Literal["starting", "running", "waiting", "ended", "failed"] = "starting"
    detail: str = ""  # e.g. "waits for a ROS master at http://localhost:11311"
    error: str = ""
    hint: str = ""

    def fail(self, error: str, hint: str) -> None:
        """Record a failure; the first one stays."""
        if self.state != "failed":
            self.state, self.error, self.hint = "failed", error, hint
