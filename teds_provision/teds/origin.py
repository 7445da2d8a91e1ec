"""Origin TEDS (access code 130): what a wrapped node has its values from (teds.md, "130 OriginTEDS").

It marks a node that wraps a sensor which cannot prove anything itself. Its absence proves nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, cast, get_args

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.text_lines import compose_lines, lines_of, read_lines, values_of
from teds_provision.teds.image import BlockId

OriginKind = Literal["dbc", "eds", "iio"]
ORIGIN: Final[BlockId] = (0, AccessCode.ORIGIN)
"""Place of the Origin TEDS."""
_KINDS: Final = frozenset(get_args(OriginKind))
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_ORDERS: Final = (("kind", "name", "sha256"), ("kind", "name"))
_WORDS: Final = {"dbc": "CAN message", "eds": "CANopen device", "iio": "IIO device"}


@dataclass(frozen=True)
class Origin:
    """``name`` is the message or device; ``sha256`` the digest of its DBC or EDS file (64 digits), "" for IIO."""

    kind: OriginKind
    name: str
    sha256: str = ""

    def __post_init__(self) -> None:
        if self.kind not in _KINDS:
            raise BadDataError(f"A node wraps dbc, eds or iio, not {self.kind!r}.")
        if not self.name:
            raise BadDataError("A wrapped sensor has no name.")
        if self.kind == "iio" and self.sha256:
            raise BadDataError("An IIO device has no file, so there is no digest of it.")
        if self.kind != "iio" and not _DIGEST.fullmatch(self.sha256):
            raise BadDataError("The digest of a wrapped sensor's file has 64 hex digits, in lower case.")

    def encode(self) -> bytes:
        """Return the framed TEDS; raises BadDataError if the name is too long or not printable."""
        values = {"kind": self.kind, "name": self.name}
        return compose_lines(AccessCode.ORIGIN, values | ({"sha256": self.sha256} if self.sha256 else {}))

    @property
    def lines(self) -> str:
        """The text of the TEDS."""
        return lines_of({"kind": self.kind, "name": self.name} | ({"sha256": self.sha256} if self.sha256 else {}))

    @property
    def text(self) -> str:
        """``CAN message Torque (dbc)``."""
        return f"{_WORDS[self.kind]} {self.name} ({self.kind})"

    def to_json(self) -> dict[str, str | None]:
        """Return what ``wrapped`` and ``origin`` hold in JSON."""
        return {"kind": self.kind, "name": self.name, "sha256": self.sha256 or None}


def read_origin(teds: bytes) -> Origin:
    """Return the origin in a framed Origin TEDS; raises BadDataError for any form but the one of the profile."""
    return _origin(read_lines(AccessCode.ORIGIN, teds, *_ORDERS))


def _origin(values: Mapping[str, str]) -> Origin:
    return Origin(cast("OriginKind", values["kind"]), values["name"], values.get("sha256", ""))


def origin_from_text(text: str) -> Origin:
    """Return the origin from the text of its TEDS; raises BadDataError for any form but the one of the profile."""
    return _origin(values_of(AccessCode.ORIGIN, text, *_ORDERS))


def origin_of(blocks: Mapping[BlockId, bytes]) -> Origin | None:
    """Return the origin among framed TEDS by place; None if the node is not wrapped, or another maker uses the code."""
    teds = blocks.get(ORIGIN)
    if teds is None:
        return None
    try:
        return read_origin(teds)
    except BadDataError:
        return None
