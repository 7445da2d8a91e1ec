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
from teds_provision.ncap.web import resources, responses
from teds_provision.ncap.web.guard import CALLER, Caller, RequestRefusedError
from teds_provision.ncap.web.resources import Resources
from teds_provision.ncap.web.responses import status_of
from teds_provision.station.store.audit import ACTOR, AuditFilter, acting_for
from tests.pace import PATIENCE

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


LABEL = "0x8D4D9DA65281F7000000"
PLAIN: dict[str, Any] = {
    "profile": None, "name": None, "calibration": None, "calibration_name": None, "channel": None, "item": None,
    "adopt": False, "accept": None,
}  # fmt: skip
ORDERED: dict[str, Any] = {
    "profile": "gripper", "name": "left", "calibration": "raw,value", "calibration_name": "a.csv",
    "calibration_channel": 2, "calibration_item": "r1", "adopt": True, "accept_calibration": "new cell",
}  # fmt: skip
BEGUN: dict[str, Any] = {
    "profile": "gripper", "name": "left", "calibration": "raw,value", "calibration_name": "a.csv", "channel": 2,
    "item": "r1", "adopt": True, "accept": "new cell",
}  # fmt: skip


@pytest.mark.parametrize(
    ("handler", "part", "body", "how", "status", "calls"),
    [
        ("detection", "", {"mode": "transparent"}, {"method": "PUT"}, 200, [("set_detection", "transparent")]),
        ("discover", "", {}, {}, 200, [("discover",)]),
        ("locate", "", {"seconds": 5}, {"uuid": "hand"}, 200, [("locate", UUID, 5)]),
        ("groups", "", None, {}, 200, [("groups",)]),
        ("groups", "", {"name": "arm"}, {}, 201, [("make_group", "arm", []), ("groups",)]),
        ("groups", "", {"name": "arm", "uuids": ["a", "b"]}, {}, 201, [("make_group", "arm", [UUID] * 2), ("groups",)]),
        ("group", "", {"uuids": ["a"]}, {"method": "PUT", "name": "arm/left"}, 200,
         [("change_group", "arm/left", [UUID]), ("groups",)]),
        ("group", "", None, {"method": "DELETE", "name": "arm"}, 200, [("drop_group", "arm"), ("groups",)]),
        ("measurements", "measuring", None, {}, 200, [("all",)]),
        ("measurement", "measuring", None, {"method": "DELETE", "id": "m1"}, 200, [("delete", "m1"), ("all",)]),
        ("rate", "measuring", None, {"query": "group=arm"}, 200,
         [("proposed_rate", ("group", "arm"), ("uuids", []))]),
        ("rate", "measuring", None, {"query": "uuids=a,,b"}, 200,
         [("proposed_rate", ("group", None), ("uuids", [UUID] * 2))]),
        ("names", "names", None, {}, 200, [("all",)]),
        ("names", "names", {"uuid": "hand", "name": "left"}, {"method": "PUT"}, 200,
         [("rename", UUID, 0, "left"), ("all",)]),
        ("names", "names", {"uuid": "hand", "channel": 2, "name": None}, {"method": "PUT"}, 200,
         [("rename", UUID, 2, None), ("all",)]),
        ("names", "names", {"uuid": "hand", "channel": 2, "name": ""}, {"method": "PUT"}, 200,
         [("rename", UUID, 2, None), ("all",)]),
        ("update", "updates", None, {"id": "u1"}, 200, [("get", "u1")]),
        ("update", "updates", None, {"method": "DELETE", "id": "u1"}, 200, [("cancel", "u1")]),
        ("updates", "updates", None, {}, 200, [("all",)]),
        ("channel", "directory", None, {"uuid": "hand", "number": 2}, 200, [("channel", UUID, 2)]),
        ("nodes", "directory", None, {}, 200, [("nodes_text", 1000, 0, ("reader", False))]),
        ("nodes", "directory", None, {"query": "limit=5&offset=7", "caller": READER}, 200,
         [("nodes_text", 5, 7, ("reader", True))]),
        ("provision", "provisioning", None, {"uuid": LABEL}, 200, [("run_of", UUID)]),
        ("provision", "provisioning", None, {"uuid": "next"}, 200, [("run_of", "next")]),
        ("provision", "provisioning", {"cancel": True}, {"uuid": "next"}, 200, [("cancel", "next")]),
        ("provision", "provisioning", {"cancel": False}, {"uuid": "hand"}, 202,
         [("begin", UUID, *sorted(PLAIN.items()))]),
        ("provision", "provisioning", ORDERED, {"uuid": LABEL}, 202, [("begin", UUID, *sorted(BEGUN.items()))]),
    ],
)  # fmt: skip
def test_each_resource_asks_for_what_its_request_says(
    handler: str, part: str, body: Any, how: dict[str, Any], status: int, calls: list[tuple[Any, ...]]
) -> None:
    asked = Asked(nodes_text="{}", proposed_rate=None)
    parts: dict[str, Any] = {part: asked} if part else {}
    if not part:
        names = ("set_detection", "discover", "locate", "groups", "make_group", "change_group", "drop_group")
        parts = {name: getattr(asked, name) for name in names} | {"detection": "whitelist"}

    def known(word: str) -> str:
        assert word in ("hand", "a", "b"), "a label need not be of a node that is known"
        return UUID

    daemon: Any = SimpleNamespace(known=known, resolve=known, **parts)
    assert answer(handler, daemon, body=body, **how)[0] == status
    assert asked.calls == calls


