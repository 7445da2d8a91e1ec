"""What a station makes of unclear answers to a question to everyone (wire.md, "CAN"): asked again, then named."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from teds_provision.errors import AddressConflictError
from teds_provision.links.can import identify_broadcast
from teds_provision.links.can.identify_broadcast import FunctionalAnswers, ask_unclear_again
from teds_provision.protocol.messages.identity import Identity, NodeState


def who(number: int) -> Identity:
    return Identity(bytes([number] * 10), NodeState.KEYED, 1, 2, 1024, number)


FIRST = FunctionalAnswers({1: who(1), 2: who(2)}, {3, 4, 10}, {5, 6, 2}, {3, 4}, {9})
LATER = FunctionalAnswers({5: who(5), 3: who(3)}, {2, 4}, {7}, {4, 2}, {8})


def test_an_address_that_one_of_two_questions_settled_is_unfinished_no_more() -> None:
    assert FIRST.combined_with(LATER) == FunctionalAnswers(
        {1: who(1), 2: who(2), 3: who(3), 5: who(5)}, {2, 3, 4, 10}, {6, 7}, {2, 3, 4}, {8, 9}
    )


def test_a_conflict_stays_only_if_it_is_seen_again_and_is_sure_by_two_beginnings_in_both() -> None:
    """What only the first question left unclear, and the second one did not settle, is unfinished."""
    assert FIRST.cleared_by(LATER) == FunctionalAnswers(
        {1: who(1), 3: who(3), 5: who(5)}, {2, 4}, {6, 7, 10}, {2, 4}, {4}
    )


def test_each_uuid_at_more_than_one_address_is_named_with_all_of_them() -> None:
    found = FunctionalAnswers({0x23: who(1), 0x21: who(1), 0x22: who(2), 0x25: who(3), 0x24: who(3)})
    assert found.duplicates == {bytes([1] * 10): [0x21, 0x23], bytes([3] * 10): [0x24, 0x25]}


@pytest.mark.parametrize("in_time", [True, False])
def test_each_unclear_address_is_asked_alone_unless_it_is_sure_or_time_is_up(
    in_time: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two boards collide again, a lost frame does not: 1 answers, 2 collides, 3 and 5 are silent, 4 is sure."""
    monkeypatch.setattr(identify_broadcast, "time", SimpleNamespace(monotonic=lambda: 99.9 if in_time else 100.0))
    asked = list[int]()

    def ask(address: int) -> Identity | None:
        asked.append(address)
        if address == 2:
            raise AddressConflictError("Two.")
        return who(address) if address in (1, 6) else None

    found = FunctionalAnswers({4: who(4), 7: who(7), 2: who(2)}, {1, 2, 3, 4}, {5, 6}, set(), {4})
    settled = ask_unclear_again(found, ask, until=100.0)
    if in_time:
        assert asked == [1, 2, 3, 5, 6]
        assert settled == FunctionalAnswers({1: who(1), 6: who(6), 7: who(7)}, {2, 3, 4}, {5})
    else:
        assert asked == []
        assert settled == FunctionalAnswers({2: who(2), 7: who(7)}, {1, 2, 3, 4}, {5, 6})
    assert found.identities == {4: who(4), 7: who(7), 2: who(2)}, "what was found first is not changed"
