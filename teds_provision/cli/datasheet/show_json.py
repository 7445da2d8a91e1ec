"""``show`` for machines: one object with every TEDS of every file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from teds_provision.cli.datasheet.show_files import ShownFile, guard_to_json
from teds_provision.protocol.messages.message import Argument, Message
from teds_provision.teds.formats import with_class
from teds_provision.teds.formats.jsonform import FORMAT, value_to_json
from teds_provision.teds.show import describe, finding_to_json, shown_to_json


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
