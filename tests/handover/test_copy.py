"""A copied key: who may use it, who knows of whom, and what a rotation by one means for the other."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.errors import PolicyError
from teds_provision.handover.incoming import prove_node
from teds_provision.handover.pending import close
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.teds_read import read_image
from tests.bench import MemoryLink, make_station, talk
from tests.handover.desk import Pair, held, row, session, trust

SESSIONS = 1000


def test_after_a_copy_both_stations_reach_the_node(pair: Pair) -> None:
    path, _exported = pair.export("copy")
    taken = pair.take(path)
    assert taken.uuids == (pair.board.uuid,)
    assert held(pair.south, pair.board) == [("pending", 1, "import")]
    assert session(pair.south, pair.board) == 1
    assert held(pair.south, pair.board) == [("active", 1, "import")]
    assert session(pair.north, pair.board) == 1
    record = pair.south.nodes.get(pair.board.uuid)
    assert record is not None
    assert (record.name, record.profile) == ("finger 1", "tactile-finger-sensor")
    assert pair.south.groups.names_of_node(pair.board.uuid) == ["left hand"]
    entry = pair.south.pins.entry(pair.board.uuid)
    assert entry is not None
    assert (entry.assurance, entry.fingerprint is not None) == ("import", True)


def test_each_station_knows_who_else_holds_a_copy(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    assert [(h.fingerprint, h.mode) for h in pair.north.keys.holders()] == [(pair.south.fingerprint, "copy")]
    assert [(h.fingerprint, h.mode) for h in pair.south.keys.holders()] == [(pair.north.fingerprint, "copy")]


def test_stations_alternate_sessions_under_one_copied_key(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    for number in range(SESSIONS):
        assert session((pair.north, pair.south)[number % 2], pair.board, via=("can", "nfc")[number // 2 % 2]) == 1


def test_sessions_of_both_at_once_on_two_links_do_not_disturb_each_other(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    with (
        talk(pair.board, MemoryLink(pair.board)) as here,
        talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as there,
    ):
        for _ in range(3):
            prove_node(pair.north, here)
            prove_node(pair.south, there)
            assert read_image(here) == read_image(there)


def test_a_rotation_by_one_locks_the_other_out_and_is_reported(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    with talk(pair.board) as node:
        agree(pair.south, node, identify(pair.south, node), rotate=True)
    assert pair.south.keys.holders() == []
    with talk(pair.board) as node, pytest.raises(PolicyError, match="knows none of the keys"):
        agree(pair.north, node, identify(pair.north, node))
    assert session(pair.south, pair.board) == 2


def test_one_bundle_for_several_stations(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    trust(west, pair.north)
    trust(pair.south, west)
    path, _exported = pair.export("copy", to=("south", west.fingerprint[:16]))
    for station in (pair.south, west):
        pair.take(path, station)
        assert session(station, pair.board) == 1
    assert {h.fingerprint for h in pair.south.keys.holders()} == {pair.north.fingerprint, west.fingerprint}
    assert pair.south.identity.certificate(pair.north.ca, west.point) is not None
    west.close()


def test_a_copy_for_several_is_closed_by_the_last_receipt(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    trust(west, pair.north)
    path, exported = pair.export("copy", to=("south", "west"))
    for station, state in ((pair.south, "open"), (west, "closed")):
        receipt = pair.take(path, station).receipt
        assert (close(pair.north, receipt).row.state, close(pair.north, receipt).fresh) == (state, False)
    assert row(pair.north, exported.plan.id, "out").state == "closed"
    west.close()
