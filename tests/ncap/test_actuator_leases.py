"""Who may move an actuator that a request holds, asked of the leases in this process."""

from __future__ import annotations

from typing import Any, cast

import pytest

from teds_provision.measure.blocks import SetPointCommand
from teds_provision.ncap.nodes.actuator_leases import ActuatorLeases, _HeldActuator, _SetPointOrder


class Events:
    """What a page would be told."""

    def __init__(self) -> None:
        self.states: list[str] = []

    def event(self, kind: str, **facts: object) -> None:
        self.states.append(str(facts["state"]))


@pytest.mark.parametrize(
    ("changes", "admitted"), [({}, False), ({"let_go": True}, False), ({"let_go": True, "ended": True}, True)]
)
def test_no_set_point_of_a_topic_moves_an_actuator_until_its_request_has_ended(
    changes: dict[str, bool], admitted: bool
) -> None:
    """One that is let go is on its way to its safe state, by the session that holds it still."""
    events, none = Events(), cast(Any, None)
    leases = ActuatorLeases(none, cast(Any, events), none, none, none, none, none)
    held = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.0, None, 1), **changes)
    leases._held["ab", 1] = held
    for _ in range(2):
        assert leases.admits(SetPointCommand("ab", 1, 0.5, 0.0)) is admitted
    assert events.states == ([] if admitted else ["refused"]), "reported once"
    assert leases.admits(SetPointCommand("ab", 2, 0.5, 0.0))
