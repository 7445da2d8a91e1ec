"""What a request's query and headers mean, asked of the functions that read them."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from teds_provision.errors import (
    FrozenError,
    NodeBusyError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.ncap.nodes.update_actions import UpdateRequest
from teds_provision.ncap.web import app, clause12, metrics, resources, wot
from teds_provision.ncap.web.clause12 import Clause12
from teds_provision.ncap.web.guard import CALLER, Caller, RequestRefusedError, _require_may_change
from teds_provision.ncap.web.resources import Resources


def request(query: str = "", *headers: tuple[str, str]) -> Request:
    pairs = [(name.encode(), value.encode()) for name, value in headers]
    return Request({"type": "http", "method": "GET", "path": "/", "query_string": query.encode(), "headers": pairs})


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ([], None),
        (["*"], None),
        (['"a1"'], {"a1"}),
        (['"a1", "b2"'], {"a1", "b2"}),
        (['"a1"', '"b2"'], {"a1", "b2"}),
        (['"a1", *'], None),
        (['W/"a1"'], set()),
        (["a1"], set()),
        (['"'], set()),
        ([""], set()),
    ],
)
def test_if_match_names_the_datasheets_that_may_be_changed_and_a_weak_or_bare_tag_none(
    tags: list[str], expected: set[str] | None
) -> None:
    """A tag that is no strong one must refuse the change, not allow every one (RFC 9110, section 13.1.1)."""
    assert resources._expected(request("", *(("if-match", tag) for tag in tags))) == expected


@pytest.mark.parametrize(
    ("text", "number"),
    [("", 7), ("limit=1", 1), ("limit=10", 10), ("limit=0", None), ("limit=11", None), ("limit=", None)]
    + [(f"limit={word}", None) for word in ("-1", "1.0", "%D9%A1", "1e1", "00000000000000000000001")],
)
def test_a_number_is_whole_within_its_bounds_or_left_out(text: str, number: int | None) -> None:
    if number is not None:
        assert resources._integer(request(text), "limit", 7, 10) == number
        return
    with pytest.raises(UsageError, match="limit must be a whole number from 1 to 10"):
        resources._integer(request(text), "limit", 7, 10)


def test_a_switch_is_on_or_off_and_an_unknown_word_is_refused() -> None:
    words = {"": False, "dry_run=1": True, "dry_run=True": True, "dry_run=0": False, "dry_run=false": False}
    assert {text: resources._says(request(text), "dry_run") for text in words} == words
    with pytest.raises(UsageError, match="dry_run must be 1 or 0"):
        resources._says(request("dry_run=yes"), "dry_run")
    resources._require_known(request("dry_run=1"), ["dry_run"])
    with pytest.raises(UsageError, match="Unknown in the query: dry-run"):
        resources._require_known(request("dry-run=1"), ["dry_run"])


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("from=12.5", 12.5),
        ("from=2026-11-22T10:00:00Z", 1795341600.0),
        ("from=2026-11-22T11:00:00%2B01:00", 1795341600.0),
        ("from=2026-11-22T10:00:00", 1795341600.0),
        ("", None),
        ("from=", None),
    ],
)
def test_a_moment_is_in_unix_seconds_or_iso_and_without_a_zone_in_utc(text: str, moment: float | None) -> None:
    assert resources._unix(request(text), "from") == moment


def test_a_change_without_a_body_is_a_delete_of_no_octets() -> None:
    caller = Caller("a", "script")

    def refused(method: str, **headers: str) -> int | None:
        scope = {"type": "http", "method": method, "path": "/api/v1/x"}
        try:
            _require_may_change(scope, {name.replace("_", "-"): value for name, value in headers.items()}, caller)
        except RequestRefusedError as refusal:
            return refusal.status
        return None

    json = "application/json; charset=utf-8"
    assert [refused("DELETE"), refused("DELETE", content_length="0"), refused("GET")] == [None] * 3
    assert refused("DELETE", content_length="2") == 415
    assert refused("DELETE", transfer_encoding="chunked") == 415, "it has a body, of whatever form"
    assert refused("DELETE", transfer_encoding="chunked", content_type=json) is None
    assert [refused("POST"), refused("PUT", content_type="text/plain")] == [415, 415]
    assert refused("POST", content_type=json) is None
    assert refused("POST", content_type=json, content_length=str((1 << 20) + 1)) == 413
    assert refused("GET", content_length=str((1 << 20) + 1)) == 413


def test_a_number_of_thousands_of_digits_is_refused_and_no_bug() -> None:
    """Python reads no such number, so the answer was 500."""
    number, known = "7" * 5000, SimpleNamespace(known=lambda text: text, directory=SimpleNamespace(channel=_numbered))

    def status(path: str, query: str, *routes: Route) -> tuple[int, bytes]:
        sent: list[Any] = []

        async def send(message: Any) -> None:
            sent.append(message)

        scope = {"type": "http", "method": "GET", "path": path, "query_string": query.encode(), "headers": []}
        handlers: Any = {TedsProvisionError: lambda _request, error: Response(error.message, 422)}
        called = Starlette(routes=routes, exception_handlers=handlers)
        asyncio.run(called({**scope, CALLER: Caller("arm", "script")}, cast("Any", None), send))
        return sent[0]["status"], sent[1]["body"]

    there = Resources(cast("Any", known)).routes()
    assert status("/nodes/hand/channels/255", "", *there) == (200, b'{"number":255}')
    assert status(f"/nodes/hand/channels/{number}", "", *there)[0] == 404
    old = Clause12(cast("Any", known)).routes()
    asked = "responseFormat=text&tedsType=1&channelId="
    assert status("/1451/TEDSManager/ReadTeds", f"{asked}{number}", *old) == (200, b"3\nchannelId must be a number.\n")


def _numbered(_uuid: str, number: int) -> dict[str, int]:
    return {"number": number}


def test_names_of_clause_12_are_separated_by_commas_alone_and_a_module_keeps_its_number() -> None:
    present = ["aa", "bb"]
    directory = SimpleNamespace(
        uuids=lambda: present,
        seen=lambda uuid: SimpleNamespace(present=uuid != "cc"),
        channel_names=lambda _uuid: [(1, "left, upper"), (2, "right")],
    )
    daemon: Any = SimpleNamespace(directory=directory, known=lambda word: word)
    found = Clause12(daemon)
    assert found.tims({})["timIds"] == "1,2"
    present[:] = ["bb", "cc", "aa", "dd"]
    assert found.tims({}) == {"timIds": "2,1,3", "uuids": "bb,aa,dd"}
    assert found.transducers({"timid": "2"}) == {
        "timId": 2, "channelIds": "1,2", "transducerNames": "left  upper,right",
    }  # fmt: skip
    with pytest.raises(UsageError, match="timId is missing"):
        found.transducers({})
    assert clause12._integer({"channelid": "65535"}, "channelId") == 65535
    for word in ("", "-1", "65536", "x", "²", "1.0", " 1"):
        with pytest.raises(UsageError, match="channelId must be a number"):
            clause12._integer({"channelid": word}, "channelId")


@pytest.mark.parametrize(
    ("path", "query", "kind", "body"),
    [
        ("Discovery/TIMDiscovery", "", "xml", "<errorCode>0</errorCode><timIds>1</timIds><uuids>aa</uuids>"),
        ("discovery/timdiscovery.htm", "format=1", "xml", "<timIds>1</timIds>"),
        ("Discovery/TIMDiscovery", "format=0", "text", "0\n1\naa\n"),
        ("Discovery/TIMDiscovery", "responseFormat=TEXT&format=1", "text", "0\n1\naa\n"),
        ("Discovery/TIMDiscovery", "ResponseFormat=json", "json", '{"errorCode":0,"timIds":"1","uuids":"aa"}'),
        ("TransducerAccess/ReadData", "timId=1&channelId=1", "xml", "<timId>1</timId><channelId>1</channelId>"
         "<transducerData>2.5</transducerData><timestamp>7.0</timestamp>"),
        ("TransducerAccess/ReadData", "timId=1&channelId=2&format=0", "text", "2\n1\n2\n\n"),
        ("TransducerAccess/ReadData", "timId=1&channelId=3&format=0", "text", "2\n1\n3\n\n"),
        ("TransducerAccess/ReadData", "timId=1&channelId=9&format=0", "text", "1\nNode aa has no channel 9.\n"),
        ("TransducerAccess/ReadData", "timId=7&channelId=1&format=0", "text", "1\nNo node matches 7.\n"),
        ("TransducerAccess/ReadData", "timId=1&format=0", "text", "3\nchannelId must be a number.\n"),
        ("TEDSManager/ReadTeds", "timId=1&tedsType=1&format=0", "text", '0\n1\n0\n1\n{"UUID": "aa"}\n'),
        ("TEDSManager/ReadTeds", "timId=1&channelId=1&tedsType=3&format=0", "text", '0\n1\n1\n3\n{"Unit": "°"}\n'),
        ("TEDSManager/ReadTeds", "timId=1&tedsType=3&format=0", "text", "1\nNode aa has no TEDS 3 of channel 0.\n"),
        ("TEDSManager/ReadRawTeds", "timId=1&tedsType=1&format=0", "text", "0\n1\n0\n1\nAAEC/w==\n"),
        ("TEDSManager/ReadRawTeds", "timId=1&channelId=2&tedsType=3&format=0", "text",
         "1\nNode aa has no TEDS 3 of channel 2.\n"),
        ("TEDSManager/ReadRawTeds", "timId=bb&tedsType=1&format=0", "text", "4\nThe node is busy.\n"),
    ],
)  # fmt: skip
def test_the_answers_of_clause_12(path: str, query: str, kind: str, body: str) -> None:
    def known(word: str) -> str:
        if word == "bb":
            return word
        raise NotFoundError(f"No node matches {word}.")

    def read(uuid: str) -> Any:
        if uuid == "bb":
            raise NodeBusyError("The node is busy.")
        return SimpleNamespace(image=SimpleNamespace(blocks={(0, 1): b"\x00\x01\x02\xff"}))

    values = {1: SimpleNamespace(value=2.5, time=7.0), 2: SimpleNamespace(value=None, time=7.0)}
    teds = [
        {"channel": None, "access_code": 1, "fields": [{"name": "UUID", "text": "aa"}]},
        {"channel": 1, "access_code": 3, "fields": [{"name": "Unit", "text": "°"}]},
    ]
    daemon: Any = SimpleNamespace(
        known=known,
        directory=SimpleNamespace(
            uuids=lambda: ["aa"],
            seen=lambda _uuid: SimpleNamespace(present=True),
            channel_names=lambda _uuid: [(number, "") for number in (1, 2, 3)],
        ),
        live=SimpleNamespace(last=lambda _uuid, channel: values.get(channel)),
        sheets=SimpleNamespace(as_json=lambda _uuid: ({"teds": teds}, "digest"), read=read),
    )
    asked = request(query)
    asked.scope["path_params"] = {"path": path}
    answer = asyncio.run(Clause12(daemon)._answer(asked))
    assert (answer.status_code, answer.media_type) == (200, {
        "xml": "application/xml", "text": "text/plain", "json": "application/json",
    }[kind])  # fmt: skip
    text = bytes(answer.body).decode()
    assert body in text if kind == "xml" else text == body


def test_another_path_of_clause_12_is_refused_with_those_that_are_there() -> None:
    asked = request()
    asked.scope["path_params"] = {"path": "TransducerAccess/WriteData"}
    with pytest.raises(NotFoundError) as refused:
        asyncio.run(Clause12(cast("Any", None))._answer(asked))
    assert (refused.value.message, refused.value.hint) == (
        "This clause 12 path is not supported.",
        "Supported: Discovery/TIMDiscovery, Discovery/TransducerDiscovery, TransducerAccess/ReadData,"
        " TEDSManager/ReadTeds, TEDSManager/ReadRawTeds.",
    )


@pytest.mark.parametrize("read_only", [False, True])
def test_metrics_name_no_folder_to_who_may_only_read(read_only: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "text", lambda status, _parts: status["sinks"][0]["name"])
    daemon: Any = SimpleNamespace(status=lambda: {"sinks": [{"name": "/home/ann/run.csv"}]}, parts={})
    asked = request()
    asked.scope[CALLER] = Caller("a", "script", read_only)
    answer = metrics.route(daemon).endpoint(asked)
    assert answer.body.decode() == ("run.csv" if read_only else "/home/ann/run.csv")


@pytest.mark.parametrize(
    ("method", "path", "error", "logged"),
    [
        ("PUT", {"uuid": "ab" * 10}, FrozenError("It is measured."), ["frozen"]),
        ("PUT", {"uuid": "ab" * 10, "number": 3}, PolicyError("Beyond its limits."), []),
        ("GET", {"uuid": "ab" * 10}, FrozenError("It is measured."), []),
        ("PUT", {}, NotFoundError("No node."), []),
        ("PUT", {}, StoreError("The disk is full."), []),
    ],
)
def test_a_refused_change_is_logged_once(
    method: str, path: dict[str, Any], error: TedsProvisionError, logged: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A set point has an entry of its own; what does not exist, and a store that fails, are none."""
    outcomes: list[tuple[bytes | None, str]] = []
    station = SimpleNamespace(audit=lambda _act, uuid, outcome, **_facts: outcomes.append((uuid, outcome)))
    daemon: Any = SimpleNamespace(station=station)
    scope = {"type": "http", "method": method, "path": "/x", "path_params": path, "headers": [], "query_string": b""}
    scope |= {"server": ("localhost", 1), CALLER: Caller("a", "script")}
    answer = asyncio.run(app._noted(daemon)(Request(scope), error))
    assert answer.status_code >= 400
    assert outcomes == [(bytes.fromhex("ab" * 10), outcome) for outcome in logged]


