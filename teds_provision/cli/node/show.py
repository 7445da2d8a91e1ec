"""``show``: decode TEDS, images, profiles, bundle headers, messages and calibration certificates.

It also turns TEDS from any format into any other.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

import click

from teds_provision import teds
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.context import to_json as dumps
from teds_provision.cli.options import ChannelName, FileToRead, command
from teds_provision.cli.rendering import print_table
from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.files import open_to_read, read_limited
from teds_provision.lazy import late
from teds_provision.limits import LIMITS
from teds_provision.protocol.messages.message import Argument, Message, decode_message, looks_like_message
from teds_provision.sanitize import sanitize
from teds_provision.teds import convert, decode
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import Conformity, DecodedTeds, Edition, Finding, TimeInstance
from teds_provision.teds.formats import Format, Kind, TedsBlock, class_of, detect, read_blocks, with_class
from teds_provision.teds.formats.jsonform import FORMAT, value_to_json
from teds_provision.teds.guard import GuardFinding, check_calibration
from teds_provision.teds.show import (
    ShownField,
    ShownTeds,
    describe,
    finding_to_json,
    hexadecimal,
    instant,
    shown_to_json,
)

if TYPE_CHECKING:
    from rich import markup
    from rich import table as rich_table

    from teds_provision.protocol.handover import bundle as bundles
    from teds_provision.protocol.handover.bundle import BundleHeader
    from teds_provision.teds.dcc.items import CertificateItem
    from teds_provision.teds.dcc.shown import ShownCertificate
else:
    bundles = late("teds_provision.protocol.handover.bundle")  # imports cryptography: only for a handover bundle
    markup, rich_table = late("rich.markup"), late("rich.table")

CHOICES = ["table", "json", "xml", "hex", "ihex", "toml", "binary", "image"]
_BAD_DATA = BadDataError.exit_code
_POLICY = 6
_MOST_PEM: Final = 1 << 20
_CERTIFICATE: Final = b"digitalCalibrationCertificate"
_CERTIFICATE_HEAD: Final = 8192  # a licence text may precede the root element


@command(
    "teds-provision show meta.hex",
    "teds-provision show image.json --format xml > image.xml",
    "teds-provision show image.json --edition 2024",
    "teds-provision show --diff before.json after.json",
    "teds-provision show image.json --plot curve.svg",
    "teds-provision show certificate.xml --trust-dcc laboratory.pem",
)
@click.argument("files", metavar="FILE…", nargs=-1)
@click.option("--format", "form", type=click.Choice(CHOICES), default="table", show_default=True, help="Output format.")
@click.option(
    "--edition", type=click.Choice(["2007", "2024"]), help="Convert to this edition and list what it cannot represent."
)
@click.option("--diff", nargs=2, metavar="A B", help="Show in physical terms what changes from A to B.")
@click.option(
    "--plot", metavar="FILE", type=click.Path(path_type=Path), help="Plot the calibrations to this file, .png or .svg."
)
@click.option(
    "--channel", type=ChannelName(), metavar="CHANNEL", help="With --plot: only this channel, by number or name."
)
@click.option(
    "--trust-dcc",
    type=FileToRead(),
    multiple=True,
    metavar="CERT.pem",
    help="Require a calibration certificate signed by this one, or under this CA; repeatable.",
)
@click.option("--strict", is_flag=True, help="Exit 8 for any error finding, 6 for a harmful calibration.")
@pass_app
def show(
    app: App,
    files: tuple[str, ...],
    form: str,
    edition: str | None,
    diff: tuple[str, str] | None,
    plot: Path | None,
    channel: int | str | None,
    trust_dcc: tuple[Path, ...],
    strict: bool,
) -> None:
    """Decode TEDS (binary, hex, Intel HEX, JSON, XML), images, profiles, bundle headers, messages and certificates.

    Use - for standard input. Exits 0 if everything could be decoded, 8 if a TEDS is malformed, 4 if a certificate's
    signature is bad, 3 if a file is missing.
    """
    plain = form in {"table", "json"}
    if diff is not None:
        if files or plot or not plain:
            raise UsageError("--diff compares two files and cannot be combined with anything else.")
        _diff(app, *diff, as_json=form == "json")
        return
    if channel is not None and plot is None:
        raise UsageError("--channel works with --plot.", hint="Add --plot curve.svg")
    if not files:
        raise UsageError("No file given.", hint="Name a file, or - for standard input.")
    if app.json and not plain:
        raise UsageError("--json and --format cannot be combined.", hint="Omit one of them.")
    wanted = cast("Edition", int(edition)) if edition else None
    trusted = tuple(read_limited(path, _MOST_PEM, "certificate") for path in trust_dcc)
    try:
        shown = [load(name, wanted, trusted) for name in files]
    except NotFoundError as error:
        hint = error.hint or "show decodes files. Of a node: nodes UUID, or read UUID --output FILE."
        raise NotFoundError(error.message, hint=hint) from error
    if plot is not None:
        if len(shown) != 1:
            raise UsageError("--plot works with one file.", hint="Run show once per file.")
        blocks = placed(shown[0].blocks)
        if isinstance(channel, str):
            sheet = teds.sheet.Sheet.from_blocks(blocks)
            channel = sheet.chosen(channel, sheet.uuid.hex()).number
        channels = teds.plot.plot_blocks(blocks, plot, channel=channel)
        app.note(f"Plotted in {plot}: channel{'s' if len(channels) > 1 else ''} {', '.join(map(str, channels))}.")
    _print_files(app, shown, form)
    if any(file.malformed for file in shown) or (strict and any(map(_has_errors, shown))):
        raise click.exceptions.Exit(_BAD_DATA)
    if strict and any(guarded.severity == "error" for file in shown for guarded in file.guard):
        raise click.exceptions.Exit(_POLICY)


def _print_files(app: App, files: Sequence[ShownFile], form: str) -> None:
    for file in files:
        for note in file.notes:
            app.note(f"{file.name}: {note}")
    if app.json or form == "json":
        result = to_json(files)
        print(dumps(result, indent=None if app.json else 1), flush=True)
    elif form == "table":
        print_files(app.console(), files)
    else:
        _convert(app, files, cast("Format", form))


def _convert(app: App, files: Sequence[ShownFile], form: Format) -> None:
    for file in files:
        if file.bundle is not None or file.certificate is not None:
            raise BadDataError(f"{file.name} contains no TEDS that could be written as {form}.")
        for finding in chain.from_iterable(file.conversions.values()):
            if finding.severity == "error":
                app.warn(f"{file.name}: {finding.message}")
    _write(app, [block for file in files for block in file.blocks], form)


def _write(app: App, blocks: Sequence[TedsBlock], form: Format) -> None:
    written = teds.formats.write_blocks(blocks, form)
    if isinstance(written, bytes) and sys.stdout.isatty():
        raise UsageError(
            "Binary output cannot go to a terminal.", hint="Redirect it to a file: … --format binary > FILE"
        )
    for sentence in teds.formats.lost(blocks, form):
        app.warn(f"{form} cannot hold {sentence}")
    if isinstance(written, str) and sys.stdout.isatty():
        written = sanitize(written)
    octets = written if isinstance(written, bytes) else written.encode()
    sys.stdout.buffer.write(octets)
    sys.stdout.flush()


def _has_errors(file: ShownFile) -> bool:
    found = [finding for shown in file.teds for finding in shown.decoded.findings]
    found += file.message.findings if file.message is not None else ()
    return any(finding.severity == "error" for finding in found)


def _diff(app: App, before: str, after: str, *, as_json: bool) -> None:
    old, new = (placed(load(name).blocks) for name in (before, after))
    changes = teds.diff.diff_blocks(old, new)
    judged = teds.guard.check_calibration(new, old)
    result = {
        "changes": [asdict(change) for change in changes],
        "guard": [guard_to_json(finding) for finding in judged],
    }
    if as_json and not app.json:
        print(dumps(result, indent=1), flush=True)
        return
    lines = [change.text for change in changes] or ["no difference"]
    lines += [f"{finding.severity}: guard, channel {finding.channel}: {finding.message}" for finding in judged]
    app.emit(result, lambda console: console.print("\n".join(lines), markup=False))


# Output for people: rich tables of fields and findings, with explanations.

_COLOURS = {"error": "bold red", "warning": "yellow", "note": "dim"}
_PIPE_WIDTH = 200
_UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_GOOD = {Conformity.CLEAN, Conformity.BLOCK_CLEAN, Conformity.MESSAGE}


def escape(text: str) -> str:
    """Return text of a file as text for the terminal: no markup, no control or direction characters."""
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
        if file.certificate is not None:
            _print_certificate(console, file.certificate)
        for number, shown in enumerate(file.teds):
            if number:
                console.print()
            print_teds(console, shown)
            _print_findings(console, file.conversions.get(number, ()), "conversion: ")
        for guarded in file.guard:
            colour = _COLOURS[guarded.severity]
            where = f"guard, channel {guarded.channel}, {guarded.code}: "
            console.print(f"[{colour}]{guarded.severity}[/]  {escape(where + guarded.message)}")


def print_teds(console: Console, shown: ShownTeds) -> None:
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
    print_table(console, table)
    _print_findings(console, decoded.findings, "")


def _rows(fields: Iterable[ShownField], depth: int) -> Iterator[tuple[str, ...]]:
    for shown in fields:
        meaning = escape(shown.meaning)
        if shown.weak:
            meaning = f"[bold red]{meaning}: weak, refused when building or trusting a TEDS[/]"
        yield str(shown.offset), str(shown.type), "  " * depth + escape(shown.name), escape(shown.text), meaning
        yield from _rows(shown.children, depth + 1)


def _print_findings(console: Console, findings: Iterable[Finding], prefix: str) -> None:
    for finding in findings:
        where = "" if finding.offset is None else f"octet {finding.offset}, "
        text = f"{prefix}{where}{finding.code}: {finding.message}"
        console.print(f"[{_COLOURS[finding.severity]}]{finding.severity}[/]  {escape(text)}")


def _print_message(console: Console, message: Message) -> None:
    where = "" if message.channel is None else f" · channel {message.channel}"
    group = f"{message.group_name}: " if message.group_name else ""
    name = message.name or "unknown message"
    school = " · tagged arguments" if message.school == "tagged" else ""
    failed = " · [red]failed[/]" if message.ok is False else ""
    console.print(f"[bold]{escape(group + name)}[/] · {message.kind}, {message.edition} edition{where}{school}{failed}")
    table = rich_table.Table("offset", "argument", "value", "meaning", box=None, pad_edge=False, header_style="dim")
    for argument in message.arguments:
        table.add_row(str(argument.offset), argument.name, escape(_value(argument)), escape(argument.meaning))
    if message.arguments:
        print_table(console, table)
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


def _print_certificate(console: Console, shown: ShownCertificate) -> None:
    console.print(f"[bold]calibration certificate[/] · DCC {escape(shown.certificate.schema_version)}")
    for label, text in shown.lines():
        console.print(f"  [cyan]{label}[/]: {escape(text)}" if label else f"    {escape(text)}")
    for item in shown.items:
        console.print(f"\n[bold]item {escape(item.id)}[/] · {escape(item.title)}")
        table = rich_table.Table(*_heads(item), box=None, pad_edge=False, header_style="dim")
        for row in teds.dcc.shown.points_of(item):
            table.add_row(*row)
        print_table(console, table)
        uncertainty = item.to_json()["uncertainty"]
        if isinstance(uncertainty, float):
            console.print(f"  standard uncertainty {uncertainty:.6g} {escape(item.reference.unit.text)}".rstrip())


def _heads(item: CertificateItem) -> tuple[str, str]:
    unit = item.reference.unit.text
    value = f"value [{unit}]" if unit else "value"
    if item.indicated is None:
        return "coefficient", escape(value)
    of = item.indicated.unit.text
    return escape(f"indication [{of}]" if of else "raw"), escape(value)


# Read, recognize and describe all files before anything is printed.

STDIN = "-"
_HEAD_OCTETS: Final = 64
_OTHERS: Final = {
    b'{"format":"teds-backup/': ("a backup of a station", "teds-provision restore {}"),
    b"\x89MCAP0\r\n": ("a recording (MCAP)", "mcap info {}"),
    b"# teds-provision measurement, text": (
        "a recording (text)",
        "less {}",
    ),
    b"\n\r\r\n": ("a trace (pcapng)", "teds-provision trace show {}"),
    b'{"format": "teds-trace/': ("a trace", "teds-provision trace show {}"),
}
"""First characters of this program's other files, their kinds, and the command that reads them."""


