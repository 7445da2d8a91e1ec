"""Which nodes an export takes, and why others stay."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from teds_provision.errors import NotFound, PolicyRefused
from teds_provision.handover.pending import OPEN, Notes
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.handover.bundle import Mode
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import KeyRecord, NodeRecord
from teds_provision.store.records import KeyState

DEFAULT_DAYS = 7
OUT_OF_SERVICE = ("decommissioned", "replaced by")  # verdicts that workflow.life gives
_CURE = "See teds-provision nodes UUID; settle it by any session, or: teds-provision agree UUID --rotate"


@dataclass(frozen=True)
class ExportOrder:
    """What to hand over: to whom (as typed), which nodes (None: all that can be), how, and for how many days."""

    to: tuple[str, ...]
    nodes: tuple[bytes, ...] | None
    mode: Mode = "copy"
    days: int = DEFAULT_DAYS
    ca: str | None = None


Chosen = list[tuple[NodeRecord, KeyRecord]]


class Selection:
    """Which nodes go, by the tables as they are now (read once: there may be ten thousand)."""

    def __init__(self, station: Station, order: ExportOrder, receivers: set[str]) -> None:
        self.station, self.order, self.receivers = station, order, receivers
        self.nodes = {node.uuid: node for node in station.nodes.all()}
        self.pins = station.pins.all(self.nodes.values())
        held = list(station.keys.all())
        self.keys = _in_state(held, "active")
        self.pending = _in_state(held, "pending").keys()
        self.due = station.keys.rotations_due().keys()
        self.tombstones = {tombstone.uuid: tombstone for tombstone in station.policy.tombstones()}
        self.revoked = {revocation.uuid for revocation in station.policy.revocations()}
        self.rows = [row for row in station.handovers.all() if row.direction == "out" and row.state == OPEN]
        self.open = {row.id: row for row in self.rows}

    def parts(self, nodes: Chosen, most: int) -> list[Chosen]:
        """Divide the nodes into bundles: those of an open move as they were, the others by ``most``."""
        resting: dict[str, Chosen] = {}
        free: Chosen = []
        for node, key in nodes:
            tombstone = self.tombstones.get(node.uuid)
            (free if tombstone is None else resting.setdefault(tombstone.handover_id, [])).append((node, key))
        return [*resting.values(), *(free[start : start + most] for start in range(0, len(free), most))]

    def choose(self) -> tuple[Chosen, list[tuple[bytes, str]]]:
        """The nodes with their keys, and those that ``--all`` leaves out."""
        why = self._every() if self.order.nodes is None else self._named(self.order.nodes)
        chosen = [(self.nodes[uuid], self.keys[uuid]) for uuid, obstacle in why.items() if not obstacle]
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
        return self._key_stays(uuid) or self._node_stays(uuid)

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

    def _node_stays(self, uuid: bytes) -> str:
        node = self.nodes.get(uuid)
        if node is not None and (node.verdict or "").startswith(OUT_OF_SERVICE):
            return "it is out of service"
        if node is None or node.point is None:
            return "its public key is not known"
        if not same_key(self.pins.get(uuid, ""), fingerprint(node.point)):
            return "the key that it showed last is not the one that it is pinned to"
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


def _in_state(keys: Iterable[KeyRecord], state: KeyState) -> dict[bytes, KeyRecord]:
    return {key.uuid: key for key in keys if key.state == state}


def _of_the_last_run(notes: list[Notes]) -> list[Notes]:
    """The newest bundle, with all that one command made together with it."""
    return [one for one in notes if one.run and one.run == notes[-1].run] or notes[-1:]
