"""From the merged tables of a profile to a checked :class:`Profile`."""

from __future__ import annotations

from typing import Final

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.profile.channels import channels_of
from teds_provision.teds.profile.keys import META_GROUPS, META_KEYS, PHY_KEYS, Key, Kind
from teds_provision.teds.profile.model import Pairs, Profile, TextProfile
from teds_provision.teds.profile.reader import Problems, Section
from teds_provision.teds.profile.source import Table

LINKS: Final = ("nfc", "can", "ble")
TEXT_CLASSES: Final = {
    "meta-identification": AccessCode.META_ID,
    "channel-identification": AccessCode.CHANNEL_ID,
    "calibration-identification": AccessCode.CALIBRATION_ID,
    "commands": AccessCode.COMMANDS,
    "title": AccessCode.TITLE,
    "geo-location": AccessCode.LOCATION,
}


def interpret(table: Table, name: str, file: str, lineage: tuple[str, ...], problems: Problems) -> Profile | None:
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
            _members(group, inner, channels)
            pairs.append((field, inner))
    section.finish()
    return tuple(pairs)


def _members(group: Section, pairs: Pairs, channels: tuple[int, ...]) -> None:
    for name, value in pairs:
        if name == "MemList" and isinstance(value, tuple):
            absent = [str(number) for number in value if number not in channels]
            if absent:
                group.error("members", f"the type has no channel {', '.join(absent)}.")


def _text(part: Section, channels: tuple[int, ...]) -> TextProfile | None:
    kind = part.text("kind")
    channel = part.read(Key("channel", "", Kind.U16, "channel, 0 for the whole node"))
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
    if len(language) != 2 or not language.isascii():
        part.error("language", f'a language has two letters, like "en", not "{language}".')
    return TextProfile(TEXT_CLASSES[kind], number, text, language)
