"""What the API's resources do with a request: status of each error, defaults, and what the daemon is asked for."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.requests import Request

from teds_provision import errors
from teds_provision.errors import PolicyError, TedsProvisionError, UsageError
from teds_provision.ncap.web.guard import CALLER, Caller
from teds_provision.ncap.web.resources import Resources
from teds_provision.ncap.web.responses import status_of
from teds_provision.station.store.audit import AuditFilter

UUID = "8d4d9da65281f7000000"
SCRIPT, READER = Caller("arm", "script"), Caller("plotter", "script", read_only=True)
SOCKET = Caller("socket", "socket")


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (errors.NotFoundError("x"), 404),
        (errors.FrozenError("x"), 409),
        (errors.KnownUuidError("x"), 409),
        (errors.DatasheetChangedError("x"), 412),
        (errors.NodeBusyError("x"), 423),
        (errors.NodeRefusedError("claimed by another", reason=17), 423),
        (errors.NodeRefusedError("out of range", reason=6), 422),
        (errors.NodeSilentError("x"), 503),
        (errors.UnprovenError("x"), 503),
        (errors.StoreLockedError("x"), 503),
        (errors.VaultLockedError("x"), 503),
        (errors.PolicyError("limits"), 422),
        (errors.BadDataError("guard"), 422),
        (errors.NotAuthenticError("x"), 422),
        (errors.NotWhitelistedError("x"), 422),
        (errors.UsageError("x"), 422),
    ],
)
def test_the_status_of_each_error(error: TedsProvisionError, status: int) -> None:
    assert status_of(error) == status


class Asked:
    """The calls of the daemon's parts, in the place of the daemon."""

    def __init__(self, **answers: Any) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        def call(*words: Any, **more: Any) -> Any:
            self.calls.append((name, *words, *sorted(more.items())))
            return self._answers.get(name, {})

        return call


def answer(
    handler: str,
    daemon: Any,
    query: str = "",
    *,
    body: Any = None,
    method: str = "",
    caller: Caller = SCRIPT,
    **path: Any,
) -> tuple[int, Any]:
    """Return status and JSON of a handler's answer."""
    octets = body if isinstance(body, bytes) else b"" if body is None else json.dumps(body).encode()

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": octets, "more_body": False}

    scope = {"type": "http", "method": method or ("GET" if body is None else "POST"), "path": "/", "path_params": path}
    request = Request({**scope, "query_string": query.encode(), "headers": [], CALLER: caller}, receive)
    got = asyncio.run(getattr(Resources(daemon), handler)(request))
    return got.status_code, json.loads(got.body)


def daemon_of(**parts: Any) -> Any:
    return SimpleNamespace(known=lambda _word: UUID, resolve=lambda _word: UUID, **parts)


@pytest.mark.parametrize(
    ("query", "asked"),
    [
        ("", (1, None, None, 600)),
        ("channel=255&points=3600&from=12.5&until=1795341600", (255, 12.5, 1795341600.0, 3600)),
    ],
)
def test_the_past_of_a_channel_is_of_channel_1_in_600_points_unless_asked_otherwise(
    query: str, asked: tuple[Any, ...]
) -> None:
    history = Asked()
    answer("past", daemon_of(live=SimpleNamespace(history=history)), query, uuid=UUID)
    assert history.calls == [("channel_history", UUID, *asked)]


@pytest.mark.parametrize(
    ("handler", "query"),
    [
        ("past", "points=3601"), ("past", "points=0"), ("past", "channel=256"), ("past", "channel=0"),
        ("log", "limit=10001"), ("log", "limit=0"), ("log", "before=0"), ("log", f"text={'x' * 201}"),
        ("nodes", "limit=1001"), ("nodes", "offset=-1"),
        ("updates", "nodes=a&parallel=25"), ("updates", "nodes=a&parallel=0"), ("updates", "nodes=a&wait=3601"),
        ("updates", "nodes=a&match=all"), ("updates", ""), ("updates", "nodes=a&dry-run=1"),
    ],
)  # fmt: skip
def test_what_no_query_may_ask_for(handler: str, query: str) -> None:
    daemon = daemon_of(live=SimpleNamespace(history=Asked()), directory=Asked(nodes_text="{}"), updates=Asked())
    with pytest.raises(UsageError):
        answer(handler, daemon, query, uuid=UUID, method="POST" if handler == "updates" else "GET", body=b"image")


