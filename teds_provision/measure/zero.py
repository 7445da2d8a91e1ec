"""``calibrate zero``: define the present reading as 0. Read, build, sign, write, verify: one step.

The curve stays, and so does the date of its calibration; its zero offset moves, and the date of that is stored beside
it. The guard judges the result as it judges any calibration. The node's own datasheet counts, no profile is needed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Final

from teds_provision.arrays import np
from teds_provision.errors import BadDataError, PolicyError
from teds_provision.links import LinkSettings
from teds_provision.measure.held_actuator import unit_for
from teds_provision.measure.sample_series import SampleSeries, reference_for, require_still, take_samples_of
from teds_provision.measure.sources import own_source_address
from teds_provision.measure.verified_session import VerifiedSession, operation, trusted_from
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.operation.commands import ChannelState
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.charge import Low, wait_for_charge
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.progress import DONE, NOTHING, Reporter, StepResult, Steps
from teds_provision.provisioning.sign import require_not_measured, sign
from teds_provision.provisioning.verify_node import NodeVerification, judge_and_keep, verify_in_session
from teds_provision.provisioning.visit import NodeVisit, at_node
from teds_provision.provisioning.write import write
from teds_provision.station.station import Station
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.zero import offset_for, reading_of, shortest, turn_of, with_zero_offset
from teds_provision.teds.channel import TURN, Channel, wrapped
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.diff import diff_blocks
from teds_provision.teds.image import Image
from teds_provision.teds.units import format_value

_NAME = "calibrate zero"
_AFTERWARDS: Final = 16
"""Samples by the new datasheet, one after the other: each takes 6 ms of a bus of 500 kbit/s."""
_ROUNDING: Final = 1e-6 * TURN


@dataclass(frozen=True)
class ZeroOrder:
    """The channel that reads ``value`` (None: 0) now, in ``unit`` (None: SI).

    ``shown_unit_asked``: an operator at a terminal has to name the unit if the display unit is not SI.
    ``accept_calibration`` is the reason given for a result that the guard would refuse.
    """

    channel: int | str
    value: float | None = None
    unit: str | None = None
    shown_unit_asked: bool = False
    accept_calibration: str | None = None


@dataclass(frozen=True)
class ZeroResult:
    """Result of a zero, or of its dry run: numbers are in SI units, ``offset`` and ``moved`` are differences.

    ``before`` is the channel's reading before, ``after`` the one now (for a dry run: expected). ``moved`` is 0 if there
    was nothing to do.
    """

    uuid: bytes
    channel: Channel
    offset: float
    moved: float
    before: float
    after: float
    spread: float
    count: int
    sequence: int
    changes: tuple[str, ...]
    warnings: tuple[str, ...]
    steps: tuple[StepResult, ...]
    written: bool


def zero_at(
    station: Station,
    links: LinkSettings,
    node: str,
    order: ZeroOrder,
    reporter: Reporter,
    *,
    dry_run: bool = False,
    low: Low = wait_for_charge,
) -> ZeroResult:
    """Have a channel of the node that ``node`` names read ``order.value`` now.

    A running `ncap` of this home that measures the node releases it, and gets it back. Raises PolicyError (too
    restless, no calibration whose offset could carry it, a value beyond the limits, the guard), NotAuthenticError if
    the datasheet on the node is not good, and what reading, signing and writing raise.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    writes = "" if dry_run else _NAME
    with (
        own_source_address(station, links.after_agreeing(), f"{_NAME} {uuid.hex()}", shared=False) as own,
        at_node(station, own, uuid, reporter, unlock="always", writes=writes) as visit,
    ):
        try:
            return _ZeroRun(visit, order, Steps(reporter), low, dry_run=dry_run).run()
        except SessionLostError as lost:
            raise lost.cause from lost


