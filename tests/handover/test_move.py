"""A key that is given away: it rests at once, the first contact rotates it, and the node can come back."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError, UsageError
from teds_provision.files import new_file
from teds_provision.handover.incoming import ImportPlan, plan_import, prove_node, proven_of
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.handover.pending import content_digest
from teds_provision.provisioning.address import set_address
from teds_provision.provisioning.agree import agree, open_session
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.station.store.records import RevocationRecord
from tests.bench import MemoryLink, make_station, talk
from tests.handover.desk import Pair, held, node_key_id, provisioned, session, trust


@pytest.mark.parametrize("count", [0, 1, 3, 1001])
def test_a_handover_is_known_by_the_digest_that_earlier_versions_noted(count: int) -> None:
    nodes = [(number.to_bytes(10, "big"), f"{number:016x}", number) for number in range(count)]
    parts = [
        "ab" * 32,
        ["cd" * 32, "ef" * 32],
        "copy",
        "04" * 65,
        [[uuid.hex(), key, epoch] for uuid, key, epoch in nodes],
    ]
    whole = hashlib.sha256(json.dumps(parts, separators=(",", ":")).encode()).hexdigest()
    assert content_digest("ab" * 32, ["ef" * 32, "cd" * 32], "copy", b"\x04" * 65, nodes) == whole


def test_what_is_there_before_the_key_is_stored_cannot_be_opened(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is killed before the store has the move leaves a draft at most, without signature and tag."""
    left: list[bytes] = []

    def dying(*_: object) -> None:
        (draft,) = (path for path in pair.folder.glob(".*") if path.name.endswith(".teds-part"))
        left.append(draft.read_bytes())
        raise KeyboardInterrupt

    @contextmanager
    def unbuffered(path: Path) -> Iterator[SimpleNamespace]:
        with new_file(path) as file:
            yield SimpleNamespace(write=lambda octets: (file.write(octets), file.flush()))

    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.handover.outgoing._record", dying)
        patch.setattr("teds_provision.handover.outgoing.new_file", unbuffered)
        with pytest.raises(KeyboardInterrupt):
            pair.export("move")
    assert not pair.north.policy.tombstones()
    assert b'"ciphertext"' in left[0]
    assert b'"tag"' not in left[0]
    for closed in (left[0], left[0] + b'"}', left[0] + b'","tag":"AAAAAAAAAAAAAAAAAAAAAA"}'):
        with pytest.raises((BadDataError, NotAuthenticError)):
            plan_import(pair.south, closed)
    assert isinstance(plan_import(pair.south, pair.export("move")[0].read_bytes()), ImportPlan)


def test_a_move_rests_the_key_at_once(pair: Pair) -> None:
    _, exported = pair.export("move")
    for act in (session, key_again):
        with pytest.raises(PolicyError, match="was moved to station") as refused:
            act(pair.north, pair.board)
        assert f"handover undo {exported.plan.id}" in refused.value.hint


def key_again(station, board):  # type: ignore[no-untyped-def]
    with talk(board) as node:
        agree(station, node, identify(station, node))


