"""Computes which pages of a station count: its history, or the common part of two (contract/plant.md section 2).

The result depends only on the set of signed pages, not on their order of arrival.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from teds_provision.protocol.plant.roster import Place


@dataclass(frozen=True)
class CountedPages:
    """The pages that count, ascending from 1; ``two``: the number at which two histories part, None for one."""

    pages: tuple[Place, ...]
    two: int | None = None

    @property
    def newest(self) -> Place:
        """The newest page that counts; (0, "") if none does."""
        return self.pages[-1] if self.pages else (0, "")


def counting(pages: Iterable[tuple[int, str, str]], *, last: Place | None, accepted: Place | None) -> CountedPages:
    """Return which of a station's signed pages (n, H, ``previous``) count.

    ``last`` is the roster's limit for a removed station, ``accepted`` an operator's choice between two histories; the
    roster's goes first. A page n is named by its own H and by ``previous`` of every page n + 1. The chain counts up to
    the page before the first number for which two are named, unless ``last`` or ``accepted`` selects the branch.
    """
    there: dict[int, dict[str, str]] = {}
    for n, hash, previous in pages:
        there.setdefault(n, {})[hash] = previous
    anchor = last if last is not None else accepted
    if anchor is not None and anchor[1] in there.get(anchor[0], ()):
        there = _branch(there, anchor)
    names: dict[int, set[str]] = {}
    for n, versions in there.items():
        names.setdefault(n, set()).update(versions)
        names.setdefault(n - 1, set()).update(versions.values())
    if last is not None and last[0]:
        names.setdefault(last[0], set()).add(last[1])
    counted: list[Place] = []
    for n in range(1, 1 + (last[0] if last is not None else max(there, default=0))):
        if len(names.get(n, ())) > 1:
            return CountedPages(tuple(counted), n)
        (hash,) = names.get(n) or ("",)
        if hash not in there.get(n, ()):
            break
        counted.append((n, hash))
    return CountedPages(tuple(counted))


def _branch(there: dict[int, dict[str, str]], anchor: Place) -> dict[int, dict[str, str]]:
    """Return the pages that lead to one page, it, and those that descend from it."""
    kept: dict[int, dict[str, str]] = {}
    n, hash = anchor
    while hash in there.get(n, ()):
        kept[n] = {hash: there[n][hash]}
        n, hash = n - 1, there[n][hash]
    above = anchor[0] + 1
    while descended := {hash_: before for hash_, before in there.get(above, {}).items() if before in kept[above - 1]}:
        kept[above] = descended
        above += 1
    return kept
