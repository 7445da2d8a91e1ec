"""The client of the API, without a base station: what it asks for, and under which condition it writes."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosedError, InvalidHandshake, InvalidStatus
from websockets.http11 import Response

from teds_provision.client import ApiError, Client, default_home
from teds_provision.errors import LinkError, PolicyError, UsageError

UUID, OTHER = "ab" * 10, "cd" * 10
Asked = tuple[str, str, Any, str | None]


class Desk(Client):
    """A client whose requests are kept, and answered by ``answers``; mock, no base station is there."""

    def __init__(self, *answers: Any) -> None:
        super().__init__("http://localhost:1")
        self.asked: list[Asked] = []
        self.answers = list(answers)

    def request(self, method: str, path: str, body: Any = None, *, if_match: str | None = None) -> Any:
        """Keep a request."""
        self.asked.append((method, path, body, if_match))
        return self.answers.pop(0) if self.answers else {"uuid": OTHER if OTHER in path else UUID, "safe": None}


def write(desk: Desk, node: str, *, dry_run: bool = False) -> str | None:
    """Write a datasheet; return the condition under which it is written."""
    desk.write_teds(node, "<teds/>", dry_run=dry_run)
    return desk.asked[-1][3]


@pytest.mark.parametrize("read", [lambda desk: desk.teds("hand"), lambda desk: write(desk, "hand", dry_run=True)])
def test_a_datasheet_that_was_read_is_the_condition_of_one_write_by_whichever_name(read: Callable[[Desk], Any]) -> None:
    """Read under its name and written under its UUID, its next write under the name was refused."""
    for first, second in (("hand", UUID), (UUID, "hand")):
        desk = Desk()
        desk.etag = '"e1"'
        read(desk)
        desk.etag = None
        assert write(desk, OTHER) is None, "another node's reading is no condition"
        assert write(desk, first) == '"e1"'
        assert write(desk, second) is None


def test_of_two_readings_of_a_node_under_two_names_the_later_is_the_condition() -> None:
    desk = Desk()
    for tag, name in (('"e1"', "hand"), ('"e2"', UUID)):
        desk.etag = tag
        desk.teds(name)
    desk.etag = None
    assert write(desk, "hand") == '"e2"'


def test_a_dry_run_is_under_no_condition_and_what_has_no_tag_makes_none() -> None:
    desk = Desk()
    desk.etag = '"e1"'
    desk.teds(UUID)
    desk.etag = '"e2"'
    assert write(desk, UUID, dry_run=True) is None
    desk.etag = None
    desk.teds(UUID)
    assert write(desk, UUID) == '"e2"', "the newest reading that is known"


def test_nodes_are_fetched_until_all_are_there_or_none_comes_any_more() -> None:
    pages = [
        {"nodes": [{"uuid": f"{at:020x}"} for at in range(*span)], "total": 5} for span in ((0, 2), (2, 4), (4, 5))
    ]
    desk = Desk(*pages)
    assert [int(node["uuid"], 16) for node in desk.nodes()] == [0, 1, 2, 3, 4]
    assert [path for _, path, *_ in desk.asked] == [f"/nodes?offset={offset}" for offset in (0, 2, 4)]
    some_left = Desk(pages[0], {"nodes": [], "total": 5})
    assert len(some_left.nodes()) == 2


@pytest.mark.parametrize(
    ("ask", "expected"),
    [
        (lambda desk: desk.past("a/b", 2), ("GET", "/nodes/a%2Fb/past?channel=2&points=600", None)),
        (
            lambda desk: desk.past(UUID, 1, since=0.0, until=9.5, points=3),
            ("GET", f"/nodes/{UUID}/past?channel=1&points=3&from=0.0&until=9.5", None),
        ),
        (lambda desk: desk.update(b"x", "a", "b"), ("POST", "/updates?nodes=a%2Cb", b"x")),
        (
            lambda desk: desk.update(b"x", match="all", dry_run=True, other_board=["a"], allow_downgrade=True, wait=9),
            ("POST", "/updates?match=all&dry_run=1&other_board=a&allow_downgrade=1&wait=9", b"x"),
        ),
        (lambda desk: desk.release_actuator(UUID, 3), ("PUT", f"/nodes/{UUID}/channels/3", {"hold": 0})),
        (
            lambda desk: desk.set(UUID, 3, 0.0),
            ("PUT", f"/nodes/{UUID}/channels/3", {"value": 0.0, "unit": None, "hold": None}),
        ),
        (lambda desk: desk.end_measurement("a/b"), ("DELETE", "/measurements/a%2Fb", None)),
        (lambda desk: desk.locate(UUID, 0), ("POST", f"/nodes/{UUID}/locate", {"seconds": 0})),
    ],
)
def test_each_call_asks_what_it_says(ask: Callable[[Desk], Any], expected: tuple[str, str, Any]) -> None:
    desk = Desk()
    ask(desk)
    [(method, path, body, condition)] = desk.asked
    assert ((method, path, body), condition) == (expected, None)


class Line:
    """A connection that answers what it is given, in order: an answer, or the failure of the request; a mock."""

    sock: Any = None

    def __init__(self, *answers: Any) -> None:
        self.answers, self.sent, self.closed = list(answers), list[tuple[Any, ...]](), 0

    def request(self, *words: Any) -> None:
        self.sent.append(words)

    def getresponse(self) -> Any:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        status, kind, octets = answer
        names = {"Content-Type": kind, "ETag": None}
        return SimpleNamespace(
            status=status, getheader=lambda name, otherwise=None: names[name] or otherwise, read=lambda: octets
        )

    def close(self) -> None:
        self.closed += 1


class Wired(Client):
    """A client that opens these connections one after the other, or fails to."""

    def __init__(self, *lines: Any, token: str | None = None) -> None:
        super().__init__("http://localhost:1", token=token)
        self.lines = list(lines)

    def _open(self) -> Any:
        line = self.lines.pop(0)
        if isinstance(line, Exception):
            raise line
        return line


JSON = "application/json"
UNKNOWN = b'{"error": {"code": "new-code", "message": "It is busy.", "hint": "Wait."}}'


@pytest.mark.parametrize(
    ("method", "body", "token", "if_match", "headers", "sent"),
    [
        ("GET", None, None, None, {}, None),
        ("GET", None, "t", None, {"Authorization": "Bearer t"}, None),
        ("POST", {"a": 1}, None, None, {"Content-Type": JSON}, '{"a": 1}'),
        ("PUT", {}, None, '"e1"', {"Content-Type": JSON, "If-Match": '"e1"'}, "{}"),
        ("POST", b"\0", None, None, {"Content-Type": "application/octet-stream"}, b"\0"),
        ("DELETE", None, None, None, {"Content-Type": JSON}, None),
    ],
)
def test_a_request_has_its_token_its_condition_and_the_type_of_its_body(
    method: str, body: Any, token: str | None, if_match: str | None, headers: dict[str, str], sent: Any
) -> None:
    line = Line((200, f"{JSON}; charset=utf-8", b'{"x": 1}'))
    assert Wired(line, token=token).request(method, "/status", body, if_match=if_match) == {"x": 1}
    assert line.sent == [(method, "/api/v1/status", sent, {"Accept": JSON, **headers})]


def test_what_is_no_json_is_text_and_broken_json_is_no_answer() -> None:
    line = Line((200, "text/plain", b"lent\n"), (200, JSON, b"{"), (200, "text/plain", b"\xff"))
    client = Wired(line)
    assert client.request("GET", "/lend") == "lent\n"
    for _ in range(2):
        with pytest.raises(LinkError, match="answer is not valid JSON"):
            client.request("GET", "/status")


@pytest.mark.parametrize(
    ("status", "body", "code", "exit_code"),
    [
        (400, b"{}", "failed", 1),
        (500, b"[]", "failed", 1),
        (423, b'{"error": {"code": "node-busy", "message": "It is busy.", "hint": "Wait."}}', "node-busy", 7),
        (409, b'{"error": {"code": "frozen", "message": "It is busy.", "hint": "Wait."}}', "frozen", 6),
        *((status, UNKNOWN, "new-code", 6) for status in (401, 403, 409, 412, 421, 422, 423, 429)),
        *((status, UNKNOWN, "new-code", 8) for status in (413, 415)),
        (404, UNKNOWN, "new-code", 3),
        (503, UNKNOWN, "new-code", 5),
        (500, UNKNOWN, "new-code", 1),
    ],
)
def test_a_refusal_has_the_words_of_the_daemon_and_the_exit_code_of_the_command_line(
    status: int, body: bytes, code: str, exit_code: int
) -> None:
    with pytest.raises(ApiError) as refused:
        Wired(Line((status, JSON, body))).request("GET", "/status")
    error = refused.value
    assert (error.status, error.code, error.exit_code) == (status, code, exit_code)
    words = ("It is busy.", "Wait.") if b"error" in body else (f"The base station answered {status}.", "")
    assert (error.message, error.hint) == words


GONE = ConnectionResetError("gone")
GOOD = (200, JSON, b"{}")


@pytest.mark.parametrize(
    ("method", "lines", "answered", "sent"),
    [
        ("GET", ([GOOD, GONE], [GOOD]), True, 3),
        ("GET", ([GOOD, http.client.BadStatusLine("")], [GOOD]), True, 3),
        ("GET", ([GOOD, GONE], [GONE]), False, 3),
        ("GET", ([GOOD, GONE], ConnectionRefusedError("gone")), False, 2),
        ("POST", ([GOOD, GONE], [GOOD]), False, 2),
        ("GET", ([GONE], [GOOD]), False, 1),
    ],
    ids=["kept", "kept and closed", "gone again", "nobody listens", "a change", "a new one"],
)
def test_a_question_on_a_kept_connection_is_asked_once_more_and_a_change_never(
    method: str, lines: tuple[Any, ...], answered: bool, sent: int
) -> None:
    """A change might have been done. Over TCP, a service that had ended was a ConnectionRefusedError."""
    opened = [Line(*line) if isinstance(line, list) else line for line in lines]
    client = Wired(*opened)
    if len(lines[0]) > 1:
        client.request("GET", "/status")
    if answered:
        assert client.request(method, "/status") == {}
    else:
        with pytest.raises(LinkError, match=r"^The base station is not responding: gone\.") as failed:
            client.request(method, "/status")
        assert failed.value.hint == "Is it running? teds-provision ncap status"
        assert client._connection is None, "the next request opens a new one"
    assert sum(len(line.sent) for line in opened if isinstance(line, Line)) == sent


@pytest.mark.parametrize(
    "url", ["bench:8351", "ftp://bench:8351", "http://", "http://bench:99999", "http://bench:x", "http://[::1:8351"]
)
def test_what_is_no_address_of_a_base_station_is_refused(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        Client(url).status()
    assert refused.value.message == f"{url!r} is not the address of a base station."
    assert refused.value.hint == "Use an address such as http://127.0.0.1:8351."


def test_an_address_is_host_and_port_by_its_scheme() -> None:
    """Of an IPv6 address without a port, the last digits were taken for it."""
    plain, tls = Client("http://bench:8351", timeout=3.0)._open(), Client("https://[::1]")._open()
    assert (type(plain), plain.host, plain.port, plain.timeout) == (http.client.HTTPConnection, "bench", 8351, 3.0)
    assert (type(tls), tls.host, tls.port) == (http.client.HTTPSConnection, "::1", 443)
    assert Client("http://[::1]")._open().port == 80


@pytest.mark.parametrize(
    ("ask", "answer", "expected", "found"),
    [
        (lambda desk: desk.status(), {"version": "1"}, ("GET", "/status", None), {"version": "1"}),
        (
            lambda desk: desk.set_detection("transparent"),
            {"mode": "transparent"},
            ("PUT", "/detection", {"mode": "transparent"}),
            "transparent",
        ),
        (lambda desk: desk.plant(), {}, ("GET", "/plant", None), {}),
        (lambda desk: desk.discover(), {"nodes": [1]}, ("POST", "/discover", {}), [1]),
        (lambda desk: desk.node("a/b"), {}, ("GET", "/nodes/a%2Fb", None), {}),
        (lambda desk: desk.groups(), {"groups": [1]}, ("GET", "/groups", None), [1]),
        (lambda desk: desk.measurements(), {"measurements": [1]}, ("GET", "/measurements", None), [1]),
        (lambda desk: desk.measure("a", rate=5.0), {}, ("POST", "/measurements", {"uuids": ("a",), "rate": 5.0}), {}),
        (lambda desk: desk.locate("a"), None, ("POST", "/nodes/a/locate", {"seconds": 10}), None),
        (lambda desk: desk.updates(), {"updates": [1]}, ("GET", "/updates", None), [1]),
        (lambda desk: desk.follow_update("a/b"), {}, ("GET", "/updates/a%2Fb", None), {}),
        (lambda desk: desk.cancel_update("a/b"), {}, ("DELETE", "/updates/a%2Fb", None), {}),
        (
            lambda desk: desk.release_actuator("a/b", 1),
            {"safe": True},
            ("PUT", "/nodes/a%2Fb/channels/1", {"hold": 0}),
            True,
        ),
        (lambda desk: desk.log(), {"entries": [1]}, ("GET", "/log?limit=200", None), [1]),
        (lambda desk: desk.log(5), {"entries": []}, ("GET", "/log?limit=5", None), []),
        (lambda desk: desk.login_url(), {"url": "u"}, ("POST", "/login-link", {"read_only": False}), "u"),
        (lambda desk: desk.login_url(read_only=True), {"url": "u"}, ("POST", "/login-link", {"read_only": True}), "u"),
        (
            lambda desk: desk.update(b"x", parallel=4, wait=9),
            {},
            ("POST", "/updates?parallel=4&wait=9", b"x"),
            {},
        ),
        (
            lambda desk: desk.provision(profile="gripper", name="hand", calibration="c", calibration_name="c.csv"),
            {},
            (
                "POST",
                "/nodes/next/provision",
                {
                    "profile": "gripper", "name": "hand", "calibration": "c", "calibration_name": "c.csv",
                    "calibration_channel": None, "calibration_item": None, "adopt": False, "accept_calibration": None,
                    "cancel": False,
                },
            ),
            {},
        ),
        (
            lambda desk: desk.provision(
                "a/b", calibration_channel=1, calibration_item="i", adopt=True, accept_calibration="why", cancel=True
            ),
            {},
            (
                "POST",
                "/nodes/a%2Fb/provision",
                {
                    "profile": None, "name": None, "calibration": None, "calibration_name": None,
                    "calibration_channel": 1, "calibration_item": "i", "adopt": True, "accept_calibration": "why",
                    "cancel": True,
                },
            ),
            {},
        ),
        (
            lambda desk: desk.write_teds("a/b", "x", accept_calibration="why", retype=True, dry_run=True),
            {"uuid": UUID},
            ("PUT", "/nodes/a%2Fb/teds?dry_run=1", {"content": "x", "accept_calibration": "why", "retype": True}),
            {"uuid": UUID},
        ),
    ],
)  # fmt: skip
def test_each_call_gives_its_part_of_the_answer(
    ask: Callable[[Desk], Any], answer: Any, expected: tuple[str, str, Any], found: Any
) -> None:
    desk = Desk(answer)
    assert ask(desk) == found
    assert desk.asked == [(*expected, None)]


def test_the_home_is_the_one_that_the_environment_names(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("TEDS_PROVISION_HOME", "~/bench")
    assert default_home() == tmp_path / "bench"
    for named in ("", None):
        if named is None:
            monkeypatch.delenv("TEDS_PROVISION_HOME")
        else:
            monkeypatch.setenv("TEDS_PROVISION_HOME", named)
        assert default_home().name == "teds-provision"


class Answered:
    """A connection to the Unix socket that gives one answer; ``failure`` where none is given."""

    def __init__(self, status: int, lines: list[bytes], failure: Exception | None = None) -> None:
        self.status, self._lines, self._failure = status, list(lines), failure
        self.asked: list[tuple[str, str]] = []
        self.closed = 0

    def request(self, method: str, path: str) -> None:
        self.asked.append((method, path))
        if self._failure is not None:
            raise self._failure

    def getresponse(self) -> Answered:
        return self

    def readline(self) -> bytes:
        return self._lines.pop(0) if self._lines else b""

    def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize(
    ("status", "lines", "failure", "lent"),
    [
        (200, [b"lent\n"], None, True),
        (200, [b"refused\n"], None, False),
        (423, [b"lent\n"], None, False),
        (200, [], LinkError("No base station."), False),
        (200, [], TimeoutError(), False),
        (200, [], http.client.BadStatusLine(""), False),
    ],
)
def test_readers_are_lent_by_one_word_and_until_the_end(
    status: int, lines: list[bytes], failure: Exception | None, lent: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, opened = Answered(status, lines, failure), list[tuple[Path, float]]()
    monkeypatch.setattr("teds_provision.client._UnixConnection", lambda *words: opened.append(words) or line)
    with Client(home="home", timeout=3.5).readers() as had:
        assert (had, line.closed) == (lent, 0)
    assert opened == [(Path("home/ncap.sock"), 3.5)]
    assert (line.asked, line.closed) == ([("GET", "/api/v1/lend")], 1)


@pytest.mark.parametrize(
    ("status", "lines", "failure", "had"),
    [
        (200, [b"let go\n"], None, True),
        (200, [b"waiting\n", b"waiting\n", b"let go\n"], None, True),
        (200, [b"not measured\n"], None, False),
        (200, [], LinkError("No base station."), False),
        (200, [b"refused: It is frozen.\n"], None, "It is frozen."),
        (200, [b"waiting\n"], None, "The base station did not release node ab."),
        (404, [b"let go\n"], None, "The base station did not release node ab."),
        (200, [], TimeoutError(), "The base station measures, and did not release node ab within 5 s."),
        (200, [], http.client.BadStatusLine(""), "The base station measures, and did not release node ab within 5 s."),
    ],
)
def test_a_node_is_released_by_one_word_and_anything_else_is_a_reason_to_write_nothing(
    status: int, lines: list[bytes], failure: Exception | None, had: bool | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, silences = Answered(status, lines, failure), list[float]()

    def connection(path: Path, silence: float) -> Answered:
        silences.append(silence)
        assert path == Path("home/ncap.sock")
        return line

    monkeypatch.setattr("teds_provision.client._UnixConnection", connection)
    released = Client(home="home").released("ab", "write & go")
    if isinstance(had, str):
        with pytest.raises(PolicyError) as refused, released:
            pass
        hint = "See: teds-provision ncap status. Or end the measurement first."
        assert (refused.value.message, refused.value.hint) == (had, hint)
    else:
        with released as got:
            assert (got, line.closed) == (had, 0)
    assert (line.asked, line.closed, silences) == ([("GET", "/api/v1/nodes/ab/let-go?for=write%20%26%20go")], 1, [5.0])


def test_without_a_base_station_its_socket_says_how_to_start_one(tmp_path: Path) -> None:
    with pytest.raises(LinkError) as failed:
        Client(home=tmp_path).status()
    assert f"No base station is running in {tmp_path}." in failed.value.message
    with pytest.raises(LinkError, match="The base station is not responding"):
        next(Client(home=tmp_path).live())


@pytest.mark.parametrize(
    ("url", "address"), [("http://bench:1/", "ws://bench:1/api/v1/live"), ("https://b", "wss://b/api/v1/live")]
)
@pytest.mark.parametrize("token", [None, "t"])
def test_live_messages_come_by_no_proxy_and_end_with_the_connection(
    url: str, address: str, token: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy of the environment got the token; the end of the service was an exception of another library."""
    asked: list[Any] = []

    class Connection:
        def __enter__(self) -> Iterator[str]:
            yield from ('{"type": "hello"}', '{"type": "beat"}')
            raise ConnectionClosedError(None, None)

        def __exit__(self, *_: object) -> None:
            asked.append("closed")

    def connect(given: str, **words: Any) -> Connection:
        asked.append((given, words))
        return Connection()

    monkeypatch.setattr("websockets.sync.client.connect", connect)
    assert [message["type"] for message in Client(url, token=token).live()] == ["hello", "beat"]
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    assert asked == [(address, {"additional_headers": headers, "compression": None, "proxy": None}), "closed"]


