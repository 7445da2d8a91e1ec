"""Which nodes an export takes, and why others stay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from teds_provision.errors import NotFound, PolicyRefused
from teds_provision.handover.pending import OPEN, Notes
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.handover.contents import Mode
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import NodeRecord, Shown, pages

DEFAULT_DAYS = 7
OUT_OF_SERVICE = ("decommissioned", "replaced by")  # the words of handover/life.py
_UNKNOWN = "its public key is not known"
_CURE = "See teds-provision nodes UUID; settle it by any session, or: teds-provision agree UUID --rotate"


@dataclass(frozen=True)
class ExportOrder:
    """What to hand over: to whom (as typed), which nodes (None: all that can be), how, and for how many days."""

    to: tuple[str, ...]
    nodes: tuple[bytes, ...] | None
    mode: Mode = "copy"
    days: int = DEFAULT_DAYS
    ca: str | None = None


class Leaving(NamedTuple):
    """A node that goes, by its UUID, and the key that it has now: the rest is read when it is sealed."""

    uuid: bytes
    key_id: str
    epoch: int


Chosen = list[Leaving]


class Selection:
    """Which nodes go, by the tables as they are now (read once, a page at a time: there may be ten thousand)."""

    def __init__(self, station: Station, order: ExportOrder, receivers: set[str]) -> None:
        self.order, self.receivers = order, receivers
        self.keys: dict[bytes, Leaving] = {}
        self.pending: set[bytes] = set()
        for uuid, key_id, epoch, state in _keys(station, order.nodes):
            if state == "active":
                self.keys[uuid] = Leaving(uuid, key_id, epoch)
            else:
                self.pending.add(uuid)
        self.stays = _why_nodes_stay(station, order.nodes)
        self.due = station.keys.rotations_due().keys()
        self.tombstones = {tombstone.uuid: tombstone for tombstone in station.policy.tombstones()}
        self.revoked = {revocation.uuid for revocation in station.policy.revocations()}
        self.rows = [row for row in station.handovers.all() if row.direction == "out" and row.state == OPEN]
        self.open = {row.id: row for row in self.rows}

    def parts(self, nodes: Chosen, most: int) -> list[Chosen]:
        """Divide the nodes into bundles: those of an open move as they were, the others by ``most``."""
        resting: dict[str, Chosen] = {}
        free: Chosen = []
        for node in nodes:
            tombstone = self.tombstones.get(node.uuid)
            (free if tombstone is None else resting.setdefault(tombstone.handover_id, [])).append(node)
        return [*resting.values(), *(free[start : start + most] for start in range(0, len(free), most))]

    def choose(self) -> tuple[Chosen, list[tuple[bytes, str]]]:
        """The nodes with their keys, and those that ``--all`` leaves out."""
        why = self._every() if self.order.nodes is None else self._named(self.order.nodes)
        chosen = [self.keys[uuid] for uuid, obstacle in why.items() if not obstacle]
        if not chosen:
            raise NotFound("There is no node to hand over.", hint="Name nodes, or see: teds-provision nodes")
        return chosen, [(uuid, obstacle) for uuid, obstacle in why.items() if obstacle]

    def _named(self, nodes: tuple[bytes, ...]) -> dict[bytes, str]:
        """The nodes that were named; raises PolicyRefused where one cannot go."""
        why = {uuid: self._obstacle(uuid) for uuid in sorted(set(nodes))}
        for uuid, obstacle in why.items():
            if obstacle:
                raise PolicyRefused(f"Node {uuid.hex()} cannot be handed over: {obstacle}.", hint=_CURE)
        return why

    def _every(self) -> dict[bytes, str]:
        """Every node of which a key is held, with what keeps it here; where all stay, those of a move that was cut."""
        why = {uuid: self._obstacle(uuid) for uuid in sorted(self.keys.keys() | self.pending)}
        if all(why.values()):
            return dict.fromkeys(self._cut_move(), "") or why
        return why

    def _obstacle(self, uuid: bytes) -> str:
        return self._key_stays(uuid) or self.stays.get(uuid, _UNKNOWN)

    def _key_stays(self, uuid: bytes) -> str:
        tombstone = self.tombstones.get(uuid)
        if uuid in self.revoked:
            return "it is revoked"
        if tombstone is not None and not (self.order.nodes is not None and self._is_cut(uuid)):
            return f"it was moved to station {tombstone.to_fingerprint[:16]}"
        if uuid not in self.keys:
            return "its key was never proven in a session" if uuid in self.pending else "no key of it is held here"
        if self.order.mode == "move" and uuid in self.pending:
            return "an agreement with it is not settled: the key that it has now may be a newer one"
        if uuid in self.due:
            return "its key must be rotated first"
        return ""

    def _is_cut(self, uuid: bytes) -> bool:
        """Whether this node rests because of a move to the same receiver that is still open."""
        tombstone = self.tombstones[uuid]
        return (
            self.order.mode == "move"
            and tombstone.handover_id in self.open
            and tombstone.to_fingerprint in self.receivers
        )

    def _cut_move(self) -> list[bytes]:
        """The nodes of the newest open move to this receiver, and of the bundles that one command made with it.

        ``--all`` again after a cut means these.
        """
        if self.order.mode != "move":
            return []
        rows = [row for row in self.open.values() if row.mode == "move" and set(row.peers) == self.receivers]
        together = _of_the_last_run([Notes.from_json(row.nodes) for row in rows])
        return sorted(bytes.fromhex(uuid) for one in together for uuid in one.uuids)


def _keys(station: Station, wanted: tuple[bytes, ...] | None) -> Iterator[tuple[bytes, str, int, str]]:
    """UUID, key id, epoch and state of the keys of the nodes that are wanted, or of all."""
    if wanted is None:
        return station.keys.each_name()
    records = (key for page in pages(wanted) for key in station.keys.of_page(page))
    return ((key.uuid, key.key_id, key.epoch, key.state) for key in records)


def _why_nodes_stay(station: Station, wanted: tuple[bytes, ...] | None) -> dict[bytes, str]:
    """Why each node of the wanted ones, or of all, cannot go, whatever its key is; "" for nothing."""
    known: Iterable[Sequence[NodeRecord | Shown]] = (
        pages(station.nodes.each_shown()) if wanted is None else map(_listed, map(station.nodes.of_page, pages(wanted)))
    )
    stays: dict[bytes, str] = {}
    for page in known:
        entries = station.pins.of_page([node.uuid for node in page])
        pins = station.pins.among(page, entries.values())
        stays |= {node.uuid: _why_node_stays(node, pins.get(node.uuid, "")) for node in page}
    return stays


def _listed(nodes: dict[bytes, NodeRecord]) -> list[NodeRecord]:
    return list(nodes.values())


def _why_node_stays(node: NodeRecord | Shown, pin: str) -> str:
    if (node.retired or "").startswith(OUT_OF_SERVICE):
        return "it is out of service"
    if node.point is None:
        return _UNKNOWN
    if not same_key(pin, fingerprint(node.point)):
        return "the key that it showed last is not the one that it is pinned to"
    return ""


def _of_the_last_run(notes: list[Notes]) -> list[Notes]:
    """The newest bundle, with all that one command made together with it."""
    return [one for one in notes if one.run and one.run == notes[-1].run] or notes[-1:]
