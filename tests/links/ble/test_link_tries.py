"""How often a station repeats over the air (wire.md, "Repetition"): loop, connection and clock are doubles."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NodeSilentError
from teds_provision.links.ble import link as of_link
from teds_provision.links.ble.connection import ConnectionLostError, NotConnectedError
from teds_provision.links.ble.link import BleLink

LOST, NONE, LATE = ConnectionLostError("gone"), NotConnectedError("refused"), TimeoutError()


class Scene:
    """A link whose exchanges end as listed, each after so many seconds; ``asked`` is what was sent."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, outcomes: list[bytes | Exception], takes: float) -> None:
        self.now, self.outcomes, self.takes = 100.0, list(outcomes), takes
        self.asked, self.pauses, self.notes = list[tuple[int, bytes, float]](), list[float](), list[Any]()
        self.was_up, self.address = True, "C1"
        numbers = iter(range(7, 99))
        monkeypatch.setattr(of_link, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep))
        loop: Any = SimpleNamespace(run=lambda work: work())
        connection: Any = self
        self.link = BleLink(loop, connection, lambda: next(numbers), lambda: False, self.notes.append)

    def sleep(self, seconds: float) -> None:
        self.pauses.append(seconds)
        self.now += seconds

    def exchange(self, transaction: int, frame: bytes, seconds: float) -> Callable[[], bytes]:
        def work() -> bytes:
            self.asked.append((transaction, frame, seconds))
            self.now += self.takes
            outcome = self.outcomes.pop(0)
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        return work


@pytest.mark.parametrize(
    ("outcomes", "takes", "tries", "pauses"),
    [
        ([b"ok"], 1.0, 1, []),
        ([LATE, LATE, b"ok"], 4.9, 3, []),
        ([LATE, LATE, LATE], 4.0, 3, []),
        ([LATE, LATE], 7.5, 2, []),  # the 15 s are over
        ([LOST, LOST, LOST], 0.1, 3, [0.3, 0.6, 1.2]),
        ([LOST, b"ok"], 0.1, 2, [0.3]),
        ([LOST, NONE, NONE, NONE, LOST, b"ok"], 0.1, 6, [0.3, 0.6, 1.2, 2.0, 2.0]),  # what was not sent is no try
    ],
)
def test_a_request_is_repeated_twice_at_most_within_15_s_under_its_transaction(
    outcomes: list[bytes | Exception], takes: float, tries: int, pauses: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(monkeypatch, outcomes, takes)
    if outcomes[-1] == b"ok":
        assert scene.link.exchange(b"frame") == b"ok"
    else:
        with pytest.raises(NodeSilentError):
            scene.link.exchange(b"frame")
    assert scene.asked == [(7, b"frame", 5.0)] * tries
    assert scene.pauses == pytest.approx(pauses)
    assert len(scene.notes) == len(pauses), "each new connection is reported"


def test_a_node_that_was_never_connected_is_tried_three_times(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, [NONE, NONE, NONE], 0.1)
    scene.was_up = False
    with pytest.raises(NodeSilentError):
        scene.link.exchange(b"frame")
    assert len(scene.asked) == 3


@pytest.mark.parametrize("outcome", [LATE, LOST, NONE])
def test_an_order_is_sent_once_and_a_frame_that_is_sent_again_keeps_its_transaction(
    outcome: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(monkeypatch, [b"one", outcome, b"two", b"three"], 0.1)
    assert scene.link.exchange(b"first") == b"one"
    with pytest.raises(NodeSilentError):
        scene.link.exchange_within(b"order", 0.25)
    assert scene.link.resend(b"order") == b"two"
    assert scene.link.exchange(b"next") == b"three"
    assert scene.asked == [(7, b"first", 5.0), (8, b"order", 0.25), (8, b"order", 5.0), (9, b"next", 5.0)]


def test_a_drive_message_that_finds_no_connection_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, written = Scene(monkeypatch, [], 0.1), list[bytes]()
    outcomes: list[Exception | None] = [None, LOST]

    def write_data(message: bytes) -> Callable[[], None]:
        def work() -> None:
            written.append(message)
            if (error := outcomes.pop(0)) is not None:
                raise error

        return work

    monkeypatch.setattr(scene, "write_data", write_data, raising=False)
    scene.link.drive(b"\1drive")
    with pytest.raises(NodeSilentError) as silent:
        scene.link.drive(b"\2drive")
    assert written == [b"\1drive", b"\2drive"]
    assert silent.value.message == "The node at C1 does not answer over BLE (gone)."
    assert silent.value.hint == "Bring it closer. It advertises for 60 s after a tap, and while it has a key."


def test_what_a_thread_no_longer_waits_for_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    cancelled, results = list[bool](), [KeyboardInterrupt(), LinkError("Gone."), None]

    class Running:
        def result(self) -> str:
            if failure := results.pop(0):
                raise failure
            return "done"

        def cancel(self) -> None:
            cancelled.append(True)

    given: list[Any] = []
    monkeypatch.setattr(
        of_link.asyncio,
        "run_coroutine_threadsafe",
        lambda work, loop: given.append((work, loop)) or Running(),  # type: ignore[attr-defined, func-returns-value]
    )
    loop: Any = of_link.Loop.__new__(of_link.Loop)
    loop._loop = "its loop"
    for error in (KeyboardInterrupt, LinkError):
        with pytest.raises(error):
            loop.run("work")
    assert cancelled == [True, True]
    assert loop.run("work") == "done"
    assert (len(cancelled), given) == (2, [("work", "its loop")] * 3)
