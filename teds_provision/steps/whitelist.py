"""The whitelist: which nodes may be keyed and written, each by UUID and by the fingerprint of its key.

A pinned key is never replaced by a command that adds; the entry has to be removed first (profile.md,
"Keys and trust").
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from teds_provision.errors import OtherKey, PolicyRefused, UsageFailure
from teds_provision.protocol.fingerprints import same_key
from teds_provision.station.station import Station
from teds_provision.steps.whitelist_files import FIELDS, FORMATS, Listed
from teds_provision.store import WhitelistEntry, pages

_SHOWN = 5


@dataclass(frozen=True)
class Plan:
    """What adding some entries would do: the ones to write, how many of them are new, and how many stay."""

    write: tuple[WhitelistEntry, ...]
    new: int
    unchanged: int


def plan_addition(station: Station, listed: Sequence[Listed]) -> Plan:
    """Hold entries against what is known; changes nothing.

    Raises OtherKey where a UUID is pinned to another key, PolicyRefused for a revoked node: then none may be added.
    """
    revoked = {one.uuid: one.why for one in station.policy.revocations()}
    _refuse_revoked([entry.uuid for entry in listed if entry.uuid in revoked], revoked)
    write: list[WhitelistEntry] = []
    conflicts: list[tuple[Listed, str]] = []
    new = 0
    for page in pages(listed):
        uuids = [entry.uuid for entry in page]
        present = station.pins.of_page(uuids)
        pinned = station.pins.among(station.nodes.of_page(uuids).values(), present.values())
        for entry in page:
            known, pin = present.get(entry.uuid), pinned.get(entry.uuid)
            if pin is not None and _names_another_key(entry, pin):
                conflicts.append((entry, pin))
                continue
            wanted = _merged(known, entry)
            if wanted != known:
                write.append(wanted)
                new += known is None
    _refuse_conflicts(conflicts)
    return Plan(tuple(write), new, len(listed) - len(write))


def _names_another_key(entry: Listed, pin: str) -> bool:
    return entry.fingerprint is not None and not same_key(pin, entry.fingerprint)


def _merged(known: WhitelistEntry | None, entry: Listed) -> WhitelistEntry:
    if known is None:
        assurance = "uuid" if entry.fingerprint is None else "import"
        return WhitelistEntry(entry.uuid, entry.fingerprint, assurance=assurance, name=entry.name)  # type: ignore[arg-type]
    gains = known.fingerprint is None and entry.fingerprint is not None
    pin = max(known.fingerprint or "", entry.fingerprint or "", key=len) or None
    return replace(
        known,
        fingerprint=pin,
        assurance="import" if gains and known.assurance == "uuid" else known.assurance,
        name=known.name or entry.name,
    )


def _refuse_revoked(uuids: list[bytes], why: dict[bytes, str]) -> None:
    if uuids:
        shown = ", ".join(f"{uuid.hex()} ({why[uuid]})" for uuid in uuids[:_SHOWN])
        raise PolicyRefused(f"Revoked nodes are not whitelisted: {shown}{_more(uuids)}.", hint="Nothing was added.")


def _refuse_conflicts(conflicts: list[tuple[Listed, str]]) -> None:
    if conflicts:
        shown = "; ".join(
            f"{entry.uuid.hex()} is pinned to the key {pin[:32]}, not {str(entry.fingerprint)[:32]}"
            for entry, pin in conflicts[:_SHOWN]
        )
        first = conflicts[0][0].uuid.hex()
        raise OtherKey(
            f"{shown}{_more(conflicts)}.",
            hint=f"Nothing was added. If a board was really replaced: teds-provision whitelist remove {first}",
        )


def _more(items: Sequence[object]) -> str:
    return f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""


def add(station: Station, plan: Plan, *, source: str | None = None) -> None:
    """Carry out a plan in one transaction, with one entry of the audit log; ``source`` is the file it came from."""
    if not plan.write:
        return
    with station.transaction():
        station.pins.put(*plan.write)
        if source is None:
            (entry,) = plan.write
            station.audit("whitelist", entry.uuid, "added", fingerprint=entry.fingerprint, assurance=entry.assurance)
        else:
            station.audit("whitelist", None, "imported", file=source, entries=len(plan.write), new=plan.new)


def remove(station: Station, uuid: bytes) -> bool:
    """Take a node off the whitelist and forget its pinned key; False where there was neither.

    Epoch, sequence and link keys stay: they still count when the node comes back. A replaced board under the same UUID
    can be pinned anew from here on.
    """
    with station.transaction():
        pinned = is_pinned(station, uuid)
        station.pins.let_go(uuid)
        removed = station.pins.remove(uuid)
        if removed or pinned:
            station.audit("whitelist", uuid, "removed" if removed else "unpinned")
    return removed or pinned


def is_pinned(station: Station, uuid: bytes) -> bool:
    """Whether a key of this UUID is known, be it whitelisted or not."""
    return station.pins.pinned(uuid) is not None


def as_dict(entry: WhitelistEntry) -> dict[str, Any]:
    """One entry as the command-line contract shows it."""
    return {
        "uuid": entry.uuid.hex(),
        "fingerprint": entry.fingerprint,
        "added": entry.added,
        "assurance": entry.assurance,
        "name": entry.name,
    }


def form_of(path: Path, form: str | None) -> str:
    """Format to write: ``form``, else by extension, else XML; raises UsageFailure for an extension that is none."""
    suffix = path.suffix.lower().removeprefix(".")
    if form is not None or suffix in FORMATS:
        return form or suffix
    if suffix:
        raise UsageFailure(f"{path.name} does not say which format is meant.", hint="Add --format xml, csv or json.")
    return "xml"


def render(entries: Iterable[WhitelistEntry], form: str) -> Iterator[str]:
    """The whitelist as text, a line or more at a time: XML of the NCAP with our attributes, CSV with a header, JSON."""
    rows = map(as_dict, entries)
    if form == "json":
        yield json.dumps({"whitelist": list(rows)}, indent=1, ensure_ascii=False) + "\n"
    elif form == "csv":
        yield _csv_line(dict.fromkeys(FIELDS), names=True)
        yield from map(_csv_line, rows)
    else:
        yield '<?xml version="1.0" encoding="UTF-8"?>\n<whitelist>\n'
        yield from map(_xml_line, rows)
        yield "</whitelist>\n"


def _csv_line(row: Mapping[str, Any], *, names: bool = False) -> str:
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, FIELDS, lineterminator="\n")
    if names:
        writer.writeheader()
    else:
        writer.writerow(row)
    return out.getvalue()


def _xml_line(row: Mapping[str, Any]) -> str:
    attributes = {**row, "uuid": f"0x{row['uuid']}"}
    shown = " ".join(f"{key}={_quoted(_legal(value))}" for key, value in attributes.items() if value is not None)
    return f"  <transducer {shown}/>\n"


def _quoted(text: str) -> str:
    """An attribute's value with its quotes (XML 1.0 section 2.3)."""
    for character, entity in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
        text = text.replace(character, entity)
    return f'"{text}"'


def _legal(text: str) -> str:
    """What XML 1.0 can hold; a name that a node or an older version brought may have control characters."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)
