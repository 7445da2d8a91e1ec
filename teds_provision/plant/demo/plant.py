"""Three stations of one owner and their registry: from the roster to a stolen station whose datasheet is refused.

The registry is a PostgreSQL for the demo if Debian's server is installed, else a folder. Stations, database and a
virtual board (a process, on a CAN bus over multicast) are gone at the end.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Final

from teds_provision.demo.story import PROFILE, Demo, provision_over, temporary_demo, virtual_node
from teds_provision.errors import NotAuthenticError
from teds_provision.handover import trust
from teds_provision.links.ports import free_port
from teds_provision.plant import (
    apply_pages,
    backlog,
    connecting,
    folder_transport,
    membership,
    owner,
    schema,
    status,
    sync,
)
from teds_provision.plant.demo import cluster
from teds_provision.plant.transport import Transport
from teds_provision.protocol.plant.document import open_request
from teds_provision.protocol.plant.roster import Role, Roster, Share
from teds_provision.provisioning.agree import session_if_keyed
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.progress import Reporter, StepResult
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.station.station import Station, initialise
from teds_provision.vault.passphrase import THROWAWAY

_DATABASE: Final = "plant"
_ROLES: Final[dict[str, frozenset[Role]]] = {
    "west": frozenset({"line", "sign"}),
    "south": frozenset({"base"}),
}


@dataclass(frozen=True)
class PlantDemoResult:
    """The steps, by what the stations met (``postgresql`` or ``files``), and the verdict before and after the theft."""

    steps: tuple[StepResult, ...]
    by: str
    before: str
    after: str
    seconds: float


def run_plant_demo(reporter: Reporter, say: Callable[[str], None]) -> PlantDemoResult:
    """Run it; raises whatever a step raises. The folder is gone afterwards, however it ends."""
    with temporary_demo(reporter, say, mode=0o755) as demo:  # the server runs as another user
        return _Story(demo).run()


class _Story:
    """The demo's stations and what carries between them."""

    def __init__(self, demo: Demo) -> None:
        self.demo = demo
        self.bin = None if find_spec("psycopg") is None else cluster.programs()
        self.stations: dict[str, Station] = {}
        self.server: cluster.Cluster | None = None
        self.places = demo.folder / "homes"
        self.places.mkdir(mode=0o700)
        self.secret = secrets.token_hex(16)

    def run(self) -> PlantDemoResult:
        demo, began = self.demo, time.monotonic()
        if self.bin is None:
            lacks = "PostgreSQL 15" if find_spec("psycopg") is not None else "psycopg (the extra registry)"
            demo.say(f"No {lacks} is installed here, so the stations exchange pages through a folder, as with a stick.")
        else:
            demo.say(
                "A PostgreSQL server of the demo's own, with TLS and its own port; the system's server is not touched."
            )
            with demo.steps.step("start database") as step:
                made = cluster.running(demo.folder / "postgresql", free_port(), self.bin)
                self.server = demo.stack.enter_context(made)
                step.detail = f"port {self.server.port}, as user {cluster.runs_as()}"
        demo.say("Station north has the owner's CA key and creates the roster; west and south ask to join.")
        self._set_up()
        demo.say("West, on the line, provisions a board. Its key is shared with south, which has never seen the board.")
        demo.uuid = demo.stack.enter_context(virtual_node(demo, "board", PROFILE))
        provision_over(demo, self["west"], "can", demo.uuid, BuildOrder(PROFILE, name="joint 1"))
        self._sync("west", "south", "west")
        before = self._verdict("verify")
        demo.say(
            "West is stolen. North removes it: what it signed before stays valid, what it signs from now on"
            " does not count."
        )
        self._stolen()
        with demo.steps.step("thief") as step:
            provision_over(demo, self["west"], "can", demo.uuid, BuildOrder(PROFILE, name="joint 1, forged"))
            step.detail = "the thief signs and writes another datasheet with west's key"
        after = self._verdict("verify")
        if (before, after) != ("authentic", "not authentic"):
            raise NotAuthenticError(f"South found the board {before} before the theft and {after} after it.")
        by = "files" if self.server is None else "postgresql"
        return PlantDemoResult(tuple(demo.steps.done), by, before, after, time.monotonic() - began)

    def __getitem__(self, name: str) -> Station:
        return self.stations[name]

    # -- parts -------------------------------------------------------------------------------------------------------

    def _set_up(self) -> None:
        demo = self.demo
        with demo.steps.step("init") as step:
            north, _ = initialise(self.places / "north", name="north", keystore="file", ask=self._ask, costs=THROWAWAY)
            self._keep("north", north)
            for name in _ROLES:
                request = trust.ask_for_certificate(self.places / name, name=name, keystore="file", ask=self._ask)
                certificate = trust.sign_request(north, trust.read_request(request))
                self._keep(name, trust.adopt_certificate(self.places / name, certificate, ask=self._ask))
            step.detail = "north, west, south, under one CA"
        with demo.steps.step("registry create") as step:
            roster, _ = owner.create(north, "demo plant")
            step.detail = f"registry {roster.registry[:8]}, north is keeper, sign, line, base"
        if self.server is not None:
            with demo.steps.step("registry sql") as step:
                self.server.psql(f"create database {_DATABASE}")
                self.server.psql(schema.registry_sql(roster.registry), _DATABASE)
                step.detail = "the schema, by the database's superuser"
        self._login(north)
        for name, roles in _ROLES.items():
            with demo.steps.step("registry add") as step:
                self._change(owner.add(north, self._login(self[name]), roles))
                step.detail = f"{name} as {' '.join(sorted(roles))}"
        with demo.steps.step("registry share") as step:
            self._change(owner.shared(north, Share(("all", ""), (self["south"].fingerprint,))))
            step.detail = "every key goes to south automatically"
        for name in ("north", *_ROLES):
            with demo.steps.step("registry connect") as step:
                self._sync("north", show=False)
                station = self[name]
                transport = self._transport(station)
                found = membership.found_roster(station, transport, None)
                transport.close()
                owner.join(station, found, url=None, events=list(backlog.backlog(station)))
                step.detail = f"{name}, roster {found.version}"

    def _stolen(self) -> None:
        north, west = self["north"], self["west"]
        self._sync("north")
        with self.demo.steps.step("registry remove") as step:
            last = status.page_list(north, west.fingerprint)[0][0]
            self._change(owner.draft_removal(north, "west", "stolen", last))
            if self.server is not None:
                self.server.psql(schema.close_sql(west.fingerprint), _DATABASE)
            step.detail = f"west, stolen; its pages up to {last} count"
        self._sync("north", "south")

    def _verdict(self, what: str) -> str:
        demo, south = self.demo, self["south"]
        with demo.steps.step(what) as step:
            with meet(south, demo.over("can"), demo.uuid, demo.reporter) as node:
                who = identify(south, node)
                session_if_keyed(south, node)
                verified = judge_and_keep(south, node, read_image(node), who.point).verified
            wrong = next((check.why for check in verified.checks if check.result == "failed"), "")
            step.detail = f"south finds it {verified.verdict}{f': {wrong}' if wrong else ''}"
        return verified.verdict

    def _sync(self, *names: str, show: bool = True) -> None:
        for name in names:
            transport = self._transport(self[name])
            try:
                if not show:
                    sync.sync(self[name], transport)
                    continue
                with self.demo.steps.step("registry sync") as step:
                    done = sync.sync(self[name], transport)
                    parcels = f", {done.parcels_out} parcels out, {done.parcels_in} in"
                    moved = parcels if done.parcels_in or done.parcels_out else ""
                    step.detail = f"{name}: {done.pushed} pages out, {done.fetched} in{moved}"
            finally:
                transport.close()

    def _transport(self, station: Station) -> Transport:
        if self.server is None:
            folder = self.demo.folder / "stick"
            folder.mkdir(exist_ok=True)
            return folder_transport.FolderTransport(folder)
        return connecting.database(station, self.server.url(_DATABASE))

    def _login(self, station: Station) -> Any:
        """Make the station's request, and its login at the database."""
        asked = open_request(membership.request(station))
        if self.server is not None:
            self.server.psql(schema.member_sql(asked.fingerprint, asked.login), _DATABASE)
        return asked

    def _change(self, draft: Roster) -> None:
        apply_pages.put_roster(self["north"], owner.signed(self["north"], draft))

    def _keep(self, name: str, station: Station) -> None:
        self.stations[name] = station
        self.demo.stack.callback(station.close)

    def _ask(self, prompt: str, confirm: bool) -> str:
        return self.secret
