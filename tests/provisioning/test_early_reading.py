"""Boards that are read while everyone is still asked: only read, only new ones, and nothing that went wrong counts."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError, NodeSilentError
from teds_provision.links import LINKS, Contact, LinkSettings
from teds_provision.links.ports import ContactSink, NoticeSink
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import batch, early_reading
from teds_provision.provisioning.batch import BatchRun, ProvisionRequest
from teds_provision.provisioning.batch_sheet import BoardResult
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.early_reading import EarlyReading
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.answers import Answers
from tests.bench import Board, MemoryLink, contact
from tests.pace import until
from tests.provisioning.exchanges import asked

TYPE = "limit-switch"
EARLY = 3
"""Exchanges: read 128, prove, list."""


def nothing() -> None:
    """Nothing happens while the last answers are waited for."""


@dataclass
class Bus:
    """A bus of boards in memory; ``meanwhile`` runs when all were shown and others may still answer."""

    contacts: list[Contact]
    meanwhile: Callable[[], object] = nothing
    late: tuple[Contact, ...] = ()
    """These answer after ``meanwhile``."""

    place = "can:test"
    capabilities = LINKS["can"].capabilities

    def find_all_early(self, *, seconds: float, notice: NoticeSink, listen: float, seen: ContactSink) -> list[Contact]:
        for one in self.contacts:
            seen(one)
        self.meanwhile()
        for one in self.late:
            seen(one)
        return [*self.contacts, *self.late]

    def close(self) -> None:
        """Nothing is open."""


def at(address: int, board: Board, **cut: int) -> Contact:
    return replace(contact(board, MemoryLink(board, via="can", **cut)), address=address)  # type: ignore[arg-type]


def boards(count: int) -> list[Board]:
    return [Board(uuid=bytes([number + 1] * 10)) for number in range(count)]


def frames(one: Contact) -> int:
    assert isinstance(one.link, MemoryLink)
    return len(one.link.frames)


@pytest.fixture
def everyone(station: Station, monkeypatch: pytest.MonkeyPatch) -> Callable[[Bus], list[BoardResult]]:
    """Return what provisions all whitelisted boards of a bus."""

    def run(bus: Bus) -> list[BoardResult]:
        for uuid in {one.identity.uuid for one in [*bus.contacts, *bus.late]}:
            station.pins.put(WhitelistEntry(uuid, None, assurance="uuid"))
        monkeypatch.setattr(batch, "open_port", lambda links: bus)
        request = ProvisionRequest(order=BuildOrder(TYPE), whole_bus=True)
        return list(BatchRun(station, LinkSettings("can"), request, SilentReporter()).many(Answers()))

    return run


def test_boards_are_only_read_until_all_have_answered_and_not_read_again(
    station: Station, everyone: Callable[[Bus], list[BoardResult]]
) -> None:
    three = boards(3)
    bus = Bus([at(number + 1, board) for number, board in enumerate(three)])
    before = [board.state for board in three]

    with asked() as words:

        def meanwhile() -> None:
            until(lambda: [frames(one) for one in bus.contacts] == [EARLY] * 3)
            assert sorted(words) == sorted(["read 128", "prove", "list"] * 3)
            assert [board.state for board in three] == before
            assert not any(station.keys.held(board.uuid) or station.nodes.get(board.uuid) for board in three)
            assert not [entry for entry in station.audit_log.entries() if entry.uuid is not None]

        bus.meanwhile = meanwhile
        done = everyone(bus)
    assert [(board.result, board.error) for board in done] == [("passed", None)] * 3
    assert [words.count(word) for word in ("read 128", "prove", "list", "request")] == [3, 3, 3, 3]


def test_an_authentic_board_is_finished_until_it_says_that_it_was_reset(
    everyone: Callable[[Bus], list[BoardResult]],
) -> None:
    (one,) = boards(1)
    assert [done.result for done in everyone(Bus([at(1, one)]))] == ["passed"]
    assert everyone(Bus([at(1, one)])) == []
    one.tim.reset_by_hand()
    assert [done.result for done in everyone(Bus([at(1, one)]))] == ["passed"]


def test_two_boards_of_one_uuid_are_both_left_alone_however_late_the_second_one_answers(
    station: Station, everyone: Callable[[Bus], list[BoardResult]]
) -> None:
    first, other = boards(2)
    second = Board(uuid=first.uuid)
    bus = Bus([at(1, first), at(2, other)], late=(at(3, second),))
    bus.meanwhile = lambda: until(lambda: frames(bus.contacts[0]) == EARLY)
    with pytest.raises(AddressConflictError, match=f"{first.uuid.hex()} answers at 0x01 and at 0x03"):
        everyone(bus)
    assert not station.keys.held(first.uuid)
    assert (first.state.key, second.state.key) == (None, None)
    assert station.keys.held(other.uuid), "the others are provisioned all the same"


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_what_went_wrong_early_is_asked_again(everyone: Callable[[Bus], list[BoardResult]], lost: int) -> None:
    """One of the three exchanges is lost: the board is provisioned as if nobody had asked."""
    [board] = boards(1)
    one = at(1, board, lose_reply=lost)
    one.link.via = "nfc"  # a silent node is not asked again there
    bus = Bus([one])
    bus.meanwhile = lambda: until(lambda: frames(one) >= lost)
    with asked() as words:
        [done] = everyone(bus)
    assert done.result == "passed"
    assert words.count("read 128") == 2


def test_what_was_answered_counts_once_for_a_minute_and_for_this_very_contact(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    [board] = boards(1)
    one = at(1, board)

    def reading() -> EarlyReading:
        made = EarlyReading(at_once=1)
        made.add(one)
        return made

    early = reading()
    found = early.answers_of(one)
    assert found is not None
    assert found.key.point == board.key.point
    assert early.answers_of(one) is None, "once"
    assert reading().answers_of(replace(one, address=2)) is None
    assert reading().answers_of(replace(one, identity=replace(one.identity, state=NodeState.KEYED))) is None
    monkeypatch.setattr(early_reading, "_FRESH_SECONDS", 0.0)
    assert reading().answers_of(one) is None, "too long ago"


def test_at_most_so_many_boards_are_read_at_once_and_none_waits_for_one_that_is_not_begun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    contacts = [at(number + 1, board) for number, board in enumerate(boards(4))]
    begun: list[Contact] = []
    goes_on = threading.Semaphore(0)

    def ask(one: Contact) -> Any:
        begun.append(one)
        goes_on.acquire()
        return one.address

    def at_work() -> list[str]:
        return [thread.name for thread in threading.enumerate() if thread.name.startswith("early ")]

    monkeypatch.setattr(early_reading, "_ask", ask)
    early = EarlyReading(at_once=1)
    for one in contacts:
        early.add(one)
    assert at_work() == [f"early {contacts[0].identity.uuid.hex()}"]
    goes_on.release()
    until(lambda: begun == contacts[:2])
    early.stop()
    found: list[Any] = []
    waits = threading.Thread(target=lambda: found.extend(map(early.answers_of, contacts[2:])), daemon=True)
    waits.start()
    until(lambda: not waits.is_alive())
    goes_on.release()
    found += map(early.answers_of, contacts[:2])
    assert found == [None, None, 1, 2]
    assert begun == contacts[:2]
    until(lambda: at_work() == [])


def test_a_board_that_has_a_key_is_not_read_early_nor_one_after_the_end() -> None:
    first, second = boards(2)
    keyed, late = at(1, first), at(2, second)
    early = EarlyReading(at_once=2)
    early.add(replace(keyed, identity=replace(keyed.identity, state=NodeState.KEYED)))
    early.stop()
    early.add(late)
    assert early.answers_of(keyed) is None
    assert early.answers_of(late) is None
    assert (frames(keyed), frames(late)) == (0, 0)


def test_a_board_that_fails_early_ends_no_reading_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (at(number + 1, board) for number, board in enumerate(boards(2)))
    begun: list[Contact] = []
    goes_on = threading.Event()

    def ask(one: Contact) -> Any:
        begun.append(one)
        if one is first:
            goes_on.wait()
            raise NodeSilentError("It is silent.")
        return "answers"

    monkeypatch.setattr(early_reading, "_ask", ask)
    early = EarlyReading(at_once=1)
    early.add(first)
    early.add(second)
    goes_on.set()
    until(lambda: begun == [first, second])
    assert [early.answers_of(one) for one in (first, second)] == [None, "answers"]
