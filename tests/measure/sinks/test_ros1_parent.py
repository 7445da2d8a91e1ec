"""The child of the ROS 1 sink while it waits for a master: what ends it, asked of it in this process."""

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
