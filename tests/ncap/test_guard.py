"""Who may: every refusal of api.md, asked of a running daemon; and what it never gives away."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import socket
import stat
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.requests import Request
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from teds_provision.errors import StoreError
from teds_provision.ncap.nodes.directory import for_reader
from teds_provision.ncap.sinks import for_readers
from teds_provision.ncap.web.guard import CALLER, Caller, Guard, Message, Receive, RequestRefusedError, Scope, Send
from teds_provision.ncap.web.responses import answer_error
from teds_provision.ncap.web.tokens import Tokens
from tests.e2e.desk import PASSPHRASE, Desk
from tests.ncap.service import Answer, Service, virtual
from tests.pace import PATIENCE, until
from tests.places import self_signed

pytestmark = pytest.mark.link
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def bearer(service: Service) -> dict[str, str | None]:
    return {"Authorization": f"Bearer {service.token('script')}"}


def cookie_of(service: Service) -> str:
    """Return a browser that was let in by `ncap open`."""
    path = service.station.ask("ncap", "open")["url"].removeprefix(service.url)
    answer = service.raw("GET", path)
    assert answer.status == 303, answer
    return answer.headers["set-cookie"].partition(";")[0]


def refusals(port: int) -> list[tuple[str, str, str, dict[str, str | None], Any, int, str]]:
    """Return what is asked (with a good token unless it says otherwise), and how it is refused."""
    other = f"http://127.0.0.1:{port + 1}"
    put, status = "/api/v1/detection", "/api/v1/status"
    body = json.dumps({"mode": "whitelist"})
    long = json.dumps({"mode": "x" * (1 << 20)})
    return [
        ("no token", "GET", status, {"Authorization": None}, None, 401, "no-token"),
        ("wrong token", "GET", status, {"Authorization": "Bearer nonsense"}, None, 401, "wrong-token"),
        ("wrong cookie", "GET", status, {"Authorization": None, "Cookie": f"ncap-{port}=x"}, None, 401, "wrong-token"),
        ("the page without a token", "GET", "/", {"Authorization": None}, None, 401, "no-token"),
        ("a used or foreign login", "GET", "/login?token=abc", {"Authorization": None}, None, 401, "wrong-token"),
        ("foreign Host", "GET", status, {"Host": "evil.example"}, None, 421, "foreign-host"),
        ("a name that ends like ours", "GET", status, {"Host": f"127.evil.com:{port}"}, None, 421, "foreign-host"),
        ("our address at another port", "GET", status, {"Host": f"127.0.0.1:{port + 1}"}, None, 421, "foreign-host"),
        ("no Host", "GET", status, {"Host": ""}, None, 421, "foreign-host"),
        ("foreign Origin", "GET", status, {"Origin": "https://evil.example"}, None, 403, "foreign-origin"),
        ("another local port", "GET", status, {"Origin": other}, None, 403, "foreign-origin"),
        ("Origin null", "GET", status, {"Origin": "null"}, None, 403, "foreign-origin"),
        ("https for http", "GET", status, {"Origin": f"https://127.0.0.1:{port}"}, None, 403, "foreign-origin"),
        ("cross-site", "GET", status, {"Sec-Fetch-Site": "cross-site"}, None, 403, "foreign-origin"),
        ("same-site, another port", "GET", status, {"Sec-Fetch-Site": "same-site"}, None, 403, "foreign-origin"),
        ("a form", "PUT", put, {"Content-Type": "application/x-www-form-urlencoded"}, "mode=x", 415, "not-json"),
        ("text", "POST", "/api/v1/discover", {"Content-Type": "text/plain"}, "{}", 415, "not-json"),
        ("no type", "PUT", put, {}, body, 415, "not-json"),
        ("DELETE with a form", "DELETE", "/api/v1/measurements/x", {}, "a=b", 415, "not-json"),
        ("too long", "PUT", put, JSON, long, 413, "too-large"),
        ("too long, said", "PUT", put, {**JSON, "Content-Length": str(1 << 40)}, b"", 413, "too-large"),
        ("a mode that is none", "PUT", put, JSON, '{"mode": "all"}', 422, "bad-request"),
        ("no JSON", "PUT", put, JSON, "{", 422, "bad-request"),
        ("no object", "PUT", put, JSON, "[1]", 422, "bad-request"),
        ("a member too many", "PUT", put, JSON, '{"mode": "whitelist", "x": 1}', 422, "bad-request"),
        ("no such node", "GET", "/api/v1/nodes/ffffffffffffffffffff", {}, None, 404, "not-found"),
        ("no such resource", "GET", "/api/v1/secrets", {}, None, 404, "not-found"),
        ("not for this resource", "PUT", "/api/v1/nodes", JSON, "{}", 405, "usage"),
        ("a file of this user as a source", "POST", "/api/v1/virtual", JSON,
         '{"profile": "gripper", "source": "file:/etc/passwd"}', 422, "refused"),
        ("a socket of this user as a source", "POST", "/api/v1/virtual", JSON,
         '{"profile": "gripper", "source": "unix:/run/x"}', 422, "refused"),
        ("a file of this user as a profile", "POST", "/api/v1/virtual", JSON,
         '{"profile": "/etc/passwd"}', 422, "bad-request"),
        ("a file of the working folder as a profile", "POST", "/api/v1/nodes/next/provision", JSON,
         '{"profile": "x.toml"}', 422, "bad-request"),
        ("a period of nothing", "POST", "/api/v1/virtual", JSON,
         '{"profile": "gripper", "source": "sine:0"}', 422, "usage"),
        ("a period without end", "POST", "/api/v1/virtual", JSON,
         '{"profile": "gripper", "source": "ramp:99999999999999999999"}', 422, "usage"),
        ("a member twice", "PUT", put, JSON, '{"mode": "whitelist", "mode": "transparent"}', 422, "bad-request"),
        ("a member twice, deeper", "POST", "/api/v1/groups", JSON,
         '{"name": "x", "uuids": [{"a": 1, "a": 2}]}', 422, "bad-request"),
        ("a number of thousands of digits", "GET", f"/api/v1/log?limit={'1' * 5000}", {}, None, 422, "usage"),
        ("a moment before all years", "GET", "/api/v1/log?since=0001-01-01T00:00:00%2B23:59", {}, None, 422, "usage"),
        ("an expression of no length", "POST", "/api/v1/measurements", JSON, '{"match": ""}', 422, "bad-request"),
        ("less than no node", "GET", "/api/v1/nodes?offset=-1", {}, None, 422, "usage"),
        ("more than a thousand nodes", "GET", "/api/v1/nodes?limit=1001", {}, None, 422, "usage"),
        ("the readers over the net", "GET", "/api/v1/lend", {}, None, 422, "refused"),
        ("a measured node over the net", "GET", f"/api/v1/nodes/{'00' * 10}/let-go", {}, None, 422, "refused"),
        ("a login link over the net", "POST", "/api/v1/login-link", JSON, "{}", 422, "refused"),
    ]  # fmt: skip


def test_every_refusal_of_the_contract(service: Service, bearer: dict[str, str | None]) -> None:
    wrong = []
    for what, method, path, headers, body, status, code in refusals(service.port):
        answer = service.raw(method, path, {**bearer, **headers}, body)
        if (answer.status, answer.code) != (status, code):
            wrong.append((what, answer.status, answer.text[:200]))
        assert set(answer.json["error"]) == {"code", "message", "hint"}, what
        assert "default-src 'none'" in answer.headers["content-security-policy"], what
        assert answer.headers["x-content-type-options"] == "nosniff", what
    assert not wrong
    assert service.raw("GET", "/api/v1/status", {**bearer, "host": "evil.example"}).status == 400, "two Hosts"


def test_a_refusal_shown_as_a_page_is_text() -> None:
    """Whatever a message quotes: in a browser's address line it is text, not elements."""

    async def refusing(_scope: Scope, _receive: Receive, _send: Send) -> None:
        raise RequestRefusedError(403, "refused", "<script>alert(1)</script>", "<b>")

    sent: list[Message] = []

    async def run() -> None:
        async def send(message: Message) -> None:
            sent.append(message)

        async def receive() -> Message:
            return {"type": "http.disconnect"}

        scope = {"type": "http", "method": "GET", "path": "/", "headers": [(b"accept", b"text/html")]}
        await Guard(refusing, Tokens(Path("nowhere")), None)(scope, receive, send)

    asyncio.run(run())
    assert b"&lt;script&gt;" in sent[1]["body"]
    assert b"<script" not in sent[1]["body"]
    assert b"<b>" not in sent[1]["body"]


