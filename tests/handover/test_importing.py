"""What comes in by a bundle, and what is refused: strangers, old epochs, other keys."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError, NotAuthenticError, PolicyError
from teds_provision.handover.deny import why_not
from teds_provision.handover.incoming import ImportPlan, ImportResult, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.handover.pending import close
from teds_provision.protocol.handover.bundle import BundledNode
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.wire_agreement import key_id
from teds_provision.provisioning.agree import agree, reset_node
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.verify import snapshot_trust, snapshot_trust_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder, Tombstone, TrustRecord, WhitelistEntry
from tests.bench import Board, make_station, talk
from tests.handover.desk import Pair, everything, held, key_up, provisioned, session

AT = "2026-11-28T08:00:00Z"


def key_again(station, board):  # type: ignore[no-untyped-def]
    with talk(board) as node:
        agree(station, node, identify(station, node))


def test_an_expired_bundle_is_refused_but_its_receipt_can_be_had(pair: Pair) -> None:
    path, _ = pair.export("copy")
    later = datetime.now(UTC) + timedelta(days=8)
    with pytest.raises(PolicyError, match="expired"):
        plan_import(pair.south, path.read_bytes(), later)
    taken = pair.take(path)
    again = plan_import(pair.south, path.read_bytes(), later)
    assert isinstance(again, ImportResult)
    assert again.receipt == taken.receipt


def test_a_bundle_for_another_station_or_from_a_stranger(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    path, _ = pair.export("copy")
    with pytest.raises(PolicyError, match="not sealed for this station"):
        plan_import(west, path.read_bytes())
    for role in ("station", "ca"):
        pair.south.policy.distrust("north")
        with pytest.raises(NotAuthenticError, match="not trusted here"):
            plan_import(pair.south, path.read_bytes())
        if role == "station":  # as a CA a key sends no bundle
            pair.south.policy.trust(TrustRecord("north", "ca", pair.north.point, pair.north.fingerprint))
    west.close()


def test_an_id_that_came_before_with_other_content(pair: Pair) -> None:
    path, exported = pair.export("copy")
    pair.take(path)
    other = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    key_up(pair.north, other)
    plan = replace(plan_export(pair.north, ExportOrder(("south",), None)), id=exported.plan.id)
    forged = pair.folder / "forged.jwe"
    export_bundle(pair.north, plan, forged)
    before = everything(pair.south)
    with pytest.raises(PolicyError, match="a replay or a forgery"):
        plan_import(pair.south, forged.read_bytes())
    assert everything(pair.south) == before


def test_another_key_of_the_epoch_in_use_is_refused(pair: Pair) -> None:
    """Two keys of one epoch cannot both be the node's: one of the two stations was told a lie."""
    bundle, _ = pair.export("copy")
    pair.south.keys.add_pending(pair.board.uuid, key=bytes(16), key_id=b"another!", epoch=1)
    pair.south.keys.promote(pair.board.uuid, b"another!".hex())
    with pytest.raises(PolicyError, match="another key of epoch 1 is in use here"):
        pair.take(bundle)


def test_an_older_epoch_than_the_stores_is_refused(pair: Pair) -> None:
    old, _ = pair.export("copy")
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    new, _ = pair.export("copy")
    pair.take(new)
    session(pair.south, pair.board)
    with pytest.raises(PolicyError, match="epoch 1 is older than 2"):
        plan_import(pair.south, old.read_bytes())


@pytest.mark.parametrize("holds", [True, False])
def test_an_older_epoch_than_the_node_reported_is_refused_whatever_key_is_held(pair: Pair, holds: bool) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    bundle, _ = pair.export("copy")
    pair.south.nodes.remember(pair.board.uuid, epoch=3)
    if not holds:
        pair.south.keys.remove(pair.board.uuid)
    with pytest.raises(PolicyError, match="epoch 2 is older than 3, which is known here"):
        plan_import(pair.south, bundle.read_bytes())


