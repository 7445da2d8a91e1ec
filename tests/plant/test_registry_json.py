"""The JSON of every ``registry`` command, whole (contract/plant.md section 8), from `create` to `disconnect`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant.document import MemberRequest
from teds_provision.protocol.plant.roster import open_roster
from teds_provision.station.station import Station
from tests.bench import make_station
from tests.cli.shell import call
from tests.plant.stations import LOGIN

WEST = SoftwareKey(8080)


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "north", "north")
    yield made
    made.close()


class Owner:
    """The owner at his station: a command and its JSON."""

    def __init__(self, station: Station, folder: Path) -> None:
        self.station, self.folder = station, folder

    def ask(self, *words: object, code: int = 0) -> dict[str, Any]:
        done = call(self.station.home, "--json", "registry", *words)
        assert done.code == code, (done.code, done.out, done.err)
        answer: dict[str, Any] = json.loads(done.out)
        return answer

    def request(self) -> Path:
        """Return the file of another station's request."""
        self.station.unlock()
        ca = self.station.vault.ca()
        assert ca is not None
        signed = ca.sign(station_key_message(WEST.point))
        asked = MemberRequest("west", WEST.point, signed, LOGIN, datetime.now(UTC).replace(microsecond=0))
        path = self.folder / "west.request"
        path.write_bytes(asked.signed(WEST) + b"\n")
        return path


def test_every_command_answers_with_the_keys_of_the_contract(station: Station, tmp_path: Path) -> None:
    owner, me, west = Owner(station, tmp_path), station.fingerprint, fingerprint(WEST.point)
    plan = owner.ask("create", "--name", "plant", "--dry-run")
    registry = plan.pop("registry")
    north = {"name": "north", "fingerprint": me, "roles": ["keeper", "line", "sign", "base"]}
    ends = plan.pop("expires")
    assert plan == {
        "name": "plant", "version": 1, "members": [north], "removed": [], "share": [], "roster": None, "events": 0,
        "plan": True,
    }  # fmt: skip
    assert timedelta(days=89) < datetime.fromisoformat(ends) - datetime.now(UTC) <= timedelta(days=90)
    assert station.plant.joined is None, "a plan changes nothing"
    made = owner.ask("create", "--name", "plant", "--yes", "--output", tmp_path / "roster.jws")
    assert made["registry"] != registry
    registry, roster = made["registry"], open_roster(made["roster"].encode(), station.ca)
    assert made == {
        "registry": registry, "name": "plant", "version": 1, "members": [north], "removed": [], "share": [],
        "expires": f"{roster.expires:%Y-%m-%dT%H:%M:%SZ}", "roster": roster.octets.decode(), "events": 0,
    }  # fmt: skip
    assert (tmp_path / "roster.jws").read_bytes() == roster.octets + b"\n"

    asked = owner.ask("request", "--output", tmp_path / "north.request")
    assert asked == {"request": str(tmp_path / "north.request"), "fingerprint": me, "role": f"teds_{me[:16]}"}

    whole = {"registry": registry, "name": "plant", "removed": [], "share": [], "expires": made["expires"]}
    line = {"name": "west", "fingerprint": west, "roles": ["line", "sign"]}
    file = owner.request()
    draft = tmp_path / "draft"
    words = ("add", file, "--role", "sign", "--role", "line")
    assert owner.ask(*words, "--draft", draft) == {
        **whole, "version": 2, "members": [north, line], "plan": False, "draft": str(draft)
    }  # fmt: skip
    assert owner.ask(*words, "--dry-run") == {
        **whole, "version": 2, "members": [north, line], "plan": True, "draft": None
    }  # fmt: skip
    assert owner.ask(*words, "--yes") == {**whole, "version": 2, "members": [north, line]}
    assert owner.ask(*words, "--yes") == {**whole, "version": 2, "members": [north, line]}, "nothing to do"
    base = {**line, "roles": ["line", "base"]}
    assert owner.ask("role", "west", "base", "line", "--yes") == {**whole, "version": 3, "members": [north, base]}
    share = [{"what": {"group": "hand"}, "to": [west], "forget": True}]
    assert owner.ask("share", "--group", "hand", "--to", "west", "--forget", "--yes") == {
        **whole, "version": 4, "members": [north, base], "share": share
    }  # fmt: skip
    everything = {"what": {"all": True}, "to": [west], "forget": False}
    assert owner.ask("share", "--all", "--to", "west", "--yes")["share"] == [*share, everything]
    assert owner.ask("unshare", "--group", "hand", "--yes")["share"] == [everything]
    gone = {"name": "west", "fingerprint": west, "why": "lost", "last": 0}
    assert owner.ask("remove", "west", "--lost", "--last", "0", "--yes") == {
        **whole, "version": 7, "members": [north], "removed": [gone]
    }  # fmt: skip
    renewed = owner.ask("renew", "--days", "30", "--yes")
    assert renewed["version"] == 8
    assert timedelta(days=29) < datetime.fromisoformat(renewed["expires"]) - datetime.now(UTC) <= timedelta(days=30)

    for options in (("--close", "north"), ("--mend", "north", "3"), ()):
        assert set(owner.ask("sql", *options)) == {"sql"}
    assert call(station.home, "registry", "sql", "--member", file).code == 6, "a removed key gets no login"

    stick = tmp_path / "stick"
    stick.mkdir()
    joined = {"registry": registry, "version": 8, "events": 0}
    assert owner.ask("connect", "--files", stick, "--dry-run") == {**joined, "plan": True}
    assert owner.ask("connect", "--files", stick, "--yes") == joined
    station.plant.record_event("named", bytes(10), name="left")
    assert owner.ask("sync") == {
        "pushed": 1, "fetched": 0, "returned": 0, "parcels": {"in": 0, "out": 0, "waiting": 0}, "alarms": [],
        "told": [], "rosters": [], "open_doors": [],
    }  # fmt: skip
    [told] = owner.ask("log")["events"]
    assert {name: told[name] for name in told if name not in ("id", "at")} == {
        "act": "named", "uuid": "00" * 10, "name": "left", "station": "north", "fingerprint_of_station": me, "page": 1,
        "counts": True,
    }  # fmt: skip
    shown = owner.ask("status")
    assert list(shown) == [
        "registry", "name", "roster", "expires", "members", "unsent", "synced", "conflicts", "alarms", "to_rotate",
        "heads", "open_doors",
    ]  # fmt: skip
    assert (shown["unsent"], shown["roster"], shown["heads"][1]) == (0, 8, 1)
    assert owner.ask("seen") == {"done": 0}
    assert owner.ask("vouch", "--all") == {"nodes": [], "done": 0}
    assert owner.ask("resume", "--dry-run") == {"done": 0, "adopts": 0, "plan": True}
    assert owner.ask("resume", "--yes") == {"done": 0}
    assert owner.ask("disconnect", "--dry-run") == {"registry": registry, "plan": True}
    assert owner.ask("disconnect", "--yes") == {"registry": registry}
