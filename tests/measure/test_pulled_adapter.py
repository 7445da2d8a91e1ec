"""A serial CAN adapter that is pulled while nodes are measured over it: the adapter is named, not the node."""

from __future__ import annotations

import os
import pty
import select
import signal
import threading
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import can
import pytest

from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.spec import parse_spec
from tests.e2e.desk import PROGRAM
from tests.measure.rig import Rig, events

pytestmark = pytest.mark.link
NOTHING_ASKED = (
    "import runpy, sys, teds_provision.measure.verified_session as trusting;"
    "trusting.LEASE = 60;"
    "import teds_provision.measure.background_reread as rest;"
    "rest.FIRST = 600.0;"
    "sys.argv[0] = 'teds-provision'; runpy.run_module('teds_provision', run_name='__main__')"
)


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
            for thread in self._threads:  # first: a read that still waits would keep the terminal up
                thread.join()
            os.close(self._theirs)
            os.close(self._ours)
            self._bus.close()

    def _to_bus(self) -> None:
        rest = b""
        with suppress(OSError):
            while not self._over.is_set():
                if not select.select([self._ours], [], [], 0.05)[0]:
                    continue
                *lines, rest = (rest + os.read(self._ours, 4096)).split(b"\r")
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
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path, types={"a": "magnetic-angular-position-sensor"})
    made.can = made.desk.links.can  # classic frames: slcan has no other ones
    made.nodes["a"].start(can=made.can)
    try:
        yield made
    finally:
        made.close()


def test_a_pulled_adapter_is_reported_as_itself_before_anything_is_asked_over_it(rig: Rig) -> None:
    """`measure` said: No message from the node came.

    With a lease of 60 s, and the datasheet read later, nothing is asked over the bus for 20 s: silence shows first.
    """
    adapter = Adapter(rig.can)
    try:
        where = f"slcan:{adapter.name}?sleep_after_open=0"
        running = rig.begin("a", "--rate", 50, can=where, program=(PROGRAM[0], "-c", NOTHING_ASKED))
        running.wait_for('"event":"data"')
        adapter.pull()
        running.wait_for('"state":"lost"')
    finally:
        adapter.pull()
    running.signal(signal.SIGINT)
    reasons = [
        event["why"] for event in events(running.end().out) if event["event"] == "status" and event["state"] == "lost"
    ]
    assert "The CAN bus slcan:" in reasons[0], reasons
    assert not any("No message from the node" in why for why in reasons), reasons
