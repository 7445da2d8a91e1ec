"""The child of the ROS 1 sink and its master: what it waits for and what ends it, in this process."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from teds_provision.measure.sinks.ros import ros1_child


def test_a_child_that_waits_for_a_master_ends_with_its_parent(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its stdin, which a killed parent closes, is not read yet."""

    def end(code: int) -> None:
        raise SystemExit(code)

    def answers() -> Iterator[bool]:
        yield from [False] * 3
        raise AssertionError("it waits on")

    parents, online = iter([7, 7, 7, 1]), answers()
    monkeypatch.setattr(ros1_child, "WATCH", 0.0)
    monkeypatch.setattr(ros1_child.os, "getppid", lambda: next(parents))
    monkeypatch.setattr(ros1_child.os, "_exit", end)
    with pytest.raises(SystemExit) as ended:
        ros1_child.wait_for_master(SimpleNamespace(is_master_online=lambda: next(online)))
    assert ended.value.code == 0
    assert capsys.readouterr().out.count('"event": "waiting"') == 1


@pytest.mark.parametrize(
    ("answers", "looks"),
    [
        ([True, OSError(), True, "", True, OSError(), OSError()], 7),
        ([True, "", OSError()], 3),
        (["", ""], 2),
    ],
    ids=["two in a row", "gone after it forgot", "another master"],
)
def test_a_master_that_knows_the_node_at_every_second_look_is_not_gone(
    answers: list[bool | str | OSError], looks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One answer that is late would end the child, and with it the topics of a measurement."""
    asked: list[str] = []

    def look_up(name: str) -> bool | str:
        asked.append(name)
        answer = [*answers, OSError()][len(asked) - 1]
        if isinstance(answer, OSError):
            raise answer
        return answer

    def end(code: int) -> None:
        raise SystemExit(code)

    monkeypatch.setattr(ros1_child, "WATCH", 0.0)
    monkeypatch.setattr(ros1_child.os, "_exit", end)
    with pytest.raises(SystemExit) as ended:
        ros1_child.watch_master(SimpleNamespace(Master=lambda _name: SimpleNamespace(lookupNode=look_up)), "/arm")
    assert ended.value.code == 3
    assert asked == ["/arm"] * looks
