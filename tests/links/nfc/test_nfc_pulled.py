"""A board lifted off in the middle of an exchange, at every frame of it; put back, and then another one.

nfcpy's udp driver between two processes, and its pn533 driver over a mocked chip. What the command line does with it is
in tests/e2e/test_pulled.py.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from teds_provision.errors import LinkError
from teds_provision.links import Contact, LinkSettings, Notice, open_port
from teds_provision.links.nfc import port as port_module
from tests.pace import until
from tests.places import free_reader

from .conftest import UUID, StartNode
from .field import Field
from .pn533_chip import Chip
from .test_nfc_usb import Node, chip, make_node

__all__ = ["chip", "make_node"]
pytestmark = pytest.mark.link
OTHER = "FFEEDDCCBBAA99887766"
FRAME = bytes(range(10)) + bytes(600)


class Watch:
    """A watch that exchanges two frames with each node that comes; ``results`` are UUIDs, or "pulled"."""

    def __init__(self, path: str) -> None:
        self.results: list[str] = []
        self.notices: list[Notice] = []
        self._using = False
        self._stop = threading.Event()
        self._port = open_port(LinkSettings(nfc=path))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for contact in self._port.watch(stop=self._stop, notice=self.notices.append):
            self.results.append(self._use(contact))

    def _use(self, contact: Contact) -> str:
        self._using = True
        try:
            for _ in range(2):
                assert contact.link.exchange(FRAME) == b"\x01" + FRAME[::-1]
        except LinkError:
            return "pulled"
        finally:
            self._using = False
            contact.link.close()
        return contact.identity.uuid.hex().upper()

    def until(self, condition: Callable[[], bool], what: object = None) -> None:
        until(condition, lambda: (what, self.results, self.notices[-3:]))

    def left(self) -> int:
        return [notice.kind for notice in self.notices].count("node-left")

    def gone(self, what: object, lift: Callable[[], None]) -> None:
        """Lift the board off, and wait until the watch has noticed."""
        before = self.left()
        lift()
        self.until(lambda: self.left() > before, what)
        self.results.clear()

    def notices_it(self) -> None:
        """Give it time to find the board gone for good; one that was lifted while it was first read is not told of."""
        end = time.monotonic() + (8.0 if self._using else 0.3)
        while not self.results and time.monotonic() < end:
            time.sleep(0.005)

    def end(self) -> None:
        self._stop.set()
        self._thread.join(60)
        assert not self._thread.is_alive(), "the watch hangs"
        self._port.close()


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that slips off is waited for only a moment, and is gone a moment later."""
    monkeypatch.setattr(port_module, "RETURN_WITHIN", 0.1)
    monkeypatch.setattr(port_module, "_DEBOUNCE", 0.1)


@pytest.fixture
def field() -> Iterator[Field]:
    field = Field()
    yield field
    field.close()


OTHER_TAG = pytest.mark.nightly(
    "tests/links/nfc/test_nfc_pulled.py::test_pulled_at_frames_all_over_an_exchange_between_two_processes[2], "
    "tests/links/nfc/test_nfc_pulled.py::test_pulled_at_every_frame_below_a_usb_reader[4]: either tag type once"
)


@pytest.mark.parametrize("tag", ["2", pytest.param("4", marks=OTHER_TAG)])
def test_pulled_at_frames_all_over_an_exchange_between_two_processes(
    field: Field, start_node: StartNode, tag: str
) -> None:
    paths = {UUID: free_reader(), OTHER: free_reader()}
    for uuid, path in paths.items():
        start_node(path=path, uuid=uuid, tag=tag, wt_int=4)
    watch = Watch(field.path)
    field.put(paths[UUID])
    watch.until(lambda: watch.results == [UUID])
    frames = field.frames
    try:
        for number in range(8):
            watch.gone(number, field.lift)
            field.put(paths[UUID], lift_after=4 + number * (frames - 8) // 8)
            watch.until(lambda: field.empty, number)
            if number % 2:
                watch.notices_it()  # else it is back at once
            field.put(paths[UUID])
            watch.until(lambda: UUID in watch.results, number)
            field.put(paths[OTHER])
            watch.until(lambda: OTHER in watch.results, number)
    finally:
        watch.end()


@pytest.mark.parametrize("tag", ["4", pytest.param("2", marks=OTHER_TAG)])
def test_pulled_at_every_frame_below_a_usb_reader(chip: Chip, make_node: Callable[[str], Node], tag: str) -> None:
    node = make_node(tag)
    node.put_down()
    respond = chip.answer
    left, frames = [10**6], [0]

    def answer(command: bytes) -> bytes | None:
        frames[0] += 1
        left[0] -= 1
        if left[0] < 0:
            node.take_away()
            return None
        return respond(command) if respond else None

    chip.answer = answer
    watch = Watch("usb")
    watch.until(lambda: watch.results == [UUID])
    whole = frames[0]
    try:
        for number in range(2, whole, max(1, whole // 17)):
            watch.gone(number, node.take_away)
            left[0] = number
            node.put_down()
            chip.answer = answer
            until(lambda: chip.answer is None)
            if number % 2:
                watch.notices_it()
            left[0] = 10**6
            node.put_down()
            watch.until(lambda: UUID in watch.results, number)
    finally:
        watch.end()
