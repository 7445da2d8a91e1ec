"""A CANopen device as a wrapped sensor: its channels from the EDS or DCF (python-canopen).

Channels are the objects that are in a transmit PDO by default, and those that could be and are only read.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.files import read_limited
from teds_provision.lazy import how_to_install
from teds_provision.node.wrapped.description import DEFAULT_PERIOD, WrappedChannel, WrappedSensor, written_unit
from teds_provision.teds.origin import Origin

if TYPE_CHECKING:
    from canopen import ObjectDictionary
    from canopen.objectdictionary import ODVariable

MOST_OCTETS: Final = 8 << 20
_FIRST_OBJECT: Final = 0x2000
"""Objects below this one describe the communication (CiA 301)."""
_COMMUNICATION, _MAPPING = 0x1800, 0x1A00
_MOST_PDOS: Final = 512
_MOST_MAPPED: Final = 64
_EVENT_TIMER: Final = 5
_BOOLEAN = 1
_SIGNED: Final = {2: 8, 3: 16, 4: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
_UNSIGNED: Final = {_BOOLEAN: 1, 5: 8, 6: 16, 7: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
_FLOATS: Final = {8: 32, 0x11: 64}
"""Bits of the data types (CiA 301, table 44)."""


def load(path: Path, node_id: int = 1) -> tuple[bytes, ObjectDictionary]:
    """Read an EDS or DCF: its octets, and its objects with ``$NODEID`` replaced; raises NotFoundError, BadDataError."""
    octets = read_limited(path, MOST_OCTETS, "EDS file")
    try:
        import canopen
    except ImportError as error:
        raise NotFoundError("An EDS file needs the package canopen.", hint=how_to_install("bench")) from error
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # its log lines repeat the reasons in our errors
    try:
        objects = canopen.import_od(str(path), node_id=node_id)
    except Exception as error:  # the parser raises configparser's errors, ValueError, KeyError and its own
        reason = str(error).strip().splitlines()[0][:200] if str(error).strip() else type(error).__name__
        raise BadDataError(f"{path} is not an EDS file that can be read: {reason}", hint="Check the file.") from error
    return octets, objects


def read(path: Path) -> WrappedSensor:
    """Describe the device of an EDS or DCF; raises NotFoundError and BadDataError."""
    octets, objects = load(path)
    return described(path, octets, objects)


def described(path: Path, octets: bytes, objects: ObjectDictionary) -> WrappedSensor:
    """Return the sensor of an object dictionary."""
    name = " ".join((objects.device_information.product_name or path.stem).split())
    channels = tuple(_channels(objects, _sent_objects(objects)))
    if not channels:
        raise BadDataError(
            f"{path} has no object that is sent in a PDO, or could be and is only read.",
            hint="A sensor has objects with PDOMapping=1 and AccessType=ro.",
        )
    origin = Origin("eds", name[:60], hashlib.sha256(octets).hexdigest())
    return WrappedSensor(origin, name, channels, path.name)


def measured_objects(objects: ObjectDictionary) -> Iterator[ODVariable]:
    """Yield the objects that become channels, by index and sub-index."""
    import canopen

    sent = _sent_objects(objects)
    for entry in sorted(objects.values(), key=lambda entry: entry.index):
        if entry.index < _FIRST_OBJECT:
            continue
        parts = [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else list(entry.values())
        for part in sorted(parts, key=lambda part: part.subindex):
            readable = part.pdo_mappable and part.access_type in ("ro", "rwr")
            if _bits(part) and (readable or (part.index, part.subindex) in sent):
                yield part


def _bits(variable: ODVariable) -> int:
    kind = variable.data_type or 0
    return _SIGNED.get(kind) or _UNSIGNED.get(kind) or _FLOATS.get(kind) or 0


def _channels(objects: ObjectDictionary, sent: dict[tuple[int, int], float]) -> Iterator[WrappedChannel]:
    found = list(measured_objects(objects))
    names = [_name(variable, found) for variable in found]
    for variable, name in zip(found, names, strict=True):
        unit, note = written_unit(variable.unit or "")
        period = sent.get((variable.index, variable.subindex))
        notes = [note] if note else []
        if not period:
            notes.append(f"the file states no event timer for it, so {DEFAULT_PERIOD * 1000:g} ms is assumed")
        is_float = variable.data_type in _FLOATS
        scale = float(variable.factor or 1)
        ends = [end * scale if end is not None else None for end in (variable.min, variable.max)]
        low, high = (ends[1], ends[0]) if scale < 0 else (ends[0], ends[1])
        yield WrappedChannel(
            name,
            unit,
            scale,
            0.0,
            _bits(variable),
            variable.data_type in _SIGNED,
            is_float,
            low,
            high,
            period or DEFAULT_PERIOD,
            {int(raw): str(text) for raw, text in variable.value_descriptions.items()},
            " ".join((variable.description or "").split()),
            "; ".join(notes),
        )


def _name(variable: ODVariable, others: list[ODVariable]) -> str:
    """Return the object's own name; with its parent's, or its index, if several objects have the same one."""
    if sum(other.name == variable.name for other in others) == 1:
        return str(variable.name)
    if sum(other.qualname == variable.qualname for other in others) == 1:
        return str(variable.qualname)
    return f"{variable.qualname} {variable.index:04X}.{variable.subindex}"


def _sent_objects(objects: ObjectDictionary) -> dict[tuple[int, int], float]:
    """Return the objects that are in a transmit PDO by default, with its event timer in seconds; 0 if none is set."""
    sent: dict[tuple[int, int], float] = {}
    for number in range(_MOST_PDOS):
        if _MAPPING + number not in objects:
            continue  # most numbers: each look at one of their 64 places would take as long as at one that exists
        timer = _default(objects, _COMMUNICATION + number, _EVENT_TIMER)
        for place in range(1, _MOST_MAPPED + 1):
            mapped = _default(objects, _MAPPING + number, place)
            if mapped:
                sent.setdefault((mapped >> 16, mapped >> 8 & 0xFF), timer / 1000)
    return sent


def _default(objects: ObjectDictionary, index: int, subindex: int) -> int:
    variable = objects.get_variable(index, subindex)
    value = variable.default if variable is not None else None
    if variable is not None and isinstance(getattr(variable, "value", None), int):
        value = variable.value  # a DCF also has the configured value
    return value if isinstance(value, int) else 0
