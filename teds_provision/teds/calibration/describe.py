"""A calibration in words and as plain data: method, points, residuals, dates, in the calibrated unit."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Any

from teds_provision.teds.calibration.fitting import residuals
from teds_provision.teds.calibration.model import Calibration


def kind_of(calibration: Calibration) -> str:
    """``linear``, ``polynomial of degree 3``, ``table of 64 segments``."""
    segments = math.prod(part.segments for part in calibration.inputs)
    if calibration.method in ("table", "steps"):
        return f"{calibration.method} of {segments} segment{'s' if segments > 1 else ''}"
    text = f"polynomial of degree {calibration.inputs[0].degree}" if calibration.method == "polynomial" else "linear"
    return text if segments == 1 else f"{text}, {segments} segments"


def describe_calibration(calibration: Calibration, now: datetime | None = None) -> dict[str, Any]:
    """Plain data of a calibration; residuals where it has its points, ``overdue`` where ``now`` is given."""
    left = residuals(calibration)
    shown = None
    if left is not None:
        at, difference = left.worst
        shown = {
            "points": len(left.inputs),
            "maximum": left.maximum,
            "rms": left.rms,
            "worst": {"input": at, "difference": difference},
        }
    return {
        "channel": calibration.channel,
        "kind": kind_of(calibration),
        "method": calibration.method,
        "inputs": [part.channel for part in calibration.inputs],
        "coefficients": len(calibration.coefficients),
        "unit": calibration.unit.text,
        "uncertainty": calibration.uncertainty,
        "zero_offset": calibration.zero_offset,
        "monotone": calibration.monotone,
        "raw_range": list(calibration.raw_range) if calibration.raw_range else None,
        "date": calibration.date.isoformat() if calibration.date else None,
        "interval": calibration.interval,
        "due": calibration.due.isoformat() if calibration.due else None,
        "overdue": calibration.overdue(now) if now is not None else None,
        "by": calibration.by,
        "residuals": shown,
    }


def sentence(calibration: Calibration) -> str:
    """One line for people: ``channel 1: polynomial of degree 3, 20 points, largest residual 0.1 N at raw 300, …``."""
    unit = "raw" if calibration.actuator else calibration.unit.text
    text = f"channel {calibration.channel}: {kind_of(calibration)}"
    left = residuals(calibration)
    if left is not None:
        at, _ = left.worst
        place = f"{at:.6g} {calibration.unit.text}" if calibration.actuator else f"raw {at:.8g}"
        text += f", {len(left.inputs)} points, largest residual {left.maximum:.3g} {unit} at {place}"
        text += f", rms {left.rms:.3g} {unit}"
    if calibration.due is not None:
        text += f", due {calibration.due:%Y-%m-%d}"
    return text