def test_the_metrics_are_held_whole() -> None:
    """Prometheus refuses a whole scrape for one line that comes twice; counters keep all of their digits."""
    report = {"uuid": "ab", "state": "running", "samples": 12_345_678, "lost": 1, "late": 2, "bad": 3, "invalid": 4}
    status: dict[str, Any] = {
        "version": "1.0",
        "station": {"name": 'bench "A"\\\n'},
        "links": [
            {"place": "can:x", "state": "up", "nodes": 2, "strangers": 1},
            {"place": "nfc:y", "state": "lent", "nodes": 0, "strangers": 0},
        ],
        "measurements": [
            {"id": "1", "nodes": [report | {"clock_error": 0.00125}, {"uuid": "cd", "state": "lost"}]},
            {"id": "2", "nodes": [report | {"clock_error": None, "samples": 5}]},
        ],
        "sinks": [
            {"name": "run.csv", "measurement": "1", "written": 9, "dropped": 8, "state": "failed"},
            {"name": "run.csv", "measurement": "1", "written": 7, "dropped": 0, "state": "running"},
        ],
        "budget": {"used": 12.5},
        "clients": 3,
    }
    part: Any = SimpleNamespace(
        metric_help={"teds_plant_stations": ("gauge", "Stations of the plant.")},
        metrics=lambda: [("teds_plant_stations", {}, 2)],
    )
    node, gone, other = (
        f'{{node="{uuid}",measurement="{number}"}}' for uuid, number in (("ab", 1), ("cd", 1), ("ab", 2))
    )
    sink = '{sink="run.csv",measurement="1"}'
    assert metrics.text(status, [part]).splitlines() == [
        "# HELP teds_info Version and name of the station.",
        "# TYPE teds_info gauge",
        'teds_info{version="1.0",station="bench \\"A\\"\\\\\\n"} 1',
        "# HELP teds_link_up 1 where a link works.",
        "# TYPE teds_link_up gauge",
        'teds_link_up{link="can:x"} 1',
        'teds_link_up{link="nfc:y"} 0',
        "# HELP teds_nodes_present Nodes that are there, by link.",
        "# TYPE teds_nodes_present gauge",
        'teds_nodes_present{link="can:x"} 2',
        'teds_nodes_present{link="nfc:y"} 0',
        "# HELP teds_strangers Nodes that are not taken up, by link.",
        "# TYPE teds_strangers gauge",
        'teds_strangers{link="can:x"} 1',
        'teds_strangers{link="nfc:y"} 0',
        "# HELP teds_node_measuring 1 where values of a node come.",
        "# TYPE teds_node_measuring gauge",
        f"teds_node_measuring{node} 1",
        f"teds_node_measuring{gone} 0",
        f"teds_node_measuring{other} 1",
        "# HELP teds_samples_total Values of a node in this measurement.",
        "# TYPE teds_samples_total counter",
        f"teds_samples_total{node} 12345678",
        f"teds_samples_total{gone} 0",
        f"teds_samples_total{other} 5",
        "# HELP teds_lost_total Messages of a node that were lost.",
        "# TYPE teds_lost_total counter",
        f"teds_lost_total{node} 1",
        f"teds_lost_total{gone} 0",
        f"teds_lost_total{other} 1",
        "# HELP teds_late_total Messages of a node that came too late.",
        "# TYPE teds_late_total counter",
        f"teds_late_total{node} 2",
        f"teds_late_total{gone} 0",
        f"teds_late_total{other} 2",
        "# HELP teds_bad_total Messages of a node whose tag or form was wrong.",
        "# TYPE teds_bad_total counter",
        f"teds_bad_total{node} 3",
        f"teds_bad_total{gone} 0",
        f"teds_bad_total{other} 3",
        "# HELP teds_invalid_total Values of a node that are not valid.",
        "# TYPE teds_invalid_total counter",
        f"teds_invalid_total{node} 4",
        f"teds_invalid_total{gone} 0",
        f"teds_invalid_total{other} 4",
        "# HELP teds_clock_error_seconds Bound of the error of a node's times.",
        "# TYPE teds_clock_error_seconds gauge",
        f"teds_clock_error_seconds{node} 0.00125",
        "# HELP teds_sink_written_total Values that a sink wrote.",
        "# TYPE teds_sink_written_total counter",
        f"teds_sink_written_total{sink} 9",
        "# HELP teds_sink_dropped_total Values that a sink dropped.",
        "# TYPE teds_sink_dropped_total counter",
        f"teds_sink_dropped_total{sink} 8",
        "# HELP teds_sink_failed 1 where a sink has ended with an error.",
        "# TYPE teds_sink_failed gauge",
        f"teds_sink_failed{sink} 1",
        "# HELP teds_messages_per_second Messages to ROS and MQTT now.",
        "# TYPE teds_messages_per_second gauge",
        "teds_messages_per_second 12.5",
        "# HELP teds_live_clients Clients of the live channel.",
        "# TYPE teds_live_clients gauge",
        "teds_live_clients 3",
        "# HELP teds_plant_stations Stations of the plant.",
        "# TYPE teds_plant_stations gauge",
        "teds_plant_stations 2",
    ]