DIGEST = {"etag": '"d1"'}


@pytest.mark.parametrize(
    ("method", "query", "match", "call", "headers"),
    [
        ("GET", "", None, ("as_json", UUID), DIGEST),
        ("GET", "format=xml", None, ("document", UUID, "xml"),
         DIGEST | {"content-disposition": f'attachment; filename="{UUID}.xml"', "content-type": "application/xml"}),
        ("PUT", "dry_run=1", None, ("plan", None), DIGEST),
        ("PUT", "dry_run=true", '"d1"', ("plan", {"d1"}), DIGEST),
        ("PUT", "", '"d1", "d2"', ("write", {"d1", "d2"}), {}),
        ("PUT", "dry_run=0", None, ("write", None), {}),
    ],
)  # fmt: skip
def test_a_datasheet_that_is_read_or_planned_has_a_tag_which_a_change_may_name(
    method: str, query: str, match: str | None, call: tuple[Any, ...], headers: dict[str, str]
) -> None:
    sheets = Asked(as_json=({"teds": []}, "d1"), document=("<teds/>", "application/xml", "d1"), plan=({}, "d1"))
    body = {"content": "<teds/>", "accept_calibration": "new cell", "retype": True}

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": json.dumps(body).encode(), "more_body": False}

    scope = {"type": "http", "method": method, "path": "/", "path_params": {"uuid": "hand"}, CALLER: SCRIPT}
    pairs = [] if match is None else [(b"if-match", match.encode())]
    request = Request({**scope, "query_string": query.encode(), "headers": pairs}, receive)
    got = asyncio.run(Resources(daemon_of(sheets=sheets)).teds(request))
    if method == "PUT":
        asked = [("accept", "new cell"), ("expected", call[1]), ("retype", True)]
        call = (call[0], UUID, "<teds/>", *asked)
    assert sheets.calls == [call]
    given = {name: value for name, value in got.headers.items() if name != "content-length"}
    assert given == {"content-type": "application/json", **headers}


def test_the_types_that_can_be_built_are_neither_unfinished_nor_faulty(monkeypatch: pytest.MonkeyPatch) -> None:
    entries: list[dict[str, Any]] = [
        {"name": "gripper"}, {"name": "smart-sensor", "abstract": True}, {"name": "bad", "error": "no unit"},
        {"name": "cell", "abstract": False},
    ]  # fmt: skip
    monkeypatch.setattr(resources, "list_profiles", lambda _folders: entries)
    monkeypatch.setattr(resources, "listed", lambda entry: entry)
    monkeypatch.setattr(resources, "default_folders", lambda home: [home])
    found = answer("profiles", daemon_of(station=SimpleNamespace(home="home")))[1]["profiles"]
    assert [entry["name"] for entry in found] == ["gripper", "cell"]


def test_a_virtual_transducer_is_removed_by_its_uuid_in_any_case_and_another_node_is_not() -> None:
    class Made(dict[str, None]):
        """The transducers of the station."""

        def all(self) -> list[str]:
            return list(self)

    removed: list[str] = []
    daemon = daemon_of(virtuals=Made({UUID: None}), drop_virtual=removed.append)
    assert answer("one_virtual", daemon, method="DELETE", uuid=UUID.upper())[0] == 200
    with pytest.raises(errors.NotFoundError, match="is not a virtual transducer of this station"):
        answer("one_virtual", daemon, method="DELETE", uuid="ab" * 10)
    assert removed == [UUID]


