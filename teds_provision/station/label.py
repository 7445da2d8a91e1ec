"""The label on a board: ``TEDS1:UUID:FINGERPRINT`` as QR code and text, and what a scanner types of it.

A scanner that types as a keyboard knows nothing of the layout that the computer has. The separators come out as
something else, on some layouts the letters too, and on a French one the digits and A. Lengths are fixed, so separators
are skipped by position.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final

from teds_provision import files
from teds_provision.errors import NotFoundError, TedsProvisionError, UsageError
from teds_provision.lazy import how_to_install, is_installed

if TYPE_CHECKING:
    from teds_provision.station.station import Station

PREFIX: Final = "TEDS1"
_UUID_DIGITS, _FINGERPRINT_DIGITS = 20, 64
_LENGTH = len(PREFIX) + 1 + _UUID_DIGITS + 1 + _FINGERPRINT_DIGITS
_KEYS: Final = "ABCDEFTS"
_LAYOUTS: Final = {
    "": "ABCDEFTS",  # also German, Turkish Q, and all layouts that have these letters at the same keys
    "French": "QBCDEFTS",
    "Dvorak": "AXJE>UYO",
    "Russian": "ФИСВУАЕЫ",
    "Ukrainian": "ФИСВУАЕІ",
    "Greek": "ΑΒΨΔΕΦΤΣ",
    "Turkish F": "UÇVEĞAOİ",
}
"""Characters that a scanner typing on a US keyboard gives under other layouts, in the order of _KEYS.

Dvorak's E without Shift is a full stop; digits are the same but on a French layout, which needs Shift for them.
"""
_LOWER: Final = str.maketrans({"İ": "i", ">": "."})  # exceptions to lower()
_FRENCH_DIGITS: Final = dict(zip("à&é\"'(-è_ç", "0123456789", strict=True))
_MODULE, _QUIET = 8, 4


@dataclass(frozen=True)
class Label:
    """Content of a label: the node's UUID, the whole fingerprint of its key (64 hex digits), and its name."""

    uuid: bytes
    fingerprint: str
    name: str | None = None

    @property
    def text(self) -> str:
        """The content of the QR code; upper case, so that it is coded as alphanumeric and stays small."""
        return f"{PREFIX}:{self.uuid.hex()}:{self.fingerprint}".upper()

    @property
    def lines(self) -> list[str]:
        """The text beside the code."""
        first = [self.name] if self.name else []
        digits = self.fingerprint
        return [*first, self.uuid.hex(), *(digits[start : start + 16] for start in range(0, len(digits), 16))]


def label_of(station: Station, uuid: bytes) -> Label:
    """Return the label of a node whose key is pinned; raises NotFoundError if it is not."""
    pinned = station.pins.pinned(uuid)
    if pinned is None or len(pinned) != _FINGERPRINT_DIGITS:
        raise NotFoundError(
            f"The key of node {uuid.hex()} is not known here.", hint="Tap it once: teds-provision identify --add"
        )
    entry, node = station.pins.entry(uuid), station.nodes.get(uuid)
    name = (node.name if node is not None else None) or (entry.name if entry is not None else None)
    return Label(uuid, pinned, name)


def read_label(text: str) -> tuple[bytes, str] | None:
    """Parse a scanned label into UUID and fingerprint, whatever became of the separators; None for other text."""
    text = text.strip()
    if len(text) != _LENGTH:
        return None
    first = len(PREFIX) + 1
    second = first + _UUID_DIGITS + 1
    for table in _TABLES:
        read = text.translate(table).upper()
        digits = read[first : second - 1] + read[second:]
        if len(read) == _LENGTH and read.startswith(PREFIX) and re.fullmatch("[0-9A-F]+", digits):
            return bytes.fromhex(digits[:_UUID_DIGITS]), digits[_UUID_DIGITS:].lower()
    return None


def _table(layout: str, letters: str) -> dict[int, str]:
    """Return the table from what a layout types to the keys of a US keyboard, with and without Shift."""
    table = dict(zip(letters, _KEYS, strict=True))
    # singly: at the end of a word, lower() gives another sigma
    small = [letter.translate(_LOWER).lower() for letter in letters]
    table |= dict(zip(small, _KEYS, strict=True))
    return str.maketrans(table | (_FRENCH_DIGITS if layout == "French" else {}))


_TABLES: Final = tuple(_table(layout, letters) for layout, letters in _LAYOUTS.items())


def require_label_packages(label_format: str) -> None:
    """Raise TedsProvisionError if a package for labels of this format ("svg", "png") is missing, before any work."""
    if not is_installed("segno"):
        raise TedsProvisionError("Labels need segno, which is not installed.", hint=how_to_install("label"))
    if label_format == "png" and not is_installed("PIL"):
        raise TedsProvisionError("A PNG needs Pillow, which is not installed.", hint=how_to_install("label"))


def write_label(label: Label, path: Path) -> None:
    """Write the label as SVG or PNG, by the suffix; raises UsageError (another one).

    Raises TedsProvisionError if segno, or for a PNG Pillow, is missing.
    """
    suffix = path.suffix.lower()
    if suffix not in (".svg", ".png"):
        raise UsageError(f"Labels are written as .svg or .png, not {path.name}.", hint="Name it LABEL.svg.")
    require_label_packages(suffix.removeprefix("."))
    rows = _modules(label.text)
    octets = _svg(label, rows).encode() if suffix == ".svg" else _png(label, rows)
    files.write_whole(path, octets, mode=0o644)


def _modules(text: str) -> list[list[bool]]:
    import segno

    code = segno.make(text, micro=False, error="m", boost_error=True)
    return [[bool(module) for module in row] for row in code.matrix]


def _svg(label: Label, rows: list[list[bool]]) -> str:
    size = len(rows) + 2 * _QUIET
    dark = "".join(
        f"M{x + _QUIET} {y + _QUIET}h1v1h-1z" for y, row in enumerate(rows) for x, module in enumerate(row) if module
    )
    lines = "".join(
        f'<text x="{size}" y="{_QUIET + 4 + 5 * number}">{escape(line)}</text>'
        for number, line in enumerate(label.lines)
    )
    width = size + 2 + max(len(line) for line in label.lines) * 2.5
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {size}" width="{width * 0.4:g}mm" '
        f'height="{size * 0.4:g}mm"><rect width="100%" height="100%" fill="#fff"/><path d="{dark}"/>'
        f'<g font-family="monospace" font-size="4">{lines}</g></svg>\n'
    )


def _png(label: Label, rows: list[list[bool]]) -> bytes:
    from PIL import Image, ImageDraw, ImageFont

    side = (len(rows) + 2 * _QUIET) * _MODULE
    font = ImageFont.load_default(4 * _MODULE)
    width = side + _QUIET * _MODULE + int(max(font.getlength(line) for line in label.lines))
    picture = Image.new("1", (width, side), 1)
    draw = ImageDraw.Draw(picture)
    for y, row in enumerate(rows):
        for x, module in enumerate(row):
            if module:
                left, top = (x + _QUIET) * _MODULE, (y + _QUIET) * _MODULE
                draw.rectangle((left, top, left + _MODULE - 1, top + _MODULE - 1), fill=0)
    for number, line in enumerate(label.lines):
        draw.text((side, (_QUIET + 5 * number) * _MODULE), line, font=font, fill=0)
    octets = BytesIO()
    picture.save(octets, "PNG", dpi=(508, 508))
    return octets.getvalue()
