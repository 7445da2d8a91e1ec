"""Message classes as rosidl makes them for Python: keyword arguments alone, every field checked for name and type.

The definitions are those of Jazzy, from rosbags. ``octets`` is the CDR of a message.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
FLOATS = {"float32", "float64"}
WHOLE = {"int8": 7, "uint8": 8, "int32": 31, "uint32": 32}


def _empty(form: tuple[Any, Any]) -> Any:
    kind, rest = form
    if kind.name == "NAME":
        return made(rest)()
    if kind.name == "BASE":
        name = rest[0]
        return {"string": "", "bool": False, "byte": b"\0"}.get(name, 0.0 if name in FLOATS else 0)
    one, count = rest
    return [_empty(one) for _ in range(count)] if kind.name == "ARRAY" else []


def _check(form: tuple[Any, Any], value: Any, where: str) -> None:
    kind, rest = form
    if kind.name == "NAME":
        assert isinstance(value, made(rest)), f"{where}: {value!r} is no {rest}"
    elif kind.name == "BASE":
        _check_base(rest[0], value, where)
    else:
        one, count = rest
        assert isinstance(value, list | tuple), where
        assert kind.name != "ARRAY" or len(value) == count, where
        for item in value:
            _check(one, item, where)


def _check_base(name: str, value: Any, where: str) -> None:
    if name in FLOATS:
        assert type(value) is float, f"{where}: {value!r} is no float"
        assert name == "float64" or not math.isfinite(value) or abs(value) < 3.4028235e38, where
    elif name == "byte":
        assert isinstance(value, bytes), f"{where}: an octet is bytes of length 1, not {value!r}"
        assert len(value) == 1, where
    elif name in WHOLE:
        assert type(value) is int, f"{where}: {value!r} is no int"
        low = 0 if name.startswith("u") else -(2 ** WHOLE[name])
        assert low <= value < 2 ** WHOLE[name], where
    else:
        assert type(value) is {"string": str, "bool": bool}[name], f"{where}: {value!r} is no {name}"


class Message:
    """What all of them can."""

    fields: ClassVar[dict[str, Any]] = {}
    type_name = ""

    def __init__(self, **given: Any) -> None:
        assert given.keys() <= self.fields.keys(), f"{self.type_name} has no {given.keys() - self.fields.keys()}"
        for field, form in self.fields.items():
            setattr(self, field, given.get(field, _empty(form)))

    def __setattr__(self, field: str, value: Any) -> None:
        if field not in self.fields:
            raise AttributeError(f"{self.type_name} has no {field}")
        _check(self.fields[field], value, f"{self.type_name}.{field}")
        object.__setattr__(self, field, value)

    def plain(self) -> Any:
        """The same for rosbags."""
        values = {field: _plain(form, getattr(self, field)) for field, form in self.fields.items()}
        return STORE.types[self.type_name](**values)

    def octets(self) -> bytes:
        """Its CDR."""
        return bytes(STORE.serialize_cdr(self.plain(), self.type_name))


def _plain(form: tuple[Any, Any], value: Any) -> Any:
    kind, rest = form
    if kind.name == "NAME":
        return value.plain()
    if kind.name == "BASE":
        return value[0] if rest[0] == "byte" else value
    one, _ = rest
    if one[0].name == "BASE" and one[1][0] in FLOATS:
        return np.array(value, dtype=one[1][0])
    return [_plain(one, item) for item in value]


_made: dict[str, type[Message]] = {}


def made(name: str) -> type[Message]:
    """The class of ``package/msg/Type``."""
    if name not in _made:
        fields = dict(STORE.fielddefs[name][1])
        _made[name] = type(name.rpartition("/")[2], (Message,), {"fields": fields, "type_name": name})
    return _made[name]
