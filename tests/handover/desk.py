"""Two base stations that trust each other, and boards that the first one keyed: for the tests of a handover."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from teds_provision.handover.incoming import ImportPlan, ImportResult, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, ExportResult, export_bundle, plan_export
from teds_provision.protocol.handover.bundle import Mode
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover, TrustRecord, WhitelistEntry
from tests.bench import Board, MemoryLink, make_station, talk


def trust(station: Station, other: Station, name: str | None = None) -> None:
    """``station`` trusts ``other``."""
    station.policy.trust(TrustRecord(name or other.name, "station", other.point, other.fingerprint))


def key_up(station: Station, board: Board, *, name: str | None = None) -> None:
    """Whitelist a board and agree on its first key."""
    station.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        agree(station, node, identify(station, node))
    if name:
        station.nodes.remember(board.uuid, name=name, profile="tactile-finger-sensor")
        if station.groups.find("left hand") is None:
            station.groups.create("left hand", [])
        station.groups.add("left hand", [board.uuid])


def provisioned(station: Station, board: Board, profile: str = "temperature-sensor") -> ProvisionResult:
    """Take all steps on one board."""
    with talk(board) as node:
        return provision(station, node, BuildOrder(profile), operator=AcceptingOperator(), reporter=SilentReporter())


def session(station: Station, board: Board, *, via: str = "can") -> int:
    """One session with a board over its bus; returns the epoch of the key that it was opened under."""
    with talk(board, MemoryLink(board, via=via, tapped=via == "nfc")) as node:
        return require_session(station, node).record.epoch


def boards(count: int) -> list[Board]:
    return [Board(uuid=bytes.fromhex("8d4d9da65281f7") + number.to_bytes(3, "big")) for number in range(1, count + 1)]


@dataclass
class Pair:
    """North has the nodes, south takes them over; each trusts the other."""

    folder: Path
    north: Station
    south: Station
    boards: list[Board] = field(default_factory=list)
    files: int = 0

    @classmethod
    def make(cls, folder: Path, count: int = 1) -> Pair:
        pair = cls(folder, make_station(folder / "north", "north"), make_station(folder / "south", "south"))
        trust(pair.north, pair.south)
        trust(pair.south, pair.north)
        pair.boards = boards(count)
        for number, board in enumerate(pair.boards, 1):
            key_up(pair.north, board, name=f"finger {number}")
        return pair

    def close(self) -> None:
        self.north.close()
        self.south.close()

    @property
    def board(self) -> Board:
        return self.boards[0]

    def export(self, mode: Mode = "copy", *, to: tuple[str, ...] = ("south",), nodes: tuple[bytes, ...] | None = None,
               output: Path | None = None) -> tuple[Path, ExportResult]:  # fmt: skip
        self.files += 1
        path = output or self.folder / f"bundle{self.files}.jwe"
        plan = plan_export(self.north, ExportOrder(to, nodes, mode))
        return path, export_bundle(self.north, plan, path)

    def take(self, path: Path, station: Station | None = None) -> ImportResult:
        station = station or self.south
        plan = plan_import(station, path.read_bytes())
        return import_bundle(station, plan) if isinstance(plan, ImportPlan) else plan


def held(station: Station, board: Board) -> list[tuple[str, int, str]]:
    return [(key.state, key.epoch, key.source) for key in station.keys.keys_of(board.uuid)]


def node_key_id(board: Board) -> str:
    assert board.state.key is not None
    return key_id(board.state.key).hex()


def everything(station: Station) -> tuple[object, ...]:
    """Return what the store holds but for the audit log and times: to see that nothing changed."""
    store = station
    return (
        [replace(entry, added="") for entry in store.pins.whitelist()],
        store.nodes.all(),
        sorted((key.uuid, key.key_id, key.state, key.epoch) for key in store.keys.all()),
        [replace(row, created="") for row in store.handovers.all()],
        [replace(tombstone, created="") for tombstone in store.policy.tombstones()],
        [replace(holder, since="") for holder in store.keys.holders()],
        store.policy.revocations(),
    )


def row(station: Station, handover_id: str, direction: str) -> Handover:
    found = station.handovers.get(handover_id, direction)  # type: ignore[arg-type]
    assert found is not None
    return found


def fresh_key() -> tuple[SoftwareKey, str]:
    key = SoftwareKey.generate()
    return key, fingerprint(key.point)


Fault = Callable[[], None]
