"""A serial CAN adapter that is pulled while nodes are measured over it: the adapter is named, not the node."""

from __future__ import annotations

import os
import pty
import signal
import threading
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import can
import pytest

from teds_provision.links.can.bus import Bus
from teds_provision.links.can.frame import Frame
from teds_provision.links.can.spec import parse_spec
from tests.measure.hall import Hall, events

pytestmark = pytest.mark.link


class Adapter:
    """An slcan adapter between a pseudo terminal and a bus of this machine (LAWICEL: ``T`` iiiiiiii l dd… CR)."""

    def __init__(self, spec: str) -> None:
        self._ours, theirs = pty.openpty()
        tty.setraw(theirs)
        self.name = os.ttyname(theirs)
        self._theirs = theirs
        self._bus = Bus(parse_spec(spec))
        self._over = threading.Event()
        self._threads = [threading.Thread(target=work) for work in (self._to_bus, self._from_bus)]
        for thread in self._threads:
            thread.start()

    def pull(self) -> None:
        """Take it out: whoever reads from the terminal has an error."""
        if not self._over.is_set():
            self._over.set()
            os.close(self._theirs)
            os.close(self._ours)
            for thread in self._threads:
                thread.join()
            self._bus.close()

    def _to_bus(self) -> None:
        rest = b""
        with suppress(OSError):
            while not self._over.is_set() and (read := os.read(self._ours, 4096)):
                *lines, rest = (rest + read).split(b"\r")
                for line in lines:
                    if line[:1] == b"T":
                        self._bus.send(Frame(int(line[1:9], 16), bytes.fromhex(line[10:].decode()), False))

    def _from_bus(self) -> None:
        with suppress(OSError, can.CanError):
            while not self._over.is_set():
                frame = self._bus.receive(0.1)
                if frame is not None and not frame.fd:
                    data = frame.data.hex().upper()
                    os.write(self._ours, f"T{frame.identifier:08X}{len(frame.data)}{data}\r".encode())


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    made = Hall(tmp_path, types={"a": "magnetic-angular-position-sensor"})
    made.can = made.desk.links.can  # classic frames: slcan has no other ones
    made.nodes["a"].start(can=made.can)
    yield made
    made.close()


def test_a_pulled_adapter_is_told_as_itself(hall: Hall) -> None:
    """`measure` said: No message of the node came."""
    adapter = Adapter(hall.can)
    try:
        running = hall.begin("a", "--rate", 10, can=f"slcan:{adapter.name}?sleep_after_open=0")
        running.wait_for('"event":"data"', 60)
        adapter.pull()
        running.wait_for("The CAN bus slcan:", 60)
    finally:
        adapter.pull()
    running.signal(signal.SIGINT)
    told = [one.get("why") or "" for one in events(running.end().out) if one["event"] == "status"]
    assert any("The CAN bus slcan:" in why for why in told), told
    assert not any("No message of the node" in why for why in told), told
