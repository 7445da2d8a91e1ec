"""The daemon: begins everything in order, and ends it in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Final, get_args

from teds_provision import __version__
from teds_provision.errors import (
    FrozenError,
    NewerStoreError,
    NotFoundError,
    StoreError,
    TedsProvisionError,
    UsageError,
    VaultError,
)
from teds_provision.links import Port
from teds_provision.links.discovery import Sighting
from teds_provision.links.opening import with_source
from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.buses import Buses
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer
from teds_provision.ncap.live import Live
from teds_provision.ncap.measurement_supervisor import MeasurementSupervisor
from teds_provision.ncap.names import Names
from teds_provision.ncap.nodes.actuator_leases import ActuatorLeases
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.link_watch import LinkWatch
from teds_provision.ncap.nodes.node_jobs import NodeJobs, NodeLocks
from teds_provision.ncap.nodes.provisioning import AutoProvisioner, Provisioning
from teds_provision.ncap.nodes.sheets import Sheets
from teds_provision.ncap.nodes.updates import Updates
from teds_provision.ncap.nodes.virtual import Virtuals
from teds_provision.ncap.service_part import KINDS
from teds_provision.ncap.settings import Detection, Settings, own_source
from teds_provision.ncap.sinks import DaemonSinks
from teds_provision.ncap.waits import USUAL, Waits
from teds_provision.ncap.web.tokens import Tokens
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.locate import locate_here, locate_measured
from teds_provision.shapes.problem import Problem, problem_of
from teds_provision.station.station import Station

_log = logging.getLogger(__name__)
_ENDING: Final = 8.0


class Daemon:
    """All that runs, over one station; what the API calls."""

    def __init__(
        self,
        station: Station,
        settings: Settings,
        foxglove: FoxgloveServer | None = None,
        waits: Waits = USUAL,
    ) -> None:
        self.station, self.settings, self.foxglove, self.waits = station, settings, foxglove, waits
        self.live, self.node_locks, self.tokens = Live(), NodeLocks(), Tokens(station.home)
        self.directory = NodeDirectory(station, self.live)
        self.buses = Buses(news=self._saw, note=lambda text: self.live.event("link", state="notice", why=text))
        self.node_jobs = NodeJobs(self.directory, self.node_locks, self._port_of)
        sinks = DaemonSinks(
            station.home,
            settings.sinks,
            settings.record,
            actuators=settings.actuators,
            brokers=settings.brokers,
            units=settings.file_units,
            foxglove=foxglove,
            scalars=settings.scalars,
        )
        self.measuring = MeasurementSupervisor(
            station,
            self.directory,
            self.live,
            self.node_locks,
            self.buses,
            sinks,
            self._admits,
            dead_man=settings.dead_man,
            require_firmware=settings.require_firmware,
            waits=self.waits,
        )
        self.node_locks.given = self._free_again
        self._takes_set_points = sinks.take_set_points
        self.names = Names(station, self.directory, self.live, self.measuring.is_measured, self.measuring.facts_of)
        self.sheets = Sheets(station, self.directory, self.node_jobs, self.measuring.sheet)
        self.provisioning = Provisioning(
            station,
            self.directory,
            self.live,
            self.node_jobs,
            self.measuring.unmeasured,
            trusted=settings.trust_dcc,
        )
        self.leases = ActuatorLeases(
            station,
            self.live,
            self.node_jobs,
            self.node_locks,
            self.measuring.session,
            self.measuring.is_measured,
            self.measuring.lent_for,
            dead_man=settings.dead_man,
        )
        self.updates = Updates(
            station,
            self.directory,
            self.live,
            self.node_locks,
            bus_of=self.node_jobs.bus_of,
            measured=lambda uuid: self.measuring.session(uuid, streaming=True),
            lent=self.measuring.lent,
            held=self.leases.held,
        )
        self.virtuals = Virtuals(station, self.live)
        kinds = KINDS.parts()
        self.parts = {kind.name: kind.make(station, self.live, self._store_changed) for kind in kinds}
        self._views = {kind.view: self.parts[kind.name].is_shown for kind in kinds}
        self.adopting = AutoProvisioner(
            station, self.directory, self.live, self.virtuals, lambda: self._adopts, signs=settings.yes
        )
        self.directory.topic, self.directory.actuator = self.names.topic, self.leases.state
        self.directory.virtual = lambda uuid: uuid in self.virtuals
        self.url: str | None = None
        self.failure: TedsProvisionError | None = None
        """Why the service ends by itself; None while it need not."""
        self._ends: Callable[[], None] = lambda: None
        self.started = time.time()
        self._version = station.version()
        self._vault_problem: Problem | None = None
        self._stop = threading.Event()
        self._guard = threading.Lock()
        source = own_source(station.id)
        self.watches = [self._watch(with_source(place, source)) for place in settings.places]
        self._observer = threading.Thread(target=self._observe, name="store", daemon=True)

    # -- start, run, end ---------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Run links, measurements and the store's observer for the length of the block; then end them in order."""
        if self.settings.detection is not None and self.settings.detection != self.detection:
            self.set_detection(self.settings.detection)
        self.directory.refresh()
        self._observer.start()
        self.live.history.start()
        for watch in self.watches:
            watch.start()
        if self.virtuals.all():
            self._start_virtuals()
        self.measuring.start()
        if self.settings.unverified:
            self.measuring.unverified(rate=self.settings.rate)
        for name in self.settings.parts:
            self.parts[name].start()
        if self.settings.measure is not None:
            self.measuring.match(self.settings.measure, rate=self.settings.rate, frozen=self.settings.frozen)
        self.updates.start()
        try:
            yield
        finally:
            self._end()

    def _end(self) -> None:
        """End in order: actuators safe, then claims released and files closed, then links, then the virtual nodes."""
        self._stop.set()
        self.updates.stop()
        for part in self.parts.values():
            part.stop()
        self.leases.end()
        self.measuring.stop()
        for watch in self.watches:
            watch.stop()
        self.buses.close()
        until = time.monotonic() + _ENDING
        for watch in self.watches:
            watch.join(max(0.1, until - time.monotonic()))
        self.virtuals.stop()
        self.live.history.close()
        self._observer.join(self.waits.store)

    async def serve(self, begin: Callable[[], Any], stop: asyncio.Event) -> None:
        """Fan out what is live until ``stop``; ``begin`` is awaited once the loop runs."""
        loop = asyncio.get_running_loop()

        def end() -> None:
            loop.call_soon_threadsafe(stop.set)

        self._ends = end
        if self.failure is not None:
            stop.set()
        fan = asyncio.create_task(self.live.run())
        try:
            await begin()
            await stop.wait()
        finally:
            fan.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await fan

    def _store_changed(self) -> None:
        """Look at the store again: a part of an optional room changed pins, bans or keys."""
        self.directory.refresh()
        self.live.event("store", state="changed")

    def _watch(self, place: str) -> LinkWatch:
        def transparent() -> bool:
            return self.detection == "transparent"

        return LinkWatch(
            place,
            self.station,
            self.directory,
            self.live,
            self.node_locks,
            self,
            transparent,
            self.buses,
            self.settings.trace,
            self.waits,
        )

    def _start_virtuals(self) -> None:
        """Watch the bus of the virtual transducers, which is a link like others, unless it is watched already."""
        with self._guard:
            if all(watch.place != self.virtuals.place for watch in self.watches):
                watch = self._watch(self.virtuals.place)
                self.watches.append(watch)
                watch.start()
            self.virtuals.start()

    def _observe(self) -> None:
        """Follow what the command line does beside us; end the service if a newer version did it."""
        while not self._stop.wait(self.waits.store):
            try:
                self._look_at_vault()
                for uuid in self.directory.follow_profiles():
                    self.live.event("node", uuid=uuid, state="changed")
                version = self.station.version()
                if version == self._version:
                    continue
                self.station.require_known_schema()
                if not self.directory.refresh():
                    continue  # the change is read at the next look
                self._version = version
                self.names.forget()
                self.live.event("store", state="changed")
            except NewerStoreError as newer:
                self.failure = newer
                self.live.event("store", state="newer", why=newer.message, hint=newer.hint)
                self._ends()
                return
            except StoreError as failure:  # temporary: the next read may succeed
                _log.warning("The store cannot be read: %s", failure.message)
            except Exception:  # noqa: BLE001 - a thread that ends unreported would follow no further change
                _log.exception("Following the changes of the store failed; it goes on.")

    def _look_at_vault(self) -> None:
        """Report when another command locks this process out of the vault, and when it is open again."""
        problem: Problem | None = None
        try:
            self.station.current_vault()
        except VaultError as failure:
            problem = problem_of(failure)
        if (problem is None) == (self._vault_problem is None):
            return
        self._vault_problem = problem
        if problem is not None:
            self.live.event("vault", state="locked", why=problem["message"], hint=problem["hint"])
            return
        self.live.event("vault", state="open")
        self.measuring.look_who_is_meant()
        for watch in self.watches:
            watch.look_at_all()

    # -- links -------------------------------------------------------------------------------------------------------

    def _port_of(self, place: str) -> Port | None:
        return next((watch.port for watch in self.watches if watch.place == place), None)

    def _saw(self, sighting: Sighting) -> None:
        self.measuring.on_sighting(sighting.uuid.hex())
        for watch in self.watches:
            if watch.port is sighting.port:
                watch.on_sighting(sighting)

    def _free_again(self, uuid: str) -> None:
        """Report a node that was inspected, or provisioned: now it may be measured."""
        if self.directory.seen(uuid).present:
            self.measuring.on_sighting(uuid)

    def serve_node(self, node: Conversation) -> bool:
        """Do what was requested for this node, or take it up; False if there was nothing to do."""
        before = node.identity.state
        served = self.node_jobs.serve(node) or self.adopting.serve(node)
        if served or node.identity.state != before:  # the reason why a measurement refused it may be gone
            self.measuring.look_who_is_meant()
        return served

    @property
    def _adopts(self) -> bool:
        return self.settings.adopt and self.detection == "transparent"

    # -- for the API -------------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Return the object of api.md, `/status`."""
        links = [self._link(watch) for watch in self.watches]
        return {
            "version": __version__,
            "station": {"name": self.station.name, "fingerprint": self.station.fingerprint},
            "started": self.started,
            "time": time.time(),
            "url": self.url,
            "detection": self.detection,
            "adopt": self.settings.adopt,
            "actuators": self._takes_set_points,
            "dead_man": self.settings.dead_man,
            "links": links,
            "nodes": sum(link["nodes"] for link in links),
            "strangers": sum(link["strangers"] for link in links),
            "clients": self.live.listeners,
            "measurements": self.measuring.all(),
            "sinks": self.measuring.sinks(),
            "foxglove": self.foxglove.url if self.foxglove is not None else None,
            "clock_error": self.measuring.clock_error(),
            "budget": self.measuring.budget(),
            "plant": "plant" in self._views and self._views["plant"](),
            "vault": {"state": "open" if self._vault_problem is None else "locked", "problem": self._vault_problem},
        }

    def _admits(self, set_point: SetPointCommand) -> bool:
        return self.leases.admits(set_point)

    def _link(self, watch: LinkWatch) -> dict[str, Any]:
        state = watch.state
        return {
            "place": watch.place,
            "via": watch.place.partition(":")[0],
            "virtual": watch.place == self.virtuals.place,
            "state": state.state,
            "problem": state.problem,
            "waiting": state.waiting or None,
            "notice": state.notice_text or None,
            "since": state.since,
            "nodes": self.directory.present(watch.place),
            "strangers": self.directory.strangers(watch.place),
        }

    def first_message(self) -> dict[str, Any]:
        """Return the first message of /live."""
        return {"type": "hello", "version": __version__, "station": self.station.name, "time": time.time()}

    @property
    def detection(self) -> Detection:
        """Which nodes are taken up."""
        return self.station.measurements.detection

    def set_detection(self, mode: str) -> None:
        """Change the mode, and inspect all links again; raises UsageError.

        Nodes found in another mode are forgotten until they are found again; in the same one they stay.
        """
        if mode not in get_args(Detection):
            raise UsageError(f"{mode!r} is not a detection mode.", hint="Use transparent or whitelist.")
        changes = mode != self.station.measurements.detection
        with self.station.durable("detection"):
            self.station.measurements.detection = mode  # type: ignore[assignment]
            self.station.audit("detection", None, "set", mode=mode)
        self.measuring.look_who_is_meant()
        self.live.event("detection", state=mode)
        for watch in self.watches:
            if changes:
                self.directory.forget_place(watch.place)
            watch.look_at_all()

    def discover(self) -> list[dict[str, Any]]:
        """Ask every link now, and give the nodes after a moment."""
        for watch in self.watches:
            watch.look_at_all()
        self._stop.wait(self.waits.discovery)
        return self.directory.nodes()

    def locate(self, uuid: str, seconds: int) -> None:
        """Make a node blink for so many seconds, 0: stop; one that is measured does so in its measurement's session.

        Raises FrozenError if it is measured, but no values come of it now.
        """
        station = self.station
        with self.measuring.session(uuid, streaming=True) as trusted:
            if trusted is not None and trusted.node.sealed:
                locate_measured(trusted.node, seconds)
                return
        self.node_jobs.with_node(uuid, "locate", lambda node: locate_here(station, node, seconds))

    def known(self, text: str) -> str:
        """Return the UUID that a path names, of a known node; raises NotFoundError, UsageError."""
        uuid = self.resolve(text)
        if not self.directory.known(uuid) and not self.station.overview.is_known(bytes.fromhex(uuid)):
            raise NotFoundError(f"No node matches {uuid!r}.", hint="See /nodes.")
        return uuid

    def resolve(self, text: str) -> str:
        """Return the UUID that a text names: whole, a prefix, or a name; raises NotFoundError, UsageError."""
        digits = text.lower().removeprefix("0x")
        if self.directory.known(digits):
            return digits
        try:
            return self.station.nodes.resolve(text).hex()
        except NotFoundError:
            near = [uuid for uuid in self.directory.uuids() if uuid.startswith(digits)] if len(digits) >= 4 else []
            if len(near) == 1:
                return near[0]
            raise

    def login_url(self, *, read_only: bool = False) -> str:
        """Return the page's address with a token that works once; raises UsageError if no page is served."""
        if self.url is None:
            raise UsageError(
                "The station is not serving its page.", hint="Restart it with --http: ncap run --http 127.0.0.1:8351"
            )
        return f"{self.url}/login?token={self.tokens.login_link(read_only=read_only)}"

    # -- groups ------------------------------------------------------------------------------------------------------

    def groups(self) -> list[dict[str, Any]]:
        """Return every group, and whether it is measured."""
        return [
            {
                "name": group.name,
                "uuids": [uuid.hex() for uuid in group.uuids],
                "measuring": bool(self.measuring.measured_as(group.name)),
            }
            for group in self.station.groups.all()
        ]

    def make_group(self, name: str, uuids: list[str]) -> None:
        """Make a new group; raises UsageError."""
        with self.station.lock("group create"):
            self.station.groups.create(name, [bytes.fromhex(uuid) for uuid in uuids])
        self._group_changed(name)

    def change_group(self, name: str, uuids: list[str]) -> None:
        """Replace the members of a group; raises NotFoundError, and FrozenError while it is measured."""
        wanted = {bytes.fromhex(uuid) for uuid in uuids}
        with self.station.lock("group change"):
            present = set(self.station.groups.get(name).uuids)
            self._require_thawed(name)
            with self.station.transaction():
                self.station.groups.remove(name, present - wanted)
                self.station.groups.add(name, wanted - present)
        self._group_changed(name)

    def drop_group(self, name: str) -> None:
        """Delete a group; raises NotFoundError, FrozenError while it is measured or a measurement is kept for it."""
        with self.station.durable("group delete"):
            self.station.groups.get(name)
            self._require_thawed(name)
            self.station.measurements.delete_group(name)
            self.station.audit("group", None, "deleted", group=name)
        self._group_changed(name)

    def _require_thawed(self, name: str) -> None:
        measured = self.measuring.measured_as(name)
        if measured:
            raise FrozenError(
                f"Group {name!r} is being measured ({', '.join(measured)}) and cannot be changed now.",
                hint="End the measurement first.",
            )

    def _group_changed(self, name: str) -> None:
        self.directory.refresh()
        self.measuring.look_who_is_meant()
        self.live.event("group", state="changed", name=name)

    # -- virtual transducers -----------------------------------------------------------------------------------------

    def make_virtual(
        self, *, name: str | None, source: str, content: str | None, profile: str | None, new_uuid: bool = False
    ) -> dict[str, Any]:
        """Make one and start it; it is provisioned when it answers.

        Raises UsageError, BadDataError, NotFoundError, KnownUuidError.
        """
        made = self.virtuals.make(
            name=name,
            source=source,
            content=content,
            profile=profile,
            new_uuid=new_uuid,
            on_bus=self.directory.answering_on(),
        )
        self._start_virtuals()
        self.directory.refresh([made.uuid])
        return made.as_json()

    def drop_virtual(self, uuid: str) -> None:
        """End one, and its key with it.

        Raises NotFoundError, FrozenError (it is measured), NodeBusyError (it is worked on).
        """
        with self.node_locks.hold(uuid, "it is removed"):
            with self.station.lock("virtual"):  # so that no measurement starts with it meanwhile
                if self.measuring.measurement_of(uuid) is not None:
                    raise FrozenError(f"Node {uuid} is being measured.", hint="End the measurement first.")
                one = self.virtuals.forget(uuid)
            self.virtuals.end(one)
            self.directory.note(uuid, "left", present=False)
        self.directory.refresh()
