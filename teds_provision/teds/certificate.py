"""Certificate TEDS (access code 131), of a channel's calibration (teds.md, "131 CertificateTEDS").

It is written with the Calibration TEDS of its channel and goes with it. A zero offset set later leaves both.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.text_lines import MOST_OCTETS, compose_lines, read_lines
from teds_provision.teds.image import BlockId

_KEYS: Final = ("certificate", "laboratory", "date", "sha256")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_DATE: Final = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")
_CUT: Final = "…"


ChooseItem = Callable[[str, Sequence[tuple[str, str]]], str]
"""Asked which result of a certificate is meant: the question, and (id, title) of each; returns an id."""


def split_channel(text: str) -> tuple[int | None, str]:
    """Return channel and file of ``2=cell.xml``; None without a number before the file."""
    number, equals, file = text.partition("=")
    if equals and file and number.isascii() and number.isdecimal() and len(number) < 4:
        return int(number), file
    return None, text


@dataclass(frozen=True)
class CertificateChoice:
    """Choices for reading a certificate: the channel, the item, and the trusted signers (PEM)."""

    channel: int | None = None
    item: str | None = None
    trusted: tuple[bytes, ...] = ()
    choose: ChooseItem | None = field(default=None, compare=False)


@dataclass(frozen=True)
class CertificateReference:
    """Number, laboratory, day (ISO 8601) and digest of a certificate's file.

    ``signature`` is ``good`` or ``not checked`` for a certificate that was just read, "" for one that a TEDS names;
    ``notes`` are sentences about what was not checked.
    """

    number: str
    laboratory: str
    date: str
    sha256: str
    signature: str = field(default="", compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)

    def encode(self) -> bytes:
        """Return the framed TEDS; a long name of the laboratory is cut. Raises BadDataError for a long number."""
        values = dict(zip(_KEYS, (self.number, self.laboratory, self.date, self.sha256), strict=True))
        spare = MOST_OCTETS - sum(len(f"{key}={value}\n".encode()) for key, value in values.items())
        if spare < 0:
            octets = self.laboratory.encode()
            kept = octets[: max(len(octets) + spare - len(_CUT.encode()), 0)].decode(errors="ignore").rstrip()
            values["laboratory"] = kept + _CUT
        return compose_lines(AccessCode.CERTIFICATE, values)

    def to_json(self) -> dict[str, str]:
        """Return what ``calibration`` holds in JSON."""
        return {
            "certificate": self.number,
            "laboratory": self.laboratory,
            "date": self.date,
            "sha256": self.sha256,
        } | ({"signature": self.signature} if self.signature else {})


def read_certificate_reference(teds: bytes) -> CertificateReference:
    """Return the reference in a framed Certificate TEDS; raises BadDataError for any form but the profile's."""
    values = read_lines(AccessCode.CERTIFICATE, teds, _KEYS)
    if not _DIGEST.fullmatch(values["sha256"]) or not _DATE.fullmatch(values["date"]) or not values["certificate"]:
        raise BadDataError("The Certificate TEDS has no number, date or digest in the form of the profile.")
    return CertificateReference(values["certificate"], values["laboratory"], values["date"], values["sha256"])


def certificate_reference_of(blocks: Mapping[BlockId, bytes], channel: int) -> CertificateReference | None:
    """Return the certificate of a channel's calibration among framed TEDS by place; None without one of our form."""
    teds = blocks.get((channel, AccessCode.CERTIFICATE))
    if teds is None:
        return None
    try:
        return read_certificate_reference(teds)
    except BadDataError:
        return None