@dataclass(frozen=True)
class ShownFile:
    """One file: its TEDS, or the message, bundle header or certificate that it holds; ``notes`` go to stderr."""

    name: str
    kind: Kind
    teds: tuple[ShownTeds, ...] = ()
    message: Message | None = None
    bundle: BundleHeader | None = None
    certificate: ShownCertificate | None = None
    guard: tuple[GuardFinding, ...] = ()
    notes: tuple[str, ...] = ()
    conversions: Mapping[int, tuple[Finding, ...]] = field(default_factory=dict)

    @property
    def blocks(self) -> list[TedsBlock]:
        """The blocks of its TEDS; a message is one block without a place."""
        if self.message is not None:
            return [TedsBlock(None, None, self.message.octets)]
        return [shown.block for shown in self.teds]

    @property
    def malformed(self) -> bool:
        """True if the tuples of a TEDS do not even close, or a message is malformed."""
        unreadable = self.message is not None and self.message.kind == "unknown"
        return unreadable or any(shown.decoded.verdict is Conformity.MALFORMED for shown in self.teds)


def read_file(name: str) -> bytes:
    """Return the octets of a file or, for ``-``, of standard input.

    Raises NotFoundError and, for more than 32 MiB, BadDataError.
    """
    if name != STDIN:
        with open_to_read(Path(name)) as file:
            octets = file.read(LIMITS.teds_file + 1)
        if len(octets) <= LIMITS.teds_file:
            return octets
        raise _no_teds(name, octets, f"it has more than {LIMITS.teds_file >> 20} MiB")
    octets = sys.stdin.buffer.read(LIMITS.teds_file + 1)
    if len(octets) > LIMITS.teds_file:
        raise BadDataError(f"Standard input gives more than {LIMITS.teds_file >> 20} MiB; no file of TEDS has.")
    return octets


