"""Announce and Claim of the node in C as wire.md has them: how long each wait may be, who moves where, and how often.

The Python node's are in tests/protocol/test_announce.py.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import single
from tests.firmware.bench import CBench
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID
from tests.protocol.operation.bench import SECOND

pytestmark = pytest.mark.system

CRC = zlib.crc32(UUID)
OWN = 192
"""1 + CRC-32 of its UUID mod 239."""


class Bus:
    """The node alone on a bus; whatever it draws are the greatest numbers, so that it waits as long as it may."""

    def __init__(self) -> None:
        self.now = 100.0
        self.node = MemoryNode(
            lambda kind, size: NODE.secret() if kind == "i" else b"\xff" * size, lambda: self.now, uuid=UUID
        )
        assert self.node.start() == 0

    def frames(self) -> list[tuple[int, str]]:
        """Return what it sends now."""
        sent = []
        self.node.poll()
        while (frame := self.node.next_frame()) is not None:
            sent.append((frame[0], frame[1].hex()))
        return sent

    def announce(self, crc: int, *, address: int | None = None, state: int = 0, pressed: int = 0) -> None:
        """Another node announces itself, by default from the address of this one."""
        at = self.node.can_address if address is None else address
        octets = bytes([1, state]) + crc.to_bytes(4, "big") + bytes([pressed, 0])
        self.node.take_frame(0x1CFF0000 | at, octets)


def own(address: int) -> tuple[int, str]:
    """Its Announce from this address, in factory state."""
    return 0x1CFF0000 | address, f"0100{CRC:08x}0000"


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.node.close()


def test_the_first_announce_leaves_within_half_a_second_of_the_start(bus: Bus) -> None:
    bus.node.joins_bus()
    bus.now += 0.49
    assert bus.frames() == []
    bus.now += 0.01
    assert bus.frames() == [own(OWN)]
    bus.now += 60
    assert bus.frames() == [], "once"


def test_the_smaller_crc_stays_and_announces_within_50_ms(bus: Bus) -> None:
    bus.announce(CRC + 1)
    bus.now += 0.049
    assert bus.frames() == []
    bus.now += 0.001
    assert bus.frames() == [own(OWN)]


def test_an_answer_to_everyone_leaves_within_50_ms(bus: Bus) -> None:
    bus.node.take_frame(0x18DBFFF1, single(bytes.fromhex("07000080070000")))
    bus.now += 0.049
    assert bus.frames() == []
    bus.now += 0.001
    assert [frame[0] for frame in bus.frames()] == [0x18DAF100 | OWN]


def test_nothing_but_an_identify_is_answered_to_a_question_to_everyone(bus: Bus) -> None:
    for command in ("000080080000", "0000800700", "00008007000000", "000180070000", "0000800b0000"):
        body = bytes.fromhex("07" + command)
        bus.node.take_frame(0x18DBFFF1, single(body, fd=len(body) > 7), fd=len(body) > 7)
        bus.now += 1
        assert bus.frames() == [], command


def test_239_is_an_address_like_another(bus: Bus) -> None:
    bus.node.take_can_address(238)
    bus.announce(CRC - 1)
    assert bus.node.can_address == 239


def test_the_greater_crc_moves_to_the_next_address_from_which_nothing_was_heard(bus: Bus) -> None:
    bus.node.take_can_address(238)
    bus.node.take_frame(0x1CFF20EF, bytes(8))  # a data frame of 239
    bus.announce(CRC + 5, address=1)
    bus.node.take_frame(0x18DAF102, bytes(8))  # a reply of 2 to a station
    bus.announce(CRC - 1)
    assert bus.node.can_address == 3, "239 is followed by 1"
    bus.now += 0.05
    assert bus.frames() == [own(3)]


def test_who_claims_nothing_moves_nobody(bus: Bus) -> None:
    bus.announce(CRC - 1, address=OWN + 1)
    bus.announce(CRC)
    bus.announce(CRC - 1, pressed=1)
    bus.announce(CRC - 1, state=3)
    bus.node.take_frame(0x1CFF0000 | OWN, b"\x02\x00" + bytes(6))  # another version
    bus.now += 1
    assert (bus.node.can_address, bus.frames()) == (OWN, [])
    bus.announce(CRC - 1, pressed=2)
    assert bus.node.can_address == OWN + 2, "any other value counts as 0; the next one was heard"


def test_moves_after_the_third_wait_twice_as_long_each_and_ten_quiet_minutes_forget_them(bus: Bus) -> None:
    at = 10
    bus.node.take_can_address(at)
    for _ in range(3):
        bus.announce(1)
        at += 1
        assert bus.node.can_address == at
    for wait in (1, 2, 4, 8, 16, 32, 60, 60):
        bus.announce(1)
        bus.now += wait - 0.01
        bus.announce(1)
        bus.frames()
        assert bus.node.can_address == at, wait
        bus.now += 0.01
        bus.frames()
        at += 1
        assert bus.node.can_address == at, wait
    bus.announce(1)
    bus.now += 60
    bus.frames()
    at += 1
    assert bus.node.can_address == at
    bus.now += 539.9  # 599.9 s since the last conflict
    bus.announce(CRC + 1)
    bus.now += 599.9
    bus.announce(1)
    assert bus.node.can_address == at, "a conflict that it wins counts too"
    bus.now += 60
    bus.frames()
    at += 1
    bus.now += 540
    for _ in range(3):
        bus.announce(1)
        at += 1
        assert bus.node.can_address == at


def test_at_most_twenty_announces_a_minute(bus: Bus) -> None:
    left = []
    for _ in range(1300):
        bus.announce(CRC + 1)
        bus.now += 0.1
        left += [(bus.now, frame) for frame in bus.frames()]
    assert {frame for _, frame in left} == {own(OWN)}
    times = [at for at, _ in left]
    assert all(sum(start <= at < start + 60 for at in times) <= 20 for start in times)
    assert len(times) >= 59, "and no fewer"


@pytest.mark.parametrize("waits", [False, True], ids=["at once", "when the move is due"])
def test_who_has_an_actuator_claimed_stays_and_goes_on_announcing(waits: bool) -> None:
    bench = CBench()
    claims_it = b"\1" + bytes(7)  # the smallest CRC that there is
    for _ in range(4 if waits else 0):  # three moves at once, and the fourth waits a second
        bench.tim.take_frame(0x1CFF0000 | bench.tim.can_address, claims_it)  # type: ignore[attr-defined]
    address = bench.tim.can_address
    bench.open().operate(4)
    if not waits:
        bench.tim.take_frame(0x1CFF0000 | address, claims_it)  # type: ignore[attr-defined]
    bench.frames.clear()
    bench.later(3 * SECOND)
    assert bench.tim.can_address == address
    assert 0x1CFF0000 | address in {frame.identifier for _, frame in bench.frames}
    assert bench.tim.actuator_claimed(), "its session goes on"
    CBench.close_all()
