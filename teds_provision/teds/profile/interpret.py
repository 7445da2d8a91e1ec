"""From the merged tables of a profile to a checked :class:`Profile`."""

from __future__ import annotations

import re
from typing import Final, cast

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import MAXIMUM_DEGREE, METHODS, Monotone
from teds_provision.teds.calibration.samples import SAMPLE_OCTETS, DataModel
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import Units
from teds_provision.teds.profile.firmware import firmware_demand
from teds_provision.teds.profile.keys import (
    CALIBRATION_KEYS,
    CHANNEL_KEYS,
    DATA_SET_KEYS,
    META_GROUPS,
    META_KEYS,
    MODELS,
    MODES,
    PHY_KEYS,
    SAMPLE_KEYS,
    Key,
    KeyKind,
)
from teds_provision.teds.profile.model import CalibrationDemand, ChannelProfile, Pairs, Profile, TextProfile
from teds_provision.teds.profile.reader import FLOAT32_MAXIMUM, Problems, Section, TomlTable
from teds_provision.teds.units import WrittenUnit, parse_seconds, parse_unit

# The channels of a profile: ``[channel.all]``, ``[channel.1-12]``, ``[channel.3]``, merged and checked.

MAXIMUM_CHANNEL: Final = 255
_RANGE: Final = re.compile(r"(\d+)(?:-(\d+))?\Z")
_FRAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z0-9_]+)*\Z")
_KEY_CHOICES: Final = {"auto": -1, **CALIBRATION_KEYS}
_KEY: Final = Key("calibration-key", "CalKey", KeyKind.CHOICE, "who applies the calibration", choices=_KEY_CHOICES)


def channels_of(top: Section, abstract: bool) -> tuple[ChannelProfile, ...]:
    """Return every channel of a profile; none if something about them is wrong, which is reported to the section."""
    section = top.section("channel")
    tables = _selections(section) if section else {}
    if not tables:
        if not abstract:
            top.error("channel", "there is no channel: write at least [channel.1].")
        return ()
    missing = sorted(set(range(1, max(tables) + 1)) - set(tables))
    if missing and section:
        section.problems.error(
            section.table.where, "channel", f"channels are numbered from 1 without gaps; {missing[0]} is missing."
        )
    found = (_channel(Section(tables[number], top.problems), number) for number in sorted(tables))
    return tuple(channel for channel in found if channel)


def _selections(section: Section) -> dict[int, TomlTable]:
    """Return tables by channel number: ``all`` first, then the selections ``1-12`` from the widest to the narrowest."""
    everywhere: TomlTable | None = None
    selections: list[tuple[range, TomlTable]] = []
    for key, entry in section.table.entries.items():
        match = _RANGE.match(key)
        if not isinstance(entry, TomlTable) or not (match or key == "all"):
            section.error(key, "channels are written [channel.1], [channel.1-12] or [channel.all].")
        elif match is None:
            everywhere = entry
        else:
            low, high = int(match[1]), int(match[2] or match[1])
            if not 1 <= low <= high <= MAXIMUM_CHANNEL:
                section.error(key, f"channel numbers go from 1 to {MAXIMUM_CHANNEL}, the lower one first.")
                continue
            selections.append((range(low, high + 1), entry))
    return _laid_over(everywhere, selections)


def _laid_over(everywhere: TomlTable | None, selections: list[tuple[range, TomlTable]]) -> dict[int, TomlTable]:
    tables: dict[int, TomlTable] = {}
    for numbers, table in sorted(selections, key=lambda pair: -len(pair[0])):
        for number in numbers:
            below = tables.get(number, everywhere)
            tables[number] = below.merged(table) if below else table
    return tables