def test_an_entry_of_the_log_as_a_row_of_the_page() -> None:
    def entry(uuid: bytes | None, outcome: str, **detail: Any) -> Any:
        return SimpleNamespace(
            seq=7, at="2026-11-22T10:00:00Z", who="ann@bench", actor="page", act="set", uuid=uuid, outcome=outcome,
            detail=detail,
        )  # fmt: skip

    entries = [
        entry(bytes.fromhex(UUID), "refused", channel=1, why="Too far.", unit="", names=["a"]),
        entry(None, "done"),
        entry(None, "begun"),
    ]
    verdict = SimpleNamespace(intact=False, why="Entry 3 is missing.")
    log = Asked(entry_before=0, check=verdict, chosen=entries)
    found = answer("log", daemon_of(station=SimpleNamespace(audit_log=log)), "uuid=hand")[1]
    common = {"seq": 7, "time": 1795341600.0, "who": "ann@bench", "actor": "page", "act": "set"}
    nobody = {**common, "uuid": None, "subject": "", "failed": False, "facts": {}}
    assert found == {
        "entries": [
            {
                **common, "uuid": UUID, "subject": UUID, "outcome": "refused", "failed": True,
                "detail": "refused: channel 1, why Too far.",
                "facts": {"channel": 1, "why": "Too far.", "unit": "", "names": ["a"]},
            },
            {**nobody, "outcome": "done", "detail": "done"},
            {**nobody, "outcome": "begun", "detail": "begun"},
        ],
        "intact": False, "why": "Entry 3 is missing.",
    }  # fmt: skip
    assert log.calls[0][1] == AuditFilter(uuid=bytes.fromhex(UUID))


def test_who_may_only_read_is_shown_no_folder_whether_by_a_token_or_in_a_browser() -> None:
    shown = [{"source": "file:/home/ann/run.csv"}]
    virtuals = SimpleNamespace(all=lambda: shown)
    for caller in (READER, Caller("browser", "browser", read_only=True)):
        assert answer("virtual", daemon_of(virtuals=virtuals), caller=caller)[1] == {
            "virtual": [{"source": "file:run.csv"}]
        }
    assert answer("virtual", daemon_of(virtuals=virtuals))[1] == {"virtual": shown}


def test_a_transducer_gets_another_uuid_if_that_was_asked_for() -> None:
    daemon = Asked(make_virtual={})
    answer("virtual", daemon, body={"content": "<teds/>", "name": "copy", "source": "ramp:1", "new_uuid": True})
    assert daemon.calls == [
        ("make_virtual", ("content", "<teds/>"), ("name", "copy"), ("new_uuid", True), ("profile", None),
         ("source", "ramp:1"))
    ]  # fmt: skip


def test_an_update_of_those_that_match_is_of_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    updates, asked = Asked(), list[Any]()

    def known_nodes(station: Any, match: str) -> list[bytes]:
        asked.append((station, match))
        return [bytes.fromhex(UUID), bytes.fromhex("cd" * 10), bytes.fromhex(UUID)]

    monkeypatch.setattr(resources, "known_nodes", known_nodes)
    answer("updates", daemon_of(updates=updates, station="bench"), "match=type:load-cell", body=b"image")
    assert asked == [("bench", "type:load-cell")]
    assert updates.calls[0][2].uuids == (UUID, "cd" * 10)


@pytest.mark.parametrize(
    ("query", "lent", "lines", "why", "looked"),
    [
        ("", True, ["let go\n", ".\n"], "let go for a command", False),
        ("for=write", False, ["not measured\n", ".\n"], "let go for write", False),
        ("for=update", True, ["let go\n", ".\n"], "let go for update", True),
        (f"for={'x' * 50}", True, ["let go\n", ".\n"], f"let go for {'x' * 40}", False),
        ("for=write", PolicyError("It is frozen."), ["refused: It is frozen.\n"], "let go for write", False),
    ],
)
def test_a_command_has_a_node_until_it_closes_and_hears_whether_it_was_measured(
    query: str, lent: bool | Exception, lines: list[str], why: str, looked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources, "_LENT_LOOK", 0.0)
    loans, returned, free = list[Any](), list[Any](), list[str]()

    def lend_node(loan: Any) -> bool:
        loans.append(loan)
        if isinstance(lent, Exception):
            raise lent
        return lent

    async def run() -> list[str]:
        gone = asyncio.Event()
        loop = asyncio.get_running_loop()

        def return_node(loan: Any) -> None:
            returned.append(loan)
            loop.call_soon_threadsafe(gone.set)

        measuring = SimpleNamespace(lend_node=lend_node, return_node=return_node)
        updates = SimpleNamespace(require_free=free.append)
        scope = {"type": "http", "method": "GET", "path": "/", "path_params": {"uuid": UUID.upper()}, CALLER: SOCKET}
        request = Request({**scope, "query_string": query.encode(), "headers": []})
        daemon: Any = SimpleNamespace(measuring=measuring, updates=updates)
        answered: Any = await Resources(daemon).lend_until_closed(request)
        got: list[str] = []
        async for line in answered.body_iterator:
            got.append(line)
            if (len(got) == len(lines) and not isinstance(lent, Exception)) or len(got) > len(lines):
                break
        await answered.body_iterator.aclose()
        await asyncio.wait_for(gone.wait(), PATIENCE)
        return got

    assert asyncio.run(run()) == lines
    assert [(loan.uuid, loan.why) for loan in loans] == [(UUID, why)]
    assert returned == loans, "it is measured again, however the command ended"
    assert free == ([UUID] if looked else [])


