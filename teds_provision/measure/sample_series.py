"""Many samples of one channel of a running sensor, taken one after the other: what zero and capture begin with."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

from teds_provision.arrays import NDArray, np
from teds_provision.errors import BadDataError, PolicyError, UsageError
from teds_provision.measure.held_actuator import unit_for
from teds_provision.measure.verified_session import VerifiedSession, claim
from teds_provision.protocol.operation.commands import SampleReply, idle, sample
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.zero import SampleStatistics, reading_of, turn_of
from teds_provision.teds.sheet import Channel

SAMPLES: Final = 32
SECONDS: Final = 0.5
"""They are spread over this time, so that mains hum averages out and a slow movement shows."""
_LEASE: Final = 10
_TYPED: Final = {"°": "degree", "°C": "degC", "°F": "degF", "µm": "um"}
_UNSTATED: Final = 0.01
"""Of the range: how restless a channel may be that states no uncertainty."""


@dataclass(frozen=True)
class SampleSeries:
    """Raw values of a channel, sample for sample, and of the channels that its calibration takes as well."""

    interpreter: ChannelInterpreter
    raw: NDArray[np.generic]
    others: dict[int, NDArray[np.generic]]

    def calibrated(self) -> NDArray[np.float64]:
        """Return values in the calibrated unit, before limits; raises PolicyError if a raw value is impossible."""
        values, possible, _ = self.interpreter.calibrated(self.raw, self.others)
        if not (possible & np.isfinite(values)).all():
            raise PolicyError(
                f"Channel {self.interpreter.channel.number} delivers raw values that its type does not allow."
            )
        return values

    @property
    def extrapolated(self) -> bool:
        """True if it is beyond the calibrated range."""
        return bool(self.interpreter.calibrated(self.raw, self.others)[2].any())


def take_samples_of(
    trusted: VerifiedSession, number: int, *, count: int = SAMPLES, seconds: float = SECONDS
) -> SampleSeries:
    """Take ``count`` samples of a sensor over at least ``seconds``, and release it.

    Raises BadDataError (no such channel, an actuator, an event sensor), NodeRefusedError, LinkError; PolicyError if the
    node marks a sample as not valid.
    """
    channel = trusted.channel(number)
    if channel.actuator:
        raise BadDataError(f"Channel {channel.label} of node {trusted.uuid} is an actuator, not a sensor.")
    one = ChannelInterpreter(trusted.sheet, number)
    readers = {number: one} | {other: ChannelInterpreter(trusted.sheet, other) for other in one.others}
    width = sum(reader.octets for reader in readers.values())
    octets = bytearray()
    try:
        for read_channel in readers:
            claim(trusted, read_channel, lease=_LEASE)
        began = time.monotonic()
        for taken in range(count):
            time.sleep(max(0.0, began + taken * seconds / (count - 1) - time.monotonic()))
            reply = SampleReply.decode(trusted.node.request(sample(tuple(readers)), "to sample"), width)
            if not reply.valid:
                raise PolicyError(
                    f"The node marks the reading of channel {number} as invalid: it is warming up, or has a fault.",
                    hint="See: teds-provision mode UUID",
                )
            octets += reply.data
    finally:
        trusted.node.request(idle(0), "to let go")
    rows = np.frombuffer(bytes(octets), dtype=np.uint8).reshape(count, width)
    raws, at = {}, 0
    for read_channel, reader in readers.items():
        raws[read_channel] = reader.reader.raw(np.ascontiguousarray(rows[:, at : at + reader.octets]))
        at += reader.octets
    return SampleSeries(one, raws.pop(number), raws)


def require_still(settled: SampleSeries) -> SampleStatistics:
    """Return the reading in the calibrated unit (of angles the circular mean); raises PolicyError if it is restless.

    That is a spread, or drift, of more than the stated uncertainty, or without one a hundredth of the range.
    """
    channel = settled.interpreter.channel
    own = channel.calibration
    assert own is not None, "there is something to read by"
    reading = reading_of(settled.calibrated(), turn_of(own, full_turn=channel.full_turn))
    span = abs(channel.high - channel.low)
    least = channel.stated_uncertainty if channel.stated_uncertainty > 0 else _UNSTATED * span
    if not least > 0 or not reading.is_unstable(own.unit.difference_from_si(least)):
        return reading
    moves = abs(reading.drift) > reading.spread
    amount = own.unit.difference_to_si(abs(reading.drift) if moves else reading.spread)
    raise PolicyError(
        f"Channel {channel.number} is not steady: its reading {'drifts' if moves else 'spreads'} by "
        f"{channel.show(amount, difference=True)}; {channel.show(least, difference=True)} is allowed.",
        hint="Keep it still and try again.",
    )


def require_still_raw(settled: SampleSeries, reading: SampleStatistics) -> None:
    """Raise PolicyError if raw values spread, or drift, by more than a hundredth of those that the channel can give."""
    ends = settled.interpreter.reader.form.raw_range
    if ends is None or not reading.is_unstable(_UNSTATED * (ends[1] - ends[0])):
        return
    moves = abs(reading.drift) > reading.spread
    raise PolicyError(
        f"Channel {settled.interpreter.channel.number} is not steady: its raw value "
        f"{'drifts' if moves else 'spreads'} by {abs(reading.drift) if moves else reading.spread:.6g}; "
        f"{_UNSTATED * (ends[1] - ends[0]):.6g} is allowed.",
        hint="Keep it still and try again.",
    )


def reference_for(channel: Channel, value: float | None, unit: str | None, *, shown_unit_asked: bool) -> float:
    """Return an operator's reference value of a channel in SI units; None is 0 in the display unit.

    ``shown_unit_asked``: the caller has to name the unit if the display unit is not SI. Raises UsageError for that, and
    if 0 is not the same in both; BadDataError for a unit of another kind.
    """
    other = (channel.shown.scale, channel.shown.offset) != (1.0, 0.0)
    unclear = bool(channel.shown.offset) if value is None else shown_unit_asked and other
    if unit is None and unclear:
        raise UsageError(
            f"Channel {channel.number} is shown in {channel.shown.text}; give the unit of the value.",
            hint=f"Add --unit {_TYPED.get(channel.shown.text, channel.shown.text)}, or --unit {channel.si_unit}.",
        )
    return unit_for(channel, unit).to_si(value or 0.0)
