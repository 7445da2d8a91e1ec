"""A TEDS as people want to see it: :func:`describe` gives fields with units and words, and what they mean together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from teds_provision.lazy import lazy
from teds_provision.teds.calibration.decoded import calibrated_unit
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Decoded, Field, Finding, Units
from teds_provision.teds.codec.tables import FieldSpec, Table, table
from teds_provision.teds.formats import Block
from teds_provision.teds.formats.jsonform import teds_to_json
from teds_provision.teds.sheet import channel_from, described
from teds_provision.teds.show.summary import Line, summary_of
from teds_provision.teds.show.values import Context, meaning_of, text_of
from teds_provision.teds.units import WrittenUnit, display_unit

__all__ = ["Shown", "ShownField", "describe", "finding_to_json", "shown_to_json"]

if TYPE_CHECKING:
    from teds_provision.teds.show import plot
else:
    __getattr__ = lazy(__name__)


@dataclass(frozen=True)
class ShownField:
    """One field for people: ``text`` is the value, ``meaning`` words for a code, ``weak`` a flag of the latter."""

    type: int
    name: str
    text: str
    meaning: str
    weak: bool
    offset: int
    children: tuple[ShownField, ...] = ()


@dataclass(frozen=True)
class Shown:
    """One TEDS for people; ``summary`` holds (label, text) lines about the whole."""

    block: Block
    decoded: Decoded
    fields: tuple[ShownField, ...]
    summary: tuple[Line, ...]

    @property
    def title(self) -> str:
        """``channel 1 · ChanTEDS (3)``, ``ChanTEDS (3)``, or that nothing says what it is."""
        code = self.block.access_code
        name = f"{table(code).name} ({code})" if code is not None else "unknown class"
        if self.decoded.access_code is not None and code is not None and self.decoded.access_code != code:
            name += f", though its TEDSID says {self.decoded.access_code}"
        return name if self.block.channel is None else f"channel {self.block.channel} · {name}"


def describe(
    block: Block, beside: Mapping[tuple[int, int], bytes] | None = None, *, now: datetime | None = None
) -> Shown:
    """Decode a block and put it into words; ``beside`` are the framed TEDS that lie in the same image.

    Never raises, whatever the octets.
    """
    decoded = decode(block.octets)
    context = _context(block, decoded, dict(beside or {}))
    rows = table(decoded.access_code) if decoded.access_code is not None else None
    known: Mapping[int, FieldSpec] = _rows(rows)
    fields = tuple(_field(field, known, context) for field in decoded.fields)
    return Shown(block, decoded, fields, summary_of(decoded, context, now or datetime.now(UTC)))


def _rows(rows: Table | None) -> dict[int, FieldSpec]:
    return {} if rows is None else {**rows.inner, **rows.aliases, **rows.by_type}


def _field(field: Field, known: Mapping[int, FieldSpec], context: Context) -> ShownField:
    spec = known.get(field.type) if field.name else None
    if field.name == "TEDSID":
        return ShownField(field.type, field.name, field.raw.hex(" "), "", False, field.offset)
    inner = {} if spec is None else spec.by_type
    children = () if isinstance(field.value, Units) else tuple(_field(part, inner, context) for part in field.children)
    text = "" if children else text_of(field, context, spec)
    meaning, weak = meaning_of(field, spec)
    return ShownField(field.type, field.name or f"type {field.type}", text, meaning, weak, field.offset, children)


def _context(block: Block, decoded: Decoded, beside: dict[tuple[int, int], bytes]) -> Context:
    series = decoded.get("SUnits")
    return Context(
        _unit(block, decoded, beside),
        display_unit(series) if isinstance(series, Units) else None,
        beside,
        converted=decoded.access_code == AccessCode.CALIBRATION,
        channel=block.channel,
    )


def _unit(block: Block, decoded: Decoded, beside: Mapping[tuple[int, int], bytes]) -> WrittenUnit | None:
    """Unit of LowLimit, HiLimit and OError: the channel's, or the calibrated one; None where nothing names one."""
    if decoded.access_code == AccessCode.CHANNEL:
        channel = channel_from(decoded)
        return channel.unit if channel.units_stated else None
    if decoded.access_code != AccessCode.CALIBRATION:
        return None
    channel = described(block.channel or 1, beside)
    return calibrated_unit(decoded, channel.units) if channel.units_stated else None


def finding_to_json(finding: Finding) -> dict[str, Any]:
    """One finding as a JSON object."""
    out: dict[str, Any] = {"severity": finding.severity, "offset": finding.offset, "code": finding.code}
    out["message"] = finding.message
    extra = {"field": finding.field, "asked": finding.asked, "found": finding.found}
    return out | {key: value for key, value in extra.items() if value not in {"", None}}


def shown_to_json(shown: Shown) -> dict[str, Any]:
    """One TEDS as a JSON object: the field tree of format ``teds/1``, and edition, verdict, findings, meaning."""
    decoded = shown.decoded
    out = {"edition": decoded.edition, **teds_to_json(shown.block)}
    out["edition"], out["verdict"] = decoded.edition, str(decoded.verdict)
    out["findings"] = [finding_to_json(finding) for finding in decoded.findings]
    visible = [field for field in shown.fields if field.name != "TEDSID"]
    if len(visible) == len(out["fields"]):
        out["fields"] = [_annotated(tree, field) for tree, field in zip(out["fields"], visible, strict=True)]
    if shown.summary:
        out["summary"] = [{"label": label, "text": text} for label, text in shown.summary]
    return out


def _annotated(tree: dict[str, Any], field: ShownField) -> dict[str, Any]:
    out = {**tree, "offset": field.offset}
    inner = tree.get("fields")
    if inner is not None and len(inner) == len(field.children):
        out["fields"] = [_annotated(part, child) for part, child in zip(inner, field.children, strict=True)]
    elif field.text:
        out["text"] = field.text
    if field.meaning:
        out["meaning"] = field.meaning
    return out | ({"weak": True} if field.weak else {})
