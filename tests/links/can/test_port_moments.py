"""Whom a station asks on a bus, when, and what it makes of the answers (wire.md, "CAN"). Bus and clock are mocks."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError, LinkError, NoNodeError
from teds_provision.links.can import identify_broadcast
from teds_provision.links.can import port as of_port
from teds_provision.links.can.identify_broadcast import FunctionalAnswers
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import Contact, Notice
from teds_provision.protocol.messages.identity import Identity, NodeState


def who(number: int) -> Identity:
    return Identity(bytes([number] * 10), NodeState.KEYED, 1, 2, 1024, number)


class MockPort(CanPort):
    """A port whose questions to everyone bring what is listed, the last for ever, and ``there`` is at each address."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, where: str = "virtual:mock") -> None:
        self.spec, self.place, self.trace = parse_spec(where), "can:mock", None
        self.now = 100.0
        self.answers: list[FunctionalAnswers] = [FunctionalAnswers()]
        self.asked: list[tuple[float, float, float]] = []  # when, silence, longest
        self.there: dict[int, Identity | Exception] = {}
        self.asked_alone: list[tuple[float, int, float | None]] = []
        self.notices: list[tuple[str, str]] = []
        self.rivals = False
        self._rival_reported = False
        self._transactions = itertools.count()
        clock = SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep)
        monkeypatch.setattr(of_port, "time", clock)
        monkeypatch.setattr(identify_broadcast, "time", clock)
        monkeypatch.setattr(of_port, "ask_all", self._ask_all)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def bus(self) -> Any:
        conflicts = SimpleNamespace(seen_within=lambda: self.rivals, text="A rival.", hint="Another source.")
        return SimpleNamespace(conflicts=conflicts, presses=SimpleNamespace(marks=lambda address, crc: False))

    def next_transaction(self) -> int:
        return next(self._transactions)

    def identify(self, node: int, *, seconds: float | None = None, **_: object) -> Identity | None:  # type: ignore[override]
        self.asked_alone.append((round(self.now - 100, 2), node, seconds))
        found = self.there.get(node)
        if isinstance(found, Exception):
            raise found
        return found

    def _ask_all(self, bus: object, transaction: int, *, silence: float, longest: float) -> Iterator[Any]:
        self.asked.append((round(self.now - 100, 2), round(silence, 2), round(longest, 2)))
        found = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        for address, identity in found.identities.items():
            self.now += 0.01
            yield address, identity
        self.now += min(silence, longest)
        yield found

    def note(self, notice: Notice) -> None:
        self.notices.append((notice.kind, notice.text))

    def seeks(self, number: int, seconds: float = 3.0, address: int | None = None) -> int | None:
        """Seek the node of this number; return the address at which it was found."""
        return self.find(
            lambda identity: identity.uuid == who(number).uuid, seconds=seconds, notice=self.note, address=address
        ).address

    def lists(self, seconds: float = 5.0, listen: float = 0.0) -> tuple[list[int | None], list[int | None]]:
        """List everyone; return the addresses that were shown early, and those of the result."""
        shown: list[Contact] = []
        found = self.find_all_early(seconds=seconds, notice=self.note, listen=listen, seen=shown.append)
        return [contact.address for contact in shown], [contact.address for contact in found]

    def kinds(self) -> list[str]:
        return [kind for kind, _ in self.notices if kind != "waiting"]


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> MockPort:
    return MockPort(monkeypatch)


def answers(*numbers: int) -> FunctionalAnswers:
    return FunctionalAnswers({number: who(number) for number in numbers})


# -- one node ----------------------------------------------------------------------------------------------------------


def test_a_node_is_asked_first_where_it_was_and_everyone_if_it_is_not_there(port: MockPort) -> None:
    port.there = {5: who(5)}
    assert port.seeks(5, address=5) == 5
    assert (port.asked_alone, port.asked) == ([(0.0, 5, 0.1)], [])
    port.answers = [answers(5, 6)]
    for address, asked in ((5, 1), (9, 1), (0, 0), (240, 0), (None, 0), (1, 1), (239, 1)):
        port.asked_alone.clear()
        port.asked.clear()
        port._transactions = itertools.count()
        assert port.seeks(6, address=address) == 6
        assert (len(port.asked_alone), len(port.asked)) == (asked, 1), address


