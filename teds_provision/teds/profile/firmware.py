"""The table ``[firmware]`` of a profile: which firmware boards of the type should run (profiles.md, "[firmware]")."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final

from teds_provision.teds.profile.reader import Section

Release = tuple[int, int, int, int]
"""Major, minor, patch, build."""
_NUMBER: Final = "(0|[1-9][0-9]{0,9})"
_VERSION: Final = re.compile(rf"{_NUMBER}\.{_NUMBER}\.{_NUMBER}(?:\+{_NUMBER})?")
"""As a report is spelled, which is compared with it: without leading zeros."""
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_HIGHEST: Final = (0xFF, 0xFF, 0xFFFF, 0xFFFFFFFF)


@dataclass(frozen=True)
class FirmwareDemand:
    """``text`` is a pattern (``*``, ``?``, ``[…]``) for board and application, "" for any; ``minimum`` a version.

    ``bad`` names versions (1.2.3 of any build, or 1.2.3+4) and digests of images (64 hex digits).
    """

    text: str = ""
    minimum: str = ""
    bad: tuple[str, ...] = ()

    def fits(self, text: str) -> bool:
        """Return True if firmware of this text is of the type."""
        return not self.text or fnmatchcase(text, self.text)

    def is_bad(self, release: Release, image: str | None) -> bool:
        """Return True if the version, or the digest of the image (hex), is among the bad ones."""
        version = ".".join(map(str, release[:3]))
        return not {version, f"{version}+{release[3]}", image}.isdisjoint(self.bad)

    def is_outdated(self, release: Release) -> bool:
        """Return True if the version is lower than the minimum."""
        least = parse_release(self.minimum) if self.minimum else None
        return least is not None and release < least


def parse_release(text: str) -> Release | None:
    """Read a version such as 1.2.3 or 1.2.3+45; None if it is none that a node can report."""
    found = _VERSION.fullmatch(text)
    if found is None:
        return None
    release = (int(found[1]), int(found[2]), int(found[3]), int(found[4] or 0))
    return release if all(number <= most for number, most in zip(release, _HIGHEST, strict=True)) else None


def firmware_demand(top: Section) -> FirmwareDemand | None:
    """Read the table; None for a profile without it. Mistakes are reported to the section."""
    part = top.section("firmware")
    if part is None:
        return None
    minimum, bad = part.text("minimum"), tuple(word.lower() for word in part.texts("bad"))
    if minimum and parse_release(minimum) is None:
        part.error("minimum", f'"{minimum}" is not a version such as 1.2.0 or 1.2.0+45.')
    for word in bad:
        if parse_release(word) is None and not _DIGEST.fullmatch(word):
            part.error("bad", f'"{word}" is neither a version such as 1.2.0 nor a digest of 64 hex digits.')
    demand = FirmwareDemand(part.text("text"), minimum, bad)
    part.finish()
    return demand