def load(name: str, edition: Edition | None = None, trusted: tuple[bytes, ...] = ()) -> ShownFile:
    """Read one file and put it into words, converted to ``edition`` if one is given.

    ``trusted`` are those whose signature a certificate must have, as PEM; empty if it need not have any.
    """
    bundle = _long_bundle(name)
    if bundle is not None:
        return ShownFile(name, "bundle", bundle=bundle)
    octets = read_file(name)
    kind: Kind | None = None
    if octets.startswith(tuple(_OTHERS)):
        raise _no_teds(name, octets, "")
    if looks_like_certificate(octets):
        certificate = teds.dcc.signature.read_checked(octets, name, trusted, datetime.now(UTC))
        shown = teds.dcc.shown.ShownCertificate.from_certificate(certificate)
        return ShownFile(name, "xml", certificate=shown, notes=certificate.warnings)
    try:
        kind = detect(octets)
        if kind == "bundle":
            return ShownFile(name, kind, bundle=bundles.peek_bundle(octets))
        blocks = read_blocks(octets, kind, path=Path(name) if name != STDIN else None)
    except BadDataError as error:
        raise _of_file(name, kind, error) from error
    if not blocks:
        raise BadDataError(f"{name} holds no TEDS.")
    if len(blocks) == 1 and is_message(blocks[0].octets):
        return ShownFile(name, kind, message=decode_message(blocks[0].octets))
    return _described(name, kind, blocks, edition)