def test_the_first_answer_of_the_wanted_node_ends_the_search(port: MockPort) -> None:
    port.answers = [answers(5, 6, 7)]
    assert port.seeks(6) == 6
    assert port.now == pytest.approx(100.02)


def test_everyone_is_asked_once_a_second_and_others_are_named_once(port: MockPort) -> None:
    port.answers = [answers(7), FunctionalAnswers(), answers(7, 8)]
    with pytest.raises(NoNodeError) as failure:
        port.seeks(6, 3.0)
    assert port.asked == [(0.0, 0.3, 3.0), (1.0, 0.3, 2.0), (2.0, 0.3, 1.0)]
    assert port.kinds() == ["foreign-tag", "foreign-tag"]
    assert who(7).uuid.hex() in port.notices[1][1]
    assert "0x08" in port.notices[2][1]
    assert failure.value.message == (
        f"The node did not answer on virtual:mock within 3 s; others did: {who(7).uuid.hex()}, {who(8).uuid.hex()}."
    )


def test_with_an_address_in_the_option_that_one_alone_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    port = MockPort(monkeypatch, "virtual:mock?node=0x21")
    port.there = {0x21: who(9), 5: who(5)}
    with pytest.raises(NoNodeError, match=f"at 0x21 on .* within 2 s; others did: {who(9).uuid.hex()}"):
        port.seeks(5, 2.0, address=5)
    assert port.asked_alone == [(0.0, 0x21, None), (1.0, 0x21, None)]
    assert port.asked == []
    assert port.kinds() == ["foreign-tag"]
    assert port.seeks(9) == 0x21
    assert port.lists() == ([], [0x21])


def test_a_node_beside_a_conflict_is_found_and_one_that_is_not_is_not_guessed(port: MockPort) -> None:
    torn = FunctionalAnswers({6: who(6)}, {7}, set(), {7})
    port.there = {7: AddressConflictError("Two.")}
    port.answers = [FunctionalAnswers({}, {7}, set(), {7}), torn]
    assert port.seeks(6) == 6, "by the second question, which the conflict needs"
    assert port.kinds() == ["conflict"]
    with pytest.raises(AddressConflictError, match="0x07"):
        port.seeks(5)
    assert port.kinds()[-2:] == ["conflict", "foreign-tag"]


def test_what_began_and_did_not_end_is_asked_alone(port: MockPort) -> None:
    port.answers = [FunctionalAnswers({}, set(), {7})]
    port.there = {7: who(7)}
    assert port.seeks(7) == 7
    assert [node for _, node, _ in port.asked_alone] == [7]


# -- everyone ----------------------------------------------------------------------------------------------------------


def test_everyone_is_listened_for_at_least_as_long_as_asked_and_shown_once(port: MockPort) -> None:
    port.answers = [answers(5), answers(6)]
    assert port.lists(5.0, listen=3.0) == ([5, 6], [5, 6])
    assert port.asked[0] == (0.0, 1.5, 3.0)
    assert [round(silence, 1) for _, silence, _ in port.asked] == [1.5, 1.5]
    assert 3.0 <= port.now - 100 < 3.5
    assert port.notices == [("waiting", "Asking every node on virtual:mock.")]


def test_without_a_time_the_first_answers_are_enough(port: MockPort) -> None:
    port.answers = [FunctionalAnswers(), FunctionalAnswers(), answers(6, 5)]
    assert port.lists(5.0) == ([6, 5], [5, 6])
    assert [silence for _, silence, _ in port.asked] == [0.3, 0.3, 0.3]
    assert port.asked[-1][2] == 3.0


@pytest.mark.parametrize("seconds", [0.5, 2.0])
def test_where_nobody_answers_it_is_said_after_the_time(port: MockPort, seconds: float) -> None:
    with pytest.raises(NoNodeError, match=f"No node answered on virtual:mock within {seconds:g} s"):
        port.lists(seconds, listen=3.0)
    assert seconds <= port.now - 100 < seconds + 1.6
    assert all(longest <= seconds for _, _, longest in port.asked)


