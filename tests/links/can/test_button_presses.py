"""Whose button was pressed: a board is marked only if nothing else on the bus could have been meant."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from teds_provision.links.can import presses
from teds_provision.links.can.presses import ButtonPressLog
from teds_provision.protocol.announce import Announce

LEFT, RIGHT = Announce(0x21, 2, 0xA1A1A1A1, True), Announce(0x22, 2, 0xB2B2B2B2, True)


class Bus:
    """The log of one bus, and its time in seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.log, self.now = ButtonPressLog(), 100.0
        monkeypatch.setattr(presses, "time", SimpleNamespace(monotonic=lambda: self.now))

    def hear(self, *announces: Announce, after: float = 0.0) -> None:
        self.now += after
        for announce in announces:
            self.log.hear(announce)

    def marked(self) -> list[Announce]:
        return [board for board in (LEFT, RIGHT) if self.log.marks(board.address, board.crc)]


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    return Bus(monkeypatch)


def test_the_board_that_was_pressed_is_marked_and_is_news_once_a_second_later(bus: Bus) -> None:
    bus.hear(LEFT, replace(RIGHT, pressed=False))
    assert bus.marked() == [LEFT]
    assert bus.log.news() == [], "another one may still say the same"
    bus.now += 1.0
    assert bus.log.news() == [LEFT.crc]
    assert bus.log.news() == []


@pytest.mark.parametrize(("apart", "marked"), [(0.99, []), (1.0, [LEFT, RIGHT])])
def test_of_two_boards_within_a_second_neither_is_marked(bus: Bus, apart: float, marked: list[Announce]) -> None:
    bus.hear(LEFT)
    bus.hear(RIGHT, after=apart)
    assert bus.marked() == marked
    bus.now += 1.0
    assert bus.log.news() == [board.crc for board in marked]


def test_one_board_that_is_pressed_again_and_again_stays_marked(bus: Bus) -> None:
    bus.hear(LEFT)
    bus.hear(LEFT, after=0.5)
    assert bus.marked() == [LEFT]


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.parametrize("after", [0.0, 30.0])
def test_where_two_boards_announce_from_one_address_neither_is_marked(bus: Bus, pressed: bool, after: float) -> None:
    bus.hear(LEFT)
    bus.hear(replace(LEFT, crc=0xC3C3C3C3, pressed=pressed), after=after)
    assert bus.marked() == [], "nothing tells which of the two the hand was on"
    bus.now += 1.0
    assert bus.log.news() == []
