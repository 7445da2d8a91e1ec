"""Who listens to /live: each token has its own share of the places, and ends with its token."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from teds_provision.ncap.live import Live
from teds_provision.ncap.waits import USUAL
from teds_provision.ncap.web.app import MOST_LISTENERS, OF_ONE_TOKEN, LiveSlots
from teds_provision.ncap.web.tokens import Tokens, digest_of
from teds_provision.station.store.lock import StoreLock
from tests.ncap.service import Service, described, virtual
from tests.ncap.test_guard import cookie_of
from tests.pace import PATIENCE, until


def test_one_token_never_takes_all_places() -> None:
    places = LiveSlots()
    assert sum(places.acquire("greedy", lambda: None) for _ in range(3 * MOST_LISTENERS)) == OF_ONE_TOKEN
    assert OF_ONE_TOKEN < MOST_LISTENERS
    assert places.acquire("other", lambda: None)


def test_if_all_are_taken_the_one_that_has_most_gives_its_newest_up() -> None:
    places, left = LiveSlots(most=6, of_one=3), list[str]()

    def leaves(name: str) -> Any:
        return lambda: left.append(name)

    assert all(places.acquire("a", leaves(f"a{number}")) for number in range(3))
    assert all(places.acquire("b", leaves(f"b{number}")) for number in range(3))
    assert not places.acquire("a", leaves("a3"))
    assert places.acquire("c", leaves("c0"))
    assert places.acquire("c", leaves("c1"))
    assert sorted(left) == ["a2", "b2"]
    assert not places.acquire("c", leaves("c2")), "two each is an even share"
    newest = leaves("d0")
    assert places.acquire("d", newest)
    assert len(left) == 3
    places.release("d", newest)
    places.release("d", newest)
    assert places.acquire("d", newest), "a place that was given back is free"
    assert len(left) == 3


def test_a_place_is_not_taken_from_who_would_then_have_fewer() -> None:
    """Two tokens would take one place from each other for ever, each time with a new connection."""
    places, left = LiveSlots(most=3, of_one=3), list[str]()
    for token in ("a", "a", "b"):
        assert places.acquire(token, lambda token=token: left.append(token))
    assert not places.acquire("b", lambda: None)
    assert left == []


def test_a_token_that_is_over_is_good_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = Tokens(tmp_path)
    cookie = tokens.login(tokens.login_link().rpartition("=")[2])
    assert cookie is not None
    assert tokens.is_good(digest_of(cookie))
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 31 * 86_400)
    assert not tokens.is_good(digest_of(cookie))


@contextmanager
def listening(service: Service, token: str) -> Iterator[ClientConnection]:
    """Yield a client of /live that was greeted."""
    address, headers = service.url.replace("http", "ws", 1) + "/api/v1/live", {"Authorization": f"Bearer {token}"}
    with connect(address, additional_headers=headers, open_timeout=PATIENCE) as client:
        assert json.loads(client.recv(PATIENCE))["type"] == "hello"
        yield client


def read_on(client: ClientConnection) -> None:
    for _ in range(10_000):
        client.recv(PATIENCE)


@pytest.mark.link
def test_a_token_that_is_removed_ends_its_open_channel_and_no_other(service: Service) -> None:
    assert USUAL.token <= 1.0, "within two seconds"
    with listening(service, service.token("stays")) as stays, listening(service, service.token("goes")) as goes:
        service.station.ask("ncap", "token", "remove", "goes")
        with pytest.raises(ConnectionClosed) as ended:
            read_on(goes)
        assert ended.value.rcvd is not None
        assert (ended.value.rcvd.code, ended.value.rcvd.reason) == (1008, "This token is invalid or has expired.")
        assert json.loads(stays.recv(PATIENCE))["type"] in ("beat", "event", "values")


def test_who_may_only_read_is_shown_no_paths() -> None:
    async def paths_seen() -> list[list[str]]:
        live = Live()
        every = [live.join(), live.join(reader=True)]
        running = asyncio.create_task(live.run())
        await asyncio.sleep(0.01)
        live.event("sink", state="failed", error="/home/me/run.csv cannot be written: the disk is full.")
        found = [await live_client.wait() for live_client in every]
        running.cancel()
        return found

    writer, reader = asyncio.run(paths_seen())
    assert "/home/me/run.csv cannot" in writer[0]
    assert '"run.csv cannot' in reader[0]


@pytest.mark.link
def test_what_waits_for_the_stores_lock_holds_up_no_other_request(service: Service) -> None:
    """A dozen requests for a group, beside a command that holds the store, had stopped the whole API."""
    headers: dict[str, str | None] = {
        "Authorization": f"Bearer {service.token('groups')}",
        "Content-Type": "application/json",
    }
    answers: list[int] = []

    def make(number: int) -> None:
        body = json.dumps({"name": f"held {number}", "uuids": []})
        answers.append(service.raw("POST", "/api/v1/groups", headers, body).status)

    makers = [threading.Thread(target=make, args=(number,), daemon=True) for number in range(12)]
    with StoreLock(service.station.home, command="another command"):
        for thread in makers:
            thread.start()
        asked = until(lambda: [service.raw("GET", "/api/v1/status", headers).status for _ in range(20)])
        assert (set(asked), answers) == ({200}, [])
    for thread in makers:
        thread.join(PATIENCE)
    assert set(answers) <= {201, 423, 503}
    assert 201 in answers


@pytest.fixture(scope="module")
def hand(service: Service) -> str:
    """Return a virtual gripper of the daemon."""
    return virtual(service)


@pytest.mark.link
def test_the_log_names_who_asked_for_what_and_why_it_was_refused(service: Service, hand: str) -> None:
    headers: dict[str, str | None] = {"Content-Type": "application/json"}
    bearer = {**headers, "Authorization": f"Bearer {service.token('robot 7')}"}
    page = {**headers, "Cookie": cookie_of(service), "Origin": service.url}
    path = f"/api/v1/nodes/{hand}/channels/1"
    assert service.raw("PUT", path, bearer, '{"value": 5, "unit": "m", "hold": 1}').status == 422
    assert service.raw("PUT", "/api/v1/detection", page, '{"mode": "whitelist"}').status == 200
    with service.client() as asked:
        assert asked.request("PUT", f"/nodes/{hand}/channels/1", {"hold": 0})["applied"] is None
        asked.request("PUT", f"/nodes/{hand}/channels/1", {"value": 0.02, "hold": 0.2})
        until(lambda: asked.request("GET", "/log?act=set")["entries"][-1]["outcome"] == "done")
        [begun, refused, *own] = asked.request("GET", "/log?act=set")["entries"]
        assert (begun["actor"], refused["actor"], refused["failed"]) == ("robot 7", "robot 7", True)
        assert (refused["facts"]["value"], refused["facts"]["unit"]) == (5, "m")
        assert "0.11" in refused["facts"]["why"]
        assert {"@" in item["actor"] for item in own} == {True}
        [mode] = asked.request("GET", "/log?act=detection&limit=1")["entries"]
        assert (mode["actor"], mode["facts"]["mode"]) == ("page", "whitelist")

        failed = asked.request("GET", "/log?failed=1&text=ROBOT%207")["entries"]
        assert [item["seq"] for item in failed] == [refused["seq"]]
        assert asked.request("GET", f"/log?text={hand[:12]}&limit=3")["entries"]
        assert asked.request("GET", "/log?text=100%25_no'such")["entries"] == []
        before = asked.request("GET", f"/log?before={refused['seq']}&limit=2")["entries"]
        assert [item["seq"] for item in before] == [refused["seq"] - 2, refused["seq"] - 1]
        assert asked.request("GET", "/log?since=2099-01-01T00:00:00Z")["entries"] == []
        newest = asked.request("GET", f"/log?since={int(begun['time'])}&limit=1000")["entries"]
        assert begun["seq"] in {item["seq"] for item in newest}
    for query in ("before=0", "since=yesterday", f"text={'x' * 300}", "limit=0"):
        assert service.raw("GET", f"/api/v1/log?{query}", bearer).status == 422, query
    shown = service.station.ask("log", "--act", "set")["entries"]
    assert (shown[0]["actor"], shown[0]["who"]) == ("robot 7", "token robot 7")


@pytest.mark.link
def test_a_datasheet_as_a_json_document_is_what_the_description_says(service: Service, hand: str) -> None:
    bearer: dict[str, str | None] = {"Authorization": f"Bearer {service.token('documents', '--read-only')}"}
    path = f"/nodes/{hand}/teds?format=json"
    answer = service.raw("GET", f"/api/v1{path}", bearer)
    assert answer.status == 200
    described("GET", path, 200, answer.headers["content-type"], answer.text.encode())
    assert answer.json["format"] == "teds/1"
