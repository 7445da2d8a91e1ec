"""What the API does, asked of a running daemon with real (virtual) nodes: by its Python client, as a script would."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Barrier
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote, urljoin
from urllib.request import Request, urlopen

import pytest

from teds_provision.client import ApiError, Client
from teds_provision.ncap.nodes.sheets import curves
from teds_provision.station.store.store import Store
from teds_provision.teds.calibration import read_calibrations
from teds_provision.teds.profile import load_profile
from tests.e2e.desk import ANGLE
from tests.ncap.service import Service, verdict, verified, virtual
from tests.pace import best_of, succeeds, until
from tests.places import free_bus

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def asked(service: Service) -> Client:
    return service.client()


@pytest.fixture(scope="module")
def hand(service: Service) -> str:
    """Return a virtual gripper of the daemon: channel 1 an actuator, 2 and 3 sensors."""
    return virtual(service)


@pytest.fixture(autouse=True)
def nothing_begun_is_left(service: Service, asked: Client, request: pytest.FixtureRequest) -> Iterator[None]:
    """A test that fails leaves no measurement, no group, no other detection and no virtual node to the next one."""
    if "hand" in request.fixturenames:
        request.getfixturevalue("hand")
    before = [item["uuid"] for item in asked.request("GET", "/virtual")["virtual"]]
    yield
    for measurement in asked.request("GET", "/measurements")["measurements"]:
        asked.end_measurement(measurement["id"])
    for group in asked.request("GET", "/groups")["groups"]:
        asked.request("DELETE", f"/groups/{group['name']}")
    for item in asked.request("GET", "/virtual")["virtual"]:
        if item["uuid"] not in before:
            asked.request("DELETE", f"/virtual/{item['uuid']}")
    if asked.status()["detection"] != "whitelist":
        asked.request("PUT", "/detection", {"mode": "whitelist"})
    service.desk.clear(but=[service.process])


def refused(asked: Client, status: int, code: str, method: str, path: str, body: Any = None) -> str:
    with pytest.raises(ApiError) as error:
        asked.request(method, path, body)
    assert (error.value.status, error.value.code) == (status, code), error.value.message
    return error.value.message + error.value.hint


def measured(asked: Client, uuid: str) -> dict[str, Any]:
    """Wait until values of a node come, and the newest is younger than two seconds."""

    def fresh() -> dict[str, Any] | None:
        node = asked.node(uuid)
        last = node["channels"][1]["last"]
        running = (node["measuring"] or {}).get("state") == "running"  # else it is the last one's value
        return node if running and last and last["age"] < 2 else None

    return dict(until(fresh))


def test_status_says_what_runs(service: Service, asked: Client) -> None:
    status = asked.status()
    assert status["station"]["name"] == "bench"
    assert (status["detection"], status["write"], status["url"]) == ("whitelist", True, service.url)
    until(lambda: asked.status()["links"][0]["state"] == "up")
    assert asked.status()["links"][0]["via"] == "can"
    assert {"sinks", "clock_error", "budget", "measurements", "strangers"} <= set(status)


def test_a_node_has_its_verdict_with_checks_and_its_channels_with_units(asked: Client, hand: str) -> None:
    node = asked.node("hand")
    assert (node["uuid"], verdict(node), node["state"], node["present"]) == (hand, "authentic", "provisioned", True)
    assert node["virtual"] is True
    assert {check["name"] for check in node["verdict"]["checks"]} >= {"signature", "session", "not revoked"}
    assert not [check for check in node["verdict"]["checks"] if check["result"] == "failed"]
    assert (node["verdict"]["from"], node["heard"]) == ("session", None)
    opening = node["channels"][1]
    assert (opening["name"], opening["kind"], opening["unit"], opening["low"]) == ("opening", "sensor", "m", 0.0)
    assert opening["high"] == pytest.approx(0.11)
    assert opening["uncertainty"] == pytest.approx(1e-4)
    assert opening["topic"] == "/bench/hand/opening"
    assert node["firmware"] is not None
    assert node["firmware"]["text"] == "virtual/teds-provision"
    assert (node["firmware"]["from"], node["firmware"]["state"]) == ("session", "unjudged")
    asked.locate("hand", 5)
    asked.locate("hand", 0)
    with pytest.raises(ApiError) as caught:
        asked.locate("hand", 61)
    assert caught.value.status == 422
    assert asked.node(hand[:6])["uuid"] == hand
    assert hand in {node["uuid"] for node in asked.nodes()}


def test_things_are_described_for_the_web_of_things_and_read_at_their_forms(
    service: Service, asked: Client, hand: str
) -> None:
    """``/.well-known/wot``: asked as a client of the Web of Things does, over HTTP with a token that may only read."""
    url, token = service.url, service.token("wot", "--read-only")
    found = fetched(f"{url}/.well-known/wot", token)
    [thing] = [thing for thing in found if thing["id"] == f"urn:teds:{hand}"]
    [form] = next(iter(thing["properties"].values()))["forms"]
    channel = fetched(urljoin(thing["base"], form["href"]), token)
    assert channel == next(
        listed for listed in asked.node(hand)["channels"] if listed["number"] == channel["number"]
    ) | {"last": channel["last"]}
    with pytest.raises(HTTPError) as refusal:
        fetched(f"{url}/.well-known/wot", "")
    assert refusal.value.code == 401
    refused(asked, 404, "not-found", "GET", f"/nodes/{hand}/channels/9")


def fetched(url: str, token: str) -> Any:
    request = Request(url, headers={"authorization": f"Bearer {token}"} if token else {})
    with urlopen(request, timeout=20) as answer:
        return json.load(answer)


def test_the_datasheet_is_read_decoded_and_given_as_a_document(asked: Client, hand: str) -> None:
    sheet = asked.request("GET", f"/nodes/{hand}/teds")
    assert sheet["verdict"] == "authentic"
    assert {"MetaTEDS", "XdcrName", "CalTEDS"} <= {item["name"] for item in sheet["teds"]}
    curve = next(curve for curve in sheet["curves"] if curve["channel"] == 2)
    assert curve["points"][0] == pytest.approx([0, 0])
    assert curve["points"][-1][1] == pytest.approx(0.11, rel=1e-3)
    assert asked.request("GET", f"/nodes/{hand}/teds?format=xml").startswith("<?xml")
    assert asked.request("GET", f"/nodes/{hand}/teds?format=json")["format"] == "teds/1"
    assert asked.request("GET", f"/nodes/{hand}/teds?format=hex").startswith("#")
    refused(asked, 422, "usage", "GET", f"/nodes/{hand}/teds?format=pdf")


def test_a_datasheet_is_written_after_its_diff_was_shown(asked: Client, hand: str) -> None:
    document = asked.request("GET", f"/nodes/{hand}/teds?format=xml")
    changed = document.replace(">gripper<", ">left hand<").replace(">hand<", ">left hand<")
    assert changed != document
    plan = asked.request("PUT", f"/nodes/{hand}/teds?dry_run=1", {"content": changed, "format": "xml"})
    assert [change["after"] for change in plan["changes"]] == ['"left hand"'] or "left hand" in plan["changes"][0][
        "text"
    ]
    assert asked.request("PUT", f"/nodes/{hand}/teds?dry_run=1", {"content": document})["changes"] == []
    before = asked.node(hand)["sequence"]
    done = asked.request("PUT", f"/nodes/{hand}/teds", {"content": changed})
    assert done["verdict"] == "authentic"
    assert [step["result"] for step in done["steps"]] == ["done"] * 4
    assert (asked.node(hand)["sequence"], asked.node(hand)["name"]) == (before + 1, "left hand")
    back = asked.request("PUT", f"/nodes/{hand}/teds", {"content": document})
    assert back["verdict"] == "authentic"


def test_a_datasheet_that_another_client_wrote_after_the_review_is_not_overwritten(
    service: Service, asked: Client, hand: str
) -> None:
    other, path = service.client(), f"/nodes/{hand}/teds"
    document = asked.request("GET", f"{path}?format=xml")
    name = asked.node(hand)["name"]
    mine, others = (document.replace(f">{name}<", f">{word} {name}<") for word in ("my", "other"))
    assert asked.write_teds(hand, mine, dry_run=True)["changes"]
    reviewed = asked.etag
    assert other.write_teds(hand, others)["verdict"] == "authentic", "one that has read nothing writes as before"
    written = asked.node(hand)["sequence"]
    for _ in range(2):  # repeating it is no way around the review
        with pytest.raises(ApiError) as error:
            asked.write_teds(hand, mine)
        assert (error.value.status, error.value.code, error.value.exit_code) == (412, "changed", 6)
    with pytest.raises(ApiError):
        other.request("PUT", path, {"content": mine}, if_match=f'W/"1", {reviewed}')
    assert (asked.node(hand)["sequence"], asked.node(hand)["name"]) == (written, f"other {name}")
    tags = set()
    for query in ("", "?format=xml", "?format=json", "?format=hex"):
        asked.request("GET", path + query)
        tags.add(asked.etag)
    assert asked.write_teds(hand, document, dry_run=True)["changes"]
    assert tags == {asked.etag}, "one tag for one datasheet"
    assert asked.write_teds(hand, document)["verdict"] == "authentic"
    assert asked.write_teds(hand, document)["verdict"] == "authentic", "what this client wrote itself is no surprise"
    assert asked.request("PUT", path, {"content": document}, if_match="*")["verdict"] == "authentic"


def test_a_datasheet_of_another_type_retypes_no_board_without_the_option(
    service: Service, asked: Client, hand: str
) -> None:
    virtual(service, ANGLE, "elbow")
    document = asked.request("GET", "/nodes/elbow/teds?format=json")
    path, body = f"/nodes/{hand}/teds", {"content": json.dumps(document).replace(asked.node("elbow")["uuid"], hand)}
    before = asked.node(hand)["sequence"]
    for where in (path, f"{path}?dry_run=1"):
        assert "of a different type" in refused(asked, 422, "wrong-board", "PUT", where, body)
    assert asked.node(hand)["sequence"] == before
    assert asked.request("PUT", f"{path}?dry_run=1", {**body, "retype": True})["changes"]
    [noted] = asked.request("GET", f"/log?act=api&failed=1&uuid={hand}&limit=1")["entries"]
    assert (noted["outcome"], noted["facts"]["method"]) == ("wrong-board", "PUT")


def test_an_entry_of_an_earlier_clock_hides_no_other_entry(
    service: Service, asked: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store.open(service.station.home) as store:
        for day in ("2099-05-04", "2099-05-05", "2099-05-04", "2099-05-05"):
            monkeypatch.setattr("teds_provision.station.store.audit.utc_now", lambda day=day: f"{day}T12:00:00Z")
            store.audit.append("verify", None, f"of {day}")
    path = "/log?act=verify&since=2099-05-05T00:00:00Z"
    newest = asked.request("GET", f"{path}&limit=1")
    both = asked.request("GET", path)
    assert [entry["outcome"] for entry in both["entries"]] == ["of 2099-05-05"] * 2
    assert (newest["entries"], both["intact"]) == (both["entries"][1:], True)
    [older] = asked.request("GET", f"{path}&before={newest['entries'][0]['seq']}")["entries"]
    assert older == both["entries"][0]


def test_a_refused_change_is_logged_with_who_asked_for_what_and_why(service: Service, asked: Client, hand: str) -> None:
    asked.request("POST", "/groups", {"name": "robot", "uuids": [hand]})
    asked.request("POST", "/measurements", {"group": "robot", "rate": 50})
    measured(asked, hand)
    headers: dict[str, str | None] = {"Content-Type": "application/json"}
    headers["Authorization"] = f"Bearer {service.token('robot 8')}"
    body = json.dumps({"uuid": hand, "channel": 2, "name": "other"})
    assert service.raw("PUT", "/api/v1/names", headers, body).status == 409
    assert service.raw("PUT", "/api/v1/names", headers, '{"no such": 1}').status == 422, "no request, no entry"
    assert service.raw("GET", "/api/v1/log?since=yesterday", headers).status == 422, "it changes nothing: no entry"
    [noted] = asked.request("GET", "/log?act=api&limit=1")["entries"]
    assert (noted["actor"], noted["outcome"], noted["failed"]) == ("robot 8", "frozen", True)
    facts = noted["facts"]
    assert (facts["path"], facts["name"], facts["channel"]) == ("/api/v1/names", "other", 2)
    assert "frozen" in facts["why"] or "measured" in facts["why"]


def test_the_curve_of_an_angle_is_drawn_as_it_is_measured_within_its_turn() -> None:
    profile = load_profile(ANGLE)
    text = "# zero-offset: 90\nraw,value [degree]\n0,0\n65536,360\n"
    made = read_calibrations(text, "angle.csv", profile)
    (curve,) = curves(profile.build(bytes(10), calibration=made).blocks)
    values = [y for _, y in curve["points"] if y is not None]
    turn = 360 if curve["y_unit"] == "°" else 2 * math.pi
    assert 0 <= min(values) < max(values) <= turn * 1.000001
    assert values[0] == pytest.approx(turn / 4)
    [gap] = [at for at, (_, y) in enumerate(curve["points"]) if y is None]
    (before, top), _, (after, bottom) = curve["points"][gap - 1 : gap + 2]
    assert (before, after, top, bottom) == pytest.approx((49152, 49152, turn, 0), abs=1), "no line across"


def test_a_datasheet_that_is_damaged_of_another_node_or_none_is_refused(asked: Client, hand: str) -> None:
    document = asked.request("GET", f"/nodes/{hand}/teds?format=xml")
    path = f"/nodes/{hand}/teds"
    refused(asked, 422, "bad-data", "PUT", path, {"content": "<nonsense/>"})
    refused(asked, 422, "bad-data", "PUT", path, {"content": ""})
    refused(
        asked, 422, "bad-data", "PUT", path, {"content": '<!DOCTYPE x [<!ENTITY y SYSTEM "file:///etc/passwd">]><x/>'}
    )
    other = document.replace(hand, "11" * 10)
    assert "11" * 10 in refused(asked, 422, "bad-data", "PUT", path, {"content": other})
    refused(asked, 422, "bad-request", "PUT", path, {})


def test_a_measurement_gives_values_freezes_its_nodes_and_ends(service: Service, asked: Client, hand: str) -> None:
    asked.request("POST", "/groups", {"name": "robot", "uuids": [hand]})
    made = asked.request("POST", "/measurements", {"group": "robot", "rate": 50, "sinks": ["run.csv"]})
    node = measured(asked, hand)
    document = asked.request("GET", f"/nodes/{hand}/teds?format=xml")
    assert node["measurement"] == made["id"]
    assert 0 <= node["channels"][1]["last"]["value"] <= 0.11
    for method, path, body in (
        ("PUT", f"/nodes/{hand}/teds", {"content": document}),
        ("PUT", "/groups/robot", {"uuids": []}),
        ("DELETE", "/groups/robot", None),
        ("PUT", "/names", {"uuid": hand, "channel": 2, "name": "other"}),
        ("DELETE", f"/virtual/{hand}", None),
    ):
        refused(asked, 409, "frozen", method, path, body)
    assert "already being measured" in refused(asked, 423, "node-busy", "POST", "/measurements", {"uuids": [hand]})
    assert asked.request("GET", f"/nodes/{hand}/teds")["verdict"] == "authentic", "reading goes on meanwhile"

    def running() -> Any:
        [entry] = asked.request("GET", "/measurements")["measurements"]
        return entry if (entry["state"], entry["nodes"][0]["state"]) == ("running", "running") else None

    measurement = until(running)
    assert measurement["rate"] == 50
    until(lambda: asked.request("GET", "/measurements")["measurements"][0]["nodes"][0]["samples"] > 20)
    past = asked.past(hand, 2)
    assert past["count"][-1] > 0
    assert -1e-12 <= (past["low"][-1] or 0) <= (past["high"][-1] or 0) <= 0.11, "a line through its points, rounded"
    assert all(len(past[name]) == len(past["time"]) for name in ("low", "high", "count", "invalid", "lost"))
    asked.end_measurement(made["id"])
    assert asked.past(hand, 2, since=time.time() - 30, points=9)["time"], "it is kept when the measurement has ended"
    refused(asked, 404, "not-found", "GET", f"/nodes/{hand}/past?channel=200")
    for words in ("channel=0", "channel=x", "points=0", "points=3601", "from=yesterday"):
        refused(asked, 422, "usage", "GET", f"/nodes/{hand}/past?{words}")
    assert asked.request("GET", "/measurements")["measurements"] == []
    file = service.station.home / "recordings" / "run.csv"
    assert [str(file)] == measurement["files"]
    assert len([line for line in file.read_text().splitlines() if not line.startswith("#")]) > 10
    refused(asked, 404, "not-found", "DELETE", "/measurements/nothing")
    asked.request("DELETE", "/groups/robot")
    until(lambda: asked.node(hand)["measurement"] is None)


def test_a_measurement_that_cannot_be_is_refused(asked: Client, hand: str) -> None:
    for body in (
        {},
        {"group": "x", "uuids": [hand]},
        {"uuids": [hand], "rate": -1},
        {"uuids": [hand], "rate": "fast"},
        {"uuids": [hand], "kind": "wild"},
        {"uuids": [hand], "channels": [0]},
        {"uuids": "all"},
    ):
        refused(asked, 422, "bad-request", "POST", "/measurements", body)
    for sink in ("/etc/passwd.csv", "../up.csv", "exec:rm"):
        refused(asked, 422, "usage", "POST", "/measurements", {"uuids": [hand], "sinks": [sink]})
    refused(asked, 404, "not-found", "POST", "/measurements", {"group": "nobody"})
    fast = refused(asked, 422, "refused", "POST", "/measurements", {"uuids": [hand], "rate": 5000})
    assert "at most 100 samples" in fast, "what the datasheet rules out is not kept and tried for ever"
    refused(asked, 422, "bad-data", "POST", "/measurements", {"uuids": [hand], "channels": [1]})
    assert asked.request("GET", "/measurements")["measurements"] == []


def test_of_requests_at_once_that_measure_one_node_one_is_taken(service: Service, asked: Client, hand: str) -> None:
    """All of them were: who ended the one that ran saw the next begin, and a restart began them all."""
    asked.request("POST", "/groups", {"name": "pair", "uuids": [hand]})
    callers, together = [service.client() for _ in range(4)], Barrier(4)

    def ask(caller: Client, body: dict[str, Any]) -> int:
        together.wait()
        try:
            caller.request("POST", "/measurements", body)
        except ApiError as error:
            return error.status
        return 201

    with ThreadPoolExecutor(4) as pool:
        for body in ({"uuids": [hand]}, {"group": "pair"}) * 5:
            assert sorted(pool.map(ask, callers, [body] * 4)) == [201, 423, 423, 423]
            [measurement] = asked.request("GET", "/measurements")["measurements"]
            asked.end_measurement(measurement["id"])


def test_an_actuator_moves_within_its_limits_and_is_let_go(asked: Client, hand: str) -> None:
    path = f"/nodes/{hand}/channels/1"

    def is_safe_again() -> bool:
        """Set, and see whether it holds: on a machine that stands still for its dead-man it may not, once."""
        done = asked.request("PUT", path, {"value": 40, "unit": "mm", "hold": 20})
        assert done["applied"]["value"] == pytest.approx(40, abs=0.1)
        assert done["safe"] is False
        on = asked.request("PUT", path, {"value": 0.05, "hold": 20})
        assert (on["applied"]["unit"], on["applied"]["value"]) == ("m", pytest.approx(0.05, abs=1e-4))
        refused(asked, 422, "bad-data", "PUT", f"/nodes/{hand}/channels/2", {"value": 1})
        refused(asked, 422, "bad-data", "PUT", f"/nodes/{hand}/channels/9", {"value": 1})
        return bool(asked.node(hand)["channels"][0]["actuator"]["safe"])

    # Another channel's refusal does not end it either.
    succeeds(5, is_safe_again, because="a service that is not run for its dead-man lets go, as it must")
    assert asked.request("PUT", path, {"hold": 0})["safe"] is True
    assert asked.node(hand)["channels"][0]["actuator"]["safe"] is True
    assert "0.11" in refused(asked, 422, "refused", "PUT", path, {"value": 5, "hold": 1})
    refused(asked, 422, "bad-data", "PUT", path, {"value": 1, "unit": "kg"})
    refused(asked, 422, "bad-request", "PUT", path, {"value": 1, "hold": 1e9})
    refused(asked, 422, "bad-request", "PUT", path, {})
    log = asked.request("GET", "/log?limit=200")
    assert log["intact"] is True
    assert {"set", "virtual", "provision"} & {entry["act"] for entry in log["entries"]}


def test_an_actuator_that_is_not_requested_again_is_safe_soon(asked: Client, hand: str) -> None:

    def let_go() -> float:
        asked.request("PUT", f"/nodes/{hand}/channels/1", {"value": 0.02, "hold": 0.4})
        began = time.monotonic()
        until(lambda: asked.node(hand)["channels"][0]["actuator"]["safe"] is True)
        return time.monotonic() - began

    best_of(5, 5, let_go, because="five seconds hold a request, a dead-man and a node's answer")


def test_an_actuator_that_is_held_again_while_it_is_let_go_can_be_let_go(
    service: Service, asked: Client, hand: str
) -> None:
    """A button that is pressed twice: the second hold was forgotten by the end of the first, and moved on for 60 s."""
    path = f"/nodes/{hand}/channels/1"
    with service.client() as other, ThreadPoolExecutor(1) as beside:
        for milliseconds in range(10):
            asked.request("PUT", path, {"value": 0.05, "hold": 60})
            letting_go = beside.submit(other.request, "PUT", path, {"hold": 0})
            time.sleep(milliseconds / 1000)
            with suppress(ApiError):  # 423: it came before the release, which is meant for it too
                asked.request("PUT", path, {"value": 0.02, "hold": 60})
            letting_go.result()
            if asked.node(hand)["channels"][0]["actuator"]["safe"] is False:
                assert asked.request("PUT", path, {"hold": 0})["safe"] is not False


def test_names_are_given_kept_and_taken_back(asked: Client, hand: str) -> None:
    row = {"uuid": hand, "channel": 2, "name": "left/opening"}
    names = asked.request("PUT", "/names", row)["names"]
    assert {"uuid": hand, "channel": 2, "name": "left/opening", "topic": "/left/opening"} in names
    assert asked.node(hand)["channels"][1]["topic"] == "/left/opening"
    assert asked.request("PUT", "/names", row)["names"] == names, "its own name is no other channel's"
    refused(asked, 422, "usage", "PUT", "/names", {**row, "channel": 3})
    refused(asked, 422, "usage", "PUT", "/names", {**row, "name": "1/2"})
    assert "Channels in its datasheet: 1, 2, 3" in refused(
        asked, 404, "not-found", "PUT", "/names", {**row, "channel": 77, "name": "left/other"}
    )
    asked.request("PUT", "/names", {**row, "name": None})
    asked.request("PUT", "/names", {"uuid": hand, "channel": 77, "name": None})
    assert asked.node(hand)["channels"][1]["topic"] == "/bench/hand/opening"


@pytest.mark.nightly(
    "tests/ncap/test_api.py::test_a_namesake_that_comes_changes_no_name_that_is_being_published asks for the topics of "
    "a node that came later, too"
)
def test_a_node_that_comes_later_is_published_under_its_own_name(service: Service, asked: Client, hand: str) -> None:
    asked.request("GET", "/names")  # made while the node is unknown
    late = virtual(service, "accelerometer", "late comer")
    topics = [name["topic"] for name in asked.request("GET", "/names")["names"] if name["uuid"] == late]
    assert topics == ["late_comer", *(f"/bench/late_comer/acceleration_{axis}" for axis in "xyz")]
    asked.request("DELETE", f"/virtual/{late}", {})


def test_groups_are_made_changed_and_deleted(asked: Client, hand: str) -> None:
    made = asked.request("POST", "/groups", {"name": "both", "uuids": ["hand", "22" * 10]})
    assert made["groups"] == [{"name": "both", "uuids": sorted([hand, "22" * 10]), "measuring": False}]
    assert asked.request("PUT", "/groups/both", {"uuids": [hand]})["groups"][0]["uuids"] == [hand]
    assert asked.node(hand)["groups"] == ["both"]
    refused(asked, 422, "usage", "POST", "/groups", {"name": "abcd", "uuids": []})
    refused(asked, 422, "usage", "POST", "/groups", {"name": "all", "uuids": [hand]})
    for name in (".", ".."):  # a browser takes these two out of a path, so its page could never delete such a group
        refused(asked, 422, "usage", "POST", "/groups", {"name": name, "uuids": [hand]})
    for name in ("a/b", "/a", "a/", "a//b", "a/../b", "./a", "...", "%2e", "a?b#c", " a", "\u00e9\u4e2d"):
        asked.request("POST", "/groups", {"name": name, "uuids": [hand]})
        path = f"/groups/{quote(name, safe='')}"
        asked.request("PUT", path, {"uuids": []})
        assert [group["name"] for group in asked.request("DELETE", path)["groups"]] == ["both"]
    refused(asked, 404, "not-found", "PUT", "/groups/none", {"uuids": []})
    assert asked.request("DELETE", "/groups/both")["groups"] == []
    refused(asked, 404, "not-found", "DELETE", "/groups/both")


def test_a_running_measurement_follows_its_group_to_a_spare_and_ends_with_its_last_node(
    service: Service, asked: Client, hand: str
) -> None:
    """The group kept the dead node, and the service tried it for ever; so it did with one out of service."""
    old, spare = virtual(service, name="hook"), virtual(service, name="spare")
    asked.request("POST", "/groups", {"name": "crane", "uuids": [old]})
    made = asked.request("POST", "/measurements", {"group": "crane", "rate": 20})
    measured(asked, old)
    moved = service.station.ask("replace", old, spare, "--yes")["moved"]
    assert (moved["groups"], moved["measurements"], moved["ended"]) == (["crane"], [made["id"]], [])
    measured(asked, spare)
    [measurement] = asked.request("GET", "/measurements")["measurements"]
    assert (measurement["id"], measurement["uuids"]) == (made["id"], [spare])
    assert asked.node(spare)["groups"] == ["crane"]

    nowhere = ("--via", "can", "--can", free_bus(), "--timeout", "1")
    gone = service.station.ask("decommission", spare, "--force", "--yes", *nowhere)["removed"]
    assert (gone["groups"], gone["ended"]) == (["crane"], [made["id"]])
    until(lambda: asked.request("GET", "/measurements")["measurements"] == [])


def test_a_virtual_transducer_is_made_from_a_document_under_a_new_uuid(
    service: Service, asked: Client, hand: str
) -> None:
    document = asked.request("GET", f"/nodes/{hand}/teds?format=xml")
    assert hand in refused(asked, 409, "uuid-known", "POST", "/virtual", {"content": document, "source": "noise"})
    copy = {"content": document, "name": "copy", "source": "ramp:1", "new_uuid": True}
    made = asked.request("POST", "/virtual", copy)
    assert made["uuid"] != hand
    node = verified(service, made["uuid"])
    assert (verdict(node), node["virtual"], len(node["channels"])) == ("authentic", True, 3)
    assert node["name"] == "copy"
    assert {item["name"] for item in asked.request("GET", "/virtual")["virtual"]} == {"hand", "copy"}
    asked.request("DELETE", f"/virtual/{made['uuid']}")
    gone = until(lambda: (node := asked.node(made["uuid"]))["present"] is False and node)
    assert (gone["name"], gone["retired"], gone["whitelisted"]) == (None, "decommissioned", False)
    refused(asked, 422, "refused", "POST", "/measurements", {"uuids": [made["uuid"]]})
    again = asked.request("POST", "/virtual", {"profile": "load-cell", "name": "copy", "source": "noise"})
    asked.request("DELETE", f"/virtual/{again['uuid']}")
    refused(asked, 404, "not-found", "DELETE", f"/virtual/{made['uuid']}")
    refused(asked, 422, "usage", "POST", "/virtual", {"profile": "gripper", "source": "exec:true"})
    taken = refused(asked, 422, "usage", "POST", "/virtual", {"profile": "gripper", "name": "hand", "source": "noise"})
    assert f"Node {hand} already has the name 'hand'." in taken
    refused(asked, 422, "bad-request", "POST", "/virtual", {"source": "noise"})
    refused(asked, 404, "not-found", "POST", "/virtual", {"profile": "no-such-type", "source": "noise"})


def test_a_virtual_transducer_is_either_measured_or_removed(service: Service, asked: Client, hand: str) -> None:
    """Between the look whether it is measured and its end, a measurement of it began that could never run."""
    callers, together = [service.client() for _ in range(2)], Barrier(2)

    def ask(caller: Client, method: str, path: str, body: Any) -> int:
        together.wait()
        try:
            caller.request(method, path, body)
        except ApiError as error:
            return error.status
        return 200

    with ThreadPoolExecutor(2) as pool:
        uuid = ""
        for _ in range(3):
            uuid = uuid or virtual(service, "load-cell", "short")
            begun = pool.submit(ask, callers[0], "POST", "/measurements", {"uuids": [uuid], "rate": 20})
            ended = pool.submit(ask, callers[1], "DELETE", f"/virtual/{uuid}", None)
            there = [measurement["uuids"] for measurement in (begun.result(), asked.measurements())[1]]
            assert (begun.result(), ended.result(), there) in ((200, 409, [[uuid]]), (422, 200, []))
            for measurement in asked.measurements():
                asked.end_measurement(measurement["id"])
            if ended.result() == 409:
                until(lambda uuid=uuid: asked.node(uuid)["measurement"] is None)
            else:
                uuid = ""


def test_the_mode_that_holds_already_forgets_no_node(asked: Client, hand: str) -> None:
    until(lambda: asked.node(hand)["present"])
    for _ in range(5):
        asked.request("PUT", "/detection", {"mode": "whitelist"})
        assert asked.node(hand)["present"]


def test_detection_decides_who_is_shown(service: Service, asked: Client) -> None:
    node = service.desk.node("stranger", called="stranger").start(nfc=False, can=True)
    until(lambda: asked.status()["strangers"] == 1)
    assert node.uuid not in {node["uuid"] for node in asked.nodes()}
    assert service.station.ask("ncap", "detection", "transparent") == {"detection": "transparent"}
    seen = verified(service, node.uuid)
    assert (verdict(seen), seen["state"], seen["whitelisted"]) == ("unsigned", "factory", False)
    assert asked.request("PUT", "/detection", {"mode": "whitelist"}) == {"mode": "whitelist"}
    until(lambda: asked.status()["strangers"] == 1)
    done = asked.request("POST", f"/nodes/{node.uuid}/provision", {"profile": ANGLE, "name": "angle"})
    assert (done["state"], done["waits_for"]) == ("waiting", "tap"), "what is only a count is not met on the bus"
    assert asked.request("POST", f"/nodes/{node.uuid}/provision", {"cancel": True})["state"] == "cancelled"
    asked.request("PUT", "/detection", {"mode": "transparent"})
    verified(service, node.uuid)
    asked.request("POST", f"/nodes/{node.uuid}/provision", {"profile": ANGLE, "name": "angle"})
    run = until(lambda: (r := asked.request("GET", f"/nodes/{node.uuid}/provision"))["state"] != "running" and r)
    assert (run["state"], run["verdict"]) == ("done", "authentic"), run
    assert [step["name"] for step in run["steps"]] == [
        "identify",
        "whitelist",
        "agree",
        "build",
        "sign",
        "write",
        "verify",
        "check",
    ]
    assert asked.node("angle")["whitelisted"] is True
    asked.request("PUT", "/detection", {"mode": "whitelist"})
    assert verdict(verified(service, node.uuid)) == "authentic"
    refused(asked, 404, "not-found", "POST", f"/nodes/{node.uuid}/provision", {"profile": "no-such-type"})


def test_the_command_line_sees_what_the_daemon_did_and_the_daemon_what_it_did(
    service: Service, asked: Client, hand: str
) -> None:
    assert hand in json.dumps(service.station.ask("nodes", "hand"))
    service.station.ask("group", "create", "made-beside", hand)
    until(lambda: asked.request("GET", "/groups")["groups"])
    until(lambda: asked.node(hand)["groups"] == ["made-beside"])
    reply = service.station.ask("ncap", "status")
    assert hand in {node["uuid"] for node in reply["nodes"]}
    service.station.ask("group", "delete", "made-beside")


def test_more_than_a_thousand_nodes_come_in_pages(service: Service, asked: Client, hand: str, tmp_path: Path) -> None:
    many = [f"{number:020x}" for number in range(1, 2346)]
    sheet = tmp_path / "many.csv"
    sheet.write_text("uuid\n" + "\n".join(many) + "\n")
    service.station.ask("whitelist", "import", sheet)

    def settled() -> tuple[dict[str, Any], list[str]] | None:
        """Return the first page, and all of them where no node of another test came between the two questions."""
        first = asked.request("GET", "/nodes")
        every = [node["uuid"] for node in asked.nodes()]
        return (first, every) if first["total"] > 2000 and first["total"] == len(every) else None

    answer, uuids = until(settled)
    assert len(answer["nodes"]) == 1000
    assert len(uuids) == len(set(uuids))
    assert {*many, hand} <= set(uuids)
    few = asked.request("GET", f"/nodes?offset={answer['total'] - 1}&limit=5")
    assert [node["uuid"] for node in few["nodes"]] == uuids[-1:]


def test_a_namesake_that_comes_changes_no_name_that_is_being_published(
    service: Service, asked: Client, hand: str
) -> None:
    """/names told of the topics that the next measurement would have, while the running one published under others."""

    def topics() -> dict[str, set[str]]:
        found: dict[str, set[str]] = {}
        for row in asked.request("GET", "/names")["names"]:
            found.setdefault(row["uuid"], set()).add(row["topic"])
        return found

    made = asked.request("POST", "/measurements", {"uuids": [hand], "rate": 20})
    measured(asked, hand)
    before = topics()[hand]
    other = virtual(service, name="hand.")
    during = topics()
    assert (
        during[hand]
        == before
        == {"hand", *(f"/bench/hand/{name}" for name in ("opening_set_point", "opening", "grip_force"))}
    )
    assert not during[other] & during[hand]
    assert asked.node(hand)["channels"][1]["topic"] == "/bench/hand/opening"
    row = {"uuid": other, "channel": 2, "name": "bench/hand/opening"}
    refused(asked, 422, "usage", "PUT", "/names", row)
    asked.end_measurement(made["id"])
    assert f"/bench/hand_{hand[:8]}/opening" in topics()[hand], "the next one tells them apart"
