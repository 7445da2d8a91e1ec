"""Inventory of the store's nodes, from all of its tables; without secrets."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any

from teds_provision import teds
from teds_provision.errors import NotFoundError, PolicyError
from teds_provision.lazy import late
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.shapes.node import KnownNode
from teds_provision.shapes.verdict import NodeVerdict
from teds_provision.station.overview import NodeOverview, Search
from teds_provision.station.station import Station

if TYPE_CHECKING:
    from teds_provision.provisioning import readings
    from teds_provision.station import firmware
    from teds_provision.station.firmware import KnownFirmware
    from teds_provision.teds.fits import Fit, Requirement
else:  # imports cryptography, which a list of unverified nodes does not need
    readings, firmware = late("teds_provision.provisioning.readings"), late("teds_provision.station.firmware")

CHUNK = 256
"""Nodes that are judged together."""

STATES = ("factory", "keyed", "provisioned", "moved", "revoked", "retired", "unseen")
"""States by which nodes can be searched: those of Identify, and the station's own."""

_UUID_DIGITS = 20


def search(station: Station, text: str | None = None, *, state: str | None = None, **more: str | None) -> list[bytes]:
    """Return the UUIDs of the selected nodes; ``more``: the other fields of :class:`Search`.

    ``text``: a whole UUID, an exact name, or any part of UUID, name or profile. Raises NotFoundError if none fits it.
    """
    number: str | int | None = NodeState[state.upper()].value if state in STATES[:3] else state
    if text is None:
        return station.overview.find(Search(state=number, **more))
    exact = _exact(station, text) if number is None and not any(more.values()) else None
    found = [exact] if exact is not None else station.overview.find(Search(text, number, **more))
    if not found:
        raise NotFoundError(f"No node matches {text!r}.", hint="See: teds-provision nodes.")
    return found


def _exact(station: Station, text: str) -> bytes | None:
    digits = text.strip().lower().removeprefix("0x")
    if len(digits) == _UUID_DIGITS and not set(digits) - set("0123456789abcdef"):
        return bytes.fromhex(digits) if station.overview.is_known(bytes.fromhex(digits)) else None
    return station.nodes.named(text)


def inventory(station: Station, uuids: Sequence[bytes]) -> Iterator[KnownNode]:
    """Describe nodes, in their order, a chunk at a time; ``verdict`` is judged now, from each one's row of reading."""
    return (node for node, _ in with_verdicts(station, uuids))


def with_verdicts(station: Station, uuids: Sequence[bytes]) -> Iterator[tuple[KnownNode, NodeVerdict | None]]:
    """Yield the nodes of :func:`inventory`, each with the whole verdict; None if no datasheet of the node was read."""
    known = station.overview.nodes(uuids)
    demands = firmware.FirmwareDemands(station.home)
    while chunk := list(islice(known, CHUNK)):
        listed = [overview.uuid for overview in chunk]
        judged = readings.verdicts_of(
            station, listed, [overview.uuid for overview in chunk if overview.keys and overview.moved is None]
        )
        reported = station.firmware_reports.get_many(listed)
        for overview in chunk:
            found, record = judged.get(overview.uuid), reported.get(overview.uuid)
            profile = (overview.node or {}).get("profile")
            runs = firmware.known_firmware(record, partial(demands.demand_of, profile)) if record is not None else None
            yield _described(overview, found, runs), found


def _described(known: NodeOverview, judged: NodeVerdict | None, runs: KnownFirmware | None) -> KnownNode:
    node, entry, moved, revoked = known.node or {}, known.whitelist or {}, known.moved, known.revoked
    point = node.get("point")
    return KnownNode(
        uuid=known.uuid.hex(),
        name=node.get("name") or entry.get("name"),
        profile=node.get("profile"),
        state=_state(node),
        epoch=node.get("epoch", 0),
        sequence=node.get("sequence", 0),
        fingerprint=hashlib.sha256(point).hexdigest() if point is not None else entry.get("fingerprint"),
        whitelisted=known.whitelist is not None,
        assurance=entry.get("assurance"),
        verdict=judged.verified.verdict if judged is not None else None,
        retired=node.get("retired"),
        reading=judged.reading() if judged is not None else None,
        last_seen=node.get("last_seen"),
        due=node.get("due"),
        charging=json.loads(node["charging"]) if node.get("charging") else None,
        channels=node.get("channels", 0),
        can_address=node.get("can_address", 0),
        group=known.groups[0] if known.groups else None,
        groups=known.groups,
        teds_sha256=node.get("teds_sha256"),
        keys=known.keys,
        rotation_due=known.rotation,
        moved_to=moved and {"fingerprint": moved["to_fingerprint"], "handover": moved["handover_id"]},
        holders=known.holders,
        wrapped=known.origin.to_json() if known.origin is not None else None,
        revoked=revoked and {"why": revoked["why"], "since": revoked["created"]},
        firmware=runs.to_json() if runs is not None else None,
    )


def _state(node: dict[str, Any]) -> str | None:
    if node.get("last_seen") is None and node.get("point") is None:
        return None
    try:
        return NodeState(node["state"]).name.lower()
    except ValueError:
        return f"unknown ({node['state']})"


# -- do the known datasheets suffice for a task? (--fits, --require) ---------------------------------------------------


@dataclass(frozen=True)
class NodeFit:
    """Result for one channel of one node (None: the node as a whole) and one requirement."""

    uuid: bytes
    requirement: Requirement
    fit: Fit

    def to_json(self) -> dict[str, object]:
        """Return one entry of ``fits``."""
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
    """Judge the last known datasheet of each node; ``skipped`` if there is none."""
    asked = tuple(requirements)
    for uuid in uuids:
        image = station.datasheets.datasheet(uuid)
        sheet = teds.sheet.Sheet.from_image(image) if image is not None else None
        for requirement in asked:
            if sheet is None or not sheet.channels:
                unknown = teds.fits.Fit(None, "", "skipped", "its datasheet is unknown here.")
                yield NodeFit(uuid, requirement, unknown)
            else:
                yield from (NodeFit(uuid, requirement, fit) for fit in teds.fits.judge(requirement, sheet, now))


def require(fits: Iterable[NodeFit]) -> None:
    """Raise PolicyError (exit 6) unless a group meets every requirement that it was judged by."""
    by_requirement: dict[Requirement, list[Fit]] = {}
    for found in fits:
        by_requirement.setdefault(found.requirement, []).append(found.fit)
    for requirement, found_fits in by_requirement.items():
        if not teds.fits.met(requirement, found_fits):
            reasons = " ".join(dict.fromkeys(fit.why for fit in found_fits if fit.result != "passed"))
            raise PolicyError(
                f"No channel suffices for {requirement.subject}: {reasons}"
                if not requirement.channel
                else f"{requirement.subject[0].upper()}{requirement.subject[1:]} does not suffice: {reasons}",
                hint="See what each channel has with: teds-provision nodes --fits EXPRESSION",
            )
