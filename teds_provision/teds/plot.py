"""Pictures of calibrations: the curve with its points, residuals and limits, as PNG or SVG.

matplotlib comes with the extra ``[plot]`` and is loaded when a picture is drawn.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from teds_provision.arrays import np
from teds_provision.errors import BadDataError, TedsProvisionError, UsageError
from teds_provision.files import SHARED, write_whole
from teds_provision.lazy import how_to_install
from teds_provision.teds.calibration.formula import kind_of, residuals
from teds_provision.teds.calibration.model import Calibration, is_sound
from teds_provision.teds.channel import TURN, wrapped
from teds_provision.teds.curve import Curve, CurveChannel, channel_of, curve_of
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile.model import Profile
from teds_provision.teds.sheet import Sheet, name_among

FORMATS: Final = ("png", "svg")
COLUMNS: Final = 3
MAXIMUM_PANELS: Final = 24
_LINE_POINTS: Final = 2000
_MARKED_NODES: Final = 200
_BLUE, _ORANGE, _GREY, _RED = "#1f5fa8", "#d9730d", "#777777", "#b3261e"


def plot_blocks(
    blocks: Mapping[BlockId, bytes],
    path: Path,
    *,
    channel: int | None = None,
    profile: Profile | None = None,
    calibrations: Mapping[int, Calibration] | None = None,
) -> tuple[int, ...]:
    """Draw the calibrations among framed TEDS into a PNG or SVG file (by its ending); returns the channels drawn.

    ``calibrations`` are those that the blocks were made from: their points and residuals are drawn too. Raises
    BadDataError (no calibration that can be drawn), UsageError (another ending, no matplotlib), and what
    ``write_whole`` raises.
    """
    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise UsageError(f'"{path.name}" is no picture that can be drawn.', hint="Let its name end in .png or .svg.")
    panels = _panels(blocks, channel, profile, calibrations or {})
    if not panels:
        which = f"channel {channel}" if channel is not None else "any channel"
        raise BadDataError(f"There is no calibration of {which} that can be drawn.")
    if len(panels) > MAXIMUM_PANELS:
        raise UsageError(f"{len(panels)} channels do not fit one picture.", hint="Choose one with --channel.")
    sheet = Sheet.from_blocks(blocks)
    title = "  ".join(part for part in (sheet.meta.name, sheet.uuid.hex()) if part)
    write_whole(path, _picture(panels, kind, title), mode=SHARED)
    return tuple(panel.curve.channel.number for panel in panels)


@dataclass(frozen=True)
class _Panel:
    name: str
    curve: Curve
    points: tuple[tuple[float, float], ...]


def _panels(
    blocks: Mapping[BlockId, bytes],
    channel: int | None,
    profile: Profile | None,
    calibrations: Mapping[int, Calibration],
) -> list[_Panel]:
    panels = []
    for number, calibration in Sheet.from_blocks(blocks).calibrations.items():
        if channel not in (None, number) or not is_sound(calibration):
            continue
        own = channel_of(number, blocks, profile)
        if profile is None and calibration.raw_range:
            own = replace(own, raw=calibration.raw_range)
        others = {part.channel: channel_of(part.channel, blocks, profile) for part in calibration.inputs}
        points = calibrations[number].points if number in calibrations else ()
        name = name_among(number, blocks)
        title = f"channel {number}: {name}" if name else f"channel {number}"
        panels.append(_Panel(title, curve_of(calibration, own, others, dense=True), points))
    return panels


def _picture(panels: list[_Panel], kind: str, title: str) -> bytes:
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError as error:
        raise TedsProvisionError(
            "Pictures need matplotlib, which is not installed.",
            hint=how_to_install("plot"),
        ) from error
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    settings: Any = {"svg.hashsalt": "teds-provision", "svg.fonttype": "none", "text.parse_math": False, "font.size": 9}
    with mpl.rc_context(settings):
        figure = Figure(figsize=(max(7.0, 5.2 * columns), 5.4 * rows), layout="constrained", dpi=110)
        if title:
            figure.suptitle(title, fontsize=11)
        grid: Any = figure.subfigures(rows, columns, squeeze=False)
        for number, panel in enumerate(panels):
            _draw(grid[number // columns][number % columns], panel)
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, metadata={"Date": None} if kind == "svg" else None)
        return buffer.getvalue()


def _draw(where: Any, panel: _Panel) -> None:
    upper, lower = where.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 1.3]})
    view = _View(panel)
    upper.set_title(f"{panel.name}\n{_subtitle(panel.curve.calibration)}", fontsize=10)
    view.curve(upper)
    view.limits(upper)
    upper.set_ylabel(view.y_label)
    upper.grid(alpha=0.25)
    if panel.points:
        view.residuals(lower)
    else:
        view.straightness(lower)
    lower.axhline(0, color=_GREY, linewidth=0.8)
    lower.set_xlabel(view.x_label)
    lower.grid(alpha=0.25)
    upper.legend(fontsize=8, loc="best", framealpha=0.9)


def _subtitle(calibration: Calibration) -> str:
    text = kind_of(calibration)
    if calibration.date is not None:
        text += f", {calibration.date:%Y-%m-%d}"
        if calibration.due is not None:
            text += f", due {calibration.due:%Y-%m-%d}"
    return text


class _View:
    """One channel in the units that are drawn: the calibrated unit for sensors, raw for the results of actuators."""

    def __init__(self, panel: _Panel) -> None:
        import numpy as np

        self.panel = panel
        curve = panel.curve
        self.channel: CurveChannel = curve.channel
        self.calibration = curve.calibration
        self.unit = curve.calibration.unit
        self.axis = curve.axes[curve.main]
        results = np.moveaxis(curve.result, curve.main, 0).reshape(len(self.axis), -1)
        columns = sorted({0, results.shape[1] // 2, results.shape[1] - 1})
        self.lines = [self._shown(results[:, column]) for column in columns]
        part = self.calibration.inputs[curve.main]
        self.nodes = np.asarray(part.boundaries)
        self.inside = (self.axis >= part.boundaries[0]) & (self.axis <= part.boundaries[-1])
        value, raw = f"value [{self.unit.text or 'count'}]", "raw"
        self.x_label, self.y_label = (value, raw) if self.channel.actuator else (raw, value)

    def _shown(self, values: Any) -> Any:
        return values if self.channel.actuator else (values - self.unit.offset) / self.unit.scale

    def _thinned(self, mask: Any) -> Any:
        """Return indices to draw within the mask: about 2000, corners of the curve kept by the spread."""
        places = np.flatnonzero(mask)
        step = max(1, len(places) // _LINE_POINTS)
        return np.unique(np.append(places[::step], places[-1:]))

    def _wrapped(self, values: Any) -> Any:
        """Return angles over a full turn wrapped into it, as they are measured."""
        if not self.channel.full_turn:
            return values
        ends = sorted(self.unit.from_si(end) for end in (self.channel.low, self.channel.high))
        return wrapped(values, ends[0], ends[1], abs(self.unit.difference_from_si(TURN)))

    def _drawn(self, values: Any) -> Any:
        """Return the values of a line, with a gap if an angle continues at the other end of its turn."""
        if not self.channel.full_turn:
            return values
        values = self._wrapped(values)
        jumps = np.abs(np.diff(values)) > abs(self.unit.difference_from_si(TURN)) / 2
        values[1:][jumps] = np.nan
        return values

    def curve(self, axes: Any) -> None:
        """Draw the curve, solid within the calibrated range and dotted beyond; its points, or the nodes of a table."""
        inside = self._thinned(self.inside)
        for number, line in enumerate(self.lines):
            label = "calibration" if number == 0 else None
            axes.plot(self.axis[inside], self._drawn(line[inside]), color=_BLUE, linewidth=1.4, label=label, zorder=3)
            low, high = self.nodes[0], self.nodes[-1]
            first = label and "extrapolated"
            for side in (self.axis <= low, self.axis >= high):
                places = self._thinned(side)
                if len(places) > 1:
                    drawn = self._drawn(line[places])
                    axes.plot(self.axis[places], drawn, color=_BLUE, linestyle=":", label=first, zorder=3)
                    first = None
        if self.panel.points:
            pairs = np.asarray(self.panel.points)
            x, y = (pairs[:, 1], pairs[:, 0]) if self.channel.actuator else (pairs[:, 0], pairs[:, 1])
            axes.plot(x, y, "o", markersize=3.5, color=_ORANGE, label=f"{len(pairs)} points", zorder=4)
        elif 2 < len(self.nodes) <= _MARKED_NODES and len(self.lines) == 1:
            heights = self._wrapped(np.interp(self.nodes, self.axis, self.lines[0]))
            axes.plot(self.nodes, heights, "o", markersize=3, color=_ORANGE, label=f"{len(self.nodes)} nodes", zorder=4)

    def limits(self, axes: Any) -> None:
        """Draw the limits, with the stated uncertainty as a band around them."""
        if self.channel.actuator:
            ends, width = self.channel.raw or (), 0.0
        else:
            ends = (self.unit.from_si(self.channel.low), self.unit.from_si(self.channel.high))
            width = self.unit.difference_from_si(self.channel.tolerance)
        for number, end in enumerate(ends):
            if math.isfinite(end):
                label = "limits ± uncertainty" if width else "limits"
                axes.axhline(end, color=_RED, linewidth=1, linestyle="--", label=None if number else label)
                if width:
                    axes.axhspan(end - width, end + width, color=_RED, alpha=0.12, linewidth=0)

    def residuals(self, axes: Any) -> None:
        """Draw the residuals of the points, and the stated uncertainty."""
        own = residuals(replace(self.calibration, points=self.panel.points, actuator=self.channel.actuator))
        if own is None:
            return
        axes.plot(own.inputs, own.differences, "o-", color=_ORANGE, markersize=3, linewidth=0.7)
        stated = self._uncertainty(axes, own.maximum)
        self._caption(axes, f"residuals: largest {own.maximum:.3g}, rms {own.rms:.3g}{stated}")
        axes.set_ylabel("point - curve")

    def straightness(self, axes: Any) -> None:
        """Draw, without points, how far the curve departs from the straight line through it."""
        line = self.lines[len(self.lines) // 2]
        places = self._thinned(self.inside)
        x, y = self.axis[places], line[places]
        if len(x) < 2:
            return
        middle = x.mean()
        slope = float(((x - middle) * (y - y.mean())).sum() / max(float(((x - middle) ** 2).sum()), 1e-300))
        away = y - (y.mean() + slope * (x - middle))
        largest = float(np.abs(away).max())
        axes.plot(x, away, color=_BLUE, linewidth=1)
        stated = self._uncertainty(axes, largest)
        self._caption(axes, f"departure from a straight line: largest {largest:.3g}{stated}")
        axes.set_ylabel("curve - line")

    @staticmethod
    def _caption(axes: Any, text: str) -> None:
        axes.set_title(text, fontsize=8, loc="left", pad=3)

    def _uncertainty(self, axes: Any, largest: float) -> str:
        """Draw the stated uncertainty unless it is far outside; return the words for it."""
        if self.channel.actuator or not self.channel.tolerance:
            return ""
        width = self.unit.difference_from_si(self.channel.tolerance)
        if largest * 20 < width:
            return f"; stated uncertainty {width:.3g}, far outside"
        for end in (-width, width):
            axes.axhline(end, color=_RED, linewidth=0.9, linestyle="--")
        return f"; stated uncertainty {width:.3g} (dashed)"
