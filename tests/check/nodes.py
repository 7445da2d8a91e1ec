"""Nodes on a desk in memory for ``node check``: on a reader, or on a bus with several stations; no real time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import pytest

from teds_provision.check.probe import Probe
from teds_provision.check.rule import RuleResult
from teds_provision.check.run import CheckReport, check_node
from teds_provision.protocol.messages.firmware import LOCATE_SECONDS, FirmwareFlag, FirmwareReport
from teds_provision.protocol.tim import Tim
from teds_provision.station.station import Station
from teds_provision.teds.codec.frame import frame
from tests.protocol.operation.bench import SECOND, FakeHardware, channel_teds

from .. import bench
from ..bench import talk
from ..protocol.desk import META, NAME
from .faulty import FaultyBus, FaultyLink

ORIGIN: Final = (0, 130)
ORIGIN_TEDS: Final = frame(bytes([3, 4, 0, 130, 1, 1, 4, 9]) + b"kind=dbc\n")


@dataclass
class TimedHardware(FakeHardware):
    """Hardware whose clock is that of its board."""

    clock: Callable[[], float] = float

    def now(self) -> int:
        return self.tick + round(self.clock() * SECOND)


FIRMWARE: Final = FirmwareReport("desk/check", (1, 2, 3), 4, bytes(range(32)), FirmwareFlag.LOCATE)


class Board(bench.Board):
    """A node that reports its firmware and has a light to blink with."""

    hardware: TimedHardware | None = None

    def about(self) -> FirmwareReport:
        return FIRMWARE

    def locate(self, seconds: int) -> None:
        assert 0 <= seconds <= LOCATE_SECONDS

    def power_on(self) -> None:
        super().power_on()
        more: dict[str, Any] = {"max_message": self.max_message, "hardware": self.hardware, "firmware": self}
        self.tim = Tim(self.key, self.flash, lambda: self.seconds, **more)


class MeasuringBoard(Board):
    """A node with channels, which a session may claim; their TEDS fit."""

    hardware: TimedHardware

    def power_on(self) -> None:
        self.hardware = TimedHardware(clock=lambda: self.seconds)
        super().power_on()


def made(over: str = "nfc", *, epoch: int = 4) -> Board:
    """Return a node in factory state that was keyed before, with a Meta-TEDS and a name of its own."""
    board = MeasuringBoard() if over.startswith("measuring") else Board()
    blocks = {(0, 1): META, (1, 12): NAME}
    if isinstance(board, MeasuringBoard) and not over.endswith("blank"):
        blocks |= {(number, 3): channel_teds(facts) for number, facts in board.hardware.channels.items()}
    read_only = frozenset({ORIGIN} if over.endswith("read-only") else ())
    blocks |= dict.fromkeys(read_only, ORIGIN_TEDS)
    board.flash.state = replace(board.state, blocks=blocks, read_only=read_only, epoch=epoch)
    board.power_on()
    return board


def checked(
    station: Station, patch: pytest.MonkeyPatch, board: Board | None = None, *, over: str = "nfc", factory: bool = True,
    explained: bool = False, line: FaultyLink | None = None, **link: Any,
) -> CheckReport:  # fmt: skip
    """Run the rules; waits of theirs pass at once, for the node as well."""
    board = made(over) if board is None else board

    def pause(self: Probe, seconds: float) -> None:
        board.seconds += seconds

    patch.setattr(Probe, "pause", pause)
    patch.setattr(Probe, "now", lambda self: board.seconds)
    line = line or (FaultyBus(board, **link) if "can" in over else FaultyLink(board, **link))
    return check_node(station, talk(board, line), factory=factory, explained=explained)


def failed(report: CheckReport) -> dict[str, RuleResult]:
    """Return the rules that the node breaks."""
    return {check.rule: check for check in report.checks if check.result == "failed"}


def names(report: CheckReport, result: str) -> set[str]:
    """Return the rules that ended so."""
    return {check.rule for check in report.checks if check.result == result}