def test_who_may_not_see_live_messages_is_refused_as_by_any_request(monkeypatch: pytest.MonkeyPatch) -> None:
    body = b'{"error": {"code": "no-token", "message": "A token is required.", "hint": "Get one."}}'

    def connect(_url: str, **_words: Any) -> None:
        raise InvalidStatus(Response(401, "Unauthorized", Headers(), body))

    monkeypatch.setattr("websockets.sync.client.connect", connect)
    with pytest.raises(ApiError, match="A token is required") as refused:
        next(Client("http://bench:1").live())
    assert (refused.value.status, refused.value.code, refused.value.exit_code) == (401, "no-token", 6)


@pytest.mark.parametrize("ended", [False, True])
def test_a_change_is_not_sent_on_a_connection_that_the_base_station_has_ended(ended: bool) -> None:
    """It does after half a minute; sent there, the change would fail, and could not be sent again."""
    first, second = Line(GOOD, GOOD), Line(GOOD)
    client = Wired(first, second)
    client.request("GET", "/status")
    ours, theirs = socket.socketpair()
    with ours, theirs:
        first.sock = ours
        if ended:
            theirs.close()
        client.request("POST", "/discover", {})
    assert (len(first.sent), len(second.sent), first.closed) == ((1, 1, 1) if ended else (2, 0, 0))
    client.close()
    client.close()
    assert (first.closed, second.closed) == ((1, 1) if ended else (1, 0))


@pytest.mark.parametrize("error", [InvalidHandshake("no upgrade"), ConnectionRefusedError(111, "refused")])
def test_who_gets_no_live_connection_is_as_one_whom_nothing_answers(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def connect(_url: str, **_words: Any) -> None:
        raise error

    monkeypatch.setattr("websockets.sync.client.connect", connect)
    with pytest.raises(LinkError, match="The base station is not responding"):
        next(Client("http://bench:1").live())
