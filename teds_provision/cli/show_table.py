"""``show`` for people: rich tables of fields, findings and what they mean."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from teds_provision.cli.show_files import ShownFile
from teds_provision.lazy import late
from teds_provision.protocol.messages.message import Argument, Message
from teds_provision.teds.codec.model import Finding, TimeInstance, Verdict
from teds_provision.teds.formats import with_class
from teds_provision.teds.formats.jsonform import value_to_json
from teds_provision.teds.show import Shown, ShownField, describe, hexadecimal, instant

if TYPE_CHECKING:
    from rich import markup
    from rich import table as rich_table
    from rich.console import Console

    from teds_provision.protocol.handover.bundle import BundleHeader
else:
    markup, rich_table = late("rich.markup"), late("rich.table")

_COLOURS = {"error": "bold red", "warning": "yellow", "note": "dim"}
_PIPE_WIDTH = 200
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_GOOD = {Verdict.CLEAN, Verdict.BLOCK_CLEAN, Verdict.MESSAGE}


def escape(text: str) -> str:
    """Text of a file that is to reach the terminal as text: no markup, no control or direction characters."""
    return markup.escape(_UNSAFE.sub(lambda found: f"\\x{ord(found.group()):02x}", text))


def print_files(console: Console, files: Iterable[ShownFile]) -> None:
    """Print every file, one TEDS after the other."""
    many = list(files)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    for file in many:
        if len(many) > 1:
            console.rule(escape(file.name), align="left")
        if file.message is not None:
            _print_message(console, file.message)
        if file.bundle is not None:
            _print_bundle(console, file.bundle)
        for number, shown in enumerate(file.teds):
            if number:
                console.print()
            print_teds(console, shown)
            _print_findings(console, file.conversions.get(number, ()), "conversion: ")
        for guarded in file.guard:
            colour = _COLOURS[guarded.severity]
            where = f"guard, channel {guarded.channel}, {guarded.code}: "
            console.print(f"[{colour}]{guarded.severity}[/]  {escape(where + guarded.message)}")


def print_teds(console: Console, shown: Shown) -> None:
    """Print one TEDS: title, meaning, fields, findings."""
    decoded = shown.decoded
    colour = "green" if decoded.verdict in _GOOD else "red"
    edition = f"{decoded.edition} edition" if decoded.edition else "edition unknown"
    frame = "" if decoded.framed else " · bare data block"
    head = f"[bold]{escape(shown.title)}[/] · {edition} · {len(decoded.octets)} octets{frame}"
    console.print(f"{head} · [{colour}]{decoded.verdict}[/]")
    for label, text in shown.summary:
        console.print(f"  [cyan]{label}[/]: {escape(text)}")
    table = rich_table.Table(
        "offset", "type", "field", "value", "meaning", box=None, pad_edge=False, header_style="dim"
    )
    table.columns[0].justify = table.columns[1].justify = "right"
    for row in _rows(shown.fields, 0):
        table.add_row(*row)
    for octets in decoded.text:
        table.add_row("", "", "text", escape(octets.decode(errors="replace")), "")
    console.print(table)
    _print_findings(console, decoded.findings, "")


def _rows(fields: Iterable[ShownField], depth: int) -> Iterator[tuple[str, ...]]:
    for field in fields:
        meaning = escape(field.meaning)
        if field.weak:
            meaning = f"[bold red]{meaning}: weak, refused wherever a TEDS is built or trusted[/]"
        yield str(field.offset), str(field.type), "  " * depth + escape(field.name), escape(field.text), meaning
        yield from _rows(field.children, depth + 1)


def _print_findings(console: Console, findings: Iterable[Finding], prefix: str) -> None:
    for finding in findings:
        where = "" if finding.offset is None else f"octet {finding.offset}, "
        text = f"{prefix}{where}{finding.code}: {finding.message}"
        console.print(f"[{_COLOURS[finding.severity]}]{finding.severity}[/]  {escape(text)}")


def _print_message(console: Console, message: Message) -> None:
    where = "" if message.channel is None else f" · channel {message.channel}"
    group = f"{message.group_name}: " if message.group_name else ""
    name = message.name or "no message that is known here"
    school = " · tagged arguments" if message.school == "tagged" else ""
    failed = " · [red]failed[/]" if message.ok is False else ""
    console.print(f"[bold]{escape(group + name)}[/] · {message.kind}, {message.edition} edition{where}{school}{failed}")
    table = rich_table.Table("offset", "argument", "value", "meaning", box=None, pad_edge=False, header_style="dim")
    for argument in message.arguments:
        table.add_row(str(argument.offset), argument.name, escape(_value(argument)), escape(argument.meaning))
    if message.arguments:
        console.print(table)
    _print_findings(console, message.findings, "")
    for offset, octets in message.teds:
        console.print(f"\nTEDS at octet {offset}:")
        print_teds(console, describe(with_class(octets)))


def _value(argument: Argument) -> str:
    value = argument.value
    if isinstance(value, bytes):
        return ".".join(map(str, value)) if argument.name == "address" and len(value) == 4 else hexadecimal(value)
    if isinstance(value, TimeInstance):
        return instant(value)
    if argument.type == "duration":
        return f"{value} s"
    return ", ".join(map(str, value_to_json(value))) if isinstance(value, tuple) else str(value)


def _print_bundle(console: Console, bundle: BundleHeader) -> None:
    console.print(f"[bold]sealed handover bundle[/] · {bundle.octets} octets · sha256 {bundle.sha256[:16]}…")
    console.print(f"  {bundle.algorithm}, {bundle.encryption}, holds {bundle.content_type or 'unknown'}; not opened")
    for recipient in bundle.recipients:
        console.print(f"  for the station with fingerprint {recipient[:16] or '(not named)'}")
