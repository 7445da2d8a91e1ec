"""Whether the datasheets that this station knows suffice for a task (``--fits``, ``--require``)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime

from teds_provision.errors import PolicyRefused
from teds_provision.station.station import Station
from teds_provision.teds.fits import Fit, Requirement, judge, met
from teds_provision.teds.sheet import Sheet


@dataclass(frozen=True)
class NodeFit:
    """How one channel of one node (None: the node as a whole) stands to one requirement."""

    uuid: bytes
    requirement: Requirement
    fit: Fit

    def to_json(self) -> dict[str, object]:
        """One entry of ``fits``."""
        return {
            "uuid": self.uuid.hex(),
            "channel": self.fit.channel,
            "name": self.fit.name,
            "result": self.fit.result,
            "why": self.fit.why,
        }


def fits_of(
    station: Station, requirements: Iterable[Requirement], uuids: Iterable[bytes], now: datetime
) -> Iterator[NodeFit]:
    """Judge the datasheet that each node has, as far as this station knows it; ``skipped`` where it knows none."""
    asked = tuple(requirements)
    for uuid in uuids:
        image = station.nodes.datasheet(uuid)
        sheet = Sheet.of(image) if image is not None else None
        for requirement in asked:
            if sheet is None or not sheet.channels:
                yield NodeFit(uuid, requirement, Fit(None, "", "skipped", "its datasheet is not known here."))
            else:
                yield from (NodeFit(uuid, requirement, fit) for fit in judge(requirement, sheet, now))


def require(fits: Iterable[NodeFit]) -> None:
    """Raise PolicyRefused (exit 6) unless a group meets every requirement that it was judged by."""
    by_requirement: dict[Requirement, list[Fit]] = {}
    for found in fits:
        by_requirement.setdefault(found.requirement, []).append(found.fit)
    for requirement, found_fits in by_requirement.items():
        if not met(requirement, found_fits):
            reasons = " ".join(dict.fromkeys(fit.why for fit in found_fits if fit.result != "passed"))
            raise PolicyRefused(
                f"No channel suffices for {requirement.subject}: {reasons}"
                if not requirement.channel
                else f"{requirement.subject[0].upper()}{requirement.subject[1:]} does not suffice: {reasons}",
                hint="See what each channel has with: teds-provision nodes --fits EXPRESSION",
            )
