"""Who measures under a source address of a bus: held for the time of it, and another machine there is looked for."""

from __future__ import annotations

from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.measure import sources
from teds_provision.measure.sources import sole_user


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