def test_a_node_that_a_silent_command_has_is_measured_again_after_a_quarter_of_an_hour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, returned = [1000.0], list[Any]()
    monkeypatch.setattr(resources, "_LENT_LOOK", 0.0)
    monkeypatch.setattr(resources, "time", SimpleNamespace(monotonic=lambda: now[0]))

    async def run() -> int:
        gone, loop = asyncio.Event(), asyncio.get_running_loop()

        def return_node(loan: Any) -> None:
            returned.append(loan)
            loop.call_soon_threadsafe(gone.set)

        measuring = SimpleNamespace(lend_node=lambda _loan: True, return_node=return_node)
        scope = {"type": "http", "method": "GET", "path": "/", "path_params": {"uuid": UUID}, CALLER: SOCKET}
        daemon: Any = SimpleNamespace(measuring=measuring)
        answered: Any = await Resources(daemon).lend_until_closed(
            Request({**scope, "query_string": b"", "headers": []})
        )
        lines = 0
        async for _ in answered.body_iterator:
            lines += 1
            now[0] += 300.0
        await asyncio.wait_for(gone.wait(), PATIENCE)
        return lines

    assert asyncio.run(run()) == 3, "that it was let go, and two signs of life"
    assert len(returned) == 1


def test_a_body_that_the_description_forbids_is_refused_with_what_to_do_and_a_bug_gives_its_type_alone() -> None:
    with pytest.raises(RequestRefusedError) as refused:
        answer("locate", daemon_of(), body=b'{"seconds": 1, "seconds": 2}', uuid="hand")
    assert (refused.value.status, refused.value.code, bool(refused.value.hint)) == (422, "bad-request", True)
    nobody: Any = None
    bug = responses.answer_bug(nobody, ValueError("the key is 4711"))
    problem = {"code": "bug", "message": "Unexpected ValueError.", "hint": "See the daemon's log."}
    assert (bug.status_code, json.loads(bug.body)) == (500, {"error": problem})


@pytest.mark.parametrize(
    ("value", "is_short"),
    [
        (True, True), (5, True), (0.5, True), ("x" * 200, True), ("x" * 201, False), (None, False),
        (["a"] * 16, True), (["a"] * 17, False), (["a", "x" * 201], False), ([], True),
    ],
)  # fmt: skip
def test_the_log_has_the_short_members_of_a_request_that_was_refused(value: Any, is_short: bool) -> None:
    """No datasheet and no calibration: an entry would be as long as the file."""
    assert responses._is_short(value) is is_short


def test_who_asked_is_known_in_whichever_thread_the_work_is_done() -> None:
    async def run() -> list[str | None]:
        with acting_for("robot 7"):
            return [await work(ACTOR.get) for work in (responses.reading, responses.changing, responses.moving)]

    assert asyncio.run(run()) == ["robot 7"] * 3


def test_a_resource_of_a_part_is_an_answer_without_files_and_users_for_a_reader() -> None:
    async def found(request: Request) -> dict[str, Any]:
        return {"why": "Cannot write /home/arm/plant/pages.", "path": request.url.path}

    part: Any = SimpleNamespace(resources=lambda: {"/plant": found, "/jobs": found})
    routes = resources.routes_of_parts([part])
    assert [route.path for route in routes] == ["/plant", "/jobs"]
    answers = []
    for caller in (SCRIPT, READER):
        scope = {"type": "http", "method": "GET", "path": "/plant", "query_string": b"", "headers": [], CALLER: caller}
        got: Any = asyncio.run(routes[0].endpoint(Request(scope)))
        answers.append(json.loads(got.body))
    assert answers[0] == {"why": "Cannot write /home/arm/plant/pages.", "path": "/plant"}
    assert "/home/arm" not in answers[1]["why"]
