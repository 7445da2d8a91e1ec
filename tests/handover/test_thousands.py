"""Many nodes in a bundle: its memory, and what a large receiver knows of them already."""

from __future__ import annotations

import hashlib
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import, proven_of
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.bulk import BulkRows
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from tests.bench import make_station
from tests.handover.desk import trust

COUNT = 1500
FEW = 20


@pytest.fixture
def stations(tmp_path: Path) -> Iterator[tuple[Station, Station]]:
    pair = make_station(tmp_path / "north", "north"), make_station(tmp_path / "south", "south")
    trust(*pair)
    trust(*reversed(pair))
    yield pair
    for station in pair:
        station.close()


def uuid_of(number: int) -> bytes:
    return hashlib.sha256(b"uuid %d" % number).digest()[:10]


def fill(station: Station, count: int) -> None:
    """So many nodes with a proven key each."""
    points = [SoftwareKey(number).point for number in range(1, 20)]
    nodes, keys = [], []
    for number in range(count):
        uuid, digest = uuid_of(number), hashlib.sha256(b"key %d" % number)
        nodes.append(NodeRecord(uuid, points[number % 19], f"finger {number}", "thermometer", 2, 1, 3,
                                teds_sha256=digest.hexdigest()))  # fmt: skip
        keys.append(station.keys.wrapped(uuid, key=digest.digest()[:16], key_id=digest.digest()[:8], epoch=1, slot=1,
                                         source="agreement", created="2026-01-01T00:00:00Z"))  # fmt: skip
    with station.transaction():
        station.bulk.put(BulkRows(nodes=nodes, keys=keys))
        for key in keys:
            station.keys.promote(key.uuid, key.key_id)


def test_export_and_import_take_less_than_twice_the_memory_of_more_bundle(
    stations: tuple[Station, Station], tmp_path: Path
) -> None:
    north, south = stations
    fill(north, COUNT)
    seconds: dict[int, tuple[int, int, int]] = {}
    for count in (FEW, COUNT):
        path = tmp_path / f"{count}.jwe"
        nodes = tuple(sorted(uuid_of(number) for number in range(count))) if count == FEW else None

        def export(nodes: tuple[bytes, ...] | None = nodes, path: Path = path) -> None:
            export_bundle(north, plan_export(north, ExportOrder(("south",), nodes)), path)

        def take(path: Path = path) -> None:
            with path.open("rb") as file:
                plan = plan_import(south, file)
                assert isinstance(plan, ImportPlan)
                import_bundle(south, plan)

        export_peak, import_peak = peak_of(export), peak_of(take)
        seconds[count] = path.stat().st_size, export_peak, import_peak
    more, exported, imported = (late - early for early, late in zip(seconds[FEW], seconds[COUNT], strict=True))
    assert exported < 2 * more
    assert imported < 2 * more
    assert not proven_of(south, [uuid_of(number) for number in range(COUNT)])


def peak_of(work: object) -> int:
    """Return octets that Python has at most while it works, beyond what it had before."""
    tracemalloc.start()
    try:
        work()  # type: ignore[operator]
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_names_and_keys_are_held_against_all_that_a_large_receiver_knows(
    stations: tuple[Station, Station], tmp_path: Path
) -> None:
    """Pages of a bundle end at 500 nodes: what is known of a node on the last one counts as on the first."""
    north, south = stations
    fill(north, COUNT)
    last = sorted(uuid_of(number) for number in range(COUNT))[-1]
    other = NodeRecord(last, SoftwareKey(77).point, "another board")
    south.nodes.put(other)
    south.nodes.put(NodeRecord(bytes(10), name="finger 7"))
    export_bundle(north, plan_export(north, ExportOrder(("south",), None)), tmp_path / "all.jwe")
    with (tmp_path / "all.jwe").open("rb") as file:
        plan = plan_import(south, file)
    assert isinstance(plan, ImportPlan)
    assert [(planned.node.uuid, planned.why) for planned in plan.nodes if planned.why] == [
        (last, "this UUID is known here with another node key")
    ]
    renamed = {planned.node.name: planned.name for planned in plan.taken if planned.name != planned.node.name}
    assert renamed == {"finger 7": f"finger 7-{uuid_of(7).hex()[-4:]}"}
    import_bundle(south, plan)
    assert len(south.nodes.all()) == COUNT + 1
    assert south.nodes.get(last) == other
    assert {len(south.keys.keys_of(uuid_of(number))) for number in range(COUNT) if uuid_of(number) != last} == {1}
    assert set(south.keys.cas_of_nodes().values()) == {north.ca}
