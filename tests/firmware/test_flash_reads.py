"""Each read of flash fails once, as on a chip behind a bus: refused, and nothing is lost by it."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from teds_provision.errors import TedsProvisionError
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, query_teds, security_command
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware.desk import CDesk
from tests.firmware.test_power_cuts import address, by_hand, commit, confirm, provisioned, reset
from tests.protocol.desk import CREDENTIALS, UUID

pytestmark = pytest.mark.system
_FLASH = -2
IDENTITY = 256
Act = Callable[[CDesk], Reply]


@pytest.fixture
def desk() -> Iterator[CDesk]:
    """Yield a provisioned node whose old slot is blank."""
    made = CDesk()
    provisioned(made)
    made.node.poll()
    yield made
    CDesk.close_all()


def query(desk: CDesk) -> Reply:
    return desk.plain(query_teds(1, 12))


def read(desk: CDesk) -> Reply:
    return desk.plain(Command(1, 1, 2, b"\x0c" + bytes(4)))


def read_absent(desk: CDesk) -> Reply:
    return desk.plain(Command(9, 1, 2, b"\x0c" + bytes(4)))


def name_all(desk: CDesk) -> Reply:
    return desk.plain(security_command(Function.LIST))


def request(desk: CDesk) -> Reply:
    return desk.plain(StationAgreement(CREDENTIALS, UUID).request())


@pytest.mark.parametrize("ask", [query, read, read_absent, name_all, request])
def test_what_cannot_be_read_now_is_11_and_no_other_answer(desk: CDesk, ask: Act) -> None:
    """Not 18, which tells a station that the datasheet lost a TEDS; not a List without it."""
    desk.node.read_fails(0)
    good = ask(desk)
    assert good.ok or ask is read_absent
    reads = desk.node.reads
    assert reads > 2
    for number in range(1, reads + 1):
        desk.node.read_fails(number)
        assert ask(desk).reason == Reason.FLASH_FAILURE, f"read {number}"
        again = ask(desk)
        assert (again.ok, again.reason) == (good.ok, good.reason)


@pytest.mark.parametrize("act", [confirm, commit, reset, by_hand, address])
def test_a_change_of_the_state_is_whole_though_a_read_failed(desk: CDesk, act: Act) -> None:
    """A record that could not be seen while the new slot was written would be gone for ever."""
    desk.restart()
    image, key, old = desk.node.image, desk.key, desk.shown()
    desk.node.read_fails(0)
    assert act(desk).ok
    reads, new = desk.node.reads, desk.shown()
    seen = set()
    for number in range(1, reads + 1):
        desk.node.image, desk.key = image, key
        desk.restart()
        desk.now += 60
        desk.node.read_fails(number)
        try:
            done = act(desk)
        except (AssertionError, TedsProvisionError, IndexError):  # what goes before it was refused
            done = Reply(False, bytes([Reason.FLASH_FAILURE]))
        desk.node.read_fails(0)
        now = desk.shown()
        assert now == (new if done.ok else old), f"read {number}"
        seen.add(done.ok)
        desk.restart()
        assert desk.shown() == now, f"read {number}: after a restart"
    assert False in seen


def test_a_start_that_cannot_read_says_so_and_the_next_one_is_good(desk: CDesk) -> None:
    """What it has to know stops it; whether the spare slot is blank does not."""
    old, image = desk.shown(), desk.node.image
    desk.node.read_fails(0)
    desk.restart()
    started = set()
    for number in range(1, desk.node.reads + 1):
        desk.node.image = image
        desk.node.read_fails(number)
        status = desk.node.start()
        assert status in (0, _FLASH), f"read {number}"
        started.add(status)
        desk.node.read_fails(0)
        if status == 0:
            assert desk.shown() == old
            assert address(desk).ok, "the spare slot is erased when it is needed"
            desk.node.image = image
        desk.restart()
        assert desk.shown() == old
    assert started == {0, _FLASH}


def test_a_first_start_that_cannot_read_its_identity_back_makes_no_second_one() -> None:
    """Written, and not known to be good: told, and there the next start finds it."""
    desk = CDesk()
    blank = bytes([0xFF]) * len(desk.node.image)
    desk.node.image = blank
    desk.node.read_fails(0)
    assert desk.node.start() == 0
    for number in range(1, desk.node.reads + 1):
        desk.node.image = blank
        desk.node.read_fails(number)
        assert desk.node.start() == _FLASH, f"read {number}"
        made = desk.node.image
        desk.node.read_fails(0)
        assert desk.node.start() == 0
        assert made[:IDENTITY] in (blank[:IDENTITY], desk.node.image[:IDENTITY])
    CDesk.close_all()


def test_a_first_start_whose_flash_reads_back_as_something_else_says_so_and_the_next_one_is_good() -> None:
    """An identity that is not there as it was written would be shown once, and be another one after the next start."""
    desk = CDesk()
    blank = bytes([0xFF]) * len(desk.node.image)
    desk.node.image = blank
    desk.node.garble(0)
    assert desk.node.start() == 0
    units = desk.node.written
    assert units > 20
    for unit in range(1, units + 1):
        desk.node.image = blank
        desk.node.garble(unit)
        assert desk.node.start() == _FLASH, f"unit {unit}"
        desk.node.garble(0)
        assert desk.node.start() == 0
        made = desk.node.image[:IDENTITY]
        assert desk.node.start() == 0
        assert desk.node.image[:IDENTITY] == made
    CDesk.close_all()
