from __future__ import annotations

import itertools
import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.links.can.hub import Hub

_numbers = itertools.count()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def group() -> str:
    """A multicast bus of this test's own, which no frame leaves."""
    number = os.getpid() * 31 + next(_numbers)
    address = f"239.{1 + number % 200}.{number // 200 % 250}.{1 + number // 50000 % 250}"
    return f"udp_multicast:{address}?port={free_udp_port()}"


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
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert process.stdout
        process.stdout.close()
