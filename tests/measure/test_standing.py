"""What a person decides of a node while it is measured: seen at the next look, whichever process wrote it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDatasheetError, KeyStolenError, PolicyError, TedsProvisionError
from teds_provision.measure import standing as of_standing
from teds_provision.measure.standing import NodeStanding, require_measurable
from teds_provision.measure.verified_session import open_trusted
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord
from tests.bench import PASSPHRASE, MemoryLink, talk
from tests.handover.desk import Pair, provisioned


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    made = Pair.make(tmp_path)
    yield made
    made.close()


@pytest.fixture
def measuring(pair: Pair) -> Iterator[Station]:
    """Yield the process that measures, beside the command that changes the store."""
    other = Station.open(pair.north.home, ask=lambda prompt, confirm: PASSPHRASE)
    yield other
    other.close()


def moved(pair: Pair) -> None:
    pair.export("move")


def forgotten(pair: Pair) -> None:
    pair.north.keys.remove(pair.board.uuid)


def revoked(pair: Pair) -> None:
    pair.north.policy.deny(RevocationRecord(pair.board.uuid, None, "lost", "a statement"))
    pair.north.keys.remove(pair.board.uuid)


def copied(pair: Pair) -> None:
    pair.export("copy")


def unlisted(pair: Pair) -> None:
    pair.north.pins.remove(pair.board.uuid)


@pytest.mark.parametrize(
    ("decide", "code", "why"),
    [
        (moved, 6, "was moved to station"),
        (forgotten, 6, "holds no key"),
        (revoked, 4, "lost"),
        (unlisted, 6, "not on the whitelist"),
    ],
)
def test_a_node_that_was_moved_forgotten_or_revoked_is_measured_no_more(
    pair: Pair, measuring: Station, decide: Callable[[Pair], None], code: int, why: str
) -> None:
    standing = NodeStanding(measuring, pair.board.uuid)
    standing.require()
    decide(pair)
    with pytest.raises(TedsProvisionError, match=why) as refused:
        standing.require()
    assert refused.value.exit_code == code
    assert standing.ended is refused.value
    with pytest.raises(TedsProvisionError, match=why):
        require_measurable(measuring, pair.board.uuid)


def test_a_node_whose_signer_is_trusted_no_more_is_measured_no_more(tmp_path: Path) -> None:
    """Whichever connection wrote it: `trust remove` beside a measurement, or the process that measures."""
    pair = Pair.make(tmp_path)
    provisioned(pair.north, pair.board)
    pair.take(pair.export()[0])
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        open_trusted(pair.south, node, by="measure")
    beside = Station.open(pair.south.home, ask=lambda prompt, confirm: PASSPHRASE)
    standings = [NodeStanding(pair.south, pair.board.uuid), NodeStanding(beside, pair.board.uuid)]
    for standing in standings:
        standing.require()
    assert pair.south.policy.distrust("north")
    pair.south.policy.end_ca(pair.north.ca)
    for standing in standings:
        with pytest.raises(BadDatasheetError, match="not authentic now") as refused:
            standing.require()
        assert "do not count" in refused.value.message
    beside.close()
    pair.close()


def test_a_copy_and_another_nodes_ban_end_no_measurement(pair: Pair, measuring: Station) -> None:
    standing = NodeStanding(measuring, pair.board.uuid)
    copied(pair)
    pair.north.policy.deny(RevocationRecord(bytes(10), None, "lost", "a statement"))
    standing.require()


def test_in_transparent_mode_a_node_off_the_whitelist_is_measured_on_and_not_moved(
    pair: Pair, measuring: Station
) -> None:
    pair.north.measurements.detection = "transparent"
    standing = NodeStanding(measuring, pair.board.uuid)
    unlisted(pair)
    standing.require()
    driven = NodeStanding(measuring, pair.board.uuid)
    driven.drives = True
    pair.north.nodes.remember(pair.board.uuid, name="another")  # any change of the store is looked at
    with pytest.raises(PolicyError, match="actuators are not moved"):
        driven.require()


def test_a_key_that_was_stolen_ends_a_session_that_was_opened_before_and_again_after_it_was_rotated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The session under the key that is known as stolen was opened all the same; each later theft ends one."""
    stolen: list[str | None] = ["out of a backup"]
    station: Any = SimpleNamespace(changes=lambda: len(stolen), keys=SimpleNamespace(stolen=lambda _uuid: stolen[-1]))
    monkeypatch.setattr(of_standing, "require_measurable", lambda _station, _uuid: None)
    monkeypatch.setattr(of_standing, "verdict_of", lambda _station, _uuid: None)
    monkeypatch.setattr(of_standing, "SETTLING", 0.0)
    standing = NodeStanding(station, bytes(10))
    for why, ends in (("out of a backup", False), ("another", True), (None, False), ("out of a backup", True)):
        stolen.append(why)
        with pytest.raises(KeyStolenError) if ends else nullcontext():
            standing.require()
        assert standing.ended is None, "the next session is under a new key"


