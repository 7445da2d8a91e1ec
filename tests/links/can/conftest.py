from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.links.can.hub import Hub
from tests.places import free_bus


@pytest.fixture
def group() -> str:
    """Return a multicast bus of this test's own, which no frame leaves."""
    return free_bus()


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub()
    yield hub
    hub.close()


@pytest.fixture
def nodes() -> Iterator[Callable[..., None]]:
    """Start nodes in another process and wait until they listen."""
    running: list[subprocess.Popen[str]] = []

    def start(spec: str, *addresses: int, **plan: object) -> None:
        arguments = json.dumps({"spec": spec, "addresses": addresses, **plan})
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.links.can.echo_node", arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[3],
        )
        running.append(process)
        assert process.stdout
        assert process.stdout.readline() == "ready\n"

    yield start
    for process in running:
        assert process.stdin
        process.stdin.close()
    for process in running:
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert process.stdout
        process.stdout.close()
