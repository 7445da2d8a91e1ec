"""Stations of one owner in this process: one CA, a roster, and a post that lies in memory."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from teds_provision.handover import trust
from teds_provision.plant.transport import CarriedPage, Parcel
from teds_provision.protocol.keys import PrivateKey, node_key_message, station_key_message
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.merged_claims import LocalState, MergedClaims, merge_claims
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, Share, open_roster, seal_roster
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.station.plant.plant import PlantRecord, RosterRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry, utc_now
from tests.bench import PASSPHRASE, Board, make_station, talk

REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


@dataclass
class MemoryTransport:
    """A post office in memory: what one station sends lies there for the other."""

    carries_all: bool = False
    where: str = "memory"
    there: dict[str, Parcel] = field(default_factory=dict)
    full: bool = False

    def registry(self) -> str | None:
        return REGISTRY

    def rosters(self) -> Iterator[bytes]:
        return iter(())

    def post_roster(self, version: int, hash: str, octets: bytes) -> None:
        return None

    def heads(self) -> Mapping[str, int]:
        return {}

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        return iter(())

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        return None

    def parcels(self, to: str) -> Iterator[Parcel]:
        yield from [parcel for parcel in self.there.values() if parcel.to == to]

    def send(self, parcel: Parcel) -> None:
        from teds_provision.errors import PolicyError

        if self.full:
            raise PolicyError("full")
        self.there.setdefault(parcel.id, parcel)

    def drop(self, parcel: str, to: str) -> None:
        self.there.pop(parcel, None)

    def close(self) -> None:
        return None


class Plant:
    """Stations of one owner: the first has the CA key; all have joined, and hear all that any of them told."""

    def __init__(self, folder: Path, *names: str) -> None:
        self.stack = ExitStack()
        first = make_station(folder / names[0], names[0])
        self.stations = {names[0]: first}
        self.stack.callback(first.close)
        for name in names[1:]:
            home = folder / name
            request = trust.ask_for_certificate(home, name=name, keystore="file", ask=ask)
            certificate = trust.sign_request(first, trust.read_request(request))
            made = trust.adopt_certificate(home, certificate, ask=ask)
            self.stack.callback(made.close)
            self.stations[name] = made
        self.transport = MemoryTransport()
        self.deaf: set[str] = set()
        """Stations whose pages nobody has."""
        self.roster_ = Roster(
            REGISTRY,
            "plant",
            0,
            "",
            datetime.now(UTC).replace(microsecond=0),
            datetime.now(UTC).replace(microsecond=0) + timedelta(days=90),
            (),
        )

    def __getitem__(self, name: str) -> Station:
        return self.stations[name]

    @property
    def ca(self) -> PrivateKey:
        found = next(iter(self.stations.values())).vault.ca()
        assert found is not None
        return found

    def roster(
        self,
        roles: Mapping[str, str],
        *share: Share,
        removed: Mapping[str, tuple[int, str]] = {},
        days: int = 90,
    ) -> Roster:
        """The next roster, by the names of stations and their roles; every station of it takes it."""
        before = self.roster_
        made = datetime.now(UTC).replace(microsecond=0) - timedelta(days=1)
        draft = replace(
            before,
            version=before.version + 1,
            previous=before.hash,
            created=made,
            expires=made + timedelta(days=days),
            members=tuple(
                Member(
                    name,
                    self[name].point,
                    self.ca.sign(station_key_message(self[name].point)),
                    frozenset(words.split()),
                )
                for name, words in roles.items()
            ),
            removed=tuple(
                RemovedMember(name, self[name].point, frozenset({"base"}), "stolen", last)
                for name, last in removed.items()
            ),
            share=share,
        )
        octets = seal_roster(draft, self.ca)
        self.roster_ = open_roster(octets, self.ca.point)
        for name in roles:
            station = self[name]
            with station.transaction():
                station.plant.put_record(PlantRecord(REGISTRY))
                station.plant.put_roster(RosterRow(self.roster_.version, self.roster_.hash, octets, True, utc_now()))
        return self.roster_

    def trusted(self) -> None:
        """Have all trust each other, as the roster does."""
        for station in self.stations.values():
            for name, other in self.stations.items():
                if other is not station and not any(
                    trusted.point == other.point for trusted in station.policy.trusted()
                ):
                    path = station.home.parent / f"{name}.pem"
                    from teds_provision.protocol.keys import to_pem

                    path.write_text(to_pem(other.point))
                    trust.add(station, [trust.candidate(station, name, path, "station")])

    def views(self, name: str):  # type: ignore[no-untyped-def]
        """Return what a station knows of nodes: every event that anybody told who is not ``deaf``."""

        def see(uuid: bytes) -> MergedClaims:
            claims: dict[str, Claim] = {}
            for word, station in self.stations.items():
                if word in self.deaf and word != name:
                    continue
                for _, _, text in station.plant.outbox(10_000):
                    event_read = event.read(json.loads(text))
                    if isinstance(event_read, event.Event) and event_read.uuid == uuid:
                        claims.setdefault(station.fingerprint, Claim()).apply_event(event_read)
            own = self[name]
            pin = own.pins.pinned(uuid)
            return merge_claims(self.roster_, claims, LocalState(own.fingerprint, pin, "tap" if pin else "", bool(pin)))

        return lambda uuids: {uuid: see(uuid) for uuid in uuids}

    def close(self) -> None:
        self.stack.close()


def keyed(station: Station, board: Board) -> None:
    """The station meets the board, pins its key and agrees on a link key."""
    with talk(board) as node:
        who = identify(station, node)
        agree(station, node, who, newcomer=WhitelistEntry(node.uuid, who.fingerprint, utc_now(), "tap", None))
    members = {"fingerprint": who.fingerprint}
    keys = station.keys.keys_of(board.uuid)
    with station.transaction():
        station.plant.record_event("pinned", board.uuid, assurance="tap", **members)
        station.plant.record_event("agreed", board.uuid, epoch=keys[-1].epoch, key_id=keys[-1].key_id, **members)


def board_of(station: Station, uuid: bytes) -> Board:
    """Return a board that a station has keyed."""
    board = Board(uuid)
    assert board.key.sign(node_key_message(uuid, board.key.point))
    keyed(station, board)
    return board
