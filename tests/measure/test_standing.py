"""What a person decides of a node while it is measured: seen at the next look, whichever process wrote it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from teds_provision.errors import PolicyRefused
from teds_provision.measure.trusting import NodeStanding
from teds_provision.station.station import Station
from teds_provision.store import RevocationRecord
from tests.bench import PASSPHRASE
from tests.handover.desk import Pair


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    made = Pair.make(tmp_path)
    yield made
    made.close()


@pytest.fixture
def measuring(pair: Pair) -> Iterator[Station]:
    """The process that measures, beside the command that changes the store."""
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
    ("decide", "why"), [(moved, "was moved to station"), (forgotten, "no longer held here"), (revoked, "lost")]
)
def test_a_node_that_was_moved_forgotten_or_revoked_is_measured_no_more(
    pair: Pair, measuring: Station, decide: Callable[[Pair], None], why: str
) -> None:
    standing = NodeStanding(measuring, pair.board.uuid)
    standing.require()
    decide(pair)
    with pytest.raises(PolicyRefused, match=why):
        standing.require()


def test_a_copy_and_another_nodes_ban_end_no_measurement(pair: Pair, measuring: Station) -> None:
    standing = NodeStanding(measuring, pair.board.uuid)
    copied(pair)
    pair.north.policy.deny(RevocationRecord(bytes(10), None, "lost", "a statement"))
    standing.require()


def test_off_the_whitelist_a_node_is_measured_on_and_not_moved(pair: Pair, measuring: Station) -> None:
    standing = NodeStanding(measuring, pair.board.uuid)
    unlisted(pair)
    standing.require()
    driven = NodeStanding(measuring, pair.board.uuid)
    driven.drives = True
    pair.north.nodes.remember(pair.board.uuid, name="another")  # any change of the store is looked at
    with pytest.raises(PolicyRefused, match="actuators are not moved"):
        driven.require()
