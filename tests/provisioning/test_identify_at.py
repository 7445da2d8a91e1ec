"""``identify`` over a bus: every node that is there, one that cannot prove its key among them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from teds_provision.links import LinkSettings, Notice
from teds_provision.node.can.server import CanServer
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.messages.frames import Function, Reason, refusal
from teds_provision.provisioning.identify import identify_at
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from tests.pace import PATIENCE
from tests.places import free_bus

pytestmark = pytest.mark.link


class ProvingNode(VirtualNode):
    """A node that gives its proof once every node of ``all_asked`` was asked for one; None: it gives none."""

    all_asked: threading.Barrier | None = None

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        if frame[2:4] == bytes([128, Function.PROVE]):
            if self.all_asked is None:
                return refusal(Reason.FAULT).encode()
            self.all_asked.wait(PATIENCE)
        return super().request(link, frame, tapped=tapped)


class CollectingReporter(SilentReporter):
    """What a person is told meanwhile."""

    def __init__(self) -> None:
        self.notices: list[Notice] = []

    def notice(self, notice: Notice) -> None:
        self.notices.append(notice)


@contextmanager
def bus(
    folder: Path, count: int, barrier: threading.Barrier | None, without: int = 0
) -> Iterator[tuple[str, list[str]]]:
    spec, uuids = free_bus(), []
    server = CanServer(spec)
    for number in range(count + without):
        uuid = bytes([0x8D, number]) * 5
        FlashFile.create(folder / str(number), uuid=uuid)
        node = ProvingNode(folder / str(number))
        node.tim.take_can_address(0x20 + number)
        node.all_asked = barrier if number < count else None
        server.add(node)
        uuids.append(uuid.hex())
    server.start()
    try:
        yield spec, uuids
    finally:
        if barrier is not None:
            barrier.abort()
        server.stop()


def test_the_nodes_of_a_bus_are_asked_side_by_side(station: Station, tmp_path: Path) -> None:
    """One after the other, each that is mute held up all the others for 40 s."""
    with bus(tmp_path, 4, threading.Barrier(4)) as (spec, uuids):
        came = list(identify_at(station, LinkSettings("can", can=spec, timeout=PATIENCE), CollectingReporter()))
    assert [arrival.uuid.hex() for arrival in came] == uuids
    assert all(arrival.result is not None for arrival in came)


def test_a_node_that_starts_meanwhile_is_found_while_a_caller_listens(station: Station, tmp_path: Path) -> None:
    with bus(tmp_path / "first", 1, threading.Barrier(1)) as (spec, (early,)):
        FlashFile.create(tmp_path / "late", uuid=bytes(range(10)))
        late = CanServer(spec)
        late.add(VirtualNode(tmp_path / "late"))
        starts = threading.Timer(2, late.start)
        starts.start()
        began = time.monotonic()
        try:
            links = LinkSettings("can", can=spec, timeout=PATIENCE, listen=6)
            came = list(identify_at(station, links, CollectingReporter()))
        finally:
            starts.join()
            late.stop()
    assert {arrival.uuid.hex() for arrival in came} == {early, bytes(range(10)).hex()}
    assert time.monotonic() - began >= 6


def test_a_node_without_a_proof_is_reported_of_beside_the_others(station: Station, tmp_path: Path) -> None:
    recorder = CollectingReporter()
    with bus(tmp_path, 1, threading.Barrier(1), without=1) as (spec, (good, bad)):
        came = list(identify_at(station, LinkSettings("can", can=spec, timeout=PATIENCE), recorder))
    assert [arrival.uuid.hex() for arrival in came] == [good]
    (notice,) = [notice for notice in recorder.notices if notice.kind == "unfinished"]
    assert bad in notice.text