def test_a_body_without_a_length_is_cut_off_all_the_same(service: Service, bearer: dict[str, str | None]) -> None:
    chunk = b"10000\r\n" + b"x" * 65536 + b"\r\n"
    headers = {**bearer, **JSON, "Transfer-Encoding": "chunked"}
    answer = service.raw("PUT", "/api/v1/detection", headers, chunk * 17 + b"0\r\n\r\n")
    assert (answer.status, answer.code) == (413, "too-large")


def test_a_body_of_two_lengths_is_refused_and_nothing_behind_it_is_a_request(
    service: Service, bearer: dict[str, str | None]
) -> None:
    """RFC 9112, section 6.3: a proxy in front may go by the other length, and pass a request on inside a body."""
    head = f"Host: 127.0.0.1:{service.port}\r\nAuthorization: {bearer['Authorization']}\r\n"
    both = "Content-Type: application/json\r\nContent-Length: 4\r\nTransfer-Encoding: chunked\r\n"
    hidden = f"GET /api/v1/status HTTP/1.1\r\n{head}\r\n"
    with socket.create_connection(("127.0.0.1", service.port), PATIENCE) as peer:
        peer.sendall(f"PUT /api/v1/detection HTTP/1.1\r\n{head}{both}\r\n0\r\n\r\n{hidden}".encode())
        answers = b"".join(iter(lambda: peer.recv(65536), b""))
    assert answers.count(b"HTTP/1.1 ") == 1, answers
    assert answers.startswith(b"HTTP/1.1 400 "), answers


