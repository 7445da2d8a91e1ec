"""TEDS as a TOML profile, and a profile as TEDS.

A profile holds less than TEDS do: it has no calibration, no signatures, no fields without a key. Losses are
found by building the TEDS again from the text and comparing octet for octet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.channel import channel_from
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import UNIT_PARTS, DecodedTeds, Edition, Field, Units
from teds_provision.teds.codec.tables import name_of
from teds_provision.teds.formats.tree import shortest
from teds_provision.teds.image import TedsBlock
from teds_provision.teds.profile.interpret import TEXT_CLASSES, interpret
from teds_provision.teds.profile.keys import (
    CALIBRATION_KEYS,
    CHANNEL_KEYS,
    DATA_SET_KEYS,
    META_GROUPS,
    META_KEYS,
    MODES,
    PHY_KEYS,
    SAMPLE_KEYS,
    Key,
    KeyKind,
)
from teds_provision.teds.profile.load import load_profile, parse_profile
from teds_provision.teds.profile.model import Profile
from teds_provision.teds.profile.reader import Problems, parse
from teds_provision.teds.units import display_unit, format_units, parse_unit

NO_UUID: Final = bytes(10)
_PLACES: Final[Mapping[int, int]] = {AccessCode.META: 0, AccessCode.NAME: 0, AccessCode.PHY: 0}
_KINDS: Final[dict[int, str]] = {code: kind for kind, code in TEXT_CLASSES.items()}
_SPELLING: Final = ("rad", "sr", "m", "kg", "s", "A", "K", "mol", "cd")

Placed = dict[tuple[int, int], bytes]


def read_profile(text: str, path: Path | None = None) -> list[TedsBlock]:
    """Return the TEDS that a profile gives for a node with UUID 0.

    Raises BadDataError and NotFoundError as the profile loader does.
    """
    return profile_blocks(parse_profile(text) if path is None else load_profile(path))


def profile_blocks(profile: Profile) -> list[TedsBlock]:
    """Return the TEDS of a loaded profile, the UUID all zeros."""
    blocks = profile.build(NO_UUID).blocks
    return [TedsBlock(channel, code, octets) for (channel, code), octets in blocks.items()]


def write_profile(blocks: Sequence[TedsBlock]) -> tuple[str, tuple[str, ...]]:
    """Return the text of a profile, and a sentence about each thing that it cannot hold."""
    placed, lost = _place(blocks)
    decoded = {key: decode(octets) for key, octets in placed.items()}
    body = "\n".join(_lines(decoded)) + "\n"
    lost += _differences(body, placed, decoded)
    head = ["# Profile made from TEDS. The UUID belongs to the node, so a profile has none."]
    head += [f"# Not held here: {sentence}" for sentence in lost]
    return "\n".join(head) + "\n" + body, tuple(lost)


def _place(blocks: Sequence[TedsBlock]) -> tuple[Placed, list[str]]:
    placed: Placed = {}
    lost: list[str] = []
    for channel, code, octets in blocks:
        if code is None:
            lost.append("a TEDS without a TEDSID.")
            continue
        key = (_PLACES.get(code, 1) if channel is None else channel, code)
        if key in placed:
            lost.append(f"a second {name_of(code)} of channel {key[0]}.")
        else:
            placed[key] = octets
    return placed, lost


def _lines(decoded: Mapping[tuple[int, int], DecodedTeds]) -> Iterator[str]:
    name = _name(decoded, 0)
    yield f"title = {_quoted(name or 'unnamed')}"
    if name:
        yield f"name = {_quoted(name)}"
    yield from ("", "[meta]")
    yield from _meta(decoded.get((0, AccessCode.META)))
    for channel, code in sorted(decoded):
        if code == AccessCode.CHANNEL and channel:
            yield from ("", f"[channel.{channel}]")
            yield from _channel(decoded[channel, code], _name(decoded, channel), channel)
    if (0, AccessCode.PHY) in decoded:
        yield from ("", "[phy]")
        yield from _keys(PHY_KEYS, decoded[0, AccessCode.PHY].fields)
    for (channel, code), teds in sorted(decoded.items()):
        if code in _KINDS and len(teds.text) == 1:
            yield from ("", "[[text]]", f"kind = {_quoted(_KINDS[code])}", f"channel = {channel}")
            language = teds.get("LangCode")
            if isinstance(language, str):
                yield f"language = {_quoted(language)}"
            yield f"xml = {_quoted(teds.text[0].decode(errors='replace'))}"


def _name(decoded: Mapping[tuple[int, int], DecodedTeds], channel: int) -> str:
    teds = decoded.get((channel, AccessCode.NAME))
    value = teds.get("TCName") if teds else None
    return value if isinstance(value, str) else ""


def _meta(teds: DecodedTeds | None) -> Iterator[str]:
    if teds is None:
        yield "operation-timeout = 1.0  # placeholder: there was no Meta-TEDS"
        yield "self-test-time = 0.0  # placeholder"
        return
    yield from _keys(META_KEYS, teds.fields)
    for key, (name, keys) in META_GROUPS.items():
        for field in teds.fields:
            if field.name == name:
                yield from ("", f"[[meta.{key}]]")
                yield from _keys(keys, field.children)


def _channel(teds: DecodedTeds, name: str, number: int) -> Iterator[str]:
    if name:
        yield f"name = {_quoted(name)}"
    channel = channel_from(teds)
    if channel.units_stated:
        yield f"unit = {_quoted(spell(channel.units))}"
        shown = display_unit(channel.units)
        if shown.scale != 1 or shown.offset:
            yield f"display-unit = {_quoted(shown.text.replace('°C', 'degC').replace('°', 'degree'))}"
    yield from _keys(CHANNEL_KEYS, teds.fields)
    if channel.calibration_key is not None:
        yield f"calibration-key = {_word_or_number(CALIBRATION_KEYS, channel.calibration_key)}"
    sample = teds.field("Sample")
    if sample is not None:
        yield f"sample = {{ {', '.join(_keys(SAMPLE_KEYS, sample.children))} }}"
    sampling = teds.field("Sampling")
    if sampling is not None:
        yield f"sampling = {{ {', '.join(_sampling(sampling))} }}"
    data_set = teds.field("DataSet")
    if data_set is not None:
        yield from ("", f"[channel.{number}.data-set]")
        units = next((part.value for part in data_set.children if part.name == "SUnits"), None)
        if isinstance(units, Units):
            yield f"unit = {_quoted(spell(units))}"
        yield from _keys(DATA_SET_KEYS, data_set.children)


def _word_or_number(words: Mapping[str, int], number: int) -> str:
    return next((_quoted(word) for word, code in words.items() if code == number), str(number))


def _sampling(field: Field) -> Iterator[str]:
    values = {part.name: part.value for part in field.children}
    mask, default = values.get("SampMode"), values.get("SDefault")
    modes = [mode for mode, bit in MODES.items() if isinstance(mask, int) and mask & bit]
    yield f"modes = [{', '.join(map(_quoted, modes))}]"
    word = next((mode for mode, bit in MODES.items() if bit == default), None)
    if word:
        yield f"default = {_quoted(word)}"


def _keys(keys: Iterable[Key], fields: Iterable[Field]) -> Iterator[str]:
    values = {field.name: field.value for field in reversed(list(fields))}
    for key in keys:
        text = _value(key, values.get(key.field))
        if text is not None:
            yield f"{key.key} = {text}"


def _value(key: Key, value: object) -> str | None:
    """Return TOML of a value in SI units; None if there is none, or none that the key takes."""
    if isinstance(value, tuple):
        return f"[{', '.join(_number(part) for part in value)}]" if all(map(_finite, value)) else None
    if key.kind is KeyKind.FLAG:
        return {0: "false", 1: "true"}.get(value) if isinstance(value, int) else None
    if key.kind is KeyKind.CHOICE:
        return _word_or_number(key.choices, value) if isinstance(value, int) else None
    return _number(value) if _finite(value) else None


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _number(value: object) -> str:
    return repr(shortest(value)) if isinstance(value, float) else str(value)


def spell(units: Units) -> str:
    """Spell units in SI so that the profile reader understands the same; others come out as shown."""
    factors = [
        f"{symbol}**{float(power):g}"
        for symbol, base in zip(_SPELLING, UNIT_PARTS, strict=True)
        if (power := getattr(units, base))
    ]
    for text in (format_units(units), "*".join(factors), "count"):
        try:
            found = parse_unit(text)
        except BadDataError:
            continue
        if (found.units, found.scale, found.offset) == (units, 1.0, 0.0):
            return text
    return format_units(units) or "count"


_ESCAPES: Final = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def _quoted(text: str) -> str:
    inner = "".join(
        _ESCAPES.get(char, char if char >= " " and char != "\x7f" else f"\\u{ord(char):04x}") for char in text
    )
    return f'"{inner}"'


def _differences(body: str, placed: Placed, decoded: Mapping[tuple[int, int], DecodedTeds]) -> list[str]:
    """Return what the TEDS built from the text lack or have otherwise."""
    built, why = _built(body, decoded)
    lost = [f"it does not load: {why}"] if why else []
    for (channel, code), octets in sorted(placed.items()):
        place = f"{name_of(code)} of channel {channel}"
        if (channel, code) not in built:
            lost.append(f"{place}{_because(code)}.")
        elif built[channel, code] != octets:
            lost.append(f"{place}: {_fields_apart(decode(built[channel, code]), decoded[channel, code])}.")
    return lost


def _because(code: int) -> str:
    if code == AccessCode.CALIBRATION:
        return " (calibrations come from a file of their own)"
    return " (made when a datasheet is signed)" if code == AccessCode.SECURITY else ""


def _built(body: str, decoded: Mapping[tuple[int, int], DecodedTeds]) -> tuple[Placed, str]:
    problems = Problems()
    try:
        profile = interpret(parse(body, "profile"), "profile", "profile", ("profile",), problems)
        if profile is None:
            return {}, str(problems.errors[0])
        meta = decoded.get((0, AccessCode.META))
        uuid = meta.get("UUID") if meta else None
        edition: Edition = next((teds.edition for teds in decoded.values() if teds.edition), 2007)
        zero = bytes(10 if edition == 2007 else 16)
        built = profile.build(uuid if isinstance(uuid, bytes) else zero, edition=edition)
    except BadDataError as error:
        return {}, error.message
    return built.blocks, ""


def _fields_apart(built: DecodedTeds, wanted: DecodedTeds) -> str:
    raws = {(field.name, field.raw) for field in built.fields}
    names = [field.name or f"type {field.type}" for field in wanted.fields if (field.name, field.raw) not in raws]
    present = {field.name for field in wanted.fields}
    names += [f"{field.name} (added)" for field in built.fields if field.name not in present]
    return ", ".join(dict.fromkeys(names)) or "its form, not its values"