def _channel(section: Section, number: int) -> ChannelProfile | None:
    before = len(section.problems.errors)
    unit = _unit(section, "unit", required=True)
    section.unit = unit
    pairs = list(section.pairs(CHANNEL_KEYS))
    fields = dict(pairs)
    fields.setdefault("SelfTest", 0)
    fields["PhyUnits"] = unit.units if unit else Units()
    fields["Sample"] = _sample(section)
    data_set = _data_set(section)
    if data_set:
        fields["DataSet"] = data_set
    fields["Sampling"] = _sampling(section)
    key = section.read(_KEY)
    display = section.text("display-unit") or None
    if display and unit and parse_unit_or_report(section, "display-unit", display, unit) is None:
        display = None
    name = section.name("name").replace("{channel}", str(number))
    frame = section.text("frame").replace("{channel}", str(number))
    if frame and not _FRAME.fullmatch(frame.replace("{node}", "n")):
        section.error("frame", 'letters, digits, _ and / are expected, and {node} for the node: "{node}_link".')
    demand = _demand(section, unit)
    section.finish()
    if len(section.problems.errors) > before or unit is None:
        return None
    channel = ChannelProfile(
        number, name, unit, fields, demand, None if key in (None, -1) else cast(int, key), display, frame
    )
    _check_channel(section, channel)
    return channel


def _unit(section: Section, key: str, *, required: bool = False) -> WrittenUnit | None:
    text = section.text(key)
    if not text:
        if required and section.place_of(key) == section.table.where:
            section.error(key, 'missing (the physical unit). Write for example: unit = "degree"')
        return None
    try:
        return parse_unit(text)
    except BadDataError as error:
        section.error(key, f"{error.message} {error.hint}")
        return None


def parse_unit_or_report(section: Section, key: str, text: str, like: WrittenUnit) -> WrittenUnit | None:
    """Parse a unit that must be of the same kind as another; reports and returns None if it is not."""
    try:
        unit = parse_unit(text)
    except BadDataError as error:
        section.error(key, f"{error.message} {error.hint}")
        return None
    if unit.units != like.units:
        section.error(key, f'"{text}" is not of the same kind as the channel\'s unit "{like.text}".')
        return None
    return unit


def _sample(section: Section) -> dict[str, object]:
    sample = section.section("sample")
    if sample is None:
        section.error("sample", 'missing. Write for example: sample = { model = "unsigned", octets = 2, bits = 16 }')
        return {}
    fields = dict(sample.pairs(SAMPLE_KEYS))
    sample.finish()
    model, octets, bits = (fields.get(name) for name in ("DatModel", "ModLenth", "SigBits"))
    if isinstance(model, int) and isinstance(octets, int) and isinstance(bits, int):
        _check_sample(sample, model, octets, bits)
    return fields


def _check_sample(sample: Section, model: int, octets: int, bits: int) -> None:
    name = next((name for name, code in MODELS.items() if code == model), None)
    if name is None:
        sample.error("model", f"{model} is no data model; {', '.join(MODELS)} are.")
        return
    low, high = SAMPLE_OCTETS[DataModel(model)]
    if not low <= octets <= high:
        wanted = str(low) if low == high else f"{low} to {high}"
        sample.error("octets", f"a sample of model {name} has {wanted} octets, not {octets}.")
    if bits > 8 * octets:
        sample.error("bits", f"{octets} octets hold {8 * octets} bits, not {bits}.")


def _data_set(section: Section) -> Pairs:
    data_set = section.section("data-set")
    if data_set is None:
        return ()
    unit = _unit(data_set, "unit") or parse_unit("s")
    out: list[tuple[str, object]] = []
    for name, value in data_set.pairs(DATA_SET_KEYS):
        if name == "SOrigin" and isinstance(value, float):
            out.append((name, unit.to_si(value)))
        elif name == "StepSize" and isinstance(value, float):
            out.append((name, unit.scale * value))
        else:
            out.append((name, value))
    out.insert(next((at for at, (name, _) in enumerate(out) if name == "PreTrigg"), len(out)), ("SUnits", unit.units))
    data_set.finish()
    return tuple(out)


