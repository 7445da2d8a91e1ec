"""Value tables: texts of raw numbers, in the Channel Identification TEDS of a wrapped sensor's channel.

``<Signal name="…" comment="…"><Value raw="1">measuring</Value>…</Signal>``; ``raw`` is the raw number of a sample.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from teds_provision.lazy import late
from teds_provision.teds.codec.model import DecodedTeds

if TYPE_CHECKING:
    from xml.sax import saxutils
else:
    saxutils = late("xml.sax.saxutils")  # it imports urllib and http, and few datasheets have a value table

MOST_ROWS: Final = 64
_MOST_COMMENT: Final = 200
_MOST_OCTETS: Final = 16_384
_ROW: Final = re.compile(r'<Value raw="(\d{1,19})">([^<>]{1,128})</Value>')


def signal_xml(name: str, comment: str, rows: Mapping[int, str]) -> str:
    """Return the XML of a signal; "" if there is neither a comment nor a row."""
    kept = sorted(rows.items())[:MOST_ROWS]
    values = "".join(f'<Value raw="{raw}">{saxutils.escape(text)}</Value>' for raw, text in kept)
    if not comment and not values:
        return ""
    described = f" comment={saxutils.quoteattr(comment[:_MOST_COMMENT])}" if comment else ""
    return f"<Signal name={saxutils.quoteattr(name)}{described}>{values}</Signal>"


def read_value_table(teds: DecodedTeds | None) -> dict[int, str]:
    """Return the texts by raw number of a Channel Identification TEDS; empty for one of another form. Never raises."""
    for octets in teds.text if teds is not None else ():
        text = octets[:_MOST_OCTETS].decode(errors="replace")
        if not text.startswith("<Signal "):
            continue
        rows = {int(raw): saxutils.unescape(word) for raw, word in _ROW.findall(text)[:MOST_ROWS]}
        return {raw: word for raw, word in rows.items() if word.isprintable()}
    return {}
