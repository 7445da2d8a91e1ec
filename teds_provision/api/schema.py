"""From a type to its JSON schema (2020-12, as OpenAPI 3.1 takes it), and from JSON to a value of that type.

A value is checked against the schema itself, so that a body is refused exactly if the published description forbids it.
The subset is what the types of this room need: type, enum, const, pattern, minLength, maxLength, minimum, maximum,
minItems, items, properties, required, additionalProperties, anyOf, oneOf.
"""

from __future__ import annotations

import json
import math
import re
import types
from dataclasses import MISSING, fields, is_dataclass
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NotRequired,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from teds_provision.json_decoder import DuplicateNameError, strict_decoder
from teds_provision.shapes.metadata import Meta

Schema = dict[str, Any]
Shape = TypeVar("Shape")
"""A dataclass of ``bodies``."""


class BadRequestError(ValueError):
    """A body that the description forbids: what is wrong, and what to do."""

    def __init__(self, message: str, hint: str = "See /api/v1/openapi.json.") -> None:
        super().__init__(message)
        self.message, self.hint = message, hint


_PLAIN: Final = {
    str: "string",
    bytes: "string",
    int: "integer",
    float: "number",
    bool: "boolean",
    dict: "object",
    Any: None,
}


def schema_of(shape: Any, named: dict[str, Schema]) -> Schema:
    """Return the schema of a type. Typed dictionaries become references; their own schemas are put into ``named``.

    ``VerdictMembers``, the typed dictionary of a shape that is a class besides, is ``Verdict`` there.
    """
    if is_typeddict(shape):
        name = shape.__name__.removesuffix("Members")
        if name not in named:
            named[name] = {}  # registered first, in case the type refers to itself
            hints = get_type_hints(shape, include_extras=True)
            named[name] = {
                "type": "object",
                "properties": {name: schema_of(hint, named) for name, hint in hints.items()},
                "required": [name for name, hint in hints.items() if get_origin(hint) is not NotRequired],
            }
        return {"$ref": f"#/components/schemas/{name}"}
    if is_dataclass(shape):
        hints = get_type_hints(shape, include_extras=True)
        required = [
            field.name for field in fields(shape) if field.default is MISSING and field.default_factory is MISSING
        ]
        found: Schema = {
            "type": "object",
            "properties": {field.name: schema_of(hints[field.name], named) for field in fields(shape)},
            "additionalProperties": False,
        }
        rule: Meta = getattr(shape, "RULE", Meta())
        return found | ({"required": required} if required else {}) | rule.facts
    origin, inner = get_origin(shape), get_args(shape)
    if origin is Annotated:
        facts: Schema = {}
        for fact in inner[1:]:
            facts |= fact.facts if isinstance(fact, Meta) else {}
        return schema_of(inner[0], named) | facts
    if origin is NotRequired:
        return schema_of(inner[0], named)
    if origin is Literal:
        return {"type": "string", "enum": list(inner)}
    if origin in (Union, types.UnionType):
        [kind] = [option for option in inner if option is not type(None)]
        found = schema_of(kind, named)
        if "type" not in found:
            return {"anyOf": [found, {"type": "null"}]}
        either: Schema = {**found, "type": [found["type"], "null"]}
        return either | ({"enum": [*found["enum"], None]} if "enum" in found else {})
    if origin in (list, tuple):
        return {"type": "array", "items": schema_of(inner[0], named)}
    kind = _PLAIN[origin or shape]
    return {} if kind is None else {"type": kind}


def read(shape: type[Shape], octets: bytes) -> Shape:
    """Return a body of that shape; an empty one counts as ``{}``. A null member counts as absent.

    Raises BadRequestError for what is not JSON (RFC 8259: UTF-8 alone, no byte order mark, no NaN, no half of a
    surrogate pair), for two members of one name (section 4: readers differ on which one they take, so a check in front
    of us might see the other one), and for what the schema forbids.
    """
    try:
        text = octets.decode()
        if text.startswith("\ufeff"):
            raise ValueError("a byte order mark is no JSON")
        value = _DECODER.decode(text) if text else {}
        json.dumps(value, ensure_ascii=False).encode()
    except DuplicateNameError as error:
        raise BadRequestError(f"Member {error.name[:64]!r} appears twice.", "Send each member once.") from error
    except (ValueError, RecursionError) as error:
        raise BadRequestError("The request body is not valid JSON.", "") from error
    if not isinstance(value, dict):
        raise BadRequestError("The request body must be a JSON object.", "")
    found = fit(schema_of(shape, {}), value)
    return shape(**{name: member for name, member in found.items() if member is not None})