def _long_bundle(name: str) -> BundleHeader | None:
    """Return the header of a bundle that is longer than any file of TEDS, read piece by piece; else None."""
    try:
        if name == STDIN or os.stat(name).st_size <= LIMITS.teds_file:  # a pipe has no size, and can be read only once
            return None
    except (OSError, ValueError):
        return None
    with open_to_read(Path(name)) as file:
        if not file.read(_HEAD_OCTETS).lstrip().startswith(b"{"):
            return None
        try:
            return bundles.peek_bundle(file)
        except BadDataError:
            return None


def _no_teds(name: str, octets: bytes, why: str) -> BadDataError:
    """Return the error for a file of another kind, with the command for it if its first octets show it."""
    for head, (what, reader) in _OTHERS.items():
        if octets.startswith(head):
            return BadDataError(f"{name} holds no TEDS: it is {what}.", hint=f"Read it with: {reader.format(name)}")
    return BadDataError(f"{name} holds no TEDS: {why}.")


def _of_file(name: str, kind: Kind | None, error: BadDataError) -> BadDataError:
    """Return the error of a file, with its name before it."""
    if kind == "hex" and "Line 1 holds" in error.message:  # text of no other kind is tried as hex
        return BadDataError(
            f"{name} holds no TEDS: it is neither binary nor hex (read as hex: {error.message[:1].lower()}"
            f"{error.message[1:].rstrip('.')}).",
            hint="TEDS come as binary, hex, Intel HEX, JSON, XML, an image, a profile or a bundle.",
        )
    named = error.message.startswith((f"{name}:", f"{name} "))
    return BadDataError(error.message if named else f"{name}: {error.message}", hint=error.hint)


def _described(name: str, kind: Kind, blocks: Sequence[TedsBlock], edition: Edition | None) -> ShownFile:
    notes = ("The UUID is all zeros: a profile has none.",) if kind == "toml" else ()
    file = ShownFile(name, kind, notes=notes)
    if edition is not None:
        blocks, conversions = _converted(blocks, edition)
        file = replace(file, conversions=conversions)
    beside = placed(blocks)
    shown = tuple(describe(block, beside) for block in blocks)
    return replace(file, teds=shown, guard=_guard(beside))


