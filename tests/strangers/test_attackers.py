"""Attackers without a key on the bus of good nodes: nobody is hidden, nothing hangs (their cases: attackers.py)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.desk import ANGLE
from tests.measure.hall import Hall
from tests.strangers.attackers import Attacker, copy_cat, silent_strangers
from tests.strangers.wire import of_spec

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    made = Hall(tmp_path_factory.mktemp("attacked"), {"a": ANGLE, "g": "gripper"})
    for node in made.nodes.values():
        node.start(can=made.desk.links.can)
    yield made
    made.close()


def identified(hall: Hall) -> list[str]:
    can = hall.desk.links.can
    outcome = hall.station.start("--json", "identify", "--via", "can", "--can", can).end(120)
    assert outcome.code == 0, outcome
    return [node["uuid"] for node in outcome.json.get("nodes", [outcome.json])]


def test_a_node_that_answers_nothing_but_identify_hides_no_other(hall: Hall) -> None:
    with Attacker(*of_spec(hall.desk.links.can), silent_strangers(range(1, 2))):
        assert set(identified(hall)) == {placed.uuid for placed in hall.nodes.values()}


def test_a_copied_uuid_hides_no_other_node(hall: Hall) -> None:
    copied = bytes.fromhex(hall.nodes["a"].uuid)
    with Attacker(*of_spec(hall.desk.links.can), copy_cat(0xEF, copied)):
        assert identified(hall) == [hall.nodes["g"].uuid]