@pytest.mark.parametrize(
    ("rounds", "questions"),
    [
        ([answers(*range(1, 8))], 1),  # seven are not many
        ([answers(*range(1, 9)), answers(*range(1, 9))], 2),
        ([answers(*range(1, 9)), answers(*range(1, 10)), answers(*range(1, 11)), answers(*range(1, 12))], 3),
        ([answers(*range(1, 9)), answers(9), answers(9)], 3),
    ],
)
def test_eight_nodes_or_more_are_asked_again_until_no_new_one_answers_three_times_at_most(
    port: MockPort, rounds: list[FunctionalAnswers], questions: int
) -> None:
    port.answers = [*rounds]
    _, found = port.lists(5.0)
    assert len(port.asked) == questions
    assert found == sorted({node for one in rounds[:questions] for node in one.identities})
    assert {silence for _, silence, _ in port.asked[1:]} <= {0.3}


def test_of_many_the_rounds_after_the_first_need_no_patience(port: MockPort) -> None:
    port.answers = [answers(*range(1, 9))]
    port.lists(5.0, listen=1.6)
    assert [silence for _, silence, _ in port.asked] == [1.5, 0.3]


def test_another_station_at_our_address_is_named_once(port: MockPort) -> None:
    port.rivals, port.answers = True, [FunctionalAnswers(), answers(5)]
    assert port.seeks(5) == 5
    port.answers = [FunctionalAnswers(), answers(5)]
    assert port.seeks(5) == 5
    assert port.kinds() == ["conflict"]


def test_what_is_unclear_is_named_once_and_a_conflict_ends_the_list(port: MockPort) -> None:
    port.answers = [FunctionalAnswers({5: who(5), 6: who(5)}, set(), {7})]
    port.rivals = True
    assert port.lists(5.0, listen=3.0)[1] == [5, 6]
    assert len(port.asked) > 1
    assert port.notices[1:] == [
        ("unfinished", "The answer of 0x07 was incomplete; try again."),
        ("conflict", f"Node {who(5).uuid.hex()} answers at 0x05 and 0x06: one of them is an impostor."),
        ("conflict", "A rival. Another source."),
    ]
    port.answers = [FunctionalAnswers({5: who(5)}, {9, 8}, set(), {8, 9})]
    port.there = {8: AddressConflictError("Two."), 9: AddressConflictError("Two.")}
    with pytest.raises(AddressConflictError, match="0x08"):
        port.lists()


def test_a_conflict_that_is_not_seen_again_is_none(port: MockPort) -> None:
    """A late reply to another station looks like a second node, and comes only once."""
    port.answers = [FunctionalAnswers({}, {7}), answers(7)]
    assert port.lists() == ([], [7])
    assert len(port.asked) == 2
    assert port.kinds() == []


def test_a_watched_bus_that_is_lost_is_named_once_listened_to_anew_and_said_to_be_back(
    port: MockPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, course = LinkError("It is gone."), list[Any]()
    rounds: list[Any] = [[(5, who(5))], gone, gone, [], [(6, who(6))], gone, [(7, who(7))], []]

    class MockArrivals:
        def __init__(self, watched: object, _notice: object) -> None:
            assert watched is port

        def round(self, _stop: object) -> Iterator[Any]:
            step = rounds.pop(0)
            if isinstance(step, LinkError):
                raise step
            yield from step

        def lost(self) -> None:
            course.append("lost")

        def pause(self, _stop: object) -> None:
            course.append("pause")

        def pressed(self) -> list[bytes]:
            return [who(8).uuid] if len(rounds) == 4 else []

    def wait(seconds: float) -> None:
        course.append(seconds)

    stop: Any = SimpleNamespace(is_set=lambda: not rounds, wait=wait)
    monkeypatch.setattr(of_port, "Arrivals", MockArrivals)
    for contact in port.watch(stop=stop, notice=port.note):
        course.append(contact.address)
    assert course == [5, "pause", "lost", 1.0, "lost", 1.0, "pause", 6, "pause", "lost", 1.0, 7, "pause", "pause"]
    assert port.notices == [
        ("waiting", "Watching virtual:mock for nodes."),
        ("reader-lost", "It is gone. Waiting for it."),
        ("reader-ready", "The bus virtual:mock is back."),
        ("pressed", f"Node {who(8).uuid.hex()} says it was pressed."),
        ("reader-lost", "It is gone. Waiting for it."),
        ("reader-ready", "The bus virtual:mock is back."),
    ]
