"""How long a station listens after a question to everyone (wire.md, "CAN"): the bus is a mock, the clock the test's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.links.can import identify_broadcast
from teds_provision.links.can.bus_multiplexer import BroadcastReplies
from teds_provision.links.can.identify_broadcast import FunctionalAnswers, ask_all
from teds_provision.links.can.isotp import Frame, single
from teds_provision.protocol.messages.frames import Reply
from teds_provision.protocol.messages.identity import Identity, NodeState

WHO = Identity(bytes(range(10)), NodeState.KEYED, 1, 2, 1024, 0x21)
ANSWER = Reply(True, WHO.encode()).encode()


class MockBus:
    """A bus on which frames of answers come at these moments, the last of each makes it whole."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, frames: list[float]) -> None:
        self.now, self.frames = 0.0, frames
        self.spec, self.own = SimpleNamespace(fd=False), 0xF1
        self.sent: list[Frame] = []
        monkeypatch.setattr(identify_broadcast, "time", SimpleNamespace(monotonic=lambda: self.now))

    @contextmanager
    def gather(self, transaction: int) -> Iterator[Any]:
        self.replies = BroadcastReplies(0xF1, transaction)
        self.heard_at = self.now
        yield self

    def send(self, frame: Frame) -> None:
        self.sent.append(frame)

    def check(self) -> None:
        """Be a bus that is well."""

    def next(self, seconds: float) -> int | None:
        until = self.now + max(0.0, seconds)
        if self.frames and self.frames[0] <= until:
            self.now = self.heard_at = self.frames.pop(0)
            self.replies.answers[0x21] = ANSWER
            return 0x21
        self.now = round(until, 6)
        return None

    def listen(self) -> float:
        """Ask everyone; return when the station stopped listening."""
        *shown, found = ask_all(self, 7, silence=0.3, longest=3.0)  # type: ignore[arg-type]
        assert self.sent == [Frame(0x18DBFFF1, single(bytes.fromhex("07000080070000")))]
        assert isinstance(found, FunctionalAnswers)
        assert len(shown) == len(found.identities) <= 1, "each node is shown once"
        return round(self.now, 3)


@pytest.mark.parametrize(
    ("frames", "ends"),
    [
        ([], 0.3),
        ([0.05], 0.35),
        ([0.29, 0.58, 0.87], 1.17),
        ([0.05, 0.36], 0.35),  # the second one comes too late
        ([round(0.2 * count, 3) for count in range(40)], 3.0),
    ],
)
def test_a_station_listens_until_300_ms_of_silence_and_3_s_at_most(
    monkeypatch: pytest.MonkeyPatch, frames: list[float], ends: float
) -> None:
    assert MockBus(monkeypatch, list(frames)).listen() == ends


def test_these_are_the_seconds_that_a_station_asks_for() -> None:
    assert (identify_broadcast.SILENCE_SECONDS, identify_broadcast.LONGEST_SECONDS) == (0.3, 3.0)
