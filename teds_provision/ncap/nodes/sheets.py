"""The datasheet of a node for the API: read and decoded with its security check, or written from a document."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from teds_provision.errors import BadDataError, NotFoundError, TedsProvisionError, UsageError
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.inspection import read_anew
from teds_provision.ncap.nodes.node_jobs import NodeJobs
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.datasheet_edit import SheetPlan, plan_sheet, write_sheet
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.readings import is_keyed, verdict_of
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify import freshness_floor_of, session_check, verify_image
from teds_provision.shapes.verdict import NodeVerdict, Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds import curve as curves_of_guard
from teds_provision.teds.calibration.model import is_finite
from teds_provision.teds.channel import TURN
from teds_provision.teds.formats import TedsBlock, placed, write_blocks
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.show import describe, shown_to_json

FORMATS: Final = {"json": "application/json", "xml": "application/xml", "hex": "text/plain; charset=utf-8"}
_POINTS: Final = 200
_MOST_TURNS: Final = 100
"""A calibration may state any angle: a curve between two points that are further apart is drawn without its turns."""
MeasuredSheet = Callable[[str], Image | None]


@dataclass(frozen=True)
class DatasheetRead:
    """Datasheet of a node, or of its last reading (``now`` False)."""

    image: Image
    judged: NodeVerdict
    now: bool


class Sheets:
    """Reads and writes. ``measured`` gives the datasheet of a node that a measurement holds, as its session has it."""

    def __init__(self, station: Station, roster: NodeDirectory, desk: NodeJobs, measured: MeasuredSheet) -> None:
        self._station, self._directory, self._node_jobs, self._measured = station, roster, desk, measured

    def read(self, uuid: str) -> DatasheetRead:
        """Read from the node if it is on a bus, else return the last reading; raises NotFoundError too."""
        held = self._measured(uuid)
        if held is None and self._node_jobs.on_a_bus(uuid):
            found = self._node_jobs.with_node(uuid, "its datasheet is read", self._read)
            self._directory.refresh([uuid])
            return found
        kept = held or self._station.datasheets.datasheet(bytes.fromhex(uuid))
        judged = verdict_of(self._station, bytes.fromhex(uuid))
        if kept is None or judged is None:
            raise NotFoundError(
                f"The datasheet of node {uuid} has never been read.",
                hint="Connect it to the bus, or place it on the reader.",
            )
        return DatasheetRead(kept, judged, now=held is not None)

    def _read(self, node: Conversation) -> DatasheetRead:
        station = self._station
        found = read_anew(station, node)
        if found is not None:
            return DatasheetRead(*found, now=True)
        identify(station, node)
        image = read_image(node)
        why = "it opens no session under our key" if is_keyed(station, node.uuid) else ""
        checks = (
            *verify_image(station, image, floor=freshness_floor_of(station, node.uuid, None)),
            session_check("", why),
        )
        return DatasheetRead(image, NodeVerdict(Verification(node.uuid, checks), "plain", utc_now(), "ncap"), now=True)

    def document(self, uuid: str, form: str) -> tuple[str, str, str]:
        """Return the datasheet as a document, its media type and its digest; raises UsageError for other formats."""
        if form not in FORMATS:
            raise UsageError(f"Unsupported datasheet format: {form!r}.", hint=f"Use {', '.join(FORMATS)}.")
        image = self.read(uuid).image
        blocks = [TedsBlock(channel, code, image.blocks[channel, code]) for channel, code in image]
        text = write_blocks(blocks, form)  # type: ignore[arg-type]
        return (text if isinstance(text, str) else text.decode()), FORMATS[form], image.digest()

    def as_json(self, uuid: str) -> tuple[dict[str, Any], str]:
        """Return the body of `/nodes/UUID/teds` (api.md), and the digest of the datasheet."""
        found = self.read(uuid)
        blocks = found.image.blocks
        teds = [
            shown_to_json(describe(TedsBlock(channel, code, blocks[channel, code]), blocks))
            for channel, code in found.image
        ]
        shown = {
            "uuid": uuid,
            "read_now": found.now,
            **found.judged.to_json(),
            "teds": teds,
            "guard": self._guarded(found.image),
            "curves": curves(blocks),
        }
        return shown, found.image.digest()

    def _guarded(self, image: Image) -> list[dict[str, str]]:
        try:
            return [_warning(text) for text in guard(self._station, image, None, None, record=False)]
        except TedsProvisionError as error:
            return [{"severity": "error", "message": error.message, "hint": error.hint}]

    # -- writing -----------------------------------------------------------------------------------------------------

    def plan(
        self,
        uuid: str,
        content: str,
        *,
        accept: str | None = None,
        retype: bool = False,
        expected: Collection[str] | None = None,
    ) -> tuple[dict[str, Any], str]:
        """Return what writing this document would change, and the digest of the datasheet that it would change.

        Nothing is changed. Raises DatasheetChangedError if ``expected`` is given and does not contain that digest.
        """
        blocks = parsed(content)
        plan = self._node_jobs.with_node(
            uuid,
            "a datasheet is compared",
            lambda node: plan_sheet(
                self._station, node, blocks, accept_calibration=accept, retype=retype, expected=expected
            ),
        )
        shown = {"uuid": uuid, "dry_run": True, **_plan_json(plan), "steps": [], "verdict": None}
        return shown, plan.present.image.digest()

    def write(
        self,
        uuid: str,
        content: str,
        *,
        accept: str | None = None,
        retype: bool = False,
        expected: Collection[str] | None = None,
    ) -> dict[str, Any]:
        """Build, guard, compare, sign, write and verify it.

        Raises DatasheetChangedError, and writes nothing, if ``expected`` is given and the node has another datasheet.
        """
        blocks = parsed(content)

        def work(node: Conversation) -> dict[str, Any]:
            with self._station.node_lock(node.uuid):
                done = write_sheet(
                    self._station,
                    node,
                    blocks,
                    SilentReporter(),
                    accept_calibration=accept,
                    retype=retype,
                    expected=expected,
                )
            steps = [
                {"name": step.name, "result": step.result, "seconds": step.seconds, "detail": step.detail}
                for step in done.steps
            ]
            return {**_plan_json(done.plan), "steps": steps, "verdict": done.verified.verdict}

        done = self._node_jobs.with_node(uuid, "a datasheet is written", work)
        self._directory.show_sheet(uuid, None)
        self._directory.refresh([uuid])
        self._directory.note(uuid, "written", verdict=done["verdict"], problem=None)
        return {"uuid": uuid, "dry_run": False, **done}


def parsed(content: str) -> dict[BlockId, bytes]:
    """Return the TEDS of a document in XML, JSON or hex; raises BadDataError."""
    if not content.strip():
        raise BadDataError("The datasheet is empty.")
    return placed(content.encode())


def _plan_json(plan: SheetPlan) -> dict[str, Any]:
    changes = [
        {
            "channel": change.channel,
            "access_code": change.access_code,
            "field": change.field,
            "before": change.before,
            "after": change.after,
            "text": change.text,
        }
        for change in plan.changes
    ]
    return {"changes": changes, "guard": [_warning(text) for text in plan.warnings]}


def _warning(text: str) -> dict[str, str]:
    return {"severity": "warning", "message": text, "hint": ""}


def curves(blocks: Mapping[BlockId, bytes]) -> list[dict[str, Any]]:
    """Return every drawable calibration of one input: points of (raw value, value in ``y_unit``), at most 200.

    An angle over a full turn is drawn as it is measured: within its limits, with a gap (the value None) at each wrap.
    """
    sheet = Sheet.from_blocks(blocks)
    found = []
    for number, calibration in sheet.calibrations.items():
        channel = sheet.channel(number)
        if channel is None or len(calibration.inputs) != 1 or not is_finite(calibration):
            continue
        if channel.calibration is None or channel.actuator:
            continue
        own = curves_of_guard.channel_of(number, blocks, None)
        curve = curves_of_guard.curve_of(calibration, own, {number: own})
        raws, values = curve.axes[0].tolist(), curve.result.tolist()
        step = max(1, math.ceil(len(raws) / _POINTS))
        kept = sorted({*range(0, len(raws), step), len(raws) - 1})
        drawn = [(float(raws[at]), values[at]) for at in kept if math.isfinite(values[at])]
        line = within_a_turn(drawn, min(own.low, own.high)) if own.full_turn else drawn
        points = [[raw, None if value is None else channel.unit.from_si(value)] for raw, value in line]
        found.append(
            {"channel": number, "name": channel.name, "x_unit": "raw", "y_unit": channel.unit.text, "points": points}
        )
    return found


def within_a_turn(points: Sequence[tuple[float, float]], low: float) -> list[tuple[float, float | None]]:
    """Return a line of (raw value, angle in rad) within [low, low + 2π], with None at each wrap."""
    found: list[tuple[float, float | None]] = []
    for (x0, y0), (x1, y1) in zip(points, [*points[1:], *points[-1:]], strict=True):
        turn, last = (math.floor((y - low) / TURN) for y in (y0, y1))
        found.append((x0, y0 - turn * TURN))
        while turn != last and abs(turn - last) <= _MOST_TURNS:
            up = last > turn
            edge = low + (turn + up) * TURN
            x = x0 + (x1 - x0) * (edge - y0) / (y1 - y0)
            found += [(x, low + up * TURN), (x, None), (x, low + (not up) * TURN)]
            turn += 1 if up else -1
    return found
