"""Reads the field table of the Calibration TEDS from ``calibration_fields.toml`` (unverified numbers)."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.tables.field_spec import FieldSpec, Table, name_of


def calibration_table() -> Table:
    """Return the table of access code 5, marked unverified."""
    data = tomllib.loads(Path(__file__).with_name("calibration_fields.toml").read_text(encoding="utf-8"))
    rows = tuple(_row(row) for row in data["field"])
    return Table(
        AccessCode.CALIBRATION,
        name_of(AccessCode.CALIBRATION),
        rows,
        verified=data["status"] != "unverified",
        source=data["source"],
    )


def _row(row: dict[str, Any]) -> FieldSpec:
    plain = {key: value for key, value in row.items() if key not in {"children", "enumeration"}}
    return FieldSpec(
        **plain,
        children=tuple(_row(child) for child in row.get("children", ())),
        enumeration=dict(enumerate(row.get("enumeration", ()))),
    )
