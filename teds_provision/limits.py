"""The limits of every reader of files in one place, listed in docs/formats.md.

Untrusted input is checked cheaply (octets, tags, brackets, depth) before anything is built from it, so that no file
costs more than 10 s and 400 MB. Every check raises BadDataError that names the excess and the limit. This module is
below every room and imports nothing of ours but the errors, the decoder of JSON, and ``late``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadDataError
from teds_provision.json_decoder import strict_decoder
from teds_provision.lazy import late

if TYPE_CHECKING:
    import tomllib
else:
    tomllib = late("tomllib")  # most files are JSON and do not need it


@dataclass(frozen=True)
class Limits:
    """Largest sizes in octets (or characters), and counts, that are read."""

    teds_file: int = 32 << 20
    """A file of TEDS: binary, hex, Intel HEX, JSON, XML, image."""
    teds_of_a_file: int = 2000
    """255 channels with six TEDS each, and those of the node, are 1,540."""
    json_values: int = 2_000_000
    json_depth: int = 32
    xml_elements: int = 200_000
    xml_attributes: int = 400_000
    xml_depth: int = 32
    text_file: int = 1 << 20
    """A profile, a calibration, a sheet of requirements (TOML, CSV, JSON)."""
    certificate: int = 8 << 20
    """A calibration certificate (DCC), with the documents that it embeds."""
    certificate_tables: int = 200
    certificate_values: int = 10_000
    certificate_pairs: int = 1000
    """Pairs of columns of one table that could be indication and reference value."""
    toml_parts: int = 32
    toml_depth: int = 16
    toml_keys: int = 20_000
    integer_digits: int = 1000
    hex_records: int = 2_500_000
    hex_stretches: int = 2000
    unit: int = 64
    expression: int = 1000
    terms: int = 16


LIMITS: Final = Limits()

# Possessive quantifiers and the lookbehind keep the search linear for any input.
_PART: Final = r"(?:[A-Za-z0-9_-]++|'')"
_LONG_KEY: Final = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{LIMITS.toml_parts}}}")
_LONG_INTEGER: Final = re.compile(rf"(?<![A-Za-z0-9_-])[+-]?(?:0[xob])?[0-9a-fA-F_]{{{LIMITS.integer_digits + 1}}}")
_STRINGS: Final = re.compile(r"""\"(?:[^"\\]|\\.)*+\"|'[^'\n]*+'|\#[^\n]*+""")


def check_size(octets: int, limit: int, what: str) -> None:
    """Raise BadDataError if something has more octets (or characters) than the limit allows."""
    if octets > limit:
        raise BadDataError(f"{_upper(what)} has {octets} octets; at most {limit} are read.")


def check_count(count: int, limit: int, what: str) -> None:
    """Raise BadDataError if there are more of something than the limit allows."""
    if count > limit:
        raise BadDataError(f"There are {count} {what} here; at most {limit} are read.")


def load_json(text: str | bytes, what: str, *, octets: int = LIMITS.teds_file, file: str = "") -> Any:
    """Parse untrusted JSON: bounded in size, values, depth and digits, each name once in its object.

    ``what`` names it in errors, with its article: "the image"; with ``file`` they name file and line. Raises
    BadDataError.
    """
    check_size(len(text), octets, what)
    if not text.strip():
        raise BadDataError(f"{f'{file}:1: ' * bool(file)}{_upper(what)} is empty.")
    if isinstance(text, str):
        opened, values = text.count("[") + text.count("{"), text.count(",")
    else:
        opened, values = text.count(b"[") + text.count(b"{"), text.count(b",")
    check_count(opened + values, LIMITS.json_values, f"values in {what}")
    try:
        value = _parsed(text)
    except RecursionError as error:
        raise BadDataError(f"{file}:1: " * bool(file) + f"{_upper(what)} is nested too deeply.") from error
    except json.JSONDecodeError as error:
        if file:
            raise BadDataError(f"{file}:{error.lineno}: this is not JSON: {error.msg}.") from error
        raise BadDataError(f"{_upper(what)} is not JSON: line {error.lineno}: {error.msg}.") from error
    except UnicodeDecodeError as error:
        raise BadDataError(f"{_upper(what)} is not text: it is binary, or not UTF-8.") from error
    except ValueError as error:
        raise BadDataError(f"{file}:1: " * bool(file) + f"{_upper(what)} cannot be read: {error}.") from error
    if opened > LIMITS.json_depth:  # with no more brackets than permitted levels, nesting cannot be too deep
        check_depth(value, LIMITS.json_depth, what)
    return value


