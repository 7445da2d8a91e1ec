"""Re-reads the remaining TEDS in the background; until then the cached copy is used.

Every session reads the Security TEDS. If the node has started since its other TEDS were read, it is measured at once by
the signed copy, and they are read again in the air time that data leave free: one node at a time on a bus, the frames
of a reply apart from each other, and after each exchange a pause that is longer than it took. While others on the bus
begin, nothing is read for a while: when two hundred are switched on together, the last one's first value comes sooner.
"""

from __future__ import annotations

import hashlib
import time
from datetime import UTC, datetime
from typing import Final

from teds_provision.errors import BadDataError, BadDatasheetError, GarbledError, NodeRefusedError, NodeSilentError
from teds_provision.measure.buses import MeasuredBus
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.provisioning import readings
from teds_provision.provisioning.teds_read import read_in_between
from teds_provision.provisioning.verify import freshness_floor_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import iso
from teds_provision.teds.image import Image

GAP: Final = 1  # ms between the frames of a reply: three quarters of a 500 kbit/s bus remain free
SPARING: Final = 4.0  # pause after an exchange, as a multiple of its duration
FIRST: Final = 1.0  # seconds after the first value before reading begins: other nodes on the bus may be about to start
# seconds for which nodes that start have priority; limited, since one may restart again and again
PATIENCE: Final = 60.0
AGAIN: Final = 10.0  # seconds until the next try if the node did not answer, or was busy
TRIES: Final = 5


class BackgroundReread:
    """Reads the rest of one node's datasheet, a step at a time; :meth:`close` when the session ends before it does."""

    def __init__(self, station: Station, trusted: VerifiedSession, bus: MeasuredBus, *, by: str) -> None:
        self._station, self._verified, self._bus, self._by = station, trusted, bus, by
        self._steps = read_in_between(trusted.node, gap=GAP)
        self._c = trusted.node.open_counter
        self._mine = False
        self._began = time.time()
        self._due = time.monotonic() + FIRST
        self._patient_until = self._due + PATIENCE
        self._left = TRIES

    def step(self) -> bool:
        """Do one exchange, if the bus is free for it now; False if nothing is left to do.

        Raises BadDatasheetError if the TEDS differ from those on which the values rest; SessionLostError.
        """
        began = time.monotonic()
        if began < self._due or (self._bus.beginning and began < self._patient_until):
            return True
        if not self._mine:
            self._mine = self._bus.reading.acquire(blocking=False)
            if not self._mine:
                return True
        try:
            next(self._steps)
        except StopIteration as done:
            self.close()
            self._conclude(done.value)
            return False
        except (
            NodeSilentError,
            GarbledError,
            NodeRefusedError,
            BadDataError,
        ):  # the data go on, or the supervisor notices that they have stopped
            self.close()
            self._steps, self._due = read_in_between(self._verified.node, gap=GAP), began + AGAIN
            self._left -= 1
            return self._left > 0
        self._due = time.monotonic() + SPARING * (time.monotonic() - began)
        return True

    def close(self) -> None:
        """Let another node of the bus have its turn."""
        if self._mine:
            self._mine = False
            self._bus.reading.release()

    def _conclude(self, image: Image) -> None:
        trusted, uuid = self._verified, self._verified.sheet.uuid
        floor = freshness_floor_of(self._station, uuid, trusted.node.proven)
        verified = readings.keep(self._station, trusted.node, image, by=self._by, floor=floor, c=self._c).verified
        same = hashlib.sha256(image.security or b"").hexdigest() == trusted.fingerprint
        if same and verified.verdict in (
            "authentic",
            "unsigned" if trusted.unsigned or trusted.unverified else "authentic",
        ):
            return
        failed = next((check.why for check in verified.checks if check.result == "failed"), "another Security TEDS")
        raise BadDatasheetError(
            f"The datasheet on the node is not the one used for the measurement: {failed}. "
            f"Values recorded of it since {iso(datetime.fromtimestamp(self._began, UTC))} do not count.",
            hint=f"See: teds-provision verify {uuid.hex()}",
        )