@dataclass(frozen=True)
class _ZeroRun:
    visit: NodeVisit
    order: ZeroOrder
    steps: Steps
    low: Low
    dry_run: bool

    def run(self) -> ZeroResult:
        station, node = self.visit.station, self.visit.node
        require_session(station, node)
        looked = verify_in_session(station, node, by=_NAME)
        image, trusted = looked.image, trusted_from(station, node, looked)
        with self.steps.step("read") as step:
            channel, own = _adjustable(trusted, self.order.channel)
            wanted = self._wanted(channel, own)
            turn = turn_of(own, full_turn=channel.full_turn)
            settled = take_samples_of(trusted, channel.number)
            reading = require_still(settled)
            step.detail = f"{channel.show_reading(_si(channel, own, reading.mean))}, {reading.count} samples"
        offset = offset_for(own, reading.mean, wanted, turn)
        moved = float(shortest(np.asarray(offset - own.zero_offset), turn))
        identity = node.proven
        assert identity is not None, "a look in the session asked for it"
        found = ZeroResult(
            node.uuid,
            channel,
            offset=offset * own.unit.scale,
            moved=moved * own.unit.scale,
            before=_si(channel, own, reading.mean),
            after=_si(channel, own, reading.mean + moved),
            spread=own.unit.difference_to_si(reading.spread),
            count=reading.count,
            sequence=identity.sequence,
            changes=(),
            warnings=self._warnings(settled, own),
            steps=(),
            written=False,
        )
        if abs(moved) <= reading.doubt:
            return replace(found, offset=own.zero_offset * own.unit.scale, moved=0.0, steps=tuple(self.steps.done))
        with self.steps.step("build") as step:
            at = (channel.number, int(AccessCode.CALIBRATION))
            octets = with_zero_offset(image.blocks[at], offset, datetime.now(UTC).replace(microsecond=0))
            wanted_image = Image(node.uuid, {**image.unsigned_blocks(), at: octets})
            record = not self.dry_run
            result = guard(
                station, wanted_image, image, self.order.accept_calibration, record=record, expected=("changed",)
            )
            changes = tuple(
                change.text for change in diff_blocks(image.unsigned_blocks(), wanted_image.unsigned_blocks())
            )
            found = replace(found, changes=changes, warnings=(*found.warnings, *result))
            step.detail = f"zero offset {channel.show(found.offset, difference=True)}"
        if self.dry_run:
            return replace(found, steps=tuple(self.steps.done))
        if not node.tapped:  # a tap ends the claims of other stations
            require_not_measured(station, node, released=self.visit.released)
            _require_nobody_else(trusted)
        return self._bring(wanted_image, found)

    def _wanted(self, channel: Channel, own: Calibration) -> float:
        """Return the wanted reading of the channel, in the calibrated unit; raises PolicyError beyond its limits."""
        order = self.order
        si = reference_for(channel, order.value, order.unit, shown_unit_asked=order.shown_unit_asked)
        if not channel.full_turn:
            slack = max(channel.stated_uncertainty, 0.0) if math.isfinite(channel.stated_uncertainty) else 0.0
            if si < channel.low - slack or si > channel.high + slack:
                unit = unit_for(channel, order.unit) if order.unit is not None else channel.shown
                asked, low, high = (format_value(number, unit) for number in (si, channel.low, channel.high))
                raise PolicyError(
                    f"{asked} exceeds the limits of channel {channel.label}, {low} to {high}.",
                    hint="Limits come from the signed datasheet and cannot be exceeded.",
                )
        return own.unit.from_si(si)

    def _warnings(self, settled: SampleSeries, own: Calibration) -> tuple[str, ...]:
        out = []
        if settled.extrapolated:
            first, last = own.inputs[0].boundaries[0], own.inputs[0].boundaries[-1]
            out.append(f"The reading is outside the calibrated range (raw {first:.8g} to {last:.8g}).")
        if self.visit.station.datasheets.draft(self.visit.node.uuid) is not None:
            out.append("This node has a draft, which does not include this zero offset; to drop it: draft drop UUID.")
        return tuple(out)

    def _bring(self, image: Image, found: ZeroResult) -> ZeroResult:
        """Sign, write, verify, and read once more by the new datasheet."""
        station, node, who = self.visit.station, self.visit.node, self.visit.who
        identity = node.proven
        assert identity is not None
        keys = SignedNodeKey(node.uuid, who.point, who.key_signature)
        with self.steps.step("sign") as step:
            signed = sign(station, keys, image, epoch=identity.epoch, node_sequence=identity.sequence)
            step.detail = f"sequence {signed.sequence}"
        with self.steps.step("write") as step:
            record = station.nodes.get(node.uuid)
            facts: Mapping[str, object] = {"profile": record.profile} if record is not None and record.profile else {}
            written = write(
                station, node, signed.image, progress=self.steps.reporter.written, facts=facts, low=self.low
            )
            step.result = DONE if written.octets else NOTHING
            step.detail = f"{written.octets} octets"
        with self.steps.step("verify") as step:
            judged = judge_and_keep(station, node, written.on_node, who.point, by=_NAME, c=node.open_counter)
            step.take_verdict(judged.verified.verdict)
            trusted = trusted_from(station, node, NodeVerification(written.on_node, judged))
            channel, own = _adjustable(trusted, found.channel.number)
            turn = turn_of(own, full_turn=channel.full_turn)
            after = reading_of(
                take_samples_of(trusted, channel.number, count=_AFTERWARDS, seconds=0.0).calibrated(), turn
            )
        said = {"channel": channel.number, "offset": found.offset, "unit": channel.si_unit}
        station.audit("zero", node.uuid, "done", **said, sequence=signed.sequence)
        return replace(
            found,
            after=_si(channel, own, after.mean),
            sequence=signed.sequence,
            steps=tuple(self.steps.done),
            written=True,
        )


def _require_nobody_else(trusted: VerifiedSession) -> None:
    """Raise PolicyError if another session claims a channel: the node would refuse the signed datasheet."""
    claimed = [state for state in operation(trusted.node).channels.values() if state[0] & ChannelState.CLAIMED_BY_OTHER]
    if claimed:
        raise PolicyError(
            f"Node {trusted.uuid} is being measured by another station, source address 0x{claimed[0][1]:02X}.",
            hint="End that measurement first. A running ncap of this home releases the node by itself.",
        )


def _adjustable(trusted: VerifiedSession, chosen: int | str) -> tuple[Channel, Calibration]:
    """Return a sensor and its calibration; raises PolicyError if it has no adjustable offset."""
    channel = trusted.channel(chosen)
    if channel.actuator:
        raise BadDataError(f"Channel {channel.label} of node {trusted.uuid} is an actuator, not a sensor.")
    own = channel.calibration
    if own is None:
        why = channel.calibration_problem or "it has none."
        raise PolicyError(
            f"Channel {channel.label} has no calibration with an offset that can be changed: {why}",
            hint="Calibrate it first: calibrate capture, then provision with --calibration FILE.",
        )
    return channel, own


def _si(channel: Channel, own: Calibration, value: float) -> float:
    """Return a reading in the calibrated unit, in SI units, as it is shown: within its turn.

    The rounding of a Float32 offset leaves a reading of 0 just below it, which must not come back as a whole turn.
    """
    si = own.unit.to_si(value)
    if not channel.full_turn:
        return si
    angle = float(wrapped(np.asarray(si), channel.low, channel.high, TURN))
    return channel.low if channel.low + TURN - angle < _ROUNDING else angle