def looks_like_certificate(octets: bytes) -> bool:
    """Return True if a file begins like a calibration certificate."""
    return octets.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<") and _CERTIFICATE in octets[:_CERTIFICATE_HEAD]


def is_message(octets: bytes) -> bool:
    """Return True if octets are a message rather than a TEDS."""
    if looks_like_message(octets):
        return True

    return class_of(octets) is None and decode(octets).verdict is Conformity.MESSAGE


def placed(blocks: Sequence[TedsBlock]) -> dict[tuple[int, int], bytes]:
    """Return TEDS by (channel, access code); a lone channel TEDS and a calibration without channel are channel 1."""
    out: dict[tuple[int, int], bytes] = {}
    for channel, code, octets in blocks:
        if code is not None:
            out.setdefault((_usual_channel(code) if channel is None else channel, code), octets)
    return out


def _usual_channel(code: int) -> int:
    return 1 if code in {AccessCode.CHANNEL, AccessCode.CALIBRATION} else 0


def _guard(beside: dict[tuple[int, int], bytes]) -> tuple[GuardFinding, ...]:
    if not any(code == AccessCode.CALIBRATION for _, code in beside):
        return ()
    return tuple(check_calibration(beside, now=datetime.now(UTC)))


def _converted(blocks: Sequence[TedsBlock], edition: Edition) -> tuple[list[TedsBlock], dict[int, tuple[Finding, ...]]]:
    out: list[TedsBlock] = []
    said: dict[int, tuple[Finding, ...]] = {}
    for number, block in enumerate(blocks):
        decoded: DecodedTeds = decode(block.octets)
        try:
            octets, findings = convert(decoded, edition)
        except BadDataError as error:
            octets, findings = block.octets, [Finding("error", "not-converted", error.message)]
        out.append(block._replace(octets=octets))
        said[number] = tuple(findings)
    return out, said


def guard_to_json(finding: GuardFinding) -> dict[str, Any]:
    """Return one finding of the guard as a JSON object."""
    return {
        "severity": finding.severity,
        "channel": finding.channel,
        "code": finding.code,
        "message": finding.message,
    }


# Output with --json: one object with every TEDS of every file.


def to_json(files: Sequence[ShownFile]) -> dict[str, Any]:
    """Return ``{"format": "teds/1", "teds": […]}``; the keys of a lone TEDS (or message) are at the top as well."""
    entries = [entry for file in files for entry in _entries(file)]
    bundles = [{"file": file.name, **asdict(file.bundle)} for file in files if file.bundle is not None]
    out: dict[str, Any] = dict(entries[0]) if len(entries) == 1 else {}
    out |= {"format": FORMAT, "teds": entries}
    guard = [guard_to_json(finding) for file in files for finding in file.guard]
    certificates = [file.certificate.to_json() for file in files if file.certificate is not None]
    more = {"guard": guard, "bundles": bundles, "certificates": certificates}
    return out | {name: values for name, values in more.items() if values}


def _entries(file: ShownFile) -> list[dict[str, Any]]:
    if file.message is not None:
        return [{"file": file.name, **_message(file.message)}]
    entries = []
    for number, shown in enumerate(file.teds):
        entry = {"file": file.name, **shown_to_json(shown)}
        conversion = file.conversions.get(number)
        if conversion is not None:
            entry["conversion"] = [finding_to_json(finding) for finding in conversion]
        entries.append(entry)
    return entries


def _message(message: Message) -> dict[str, Any]:
    inside = [describe(with_class(octets)) for _, octets in message.teds]
    code = message.get("access_code")
    out: dict[str, Any] = {
        "edition": message.edition,
        "access_code": code if isinstance(code, int) else None,
        "verdict": "message",
        "findings": [finding_to_json(finding) for finding in message.findings],
        "fields": [_argument(argument) for argument in message.arguments],
        "octets": message.octets.hex(),
        "message": {
            "kind": message.kind,
            "name": message.name,
            "group": message.group,
            "group_name": message.group_name,
            "function": message.function,
            "channel": message.channel,
            "ok": message.ok,
            "school": message.school,
        },
    }
    return out | ({"inside": [shown_to_json(shown) for shown in inside]} if inside else {})


def _argument(argument: Argument) -> dict[str, Any]:
    out = {"name": argument.name, "type": argument.type, "value": value_to_json(argument.value)}
    out["offset"] = argument.offset
    return out | ({"meaning": argument.meaning} if argument.meaning else {})
