"""What ``show`` was given: files read, told apart and put into words, before anything is printed."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadData
from teds_provision.files import open_to_read
from teds_provision.limits import LIMITS
from teds_provision.protocol import handover
from teds_provision.protocol.messages.message import Argument, Message, decode_message, looks_like_message
from teds_provision.teds import convert, decode
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.model import Decoded, Edition, Finding, Verdict
from teds_provision.teds.formats import Block, Kind, class_of, detect, read_blocks, with_class
from teds_provision.teds.formats.jsonform import FORMAT, value_to_json
from teds_provision.teds.guard import check_calibration
from teds_provision.teds.show import Shown, describe, finding_to_json, shown_to_json

if TYPE_CHECKING:
    from teds_provision.protocol.handover.bundle import BundleHeader
    from teds_provision.teds.guard import GuardFinding

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
"""What other files of this program begin with, what they are, and the command that reads them."""


@dataclass(frozen=True)
class ShownFile:
    """One file: its TEDS, or the message or the bundle's header that it holds; ``notes`` are said on stderr."""

    name: str
    kind: Kind
    teds: tuple[Shown, ...] = ()
    message: Message | None = None
    bundle: BundleHeader | None = None
    guard: tuple[GuardFinding, ...] = ()
    notes: tuple[str, ...] = ()
    conversions: Mapping[int, tuple[Finding, ...]] = field(default_factory=dict)

    @property
    def blocks(self) -> list[Block]:
        """The blocks of its TEDS; a message is one block without a place."""
        if self.message is not None:
            return [Block(None, None, self.message.octets)]
        return [shown.block for shown in self.teds]

    @property
    def malformed(self) -> bool:
        """Whether the tuples of a TEDS do not even close, or a message is none."""
        unreadable = self.message is not None and self.message.kind == "unknown"
        return unreadable or any(shown.decoded.verdict is Verdict.MALFORMED for shown in self.teds)


def read_file(name: str) -> bytes:
    """Octets of a file or, for ``-``, of standard input; raises NotFound and, for more than 32 MiB, BadData."""
    if name != STDIN:
        with open_to_read(Path(name)) as file:
            octets = file.read(LIMITS.teds_file + 1)
        if len(octets) <= LIMITS.teds_file:
            return octets
        raise _no_teds(name, octets, f"it has more than {LIMITS.teds_file >> 20} MiB")
    octets = sys.stdin.buffer.read(LIMITS.teds_file + 1)
    if len(octets) > LIMITS.teds_file:
        raise BadData(f"Standard input gives more than {LIMITS.teds_file >> 20} MiB; no file of TEDS has.")
    return octets


def load(name: str, edition: Edition | None = None) -> ShownFile:
    """Read one file and put it into words, converted to ``edition`` where one is asked."""
    bundle = _long_bundle(name)
    if bundle is not None:
        return ShownFile(name, "bundle", bundle=bundle)
    octets = read_file(name)
    kind: Kind | None = None
    if octets.startswith(tuple(_OTHERS)):
        raise _no_teds(name, octets, "")
    try:
        kind = detect(octets)
        if kind == "bundle":
            return ShownFile(name, kind, bundle=handover.bundle.peek_bundle(octets))
        blocks = read_blocks(octets, kind, path=Path(name) if name != STDIN else None)
    except BadData as error:
        raise _of_file(name, kind, error) from error
    if not blocks:
        raise BadData(f"{name} holds no TEDS.")
    if len(blocks) == 1 and is_message(blocks[0].octets):
        return ShownFile(name, kind, message=decode_message(blocks[0].octets))
    return _described(name, kind, blocks, edition)


def _long_bundle(name: str) -> BundleHeader | None:
    """The header of a bundle that is longer than any file of TEDS, read piece by piece; None for everything else."""
    try:
        if name == STDIN or os.stat(name).st_size <= LIMITS.teds_file:  # a pipe has none, and is opened once
            return None
    except (OSError, ValueError):
        return None
    with open_to_read(Path(name)) as file:
        if not file.read(_HEAD_OCTETS).lstrip().startswith(b"{"):
            return None
        try:
            return handover.bundle.peek_bundle(file)
        except BadData:
            return None


