"""Whether a node that was seen on a bus is still there: it is asked itself, twice, before anybody says that it left.

Everybody is asked every 30 s only (operation.md section 7), and on a busy machine an answer to that may come too late.
So a node that nobody heard of for :data:`CHECK` seconds gets an Identify of its own: at most :data:`AT_ONCE` a second,
once in 10 s each, the bound that the contract has for nodes that announce themselves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from teds_provision.errors import AddressConflict, LinkFailure
from teds_provision.links.can.port import CanPort
from teds_provision.measure.finding.sightings import Sighting

CHECK: Final = 10.0
AT_ONCE: Final = 5
PATIENCE: Final = (1.0, 3.0)  # seconds for the answer to the first question, and to the second


class StillThere:
    """Asks the nodes of one bus. ``held`` says of whom others hear meanwhile: who is measured, or worked with."""

    def __init__(self, port: CanPort, held: Callable[[str], bool]) -> None:
        self._port, self._held = port, held
        self._asked: dict[str, float] = {}
        self._last = 0.0

    def look(self, known: Mapping[str, Sighting]) -> Iterator[tuple[str, Sighting | None]]:
        """Ask those whose turn has come: each with what it says now, None where it does not answer any more."""
        now = time.monotonic()
        if now - self._last < 1.0:
            return
        due = [uuid for uuid, last in known.items() if now - max(last.at, self._asked.get(uuid, 0.0)) >= CHECK]
        due.sort(key=lambda uuid: known[uuid].at)
        silent = [uuid for uuid in due if not self._held(uuid)][:AT_ONCE]
        self._asked = {uuid: at for uuid, at in self._asked.items() if uuid in known} | dict.fromkeys(silent, now)
        if not silent:
            return
        self._last = now
        with ThreadPoolExecutor(len(silent), thread_name_prefix="still there") as askers:
            yield from zip(silent, askers.map(self._ask, [known[uuid] for uuid in silent]), strict=True)

    def _ask(self, last: Sighting) -> Sighting | None:
        for seconds in PATIENCE:
            try:
                identity = self._port.identify(last.address, seconds=seconds)
            except AddressConflict:  # somebody is there, and that two are is told by whoever finds out
                return Sighting(last.identity, last.address, last.port, time.monotonic())
            except LinkFailure:
                return None
            if identity is not None:
                same = identity.uuid == last.uuid
                return Sighting(identity, last.address, last.port, time.monotonic()) if same else None
        return None
