"""The datasheet that a board brought itself: shown with its findings, and signed after an operator's confirmation.

Its author is not trusted, so it is judged as a profile is, and more strictly: the guard, every finding of severity
error, names and texts that people and topics will see. The board's own claims decide nothing: the confirmation does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.protocol.datasheet import can_be_stored, passes_own_check
from teds_provision.sanitize import printable
from teds_provision.station.station import Station
from teds_provision.teds import guard as guarding
from teds_provision.teds.channel import Channel
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Field
from teds_provision.teds.codec.tables import TEXT_BASED, name_of
from teds_provision.teds.formats import stated_uuid
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile.model import renamed
from teds_provision.teds.profile.reader import NAME_OCTETS
from teds_provision.teds.sheet import Sheet

_NAME: Final = (0, int(AccessCode.NAME))
_PREFIX: Final = 4
"""Number of digits from which a text means a UUID."""


@dataclass(frozen=True)
class FactoryDatasheet:
    """A board's own datasheet: ``image`` is what would be signed, ``name`` the node's, "" if it has none.

    ``errors`` need a reason, ``warnings`` are for information; a sentence each.
    """

    image: Image
    name: str
    channels: tuple[Channel, ...]
    errors: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def findings(self) -> list[dict[str, str]]:
        """For the API and --json: ``severity``, ``message``."""
        both = (("error", self.errors), ("warning", self.warnings))
        return [{"severity": severity, "message": text} for severity, texts in both for text in texts]


class NotAdoptedError(PolicyError):
    """A board's own datasheet was not signed; ``brought`` is that datasheet with its findings."""

    code = "not-adopted"

    def __init__(self, message: str, brought: FactoryDatasheet, *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.datasheet = brought


def refuse_adoption(brought: FactoryDatasheet) -> None:
    """Refuse, as without a terminal there is no confirmation. Raises NotAdoptedError."""
    raise NotAdoptedError(
        f"Node {brought.image.uuid.hex()} brought its own datasheet, which is not approved for signing yet.",
        brought,
        hint="Check it, then add --yes; or write your own datasheet: --profile.",
    )


def read_factory_datasheet(station: Station, image: Image, *, name: str | None = None) -> FactoryDatasheet:
    """Return the judged datasheet of a board's TEDS; ``name`` replaces its own name.

    Raises BadDataError (no datasheet, damaged or hostile TEDS, another node's), PolicyError (another node's name).
    """
    blocks = dict(image.unsigned_blocks())
    if name is not None:
        blocks = renamed(blocks, name)
    uuid = image.uuid.hex()
    for (channel, code), octets in blocks.items():
        if not can_be_stored((channel, code)) or not passes_own_check((channel, code), octets):
            raise _refused(uuid, f"TEDS {code} of channel {channel} is damaged, or is one that no node can store")
    found = Image(image.uuid, blocks)
    sheet = Sheet.from_image(found)
    if not sheet.channels:
        raise BadDataError(
            f"Node {uuid} has no datasheet of its own: no TransducerChannel TEDS.",
            hint="To write one: provision --profile P.",
        )
    meant = stated_uuid(blocks)
    if meant is not None and meant != image.uuid:
        raise _refused(uuid, f"it belongs to node {meant.hex()}")
    for block, octets in blocks.items():
        for why in _strange_texts(block, octets):
            raise _refused(uuid, why)
    own = sheet.meta.name
    _require_own_name(station, image.uuid, own)
    errors, warnings = _wrong_with(sheet, blocks)
    return FactoryDatasheet(found, own, sheet.channels, _once(errors), _once(warnings))


def _wrong_with(sheet: Sheet, blocks: Mapping[BlockId, bytes]) -> tuple[list[str], list[str]]:
    """Return errors and warnings of a datasheet that can be signed: of its TEDS, channels and calibrations."""
    errors = [f"{name_of(finding.access_code)}: {finding.message}" for finding in sheet.errors]
    warnings = [
        f"{name_of(finding.access_code)}: {finding.message}"
        for finding in sheet.findings
        if finding.severity == "warning"
    ]
    warnings += [channel.value_problem for channel in sheet.channels if channel.value_problem and not channel.actuator]
    if any(code == AccessCode.CALIBRATION for _, code in blocks):
        for finding in guarding.check_calibration(blocks):
            text = f"channel {finding.channel}: {finding.message}."
            (errors if finding.severity == "error" else warnings).append(text)
    return errors, warnings


def require_a_reason(station: Station, brought: FactoryDatasheet, reason: str | None) -> None:
    """Raise NotAdoptedError if it has errors and no reason was given to accept them; that reason is logged."""
    if not brought.errors:
        return
    if reason is None:
        more = f" (and {len(brought.errors) - 1} more)" if len(brought.errors) > 1 else ""
        raise NotAdoptedError(
            f"The board's own datasheet is refused: {brought.errors[0].rstrip('.')}{more}.",
            brought,
            hint='Write your own: --profile. Or, if it is correct, give a reason: --accept-calibration "why".',
        )
    station.audit("accept-datasheet", brought.image.uuid, "accepted", why=reason, findings=list(brought.errors))


def _require_own_name(station: Station, uuid: bytes, name: str) -> None:
    if not name:
        return
    others = [other for other in station.nodes.all_named(name) if other != uuid]
    digits = name.lower().removeprefix("0x")
    if len(digits) >= _PREFIX and not set(digits) - set("0123456789abcdef"):
        others += [
            record.uuid
            for record in station.nodes.all()
            if record.uuid.hex().startswith(digits) and record.uuid != uuid
        ]
    if others:
        raise PolicyError(
            f"Node {uuid.hex()} calls itself {name!r}, but node {others[0].hex()} already has that name.",
            hint="Choose another name: --name NAME.",
        )


def _refused(uuid: str, why: str) -> BadDataError:
    return BadDataError(
        f"The datasheet that node {uuid} brought cannot be signed: {why}.",
        hint="Write your own: provision --profile P.",
    )


def _strange_texts(block: BlockId, octets: bytes) -> Iterator[str]:
    """Yield why a name or text must not be shown to people, topics and terminals."""
    decoded = decode(octets)
    where = f"{decoded.name} of channel {block[0]}" if block[0] else decoded.name
    for field in _leaves(decoded.fields):
        if isinstance(field.value, str) and not _is_shown(field.value, block) and "-----BEGIN" not in field.value:
            yield f"{field.name} in its {where} contains unprintable characters"
        elif field.name == "TCName":
            if not isinstance(field.value, str):
                yield f"the name in its {where} is no text"
            elif len(field.value.encode()) > NAME_OCTETS:
                yield f"the name in its {where} has more than {NAME_OCTETS} octets"
    if block[1] in TEXT_BASED:
        for text in decoded.text:
            letters = text.decode(errors="replace")
            if any(not letter.isprintable() and letter not in "\n\r\t" for letter in letters):
                yield f"a text in its {where} contains unprintable characters"


def _is_shown(text: str, block: BlockId) -> bool:
    """Return True if a text has printable letters only; the lines of TEDS 130 and 131 end in LF."""
    lines = block[1] in (AccessCode.ORIGIN, AccessCode.CERTIFICATE)
    return (text.replace("\n", "") if lines else text).isprintable()


def _leaves(fields: tuple[Field, ...]) -> Iterator[Field]:
    for field in fields:
        yield field
        yield from _leaves(field.children)


def _once(texts: list[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(printable, texts)))