def _sampling(section: Section) -> dict[str, int]:
    sampling = section.section("sampling")
    if sampling is None:
        section.error("sampling", 'missing. Write for example: sampling = { modes = ["trigger"], default = "trigger" }')
        return {}
    modes = sampling.texts("modes")
    default = sampling.text("default", modes[0] if modes else "")
    sampling.finish()
    for mode in modes:
        if mode not in MODES:
            sampling.error("modes", f'"{mode}" is no sampling mode; {", ".join(MODES)} are.')
    if not modes:
        sampling.error("modes", f"name at least one of {', '.join(MODES)}.")
    elif default not in modes:
        sampling.error("default", f'the default mode "{default}" is not among the modes.')
    mask = sum(MODES.get(mode, 0) for mode in set(modes))
    return {"SampMode": mask, "SDefault": MODES.get(default, 0)}


def _demand(section: Section, unit: WrittenUnit | None) -> CalibrationDemand:
    part = section.section("calibration")
    if part is None:
        return CalibrationDemand()
    method = part.text("method") or None
    if method and method not in METHODS:
        part.error("method", f'"{method}" is no method; {", ".join(METHODS)} are.')
    degree = part.read(Key("degree", "", KeyKind.U8, "degree of the polynomial"))
    if isinstance(degree, int) and not 1 <= degree <= MAXIMUM_DEGREE:
        part.error("degree", f"the degree of a polynomial goes from 1 to {MAXIMUM_DEGREE}, not {degree}.")
    seconds = _interval(part)
    part.unit = unit
    deviation = part.read(Key("standard-deviation", "", KeyKind.NUMBER, "standard deviation in the channel's unit"))
    demand = CalibrationDemand(
        required=part.flag("required"),
        method=method,
        degree=degree if isinstance(degree, int) else None,
        monotone=_monotone(part),
        interval=seconds,
        raw_range=_raw_range(part),
        zero_offset=part.flag("zero-offset"),
        standard_deviation=deviation if isinstance(deviation, float) else None,
        indication=_indication(part),
    )
    part.finish()
    return demand


def _interval(part: Section) -> float | None:
    """Return seconds between calibrations, None if it is not stated or wrong."""
    interval = part.item("interval")
    if interval is None:
        return None
    try:
        seconds = parse_seconds(interval)
    except BadDataError as error:
        part.error("interval", f"{error.message} {error.hint}")
        return None
    if 0 < seconds < 2**32:
        return seconds
    part.error("interval", f"{interval!r} is not a time that a TEDS can hold.")
    return None


def _monotone(part: Section) -> Monotone | None:
    value = part.item("monotone")
    if value is None or value is False:
        return None
    if value is True:
        return "either"
    if value in ("increasing", "decreasing", "either"):
        return value
    part.error("monotone", f'"increasing", "decreasing", true (either) or false is expected, not {value!r}.')
    return None


def _raw_range(part: Section) -> tuple[float, float] | None:
    value = part.item("raw-range")
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(type(end) in (int, float) for end in value):
        low, high = value
        if -FLOAT32_MAXIMUM <= low < high <= FLOAT32_MAXIMUM:
            return float(low), float(high)
    part.error("raw-range", f"two numbers, the lower one first, are expected, like [0, 65535], not {value!r}.")
    return None


def _indication(part: Section) -> tuple[float, float] | None:
    value = part.item("indication")
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(type(number) in (int, float) for number in value):
        slope, intercept = value
        if 0 < abs(slope) <= FLOAT32_MAXIMUM and abs(intercept) <= FLOAT32_MAXIMUM:
            return float(slope), float(intercept)
    part.error("indication", f"slope and intercept are expected, like [0.01, -40.0], not {value!r}.")
    return None


