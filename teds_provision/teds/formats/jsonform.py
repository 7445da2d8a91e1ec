"""TEDS as JSON: the field tree with names (format ``teds/1``); what other keys a file has is for people."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count, load_json
from teds_provision.teds.codec.model import TimeInstance, Units
from teds_provision.teds.formats.tree import (
    MAX_DEPTH,
    EntryValue,
    Kind,
    Tree,
    TreeEntry,
    from_tree,
    to_tree,
    units_from_parts,
    units_to_parts,
)
from teds_provision.teds.image import TedsBlock

FORMAT: Final = "teds/1"
_HEAD: Final = {
    "channel": 0xFFFF,
    "access_code": 0xFF,
    "family": 0xFF,
    "subfamily": 0xFF,
    "version": 0xFF,
    "width": 0xFF,
}
_WORDS: Final = {"NaN": math.nan, "INF": math.inf, "-INF": -math.inf}


def write_json(blocks: Sequence[TedsBlock]) -> str:
    """Write blocks as one JSON document; nothing is lost."""
    return json.dumps({"format": FORMAT, "teds": [teds_to_json(block) for block in blocks]}, indent=1) + "\n"


def read_json(text: str | bytes) -> list[TedsBlock]:
    """Read a JSON document of this format; raises BadDataError naming what is wrong."""
    data = load_json(text, "the JSON document")
    if not isinstance(data, dict) or data.get("format") != FORMAT or not isinstance(data.get("teds"), list):
        raise BadDataError(f'This JSON contains no TEDS: "format" is not "{FORMAT}" or "teds" is not a list.')
    check_count(len(data["teds"]), LIMITS.teds_of_a_file, "TEDS")
    return [_block(entry, number) for number, entry in enumerate(data["teds"], 1)]


def teds_to_json(block: TedsBlock) -> dict[str, Any]:
    """Return one TEDS as a JSON object."""
    tree = to_tree(block)
    head = {name: getattr(tree, name) for name in _HEAD}
    out: dict[str, Any] = {**head, "edition": tree.edition, "framed": tree.framed, "name": tree.name}
    out["fields"] = [entry_to_json(entry) for entry in tree.entries]
    if tree.octets is not None:
        out["octets"] = tree.octets.hex()
    return {key: value for key, value in out.items() if value is not None or key in {"channel", "access_code"}}


def entry_to_json(entry: TreeEntry) -> dict[str, Any]:
    """Return one field as a JSON object: type, name, kind, and value or fields."""
    out: dict[str, Any] = {} if entry.type is None else {"type": entry.type}
    out |= {"name": entry.name, "kind": entry.kind}
    if entry.kind == "fields":
        return out | {"fields": [entry_to_json(child) for child in entry.children]}
    return out | {"value": value_to_json(entry.value)}


def value_to_json(value: object) -> Any:
    """Return a field's value for JSON: octets as hex digits, non-finite numbers as the texts NaN, INF, -INF."""
    if isinstance(value, float):
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Units):
        return units_to_parts(value)
    if isinstance(value, TimeInstance):
        sign = {"negative": True} if value.negative else {}
        return {"seconds": value.seconds, "nanoseconds": value.nanoseconds, **sign}
    return [value_to_json(part) for part in value] if isinstance(value, tuple) else value


def _block(entry: object, number: int) -> TedsBlock:
    where = f"TEDS {number}"
    if not isinstance(entry, Mapping):
        raise BadDataError(f"{where} is not an object.")
    head = {name: _number(entry.get(name), limit, f"{name} of {where}") for name, limit in _HEAD.items()}
    octets = entry.get("octets")
    fields = entry.get("fields", [])
    if not isinstance(fields, list):
        raise BadDataError(f'"fields" of {where} is not a list.')
    edition = entry.get("edition", 2007)
    if edition not in (2007, 2024, None):
        raise BadDataError(f"{where} names the edition {edition!r}; 2007 and 2024 are known.")
    return from_tree(
        Tree(
            **head,
            edition=edition,
            framed=entry.get("framed", True) is not False,
            entries=() if octets is not None else tuple(_entry(field, where, 0) for field in fields),
            octets=None if octets is None else _hex(octets, f"octets of {where}"),
        )
    )


def _number(value: object, limit: int, what: str) -> int | None:
    if value is None:
        return None
    if type(value) is not int or not 0 <= value <= limit:
        raise BadDataError(f"The {what} is not a number from 0 to {limit}.")
    return value


def _hex(value: object, what: str) -> bytes:
    try:
        return bytes.fromhex(value if isinstance(value, str) else "?")
    except ValueError as error:
        raise BadDataError(f"The {what} are not hex digits.") from error


def _entry(data: object, where: str, depth: int) -> TreeEntry:
    if not isinstance(data, Mapping) or not isinstance(data.get("name", ""), str) or depth > MAX_DEPTH:
        raise BadDataError(f"A field of {where} is not an object with a name, or nests too deep.")
    number, name = _number(data.get("type"), 0xFF, f"type of a field of {where}"), data.get("name", "")
    where = f"{where}, {name or f'type {number}'}"
    if "fields" in data:
        inner = data["fields"] if isinstance(data["fields"], list) else None
        if inner is None:
            raise BadDataError(f'"fields" of {where} is not a list.')
        return TreeEntry(number, name, "fields", children=tuple(_entry(field, where, depth + 1) for field in inner))
    kind, value = _value(data.get("kind"), data.get("value"), where)
    return TreeEntry(number, name, kind, value)


def _value(kind: object, value: object, where: str) -> tuple[Kind, EntryValue]:
    match kind, value:
        case "octets", _:
            return "octets", _hex(value, f"octets of {where}")
        case "units", Mapping():
            return "units", units_from_parts(value)
        case "time", Mapping():
            seconds, nanoseconds = (
                _number(value.get(part, 0), (1 << 48) - 1, f"{part} of {where}") or 0
                for part in ("seconds", "nanoseconds")
            )
            return "time", TimeInstance(seconds, nanoseconds, value.get("negative") is True)
        case "integers", list() if set(map(type, value)) <= {int}:
            return "integers", tuple(value)
        case "numbers", list():
            return "numbers", tuple(_float(part, where) for part in value)
        case "number", _:
            return "number", _float(value, where)
        case "integer" | None, int() if type(value) is int:
            return "integer", value
        case "text" | None, str():
            return "text", value
    raise BadDataError(f"The value of {where} is no {str(kind or 'value')[:40]}: {str(value)[:60]!r}.")


def _float(value: object, where: str) -> float:
    if isinstance(value, str) and value in _WORDS:
        return _WORDS[value]
    if type(value) not in {int, float} or not isinstance(value, int | float):
        raise BadDataError(f"{where} holds {value!r} where a number is asked.")
    try:
        return float(value)
    except OverflowError as error:
        raise BadDataError(f"{where} holds a number that is too large.") from error
