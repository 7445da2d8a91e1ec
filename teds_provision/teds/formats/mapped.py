"""A lab's own datasheet XML read as a profile, by a small file with the place and the unit of each key.

The mapping is TOML (docs/formats.md, "A datasheet XML of your own"): ``channel`` is the path of the elements that are
channels, ``[keys]`` and ``[channel-keys]`` name a place for each key of a profile, ``[values]`` and
``[channel-values]`` give values that the XML lacks. A place is a path of element names below the root (the channel),
with ``@attribute`` at its end or alone. The result is the text of a profile, checked like any other.

Read with defusedxml: no DTD, no entities, nothing external; elements and attributes are counted before.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, Final
from xml.etree.ElementTree import Element

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_size, check_xml, load_toml

_TABLES: Final = frozenset({"channel", "keys", "channel-keys", "values", "channel-values"})
_PLACE: Final = frozenset({"at", "unit", "unit-at", "words"})
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_PATH: Final = re.compile(r"[\w.-]+(/[\w.-]+)*")
_LONGEST: Final = 200
_MOST_CHANNELS: Final = 255


def profile_from_xml(octets: bytes, mapping: str, *, name: str, file: str = "the XML", by: str = "the mapping") -> str:
    """Return the text of a profile with the content of the XML.

    Raises BadDataError for a file, or a place that does not exist.
    """
    rules = load_toml(mapping, by)
    if unknown := sorted(set(rules) - _TABLES):
        raise BadDataError(f"{by}: unknown key {unknown[0]!r}.", hint=f"Known are {', '.join(sorted(_TABLES))}.")
    root = _root(octets, file)
    path = rules.get("channel")
    if not isinstance(path, str):
        raise BadDataError(f"{by}: channel is missing.", hint='Name the elements of channels: channel = "Channel"')
    channels = _find(root, path, by)
    if not channels:
        raise BadDataError(f"{file} has no element {path!r}, which {by} names for its channels.")
    if len(channels) > _MOST_CHANNELS:
        raise BadDataError(f"{file} has {len(channels)} channels; a node has at most {_MOST_CHANNELS}.")
    lines = [f"# Made from {file.rpartition('/')[2]}."]
    values = {**_table(rules, "values", by), **dict(_keys(root, _table(rules, "keys", by), file, by))}
    lines += _lines({"title": name, **values})
    own, fixed = _table(rules, "channel-keys", by), _table(rules, "channel-values", by)
    for count, element in enumerate(channels, 1):
        channel_values = {**fixed, **dict(_keys(element, own, f"{file}, channel {count}", by))}
        number = str(channel_values.pop("number", count))
        if not (number.isascii() and number.isdecimal()):
            raise BadDataError(f"{file}, channel {count}: {number!r} is no channel number.")
        lines += ["", f"[channel.{int(number)}]", *_lines(channel_values)]
    return "\n".join([*lines, ""])


def _root(octets: bytes, file: str) -> Element:
    from xml.etree.ElementTree import ParseError

    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    check_size(len(octets), LIMITS.teds_file, file)
    check_xml(octets, file)
    try:
        root: Element = fromstring(octets, forbid_dtd=True)
    except DefusedXmlException as error:
        raise BadDataError(f"{file} has a DTD or entities, which are not read.", hint="Remove the DOCTYPE.") from error
    except (ParseError, ValueError, LookupError) as error:  # not XML, or in an unknown encoding
        raise BadDataError(f"{file} is not XML: {error}.") from error
    for element in root.iter():  # ignore a laboratory's namespace
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    return root


def _table(rules: Mapping[str, Any], name: str, by: str) -> dict[str, Any]:
    found = rules.get(name, {})
    if not isinstance(found, dict):
        raise BadDataError(f"{by}: {name} is not a table.", hint=f"Write [{name}].")
    return found


def _keys(element: Element, places: Mapping[str, Any], where: str, by: str) -> Iterator[tuple[str, Any]]:
    for key, place in places.items():
        rule = {"at": place} if isinstance(place, str) else place
        if not isinstance(rule, dict) or set(rule) - _PLACE or not isinstance(rule.get("at"), str):
            raise BadDataError(
                f"{by}: {key} is no place.", hint='Write key = "Path", or { at = "Path", unit = "degree" }.'
            )
        text = _text(element, rule["at"], by)
        if text is None:
            raise BadDataError(f"{where} has nothing at {rule['at']!r}, where {by} looks for {key}.")
        words = rule.get("words", {})
        text = str(words.get(text, text)) if isinstance(words, dict) else text
        unit = _text(element, rule["unit-at"], by) if isinstance(rule.get("unit-at"), str) else rule.get("unit")
        if unit is not None:
            unit = str(words.get(unit, unit)) if isinstance(words, dict) else unit
            if _NUMBER.fullmatch(text) is None:
                raise BadDataError(f"{where}: {text!r} at {rule['at']!r} is not a number.")
            yield key, f"{text} {unit}"
        else:
            yield key, _plain(text)


def _find(element: Element, path: str, by: str) -> list[Element]:
    if _PATH.fullmatch(path) is None:
        raise BadDataError(
            f"{by}: {path!r} is no path.", hint='Write names of elements: "Range/Low", or "Range/@unit".'
        )
    return element.findall(path)


def _text(element: Element, place: str, by: str) -> str | None:
    path, at, attribute = place.rpartition("@")
    path = path.rstrip("/") if at else place
    found = _find(element, path, by) if path else [element]
    if not found:
        return None
    text = found[0].get(attribute) if at else "".join(found[0].itertext())
    text = None if text is None else " ".join(text.split())
    if text is not None and len(text) > _LONGEST:
        raise BadDataError(f"The text at {place!r} has more than {_LONGEST} characters.")
    return text or None


def _plain(text: str) -> str | int | float:
    if _NUMBER.fullmatch(text) is None:
        return text
    return int(text) if text.lstrip("+-").isdecimal() else float(text)


def _lines(values: Mapping[str, Any]) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in values.items()]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)  # a string, a number, true or false: written as in TOML
