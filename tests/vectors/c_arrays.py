"""The vectors as C: a header with one type for each kind of object, and a file of constants for each JSON file.

    python -m tests.vectors.c_arrays FOLDER

Every JSON object becomes a ``struct``, every list a pointer with its ``_count``, every string of hex ``teds_octets``.
What an object lacks, or what is null, is 0, false or NULL; empty octets are no NULL. The shapes are read from the
files: a member is hex where all its values are. C11, nothing is included but stdbool, stddef and stdint.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

PROFILE: Final = Path(__file__).parent / "profile"
LEFT_OUT: Final = ("handover", "plant_kat", "firmware_kat")
"""The first two are not for nodes; members of the third have several types, so tests read the JSON."""
HEADER: Final = "teds_vectors.h"
_KEYWORDS: Final = frozenset(
    re.findall(
        r"\w+",
        "auto break case char const continue default do double else enum extern float for goto if inline int long "
        "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
        "bool",
    )
)
_A_ROW: Final = 24
_HEX: Final = re.compile("([0-9a-f]{2})*")
_TRANSCRIPTS: Final = ("rotation", "sessions", "refusals", "commit", "reset", "repetition")
"""These files share their types, so that one harness plays them all."""
_SCALARS: Final = {
    "bool": "bool",
    "int": "int64_t",
    "big": "uint64_t",
    "float": "double",
    "hex": "teds_octets",
    "text": "const char *",
}


_NOTHING: Final = {"object": "NULL", "text": "NULL", "hex": "{NULL, 0}"}


def _text(value: Any) -> str:
    return json.dumps(value if isinstance(value, str) else json.dumps(value), ensure_ascii=False)


_SAID: Final[dict[str, Callable[[Any], str]]] = {
    "": "INT64_C({})".format,
    "int": "INT64_C({})".format,
    "big": "UINT64_C({})".format,
    "bool": lambda value: "true" if value else "false",
    "float": lambda value: repr(float(value)),
    "text": _text,
}
"""Initializers of values that point to nothing; kind "" stands for no value at all."""


@dataclass
class Shape:
    """What stands at one place of a file, in all entries: ``kind`` of the value, an object's members, a list's item."""

    kind: str = ""
    members: dict[str, Shape] = field(default_factory=dict)
    item: Shape | None = None

    def take(self, value: Any) -> None:
        """Widen the shape by one more value."""
        kind = _kind(value)
        if kind == "null":
            return
        self.kind = kind if not self.kind else _wider(self.kind, kind)
        if isinstance(value, dict):
            for name, inner in value.items():
                self.members.setdefault(name, Shape()).take(inner)
        elif isinstance(value, list):
            self.item = self.item or Shape()
            for inner in value:
                self.item.take(inner)


def _kind(value: Any) -> str:
    match value:
        case None:
            return "null"
        case bool():
            return "bool"
        case int():
            return "int" if value < 1 << 63 else "big"
        case float():
            return "float"
        case str():
            return "hex" if _HEX.fullmatch(value) else "text"
        case list():
            return "list"
        case _:
            return "object"


def _wider(first: str, other: str) -> str:
    """Return the kind that holds both; numbers and objects in the place of one another are told as JSON text."""
    if first == other:
        return first
    numbers = {frozenset(("int", "float")): "float", frozenset(("int", "big")): "big"}
    return numbers.get(frozenset((first, other)), "text")


def c_name(text: str) -> str:
    """Return a member's name in C."""
    name = re.sub(r"\W", "_", text)
    return f"n{name}" if name[:1].isdigit() else f"{name}_" if name in _KEYWORDS else name


def declarations(name: str, shape: Shape) -> Iterator[str]:
    """Yield the types of a file, inner ones first."""
    if shape.item is not None:
        yield from declarations(name, shape.item)
    for member, inner in shape.members.items():
        yield from declarations(f"{name}_{c_name(member)}", inner)
    if shape.kind == "object":
        rows = [row for member, inner in shape.members.items() for row in _member(name, member, inner)]
        yield f"struct {name} {{\n" + "".join(f"    {row};\n" for row in rows) + "};\n"


def _member(of: str, member: str, shape: Shape) -> list[str]:
    name = c_name(member)
    if shape.kind == "list":
        inner = _type(f"{of}_{name}", shape.item or Shape("int"))
        return [f"{inner}const *{name}" if inner.endswith("*") else f"const {inner}*{name}", f"size_t {name}_count"]
    return [f"{_type(f'{of}_{name}', shape, pointer=True)}{name}"]


def _type(name: str, shape: Shape, *, pointer: bool = False) -> str:
    if shape.kind == "object":
        return f"const struct {name} *" if pointer else f"struct {name} "
    if shape.kind == "list":
        raise ValueError(f"{name}: a list of lists has no type here")
    c_type = _SCALARS.get(shape.kind, "int64_t")
    return c_type if c_type.endswith("*") else f"{c_type} "


