"""A running daemon for the tests: the program itself, asked over its sockets as anybody would."""

from __future__ import annotations

import functools
import http.client
import json
import signal
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any
from urllib.parse import urlsplit

import jsonschema_rs

from teds_provision import client
from teds_provision.api.operations import document
from tests.e2e.desk import Desk, Running, Station
from tests.ncap import short_waits
from tests.pace import PATIENCE, until


@dataclass
class Answer:
    """What came back."""

    status: int
    headers: dict[str, str]
    text: str

    @property
    def json(self) -> Any:
        return json.loads(self.text)

    @property
    def code(self) -> str:
        return str(self.json["error"]["code"])


class CheckedClient(client.Client):
    """A client whose every answer must be what openapi.json says of it."""

    def _ask(
        self, method: str, path: str, body: str | bytes | None, if_match: str | None = None
    ) -> tuple[int, str, bytes]:
        status, kind, octets = super()._ask(method, path, body, if_match)
        described(method, path, status, kind, octets)
        return status, kind, octets


DOCUMENT = document()
ANSWERED: set[tuple[str, str, int]] = set()


def described(method: str, path: str, status: int, kind: str, octets: bytes) -> None:
    """Fail where an answer is not what the API's description says."""
    template = next((item for item in DOCUMENT["paths"] if _matches(item, path.partition("?")[0])), None)
    if template is None or method.lower() not in DOCUMENT["paths"][template]:
        assert status in (404, 405), (method, path, status)
        return
    answers = DOCUMENT["paths"][template][method.lower()]["responses"]
    assert str(status) in answers, f"{method} {path} answers {status}, which nobody described"
    ANSWERED.add((method, template, status))
    if kind.startswith("application/json"):
        _validator(method.lower(), template, str(status)).validate(json.loads(octets))


@functools.cache
def _validator(method: str, template: str, status: str) -> jsonschema_rs.Draft202012Validator:
    """Return what checks the JSON of an answer."""
    answer = DOCUMENT["paths"][template][method]["responses"][status]
    if "$ref" in answer:
        answer = DOCUMENT["components"]["responses"][answer["$ref"].rpartition("/")[2]]
    schema = answer["content"]["application/json"]["schema"]
    return jsonschema_rs.Draft202012Validator({**schema, "components": DOCUMENT["components"]})


def _matches(template: str, path: str) -> bool:
    parts, given = template.split("/"), path.split("/")
    return len(parts) == len(given) and all(a == b or a.startswith("{") for a, b in zip(parts, given, strict=True))


@dataclass
class Service:
    """One `ncap run` of a station, on a free port and on the desk's bus."""

    desk: Desk
    station: Station
    words: tuple[object, ...] = ()
    process: Running | None = None
    url: str = ""
    closing: list[client.Client] = field(default_factory=list)

    def start(self, *more: object, **how: Any) -> Service:
        """Start it, and wait until it says that it is ready; with short waits unless ``program`` is another one."""
        words = ("--json", "ncap", "run", "--http", "127.0.0.1:0", "--can", self.desk.links.can, *self.words, *more)
        how.setdefault("program", short_waits.PROGRAM)
        self.process = self.station.start(*words, **how)
        [ready, *_] = self.process.wait_for_lines(1)
        assert ready.get("ready") is True, ready
        self.url = ready["url"]
        return self

    @property
    def port(self) -> int:
        found = urlsplit(self.url).port
        assert found is not None
        return found

    def client(self, token: str | None = None) -> client.Client:
        """By the Unix socket, or with a token by TCP; every answer is held against the API's own description."""
        made = CheckedClient(self.url if token else None, token=token, home=self.station.home, timeout=PATIENCE)
        self.closing.append(made)
        return made

    def token(self, name: str, *words: object) -> str:
        """Return a new token for a script, by command."""
        return str(self.station.ask("ncap", "token", "add", name, *words)["token"])

    def raw(self, method: str, path: str, headers: dict[str, str | None] | None = None, body: Any = None) -> Answer:
        """Send one request exactly as given; a header that is None is left out (Host too)."""
        sent_headers: dict[str, str | None] = {"Host": f"127.0.0.1:{self.port}", **(headers or {})}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            octets = body.encode() if isinstance(body, str) else body
            if octets is not None and "Content-Length" not in sent_headers and "Transfer-Encoding" not in sent_headers:
                sent_headers["Content-Length"] = str(len(octets))
            for name, value in sent_headers.items():
                if value is not None:
                    connection.putheader(name, value)
            connection.endheaders()
            if octets is not None:
                with suppress(BrokenPipeError, ConnectionResetError):  # it may answer before all of it was sent
                    connection.send(octets)
            answer = connection.getresponse()
            return Answer(answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read().decode())
        finally:
            connection.close()

    def end(self) -> None:
        """SIGTERM, and wait."""
        assert self.process is not None
        for current in self.closing:
            current.close()
        self.process.signal(signal.SIGTERM)
        outcome = self.process.end()
        assert outcome.code == 0, outcome
        assert "Traceback" not in outcome.err, outcome.err

    def kill(self) -> None:
        """As power loss would."""
        assert self.process is not None
        self.process.process.kill()
        self.process.end()


def verified(service: Service, uuid: str) -> dict[str, Any]:
    """Wait until a node is there and was looked at, and return it."""
    with service.client() as asked:
        return dict(
            until(
                lambda: next((n for n in asked.nodes() if n["uuid"] == uuid and n["verified"] and n["present"]), None),
                lambda: [n for n in asked.nodes() if n["uuid"] == uuid] or f"{uuid} is not known",
            )
        )


def unix(line: dict[str, Any]) -> float:
    """When a line of the daemon was written, in unix seconds."""
    assert line["time"].endswith("Z"), line
    return datetime.fromisoformat(line["time"]).timestamp()


def verdict(node: dict[str, Any]) -> str | None:
    """Return the verdict on a node in a word, None if it has none yet."""
    return node["verdict"] and str(node["verdict"]["verdict"])


def virtual(service: Service, profile: str = "gripper", name: str = "hand", source: str = "sine:2") -> str:
    """Return a virtual transducer of the daemon, provisioned and there."""
    with service.client() as asked:
        made = asked.request("POST", "/virtual", {"profile": profile, "name": name, "source": source})
    node = verified(service, made["uuid"])
    assert verdict(node) == "authentic", node
    return str(made["uuid"])
