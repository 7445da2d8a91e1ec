"""Faults in well-formed values: enumerations, limits, swapped octets, weak algorithms."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from math import isinf, isnan
from typing import Final

from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import Field, TimeInstance, Units
from teds_provision.teds.codec.tables import LEVELS, FieldSpec, Table

Find = Callable[..., None]

PROFILE_VERSION: Final = 105
# Octets per sample that these data models require; the other models allow any number in their range.
_MODEL_OCTETS: Final = {1: (4, 4), 2: (8, 8), 0: (0, 8), 7: (8, 8), 5: (9, 255), 6: (9, 255)}
# Field numbers of the TransducerChannel TEDS (docs/teds.md): the sample's form and the sampling modes.
_SAMPLE, _DATA_MODEL, _MODEL_LENGTH, _SIGNIFICANT_BITS = 18, 40, 41, 42
_SAMPLING, _SAMPLING_MODES, _DEFAULT_MODE = 31, 48, 49
_TINY, _HUGE, _PLAUSIBLE = 1e-30, 1e300, (1e-9, 1e12)


def check(table: Table, fields: tuple[Field, ...], find: Find, octets: bytes, framed: bool) -> None:
    """Look at the values of a decoded TEDS and report through ``find``."""
    _values(fields, table.by_type.get, table, find)
    code = table.access_code
    if code in (AccessCode.CHANNEL, AccessCode.CALIBRATION):
        _limits(fields, find)
    if code == AccessCode.CHANNEL:
        for field in fields:
            if field.type == _SAMPLING:
                _sampling(field, find)
            elif field.type == _SAMPLE:
                _sample_form(field, find)
    elif code == AccessCode.SECURITY:
        _security(fields, find, octets, framed)
    elif code == AccessCode.SECURITY_2024:
        for field in fields:
            if field.name == "Level" and isinstance(field.value, str) and field.value not in LEVELS:
                message = f"Level is {str(field.value)!r}; A to E and N are known."
                find("warning", "enumeration", message, field.offset, "Level", "A to E, N", field.value)
    if not table.verified:
        find("note", "unverified", f"The field numbers of {table.name} are not checked against the standard.", None)


def _values(fields: Iterable[Field], spec_of: Callable[[int], FieldSpec | None], table: Table, find: Find) -> None:
    for field in fields:
        value = field.value
        if field.children:
            if value.__class__ is Units:  # spelled as tuples: its interpretation is one of them
                _exponents(field, None, find)
            spec = spec_of(field.type) or table.inner.get(field.type)
            if spec is not None:
                _values(field.children, spec.by_type.get, table, find)
        elif value.__class__ is float:
            if not _TINY <= abs(value) <= _HUGE:  # NaN, infinite, tiny, zero
                _float(field, find)
        elif value.__class__ is int:
            _integer(field, spec_of(field.type) or table.inner.get(field.type), find)
        else:
            look = _LOOK.get(value.__class__)
            if look is not None:
                look(field, spec_of(field.type), find)


def _float(field: Field, find: Find) -> None:
    value = field.value
    if not isinstance(value, float) or value == 0:
        return
    if isnan(value):
        find(
            "warning",
            "not-available",
            f"{field.name} is not available (NaN).",
            field.offset,
            field.name,
            "a number",
            "NaN",
        )
    elif isinf(value):
        find("warning", "infinite", f"{field.name} is infinite.", field.offset, field.name, "a number", value)
    elif len(field.raw) == 4:
        other = struct.unpack("<f", field.raw)[0]
        if _PLAUSIBLE[0] < abs(other) < _PLAUSIBLE[1]:
            message = f"{field.name} = {value:.5g} looks like swapped octets of {other:.5g}."
            find("warning", "swapped", message, field.offset, field.name, f"{other:.5g}", f"{value:.5g}")


def _integer(field: Field, spec: FieldSpec | None, find: Find) -> None:
    if spec is None or not spec.enumeration or not isinstance(field.value, int):
        return
    if field.value in spec.weak:
        name = spec.enumeration[field.value]
        message = f"{field.name} is {name}, which is weak or protects nothing."
        find("warning", "weak", message, field.offset, field.name, "", name)
    elif field.value not in spec.enumeration:
        severity = "error" if spec.enumeration_confidence == "H" and spec.name != "Format" else "warning"
        known = ", ".join(map(str, spec.enumeration))
        message = f"{field.name} is {field.value}; known are {known}."
        find(severity, "enumeration", message, field.offset, field.name, known, field.value)


def _exponents(field: Field, _spec: FieldSpec | None, find: Find) -> None:
    units = field.value
    if not isinstance(units, Units):
        return
    if units.interpretation in (4, 5) and units != Units(units.interpretation, extension=units.extension):
        message = f"{field.name} is digital data or arbitrary and yet has exponents."
        find("warning", "units", message, field.offset, field.name, "no exponents", "some")


def _time(field: Field, _spec: FieldSpec | None, find: Find) -> None:
    if isinstance(field.value, TimeInstance) and field.value.nanoseconds > 999_999_999:
        message = f"{field.name} has {field.value.nanoseconds} nanoseconds, a second or more."
        find("warning", "time", message, field.offset, field.name, "<= 999999999", field.value.nanoseconds)


def _text(field: Field, spec: FieldSpec | None, find: Find) -> None:
    if spec is None or spec.kind != "text":
        return
    if isinstance(field.value, bytes):
        find("warning", "text", f"{field.name} is not UTF-8.", field.offset, field.name, "UTF-8", field.raw[:16].hex())
    elif field.raw[-1:] == b"\0":
        find("warning", "text", f"{field.name} ends in NUL.", field.offset, field.name, "no NUL", "NUL")


_LOOK: Final[dict[type, Callable[[Field, FieldSpec | None, Find], None]]] = {
    Units: _exponents,
    TimeInstance: _time,
    str: _text,
    bytes: _text,
}


def _limits(fields: tuple[Field, ...], find: Find) -> None:
    for field in fields:
        if field.name == "OError" and isinstance(field.value, float) and field.value < 0:
            message = "The uncertainty OError is negative."
            find("warning", "negative", message, field.offset, "OError", ">= 0", field.value)
    by_name = {field.name: field for field in fields}
    low, high = by_name.get("LowLimit"), by_name.get("HiLimit")
    if low is None or high is None or not isinstance(low.value, float) or not isinstance(high.value, float):
        return
    if low.value > high.value:
        message = f"LowLimit {low.value:g} lies above HiLimit {high.value:g}."
        find("error", "limits", message, low.offset, "LowLimit", f"<= {high.value:g}", f"{low.value:g}")


def _sample_form(field: Field, find: Find) -> None:
    parts = {child.type: child.value for child in field.children}
    model, octets, bits = parts.get(_DATA_MODEL), parts.get(_MODEL_LENGTH), parts.get(_SIGNIFICANT_BITS)
    low, high = _MODEL_OCTETS.get(model, (0, 255)) if isinstance(model, int) else (0, 255)
    if not isinstance(octets, int):
        return
    if not low <= octets <= high:
        message = f"Sample has {octets} octets; data model {model!r} takes {low} to {high}."
        find("warning", "sample", message, field.offset, "ModLenth", f"{low} to {high}", octets)
    elif isinstance(bits, int) and model in (0, 3, 5, 6) and bits > 8 * octets:
        message = f"Sample claims {bits} significant bits in {octets} octets."
        find("warning", "sample", message, field.offset, "SigBits", f"<= {8 * octets}", bits)


def _sampling(field: Field, find: Find) -> None:
    """Accept SDefault as one bit of the mask, as some sources have it, or as the number 1 to 5 of a mode."""
    parts = {child.type: child.value for child in field.children}
    modes, default = parts.get(_SAMPLING_MODES), parts.get(_DEFAULT_MODE)
    if not isinstance(modes, int) or not isinstance(default, int) or 1 <= default <= 5:
        return
    if default not in (8, 16) or not default & modes:
        message = f"SDefault {default} is neither a mode from 1 to 5 nor one bit of SampMode {modes:#04x}."
        find("warning", "sampling", message, field.offset, "SDefault", "1 to 5, or a bit of SampMode", default)


def _security(fields: tuple[Field, ...], find: Find, octets: bytes, framed: bool) -> None:
    """Check that a Security TEDS with field 105 is canonical; foreign ones are only shown."""
    if not any(field.type == PROFILE_VERSION for field in fields):
        find("note", "foreign", "This Security TEDS is not of our profile (no field 105).", None)
        return

    try:
        security.decode_block(octets[4:-2] if framed else octets)
    except security.NotCanonicalError as error:
        find("error", "not-canonical", error.message, None, "", "the canonical form", "")