def _no_teds(name: str, octets: bytes, why: str) -> BadData:
    """The error for a file of another kind: what it is, and which command reads it, where its first octets tell."""
    for head, (what, command) in _OTHERS.items():
        if octets.startswith(head):
            return BadData(f"{name} holds no TEDS: it is {what}.", hint=f"Read it with: {command.format(name)}")
    return BadData(f"{name} holds no TEDS: {why}.")


def _of_file(name: str, kind: Kind | None, error: BadData) -> BadData:
    """What is wrong with a file, with its name before it."""
    if kind == "hex" and "Line 1 holds" in error.message:  # whatever is text and nothing else is taken for hex
        return BadData(
            f"{name} holds no TEDS: it is neither binary nor hex (read as hex: {error.message[:1].lower()}"
            f"{error.message[1:].rstrip('.')}).",
            hint="TEDS come as binary, hex, Intel HEX, JSON, XML, an image, a profile or a bundle.",
        )
    named = error.message.startswith((f"{name}:", f"{name} "))
    return BadData(error.message if named else f"{name}: {error.message}", hint=error.hint)


def _described(name: str, kind: Kind, blocks: Sequence[Block], edition: Edition | None) -> ShownFile:
    notes = ("The UUID is all zeros: a profile has none.",) if kind == "toml" else ()
    file = ShownFile(name, kind, notes=notes)
    if edition is not None:
        blocks, conversions = _converted(blocks, edition)
        file = replace(file, conversions=conversions)
    beside = placed(blocks)
    shown = tuple(describe(block, beside) for block in blocks)
    return replace(file, teds=shown, guard=_guard(beside))


def is_message(octets: bytes) -> bool:
    """Whether octets are a message rather than a TEDS."""
    if looks_like_message(octets):
        return True

    return class_of(octets) is None and decode(octets).verdict is Verdict.MESSAGE


def placed(blocks: Sequence[Block]) -> dict[tuple[int, int], bytes]:
    """TEDS by (channel, access code); lone channel TEDS and calibrations without a channel count as channel 1."""
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
    from datetime import UTC, datetime

    return tuple(check_calibration(beside, now=datetime.now(UTC)))


def _converted(blocks: Sequence[Block], edition: Edition) -> tuple[list[Block], dict[int, tuple[Finding, ...]]]:
    out: list[Block] = []
    said: dict[int, tuple[Finding, ...]] = {}
    for number, block in enumerate(blocks):
        decoded: Decoded = decode(block.octets)
        try:
            octets, findings = convert(decoded, edition)
        except BadData as error:
            octets, findings = block.octets, [Finding("error", "not-converted", error.message)]
        out.append(block._replace(octets=octets))
        said[number] = tuple(findings)
    return out, said


def guard_to_json(finding: GuardFinding) -> dict[str, Any]:
    """One finding of the guard as a JSON object."""
    return {
        "severity": finding.severity,
        "channel": finding.channel,
        "code": finding.code,
        "message": finding.message,
    }


# ``show`` for machines: one object with every TEDS of every file.


def to_json(files: Sequence[ShownFile]) -> dict[str, Any]:
    """Return ``{"format": "teds/1", "teds": […]}``; the keys of a lone TEDS (or message) stand on top as well."""
    entries = [entry for file in files for entry in _entries(file)]
    bundles = [{"file": file.name, **asdict(file.bundle)} for file in files if file.bundle is not None]
    out: dict[str, Any] = dict(entries[0]) if len(entries) == 1 else {}
    out |= {"format": FORMAT, "teds": entries}
    guard = [guard_to_json(finding) for file in files for finding in file.guard]
    return out | ({"guard": guard} if guard else {}) | ({"bundles": bundles} if bundles else {})


def _entries(file: ShownFile) -> list[dict[str, Any]]:
    if file.message is not None:
        return [{"file": file.name, **_message(file.message)}]
    entries = []
    for number, shown in enumerate(file.teds):
        entry = {"file": file.name, **shown_to_json(shown)}
        said = file.conversions.get(number)
        if said is not None:
            entry["conversion"] = [finding_to_json(finding) for finding in said]
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
