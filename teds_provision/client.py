"""Talk to a running base station (`ncap run`) from Python: ``from teds_provision import client``.

    with client.connect() as station:                     # this user's own, by the Unix socket in its home
        for node in station.nodes():
            print(node["uuid"], node["verdict"]["verdict"])
    with client.connect("https://bench:8351", token=…) as station: …

Every method is one request of the API (api.md) and gives its JSON; what the daemon refuses is raised as
:class:`ApiError` with its status, code, message and hint. One client is for one thread at a time.
"""

from __future__ import annotations

import http.client
import json
import os
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final
from urllib.parse import quote, urlsplit

from teds_provision.errors import LinkFailure, TedsProvisionError, UsageFailure
from teds_provision.files import short_path

API: Final = "/api/v1"
SOCKET: Final = "ncap.sock"


class ApiError(TedsProvisionError):
    """What the daemon refused; ``status`` is that of HTTP, ``code`` that of the command line."""

    def __init__(self, status: int, code: str, message: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.code = code  # type: ignore[misc]
        self.exit_code = _EXIT.get(code, _EXIT_BY_STATUS.get(status, 1))  # type: ignore[misc]


_EXIT: Final = {
    "usage": 2, "not-found": 3, "not-authentic": 4, "link": 5, "no-reader": 5, "no-node": 5, "node-silent": 5,
    "garbled": 5, "address-conflict": 5, "unproven": 5, "store": 7, "store-changed": 7, "store-locked": 7,
    "vault-changed": 7, "node-busy": 7, "vault": 7, "no-keyring": 7, "wrong-passphrase": 7, "bad-data": 8, "bug": 1,
}  # fmt: skip
_EXIT_BY_STATUS: Final = {401: 6, 403: 6, 404: 3, 409: 6, 413: 8, 415: 8, 421: 6, 422: 6, 423: 6, 429: 6, 503: 5}


def default_home() -> Path:
    """The home of this user: TEDS_PROVISION_HOME, else the platform's user data folder."""
    named = os.environ.get("TEDS_PROVISION_HOME")
    if named:
        return Path(named).expanduser()
    from platformdirs import user_data_path

    return user_data_path("teds-provision")


def connect(
    url: str | None = None, *, token: str | None = None, home: str | Path | None = None, timeout: float = 120.0
) -> Client:
    """A client: of ``url`` with a ``token`` (ncap token add), else of the Unix socket in ``home`` (default: yours)."""
    return Client(url, token=token, home=home, timeout=timeout)


class Client:
    """See the module. ``timeout`` in seconds, of one request."""

    def __init__(
        self,
        url: str | None = None,
        *,
        token: str | None = None,
        home: str | Path | None = None,
        timeout: float = 120.0,
    ) -> None:
        self.url, self._token, self._timeout = url, token, timeout
        self._home = Path(home) if home else default_home()
        self._connection: http.client.HTTPConnection | None = None

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    # -- requests ----------------------------------------------------------------------------------------------------

    def request(self, method: str, path: str, body: Any = None) -> Any:
        """One request below /api/v1; its JSON, or its text where it is none. Raises ApiError, LinkFailure."""
        status, kind, octets = self._ask(method, path, None if body is None else json.dumps(body))
        try:
            value = json.loads(octets) if kind.startswith("application/json") else octets.decode()
        except ValueError as error:
            raise LinkFailure("The answer of the base station is no JSON.") from error
        if status < 400:
            return value
        told = value.get("error", {}) if isinstance(value, dict) else {}
        message = str(told.get("message") or f"The base station answered {status}.")
        raise ApiError(status, str(told.get("code", "failed")), message, str(told.get("hint", "")))

    def _ask(self, method: str, path: str, body: str | None) -> tuple[int, str, bytes]:
        headers = {"Accept": "application/json"}
        if method not in ("GET", "HEAD"):
            headers["Content-Type"] = "application/json"
        if self._token:
            headers["Authorization"] = f"Bearer {self._token}"
        again = self._connection is not None and method == "GET"  # kept open; the daemon may have closed it meanwhile
        try:
            return self._exchange(method, path, body, headers)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            if not again:
                raise LinkFailure(
                    f"The base station does not answer: {error}.", hint="Is it running? teds-provision ncap status"
                ) from error
        return self._exchange(method, path, body, headers)

    def _exchange(self, method: str, path: str, body: str | None, headers: dict[str, str]) -> tuple[int, str, bytes]:
        if self._connection is None:
            self._connection = self._open()
        self._connection.request(method, API + path, body, headers)
        answer = self._connection.getresponse()
        return answer.status, answer.getheader("Content-Type", ""), answer.read()

    def _open(self) -> http.client.HTTPConnection:
        if self.url is None:
            return _UnixConnection(self._home / SOCKET, self._timeout)
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise UsageFailure(f"{self.url!r} is no address of a base station.", hint="Write http://127.0.0.1:8351")
        if parts.scheme == "https":
            context = ssl.create_default_context()
            return http.client.HTTPSConnection(parts.hostname, parts.port, timeout=self._timeout, context=context)
        return http.client.HTTPConnection(parts.hostname, parts.port, timeout=self._timeout)

    # -- resources ---------------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Version, links, detection, sinks, clock, budget."""
        return dict(self.request("GET", "/status"))

    def set_detection(self, mode: str) -> str:
        """``transparent`` or ``whitelist``."""
        return str(self.request("PUT", "/detection", {"mode": mode})["mode"])

    def discover(self) -> list[dict[str, Any]]:
        """Ask every link now."""
        return list(self.request("POST", "/discover", {})["nodes"])

    def nodes(self) -> list[dict[str, Any]]:
        """Every node, asked for a thousand at a time."""
        found: dict[str, dict[str, Any]] = {}
        offset = 0
        while True:
            answer = self.request("GET", f"/nodes?offset={offset}")
            found |= {node["uuid"]: node for node in answer["nodes"]}
            offset += len(answer["nodes"])
            if not answer["nodes"] or offset >= answer["total"]:
                return list(found.values())

    def node(self, node: str) -> dict[str, Any]:
        """One node, by UUID, prefix or name."""
        return dict(self.request("GET", f"/nodes/{quote(node, safe='')}"))

    def teds(self, node: str) -> dict[str, Any]:
        """A node's datasheet, decoded and checked."""
        return dict(self.request("GET", f"/nodes/{quote(node, safe='')}/teds"))

    def write_teds(self, node: str, document: str, *, dry_run: bool = False) -> dict[str, Any]:
        """Write what a document (XML, JSON, hex) says; ``dry_run``: only what that would change."""
        query = "?dry_run=1" if dry_run else ""
        return dict(self.request("PUT", f"/nodes/{quote(node, safe='')}/teds{query}", {"content": document}))

    def provision(self, node: str = "next", **order: str | None) -> dict[str, Any]:
        """Provision a node, or the next that is tapped; ``order``: profile, name, calibration, calibration_name."""
        return dict(self.request("POST", f"/nodes/{quote(node, safe='')}/provision", order))

    def groups(self) -> list[dict[str, Any]]:
        """The measurement groups."""
        return list(self.request("GET", "/groups")["groups"])

    def measurements(self) -> list[dict[str, Any]]:
        """What is measured."""
        return list(self.request("GET", "/measurements")["measurements"])

    def measure(self, *nodes: str, **asked: Any) -> dict[str, Any]:
        """Measure nodes from now on; ``asked``: group (in place of nodes), rate, kind, trigger, channels, sinks."""
        return dict(self.request("POST", "/measurements", {**({"uuids": list(nodes)} if nodes else {}), **asked}))

    def end_measurement(self, measurement_id: str) -> None:
        """End one and forget it."""
        self.request("DELETE", f"/measurements/{quote(measurement_id, safe='')}")

    def set(
        self, node: str, channel: int, value: float, *, unit: str | None = None, hold: float | None = None
    ) -> dict[str, Any]:
        """Set an actuator and hold it for ``hold`` seconds (1 where none are said); set it again to hold it on."""
        body = {"value": value, "unit": unit, "hold": hold}
        return dict(self.request("PUT", f"/nodes/{quote(node, safe='')}/channels/{channel}", body))

    def let_go(self, node: str, channel: int) -> bool | None:
        """Let an actuator go; whether the node said that it is safe, None where it did not say."""
        safe = self.request("PUT", f"/nodes/{quote(node, safe='')}/channels/{channel}", {"hold": 0})["safe"]
        return None if safe is None else bool(safe)

    def log(self, last: int = 200) -> list[dict[str, Any]]:
        """The newest entries of the audit log."""
        return list(self.request("GET", f"/log?limit={last}")["entries"])

    def login_url(self, *, read_only: bool = False) -> str:
        """The page's address with a token that works once; over the Unix socket alone."""
        return str(self.request("POST", "/login-link", {"read_only": read_only})["url"])

    @contextmanager
    def readers(self) -> Iterator[bool]:
        """Have the readers of the base station for the length of the block; False where it does not run."""
        connection = _UnixConnection(self._home / SOCKET, self._timeout)
        try:
            connection.request("GET", f"{API}/lend")
            answer = connection.getresponse()
            lent = answer.status == 200 and answer.readline() == b"lent\n"
        except (LinkFailure, OSError, http.client.HTTPException):
            lent = False
        try:
            yield lent
        finally:
            connection.close()

    def live(self) -> Iterator[dict[str, Any]]:
        """What happens now: ``hello``, then values, events and beats, until the connection ends.

        Needs the package websockets (the extra ``ncap``).
        """
        from websockets.sync.client import connect as connect_socket
        from websockets.sync.client import unix_connect

        if self.url is None:
            with short_path(self._home / SOCKET) as path:
                opened = unix_connect(path, f"ws://localhost{API}/live", compression=None)
        else:
            headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
            url = self.url.replace("http", "ws", 1).rstrip("/")
            opened = connect_socket(f"{url}{API}/live", additional_headers=headers, compression=None)
        with opened as connection:
            for text in connection:
                yield json.loads(text)


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path, timeout: float) -> None:
        super().__init__("localhost", timeout=timeout)
        self._path = path

    def connect(self) -> None:
        """Open it; raises LinkFailure (5) where nobody listens."""
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        try:
            with short_path(self._path) as path:
                self.sock.connect(path)
        except OSError as error:
            self.sock.close()
            raise LinkFailure(
                f"No base station runs in {self._path.parent}.", hint="Start it: teds-provision ncap run"
            ) from error