class Store:
    """A station whose decisions and verdict on one node are the test's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.version, self.verdict, self.listed, self.theft = 1, "authentic", True, ""
        self.looks = 0
        self.now = 100.0
        self.pins = SimpleNamespace(entry=lambda _uuid: object() if self.listed else None)
        self.keys = SimpleNamespace(stolen=lambda _uuid: self.theft or None)
        monkeypatch.setattr(of_standing, "require_measurable", lambda *_words: None)
        monkeypatch.setattr(of_standing, "verdict_of", self.verdict_of)
        monkeypatch.setattr(of_standing, "time", SimpleNamespace(monotonic=lambda: self.now, time=lambda: 1.8e9))

    def changes(self) -> int:
        return self.version

    def verdict_of(self, _station: Any, _uuid: bytes) -> Any:
        self.looks += 1
        checks = [
            SimpleNamespace(result="failed", why="the signer is unknown", name="signer"),
            SimpleNamespace(result="failed", why="", name="sequence"),
            SimpleNamespace(result="passed", why="fine", name="checksums"),
        ]
        return SimpleNamespace(verified=SimpleNamespace(verdict=self.verdict, checks=checks))

    def standing(self) -> NodeStanding:
        station: Any = self
        return NodeStanding(station, bytes(10))

    def decide(self, standing: NodeStanding, **decided: Any) -> None:
        """Change the store, and look a second later."""
        for name, value in decided.items():
            setattr(self, name, value)
        self.version += 1
        self.now += 1.0
        standing.require()


@pytest.mark.parametrize(
    ("verdict", "unsigned", "mark"),
    [
        ("authentic", False, ""),
        ("unproven", False, "its datasheet is unproven: the signer is unknown; sequence"),
        ("unsigned", True, ""),
        ("unsigned", False, None),
        ("not authentic", True, None),
    ],
)
def test_a_datasheet_that_is_worse_today_ends_the_session_or_marks_its_values(
    verdict: str, unsigned: bool, mark: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(monkeypatch)
    standing = store.standing()
    standing.unsigned = unsigned
    if mark is not None:
        store.decide(standing, verdict=verdict)
        assert (standing.mark, standing.ended) == (mark, None)
        store.decide(standing, verdict="authentic")
        assert standing.mark == "", "it is proven again"
        return
    with pytest.raises(BadDatasheetError, match=f"is {verdict} now: the signer is unknown; sequence") as refused:
        store.decide(standing, verdict=verdict)
    assert "Values recorded of it since 2027-01-15T08:00:00Z do not count" in refused.value.message
    assert refused.value.hint == f"See: teds-provision verify {bytes(10).hex()}"
    assert standing.ended is refused.value


def test_a_node_is_looked_at_once_for_each_change_and_twice_a_second_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(monkeypatch)
    standing = store.standing()
    standing.require()
    assert store.looks == 0, "nothing was changed since the session began"
    store.decide(standing)
    standing.require()
    assert store.looks == 1
    for _ in range(8):
        store.version += 1
        store.now += 0.125
        standing.require()
    assert store.looks == 3


def test_only_a_node_that_is_moved_has_to_stay_on_the_whitelist_and_a_known_theft_ends_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    store = Store(monkeypatch)
    store.theft = "seen before"
    standing = store.standing()
    store.decide(standing, listed=False)
    standing.drives = True
    store.decide(standing, listed=True)
    with pytest.raises(PolicyError, match="not on the whitelist, so its actuators are not moved"):
        store.decide(standing, listed=False)
    standing.drives = False
    store.decide(standing, theft="")
    with pytest.raises(KeyStolenError, match="gets a new key: copied"):
        store.decide(standing, theft="copied")
