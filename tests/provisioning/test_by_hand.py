"""Steps run by hand, one after the other: cut anywhere, the next one knows what the node knows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import NodeRefusedError, NodeSilentError, UsageError
from teds_provision.links import Contact
from teds_provision.protocol.messages.frames import Reason, refusal
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.meeting import pick_single_node
from teds_provision.provisioning.sign import SignOrder, sign_image
from teds_provision.provisioning.teds_read import NodeSnapshot
from teds_provision.provisioning.write import write
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.image import Image
from tests.bench import Board, MemoryLink, contact, talk

from .test_provision import run as provision

ANGLE = BuildOrder(profile="magnetic-angular-position-sensor")


@pytest.mark.parametrize("lost", [4, 5, 6])  # Confirm, Open, the sealed Identify
@pytest.mark.parametrize("rotate", [False, True])
def test_a_datasheet_signed_by_hand_after_a_cut_agreement_is_taken(
    station: Station, board: Board, lost: int, rotate: bool
) -> None:
    station.pins.put(WhitelistEntry(board.uuid))
    if rotate:
        with talk(board) as node:
            agree(station, node, identify(station, node))
        lost += 1  # Open under the present key
    with pytest.raises(NodeSilentError), talk(board, MemoryLink(board, lose_reply=lost)) as node:
        agree(station, node, identify(station, node), rotate=rotate)
    with talk(board) as node:
        agree(station, node, identify(station, node))
    build(station, board.uuid, ANGLE)
    signed = sign_image(station, SignOrder(board.uuid), None).signed
    with talk(board) as node:
        identify(station, node)
        require_session(station, node)
        assert write(station, node, signed.image).octets > 0
    assert board.state.provisioned


def test_a_node_that_refuses_at_the_last_of_all_attempts_is_reported_as_such(station: Station, board: Board) -> None:
    station.pins.put(WhitelistEntry(board.uuid))
    with talk(board) as node:
        agree(station, node, identify(station, node))
    build(station, board.uuid, ANGLE)
    signed = sign_image(station, SignOrder(board.uuid), None).signed.image
    lost = 2

    def drop_session(_count: int, reply: bytes) -> bytes:
        nonlocal lost
        if link.frames[-1][2:4] == b"\x80\x04" and len(link.frames[-1]) > 500 and lost:
            lost -= 1
            return refusal(Reason.WRONG_STATE).encode()
        return reply

    link = MemoryLink(board, tamper=drop_session)
    with talk(board, link) as node:
        require_session(station, node)
        present = NodeSnapshot(Image(board.uuid, signed.unsigned_blocks()), board.tim.identity(), lambda _block: False)
        with pytest.raises(NodeRefusedError) as refused:
            write(station, node, signed, present=present)
    assert (lost, refused.value.reason) == (0, Reason.DIGEST_MISMATCH)


def test_what_the_node_lost_since_it_was_read_is_sent_again(station: Station, board: Board) -> None:
    """The commit is refused (6) because a TEDS that was not sent is not what it was: then everything is sent."""
    done = provision(station, board)
    renamed = replace(ANGLE, name="renamed")
    build(station, board.uuid, renamed)
    signed = sign_image(station, SignOrder(board.uuid), None).signed.image
    channel = (1, 3)
    assert signed.blocks[channel] == done.image.blocks[channel], "not sent at first"
    damaged = done.image.blocks[0, 12]
    board.flash.state = replace(board.state, blocks={**board.state.blocks, channel: damaged})
    board.power_on()
    with talk(board) as node:
        require_session(station, node)
        write(station, node, signed)
    assert board.state.blocks[channel] == signed.blocks[channel]
    assert board.state.sequence == 2


def test_a_digest_that_never_fits_is_reported_and_nothing_is_sent_a_third_time(station: Station, board: Board) -> None:
    provision(station, board)
    build(station, board.uuid, replace(ANGLE, name="renamed"))
    signed = sign_image(station, SignOrder(board.uuid), None).signed.image
    wrong = signed.with_block((1, 3), signed.blocks[0, 12])
    with talk(board) as node:
        require_session(station, node)
        with pytest.raises(NodeRefusedError):
            write(station, node, wrong)
    assert board.state.sequence == 1


def _at(board: Board, address: int) -> Contact:
    return replace(contact(board, MemoryLink(board, via="can")), address=address)


def test_of_several_nodes_the_one_that_is_not_finished_is_meant(station: Station) -> None:
    boards = [Board(uuid=bytes([number]) * 10) for number in range(3)]
    contacts = [_at(board, 0x10 + number) for number, board in enumerate(boards)]
    with pytest.raises(UsageError, match="3 nodes answer"):
        pick_single_node(station, contacts)
    provision(station, boards[0])
    provision(station, boards[2])
    contacts = [_at(board, 0x10 + number) for number, board in enumerate(boards)]
    assert pick_single_node(station, contacts).identity.uuid == boards[1].uuid
    provision(station, boards[1])
    contacts = [_at(board, 0x10 + number) for number, board in enumerate(boards)]
    with pytest.raises(UsageError, match="3 nodes answer"):
        pick_single_node(station, contacts)
    assert pick_single_node(station, contacts[1:2]).identity.uuid == boards[1].uuid


def test_a_node_whose_last_verdict_was_not_good_is_not_finished(station: Station) -> None:
    boards = [Board(uuid=bytes([number]) * 10) for number in range(2)]
    for board in boards:
        provision(station, board)
    row = station.datasheets.reading(boards[1].uuid)
    assert row is not None
    station.datasheets.keep_reading(replace(row, checks='[["form", "failed", "a checksum is wrong"]]'))
    contacts = [_at(board, 0x10 + number) for number, board in enumerate(boards)]
    assert pick_single_node(station, contacts).identity.uuid == boards[1].uuid
