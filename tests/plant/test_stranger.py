"""Somebody with `psql` and the C tool `jose` alone reads the registry, and comes to the claims that a station has."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.plant.demo.cluster import Cluster
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.handing import board_of
from tests.plant.test_synced_by_database import Office

pytestmark = pytest.mark.system


@pytest.fixture
def office(tmp_path: Path, cluster: Cluster) -> Iterator[Office]:
    made = Office(tmp_path, cluster)
    yield made
    made.plant.close()


def base64url(octets: bytes) -> str:
    return base64.urlsafe_b64encode(octets).rstrip(b"=").decode()


class Stranger:
    """Nothing of the program: rows of the database, and keys that he was told."""

    def __init__(self, office: Office, folder: Path) -> None:
        self.office, self.folder = office, folder
        self.keys: dict[str, bytes] = {}

    def opened(self, jws: str, point: bytes) -> dict[str, Any]:
        """Return the payload of a compact JWS that this key signed; `jose` ends non-zero for any other."""
        jwk = {"kty": "EC", "crv": "P-256", "x": base64url(point[1:33]), "y": base64url(point[33:])}
        (self.folder / "jws").write_text(jws)
        (self.folder / "jwk").write_text(json.dumps(jwk))
        words = ["jose", "jws", "ver", "-i", str(self.folder / "jws"), "-k", str(self.folder / "jwk"), "-O", "-"]
        return dict(json.loads(subprocess.run(words, capture_output=True, timeout=60, check=True).stdout))

    def roster(self, ca: bytes) -> dict[str, Any]:
        (row,) = self.office.database.sql("select jws from registry.roster order by version desc limit 1")
        found = self.opened(row[0], ca)
        for member in found["members"]:
            point = bytes.fromhex(member["point"])
            self.keys[hashlib.sha256(point).hexdigest()] = point
        return found

    def events(self) -> dict[str, list[dict[str, Any]]]:
        """Return what each station said, page after page, each the next one's `previous` by its H."""
        statements: dict[str, list[dict[str, Any]]] = {}
        last = dict.fromkeys(self.keys, "")
        for station, number, jws in self.office.database.sql(
            "select encode(station, 'hex'), n, jws from registry.page order by station, n"
        ):
            page = self.opened(jws, self.keys[station])
            assert (page["station"], page["n"], page["previous"]) == (station, int(number), last[station])
            last[station] = hashlib.sha256(jws.rpartition(".")[0].encode()).hexdigest()
            statements.setdefault(station, []).extend(page["events"])
        return statements


def test_who_has_psql_and_jose_alone_comes_to_the_same_claims(office: Office, tmp_path: Path) -> None:
    if shutil.which("jose") is None:
        pytest.skip("the Debian package jose is not installed (scripts/install-test-packages)")
    south = office.member("south", "base")
    boards = [board_of(office.north, os.urandom(10)) for _ in range(3)]
    office.sync(office.north, south)
    office.north.pins.remove(boards[0].uuid)
    south.pins.put(WhitelistEntry(boards[1].uuid, "f" * 64, assurance="uuid"))
    office.sync(south, office.north, south)

    stranger = Stranger(office, tmp_path)
    roster = stranger.roster(office.north.identity.ca)
    assert {member["name"] for member in roster["members"]} == {"north", "south"}
    pins: dict[tuple[str, str], str | None] = {}
    keys: dict[tuple[str, str], tuple[int, str]] = {}
    for station, events in stranger.events().items():
        for event in events:
            place = (event.get("uuid", ""), station)
            if event["act"] in ("pinned", "unpinned"):
                pins[place] = event.get("fingerprint")
            elif event["act"] in ("agreed", "took"):
                keys[place] = max(keys.get(place, (-1, "")), (event["epoch"], event["key_id"]))
    claimed = south.plant.claims.of_nodes([board.uuid for board in boards])
    for board in boards:
        for station, text in claimed[board.uuid].items():
            claim, place = json.loads(text), (board.uuid.hex(), station)
            assert (claim.get("pin") or [None])[0] == pins.get(place)
            assert tuple(claim.get("agreed", ())[:2]) == keys.get(place, ())
    assert pins[boards[0].uuid.hex(), office.north.fingerprint] is None
    assert pins[boards[1].uuid.hex(), south.fingerprint] == "f" * 64