def test_the_epoch_that_the_node_reported_is_not_older_where_no_key_is_held(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    bundle, _ = pair.export("copy")
    pair.south.nodes.remember(pair.board.uuid, epoch=2)
    pair.south.keys.remove(pair.board.uuid)
    plan = plan_import(pair.south, bundle.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["new"]


def test_an_older_epoch_than_that_of_a_key_without_proof_is_refused_with_the_way_on(pair: Pair) -> None:
    """The epoch was "known here", where nothing but the word of a bundle was; once the node was reached it is clear."""
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    bundle, _ = pair.export("copy")
    pair.south.keys.add_pending(pair.board.uuid, key=bytes(16), key_id=b"no proof", epoch=3)
    with pytest.raises(PolicyError, match=r"epoch 2 is older than 3, .* no session has proven .*: verify the node"):
        plan_import(pair.south, bundle.read_bytes())


def test_a_newer_epoch_comes_in_beside_the_old_key_until_it_is_proven(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    plan = plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["newer"]
    import_bundle(pair.south, plan)
    assert held(pair.south, pair.board) == [("pending", 2, "import"), ("active", 1, "import")]
    assert session(pair.south, pair.board) == 2
    assert held(pair.south, pair.board) == [("active", 2, "import")]


def test_a_newer_key_under_another_ca_counts_once_it_is_proven(pair: Pair) -> None:
    """North shares a node; south resets it and keys it under its own CA, then shares it back."""
    pair.take(pair.export("copy")[0])
    with talk(pair.board) as node:
        reset_node(pair.south, node, identify(pair.south, node))
    key_again(pair.south, pair.board)
    assert pair.board.state.ca == pair.south.ca
    bundle = pair.folder / "back.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), None)), bundle)
    pair.take(bundle, pair.north)
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.north.ca
    assert session(pair.north, pair.board) == 2
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.south.ca
    assert provisioned(pair.north, pair.board).verified.verdict == "authentic"


def test_a_claimed_key_under_another_ca_does_not_spoil_the_one_in_use(pair: Pair) -> None:
    """A trusted station that errs, or lies: its key is never proven, and the node stays reachable and writable."""
    path, _ = pair.export("copy")
    pair.take(path)
    key = bytes(range(16))
    pair.south.keys.add_pending(pair.board.uuid, key=key, key_id=key_id(key), epoch=9)
    pair.south.keys.promote(pair.board.uuid, key_id(key).hex())
    pair.south.keys.set_ca_of(pair.board.uuid, pair.south.ca)
    bundle = pair.folder / "lie.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), None)), bundle)
    pair.take(bundle, pair.north)
    assert session(pair.north, pair.board) == 1
    assert provisioned(pair.north, pair.board).verified.verdict == "authentic"


def test_the_same_key_under_another_ca_leaves_the_ca_as_it_is(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    pair.south.keys.set_ca_of(pair.board.uuid, pair.south.ca)
    bundle = pair.folder / "lie.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), None)), bundle)
    plan = plan_import(pair.north, bundle.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["same"]
    import_bundle(pair.north, plan)
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.north.ca
    assert session(pair.north, pair.board) == 1
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.north.ca


def test_a_uuid_known_with_another_node_key_is_refused_and_the_rest_comes_in(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 2)
    clone = Board(uuid=pair.boards[1].uuid)
    key_up(pair.south, clone)
    plan = plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["new", "refused"]
    assert "another node key" in plan.nodes[1].why
    import_bundle(pair.south, plan)
    assert session(pair.south, clone) == 1
    assert session(pair.south, pair.boards[0]) == 1
    pair.close()


def test_if_every_node_is_refused_nothing_is_imported(pair: Pair) -> None:
    key_up(pair.south, Board(uuid=pair.board.uuid))
    before = everything(pair.south)
    with pytest.raises(PolicyError, match="another node key"):
        plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert everything(pair.south) == before


def test_the_same_keys_again_in_a_new_bundle(pair: Pair) -> None:
    first, exported = pair.export("copy")
    close(pair.north, pair.take(first).receipt)
    second, again = pair.export("copy")
    assert again.plan.id != exported.plan.id
    plan = plan_import(pair.south, second.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["same"]
    import_bundle(pair.south, plan)
    assert len(held(pair.south, pair.board)) == 1


def cas_that_count(station: Station, uuid: bytes) -> list[bytes]:
    """Return the CAs that count for a node: the same for it alone, in a list of nodes and for many files."""
    alone = station.policy.trusted_cas(uuid)
    assert snapshot_trust_of(station, [uuid]).policy.trusted_cas(uuid) == alone
    assert snapshot_trust(station).policy.trusted_cas(uuid) == alone
    return alone


def test_a_ca_whose_trust_ended_counts_again_once_a_person_takes_in_a_bundle_that_names_it(pair: Pair) -> None:
    uuid, ca, other = pair.board.uuid, pair.north.ca, SoftwareKey(21).point
    close(pair.north, pair.take(pair.export("copy")[0]).receipt)
    for ended in (ca, other):
        pair.south.policy.end_ca(ended)
    assert ca not in cas_that_count(pair.south, uuid)
    pair.take(pair.export("copy")[0])
    assert ca in cas_that_count(pair.south, uuid)
    assert not pair.south.policy.counts(other)


def test_a_ca_whose_trust_ended_counts_again_once_a_person_trusts_its_key(pair: Pair) -> None:
    lab, other = SoftwareKey(21).point, SoftwareKey(22).point
    for ended in (lab, other):
        pair.south.policy.end_ca(ended)
    pair.south.policy.trust(TrustRecord("lab", "ca", lab, fingerprint(lab)))
    assert [pair.south.policy.counts(ca) for ca in (lab, other)] == [True, False]


def test_a_station_that_lost_the_node_to_a_rotation_does_not_agree_again(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    pair.north.policy.take_back([pair.board.uuid])
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    with talk(pair.board) as node, pytest.raises((PolicyError, NodeRefusedError), match="knows none"):
        agree(pair.south, node, identify(pair.south, node))
    assert pair.board.state.epoch == 2


def test_a_ninth_key_that_waits_for_its_proof_is_not_taken_in(pair: Pair) -> None:
    path, _ = pair.export("copy")
    for number in range(8):
        pair.south.keys.add_pending(pair.board.uuid, key=bytes(16), key_id=bytes([number] * 8), epoch=1)
    with pytest.raises(PolicyError, match="8 of its keys are already waiting for proof here"):
        pair.take(path)


def test_whose_statement_bans_a_node_here(pair: Pair) -> None:
    """Its holders, whom it was given to, who is certified by the CA that it keeps, and who brings it: no one else."""
    south, uuid, key, other = pair.south, bytes(range(10)), SoftwareKey(31), SoftwareKey(32)
    pinned, signer, ca = fingerprint(SoftwareKey(33).point), fingerprint(key.point), SoftwareKey(34)
    south.policy.trust(TrustRecord("lab", "station", key.point, signer))
    brought = BundledNode(uuid, SoftwareKey(33).point, bytes(16), 1)

    def why(by: str = signer, key: str | None = None, *nodes: BundledNode, sender: str = "") -> str:
        statement: Any = SimpleNamespace(uuid=uuid, fingerprint=key, statement="a ban", sender=by)
        bundle: Any = SimpleNamespace(nodes=nodes, sender=sender)
        return why_not(south, statement, bundle)

    assert why() == "this node is unknown here"
    south.identity.put_certificate(fingerprint(south.ca), signer, bytes(64))
    assert why(signer, None, brought, sender=signer) == why(signer, pinned, brought, sender=signer) == ""
    assert "has another" in why(signer, "cd" * 32, brought, sender=signer), "it is held against the key that comes"
    assert why(signer, None, brought, sender="5c" * 32).endswith("has no authority over this node"), (
        "certified by the owner's CA, but nobody knows here which CA the node keeps"
    )
    south.pins.put(WhitelistEntry(uuid, pinned, assurance="tap"))
    nobody = f"station {signer[:32]} has no authority over this node"
    assert why() == "", "it is certified by the CA that the node keeps"
    south.policy.distrust("lab")
    assert why() == nobody, "a key that is not trusted"
    south.policy.trust(TrustRecord("lab", "ca", key.point, signer))
    assert why() == nobody, "a CA is no station"
    south.policy.distrust("lab")
    south.policy.trust(TrustRecord("lab", "station", key.point, signer))
    south.pins.remove(uuid)
    south.nodes.remember(uuid, state=1)
    assert why(signer, None, brought) == "", "a node that was seen here is known, on the whitelist or not"
    south.pins.put(WhitelistEntry(uuid, pinned, assurance="tap"))
    south.keys.set_ca_of(uuid, ca.point)
    assert why() == nobody
    assert why(south.fingerprint) == why(signer, None, brought, sender=signer) == ""
    assert why(signer, None, brought, sender="5c" * 32) == nobody, "another one's bundle"
    assert why(signer, None, replace(brought, uuid=bytes(10)), sender=signer) == nobody, "it brings another node"

    south.keys.put_holder(Holder(uuid, signer, AT), Holder(bytes(10), fingerprint(other.point), AT))
    assert (why(), why(signer, pinned)) == ("", "")
    assert why(signer, "cd" * 32) == f"it names the key {'cd' * 16}, and the node here has another"
    assert why(fingerprint(other.point)).endswith("has no authority over this node"), "it holds another node's key"
    another = replace(brought, node_key=other.point)
    assert why(signer, pinned, another) == "", "the key that it is pinned to goes before the one that comes"
    assert "has another" in why(signer, fingerprint(other.point), another)
    south.keys.remove_holder(uuid, signer)
    assert why() == nobody

    south.policy.put_tombstone(Tombstone(uuid, signer, "h", AT))
    assert why() == ""
    assert why(fingerprint(other.point)).endswith("has no authority over this node"), "it went to another station"
    south.policy.take_back([uuid])
    assert why() == nobody

    south.identity.put_certificate(fingerprint(ca.point), signer, bytes(64))
    assert why() == ""
    south.policy.distrust("lab")
    assert why() == nobody
