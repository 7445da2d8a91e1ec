"""The end of a node's life: revoked here and at every station that imports, out of service, replaced."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.errors import NotFoundError, NotWhitelistedError, PolicyError, UsageError
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.life import is_finished, plan_takeover, retire, revoke, take_over
from teds_provision.handover.outgoing import ExportOrder, plan_export
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.agree import ResetReceipt, agree, reset_node
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.inventory import inventory
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.verify import verify_image
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, WhitelistEntry
from teds_provision.teds.image import Image
from tests.bench import Board, talk
from tests.handover.desk import Pair, held, key_up, provisioned, session


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    made = Pair.make(tmp_path, 2)
    yield made
    made.close()


def reset(station: Station, board: Board) -> ResetReceipt:
    with talk(board) as node:
        return reset_node(station, node, identify(station, node))


# -- revoke -----------------------------------------------------------------------------------------------------------


def test_a_revoked_node_gets_nothing_any_more(pair: Pair) -> None:
    done = provisioned(pair.north, pair.board)
    pair.north.datasheets.keep_draft(Draft(pair.board.uuid, done.image))
    assert revoke(pair.north, pair.board.uuid, "stolen").fresh
    assert pair.north.datasheets.draft(pair.board.uuid) is None
    assert held(pair.north, pair.board) == []
    assert pair.north.pins.entry(pair.board.uuid) is None
    with talk(pair.board) as node, pytest.raises(PolicyError, match="was revoked: stolen"):
        agree(pair.north, node, identify(pair.north, node))
    failed = list(verify_image(pair.north, Image(pair.board.uuid, done.image.blocks)))
    assert [check.name for check in failed if check.result == "failed"] == ["not revoked"]
    assert not revoke(pair.north, pair.board.uuid, "once more").fresh


def test_whitelisting_a_revoked_node_again_does_not_help(pair: Pair) -> None:
    revoke(pair.north, pair.board.uuid, "stolen")
    pair.north.pins.put(WhitelistEntry(pair.board.uuid))
    with talk(pair.board) as node, pytest.raises(PolicyError, match="was revoked"):
        agree(pair.north, node, identify(pair.north, node))


def test_a_reason_is_needed(pair: Pair) -> None:
    for why in ("", "  ", "two\nlines", "\x1b[31mred"):
        with pytest.raises(UsageError):
            revoke(pair.north, pair.board.uuid, why)


def test_the_deny_list_travels_in_every_bundle_and_is_honoured(pair: Pair) -> None:
    lost, good = pair.boards
    pair.take(pair.export("copy")[0])
    assert session(pair.south, lost) == 1
    revoke(pair.north, lost.uuid, "lost in transit")
    path, _exported = pair.export("copy", nodes=(good.uuid,))
    plan = plan_import(pair.south, path.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [revocation.why for revocation in plan.denied] == ["lost in transit"]
    import_bundle(pair.south, plan)
    with talk(lost) as node, pytest.raises(PolicyError, match="was revoked: lost in transit"):
        agree(pair.south, node, identify(pair.south, node))
    assert session(pair.south, good) == 1


def test_a_node_on_the_receivers_deny_list_is_not_imported(pair: Pair) -> None:
    lost, good = pair.boards
    path, _ = pair.export("copy")
    revoke(pair.south, lost.uuid, "burnt")
    taken = pair.take(path)
    assert taken.notes.refused == ((lost.uuid.hex(), "it is revoked: burnt"),)
    assert held(pair.south, lost) == []
    assert session(pair.south, good) == 1


def test_a_deny_list_of_strangers_counts_for_nothing_and_is_passed_over(pair: Pair, tmp_path: Path) -> None:
    third = Pair.make(tmp_path / "third", 1)
    revoke(third.north, pair.boards[1].uuid, "says a stranger")
    (entry,) = third.north.policy.revocations()
    pair.north.policy.deny(entry)
    taken = pair.take(pair.export("copy")[0])
    assert taken.uuids == (pair.boards[0].uuid,)
    assert pair.south.policy.revocations() == []
    third.close()


def test_a_revoked_node_is_not_handed_over(pair: Pair) -> None:
    revoke(pair.north, pair.board.uuid, "stolen")
    with pytest.raises(PolicyError, match="it is revoked"):
        plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,)))
    plan = plan_export(pair.north, ExportOrder(("south",), None))
    assert [node.uuid for node in plan.nodes] == [pair.boards[1].uuid]


# -- decommission -----------------------------------------------------------------------------------------------------


def test_a_node_out_of_service_signed_that_it_is_reset(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    retire(pair.north, pair.board.uuid, reset(pair.north, pair.board))
    assert pair.board.state.state == NodeState.FACTORY
    assert held(pair.north, pair.board) == []
    assert is_finished(pair.north, pair.board.uuid)
    with pytest.raises(NotFoundError):
        pair.north.nodes.resolve("finger 1")
    with talk(pair.board) as node, pytest.raises(NotWhitelistedError):
        agree(pair.north, node, identify(pair.north, node))


def test_a_node_out_of_service_is_listed_with_its_verdict_and_with_why_it_is_out(pair: Pair) -> None:
    """`nodes`, `verify` and `ncap status` name one verdict; the reason is another fact, with a key for itself."""
    provisioned(pair.north, pair.board)
    retire(pair.north, pair.board.uuid, None)
    (listed,) = inventory(pair.north, [pair.board.uuid])
    assert (listed.verdict, listed.retired) == ("authentic", "decommissioned, unconfirmed")


def test_a_node_that_does_not_answer_is_unconfirmed_and_can_be_tried_again(pair: Pair) -> None:
    retire(pair.north, pair.board.uuid, None)
    assert not is_finished(pair.north, pair.board.uuid)
    record = pair.north.nodes.get(pair.board.uuid)
    assert record is not None
    assert record.retired == "decommissioned, unconfirmed"
    with pytest.raises(PolicyError, match="out of service"):
        plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,)))
    retire(pair.north, pair.board.uuid, reset(pair.north, pair.board))
    assert is_finished(pair.north, pair.board.uuid)
    assert held(pair.north, pair.board) == []


def test_a_node_that_was_out_of_service_and_proves_that_it_was_reset_is_out_of_it_no_more(pair: Pair) -> None:
    retire(pair.north, pair.board.uuid, None)
    reset(pair.north, pair.board)
    record = pair.north.nodes.get(pair.board.uuid)
    assert record is not None
    assert (record.retired, record.state) == (None, int(NodeState.FACTORY))


# -- replace ----------------------------------------------------------------------------------------------------------


def test_a_spare_takes_over_name_groups_and_profile(pair: Pair) -> None:
    spare = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    key_up(pair.north, spare)
    for uuid in (pair.board.uuid, spare.uuid):
        pair.north.datasheets.keep_draft(Draft(uuid, Image(uuid, {})))
    plan = plan_takeover(pair.north, pair.board.uuid, spare.uuid, copy_calibration=False)
    take_over(pair.north, plan, None)
    assert pair.north.datasheets.drafts() == [], "of the old node, and of the spare before it was one"
    record = pair.north.nodes.get(spare.uuid)
    assert record is not None
    assert (record.name, record.profile) == ("finger 1", "tactile-finger-sensor")
    assert pair.north.groups.names_of_node(spare.uuid) == ["left hand"]
    assert pair.north.nodes.resolve("finger 1") == spare.uuid
    old = pair.north.nodes.get(pair.board.uuid)
    assert old is not None
    assert (old.name, old.retired) == (None, f"replaced by {spare.uuid.hex()}, unconfirmed")
    assert plan_takeover(pair.north, pair.board.uuid, spare.uuid, copy_calibration=False).done


def test_a_spare_takes_over_a_name_that_only_the_whitelist_has(pair: Pair) -> None:
    old, spare, north = pair.board.uuid, bytes.fromhex("8d4d9da65281f700ffff"), pair.north
    north.nodes.remember(old, name=None)
    north.pins.put(WhitelistEntry(old, north.pins.pinned(old), name="left thumb"), WhitelistEntry(spare))
    assert north.nodes.resolve("left thumb") == old
    take_over(north, plan_takeover(north, old, spare, copy_calibration=False), None)
    assert north.nodes.resolve("left thumb") == spare
    assert north.pins.entry(old) is None


def calibrated(pair: Pair, tmp_path: Path) -> Board:
    from teds_provision.provisioning.build import BuildOrder
    from teds_provision.provisioning.progress import SilentReporter
    from teds_provision.provisioning.provision import provision

    board = Board(uuid=bytes.fromhex("8d4d9da65281f700aaaa"))
    calibration = tmp_path / "calibration.csv"
    calibration.write_text("# channel: 1\nraw,value\n0,-40\n21120,125\n")
    with talk(board) as node:
        order = BuildOrder("temperature-sensor", calibration=calibration, name="thermo")
        provision(pair.north, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
    return board


@pytest.mark.parametrize("copied", [True, False])
def test_a_calibration_is_copied_only_when_told(pair: Pair, tmp_path: Path, copied: bool) -> None:
    old, spare = calibrated(pair, tmp_path), Board(uuid=bytes.fromhex("8d4d9da65281f700bbbb"))
    assert (1, 5) in old.state.blocks
    key_up(pair.north, spare)
    plan = plan_takeover(pair.north, old.uuid, spare.uuid, copy_calibration=copied)
    take_over(pair.north, plan, reset(pair.north, old))
    provisioned(pair.north, spare, "temperature-sensor")
    same = spare.state.blocks.get((1, 5)) == old.state.blocks[1, 5]
    assert same is copied
    record = pair.north.nodes.get(spare.uuid)
    assert record is not None
    assert record.name == "thermo"


def test_a_node_of_another_type_is_no_spare(pair: Pair, tmp_path: Path) -> None:
    """It was accepted: the old node was reset, and the datasheet could not be written to the other one."""
    thermometer, finger = calibrated(pair, tmp_path), pair.board
    provisioned(pair.north, finger, "tactile-finger-sensor")
    with pytest.raises(WrongBoardError, match=r"is of a different type: Channel 1.*Nothing was changed") as refused:
        plan_takeover(pair.north, thermometer.uuid, finger.uuid, copy_calibration=False)
    assert "--retype" in refused.value.hint
    spare = Board(uuid=bytes.fromhex("8d4d9da65281f700cccc"))
    key_up(pair.north, spare)
    plan = plan_takeover(pair.north, thermometer.uuid, spare.uuid, copy_calibration=False)
    take_over(pair.north, plan, None)
    assert plan_takeover(pair.north, thermometer.uuid, spare.uuid, copy_calibration=False).done, "it may be repeated"


def test_what_cannot_be_replaced(pair: Pair) -> None:
    first, second = (board.uuid for board in pair.boards)
    with pytest.raises(UsageError):
        plan_takeover(pair.north, first, first, copy_calibration=False)
    with pytest.raises(NotFoundError, match="is not known here"):
        plan_takeover(pair.north, bytes(10), second, copy_calibration=False)
    with pytest.raises(NotWhitelistedError):
        plan_takeover(pair.north, first, bytes(10), copy_calibration=False)
    with pytest.raises(NotFoundError, match="No calibration"):
        plan_takeover(pair.north, first, second, copy_calibration=True)
    pair.export("move")
    with pytest.raises(PolicyError, match="was moved"):
        plan_takeover(pair.north, first, second, copy_calibration=False)
