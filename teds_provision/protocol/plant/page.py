"""Pages: a station's statements, in its own chain (contract/plant.md section 2).

Of another station's page only ``format``, ``registry``, ``station``, ``n``, ``previous``, ``events`` (a list) and its
octets are required; faults inside are skipped and reported. Limits on numbers bind the writer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import PrivateKey, fingerprint
from teds_provision.protocol.plant.document import (
    PAGE,
    Fields,
    is_form,
    is_number,
    is_time,
    open_document,
    payload,
    sign_document,
)

MOST_EVENTS: Final = 1000
MOST_PAYLOAD: Final = 700_000
"""So a page of any station stays below what readers take, with base64url and signature."""
MOST_HEADS: Final = 2048


@dataclass(frozen=True)
class Page:
    """A page under a good signature. ``station`` signed it; ``hash`` is H, ``previous`` that of the page before.

    ``previous`` of page 1 is "". ``home`` (16 digits), ``created`` and ``heads`` are "", "" and empty if they are not
    of their form.
    """

    station: str
    number: int
    hash: str
    previous: str
    home: str
    created: str
    heads: Mapping[str, tuple[int, str]] = field(repr=False)
    events: Sequence[Any] = field(repr=False)
    octets: bytes = field(repr=False)


def open_page(octets: bytes, registry: str, find_key: Callable[[str], bytes | None]) -> Page:
    """Read a page of a member of this registry.

    Raises NotAuthenticError or BadDataError (no member's page: junk), NewerFormatError (the chain waits).
    """
    document = open_document(octets, find_key, PAGE)
    fields = Fields(document.members, "The page")
    if fields.text_of_form("random_id", "registry") != registry:
        raise BadDataError("The page is of another registry.")
    if fields.text_of_form("sha256", "station") != document.signer:
        raise BadDataError("The page names another station than the one that signed it.")
    n = fields.number("n", 1)
    previous = fields.members.get("previous")
    if not (is_form("sha256", previous) if n > 1 else previous == ""):
        raise fields.bad("previous", "is not H of the page before")
    events = fields.members.get("events", [])
    if not isinstance(events, list):
        raise fields.bad("events", "is no list")
    home, created = fields.members.get("home"), fields.members.get("created")
    return Page(
        document.signer,
        n,
        document.hash,
        str(previous),
        str(home) if is_form("digits", home) else "",
        str(created) if is_time(created) else "",
        _heads(fields.members.get("heads")),
        events,
        octets,
    )


def _heads(value: object) -> dict[str, tuple[int, str]]:
    """Return the heads that have the right form."""
    if not isinstance(value, dict) or len(value) > MOST_HEADS:
        return {}
    return {
        station: (head[0], head[1])
        for station, head in value.items()
        if is_form("sha256", station)
        and isinstance(head, list)
        and len(head) == 2
        and is_number(head[0])
        and is_form("sha256", head[1])
    }


@dataclass(frozen=True)
class PageDraft:
    """Content of the next page of a station, beside its events."""

    registry: str
    number: int
    previous: str
    home: str
    created: datetime
    heads: Mapping[str, tuple[int, str]]
    audit: tuple[int, str]


def sign_page(draft: PageDraft, events: Sequence[Mapping[str, Any]], key: PrivateKey) -> bytes:
    """Sign a page; raises BadDataError if it exceeds the limits of a page."""
    if len(events) > MOST_EVENTS:
        raise BadDataError(f"A page takes {MOST_EVENTS} events, not {len(events)}.")
    members = {
        "format": PAGE.format,
        "registry": draft.registry,
        "station": fingerprint(key.point),
        "n": draft.number,
        "previous": draft.previous,
        "home": draft.home,
        "created": time_text(draft.created),
        "heads": {station: list(head) for station, head in sorted(draft.heads.items())},
        "audit": list(draft.audit),
        "events": list(events),
    }
    if len(payload(members)) > MOST_PAYLOAD:
        raise BadDataError(f"The payload of a page has at most {MOST_PAYLOAD} octets.")
    return sign_document(members, key, PAGE)
