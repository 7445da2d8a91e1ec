"""What a trusted station, or someone on the way between two, may not do: issue 7, rows M1 to M4, L1 to L3, L13."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

import pytest

from teds_provision.errors import NotAuthenticError, PolicyError, UsageError
from teds_provision.files import new_file
from teds_provision.handover.deny import deny, lift
from teds_provision.handover.incoming import ImportPlan, ImportResult, import_bundle, plan_import
from teds_provision.handover.life import revoke
from teds_provision.handover.outgoing import (
    ExportOrder,
    export_all,
    export_bundle,
    outputs_of,
    plan_export,
    plan_exports,
)
from teds_provision.handover.pending import close, find_handover, undo
from teds_provision.handover.trust import plan_removal, remove
from teds_provision.protocol.datasheet import SEQUENCE_WINDOW
from teds_provision.protocol.handover.bundle import Bundle, BundledNode, Mode, seal_bundle
from teds_provision.protocol.handover.jose import verify_compact
from teds_provision.protocol.handover.receipt import TYPE, open_receipt, seal_receipt
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.keys import fingerprint, station_key_message
from teds_provision.protocol.messages.frames import Command
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.sign import known_node_keys, sign
from teds_provision.provisioning.write import write
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover, NodeRecord, TrustRecord
from tests.bench import Board, MemoryLink, make_station, talk
from tests.handover.desk import Pair, held, key_up, provisioned, session, trust

HIGHEST = 0xFFFFFFFF


@pytest.fixture
def west(pair: Pair, tmp_path: Path) -> Iterator[Station]:
    """Yield a third station; north and west trust each other."""
    made = make_station(tmp_path / "west", "west")
    trust(pair.north, made)
    trust(made, pair.north)
    yield made
    made.close()


def node_of(board: Board, **more: object) -> BundledNode:
    state = board.state
    assert state.key is not None
    return replace(BundledNode(board.uuid, state.node_key, state.key, max(1, state.epoch)), **more)  # type: ignore[arg-type]


def forged(
    sender: Station,
    receiver: Station,
    *nodes: BundledNode,
    mode: Mode = "copy",
    revoked: tuple[str, ...] = (),
    signatures: dict[str, bytes] | None = None,
    vouches: bool = True,
) -> bytes:
    """Return a bundle that a trusted station may make by hand: its own key, and whatever content it likes."""
    now = datetime.now(UTC).replace(microsecond=0)
    ca = sender.vault.ca()
    assert ca is not None
    bundle = Bundle(
        id=str(uuid4()),
        sender=sender.fingerprint,
        to=(receiver.fingerprint,),
        created=now,
        expires=now + timedelta(days=1),
        mode=mode,
        ca=sender.ca,
        nodes=nodes,
        station_signatures={
            **({receiver.fingerprint: ca.sign(station_key_message(receiver.point))} if vouches else {}),
            **(signatures or {}),
        },
        revoked=revoked,
    )
    return seal_bundle(bundle, sender.vault.identity(), [receiver.point])


def taken(station: Station, octets: bytes) -> ImportResult:
    plan = plan_import(station, octets)
    return import_bundle(station, plan) if isinstance(plan, ImportPlan) else plan


# -- M1: sequence and epoch are hearsay ------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [False, True])
def test_a_bundle_cannot_ruin_a_nodes_sequence(pair: Pair, known: bool) -> None:
    provisioned(pair.north, pair.board)
    if known:
        pair.take(pair.export("copy")[0])
        session(pair.south, pair.board)
    before = pair.south.nodes.get(pair.board.uuid)
    lie = node_of(pair.board, sequence=HIGHEST, teds_sha256="ab" * 32)
    taken(pair.south, forged(pair.north, pair.south, lie))
    record = pair.south.nodes.get(pair.board.uuid)
    assert record is not None
    assert record.teds_sha256 == (before.teds_sha256 if before is not None else "ab" * 32)
    assert record.sequence <= 1
    provisioned(pair.south, pair.board)
    record = pair.south.nodes.get(pair.board.uuid)
    assert record is not None
    assert record.sequence == pair.board.state.sequence <= 2


def test_a_lie_about_the_epoch_is_corrected_in_the_first_session(pair: Pair) -> None:
    taken(pair.south, forged(pair.north, pair.south, node_of(pair.board, epoch=HIGHEST)))
    assert held(pair.south, pair.board) == [("pending", HIGHEST, "import")]
    assert session(pair.south, pair.board) == 1
    assert held(pair.south, pair.board) == [("active", 1, "import")]
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        assert agree(pair.south, node, identify(pair.south, node), rotate=True).epoch == 2


def test_a_far_jump_of_the_sequence_needs_a_persons_word(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    image = pair.north.datasheets.datasheet(pair.board.uuid)
    assert image is not None
    far = pair.board.state.sequence + SEQUENCE_WINDOW + 1
    keys = known_node_keys(pair.north, pair.board.uuid, image)
    signed = sign(pair.north, keys, image, epoch=pair.board.state.epoch, node_sequence=0, sequence=far).image
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        require_session(pair.north, node)
        with pytest.raises(PolicyError, match="far ahead"):
            write(pair.north, node, signed)
        assert pair.board.state.sequence == 1
        write(pair.north, node, signed, jump=True)
    assert pair.board.state.sequence == far


# -- M2: who may hand a node back ------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["copy", "move"])
def test_a_station_that_never_had_the_node_lifts_no_tombstone(pair: Pair, west: Station, mode: Mode) -> None:
    before = node_of(pair.board)
    pair.take(pair.export("move")[0])
    with pytest.raises(PolicyError, match="only that station can move it back"):
        plan_import(pair.north, forged(west, pair.north, before, mode=mode))
    with pytest.raises(PolicyError, match="was moved"):
        session(pair.north, pair.board)


def test_a_node_that_comes_back_is_rotated_and_the_plan_says_so(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    session(pair.south, pair.board)
    (plan,) = plan_exports(pair.south, ExportOrder(("north",), None, "move"))
    back = pair.folder / "back.jwe"
    export_bundle(pair.south, plan, back)
    shown = plan_import(pair.north, back.read_bytes())
    assert isinstance(shown, ImportPlan)
    assert shown.nodes[0].notes == ("it is returning: its key is rotated at the first contact",)
    import_bundle(pair.north, shown)
    assert pair.north.keys.rotation_due(pair.board.uuid) is not None
    assert session(pair.north, pair.board) == 3
    assert pair.north.keys.rotation_due(pair.board.uuid) is None


def test_a_bundle_vouches_for_other_stations_only_with_its_cas_signature(pair: Pair, west: Station) -> None:
    """Of the stations that it names, those that are trusted here are kept; a bad signature keeps nothing at all."""
    trust(pair.south, west)
    ca = pair.north.vault.ca()
    assert ca is not None
    good = ca.sign(station_key_message(west.point))
    unknown = {"77" * 32: good}
    before = held(pair.south, pair.board)
    with pytest.raises(NotAuthenticError, match="did not sign"):
        taken(
            pair.south,
            forged(pair.north, pair.south, node_of(pair.board), signatures={west.fingerprint: bytes([1]) * 64}),
        )
    assert held(pair.south, pair.board) == before == []
    assert pair.south.identity.certificate(pair.north.ca, pair.south.point) is None
    assert pair.south.identity.certificate(pair.north.ca, west.point) is None
    signatures = {west.fingerprint: good, **unknown}
    taken(pair.south, forged(pair.north, pair.south, node_of(pair.board), signatures=signatures))
    assert pair.south.identity.certificate(pair.north.ca, west.point) == good
    assert len(held(pair.south, pair.board)) == 1


def test_a_bundle_need_not_vouch_again_for_its_receiver(pair: Pair) -> None:
    without = forged(pair.north, pair.south, node_of(pair.board), vouches=False)
    with pytest.raises(PolicyError, match="has no signature by CA"):
        taken(pair.south, without)
    taken(pair.south, forged(pair.north, pair.south, node_of(pair.board)))
    kept = pair.south.identity.certificate(pair.north.ca, pair.south.point)
    assert kept is not None
    assert taken(pair.south, without).fresh
    assert pair.south.identity.certificate(pair.north.ca, pair.south.point) == kept


# -- M3: what a move gives away, and what its receipt deletes --------------------------------------------------------


def cut_rotation(station: Station, board: Board) -> None:
    """A rotation whose Confirm reached the node while the station died before its reply."""
    with talk(board) as node:
        who, real = identify(station, node), node.request

        def cut(command: Command, why: str) -> bytes:
            reply = real(command, why)
            if why == "the key confirmation":
                raise KeyboardInterrupt
            return reply

        node.request = cut  # type: ignore[assignment, method-assign]
        with pytest.raises(KeyboardInterrupt):
            agree(station, node, who, rotate=True)


def test_a_move_waits_until_a_cut_rotation_is_settled(pair: Pair) -> None:
    cut_rotation(pair.north, pair.board)
    assert [state for state, *_ in held(pair.north, pair.board)] == ["pending", "active"]
    with pytest.raises(PolicyError, match="not settled"):
        pair.export("move", nodes=(pair.board.uuid,))
    session(pair.north, pair.board)
    path, _ = pair.export("move")
    close(pair.north, pair.take(path).receipt)
    assert session(pair.south, pair.board) == 3


def test_a_receipt_deletes_the_key_that_was_in_its_bundle_and_no_other(pair: Pair) -> None:
    path, _exported = pair.export("move")
    pair.north.keys.add_pending(pair.board.uuid, key=bytes(16), key_id=b"newer...", epoch=9)
    close(pair.north, pair.take(path).receipt)
    assert [record.key_id for record in pair.north.keys.keys_of(pair.board.uuid)] == [b"newer...".hex()]


def test_a_receipt_that_comes_after_the_nodes_return_deletes_nothing(pair: Pair) -> None:
    """Model, LATE."""
    path, _ = pair.export("move")
    receipt = pair.take(path).receipt
    session(pair.south, pair.board)
    (plan,) = plan_exports(pair.south, ExportOrder(("north",), None, "move"))
    export_bundle(pair.south, plan, pair.folder / "back.jwe")
    pair.take(pair.folder / "back.jwe", pair.north)
    before = held(pair.north, pair.board)
    close(pair.north, receipt)
    assert held(pair.north, pair.board) == before
    assert session(pair.north, pair.board) == 3


def test_an_undone_move_does_not_take_an_older_pending_key_for_a_rotation(pair: Pair) -> None:
    """Model, OLD_PENDING: only a key that was agreed on since ends a due rotation."""
    cut_rotation(pair.north, pair.board)
    pair.north.keys.demand_rotation(pair.board.uuid, "others may have this key")
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        assert require_session(pair.north, node).record.epoch == 3  # 2 was the one that was cut
    assert pair.north.keys.rotation_due(pair.board.uuid) is None


def test_a_ban_is_bound_to_the_key_that_it_names_and_one_that_names_none_to_the_pinned_one(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    own = pair.north.pins.pinned(pair.board.uuid)
    for named in (None, own):
        statement = seal_revocation(
            pair.north.vault.identity(), uuid=pair.board.uuid, node=named, why="lost", created=datetime.now(UTC)
        )
        for key in ("ab" * 32, own):
            deny(pair.north, statement, key=key)
            entry = pair.north.policy.revocation(pair.board.uuid)
            assert entry is not None
            assert entry.fingerprint == (named or key)
            pair.north.policy.forgive(pair.board.uuid)


# -- M4: trust that is removed ---------------------------------------------------------------------------------------


def test_trust_that_is_removed_ends_with_all_that_hung_on_it(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    revoke(pair.north, pair.board.uuid, "says north")
    statement = pair.north.policy.revocations()[0].statement
    taken(pair.south, forged(pair.north, pair.south, revoked=(statement,)))
    assert pair.south.policy.revocation(pair.board.uuid) is not None
    assert pair.north.ca in pair.south.policy.trusted_cas(pair.board.uuid)
    (north,) = pair.south.policy.trusted("station")
    shown = plan_removal(pair.south, north)
    assert (shown.shared, shown.cas, shown.under) == ((pair.board.uuid,), (pair.north.ca,), 1)
    assert shown.bans == (pair.board.uuid,)
    assert remove(pair.south, north) == shown
    assert pair.north.ca not in pair.south.policy.trusted_cas(pair.board.uuid)
    assert "no longer trusted" in (pair.south.keys.rotation_due(pair.board.uuid) or "")
    assert pair.south.policy.revocation(pair.board.uuid) is None
    trust(pair.south, pair.north)
    assert pair.north.ca not in pair.south.policy.trusted_cas(pair.board.uuid)  # a person compared a station, not a CA


def test_the_owners_ca_stays_though_a_station_that_is_trusted_no_more_brought_nodes_of_it(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    session(pair.south, pair.board)
    back = pair.folder / "back.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), (pair.board.uuid,), "move")), back)
    pair.take(back, pair.north)
    (south,) = pair.north.policy.trusted("station")
    assert remove(pair.north, south).cas == ()
    assert pair.north.policy.counts(pair.north.ca)


def test_a_ca_that_a_person_named_stays_though_the_station_that_brought_it_is_trusted_no_more(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    (north,) = pair.south.policy.trusted("station")
    assert plan_removal(pair.south, north).cas == (pair.north.ca,)
    named = TrustRecord("the owner", "ca", pair.north.ca, fingerprint(pair.north.ca))
    pair.south.policy.trust(named)
    pair.south.keys.set_ca_of(bytes(10), pair.north.ca)
    assert remove(pair.south, north).cas == ()
    assert pair.south.policy.counts(pair.north.ca)
    removal = plan_removal(pair.south, named)
    assert (removal.cas, removal.under, removal.shared, removal.bans) == ((pair.north.ca,), 2, (), ())


def test_a_ca_that_two_stations_brought_stays_until_both_are_gone(pair: Pair, west: Station) -> None:
    trust(pair.south, west)
    pair.take(pair.export("copy")[0])
    (north,) = (trusted for trusted in pair.south.policy.trusted("station") if trusted.name == "north")
    pair.south.keys.set_ca_of(bytes(10), pair.north.ca)
    removal = plan_removal(pair.south, north)
    assert (removal.cas, removal.under) == ((pair.north.ca,), 2), "two nodes keep one CA"
    (other,) = (trusted for trusted in pair.south.policy.trusted("station") if trusted.name == "west")
    assert plan_removal(pair.south, other).cas == ()
    (row,) = (row for row in pair.south.handovers.all() if row.direction == "in")
    pair.south.handovers.put(replace(row, id=str(uuid4()), peers=(west.fingerprint,)))  # as if west brought it as well
    assert [plan_removal(pair.south, station).cas for station in (north, other)] == [(), ()]
    assert remove(pair.south, north).cas == ()
    assert remove(pair.south, other).cas == (pair.north.ca,)


def test_of_the_bundles_for_a_key_that_is_trusted_no_more_those_that_are_open_are_named(
    pair: Pair, west: Station
) -> None:
    (south,) = pair.north.policy.trusted("station")[:1]
    assert south.name == "south"
    for id, state, to in (
        ("1", "open", (pair.south,)), ("2", "closed", (pair.south,)), ("3", "undone", (pair.south,)),
        ("4", "open", (west,)), ("5", "open", (west, pair.south)),
    ):  # fmt: skip
        peers = tuple(station.fingerprint for station in to)
        pair.north.handovers.put(Handover(id, "out", "copy", peers, state, "{}", created="2026-01-01T00:00:00Z"))
    assert plan_removal(pair.north, south).open == ("1", "5")
    assert remove(pair.north, south).open == ("1", "5")


# -- L1, L3: receipts ------------------------------------------------------------------------------------------------


def test_a_header_added_on_the_way_does_not_keep_a_move_from_closing(pair: Pair) -> None:
    path, _ = pair.export("move")
    document = json.loads(path.read_bytes())
    document["unprotected"] = {"added": "on the way"}
    path.write_bytes(json.dumps(document, indent=1).encode())
    done = pair.take(path)
    assert close(pair.north, done.receipt).row.state == "closed"
    assert held(pair.north, pair.board) == []
    document["unprotected"] = {"added": "twice"}
    path.write_bytes(json.dumps(document).encode())
    assert (pair.take(path).fresh, pair.take(path).receipt) == (False, done.receipt)


def test_one_receiver_does_not_close_a_copy_for_two(pair: Pair, west: Station) -> None:
    path, exported = pair.export("copy", to=("south", "west"))
    first = pair.take(path)
    key, stations = pair.south.vault.identity(), {pair.south.fingerprint: pair.south.point}
    assert close(pair.north, first.receipt).row.state == "open"
    receipt = open_receipt(first.receipt, stations.get)
    again = seal_receipt(replace(receipt, created=receipt.created + timedelta(hours=1)), key)
    assert again != first.receipt
    done = close(pair.north, again)
    assert (done.row.state, done.fresh) == ("open", False)
    assert close(pair.north, pair.take(path, west).receipt).row.state == "closed"
    assert exported.plan.id == done.row.id
    assert verify_compact(first.receipt, stations.get, typ=TYPE, max_octets=10_000).kid == pair.south.fingerprint


# -- L2: whose word bans a node --------------------------------------------------------------------------------------


def test_a_ban_counts_only_from_a_station_with_authority_and_for_the_key_it_names(pair: Pair, west: Station) -> None:
    own = Board(uuid=bytes.fromhex("ee" * 10))
    key_up(pair.south, own)
    trust(pair.south, west)
    trust(west, pair.south)
    now, key = datetime.now(UTC), west.vault.identity()
    pinned = pair.south.pins.pinned(own.uuid)
    statements = (
        seal_revocation(key, uuid=own.uuid, node=pinned, why="no authority", created=now),
        seal_revocation(key, uuid=bytes(10), node="ab" * 32, why="unknown node", created=now),
    )
    plan = plan_import(
        pair.south, forged(west, pair.south, revoked=tuple(revocation.statement for revocation in statements))
    )
    assert isinstance(plan, ImportPlan)
    assert plan.denied == ()
    assert ["no authority" in why or "is unknown here" in why for _, why in plan.passed_over] == [True, True]
    import_bundle(pair.south, plan)
    assert pair.south.policy.revocations() == []
    pair.take(pair.export("copy")[0])  # north holds this node's key, so its word counts, for this key
    north = pair.north.vault.identity()
    other_key = seal_revocation(north, uuid=pair.board.uuid, node="cd" * 32, why="another key", created=now)
    real = seal_revocation(north, uuid=pair.board.uuid, node=None, why="lost", created=now)
    plan = plan_import(pair.south, forged(pair.north, pair.south, revoked=(other_key.statement,)))
    assert isinstance(plan, ImportPlan)
    assert "has another" in plan.passed_over[0][1]
    taken(pair.south, forged(pair.north, pair.south, revoked=(real.statement,)))
    (entry,) = pair.south.policy.revocations()
    assert entry.fingerprint == pair.south.pins.pinned(pair.board.uuid)


def test_a_ban_can_be_lifted_and_the_same_statement_does_not_come_back(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    now = datetime.now(UTC)
    statement = seal_revocation(pair.north.vault.identity(), uuid=pair.board.uuid, node=None, why="lost", created=now)
    taken(pair.south, forged(pair.north, pair.south, revoked=(statement.statement,)))
    with pytest.raises(PolicyError, match="revoked: lost"):
        pair.south.policy.require_whitelisted(pair.board.uuid)
    assert lift(pair.south, pair.board.uuid)
    assert not lift(pair.south, pair.board.uuid)
    pair.south.policy.require_whitelisted(pair.board.uuid)
    plan = plan_import(pair.south, forged(pair.north, pair.south, revoked=(statement.statement,)))
    assert isinstance(plan, ImportPlan)
    assert plan.passed_over[0][1] == "it was lifted here"
    assert [entry.outcome for entry in pair.south.audit_log.entries() if entry.act == "revoke"][-1] == "lifted"


# -- L13: names ------------------------------------------------------------------------------------------------------


def test_names_of_a_bundle_never_stand_for_two_nodes_or_for_digits(pair: Pair) -> None:
    mine = bytes.fromhex("aa" * 10)
    pair.south.nodes.put(NodeRecord(mine, name="gripper"))
    boards = [Board(uuid=bytes([number]) * 10) for number in (1, 2, 3)]
    for board in boards:
        key_up(pair.north, board)
    names = ("gripper", "gripper", "8d4d")
    nodes = [node_of(board, name=name) for board, name in zip(boards, names, strict=True)]
    plan = plan_import(pair.south, forged(pair.north, pair.south, *nodes))
    assert isinstance(plan, ImportPlan)
    assert [planned.name for planned in plan.nodes] == ["gripper-0101", "gripper-0202", "8d4d-0303"]
    assert all("is called" in planned.notes[0] for planned in plan.nodes)
    import_bundle(pair.south, plan)
    assert pair.south.nodes.resolve("gripper") == mine
    assert pair.south.nodes.resolve("gripper-0202") == boards[1].uuid


# -- more nodes than a bundle holds ----------------------------------------------------------------------------------


def several(pair: Pair, mode: Mode, output: Path) -> list[str]:
    plans = plan_exports(pair.north, ExportOrder(("south",), None, mode), most=2)
    return [exported.plan.id for exported in export_all(pair.north, plans, outputs_of(output, len(plans)))]


@pytest.mark.parametrize("mode", ["copy", "move"])
def test_many_nodes_go_in_several_bundles_with_a_receipt_each(tmp_path: Path, mode: Mode) -> None:
    pair = Pair.make(tmp_path, 5)
    output = tmp_path / "all.jwe"
    ids = several(pair, mode, output)
    assert [path.name for path in sorted(tmp_path.glob("all.jwe*"))] == ["all.jwe", "all.jwe.2", "all.jwe.3"]
    assert several(pair, mode, output) == ids
    for path in outputs_of(output, 3):
        close(pair.north, pair.take(path).receipt)
    assert {row.state for row in pair.north.handovers.all()} == {"closed"}
    expected = 2 if mode == "move" else 1
    assert [session(pair.south, board) for board in pair.boards] == [expected] * 5
    pair.close()


@pytest.mark.parametrize("cut", [1, 2, 3])
def test_a_move_in_several_bundles_that_was_cut_is_carried_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cut: int
) -> None:
    pair = Pair.make(tmp_path, 5)
    output, written = tmp_path / "all.jwe", []

    @contextmanager
    def dying(path: Path) -> Iterator[BinaryIO]:
        written.append(path)
        with new_file(path) as file:
            yield file
            if len(written) == cut:
                raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.handover.outgoing.new_file", dying)
        with pytest.raises(KeyboardInterrupt):
            several(pair, "move", output)
    assert len(pair.north.policy.tombstones()) == 5  # all of them rest before the first file exists
    ids = several(pair, "move", output)
    assert len(set(ids)) == 3
    assert len(pair.north.handovers.all()) == 3
    for path in outputs_of(output, 3):
        close(pair.north, pair.take(path).receipt)
    assert [session(pair.south, board) for board in pair.boards] == [2] * 5
    pair.close()


def test_a_name_that_is_taken_is_found_before_any_key_rests(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 3)
    (tmp_path / "all.jwe.2").write_text("somebody's")
    with pytest.raises(UsageError):
        several(pair, "move", tmp_path / "all.jwe")
    assert pair.north.policy.tombstones() == []
    pair.close()


def test_each_of_several_bundles_can_be_undone(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 3)
    first, second = several(pair, "move", tmp_path / "all.jwe")
    undo(pair.north, find_handover(pair.north, second))
    assert len(pair.north.policy.tombstones()) == 2
    assert find_handover(pair.north, first).state == "open"
    pair.close()