def test_a_moved_node_can_still_be_verified_by_its_former_station(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    pair.export("move")
    with talk(pair.board) as node:
        who = identify(pair.north, node)
        assert judge_and_keep(pair.north, node, read_image(node), who.point).verified.verdict == "authentic"


def test_the_receiver_of_a_move_rotates_at_its_first_contact(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    before = node_key_id(pair.board)
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        proven = prove_node(pair.south, node)
    assert (proven.rotated, proven.epoch) == (True, 2)
    last = list(pair.south.audit_log.entries())[-1]
    assert (last.act, last.outcome, last.detail) == ("handover", "taken over", {"epoch": 2, "rotated": True})
    assert node_key_id(pair.board) != before
    assert held(pair.south, pair.board) == [("active", 2, "agreement")]
    assert proven_of(pair.south, [pair.board.uuid]) == {pair.board.uuid}
    assert pair.south.keys.holders() == []
    assert pair.south.keys.rotation_due(pair.board.uuid) is None


@pytest.mark.parametrize("lost", range(1, 9))
@pytest.mark.parametrize("what", ["lose_request", "lose_reply"])
def test_a_first_contact_cut_anywhere_is_carried_on(pair: Pair, what: str, lost: int) -> None:
    from teds_provision.errors import NodeSilentError

    pair.take(pair.export("move")[0])
    link = MemoryLink(pair.board, via="can", tapped=False, **{what: lost})
    try:
        with talk(pair.board, link) as node:
            prove_node(pair.south, node)
    except NodeSilentError:
        pass
    epoch = session(pair.south, pair.board)
    assert epoch >= 2
    assert pair.south.keys.rotation_due(pair.board.uuid) is None
    assert [key.key_id for key in pair.south.keys.keys_of(pair.board.uuid)] == [node_key_id(pair.board)]


def test_any_first_contact_after_a_move_rotates_even_to_write(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    pair.take(pair.export("move")[0])
    done = provisioned(pair.south, pair.board)
    assert done.verified.verdict == "authentic"
    assert (pair.board.state.epoch, pair.board.state.station) == (2, pair.south.point)


def test_the_receiver_writes_and_rotates_under_the_senders_ca(pair: Pair) -> None:
    assert pair.north.ca != pair.south.ca
    pair.take(pair.export("copy")[0])
    done = provisioned(pair.south, pair.board)
    assert done.verified.verdict == "authentic"
    assert pair.board.state.ca == pair.north.ca
    with talk(pair.board) as node:
        assert agree(pair.south, node, identify(pair.south, node), rotate=True).epoch == 2


def test_the_senders_ca_counts_for_these_nodes_and_no_others(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    assert pair.north.ca in pair.south.policy.trusted_cas(pair.board.uuid)
    assert pair.north.ca not in pair.south.policy.trusted_cas()
    assert pair.north.ca not in pair.south.policy.trusted_cas(bytes(10))


def test_a_reset_node_gets_its_new_stations_own_ca(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    pair.board.tim.reset_by_hand()
    with talk(pair.board) as node:
        agree(pair.south, node, identify(pair.south, node))
    assert pair.board.state.ca == pair.south.ca
    assert provisioned(pair.south, pair.board).verified.verdict == "authentic"


def test_a_move_has_one_receiver(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    with pytest.raises(UsageError, match="exactly one receiver"):
        pair.export("move", to=("south", "west"))
    west.close()


def test_a_node_goes_there_and_back(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    session(pair.south, pair.board)
    back = pair.folder / "back.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), None, "move")), back)
    pair.take(back, pair.north)
    assert session(pair.north, pair.board) == 3
    assert pair.north.policy.tombstone(pair.board.uuid) is None
    with pytest.raises(PolicyError, match="was moved to station"):
        session(pair.south, pair.board)


def test_a_copy_brings_no_moved_node_back(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    session(pair.south, pair.board)
    copy = pair.folder / "copy.jwe"
    export_bundle(pair.south, plan_export(pair.south, ExportOrder(("north",), None, "copy")), copy)
    with pytest.raises(PolicyError, match="only that station can move it back"):
        plan_import(pair.north, copy.read_bytes())
    assert pair.north.policy.tombstone(pair.board.uuid) is not None


@pytest.mark.parametrize("revoked", [True, False])
def test_a_move_under_way_is_not_sealed_again_with_a_node_that_was_revoked_or_forgotten(
    pair: Pair, revoked: bool
) -> None:
    """Found by two commands at once: revoke deletes the key while a move of the node is open."""
    pair.export("move")
    if revoked:
        pair.north.policy.deny(RevocationRecord(pair.board.uuid, None, "lost", "a statement"))
    pair.north.keys.remove(pair.board.uuid)
    with pytest.raises(PolicyError, match="is revoked" if revoked else "this station holds no key for it") as refused:
        plan_export(pair.north, ExportOrder((pair.south.name,), None, "move"))
    assert "handover undo" in (refused.value.hint or "")


def test_no_command_opens_a_session_under_a_key_that_rests(pair: Pair) -> None:
    """``address`` asks for nothing but a session; every other command is refused before."""
    pair.export("move")
    with talk(pair.board) as node, pytest.raises(PolicyError, match="was moved to station"):
        open_session(pair.north, node)
    with talk(pair.board) as node, pytest.raises(PolicyError, match="was moved to station"):
        set_address(pair.north, node, 33)
