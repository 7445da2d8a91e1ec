"""Stations of one owner in folders of their own, and a folder that carries between them."""

from __future__ import annotations

from pathlib import Path

from teds_provision import plant
from teds_provision.handover import trust
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sync import SyncResult, sync
from teds_provision.protocol.plant.document import MemberRequest
from teds_provision.protocol.plant.roster import Role, Roster
from teds_provision.station.station import Station, initialise
from teds_provision.vault import passphrase
from tests.bench import PASSPHRASE
from tests.plant.plants import NOW

LOGIN = "SCRAM-SHA-256$4096:" + "A" * 22 + "==$" + "B" * 43 + "=:" + "C" * 43 + "="


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


def owner(home: Path, name: str = "north") -> Station:
    """Return a station with the owner's CA key."""
    return initialise(home, name=name, keystore="file", ask=ask, costs=passphrase.THROWAWAY)[0]


def certified(home: Path, name: str, by: Station) -> Station:
    """Return a station whose key that CA signed; it has no CA key of its own."""
    request = trust.read_request(trust.ask_for_certificate(home, name=name, keystore="file", ask=ask))
    certificate = trust.sign_request(by, request)
    return trust.adopt_certificate(home, certificate, ask=ask)


def request_of(station: Station) -> MemberRequest:
    return MemberRequest(station.name, station.point, station.identity.signature, LOGIN, NOW)


class Plant:
    """An owner and other stations, joined to one registry; ``folder`` is the stick between them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stick = folder / "stick"
        self.stick.mkdir()
        self.north = owner(folder / "north")
        self.roster, _ = plant.owner.create(self.north, "plant Augsburg")
        self.stations = [self.north]

    def member(self, name: str, *roles: Role) -> Station:
        """Return one more station, added by the owner and joined; the roster reaches others at their next sync."""
        station = certified(self.folder / name, name, self.north)
        self.change(plant.owner.add(self.north, request_of(station), frozenset(roles)))
        assert self.north.plant.roster is not None
        plant.owner.join(station, self.north.plant.roster, url=None, events=list(plant.backlog.backlog(station)))
        self.stations.append(station)
        return station

    def change(self, draft: Roster) -> None:
        """The owner signs a version, which counts for him at once."""
        plant.apply_pages.put_roster(self.north, plant.owner.signed(self.north, draft))

    def sync(self, station: Station, stick: Path | None = None) -> SyncResult:
        return sync(station, FolderTransport(stick or self.stick))

    def round(self) -> None:
        """Everybody syncs, twice: what the last one said reaches the first."""
        for station in self.stations * 2:
            self.sync(station)

    def close(self) -> None:
        for station in self.stations:
            station.close()
