"""Attackers without a key on the bus of good nodes: nobody is hidden, nothing hangs (their cases: attackers.py)."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig
from tests.strangers.attackers import Attacker, copy_cat, silent_strangers
from tests.strangers.wire import of_spec

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("attacked"), {"a": ANGLE, "g": "gripper"})
    for node in made.nodes.values():
        node.start(can=made.desk.links.can)
    yield made
    made.close()


def identified(rig: Rig) -> list[str]:
    can = rig.desk.links.can
    outcome = rig.station.start("--json", "identify", "--via", "can", "--can", can).end(120)
    assert outcome.code == 0, outcome
    return [node["uuid"] for node in outcome.json.get("nodes", [outcome.json])]


def test_a_node_that_answers_nothing_but_identify_hides_no_other(rig: Rig) -> None:
    with Attacker(*of_spec(rig.desk.links.can), silent_strangers(range(1, 2))):
        assert set(identified(rig)) == {placed.uuid for placed in rig.nodes.values()}


def test_a_copied_uuid_hides_no_other_node(rig: Rig) -> None:
    copied = bytes.fromhex(rig.nodes["a"].uuid)
    with Attacker(*of_spec(rig.desk.links.can), copy_cat(0xEF, copied)):
        assert identified(rig) == [rig.nodes["g"].uuid]
