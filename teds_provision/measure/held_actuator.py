"""Operating one actuator: a set point, kept alive by the loop that computes it, and the safe state at the end.

The dead-man (operation.md section 2) is fed only by :meth:`HeldActuator.apply`, which sends a value. No thread keeps it
alive: whatever dies, the node brings its actuator to its safe state within the dead-man. An unanswered value is sent
again after a quarter and a half of the dead-man, and abandoned at its end.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np

from teds_provision.errors import BadDataError, LinkError, PolicyError, TedsProvisionError
from teds_provision.measure.sinks.json_events import plain
from teds_provision.measure.verified_session import DEAD_MAN, LEASE, VerifiedSession, claim, operation
from teds_provision.protocol.operation.commands import ChannelState, idle, write_data_set
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.sheet import Channel
from teds_provision.teds.units import WrittenUnit, parse_unit

LONGEST_PAUSE = 0.5  # seconds; a node that may no longer be moved is released within two


@dataclass(frozen=True)
class AppliedSetPoint:
    """A set point that was sent: ``value`` in ``unit``, after rounding to the raw value."""

    channel: int
    value: float
    unit: str
    raw: Any

    def as_json(self) -> dict[str, Any]:
        """Return the object that `set --json` prints."""
        return {"channel": self.channel, "value": self.value, "unit": self.unit, "raw": self.raw}


def unit_for(channel: Channel, text: str | None) -> WrittenUnit:
    """Return the unit of a set point: the one that was named, else the datasheet's SI unit.

    Raises BadDataError, UsageError.
    """
    if text is None:
        return WrittenUnit(channel.si_unit, channel.units, 1.0, 0.0)
    unit = parse_unit(text)
    if unit.units != channel.units:
        words = " or ".join(dict.fromkeys((channel.shown.text, channel.unit.text, channel.si_unit)))
        raise BadDataError(
            f"{text} is not a unit for channel {channel.label}, whose values are in {channel.si_unit}.",
            hint=f"Use {words}.",
        )
    return unit


def _actuators_of(trusted: VerifiedSession) -> str:
    found = ", ".join(channel.label for channel in trusted.sheet.channels if channel.actuator)
    return f"Its actuators: {found}." if found else "It has no actuator."


def _set_point_of(trusted: VerifiedSession, chosen: int | str) -> Channel | None:
    """Return the actuator that sets a quantity by the quantity's name: "opening set point" for ``opening``.

    None for a number, and for a name that is itself an actuator's.
    """
    if isinstance(chosen, int):
        return None
    actuators = {channel.name.casefold(): channel for channel in trusted.sheet.channels if channel.actuator}
    name = chosen.casefold()
    return None if name in actuators else actuators.get(f"{name} set point")


class HeldActuator:
    """One claimed actuator: ``with HeldActuator(…) as hand: hand.apply(value)`` again and again; let go at the end."""

    def __init__(
        self, trusted: VerifiedSession, chosen: int | str, *, unit: str | None = None, dead_man: int = DEAD_MAN
    ) -> None:
        channel = _set_point_of(trusted, chosen) or trusted.channel(chosen)
        if not channel.actuator:
            raise BadDataError(
                f"Channel {channel.label} of node {trusted.uuid} is a sensor, not an actuator.",
                hint=_actuators_of(trusted),
            )
        self.unit = unit_for(channel, unit)
        self.channel, self._verified, self._dead_man = channel, trusted, dead_man
        self._interpreter = ChannelInterpreter(trusted.sheet, channel.number)
        if self._interpreter.problem:
            raise BadDataError(self._interpreter.problem)
        self.safe: bool | None = None

    def octets_of(self, value: float) -> bytes:
        """Return the data set for a value in :attr:`unit`.

        Raises PolicyError (6) beyond the limits of the datasheet.
        """
        one = self._interpreter
        own = one.unit.from_si(self.unit.to_si(value))
        beyond = one.beyond(own, self.unit)
        if beyond:
            raise PolicyError(beyond, hint="Limits come from the signed datasheet and cannot be exceeded.")
        return one.encode(own)

    def __enter__(self) -> HeldActuator:
        claim(self._verified, self.channel.number, lease=LEASE, dead_man=self._dead_man)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._verified.node.request(idle(self.channel.number), "to let go of the actuator")
            state, _ = operation(self._verified.node).channels[self.channel.number]
            self.safe = bool(state & ChannelState.SAFE)
        except (TedsProvisionError, SessionLostError, KeyError):
            self.safe = None  # unknown here; the node's dead-man makes the actuator safe

    def require_confirmation(self) -> bool:
        """Return True if the node reported its safe state at release; raise LinkError if it did not answer."""
        if self.safe is None:
            raise LinkError(
                "The node did not confirm that its actuator is in its safe state.",
                hint="Its dead-man timer brings it there. To check: teds-provision mode UUID",
            )
        return self.safe

    @property
    def pause(self) -> float:
        """Seconds after which a value that stays is sent again, and the node's standing is looked at."""
        return min(self._dead_man / 4000, LONGEST_PAUSE)

    def apply(self, value: float) -> AppliedSetPoint:
        """Send one value; raises PolicyError (limits, the node), LinkError if it was not taken in time."""
        octets = self.octets_of(value)
        began = time.monotonic()
        try:
            self._verified.node.request(
                write_data_set(self.channel.number, octets), "to set the actuator", within=self._dead_man / 1000
            )
        except SessionLostError as lost:
            raise LinkError(
                f"The session was lost while the actuator was in use: {lost.cause.message}",
                hint="The node returns it to its safe state by itself.",
            ) from lost
        if time.monotonic() - began > self._dead_man / 1000:
            raise LinkError(
                "Setting the value took longer than the dead-man time.", hint="The actuator is in its safe state."
            )
        raw = self._interpreter.reader.raw(octets)
        shown = float(np.asarray(self._interpreter.values(raw).value)[0])
        taken = self.unit.from_si(self._interpreter.unit.to_si(shown)) if np.isfinite(shown) else value
        return AppliedSetPoint(self.channel.number, taken, self.unit.text, plain(raw.tolist()[0]))
