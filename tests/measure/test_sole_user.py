"""Who measures under a source address of a bus: held for the time of it, and another machine there is looked for."""

from __future__ import annotations

from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import StoreLockedError
from teds_provision.measure import sources
from teds_provision.measure.sources import own_source_address, sole_user
from teds_provision.station.store.lock import UsageLockTakenError


@pytest.mark.parametrize(
    ("free", "left_behind", "course"),
    [
        (0xF1, False, ["another is looked for"]),
        (0xF1, True, []),
        (0xF3, False, ["source 0xf3", "another is looked for"]),
        (0xF3, True, ["source 0xf3"]),
    ],
)
def test_another_machine_is_looked_for_unless_a_process_of_this_one_was_killed_just_now(
    free: int, left_behind: bool, course: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its nodes send on to this address until their lease ends: the same command at once must not meet itself."""
    done: list[str] = []
    held: list[tuple[bool, str]] = []

    def enter(stack: ExitStack, _station: Any, bus: Any, command: str, *, shared: bool) -> tuple[Any, int]:
        held.append((shared, command))
        stack.callback(lambda: done.append("given back"))
        return SimpleNamespace(left_behind=left_behind), free

    monkeypatch.setattr(sources, "_enter", enter)
    port: Any = SimpleNamespace(
        shared_bus=SimpleNamespace(source=0xF1),
        use_source=lambda source: done.append(f"source {source:#x}"),
        require_sole_source=lambda: done.append("another is looked for"),
    )
    over_the_air: Any = SimpleNamespace(shared_bus=None)
    none: Any = None
    with sole_user(none, [over_the_air, port], "measure"):
        assert done == course
        assert held == [(False, "measure")]
    assert done == [*course, "given back"]


BUS: dict[str, Any] = {"wire": "can0", "text": "can:socketcan:can0", "source": 0xF1, "sources": (0xF1, 0xF2)}


class Mark:
    """The mark of one source address."""

    def __init__(self, marks: Marks, source: int) -> None:
        self.marks, self.source = marks, source

    def __enter__(self) -> Mark:
        if self.source in self.marks.held:
            raise UsageLockTakenError("taken", f"process {self.source:#x}")
        return self

    def __exit__(self, *_why: object) -> None:
        self.marks.given_back.append(self.source)

    def share(self) -> None:
        self.marks.shared.append(self.source)


class Marks:
    """The marks of a station: source addresses that another process holds; what was asked for, shared, given back."""

    def __init__(self, *held: int) -> None:
        self.held, self.asked, self.shared, self.given_back = held, list[Any](), list[int](), list[int]()

    def source(self, wire: str, source: int, *, command: str, shared: bool) -> Mark:
        self.asked.append((wire, source, command, shared))
        return Mark(self, source)


@pytest.mark.parametrize(
    ("held", "named", "source", "message", "hint"),
    [
        ((), False, 0xF1, "", ""),
        ((0xF1,), False, 0xF2, "", ""),
        ((0xF1, 0xF2), False, 0, "Every source address on can:socketcan:can0 is in use, 0xF1 by process 0xf1.",
         "Stop one of those processes."),
        ((0xF1, 0xF2), True, 0, "Source address 0xF1 on can:socketcan:can0 is in use by process 0xf1.",
         "Add source=0xF2 to --can, omit source=, or stop that process."),
    ],
)  # fmt: skip
@pytest.mark.parametrize("shared", [True, False])
def test_a_short_session_has_the_next_free_source_address_and_says_who_has_them_all(
    held: tuple[int, ...], named: bool, source: int, message: str, hint: str, shared: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    marks = Marks(*held)
    station: Any = SimpleNamespace(measurements=marks)
    bus = SimpleNamespace(**BUS, source_named=named)
    monkeypatch.setattr(sources, "shared_bus", lambda place: bus if place == "can" else None)
    monkeypatch.setattr(sources, "with_source", lambda place, number: f"{place}&source={number:#x}")
    links: Any = SimpleNamespace(places=("nfc", "can"), at_places=list)
    if message:
        with pytest.raises(StoreLockedError) as refused, own_source_address(station, links, "read", shared=shared):
            raise AssertionError("it has no address")
        assert (refused.value.message, refused.value.hint) == (message, hint)
        assert isinstance(refused.value.__cause__, UsageLockTakenError)
        return
    with own_source_address(station, links, "read", shared=shared) as own:
        assert own == [f"can&source={source:#x}"]
        assert marks.given_back == []
    assert marks.given_back == [source]
    assert marks.asked == [("can0", number, "read", shared) for number in (0xF1, 0xF2)[: 1 + len(held)]]
    assert marks.shared == ([] if shared else [source]), "a command's own sessions do not count as others"


def test_another_address_is_proposed_than_the_one_that_is_taken() -> None:
    bus: Any = SimpleNamespace(**{**BUS, "source": 0xF4, "sources": (0xF4,)}, source_named=True)
    station: Any = SimpleNamespace(measurements=Marks(0xF4))
    with pytest.raises(StoreLockedError) as refused, ExitStack() as stack:
        sources._enter(stack, station, bus, "read", shared=True)
    assert refused.value.hint == "Add source=0xF1 to --can, omit source=, or stop that process."


def test_over_a_reader_there_is_no_source_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "shared_bus", lambda _place: None)
    links: Any = SimpleNamespace(places=("nfc",))
    none: Any = None
    with own_source_address(none, links, "read") as own:
        assert own is links
