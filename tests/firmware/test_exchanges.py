"""A node in C is asked what one in Python is asked, and no more (tests/provisioning/exchanges.py)."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from teds_provision.links import LINKS, Capabilities, Contact
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station
from tests.answers import Answers
from tests.bench import make_station
from tests.firmware.crowd import draw
from tests.firmware.memory_node import MemoryNode
from tests.provisioning.exchanges import AGAIN, CLAIMED, FIRST, asked, in_order


@dataclass
class CLink:
    """The wired bus of a node in C, without a bus."""

    node: MemoryNode
    via: str = "can"

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def exchange(self, frame: bytes) -> bytes:
        reply = self.node.handle(frame, link="can:f1", tapped=True)
        self.node.reply_sent("can:f1")
        return reply

    def close(self) -> None:
        self.node.link_lost("can:f1")


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "home")
    yield made
    made.close()


def test_a_node_in_c_is_asked_no_more_than_one_in_python(station: Station) -> None:
    node = MemoryNode(draw, time.monotonic, uuid=os.urandom(10))
    node.add_channel(1, 0, 2)
    assert node.start() == 0
    try:
        with asked() as words:
            for expected in (FIRST, AGAIN):
                words.clear()
                contact = Contact(node.identity(), CLink(node), None, node.can_address)
                with Conversation(contact, notice=lambda _notice: None) as talk:
                    order = BuildOrder("magnetic-angular-position-sensor")
                    done = provision(station, talk, order, operator=Answers(), reporter=SilentReporter())
                assert done.verified.verdict == "authentic"
                assert in_order(words) == [*expected, *CLAIMED, "[close]"]
    finally:
        node.close()
