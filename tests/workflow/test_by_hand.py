"""Steps run by hand, one after the other: cut anywhere, the next one knows what the node knows."""

from __future__ import annotations

import pytest

from teds_provision.errors import NodeRefused, NodeSilent
from teds_provision.protocol.messages.frames import Reason, refusal
from teds_provision.station.station import Station
from teds_provision.steps.agree import agree, require_session
from teds_provision.steps.build import BuildOrder, build
from teds_provision.steps.identify import identify
from teds_provision.steps.sign_command import SignOrder, sign_image
from teds_provision.steps.write import write
from teds_provision.store import WhitelistEntry
from teds_provision.teds.image import Image

from .bench import Board, MemoryLink, talk

ANGLE = BuildOrder(profile="magnetic-angular-position-sensor")


@pytest.mark.parametrize("lost", [4, 5, 6])  # Confirm, Open, the sealed Identify
@pytest.mark.parametrize("rotate", [False, True])
def test_a_datasheet_signed_by_hand_after_a_cut_agreement_is_taken(
    station: Station, board: Board, lost: int, rotate: bool
) -> None:
    station.store.put_whitelist(WhitelistEntry(board.uuid))
    if rotate:
        with talk(board) as node:
            agree(station, node, identify(station, node))
        lost += 1  # Open under the present key
    with pytest.raises(NodeSilent), talk(board, MemoryLink(board, lose_reply=lost)) as node:
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


def test_a_node_that_refuses_at_the_last_of_all_attempts_is_told_as_such(station: Station, board: Board) -> None:
    station.store.put_whitelist(WhitelistEntry(board.uuid))
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
        with pytest.raises(NodeRefused) as refused:
            write(station, node, signed, has=Image(board.uuid, signed.unsigned_blocks()))
    assert (lost, refused.value.reason) == (0, Reason.DIGEST_MISMATCH)
