"""What ``teds-provision`` alone says comes next, and what it takes from a service that runs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli import start
from teds_provision.doctor import fleet
from teds_provision.doctor.checks import Finding
from teds_provision.errors import LinkError, UsageError
from teds_provision.measure.link_survey import LinkSurvey
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord, WhitelistEntry
from tests.bench import PASSPHRASE
from tests.cli.shell import call

ARM = {
    "uuid": "8d",
    "name": "arm",
    "link": "can:x",
    "whitelisted": True,
    "state": "provisioned",
    "verdict": "authentic",
}


def link(place: str, *, state: str = "up", nodes: int = 0) -> dict[str, Any]:
    return {"place": place, "state": state, "nodes": nodes, "why": None}


@pytest.mark.parametrize(
    ("links", "nodes", "following"),
    [
        ([link("can:x")], [], "doctor --can x"),
        ([link("can:y"), link("can:x", nodes=1)], [ARM], "measure arm"),
        ([link("can:y", state="down"), link("can:x", nodes=1)], [ARM], "doctor --can y"),
        ([link("can:x", nodes=1)], [{**ARM, "whitelisted": False}], "identify --add --can x"),
        ([link("can:x", nodes=1)], [{**ARM, "state": "factory"}], "provision --profile PROFILE --can x"),
        ([link("can:x", nodes=1)], [{**ARM, "verdict": None}], "verify arm --can x"),
        ([link("nfc:usb", state="listed")], [], "provision --profile PROFILE"),
        ([link("nfc:usb", state="listed"), link("can:x", state="listed")], [], "doctor"),
        ([], [], "config set can socketcan:can0"),
    ],
)
def test_a_fault_comes_before_new_boards_and_those_before_work(
    links: list[dict[str, Any]], nodes: list[dict[str, Any]], following: str
) -> None:
    """A bus on which nothing answers is a fault only where nothing answers anywhere."""
    assert start._next({"links": links, "nodes": nodes}) == f"teds-provision {following}"


def test_of_a_service_only_the_nodes_that_are_there_are_shown(station: Station) -> None:
    node = {**ARM, "verdict": {"verdict": "authentic"}, "address": 0x21}
    nodes = [{**node, "present": True}, {**node, "uuid": "8e", "present": False}]
    status = {"url": None, "measurements": [], "links": [{"place": "can:x", "nodes": 1, "problem": None}]}
    running = SimpleNamespace(status=lambda: status, nodes=lambda: nodes)
    app: Any = SimpleNamespace(running_service=lambda timeout: nullcontext(running))
    found = start._of_service(app, station)
    assert found is not None
    assert [node["uuid"] for node in found["nodes"]] == ["8d"]
    assert found["known"] == 2


ONE, TWO, NEW = (f"8d4d9da65281f700000{number}" for number in range(3))


@pytest.fixture
def cell(home: Path) -> Path:
    """Two nodes that are known: one is named and listed, one only met."""
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as store, store.transaction():
        store.nodes.restore(NodeRecord(bytes.fromhex(ONE), name="arm", state=2))
        store.nodes.restore(NodeRecord(bytes.fromhex(TWO), state=1))
        store.pins.put(WhitelistEntry(bytes.fromhex(ONE)))
    return home


def surveyed(monkeypatch: pytest.MonkeyPatch, *links: LinkSurvey, plugged: Sequence[str] = ()) -> list[list[str]]:
    """Have these links found; returns which places were asked."""
    asked: list[list[str]] = []

    def look(_station: Station, places: Sequence[str]) -> list[LinkSurvey]:
        asked.append(list(places))
        return list(links)

    monkeypatch.setattr(start, "look", look)
    monkeypatch.setattr(start, "readers", lambda: (LinkSurvey(place, "listed") for place in plugged))
    return asked


def who(uuid: str, state: NodeState, address: int) -> tuple[int, Identity]:
    return address, Identity(bytes.fromhex(uuid), state, 1, 2, 512, address)


def test_the_screen_and_its_json_have_all_that_was_found(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = (who(ONE, NodeState.PROVISIONED, 33), who(NEW, NodeState.FACTORY, 34))
    monkeypatch.setenv("TEDS_PROVISION_CAN", "socketcan:can0 socketcan:can1")
    asked = surveyed(
        monkeypatch,
        LinkSurvey("can:socketcan:can0", "up", nodes=nodes, troubles=("Two nodes at 0x21.",)),
        LinkSurvey("can:socketcan:can1", "down", "can1 is down.", "ip link set can1 up"),
        plugged=["nfc:usb:072f:2200"],
    )
    found = call(cell, "--json").json
    assert asked == [["can:socketcan:can0", "can:socketcan:can1"]]
    assert found["station"].keys() == {"name", "fingerprint", "keystore", "home"}
    assert (found["station"]["keystore"], found["station"]["home"]) == ("file", str(cell))
    assert {name: found[name] for name in ("links", "nodes", "known", "problems", "next")} == {
        "links": [
            {"place": "can:socketcan:can0", "state": "up", "nodes": 2, "why": None},
            {"place": "can:socketcan:can1", "state": "down", "nodes": 0, "why": "can1 is down."},
            {"place": "nfc:usb:072f:2200", "state": "listed", "nodes": 0, "why": None},
        ],
        "nodes": [
            {
                "uuid": ONE,
                "name": "arm",
                "link": "can:socketcan:can0",
                "address": 33,
                "state": "provisioned",
                "whitelisted": True,
                "verdict": None,
            },
            {
                "uuid": NEW,
                "name": None,
                "link": "can:socketcan:can0",
                "address": 34,
                "state": "factory",
                "whitelisted": False,
                "verdict": None,
            },
        ],
        "known": 2,
        "problems": [
            {"what": "can1 is down.", "fix": "ip link set can1 up"},
            {"what": "Two nodes at 0x21.", "fix": "teds-provision identify --via can --can socketcan:can0"},
        ],
        "next": "teds-provision doctor --can socketcan:can1",
    }
    key = found["station"]["fingerprint"][:16]
    assert call(cell).out.splitlines() == [
        f"Station {found['station']['name']}, key {key}, 2 nodes known",
        "  can:socketcan:can0: 2 nodes answer",
        "  can:socketcan:can1: can1 is down.",
        "  nfc:usb:072f:2200: waits for a tap",
        "uuid                  name  link                state        verdict",
        f"{ONE}  arm   can:socketcan:can0  provisioned  not verified",
        f"{NEW}        can:socketcan:can0  factory      not whitelisted",
        "! can1 is down.",
        "  → ip link set can1 up",
        "! Two nodes at 0x21.",
        "  → teds-provision identify --via can --can socketcan:can0",
        "Next: teds-provision doctor --can socketcan:can1",
        "All commands: teds-provision --help",
    ]


def test_what_is_named_is_asked_and_else_where_nodes_were_met(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Station.inspect(cell) as store:
        store.nodes.met_at(bytes.fromhex(TWO), "can:socketcan:can7")
    for variables, places, has_readers in (
        ({}, ["can:socketcan:can7"], True),
        ({"NFC": "usb"}, ["nfc:usb", "can:socketcan:can7"], False),
        ({"CAN": "socketcan:can0"}, ["can:socketcan:can0"], True),
        ({"BLE": "hci0", "CAN": "socketcan:can0"}, ["can:socketcan:can0", "ble:hci0"], True),
    ):
        with monkeypatch.context() as patch:
            for name, value in variables.items():
                patch.setenv(f"TEDS_PROVISION_{name}", value)
            asked = surveyed(patch, plugged=["nfc:tty"])
            found = call(cell, "--json").json
        assert [sorted(each) for each in asked] == [sorted(places)], variables
        assert bool(found["links"]) is has_readers, variables


def test_of_a_service_the_screen_has_its_page_links_and_nodes(station: Station) -> None:
    arm = {**ARM, "link": "can:x", "address": 33, "present": True, "verdict": {"verdict": "authentic", "checks": []}}
    new = {"uuid": "8f", "name": None, "link": "can:x", "state": "factory", "whitelisted": False, "verdict": None}
    trouble = {"code": "link", "message": "It is down.", "hint": "ip link set y up"}
    status = {
        "url": "http://127.0.0.1:8451",
        "measurements": [{"id": "1"}, {"id": "2"}],
        "links": [{"place": "can:x", "nodes": 2, "problem": None}, {"place": "can:y", "nodes": 0, "problem": trouble}],
    }
    nodes = [arm, {**new, "present": True}]
    running = SimpleNamespace(status=lambda: status, nodes=lambda: nodes)
    app: Any = SimpleNamespace(running_service=lambda timeout: nullcontext(running))
    found = start._of_service(app, station)
    assert found == {
        "station": {
            "name": station.name,
            "fingerprint": station.fingerprint,
            "keystore": station.identity.keystore,
            "home": str(station.home),
        },
        "ncap": {"url": "http://127.0.0.1:8451", "measurements": 2},
        "links": [
            {"place": "can:x", "state": "up", "nodes": 2, "why": None},
            {"place": "can:y", "state": "down", "nodes": 0, "why": "It is down."},
        ],
        "nodes": [{**ARM, "address": 33}, {**new, "address": None}],
        "known": 2,
        "problems": [{"what": "can:y: It is down.", "fix": "ip link set y up"}],
    }
    assert list(start._lines({**found, "next": "x"}))[1:] == [
        "ncap is running: http://127.0.0.1:8451",
        "  can:x: 2 nodes answer",
        "  can:y: It is down.",
        "uuid  name  link   state        verdict",
        "8d    arm   can:x  provisioned  authentic",
        "8f          can:x  factory      not whitelisted",
        "! can:y: It is down.",
        "  → ip link set y up",
        "Next: x",
        "All commands: teds-provision --help",
    ]


def test_without_a_station_its_readers_are_shown_and_with_one_what_waits(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    surveyed(monkeypatch, plugged=["nfc:usb"])
    assert call(tmp_path / "none", "--json").json == {
        "station": None,
        "links": [{"place": "nfc:usb", "state": "listed", "nodes": 0, "why": None}],
        "nodes": [],
        "problems": [],
        "next": "teds-provision init",
    }
    waiting = (Finding("a", "ok", "Nothing."), Finding("b", "warning", "One is due.", "Tap it."))
    monkeypatch.setattr(fleet, "nodes", lambda system: iter(waiting if system.home == home else ()))
    assert call(home, "--json").json["problems"] == [{"what": "One is due.", "fix": "Tap it."}]


def test_what_each_line_says_where_little_is_there() -> None:
    none: dict[str, Any] = {"station": None, "links": [], "nodes": [], "problems": [], "next": "teds-provision init"}
    assert list(start._lines(none)) == [
        "No station yet.",
        "  No reader is plugged in, and no bus is configured.",
        "Next: teds-provision init",
        "All commands: teds-provision --help",
    ]
    assert "ncap is running: without a page" in start._lines({**none, "ncap": {"url": None, "measurements": 0}})
    assert "! It is." in start._lines({**none, "problems": [{"what": "It is.", "fix": ""}]})
    assert "  → " not in start._lines({**none, "problems": [{"what": "It is.", "fix": ""}]})
    many = [{**ARM, "uuid": f"{number:02d}"} for number in range(22)]
    assert "  … and 2 more" in start._lines({**none, "nodes": many})
    assert not any("more" in line for line in start._lines({**none, "nodes": many[:20]}))
    for found, line in (
        (link("ble:hci0", state="listed"), "ble:hci0: waits for a connection"),
        (link("can:x"), "can:x: no node answers"),
        (link("can:x", nodes=1), "can:x: 1 node answers"),
    ):
        assert start._link_line(found) == line
    running = {"links": [], "nodes": [ARM], "ncap": {}}
    assert start._next(running) == "teds-provision ncap open"
    unnamed = {**ARM, "name": None, "link": "ble:hci0", "verdict": None}
    assert start._next({"links": [], "nodes": [unnamed]}) == "teds-provision verify 8d"
    assert start._next({"links": [], "nodes": [{**ARM, "name": "my arm"}]}) == "teds-provision measure 'my arm'"


@pytest.mark.parametrize("error", [LinkError("It ended."), ConnectionResetError(), UsageError("Its file is bad.")])
def test_a_service_that_ends_meanwhile_is_none(station: Station, error: Exception) -> None:
    def status() -> dict[str, Any]:
        raise error

    app: Any = SimpleNamespace(running_service=lambda timeout: nullcontext(SimpleNamespace(status=status)))
    assert start._of_service(app, station) is None
    app.running_service = lambda timeout: None
    assert start._of_service(app, station) is None


def test_on_the_first_screen_is_what_waits_for_a_person_and_nothing_that_is_good(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    findings = [
        Finding("nodes", "warning", "3 nodes wait.", "Do it."),
        Finding("nodes", "ok", "The others are good.", "x"),
        Finding("nodes", "skipped", "Not looked at.", "y"),
    ]
    found = {
        "station": {"name": "bench", "fingerprint": "ab" * 32},
        "links": [],
        "nodes": [],
        "problems": [],
        "known": 3,
    }
    monkeypatch.setattr(start, "_of_service", lambda *_words: dict(found, problems=[]))
    monkeypatch.setattr(start.fleet, "nodes", lambda _system: findings)
    assert call(home, "--json").json["problems"] == [{"what": "3 nodes wait.", "fix": "Do it."}]


def test_a_link_that_is_down_comes_before_one_that_is_silent() -> None:
    links = [link("can:silent"), link("can:down", state="down")]
    assert start._next({"links": links, "nodes": []}) == "teds-provision doctor --can down"


def test_of_several_nodes_the_first_that_needs_work_comes_next() -> None:
    bus = "can:udp_multicast:239.74.1.1?port=5"
    new = {**ARM, "uuid": "8e", "name": None, "state": "factory"}
    for nodes, following in (
        ([ARM, new], "provision --profile PROFILE --can x"),
        ([{**new, "whitelisted": False}, {**ARM, "verdict": None}], "identify --add --can x"),
        ([ARM, {**ARM, "name": "my arm", "verdict": None}], "verify 'my arm' --can x"),
        ([{**ARM, "link": bus, "verdict": None}], "verify arm --can 'udp_multicast:239.74.1.1?port=5'"),
        ([{**ARM, "name": None}, {**ARM, "name": "leg"}], "measure 8d"),
    ):
        assert start._next({"links": [link("can:x", nodes=2)], "nodes": nodes}) == f"teds-provision {following}"
    down = [link("ble:hci0?address=C1", state="down"), link("can:x", state="down")]
    assert start._next({"links": down, "nodes": []}) == "teds-provision doctor --ble 'hci0?address=C1'"