def asked_for(query: str) -> UpdateRequest:
    """Return what a POST to /updates asks for, by a service whose node "arm" is also known by its UUID."""
    known = {"arm": "aa" * 10, "aa" * 10: "aa" * 10, "leg": "bb" * 10}
    daemon: Any = SimpleNamespace(known=lambda text: known[text])
    return asyncio.run(resources.Resources(daemon)._update_request(request(query)))


def test_a_board_that_is_named_twice_is_updated_once_in_the_order_of_the_names() -> None:
    assert asked_for(f"nodes=leg,arm,{'aa' * 10},leg").uuids == ("bb" * 10, "aa" * 10)


def test_an_update_without_more_words_goes_board_by_board_to_no_other_type_and_to_no_older_version() -> None:
    assert asked_for("nodes=arm") == UpdateRequest(
        ("aa" * 10,), frozenset(), allow_downgrade=False, parallel=1, wait=180
    )


def test_the_words_of_an_update_are_read() -> None:
    query = "nodes=arm,leg&other_board=leg&allow_downgrade=1&parallel=24&wait=3600"
    assert asked_for(query) == UpdateRequest(
        ("aa" * 10, "bb" * 10), frozenset({"bb" * 10}), allow_downgrade=True, parallel=24, wait=3600
    )


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("", "An update needs nodes or match."),
        ("nodes=arm&match=a*", "An update needs nodes or match."),
        ("nodes=arm&parallel=25", "parallel must be a whole number from 1 to 24."),
        ("nodes=arm&parallel=0", "parallel must be a whole number from 1 to 24."),
        ("nodes=arm&wait=3601", "wait must be a whole number from 1 to 3600."),
        ("nodes=arm&allow_downgrade=2", "allow_downgrade must be 1 or 0."),
        (f"nodes={','.join(['arm'] * 1001)}", "nodes may name at most 1000 nodes."),
    ],
)
def test_an_update_of_other_words_is_refused(query: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        asked_for(query)
    assert refused.value.message == message


@pytest.mark.parametrize(
    ("server", "host", "base"),
    [
        (("127.0.0.1", 8351), "bench.example:8351", "https://bench.example:8351"),
        (("127.0.0.1", 8351), "", ""),
        (("/home/arm/ncap.sock", None), "localhost", ""),
        (None, "localhost", ""),
    ],
)
def test_things_have_the_address_under_which_they_were_asked_for_and_none_over_the_unix_socket(
    server: tuple[str, int | None] | None, host: str, base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over the Unix socket they had http://localhost/ as their base, at which nobody listens."""
    asked: list[tuple[object, str]] = []
    monkeypatch.setattr(wot, "_descriptions", lambda daemon, base: asked.append((daemon, base)) or [{"title": "Ä"}])
    daemon: Any = SimpleNamespace()
    scope = {"type": "http", "method": "GET", "path": "/", "scheme": "https", "server": server, "query_string": b""}
    headers = [(b"host", host.encode())] if host else []
    called: Any = wot.route(daemon).endpoint
    answer = asyncio.run(called(Request({**scope, "headers": headers, CALLER: Caller("arm", "script")})))
    assert asked == [(daemon, base)]
    assert answer.body.decode() == '[{"title": "Ä"}]'
    assert answer.headers["content-type"].startswith("application/ld+json")


@pytest.mark.parametrize(
    ("given", "media", "body"),
    [
        ({}, "application/xml", "xml"),
        ({"format": "1"}, "application/xml", "xml"),
        ({"format": "0"}, "text/plain", "1\nÄ<\n"),
        ({"format": "2"}, "application/xml", "xml"),
        ({"format": "0", "responseformat": "XML"}, "application/xml", "xml"),
        ({"responseformat": "Json"}, "application/json", '{"timId":1,"name":"Ä<"}'),
    ],
)
def test_an_answer_of_clause_12_is_in_the_form_that_was_asked_for_and_whole_xml_without_one(
    given: dict[str, str], media: str, body: str
) -> None:
    answer = clause12._shown("ReadTeds", {"timId": 1, "name": "Ä<"}, given)
    assert answer.media_type == media
    if body == "xml":
        body = (
            "<?xml version='1.0' encoding='utf-8'?>\n"
            "<ReadTedsHTTPResponse><timId>1</timId><name>Ä&lt;</name></ReadTedsHTTPResponse>"
        )
    assert bytes(answer.body).decode() == body
