"""A station's statement about a node or about itself: one event of a page (contract/plant.md section 2).

An event that is not of its form is skipped by every reader, and reported; it never ends a chain. One of an unknown
``act`` and unknown members are skipped too and stay in the page, for a newer version.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from teds_provision.protocol.keys import fingerprint, reset_message, verify
from teds_provision.protocol.messages.firmware import is_stated
from teds_provision.protocol.plant.document import hash_of, is_form, is_name, is_number, is_text

MOST_OCTETS: Final = 16 << 10
MOST_OCTETS_OF_REVOKED: Final = 20 << 10

_Form = Callable[[object], bool]


def _of(form: str) -> _Form:
    return lambda value: is_form(form, value)


def _hex(octets: int) -> _Form:
    def holds(value: object) -> bool:
        if not isinstance(value, str) or len(value) != 2 * octets:
            return False
        return value.isascii() and value.isalnum() and value == value.lower() and _reads(value)

    return holds


def _reads(digits: str) -> bool:
    try:
        bytes.fromhex(digits)
    except ValueError:
        return False
    return True


def _one_of(*words: str) -> _Form:
    return lambda value: isinstance(value, str) and value in words


def _or_none(form: _Form) -> _Form:
    return lambda value: value is None or form(value)


_sha256, _key_id, _random_id = _of("sha256"), _of("digits"), _of("random_id")
_handed: Final[dict[str, _Form]] = {
    "epoch": is_number, "key_id": _key_id, "peer": _sha256, "mode": _one_of("copy", "move"), "bundle": _random_id,
}  # fmt: skip
_not_handed: Final[dict[str, _Form]] = {"bundle": _random_id, "peer": _sha256, "why": is_text}
_signed: Final[dict[str, _Form]] = {"epoch": is_number, "sequence": is_number, "teds_sha256": _sha256}
_job: Final = _or_none(_random_id)

FORMS: Final[dict[str, dict[str, _Form]]] = {
    "pinned": {"fingerprint": _sha256, "assurance": _one_of("tap", "bus", "uuid", "import", "registry")},
    "unpinned": {},
    "agreed": {"fingerprint": _sha256, "epoch": is_number, "key_id": _key_id},
    "signed": _signed,
    "written": {
        **_signed, "profile": _or_none(is_text), "profile_sha256": _or_none(_sha256), "due": _or_none(is_text),
    },
    "vouched": {"teds_sha256": _sha256},
    "gave": _handed,
    "took": _handed,
    "undone": _not_handed,
    "refused": _not_handed,
    "forgot": {"epoch": is_number},
    "reset": {"epoch": is_number, "challenge": _hex(32), "proof": _hex(64), "point": _of("point")},
    "revoked": {"statement": lambda value: isinstance(value, str)},
    "lifted": {"of": _sha256},
    "named": {"name": is_name},
    "grouped": {"group": is_name, "member": lambda value: isinstance(value, bool)},
    "firmware": {"runs": _or_none(is_stated)},
    "evidence": {"sha256": _sha256, "job": _job, "unit": _or_none(is_number), "verdict": is_text},
    "closed": {"job": _random_id},
    "alarm": {"code": is_text, "about": _or_none(_sha256), "n": is_number},
}  # fmt: skip
"""The members of each act, beside ``act``, ``id``, ``at`` and ``uuid``."""

OF_UNIT: Final[dict[str, _Form]] = {"job": _random_id, "unit": is_number}
"""Members that an office adds to a ``signed`` event: the unit that it signed for. Other readers ignore both."""

WITHOUT_NODE: Final = frozenset({"lifted", "closed", "alarm"})
"""Acts that are about no node."""


class Event(NamedTuple):
    """One event of its form: act, ``id`` (16 hex digits), time, the node (10 octets, or none), all members."""

    act: str
    id: str
    at: str
    uuid: bytes | None
    members: Mapping[str, Any]


def made(act: str, id: str, at: str, uuid: bytes | None, members: Mapping[str, Any]) -> dict[str, Any]:
    """Return an event to be written, its members in the order of the contract; a caller's mistake raises ValueError."""
    event: dict[str, Any] = {"act": act, "id": id, "at": at}
    if uuid is not None:
        event["uuid"] = uuid.hex()
    named = [*FORMS[act], *(OF_UNIT if act == "signed" and "job" in members else ())]
    event |= {name: members[name] for name in named}
    found = read(event)
    if not isinstance(found, Event) or len(members) != len(named):
        raise ValueError(f"{act} is not of its form: {found}")
    return event


def read(value: object) -> Event | str | None:
    """Return an event, why it is not of its form, or None for an act that this version does not know."""
    if not isinstance(value, dict):
        return "an event is no object"
    act = value.get("act")
    if not isinstance(act, str):
        return "an event names no act"
    forms = FORMS.get(act)
    if forms is None:
        return None
    if not is_form("digits", value.get("id")) or not is_form("time", value.get("at")):
        return f"{act}: no good id or time"
    node = None
    if act not in WITHOUT_NODE:
        if not is_form("uuid", value.get("uuid")):
            return f"{act}: no good uuid"
        node = bytes.fromhex(value["uuid"])
    for name, holds in forms.items():
        if name not in value or not holds(value[name]):
            return f"{act}: {name} is not of its form"
    # otherwise the forms of its members limit its size
    if act == "revoked" or len(value) > len(forms) + 3 + (node is not None):
        octets = json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode(errors="surrogatepass")
        if len(octets) > (MOST_OCTETS_OF_REVOKED if act == "revoked" else MOST_OCTETS):
            return f"{act}: larger than an event may be"
    return Event(act, value["id"], value["at"], node, value)


def unit_of(event: Event) -> tuple[str, int] | None:
    """Return the job and unit of an ``evidence`` event, or of an office's ``signed`` one; None for none."""
    job, unit = event.members.get("job"), event.members.get("unit")
    if (
        event.act not in ("evidence", "signed")
        or not unit
        or not all(holds(event.members[name]) for name, holds in OF_UNIT.items())
    ):
        return None
    return str(job), int(unit)


def reset_proven(event: Event) -> str | None:
    """Return the fingerprint of the node's key that signed this ``reset``, None if the proof is not good."""
    assert event.uuid is not None
    point = bytes.fromhex(event.members["point"])
    message = reset_message(event.uuid, event.members["epoch"], bytes.fromhex(event.members["challenge"]))
    return fingerprint(point) if verify(point, message, bytes.fromhex(event.members["proof"])) else None


def hash_of_statement(statement: str) -> str:
    """Return H of a statement's signed text: the same for either s of its signature."""
    return hash_of(statement.encode())
