"""What lies on the reader: a node with the profile's service, or something else that deserves a word."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from teds_provision.errors import BadData, Garbled
from teds_provision.links.hints import BleAddress, Charging
from teds_provision.links.nfc import hints, message, tnep
from teds_provision.links.nfc.message import Record
from teds_provision.links.nfc.tag import ReaderTag
from teds_provision.protocol.messages.identity import Identity


@dataclass(frozen=True)
class Visit:
    """A node in the field: its tag as activated, its service, and what it says of itself."""

    tag: ReaderTag
    service: tnep.ServiceParameters
    identity: Identity
    charging: Charging | None = None
    ble: BleAddress | None = None


@dataclass(frozen=True)
class Foreign:
    """A tag that is no node of ours; ``text`` says what it is."""

    tag: ReaderTag
    text: str


def look(tag: ReaderTag) -> Visit | Foreign:
    """Read the initial message and say what the tag is; raises FieldLost and ReaderLost."""
    try:
        records = message.decode(tag.read())
    except Garbled as error:
        return Foreign(tag, _described(tag, error.message))
    service = tnep.our_service(records)
    if service is None:
        return Foreign(tag, _described(tag, f"It holds {_listed(records)}."))
    payload = tnep.external(records, tnep.ID_TYPE)
    if payload is None:
        return Foreign(tag, _described(tag, "It offers the service but does not say who it is (no id record)."))
    try:
        identity = Identity.decode(payload)
    except BadData as error:
        return Foreign(tag, _described(tag, error.message))
    return Visit(tag, service, identity, hints.charging(records), hints.ble_address(records))


def _described(tag: ReaderTag, what: str) -> str:
    return f"A tag that is not a node of this profile: {tag.kind}, UID {tag.uid.hex().upper()}. {what}"


def _listed(records: Sequence[Record]) -> str:
    names = [f"{record.name or 'a record'} ({len(record.payload)} octets)" for record in records]
    return "the NDEF records " + ", ".join(names) if names else "an empty NDEF message"
