"""A ROS 2 domain of a test's own, with the real rclpy of PyPI in an environment of its own (``make test-rclpy``)."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest

from teds_provision.measure.sinks.ros import sourced
from tests.cli.shell import unmeasured_environment
from tests.pace import until
from tests.places import ros_domain

PYTHON = Path(os.environ.get("RCLPY_PYTHON", Path(__file__).parents[3] / ".venv-rclpy" / "bin" / "python3"))
PEER = Path(__file__).with_name("rclpy_peer.py")
T = TypeVar("T")

needs_rclpy = [
    pytest.mark.rclpy,
    pytest.mark.skipif(not PYTHON.exists(), reason="make test-rclpy makes .venv-rclpy"),
]


class Peer:
    """Another node of the domain: rclpy in a process of its own."""

    def __init__(self, domain: int, name: str = "peer", **more: str) -> None:
        around = {**unmeasured_environment(), "ROS_DOMAIN_ID": str(domain), **more}
        around = {key: value for key, value in around.items() if key not in ("AMENT_PREFIX_PATH", "PYTHONPATH")}
        self.process = subprocess.Popen(
            [PYTHON, "-s", PEER, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=around
        )
        self.lines: list[dict[str, Any]] = []
        threading.Thread(target=self._read, daemon=True).start()
        until(lambda: self.of("ready"))

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(json.loads(line))

    def send(self, **words: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()

    def of(self, event: str) -> list[dict[str, Any]]:
        return [line for line in list(self.lines) if line["event"] == event]

    def hear(self, topic: str, kind: str, *, latched: bool = False, reliable: bool = True) -> None:
        self.send(op="hear", topic=topic, type=kind, latched=latched, reliable=reliable)

    def heard(self, topic: str) -> list[Any]:
        return [entry["message"] for entry in self.of("message") if entry["topic"] == topic]

    def graph(self, ready: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the graph as this node sees it, as soon as it is so."""
        found: dict[str, Any] = {}

        def look() -> bool:
            before = len(self.of("graph"))
            self.send(op="graph")
            until(lambda: len(self.of("graph")) > before)
            found.update(self.of("graph")[-1])
            return ready(found)

        until(look)
        return found

    def close(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(30)


@dataclass
class Domain:
    """A domain, and the peers that a test began in it."""

    number: int
    peers: list[Peer]

    def peer(self, name: str = "peer", **more: str) -> Peer:
        self.peers.append(Peer(self.number, name, **more))
        return self.peers[-1]


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Yield a domain in which our own sinks take the rclpy of PyPI, too."""
    for name in ("AMENT_PREFIX_PATH", "CYCLONEDDS_URI", "ROS_DISTRO", *sourced._REACH):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(sourced.CHOSEN, str(PYTHON))
    with ros_domain() as number:
        here = Domain(number, [])
        yield here
        for peer in here.peers:
            peer.close()
