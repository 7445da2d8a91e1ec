"""The suites of the reference's protocol room, with the node in C on the desk."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from _pytest.fixtures import FixtureFunctionDefinition

from tests.firmware.desk import CDesk
from tests.protocol import test_sessions, test_tim_agreement, test_tim_flash, test_tim_states

MODULES = (test_tim_states, test_tim_agreement, test_tim_flash, test_sessions)
INSIDE = "reaches into the objects of the Python node"
ELSEWHERE = "test_power_cuts.py does it at every step of flash"
LEFT_OUT = {
    "test_a_node_without_can_has_no_address_and_does_not_know_128_10": "frames.c builds that board",
    "test_a_chip_that_does_not_work_gets_11_and_nothing_has_happened": INSIDE,
    "test_another_station_of_the_same_owner_may_rekey": "asks for P(station) and P(CA), which a node does not say",
    "test_power_cut_in_confirm_leaves_all_old_or_all_new": ELSEWHERE,
    "test_power_cut_in_the_commit_leaves_all_old_or_all_new": ELSEWHERE,
    "test_the_station_refuses_a_key_that_is_not_signed_for_this_uuid_in_the_agreement_itself": INSIDE,
    "test_the_identity_key_of_a_node_only_signs": "the port of PSA holds this: such a key cannot agree",
    "test_a_write_that_is_refused_makes_nothing_give_way": INSIDE,
    "test_a_node_takes_no_teds_that_its_list_could_not_name": INSIDE,
    "test_a_write_of_too_much_gets_17_while_another_session_has_staged_and_10_then": "needs a node built for its size",
    "test_the_chip_of_the_node_checks_both_signatures_of_every_commit": INSIDE,
    "test_the_counter_runs_over_without_harm": INSIDE,
    "test_a_stranger_costs_no_point_arithmetic": INSIDE,
    "test_both_sides_have_one_key_for_data_messages_and_it_is_new_with_each_open": INSIDE,
}
"""Tests that ask what a node in C cannot be asked, and why."""

pytestmark = pytest.mark.system

for _module in MODULES:
    for _name, _test in vars(_module).items():
        if isinstance(_test, FixtureFunctionDefinition):
            globals()[_name] = _test
        elif _name.startswith("test_") and callable(_test) and _name not in LEFT_OUT:
            globals()[f"{_name}_in_c"] = _test


class LargeDesk(CDesk):
    """Of the size that the suites are written for."""

    def __init__(self, max_message: int = 2048, **more: object) -> None:
        super().__init__(max_message=max_message, max_teds=16384, **more)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def in_c(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every desk has the node in C on it."""
    for module in MODULES:
        monkeypatch.setattr(module, "Desk", LargeDesk)
    yield
    CDesk.close_all()
