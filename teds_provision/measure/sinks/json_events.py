"""The JSON lines of ``measure``: events of the command-line contract, for ``--json`` and for ``.jsonl`` files alike."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, NodeReport
from teds_provision.teds.calibration.plain import calibration_as_json


def iso(seconds: float) -> str:
    """Return unix seconds as ISO 8601 in UTC, to the millisecond."""
    try:
        return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    except (OverflowError, OSError, ValueError):
        return "unknown"


def plain(value: Any) -> Any:
    """Return a raw or calibrated value for JSON: octets as hex, non-finite numbers as null."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


_WITHIN = ("units", "siblings", "chosen")  # fields of facts that are used only in this process


def facts_as_json(facts: ChannelFacts) -> dict[str, Any]:
    """Return the facts of a channel for a header or a metadata message, without those that are not known."""
    fields = {
        field.name: getattr(facts, field.name) for field in dataclasses.fields(facts) if field.name not in _WITHIN
    }
    fields["vector"] = list(facts.vector) or None
    fields["calibration"] = None if facts.calibration is None else calibration_as_json(facts.calibration)
    return {
        name: plain(value) for name, value in fields.items() if value is not None and value is not False and value != ""
    }


def data_lines(block: Block, facts: Mapping[tuple[str, int], ChannelFacts]) -> Iterator[dict[str, Any]]:
    """Yield a ``data`` event for each channel of a block (``measure --json``); an invalid value is null, never NaN."""
    times = [round(instant, 6) for instant in block.time.tolist()]
    for column, number in enumerate(block.channels):
        known = facts.get((block.uuid, number)) or ChannelFacts(block.uuid, "", number, "")
        valid = block.valid[:, column].tolist()
        values = block.value[:, column].tolist()
        line: dict[str, Any] = {
            "event": "data",
            "uuid": block.uuid,
            "channel": number,
            "name": known.name,
            "unit": known.unit,
            "index": block.index,
            "time": times,
            "raw": [plain(value) for value in block.raw[:, column].tolist()],
            "value": [plain(value) if good else None for value, good in zip(values, valid, strict=True)],
            "uncertainty": known.uncertainty,
            "valid": valid,
            "clock_error": block.clock_error,
            "age": round(block.age, 6),
        }
        if block.test_pattern:
            line["test_pattern"] = True
        if known.unsigned:
            line["unsigned"] = True
        if known.unverified:
            line["unverified"] = True
        yield line


def row_lines(rows: GroupRows, facts: Mapping[tuple[str, int], ChannelFacts]) -> Iterator[dict[str, Any]]:
    """Yield the same for each channel of a grid, which has neither sample numbers nor raw values."""
    times = [round(instant, 6) for instant in rows.time.tolist()]
    for column, (uuid, number) in enumerate(rows.channels):
        known = facts.get((uuid, number)) or ChannelFacts(uuid, "", number, "")
        values = rows.value[:, column].tolist()
        yield {
            "event": "data",
            "uuid": uuid,
            "channel": number,
            "name": known.name,
            "unit": known.unit,
            "time": times,
            "value": [plain(value) for value in values],
            "uncertainty": known.uncertainty,
            "valid": [math.isfinite(value) for value in values],
        }


def status_line(report: NodeReport) -> dict[str, Any]:
    """Return the ``status`` event of a node."""
    return {
        "event": "status",
        "uuid": report.uuid,
        "state": report.state,
        "why": report.why,
        "samples": report.samples,
        "lost": report.lost,
        "late": report.late,
        "bad": report.bad,
        "invalid": report.invalid,
        "invalid_why": [dataclasses.asdict(invalid) for invalid in report.invalid_why],
        "clock_error": report.clock_error,
        "time": report.time,
    }


def as_line(event: Mapping[str, Any]) -> bytes:
    """Return one line of JSON; raises ValueError if a NaN is left in it."""
    return json.dumps(event, allow_nan=False, separators=(",", ":")).encode() + b"\n"
