"""Steps run by hand, one after the other: cut anywhere, the next one knows what the node knows."""

from __future__ import annotations

import pytest

from teds_provision.errors import NodeSilent
from teds_provision.store import WhitelistEntry
from teds_provision.workflow.agree import agree, require_session
from teds_provision.workflow.build import BuildOrder, build
from teds_provision.workflow.identify import identify
from teds_provision.workflow.signing import SignOrder, sign_image
from teds_provision.workflow.station import Station
from teds_provision.workflow.write import write

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