@pytest.mark.parametrize(
    ("query", "choice", "last"),
    [
        ("", AuditFilter(), 200),
        ("limit=3&before=9&text=arm&act=write&failed=1", AuditFilter(None, "write", True, text="arm", before=9), 3),
        ("since=2026-11-22T10:00:00Z&failed=0", AuditFilter(since="2026-11-22T10:00:00Z"), 200),
    ],
)
def test_the_newest_200_entries_of_the_log_unless_asked_otherwise(query: str, choice: AuditFilter, last: int) -> None:
    verdict = SimpleNamespace(intact=True, why="")
    log = Asked(entry_before=7, check=verdict, chosen=[])
    status, found = answer("log", daemon_of(station=SimpleNamespace(audit_log=log)), query)
    assert (status, found) == (200, {"entries": [], "intact": True, "why": ""})
    assert log.calls == [("entry_before", choice, ("last", last)), ("check", 7), ("chosen", choice, 7)]


def test_an_update_is_of_one_board_at_a_time_that_has_180_s_and_no_older_image_unless_asked_otherwise() -> None:
    updates = Asked()
    daemon = daemon_of(updates=updates)
    assert answer("updates", daemon, "nodes=a,a", body=b"image")[0] == 202
    more = "nodes=a&parallel=24&wait=3600&allow_downgrade=1&other_board=a&dry_run=1"
    assert answer("updates", daemon, more, body=b"image")[0] == 200
    (begun, planned) = updates.calls
    assert (begun[0], begun[1], begun[3]) == ("begin", b"image", ("owner", "api:arm"))
    assert vars(begun[2]) == {
        "uuids": (UUID,), "other_board": frozenset(), "allow_downgrade": False, "parallel": 1, "wait": 180,
    }  # fmt: skip
    assert planned[0] == "plan"
    assert vars(planned[2]) == {
        "uuids": (UUID,), "other_board": frozenset({UUID}), "allow_downgrade": True, "parallel": 24, "wait": 3600,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("body", "call"),
    [
        ({"value": 0.5}, ("put", UUID, 2, 0.5, None, None)),
        ({"value": 45, "unit": "degree", "hold": 3}, ("put", UUID, 2, 45, "degree", 3)),
        ({"value": 45, "hold": 0}, ("release_actuator", UUID, 2)),
        ({"hold": 0}, ("release_actuator", UUID, 2)),
    ],
)
def test_a_set_point_is_held_and_a_hold_of_0_lets_go(body: dict[str, Any], call: tuple[Any, ...]) -> None:
    leases = Asked()
    answer("channel", daemon_of(leases=leases), body=body, method="PUT", uuid=UUID, number=2)
    assert leases.calls == [call]


@pytest.mark.parametrize(("handler", "body"), [("lend", None), ("lend_until_closed", None), ("login_link", {})])
def test_what_this_machine_alone_may_ask_for(handler: str, body: Any) -> None:
    for caller in (SCRIPT, READER, Caller("browser", "browser")):
        with pytest.raises(PolicyError):
            answer(handler, daemon_of(watches=[], measuring=Asked()), body=body, caller=caller, uuid=UUID)


def test_a_login_link_has_the_rights_that_were_asked_for() -> None:
    daemon = Asked(login_url="http://127.0.0.1/login?token=x")
    for body in ({}, {"read_only": False}, {"read_only": True}):
        assert answer("login_link", daemon, body=body, caller=SOCKET)[1] == {"url": "http://127.0.0.1/login?token=x"}
    assert daemon.calls == [("login_url", ("read_only", asked)) for asked in (False, False, True)]


@pytest.mark.parametrize("source", ["file:/etc/passwd", "unix:/run/x"])
def test_a_file_of_this_machine_feeds_a_virtual_transducer_only_if_its_user_says_so(source: str) -> None:
    daemon = Asked(make_virtual={"uuid": UUID})
    with pytest.raises(PolicyError, match="on the station's own machine"):
        answer("virtual", daemon, body={"profile": "gripper", "source": source})
    assert answer("virtual", daemon, body={"profile": "gripper", "source": source}, caller=SOCKET)[0] == 201
    assert answer("virtual", daemon, body={"profile": "gripper"})[0] == 201
    plain = [("content", None), ("name", None), ("new_uuid", False), ("profile", "gripper")]
    assert daemon.calls == [("make_virtual", *plain, ("source", said)) for said in (source, "noise")]


def test_a_token_that_may_only_read_is_told_so() -> None:
    daemon = Asked(status={"url": None})
    assert answer("status", daemon)[1]["write"] is True
    assert answer("status", daemon, caller=READER)[1]["write"] is False


def test_the_owner_of_a_measurement_is_who_asked_for_it() -> None:
    measuring = Asked(add={"id": "m1"})
    for caller in (SOCKET, SCRIPT, Caller("browser", "browser")):
        status, found = answer("measurements", daemon_of(measuring=measuring), body={"uuids": ["8d4d"]}, caller=caller)
        assert (status, found) == (201, {"id": "m1"})
    assert [(call[1]["uuids"], call[2]) for call in measuring.calls] == [
        ([UUID], "ncap"), ([UUID], "api:arm"), ([UUID], "page"),
    ]  # fmt: skip
