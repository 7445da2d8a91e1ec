"""``calibrate capture``: one point of a calibration from the running sensor, with its reference value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from teds_provision.arrays import np
from teds_provision.errors import NotFoundError, PolicyError
from teds_provision.files import SHARED, read_text, write_whole
from teds_provision.limits import LIMITS
from teds_provision.links import LinkSettings
from teds_provision.measure.sample_series import (
    SampleSeries,
    reference_for,
    require_still,
    require_still_raw,
    take_samples_of,
)
from teds_provision.measure.sources import own_source_address
from teds_provision.measure.verified_session import open_trusted
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.progress import Reporter, Steps
from teds_provision.provisioning.visit import at_node
from teds_provision.station.station import Station
from teds_provision.teds.calibration.points import Point, points_of, with_point
from teds_provision.teds.calibration.zero import reading_of
from teds_provision.teds.channel import Channel

_NAME: Final = "calibrate capture"


@dataclass(frozen=True)
class CaptureResult:
    """The new point, and all that the file holds now (values in its unit)."""

    uuid: bytes
    channel: Channel
    point: Point
    points: tuple[Mapping[str, float | int | None], ...]


def capture_at(
    station: Station,
    links: LinkSettings,
    node: str,
    chosen: int | str,
    reference: float,
    file: Path,
    reporter: Reporter,
    *,
    unit: str | None = None,
    shown_unit_asked: bool = False,
) -> CaptureResult:
    """Add a point to a file: the ``chosen`` channel of ``node`` gives its raw value at ``reference``.

    Another station's claim on the sensor does not matter: several may measure it. Raises PolicyError (too restless, at
    the wrap of its raw values, a file of another node), BadDataError (unit, channel, file), NotFoundError (folder).
    """
    uuid = station.nodes.resolve(node)
    if not file.parent.is_dir():
        raise NotFoundError(f"There is no folder {file.parent}.")
    steps = Steps(reporter)
    with (
        own_source_address(station, links.after_agreeing(), f"{_NAME} {uuid.hex()}", shared=False) as own,
        at_node(station, own, uuid, reporter) as visit,  # the node stays locked while the file is written
    ):
        try:
            trusted = open_trusted(station, visit.node, by=_NAME)
            channel = trusted.channel(chosen)
            si = reference_for(channel, reference, unit, shown_unit_asked=shown_unit_asked)
            with steps.step("read") as step:
                point = _point(take_samples_of(trusted, channel.number), si)
                step.detail = f"raw {point.raw:.8g}, {point.count} samples"
        except SessionLostError as lost:
            raise lost.cause from lost
        text = read_text(file, LIMITS.text_file, "calibration") if file.exists() else ""
        today = datetime.now().astimezone().date()
        text = with_point(text, str(file), point, node=uuid.hex(), unit=channel.unit, today=today)
        write_whole(file, (text.encode(),), mode=SHARED)
    return CaptureResult(uuid, channel, point, tuple(points_of(text, str(file))))


def _point(settled: SampleSeries, reference: float) -> Point:
    """Return mean and spread of the raw values; raises PolicyError if they do not belong to one place."""
    channel = settled.interpreter.channel
    raw, _ = settled.interpreter.reader.numbers(settled.raw)
    if not np.isfinite(raw).all():
        raise PolicyError(f"Channel {channel.number} delivers raw values that are not numbers.")
    reading = reading_of(raw)
    ends = channel.calibration.raw_range if channel.calibration is not None else None
    ends = ends or settled.interpreter.reader.form.raw_range
    if channel.full_turn and ends is not None and float(np.ptp(raw)) > (ends[1] - ends[0]) / 2:
        raise PolicyError(
            f"Channel {channel.number} is at the wrap of its raw values: some are at either end of the turn.",
            hint="Turn it a little further and take the point there.",
        )
    if channel.calibration is not None and not settled.interpreter.problem:
        require_still(settled)
    else:
        require_still_raw(settled, reading)
    return Point(channel.number, reading.mean, reference, reading.spread, reading.count)