class Constants:
    """The constants of one file, each before it is used."""

    def __init__(self) -> None:
        self.rows: list[str] = []
        self._octets: dict[str, str] = {}
        self._number = 0

    def value(self, name: str, shape: Shape, value: Any) -> str:
        """Return the initializer of a value; what it points to is added to ``rows``."""
        if value is None:
            return _NOTHING.get(shape.kind, "0")
        if shape.kind == "hex":
            return self._of_octets(value)
        if shape.kind == "object":
            return f"{{{', '.join(self._members(name, shape, value))}}}"
        return _SAID[shape.kind](value)

    def _members(self, name: str, shape: Shape, value: dict[str, Any]) -> Iterator[str]:
        for member, inner in shape.members.items():
            if member not in value or value[member] is None:
                continue
            c_member, place = c_name(member), f"{name}_{c_name(member)}"
            if inner.kind == "list":
                items = self._list(place, inner, value[member])
                yield f".{c_member} = {items}, .{c_member}_count = {len(value[member])}"
            elif inner.kind == "object":
                yield f".{c_member} = &{self._constant(place, inner, value[member])}"
            else:
                yield f".{c_member} = {self.value(place, inner, value[member])}"

    def _list(self, name: str, shape: Shape, values: list[Any]) -> str:
        if not values:
            return "NULL"
        item = shape.item or Shape("int")
        items = ",\n    ".join(self.value(name, item, value) for value in values)
        kind = _type(name, item)
        declared = f"{kind}const " if kind.endswith("*") else f"const {kind}"
        return self._add(f"static {declared}{{name}}[] = {{{{\n    {{told}}\n}}}};", items)

    def _constant(self, name: str, shape: Shape, value: dict[str, Any]) -> str:
        return self._add(f"static const struct {name} {{name}} = {{told}};", self.value(name, shape, value))

    def _of_octets(self, text: str) -> str:
        if text not in self._octets:
            octets = [f"0x{text[at : at + 2]}" for at in range(0, len(text), 2)] or ["0"]
            rows = ",\n    ".join(", ".join(octets[at : at + _A_ROW]) for at in range(0, len(octets), _A_ROW))
            self._octets[text] = self._add("static const uint8_t {name}[] = {{\n    {told}\n}};", rows)
        return f"{{{self._octets[text]}, {len(text) // 2}}}"

    def _add(self, form: str, message: str) -> str:
        self._number += 1
        name = f"v{self._number}"
        self.rows.append(form.format(name=name, told=message))
        return name


def convert(names: list[Path]) -> dict[str, str]:
    """Return every C file by its name."""
    header = ["/* Made by python -m tests.vectors.c_arrays. See docs/vectors.md. */", "#ifndef TEDS_VECTORS_H"]
    header += ["#define TEDS_VECTORS_H", "#include <stdbool.h>", "#include <stddef.h>", "#include <stdint.h>", ""]
    header += ["typedef struct {\n    const uint8_t *octets;\n    size_t length;\n} teds_octets;\n"]
    contents = {path.stem: _content(path) for path in names}
    types: dict[str, Shape] = {}
    for stem, content in contents.items():
        types.setdefault(_type_of(stem), Shape()).take(content)
    for name, shape in types.items():
        header += declarations(name, shape)
    files: dict[str, str] = {}
    for stem, content in contents.items():
        name, kind, constants = f"teds_vectors_{c_name(stem)}", _type_of(stem), Constants()
        whole = constants.value(kind, types[kind], content)
        header.append(f"extern const struct {kind} {name};")
        rows = [f'#include "{HEADER}"\n', *constants.rows, f"const struct {kind} {name} = {whole};", ""]
        files[f"{name}.c"] = "\n".join(rows)
    return files | {HEADER: "\n".join([*header, "#endif", ""])}


def _type_of(stem: str) -> str:
    return "teds_transcripts" if stem in _TRANSCRIPTS else f"teds_{c_name(stem)}"


def _content(path: Path) -> Any:
    """Return a file, its keys as a list in the place of an object whose members differ from file to file."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(content.get("keys"), dict) and all(isinstance(key, dict) for key in content["keys"].values()):
        content["keys"] = [{"name": name, **key} for name, key in content["keys"].items()]
    return content


def main(arguments: list[str]) -> int:
    """Write the files into a folder; return the exit code."""
    if len(arguments) != 1:
        print("usage: python -m tests.vectors.c_arrays FOLDER", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    files = convert([path for path in sorted(PROFILE.glob("*.json")) if path.stem not in LEFT_OUT])
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    print(f"{folder}: {len(files)} files, {sum(map(len, files.values())) >> 10} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