def check_depth(value: object, limit: int, what: str) -> None:
    """Raise BadDataError if lists and tables nest deeper than ``limit``; walks level by level, never deeper."""
    level: list[object] = [value]
    for _ in range(limit + 1):
        inside: list[object] = []
        for container in level:
            parts: Iterable[object] = container.values() if isinstance(container, dict) else container  # type: ignore[assignment]
            if isinstance(container, dict | list):
                inside += [part for part in parts if isinstance(part, dict | list)]
        if not inside:
            return
        level = inside
    raise BadDataError(f"{_upper(what)} nests deeper than {limit} levels.")


def check_toml(text: str, file: str) -> None:
    """Raise BadDataError, with the line, for TOML whose keys or integers would take long to read."""
    check_size(len(text.encode("utf-8", "surrogatepass")), LIMITS.text_file, file)
    keys = text.count("=")
    plain = _STRINGS.sub(lambda found: "''" + "\n" * found[0].count("\n"), text)
    for pattern, why in (
        (_LONG_KEY, f"a key of more than {LIMITS.toml_parts} parts"),
        (_LONG_INTEGER, f"an integer of more than {LIMITS.integer_digits} digits"),
    ):
        found = pattern.search(plain)
        if found is not None:
            raise BadDataError(f"{file}:{plain.count(chr(10), 0, found.start()) + 1}: {why}.")
    if keys > LIMITS.toml_keys:
        raise BadDataError(f"{file}: there are {keys} keys; at most {LIMITS.toml_keys} are read.")


def load_toml(text: str, file: str) -> dict[str, Any]:
    """Parse untrusted TOML, bounded in size, keys, depth and digits; raises BadDataError, ``file`` before it."""
    check_toml(text, file)
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a plain ValueError: an integer of more than 4,300 digits
        raise BadDataError(f"{file} is not valid TOML: {error}.") from error
    check_depth(data, LIMITS.toml_depth, file)
    return data


def check_xml(text: bytes, what: str) -> None:
    """Raise BadDataError for XML with more elements or attributes than are read.

    Counted in the octets: expat takes no encoding in which ``<`` and ``=`` are other octets than in ASCII.
    """
    check_count(text.count(b"<"), LIMITS.xml_elements, f"tags in {what}")
    check_count(text.count(b"="), LIMITS.xml_attributes, f"attributes in {what}")


def whole_number(text: str, what: str) -> int:
    """Return the integer of decimal digits; raises BadDataError for any other text and for too many digits."""
    digits = text.strip()
    if len(digits) > LIMITS.integer_digits or not re.fullmatch(r"[+-]?[0-9]+", digits):
        shown = digits if len(digits) <= 40 else f"{digits[:12]}… ({len(digits)} characters)"
        raise BadDataError(f"{_upper(what)} is no whole number: {shown!r}.")
    return int(digits)


def _parsed(text: str | bytes) -> Any:
    """Parse as ``json.loads`` does, but with one decoder: json.loads would make another for every document."""
    if isinstance(text, str) and text.startswith("\ufeff"):
        return json.loads(text)  # json.loads raises the error with its position
    return _decoder().decode(
        text if isinstance(text, str) else text.decode(json.detect_encoding(text), "surrogatepass")
    )


@cache
def _decoder() -> json.JSONDecoder:
    return strict_decoder(constants=True, digits=LIMITS.integer_digits)


def _upper(what: str) -> str:
    return what[:1].upper() + what[1:]