def _check_channel(section: Section, channel: ChannelProfile) -> None:
    low, high = channel.fields.get("LowLimit"), channel.fields.get("HiLimit")
    if isinstance(low, float) and isinstance(high, float) and low >= high:
        section.error("low-limit", "the low limit must be below the high limit.")
    demand = channel.calibration
    if demand.required and channel.calibration_key == 0:
        section.error("calibration-key", '"none" contradicts calibration.required = true.')
    if demand.method == "polynomial" and demand.degree is None and demand.required:
        section.warning("calibration", "the degree of the polynomial is left to the calibration file.")
    if not channel.name:
        section.warning("name", "the channel has no name; people will see its number only.")


LINKS: Final = ("nfc", "can", "ble")
TEXT_CLASSES: Final = {
    "meta-identification": AccessCode.META_ID,
    "channel-identification": AccessCode.CHANNEL_ID,
    "calibration-identification": AccessCode.CALIBRATION_ID,
    "commands": AccessCode.COMMANDS,
    "title": AccessCode.TITLE,
    "geo-location": AccessCode.LOCATION,
}


def interpret(table: TomlTable, name: str, file: str, lineage: tuple[str, ...], problems: Problems) -> Profile | None:
    """Read a merged profile; what is wrong goes into ``problems``. None when nothing usable came out."""
    top = Section(table, problems)
    abstract = top.flag("abstract")
    links = top.texts("links")
    for link in links:
        if link not in LINKS:
            top.error("links", f'"{link}" is no link; {", ".join(LINKS)} are.')
    top.item("extends")
    channels = channels_of(top, abstract)
    numbers = tuple(channel.number for channel in channels)
    meta = _meta(top, numbers, abstract)
    phy = top.section("phy")
    phy_pairs = phy.pairs(PHY_KEYS) if phy else ()
    if phy:
        phy.finish()
    firmware = firmware_demand(top)
    texts = tuple(text for part in top.sections("text") if (text := _text(part, numbers)))
    title = top.text("title", name)
    description = top.text("description")
    tim_name = top.name("name", title)
    top.finish()
    if problems.errors:
        return None
    warnings = tuple(str(problem) for problem in problems.found)
    return Profile(
        name,
        title,
        description.strip(),
        file,
        lineage,
        tim_name,
        links,
        meta,
        channels,
        phy_pairs,
        texts,
        abstract,
        warnings,
        firmware,
    )


def _meta(top: Section, channels: tuple[int, ...], abstract: bool) -> Pairs:
    section = top.section("meta")
    if section is None:
        if not abstract:
            top.error("meta", "the table [meta] is missing: operation-timeout and self-test-time are needed.")
        return ()
    pairs = list(section.pairs(META_KEYS))
    for key, (field, keys) in META_GROUPS.items():
        for group in section.sections(key):
            inner = group.pairs(keys)
            group.finish()
            for name, value in inner:
                if name == "MemList" and isinstance(value, tuple):
                    absent = [str(number) for number in value if number not in channels]
                    if absent:
                        group.error("members", f"the type has no channel {', '.join(absent)}.")
            pairs.append((field, inner))
    section.finish()
    return tuple(pairs)


def _text(part: Section, channels: tuple[int, ...]) -> TextProfile | None:
    kind = part.text("kind")
    channel = part.read(Key("channel", "", KeyKind.U16, "channel, 0 for the whole node"))
    text, language = part.text("xml"), part.text("language", "en")
    part.finish()
    if kind not in TEXT_CLASSES:
        part.error("kind", f'"{kind}" is no text; {", ".join(TEXT_CLASSES)} are.')
        return None
    number = channel if isinstance(channel, int) else 0
    if number and number not in channels:
        part.error("channel", f"the type has no channel {number}.")
    if not text:
        part.error("xml", "the text is missing.")
    if len(language) != 2 or not (language.isascii() and language.isalpha()):
        part.error("language", f'a language has two letters, like "en", not "{language}".')
    return TextProfile(TEXT_CLASSES[kind], number, text, language)
