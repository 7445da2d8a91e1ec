"""A vault that is changed beside a running `ncap`: it gets the new master key, or reports that it is locked."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from teds_provision.client import Client
from teds_provision.vault import master_socket
from tests.bench import PASSPHRASE
from tests.cli.shell import call, set_passphrase
from tests.e2e.desk import Desk
from tests.ncap.service import Service, virtual
from tests.pace import until

pytestmark = pytest.mark.link

NEW = "four other random words"


@pytest.fixture
def running(desk: Desk) -> Iterator[Service]:
    """Yield a daemon of a home that each test may change."""
    service = Service(desk, desk.station())
    yield service.start()
    service.end()


def measured_in_a_new_session(asked: Client, uuid: str) -> dict[str, Any]:
    """End what is measured of a node, measure it again, and wait for its values."""
    for measurement in asked.request("GET", "/measurements")["measurements"]:
        asked.end_measurement(measurement["id"])
    until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") is None)
    asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})

    def running() -> dict[str, Any] | None:
        node = asked.node(uuid)
        return node if (node["measuring"] or {}).get("state") == "running" else None

    return dict(until(running))


def events_of(service: Service, event: str) -> list[dict[str, Any]]:
    """Return events of one kind that the daemon has printed."""
    assert service.process is not None
    while service.process.read(0.3):
        pass
    lines = service.process.out.split("\n")[:-1]
    return [line for line in map(json.loads, lines) if line.get("event") == event]


def lock_out(service: Service) -> None:
    """Change passphrase and master key so that the running daemon cannot open the vault."""
    home, asked = service.station.home, service.client()
    (home / master_socket.SOCKET).unlink()  # the new key cannot be handed over
    assert set_passphrase(home, PASSPHRASE, NEW).code == 0
    assert call(home, "vault", "rewrap", passphrase=NEW).code == 0
    until(lambda: asked.status()["vault"]["state"] == "locked")


def test_a_new_passphrase_and_two_new_master_keys_do_not_lock_a_running_ncap(running: Service) -> None:
    home, asked = running.station.home, running.client()
    hand = virtual(running)
    assert set_passphrase(home, PASSPHRASE, NEW).code == 0
    measured_in_a_new_session(asked, hand)
    for _ in range(2):
        assert call(home, "vault", "rewrap", passphrase=NEW).code == 0
        measured_in_a_new_session(asked, hand)
    made = virtual(running, name="other")
    assert call(home, "--json", "sample", made, passphrase=NEW).code in (0, 5), "the key that ncap made opens"
    assert asked.status()["vault"] == {"state": "open", "problem": None}
    assert not events_of(running, "vault")


def test_an_ncap_that_is_locked_out_says_so_and_returns_to_work_when_unlocked(running: Service) -> None:
    home, asked = running.station.home, running.client()
    hand = virtual(running)
    lock_out(running)
    locked = until(lambda: (found := asked.status()["vault"])["state"] == "locked" and found)
    assert locked["problem"]["code"] == "vault-locked"
    assert "unlock" in locked["problem"]["hint"]
    assert "The vault is locked" in call(home, "ncap", "status").out
    assert asked.node(hand)["uuid"] == hand, "it stays up"
    try:
        assert call(home, "unlock", "--for", "5m", passphrase=NEW).code == 0
        until(lambda: asked.status()["vault"]["state"] == "open")
        measured_in_a_new_session(asked, hand)
    finally:
        call(home, "lock")
    until(lambda: [line["state"] for line in events_of(running, "vault")] == ["locked", "open"])


def test_nodes_of_a_locked_ncap_wait_quietly_and_are_measured_again_when_it_is_unlocked(running: Service) -> None:
    home, asked = running.station.home, running.client()
    nodes = [virtual(running), virtual(running, name="other")]
    lock_out(running)
    asked.request("POST", "/measurements", {"uuids": nodes[:1], "rate": 20})
    asked.request("POST", "/measurements", {"match": "name:other", "rate": 20})

    def in_state(state: str, why: str) -> bool:
        reports = [asked.node(uuid)["measuring"] or {"state": "none", "why": ""} for uuid in nodes]
        return all(report["state"] == state and why in report["why"] for report in reports)

    until(lambda: in_state("waiting", "changed by another command"))
    before = len(events_of(running, "node"))
    for _ in range(3):  # each answer of a node is a reason to try it again
        asked.discover()
        events_of(running, "node")
    assert in_state("waiting", "changed by another command")
    assert {line["state"] for line in events_of(running, "node")[before:]} == {"came"}
    assert all("changed by another command" in asked.node(uuid)["problem"]["message"] for uuid in nodes)
    assert call(home, "ncap", "status").out.count("authentic (of its last session: the vault is locked)") == 2
    try:
        assert call(home, "unlock", "--for", "5m", passphrase=NEW).code == 0
        until(lambda: in_state("running", ""))
    finally:
        call(home, "lock")
    assert "its last session" not in call(home, "ncap", "status").out
    until(lambda: [line["state"] for line in events_of(running, "vault")] == ["locked", "open"])


def test_no_one_without_a_key_of_this_store_changes_the_master_keys(running: Service) -> None:
    home, asked = running.station.home, running.client()
    hand = virtual(running)
    foreign = master_socket.MasterKeys.generate()
    assert master_socket.hand_over(home, foreign) is False, "number 1 is another key here"
    assert master_socket.hand_over(home, foreign.with_new().newest_only()) is False
    measured_in_a_new_session(asked, hand)
