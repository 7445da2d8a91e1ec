"""``read``: every TEDS of a node, and whether it came from that node."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.errors import UnprovenError
from teds_provision.links import LinkSettings
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.readings import keep
from teds_provision.provisioning.teds_read import read_identity, read_image
from teds_provision.provisioning.verify import freshness_floor_of, unproven
from teds_provision.provisioning.verify_node import open_or_say_why, provenance_check
from teds_provision.provisioning.visit import at_node
from teds_provision.station.station import Station
from teds_provision.teds.image import Image


@dataclass(frozen=True)
class ReadReport:
    """Every TEDS of a node; ``error`` is UnprovenError if a key is held here and their origin is unproven."""

    image: Image
    error: UnprovenError | None


def read_at(station: Station, links: LinkSettings, node: str, reporter: Reporter) -> ReadReport:
    """Read every TEDS of the node that ``node`` names, in a session if this station holds its key."""
    uuid = station.nodes.resolve(node)
    with at_node(station, links.after_agreeing(), uuid, reporter) as visit:
        why = open_or_say_why(station, visit.node)
        c = visit.node.open_counter
        image = read_image(visit.node)
        check = provenance_check(visit.node, visit.who.point, why)
        if visit.node.sealed:
            floor = freshness_floor_of(station, uuid, visit.node.proven or read_identity(visit.node))
            with station.durable("read"):
                keep(station, visit.node, image, by="read", floor=floor, c=c)
        return ReadReport(image, unproven(uuid, check.why) if check.result == "failed" else None)