_DECODER: Final = strict_decoder()


def fit(schema: Schema, value: Any, where: str = "") -> Any:
    """Return the value as its schema has it (1.0 is the integer 1, 1 the number 1.0); BadRequestError if forbidden.

    ``where`` names the value in the message: ``uuids[2]``.
    """
    kinds = schema.get("type", [])
    kind = _kind_of(value, kinds if isinstance(kinds, list) else [kinds])
    if "enum" in schema and value not in schema["enum"]:
        known = ", ".join(str(allowed) for allowed in schema["enum"] if allowed is not None)
        raise BadRequestError(f"{where!r} must be one of {known}, not {_shown(value)}.")
    if kind == "object":
        return _object(schema, value, where)
    if kind == "array":
        if len(value) < schema.get("minItems", 0):
            raise BadRequestError(f"{where!r} must have at least {schema['minItems']} items.")
        return [fit(schema.get("items", {}), element, f"{where}[{number}]") for number, element in enumerate(value)]
    if kind in ("integer", "number"):
        least, most = schema.get("minimum", -math.inf), schema.get("maximum", math.inf)
        if not least <= value <= most:
            raise BadRequestError(f"{where!r} must be between {least:g} and {most:g}, not {_shown(value)}.")
        return int(value) if kind == "integer" else float(value)
    if kind == "string" and not schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", math.inf):
        least, most = schema.get("minLength", 0), schema.get("maxLength", math.inf)
        raise BadRequestError(f"{where!r} must have {least} to {most} characters, not {len(value)}.")
    if kind == "string" and not re.search(schema.get("pattern", "").replace("$", r"\Z"), value):
        raise BadRequestError(f"{where!r} must match {schema['pattern']}, unlike {_shown(value)}.")
    if kind is None and kinds:
        wanted = " or ".join(kinds) if isinstance(kinds, list) else kinds
        raise BadRequestError(f"{where!r} must be of type {wanted}, not {_shown(value)}.")
    return value


def _kind_of(value: Any, kinds: list[str]) -> str | None:
    """Return which of these types a value has; in JSON Schema 1.0 is an integer, and true is no number."""
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    there = {
        "null": value is None,
        "boolean": isinstance(value, bool),
        "string": isinstance(value, str),
        "array": isinstance(value, list),
        "object": isinstance(value, dict),
        "integer": whole and not isinstance(value, bool),
        "number": isinstance(value, int | float) and not isinstance(value, bool),
    }
    return next((kind for kind in kinds if there[kind]), None)


def _object(schema: Schema, value: dict[str, Any], where: str) -> dict[str, Any]:
    properties = schema.get("properties", {})
    if schema.get("additionalProperties") is False:
        for name in value:
            if name not in properties:
                raise BadRequestError(f"Unknown member {name[:64]!r}.")
    for name in schema.get("required", ()):
        if name not in value:
            raise BadRequestError(f"Member {name!r} is missing.")
    found = {name: fit(properties.get(name, {}), member, name) for name, member in value.items()}
    for choice in ("anyOf", "oneOf"):
        fitting = sum(_fits(option, value) for option in schema.get(choice, ()))
        if choice in schema and (not fitting or (choice == "oneOf" and fitting > 1)):
            raise BadRequestError(schema["description"])
    return found


def _fits(schema: Schema, value: Any) -> bool:
    try:
        fit({"type": "object", **schema}, value)
    except BadRequestError:
        return False
    return True


def _shown(value: Any) -> str:
    return json.dumps(value)[:40]
