"""Who reads a bus: one thread that waits reads by itself, several have the loop read, and no frame is left lying."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from queue import Empty, SimpleQueue

import pytest

from teds_provision.errors import LinkError
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.bus_multiplexer import BusMultiplexer
from teds_provision.links.can.spec import parse_spec
from tests.pace import PATIENCE, best_of

pytestmark = pytest.mark.link


@pytest.fixture
def other(group: str) -> Iterator[Bus]:
    bus = Bus(parse_spec(group))
    yield bus
    bus.close()


class Listener:
    """A listener that notes which thread reads."""

    def __init__(self) -> None:
        self.readers: list[str] = []
        self.queue: SimpleQueue[Frame] = SimpleQueue()

    def heard(self, frame: Frame) -> bool:
        self.readers.append(threading.current_thread().name)
        self.queue.put(frame)
        return False


def frame(number: int) -> Frame:
    return Frame(0x1CFF0030, bytes([number]))


def test_the_one_thread_that_waits_reads_and_the_loop_goes_on_after_it(group: str, other: Bus) -> None:
    bus, listener = BusMultiplexer(Bus(parse_spec(group))), Listener()
    bus.listen(listener.heard)

    def by_others() -> int:
        """Return how many of twenty the loop read: those that came before the one thread waited, on a busy machine."""
        del listener.readers[:]
        for number in range(20):
            threading.Timer(0.02, other.send, [frame(number)]).start()
            assert bus.next_of(listener.queue, PATIENCE) == frame(number)
        return 20 - listener.readers.count(threading.current_thread().name)

    best_of(5, 10, by_others, because="half of twenty frames may come before the thread waits")
    del listener.readers[:]
    other.send(frame(99))
    assert listener.queue.get(timeout=60) == frame(99), "nobody waits by the bus: the loop reads"
    assert listener.readers == [f"can {bus.spec.text}"]
    bus.close()


def test_several_threads_that_wait_all_get_theirs(group: str, other: Bus) -> None:
    bus = BusMultiplexer(Bus(parse_spec(group)))
    queues: list[SimpleQueue[Frame]] = [SimpleQueue() for _ in range(6)]
    got: list[int] = []

    def share(frame: Frame) -> bool:
        queues[frame.data[0]].put(frame)
        return False

    def wait(number: int) -> None:
        for _ in range(30):
            assert bus.next_of(queues[number], PATIENCE).data[0] == number
            got.append(number)
            other.send(frame(number)) if got.count(number) < 30 else None

    bus.listen(share)
    threads = [threading.Thread(target=wait, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for number in range(6):
        other.send(frame(number))
    for thread in threads:
        thread.join(60)
    assert sorted(got) == sorted(list(range(6)) * 30)
    bus.close()


def test_waiting_ends_with_its_time_and_with_the_bus(group: str) -> None:
    bus = BusMultiplexer(Bus(parse_spec(group)))
    queue: SimpleQueue[Frame] = SimpleQueue()
    began = time.monotonic()
    with pytest.raises(Empty):
        bus.next_of(queue, 0.2)
    assert 0.2 <= time.monotonic() - began < 25
    line = bus.address_pair(0x21)
    threading.Timer(0.1, bus.close).start()
    assert bus.next_of(line.events, 120.0).kind == "failed"
    with pytest.raises(LinkError, match="closed"):
        bus.check()
    assert time.monotonic() - began < 110
