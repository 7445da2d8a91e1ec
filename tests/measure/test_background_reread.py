"""The rest of a datasheet that is read beside the values: when it is tried, how often, and who goes first."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDatasheetError, NodeSilentError
from teds_provision.measure import background_reread
from teds_provision.measure.background_reread import AGAIN, FIRST, PATIENCE, SPARING, TRIES, BackgroundReread


class Scene:
    """A reader of a node's rest, the clock that it reads, and what it did; an exchange takes 50 ms."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, answers: bool = True) -> None:
        self.now, self.asked = 100.0, list[float]()
        clock = SimpleNamespace(monotonic=lambda: self.now, time=lambda: 1.8e9)
        monkeypatch.setattr(background_reread, "time", clock)

        def read_in_between(_node: Any, *, gap: int) -> Iterator[None]:
            for _ in range(3):
                self.asked.append(self.now)
                self.now += 0.05
                if not answers:
                    raise NodeSilentError("The node does not answer.")
                yield

        monkeypatch.setattr(background_reread, "read_in_between", read_in_between)
        monkeypatch.setattr(BackgroundReread, "_conclude", lambda _self, _image: None)
        self.bus: Any = SimpleNamespace(beginning=set(), reading=threading.Lock())
        trusted: Any = SimpleNamespace(node=SimpleNamespace(open_counter=1))
        none: Any = None
        self.rest = BackgroundReread(none, trusted, self.bus, by="ncap")

    def run(self, seconds: float) -> bool:
        """Take a step every tenth of a second; False once nothing is left to do."""
        until = self.now + seconds
        while self.now < until:
            self.now += 0.1
            if not self.rest.step():
                return False
        return True


def test_a_node_that_does_not_answer_is_tried_five_times_ten_seconds_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, answers=False)
    assert scene.run(1000.0) is False
    assert len(scene.asked) == TRIES
    apart = [later - sooner for sooner, later in zip(scene.asked, scene.asked[1:], strict=False)]
    assert all(AGAIN <= seconds < AGAIN + 0.3 for seconds in apart)
    assert scene.bus.reading.acquire(blocking=False), "another node of the bus has its turn meanwhile"


def test_nothing_is_read_in_the_first_second_nor_four_times_as_long_as_an_exchange_took(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = Scene(monkeypatch)
    began = scene.now
    assert scene.run(FIRST - 0.15)
    assert scene.asked == []
    assert scene.run(60.0) is False
    assert scene.asked[0] - began >= FIRST
    pauses = [later - sooner - 0.05 for sooner, later in zip(scene.asked, scene.asked[1:], strict=False)]
    assert len(pauses) == 2
    assert all(pause >= SPARING * 0.05 - 1e-9 for pause in pauses)
    assert scene.bus.reading.acquire(blocking=False)


def test_nodes_that_begin_go_first_for_a_minute_and_one_node_of_a_bus_is_read_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that begins again and again, out of reach of a link, would keep the others' datasheets unread for ever."""
    scene = Scene(monkeypatch)
    scene.bus.beginning.add(b"another")
    began = scene.now
    assert scene.run(PATIENCE)
    assert scene.asked == []
    assert scene.bus.reading.acquire(blocking=False)
    assert scene.run(5.0)
    assert scene.asked == [], "another is being read"
    scene.bus.reading.release()
    assert scene.run(60.0) is False
    assert scene.asked[0] - began >= FIRST + PATIENCE


@pytest.mark.parametrize(
    ("verdict", "mark", "same", "why"),
    [
        ("authentic", "", True, None),
        ("authentic", "unsigned", True, None),
        ("authentic", "", False, "another Security TEDS"),
        ("unsigned", "unsigned", True, None),
        ("unsigned", "unverified", True, None),
        ("unsigned", "unsigned", False, "another Security TEDS"),
        ("unsigned", "", True, "The signature is missing"),
        ("not authentic", "", True, "The signature is missing"),
        ("not authentic", "unsigned", True, "The signature is missing"),
        ("unproven", "unverified", True, "The signature is missing"),
    ],
)
def test_values_count_on_only_by_the_datasheet_that_they_were_calibrated_by(
    monkeypatch: pytest.MonkeyPatch, verdict: str, mark: str, same: bool, why: str | None
) -> None:
    kept: list[tuple[Any, ...]] = []
    results = [("passed", "It is trusted"), ("failed", "The signature is missing"), ("failed", "It is old")]
    checks = [SimpleNamespace(result=result, why=text) for result, text in results if same or result == "passed"]

    def keep(_station: Any, _node: Any, image: Any, *, by: str, floor: Any, c: int) -> Any:
        kept.append((image, by, floor, c))
        return SimpleNamespace(verified=SimpleNamespace(verdict=verdict, checks=checks))

    monkeypatch.setattr(background_reread.readings, "keep", keep)
    monkeypatch.setattr(background_reread, "freshness_floor_of", lambda _station, uuid, proven: (uuid, proven))
    trusted = SimpleNamespace(
        node=SimpleNamespace(proven="proof"),
        sheet=SimpleNamespace(uuid=b"\x8d" * 10),
        fingerprint=hashlib.sha256(b"security" if same else b"another").hexdigest(),
        unsigned=mark == "unsigned",
        unverified=mark == "unverified",
    )
    rest: Any = SimpleNamespace(_station=None, _verified=trusted, _by="ncap", _c=7, _began=1.8e9)
    image: Any = SimpleNamespace(security=b"security")
    if why is None:
        BackgroundReread._conclude(rest, image)
    else:
        with pytest.raises(BadDatasheetError) as ended:
            BackgroundReread._conclude(rest, image)
        assert ended.value.message == (
            f"The datasheet on the node is not the one used for the measurement: {why}. "
            "Values recorded of it since 2027-01-15T08:00:00Z do not count."
        )
    assert kept == [(image, "ncap", (b"\x8d" * 10, "proof"), 7)], "its verdict is that of the whole station"


def test_the_pause_after_an_exchange_begins_when_it_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]

    def steps() -> Iterator[None]:
        now[0] += 0.5
        yield

    monkeypatch.setattr(background_reread, "time", SimpleNamespace(monotonic=lambda: now[0]))
    rest: Any = SimpleNamespace(
        _due=0.0, _bus=SimpleNamespace(beginning=set()), _patient_until=0.0, _mine=True, _steps=steps()
    )
    assert BackgroundReread.step(rest) is True
    assert rest._due == 100.5 + SPARING * 0.5