def test_a_read_only_token_reads_and_changes_nothing(service: Service) -> None:
    bearer = {"Authorization": f"Bearer {service.token('reader', '--read-only')}"}
    assert service.raw("GET", "/api/v1/status", bearer).json["write"] is False
    for method, path in (
        ("PUT", "/api/v1/detection"),
        ("POST", "/api/v1/discover"),
        ("POST", "/api/v1/groups"),
        ("DELETE", "/api/v1/measurements/x"),
        ("PUT", "/api/v1/nodes/00/channels/1"),
        ("POST", "/api/v1/virtual"),
    ):
        answer = service.raw(method, path, {**bearer, **JSON}, "{}")
        assert (answer.status, answer.code) == (403, "read-only"), (method, path)


def test_an_unwritten_act_is_no_failure_of_the_store(service: Service, bearer: dict[str, str | None]) -> None:
    answer = service.raw("GET", "/api/v1/log?act=%00", bearer)
    assert (answer.status, answer.json["entries"]) == (200, [])


def test_a_read_only_token_learns_no_folder_from_an_error() -> None:
    error = StoreError(
        "The store /home/me/bench/store.sqlite3 cannot be used: the disk is full.", hint="See /api/v1/x."
    )

    def errors_of(*, read_only: bool) -> dict[str, str]:
        scope = {"type": "http", CALLER: Caller("robot", "script", read_only)}
        return dict(json.loads(bytes(answer_error(Request(scope), error).body))["error"])

    assert "/home/me/bench/" in errors_of(read_only=False)["message"]
    assert errors_of(read_only=True)["message"] == "The store store.sqlite3 cannot be used: the disk is full."
    assert errors_of(read_only=True)["hint"] == "See /api/v1/x."


