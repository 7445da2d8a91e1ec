"""Ports of a test's own: no two tests get the same one, in whatever processes they run."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

from tests import places
from tests.zygote import ROOT

UDP, TCP = socket.SOCK_DGRAM, socket.SOCK_STREAM
CODE = """
import socket
from tests.places import _claim

print(_claim(socket.SOCK_DGRAM, {port}), _claim(socket.SOCK_DGRAM, {other}))
"""


def test_a_port_given_to_one_test_is_given_to_no_other_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although nothing is bound to it yet."""
    monkeypatch.setattr(places, "_OF_OURS", range(32_100, 32_700))  # no worker's
    port, other = places.free_udp_port(), 32_701
    code = CODE.format(port=port, other=other)
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "False True\n"
    assert places._claim(UDP, other), "the locks of a process end with it"


def test_a_process_gets_each_port_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "_OF_OURS", range(31_900, 31_940))
    given = [places.free_tcp_port() for _ in range(10)]
    assert len(set(given)) == 10
    assert not any(places._claim(TCP, port) for port in given)
