"""What a node may make a station read before anything is known of it."""

from __future__ import annotations

import pytest

from teds_provision.errors import GarbledError, NodeRefusedError
from teds_provision.protocol.messages.frames import Reason, Reply, refusal
from teds_provision.provisioning.teds_read import LARGEST_SECURITY, read_block
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY
from tests.bench import Board, MemoryLink, talk

REFUSED = refusal(Reason.NO_SUCH_TEDS).encode()


@pytest.mark.parametrize(("block", "most"), [(SECURITY, LARGEST_SECURITY), ((0, 1), 1 << 20)])
def test_a_teds_that_claims_to_be_endless_is_not_read(board: Board, block: tuple[int, int], most: int) -> None:
    def claim(count: int, _reply: bytes) -> bytes:
        return Reply(True, (0).to_bytes(4, "big") + most.to_bytes(4, "big")).encode()

    link = MemoryLink(board, tamper=claim)
    with pytest.raises(GarbledError, match=f"at most {most} are read"):  # outside a session anyone can say so: 5, not 8
        read_block(talk(board, link), block)
    assert link.count == 1


def test_the_largest_security_teds_is_read_octet_by_octet(board: Board) -> None:
    teds = frame(bytes(LARGEST_SECURITY - 6))

    def drip(count: int, _reply: bytes) -> bytes:
        at = count - 1
        return Reply(True, at.to_bytes(4, "big") + teds[at : at + 1]).encode()

    assert read_block(talk(board, MemoryLink(board, tamper=drip)), SECURITY) == teds


def test_noise_on_a_plain_read_is_read_again_and_a_teds_that_is_bad_stays_bad(board: Board) -> None:
    def noise(count: int, reply: bytes) -> bytes:
        return reply[:-1] + bytes([reply[-1] ^ 1]) if count == 1 else reply

    good = read_block(talk(board, MemoryLink(board)), SECURITY)
    noisy = MemoryLink(board, tamper=noise)
    assert read_block(talk(board, noisy), SECURITY) == good
    assert noisy.count > MemoryLink(board).count + 1

    bad = MemoryLink(board, tamper=lambda _count, reply: reply[:-1] + bytes([reply[-1] ^ 1]))
    assert read_block(talk(board, bad), SECURITY) == good[:-1] + bytes([good[-1] ^ 1])

    restless = MemoryLink(board, tamper=lambda count, reply: reply[:-1] + bytes([reply[-1] ^ count]))
    with pytest.raises(GarbledError, match="noisy"):
        read_block(talk(board, restless), SECURITY)


def test_an_unauthenticated_refusal_is_asked_for_again(board: Board) -> None:
    """Noise made another question of a frame: the fault bench saw exit 6 at 2 % of corrupted frames."""
    good = read_block(talk(board, MemoryLink(board)), SECURITY)
    disturbed = MemoryLink(board, tamper=lambda count, reply: REFUSED if count < 3 else reply)
    assert read_block(talk(board, disturbed), SECURITY) == good

    steady = MemoryLink(board, tamper=lambda _count, _reply: REFUSED)
    with pytest.raises(NodeRefusedError, match="no such TEDS"):
        read_block(talk(board, steady), SECURITY)
    assert steady.count == 3


def test_an_unexpected_offset_is_asked_again_outside_a_session(board: Board) -> None:
    """A reply to the command before, whose process was killed, ended the next one (5) on a busy machine."""
    good = read_block(talk(board, MemoryLink(board)), SECURITY)

    def stale(count: int, reply: bytes) -> bytes:
        return Reply(True, (99).to_bytes(4, "big") + b"else").encode() if count < 3 else reply

    assert read_block(talk(board, MemoryLink(board, tamper=stale)), SECURITY) == good
    steady = MemoryLink(board, tamper=lambda _count, _reply: stale(1, b""))
    with pytest.raises(GarbledError, match="different offset"):
        read_block(talk(board, steady), SECURITY)
    assert steady.count == 3