def test_a_read_only_token_learns_no_folder_from_a_node_or_a_source() -> None:
    message = "The store /home/me/bench/store.sqlite3 cannot be used: the disk is full."
    node = {"name": "a/b", "topic": "/bench/hand", "problem": {"message": message}, "measuring": {"why": message}}
    without_folder = "The store store.sqlite3 cannot be used: the disk is full."
    assert for_reader(node) == node | {"problem": {"message": without_folder}, "measuring": {"why": without_folder}}
    assert for_reader(node | {"problem": None, "measuring": None})["problem"] is None
    assert for_readers(["file:/home/me/day.csv", "unix:/run/me/feed"]) == ["file:day.csv", "unix:feed"]


def test_a_token_that_may_only_read_is_shown_what_went_wrong_without_its_folder(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    feed = desk.folder / "feed.csv"
    feed.write_text("t,value\n0,1\n")
    with service.client() as asked:
        asked.request("POST", "/virtual", {"profile": "load-cell", "name": "one", "source": f"file:{feed}"})
        [uuid] = [item["uuid"] for item in asked.request("GET", "/virtual")["virtual"]]
        until(lambda: uuid in [node["uuid"] for node in asked.nodes()])
    reader = {"Authorization": f"Bearer {service.token('reader', '--read-only')}"}
    for path in ("/virtual", "/nodes", f"/nodes/{uuid}", "/status", "/measurements", "/log", "/profiles", "/names"):
        answer = service.raw("GET", f"/api/v1{path}", reader)
        assert answer.status == 200, path
        assert str(desk.folder) not in answer.text, path
    assert '"file:feed.csv"' in service.raw("GET", "/api/v1/virtual", reader).text
    service.end()


def test_a_token_that_is_removed_is_refused_at_once(service: Service) -> None:
    bearer = {"Authorization": f"Bearer {service.token('guest')}"}
    assert service.raw("GET", "/api/v1/status", bearer).status == 200
    service.station.ask("ncap", "token", "remove", "guest")
    assert service.raw("GET", "/api/v1/status", bearer).status == 401


def test_tokens_that_cannot_be_read_let_no_client_in_and_are_reported(service: Service) -> None:
    bearer = {"Authorization": f"Bearer {service.token('file')}"}
    file = service.station.home / "ncap-tokens.json"
    whole = file.read_bytes()
    try:
        file.write_bytes(b"{")
        for method, path in (("GET", "/api/v1/status"), ("PUT", "/api/v1/detection")):
            answer = service.raw(method, path, bearer)
            assert (answer.status, answer.code) == (503, "store"), path
            assert "no token is accepted" in answer.text
            assert str(service.station.home) not in answer.text
    finally:
        file.write_bytes(whole)
    assert service.raw("GET", "/api/v1/status", bearer).status == 200


def test_tokens_that_are_made_at_once_are_all_kept(tmp_path: Path) -> None:
    """`ncap token add` beside a daemon that lets a browser in: each writes the whole file."""
    homes = [Tokens(tmp_path) for _ in range(4)]

    def make(number: int) -> list[str]:
        return [homes[number].add(f"{number}-{value}") for value in range(10)]

    with ThreadPoolExecutor(len(homes)) as pool:
        made = [token for tokens in pool.map(make, range(len(homes))) for token in tokens]
    after = Tokens(tmp_path)
    assert all(after.find(token) is not None for token in made)
    assert after.find("nonsense") is None


def test_a_browser_is_let_in_for_thirty_days_and_its_login_link_for_five_minutes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = SimpleNamespace(wall=1_800_000_000.0, up=1000.0)
    clock = SimpleNamespace(time=lambda: now.wall, monotonic=lambda: now.up)
    monkeypatch.setattr("teds_provision.ncap.web.tokens.time", clock)
    tokens = Tokens(tmp_path)
    script, late = tokens.add("script"), tokens.login_link()
    cookie = tokens.login(tokens.login_link(read_only=True))
    assert cookie is not None
    now.up += 301
    assert tokens.login(late) is None
    now.wall += 30 * 86_400 - 1
    found = tokens.find(cookie)
    assert found is not None
    assert found.read_only
    now.wall += 2
    for tokens_object in (tokens, Tokens(tmp_path)):
        assert tokens_object.find(cookie) is None, "the daemon has it in memory, and the file still names it"
        assert [token.name for token in tokens_object.all()] == ["script"]
        assert tokens_object.find(script) is not None
    tokens.add("another")
    assert "browser" not in (tmp_path / "ncap-tokens.json").read_text()


def test_of_a_hundred_browsers_the_oldest_is_forgotten(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    cookies = [tokens.login(tokens.login_link()) or "" for _ in range(101)]
    good = [tokens.find(cookie) is not None for cookie in cookies]
    assert good == [False] + [True] * 100


def test_the_login_works_once_and_leaves_a_cookie_that_scripts_cannot_read(service: Service) -> None:
    url = service.station.ask("ncap", "open")["url"]
    path = url.removeprefix(service.url)
    first = service.raw("GET", path)
    assert (first.status, first.headers["location"]) == (303, "/")
    cookie = first.headers["set-cookie"]
    for word in (f"ncap-{service.port}=", "HttpOnly", "SameSite=Strict", "Path=/"):
        assert word in cookie
    assert service.raw("GET", path).status == 401, "the token of the URL works once"
    mine = {"Cookie": cookie.partition(";")[0], "Sec-Fetch-Site": "same-origin"}
    assert service.raw("GET", "/api/v1/status", mine).json["write"] is True
    for path in (f"/api/v1/nodes/{'00' * 10}/let-go", "/api/v1/lend"):
        assert status_of(service, path, mine) == 422, "only a command of this user takes a node or a reader"
    stranger = {**mine, "Origin": "http://evil.example"}
    assert service.raw("PUT", "/api/v1/detection", {**stranger, **JSON}, '{"mode": "transparent"}').status == 403


def status_of(service: Service, path: str, headers: dict[str, str]) -> int:
    """Return the status of an answer, whose body may have no end."""
    with closing(http.client.HTTPConnection("127.0.0.1", service.port, timeout=PATIENCE)) as connection:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status


def websocket(service: Service, headers: dict[str, str], origin: str | None = None) -> Any:
    return connect(
        f"ws://127.0.0.1:{service.port}/api/v1/live",
        additional_headers=headers,
        origin=origin,  # type: ignore[arg-type]
        compression=None,
        open_timeout=PATIENCE,
        proxy=None,
    )


def test_a_websocket_is_held_against_the_same_list(service: Service, bearer: dict[str, str]) -> None:
    mine = {"Cookie": cookie_of(service)}
    own = f"http://127.0.0.1:{service.port}"
    for what, headers, origin, status in (
        ("no token", {}, own, 401),
        ("foreign Origin with a good cookie", mine, "http://evil.example", 403),
        ("another local port", mine, f"http://127.0.0.1:{service.port + 1}", 403),
        ("a cookie without an Origin", mine, None, 403),
        ("cross-site", {**mine, "Sec-Fetch-Site": "cross-site"}, own, 403),
    ):
        with pytest.raises(InvalidStatus) as refused, websocket(service, headers, origin):
            pass
        assert refused.value.response.status_code == status, what
    for headers, origin in ((mine, own), (bearer, None)):
        with websocket(service, headers, origin) as live:
            assert json.loads(live.recv(PATIENCE))["type"] == "hello"


def test_ten_wrong_tokens_are_slowed_down_and_a_right_one_never(desk: Desk) -> None:
    """At a daemon of its own: for a minute after it every wrong token is 429 there, also those of other tests."""
    service = Service(desk, desk.station()).start()
    bearer = {"Authorization": f"Bearer {service.token('script')}"}
    wrong = {"Authorization": "Bearer guess"}
    answers = [service.raw("GET", "/api/v1/status", wrong) for _ in range(11)]
    assert (answers[-1].status, answers[-1].headers["retry-after"]) == (429, "60")
    slow: list[Answer] = []
    guessing = threading.Thread(target=lambda: slow.append(service.raw("GET", "/api/v1/status", wrong)))
    began = time.monotonic()
    guessing.start()
    assert service.raw("GET", "/api/v1/status", bearer).status == 200
    guessing.join()
    assert slow[0].status == 429
    assert time.monotonic() - began >= 0.9


def test_only_this_user_reaches_the_socket_and_the_tokens_are_kept_as_digests(service: Service) -> None:
    home = service.station.home
    assert stat.S_IMODE(os.stat(home / "ncap.sock").st_mode) == 0o600
    assert stat.S_ISSOCK(os.stat(home / "ncap.sock").st_mode)
    token = service.token("kept")
    kept = home / "ncap-tokens.json"
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert token not in kept.read_text()
    assert "kept" in json.dumps(service.station.ask("ncap", "token", "list"))
    assert service.station.refuses("ncap", "token", "add", "kept", code=2)
    assert service.station.refuses("ncap", "token", "remove", "nobody", code=3)


def test_no_answer_holds_a_secret(service: Service, bearer: dict[str, str | None]) -> None:
    uuid = virtual(service)
    flash = next((service.station.home / "virtual").glob("*/flash.json"))
    document = json.loads(flash.read_text())
    secrets = {PASSPHRASE, str(document["key"]), str(document["flash"]["key"]), str(bearer["Authorization"])[7:]}
    secrets |= {
        string
        for string in _strings(json.loads((service.station.home / "ncap-tokens.json").read_text()))
        if len(string) == 64
    }
    paths = ["status", "nodes", f"nodes/{uuid}", f"nodes/{uuid}/teds", "groups", "measurements", "names", "virtual",
             "log", "profiles", "detection"]  # fmt: skip
    for path in paths:
        answer = service.raw("GET", f"/api/v1/{path}", bearer)
        assert answer.status == 200, (path, answer.text)
        assert not [secret for secret in secrets if secret and secret in answer.text], path
    assert service.process is not None
    assert not [secret for secret in secrets if secret in service.process.out + service.process.err]


def _strings(value: Any) -> set[str]:
    if isinstance(value, dict):
        return set().union(*map(_strings, value.values()))
    if isinstance(value, list):
        return set().union(*map(_strings, value))
    return {value} if isinstance(value, str) else set()


def test_another_host_needs_tls_and_a_name(desk: Desk, tmp_path: Path) -> None:
    station = desk.station()
    tls = self_signed(tmp_path)
    refused = station.refuses("ncap", "run", "--http", "0.0.0.0:0", code=2)
    assert "--tls-cert" in refused["hint"]
    assert "--http-allow" in station.refuses("ncap", "run", "--http", "0.0.0.0:0", *tls, code=2)["hint"]
    assert "together" in station.refuses("ncap", "run", "--http", "127.0.0.1:0", *tls[:2], code=2)["message"]
    token = station.ask("ncap", "token", "add", "tls")["token"]
    running = station.start("--json", "ncap", "run", "--http", "127.0.0.1:0", *tls)
    [ready, *_] = running.wait_for_lines(1)
    assert ready["url"].startswith("https://127.0.0.1:")
    port = ready["url"].rpartition(":")[2]
    import ssl
    import urllib.request

    context = ssl.create_default_context(cafile=str(tls[1]))
    request = urllib.request.Request(
        f"https://localhost:{port}/api/v1/status", headers={"Authorization": f"Bearer {token}"}
    )
    opener = urllib.request.build_opener(  # whatever proxy this machine has
        urllib.request.ProxyHandler({}), urllib.request.HTTPSHandler(context=context)
    )
    with opener.open(request, timeout=60) as answer:
        assert answer.status == 200
    with socket.create_connection(("127.0.0.1", int(port)), PATIENCE) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert not plain.recv(100).startswith(b"HTTP/1.1 200")
