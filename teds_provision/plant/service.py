"""The plant beside the service: syncs at its start, on the registry's notification, and each minute.

A registry that fails stops nothing: the failure is reported once, and once its end.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from teds_provision import plant
from teds_provision.api.operations import LONGEST_TEXT
from teds_provision.errors import (
    LinkError,
    NotAuthenticError,
    NotFoundError,
    NotMemberError,
    StoreLockedError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.ncap.live import Live
from teds_provision.ncap.service_part import Line, PartKind
from teds_provision.ncap.web.responses import reading
from teds_provision.plant.postgres import PostgresTransport, Registry
from teds_provision.plant.transport import Transport
from teds_provision.protocol.plant.job import Job
from teds_provision.station.station import Station

if TYPE_CHECKING:
    from starlette.requests import Request

EVERY: Final = 60.0
"""Seconds between two syncs without a notification."""
MOST_SHOWN: Final = 20
"""Most nodes in one answer about holders."""
_SOON: Final = 1.0
"""Seconds to wait after a failure of the connection that listens, and at most for the end of this."""
_BUSY: Final = 2.0
_DATABASE_CHECK: Final = 3600.0
"""Seconds between two looks at what the database allows."""
_EMPTY_PAGE: Final = 24 * 3600.0
_HELP: Final = {
    "teds_registry_age_seconds": ("gauge", "Since the last sync with the registry."),
    "teds_registry_unsent": ("gauge", "Events that wait for a sync."),
    "teds_registry_alarms": ("gauge", "Alarms that are not acknowledged yet."),
}


class PlantWatch:
    """Follows the registry that this station joined; does nothing if it joined none."""

    def __init__(self, station: Station, live: Live, changed: Callable[[], object]) -> None:
        self._station, self._live, self._changed = station, live, changed
        self._wake, self._stop = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        self._transport: Transport | None = None
        self._listener: Registry | None = None
        self._place: str | None = None
        """Where the transport leads, as the store has it; `registry connect` may name another place at any time."""
        self._told = ("", "")
        self._look_again = 0.0

    def start(self) -> None:
        """Begin; raises PolicyError if no registry was joined."""
        plant.apply_pages.require_roster(self._station)
        for run, name in ((self._run, "registry"), (self._listen, "registry listener")):
            self._threads.append(threading.Thread(target=run, name=name, daemon=True))
            self._threads[-1].start()

    def stop(self) -> None:
        """End: a sync that is under way is cut, and the next one carries on."""
        self._stop.set()
        self._wake.set()
        for connection in (self._transport, self._listener):
            if isinstance(connection, PostgresTransport | Registry):
                connection.interrupt()
        for thread in self._threads:
            thread.join(_SOON)

    def is_shown(self) -> bool:
        """Return True if this station joined a registry."""
        return self._station.plant.joined is not None

    def resources(self) -> Mapping[str, Callable[[Request], Awaitable[dict[str, Any]]]]:
        """Return what answers a GET, by its path below /api/v1."""
        return {
            "/plant": self._get_plant,
            "/plant/nodes": self._get_nodes,
            "/jobs": self._get_jobs,
            "/jobs/{id}": self._get_job,
        }

    async def _get_plant(self, _request: Request) -> dict[str, Any]:
        found = await asyncio.to_thread(self.status)
        if found is None:
            raise NotFoundError(
                "This station has joined no registry.", hint="Join one: teds-provision registry connect"
            )
        return found

    async def _get_nodes(self, request: Request) -> dict[str, Any]:
        text = request.query_params.get("text", "")
        if len(text) > LONGEST_TEXT:
            raise UsageError(f"text may have at most {LONGEST_TEXT} characters.")
        return await reading(self.nodes, text)

    async def _get_jobs(self, _request: Request) -> dict[str, Any]:
        return {"jobs": await asyncio.to_thread(self.jobs)}

    async def _get_job(self, request: Request) -> dict[str, Any]:
        return await reading(self.job, request.path_params["id"])

    @property
    def metric_help(self) -> Mapping[str, tuple[str, str]]:
        """Kind and help of each metric, by name."""
        return _HELP

    def metrics(self) -> Iterator[Line]:
        """Yield the present values; none if this station joined no registry."""
        found = self.status()
        if found is None:
            return
        if found["age"] is not None:
            yield "teds_registry_age_seconds", {}, found["age"]
        yield "teds_registry_unsent", {}, found["unsent"]
        yield "teds_registry_alarms", {}, sum(not alarm["seen"] for alarm in found["alarms"])

    def status(self) -> dict[str, Any] | None:
        """Return the body of `/plant` (api.md); None if this station joined no registry. Reads the store alone."""
        record, roster = self._station.plant.joined, self._station.plant.roster
        if record is None or roster is None:
            return None
        found = plant.status.status(self._station, record, roster)
        synced = datetime.fromisoformat(record.synced).timestamp() if record.synced else None
        return {
            "registry": roster.registry,
            "name": roster.name,
            "roster": roster.version,
            "expires": roster.expires.timestamp(),
            "state": self._told[0] or "waiting",
            "why": self._told[1],
            "synced": synced,
            "age": None if synced is None else max(0.0, time.time() - synced),
            "unsent": found.unsent,
            "to_rotate": plant.removed_members.rotations_due(self._station),
            "stations": [
                {
                    "name": standing.name,
                    "fingerprint": standing.fingerprint,
                    "roles": list(standing.roles),
                    "page": standing.number,
                    "age": standing.age,
                    "state": standing.state,
                }
                for standing in found.standings
            ],
            "conflicts": [
                {"uuid": uuid.hex(), "conflict": name, "detail": detail}
                for uuid, name, detail in self._station.plant.claims.conflicts()
            ],
            "alarms": [
                {"code": alarm.code, "about": roster.name_of(alarm.about) if alarm.about else "", "why": alarm.why,
                 "at": alarm.at, "seen": alarm.seen}
                for alarm in found.alarms
            ],
        }  # fmt: skip

    def nodes(self, text: str) -> dict[str, Any]:
        """Return the body of `/plant/nodes` (api.md); raises PolicyError if no registry was joined."""
        found = plant.status.nodes(self._station, plant.apply_pages.require_roster(self._station), text)
        first = list(islice(found, MOST_SHOWN + 1))
        return {"nodes": first[:MOST_SHOWN], "more": len(first) > MOST_SHOWN}

    def jobs(self) -> list[dict[str, Any]]:
        """Return the object of api.md, `/jobs`."""
        found = []
        for row in self._station.plant.line.jobs():
            with suppress(NotAuthenticError):  # by a keeper that is in no roster any more
                found.append(self._job(plant.jobs.kept_job(self._station, row), row.state))
        return found

    def job(self, text: str) -> dict[str, Any]:
        """Return the body of `/jobs/{id}` (api.md); raises NotFoundError.

        A synced job that was not taken yet is none.
        """
        rows = [row for row in self._station.plant.line.jobs() if len(text) >= 4 and row.id.startswith(text.lower())]
        if len(rows) != 1:
            raise NotFoundError(f"{len(rows) or 'No'} jobs begin with {text[:64]}.", hint="GET /jobs lists them.")
        [row] = rows
        found = plant.jobs.kept_job(self._station, row)
        parts = plant.yield_stats.yield_stats(
            self._station, found, plant.yield_stats.attempts_of(self._station, found.id)
        )
        return {**self._job(found, row.state), "stations": [part.to_json() for part in parts]}

    def _job(self, found: Job, state: str) -> dict[str, Any]:
        given, passed, _ = self._station.plant.line.count_units(found.id)
        return {
            "id": found.id,
            "title": found.title,
            "profile": found.profile,
            "total": found.total,
            "ends": found.ends.timestamp(),
            "state": state,
            "units": given,
            "passed": passed,
        }

    # -- threads -----------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.clear()
            busy = self._sync()
            self._wake.wait(_BUSY if busy else EVERY)

    def _sync(self) -> bool:
        """Run one sync; True if another command of this home runs one."""
        station = self._station
        try:
            self._follow(plant.connecting.place_of(self._station))
            if self._transport is None:
                self._transport = plant.connecting.open_transport(station)
            if self._transport is None:
                self._publish_state("unreachable", "nothing is known that carries: registry connect")
                return False
            self._say_daily()
            done = plant.sync.sync(station, self._transport)
            if time.monotonic() >= self._look_again:
                plant.connecting.check_database(station, self._transport)
                self._look_again = time.monotonic() + _DATABASE_CHECK
        except StoreLockedError:
            return True
        except NotMemberError as error:
            self._publish_state("removed", error.message)
        except LinkError as error:
            self._publish_state("unreachable", error.message)
        except TedsProvisionError as error:
            self._publish_state("alarm", error.message)
        else:
            self._after(done.pushed + done.fetched + done.parcels_in + done.parcels_out + len(done.rosters))
        return False

    def _follow(self, place: str | None) -> None:
        """Let go of the connections to another place than this."""
        if place == self._place:
            return
        if self._transport is not None:
            self._transport.close()
        self._transport, self._place, self._look_again = None, place, 0.0
        if self._listener is not None:
            self._listener.interrupt()

    def _after(self, moved: int) -> None:
        record, roster = self._station.plant.joined, self._station.plant.roster
        if record is None or roster is None:
            return
        found = plant.status.status(self._station, record, roster)
        alarms = [alarm for alarm in found.alarms if not alarm.seen]
        if alarms:
            self._publish_state("alarm", f"{alarms[-1].code}: {alarms[-1].why}")
        elif found.expired:
            self._publish_state("expired", f"the roster's time was over on {roster.expires:%Y-%m-%d}")
        elif found.expires_soon:
            self._publish_state("expires", f"the roster's time is over on {roster.expires:%Y-%m-%d}")
        else:
            self._publish_state("synced", "")
        if moved:
            self._changed()

    def _say_daily(self) -> None:
        """Write an empty page each day: a station without a page for seven days counts as silent.

        Also after a page that a clock which was ahead has dated a day ahead or more: its date would last for long.
        """
        station, roster = self._station, self._station.plant.roster
        chain = station.plant.pages.chains().get(station.fingerprint)
        if roster is None or chain is None or not chain.counted[0]:
            return
        page = station.plant.pages.get(chain.id, *chain.counted)
        if (
            page is not None
            and abs((datetime.now(UTC) - datetime.fromisoformat(page.created)).total_seconds()) > _EMPTY_PAGE
        ):
            plant.sync.write_page(station, roster, empty=True)

    def _listen(self) -> None:
        """Start a sync when the registry notifies of a change."""
        listened: str | None = None  # the place that the listener leads to
        while not self._stop.is_set():
            try:
                place = plant.connecting.place_of(self._station)
                if self._listener is not None and place != listened:
                    self._listener.close()
                    self._listener = None
                if self._listener is None:
                    self._listener, listened = plant.connecting.listener(self._station), place
                if self._listener is None:  # a folder, which may become a database
                    self._stop.wait(EVERY)
                    continue
                self._listener.listen()
                self._wake.set()  # finds what was pushed before
                swept = 0.0
                while not self._stop.is_set() and plant.connecting.place_of(self._station) == place:
                    if time.monotonic() - swept >= EVERY:  # also detects a lost connection
                        self._listener.sweep()
                        swept = time.monotonic()
                    if self._listener.wait(EVERY):
                        self._wake.set()
            except TedsProvisionError:
                self._stop.wait(EVERY if self._told[0] == "unreachable" else _SOON)

    def _publish_state(self, state: str, why: str) -> None:
        """Publish an event for each change of state."""
        if (state, why) != self._told:
            self._told = state, why
            self._live.event("registry", state=state, why=why)


PART: Final = PartKind("registry", "plant", plant.apply_pages.require_roster, PlantWatch)
"""What runs beside the service if ``ncap run --registry`` asks for it; its status is shown in any case."""
