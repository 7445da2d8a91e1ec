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
import selectors
import socket
import ssl
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Unpack
from urllib.parse import quote, urlencode, urlsplit

from teds_provision.errors import EXIT_CODES, LinkError, PolicyError, TedsProvisionError, UsageError
from teds_provision.files import short_path
from teds_provision.shapes.measurement import MeasurementMembers
from teds_provision.shapes.problem import problem_in

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

    from teds_provision.api.answers import (
        Applied,
        Entry,
        Group,
        Measurement,
        Node,
        Past,
        Plant,
        Provisioning,
        Sheet,
        SheetPlan,
        Status,
        Update,
    )
    from teds_provision.api.bodies import Mode

API: Final = "/api/v1"
SOCKET: Final = "ncap.sock"
LETTING_GO: Final = 5.0
"""Longest silence of a base station that lets a node go; one that needs longer writes :data:`STILL_WAITING`."""
STILL_WAITING: Final = b"waiting\n"


class ApiError(TedsProvisionError):
    """The daemon refused; ``status`` is that of HTTP, ``code`` that of the command line."""

    def __init__(self, status: int, code: str, message: str, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.code = code  # type: ignore[misc]
        self.exit_code = EXIT_CODES.get(code, _EXIT_BY_STATUS.get(status, 1))  # type: ignore[misc]


_EXIT_BY_STATUS: Final = {
    401: 6,
    403: 6,
    404: 3,
    409: 6,
    412: 6,
    413: 8,
    415: 8,
    421: 6,
    422: 6,
    423: 6,
    429: 6,
    503: 5,
}


def _is_over(connection: http.client.HTTPConnection) -> bool:
    """Return True if the base station has ended a connection that was kept open.

    It does so after half a minute, or with its process. Between two requests only its end can arrive. A change that is
    sent on it would fail, and could not be sent again, as it might have been done.
    """
    if connection.sock is None:
        return False
    with selectors.DefaultSelector() as selector:
        selector.register(connection.sock, selectors.EVENT_READ)
        return bool(selector.select(0))


def _address_of(url: str) -> tuple[str, str, int]:
    """Return scheme, host and port of a base station; raises UsageError."""
    with suppress(ValueError):  # a port or an IPv6 address that is none
        parts = urlsplit(url)
        if parts.scheme in ("http", "https") and parts.hostname:
            # without a port, http.client would take the last digits of an IPv6 address for it
            usual = 443 if parts.scheme == "https" else 80
            return parts.scheme, parts.hostname, usual if parts.port is None else parts.port
    raise UsageError(
        f"{url!r} is not the address of a base station.", hint="Use an address such as http://127.0.0.1:8351."
    )


def default_home() -> Path:
    """Return the home of this user: TEDS_PROVISION_HOME, else the platform's user data folder."""
    named = os.environ.get("TEDS_PROVISION_HOME")
    if named:
        return Path(named).expanduser()
    from platformdirs import user_data_path

    return user_data_path("teds-provision")


def connect(
    url: str | None = None, *, token: str | None = None, home: str | Path | None = None, timeout: float = 120.0
) -> Client:
    """Return a client of ``url`` with a ``token`` (ncap token add), else of the Unix socket in ``home``.

    The default home is the user's.
    """
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
        self.etag: str | None = None
        """ETag of the last answer, None if it had none."""
        self._read: dict[str, str] = {}  # the ETag of the last datasheet read, by UUID
        self._uuids: dict[str, str] = {}  # the UUID of each node by the text under which it was read

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

    def request(self, method: str, path: str, body: Any = None, *, if_match: str | None = None) -> Any:
        """Send one request below /api/v1; return its JSON, or its text otherwise. Raises ApiError, LinkError.

        ``body`` is sent as JSON, octets as they are.
        """
        sent = body if body is None or isinstance(body, bytes) else json.dumps(body)
        status, kind, octets = self._ask(method, path, sent, if_match)
        try:
            value = json.loads(octets) if kind.startswith("application/json") else octets.decode()
        except ValueError as error:
            raise LinkError("The base station's answer is not valid JSON.") from error
        if status < 400:
            return value
        raise _refusal(status, value)

    def _ask(
        self, method: str, path: str, body: str | bytes | None, if_match: str | None = None
    ) -> tuple[int, str, bytes]:
        headers = {"Accept": "application/json"}
        if method not in ("GET", "HEAD"):
            headers["Content-Type"] = "application/octet-stream" if isinstance(body, bytes) else "application/json"
        if if_match is not None:
            headers["If-Match"] = if_match
        if self._token:
            headers["Authorization"] = f"Bearer {self._token}"
        # the daemon may have closed the kept connection meanwhile
        again = self._connection is not None and method == "GET"
        try:
            return self._exchange(method, path, body, headers)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            if not again:
                raise _no_answer(error) from error
        return self._ask(method, path, body, if_match)  # once: there is no kept connection now

    def _exchange(
        self, method: str, path: str, body: str | bytes | None, headers: dict[str, str]
    ) -> tuple[int, str, bytes]:
        if self._connection is not None and _is_over(self._connection):
            self.close()
        if self._connection is None:
            self._connection = self._open()
        with suppress(BrokenPipeError, ConnectionResetError):  # the daemon may reply before it has read the whole body
            self._connection.request(method, API + path, body, headers)
        answer = self._connection.getresponse()
        self.etag = answer.getheader("ETag")
        return answer.status, answer.getheader("Content-Type", ""), answer.read()

    def _open(self) -> http.client.HTTPConnection:
        if self.url is None:
            return _UnixConnection(self._home / SOCKET, self._timeout)
        scheme, host, port = _address_of(self.url)
        if scheme == "https":
            context = ssl.create_default_context()
            return http.client.HTTPSConnection(host, port, timeout=self._timeout, context=context)
        return http.client.HTTPConnection(host, port, timeout=self._timeout)

    # -- resources ---------------------------------------------------------------------------------------------------

    def status(self) -> Status:
        """Return version, links, detection, sinks, clock and budget."""
        found: Status = self.request("GET", "/status")
        return found

    def set_detection(self, mode: Mode) -> Mode:
        """Set detection to ``transparent`` or ``whitelist`` and return it."""
        found: Mode = self.request("PUT", "/detection", {"mode": mode})["mode"]
        return found

    def plant(self) -> Plant:
        """Return the plant that the station belongs to; raises ApiError (404) if it joined none."""
        found: Plant = self.request("GET", "/plant")
        return found

    def discover(self) -> list[Node]:
        """Ask every link now."""
        return list(self.request("POST", "/discover", {})["nodes"])

    def nodes(self) -> list[Node]:
        """Return every node; they are fetched a thousand at a time."""
        found: dict[str, Node] = {}
        offset = 0
        while True:
            answer = self.request("GET", f"/nodes?offset={offset}")
            found |= {node["uuid"]: node for node in answer["nodes"]}
            offset += len(answer["nodes"])
            if not answer["nodes"] or offset >= answer["total"]:
                return list(found.values())

    def node(self, node: str) -> Node:
        """Return one node, by UUID, prefix or name."""
        found: Node = self.request("GET", f"/nodes/{quote(node, safe='')}")
        return found

    def past(
        self, node: str, channel: int, *, since: float | None = None, until: float | None = None, points: int = 600
    ) -> Past:
        """Return the last hour of a channel, thinned to ``points`` bins.

        Moments in unix seconds (None: an hour ago, now).
        """
        asked = {"channel": channel, "points": points, "from": since, "until": until}
        words = urlencode({name: value for name, value in asked.items() if value is not None})
        found: Past = self.request("GET", f"/nodes/{quote(node, safe='')}/past?{words}")
        return found

    def teds(self, node: str) -> Sheet:
        """Return a node's datasheet, decoded and checked."""
        found: Sheet = self.request("GET", f"/nodes/{quote(node, safe='')}/teds")
        self._keep_tag(node, found["uuid"])
        return found

    def _keep_tag(self, node: str, uuid: str) -> None:
        if self.etag is not None:
            self._uuids[node], self._read[uuid] = uuid, self.etag

    def write_teds(
        self,
        node: str,
        content: str,
        *,
        accept_calibration: str | None = None,
        retype: bool = False,
        dry_run: bool = False,
    ) -> SheetPlan:
        """Write a datasheet (XML, JSON, hex); ``dry_run``: only show what that would change.

        ``accept_calibration``: why a calibration that the guard refuses is right. ``retype``: the board may become one
        of another type than it claims (else ApiError, ``wrong-board``).

        If this client has read the datasheet (:meth:`teds`, or a dry run) since it last wrote it, that reading is the
        condition: ApiError (412, ``changed``), and nothing is written, if the node has another datasheet by now.
        """
        query = "?dry_run=1" if dry_run else ""
        body = {"content": content, "accept_calibration": accept_calibration, "retype": retype}
        tag = None if dry_run else self._read.get(self._uuids.get(node, node))
        found: SheetPlan = self.request("PUT", f"/nodes/{quote(node, safe='')}/teds{query}", body, if_match=tag)
        if dry_run:
            self._keep_tag(node, found["uuid"])
        else:
            self._read.pop(found["uuid"], None)
        return found

    def provision(
        self,
        node: str = "next",
        *,
        profile: str | None = None,
        name: str | None = None,
        calibration: str | None = None,
        calibration_name: str | None = None,
        calibration_channel: int | None = None,
        calibration_item: str | None = None,
        adopt: bool = False,
        accept_calibration: str | None = None,
        cancel: bool = False,
    ) -> Provisioning:
        """Provision a node, or the next that is tapped; ``calibration`` is the content of a file of that name.

        ``calibration_channel`` is the channel that it is for, ``calibration_item`` the result of a certificate.
        ``adopt``: in place of a profile the datasheet that the board brought is signed; ``accept_calibration`` is the
        reason to accept it in spite of findings.
        """
        body = {
            "profile": profile,
            "name": name,
            "calibration": calibration,
            "calibration_name": calibration_name,
            "calibration_channel": calibration_channel,
            "calibration_item": calibration_item,
            "adopt": adopt,
            "accept_calibration": accept_calibration,
            "cancel": cancel,
        }
        found: Provisioning = self.request("POST", f"/nodes/{quote(node, safe='')}/provision", body)
        return found

    def groups(self) -> list[Group]:
        """Return the groups of nodes that are measured together."""
        return list(self.request("GET", "/groups")["groups"])

    def measurements(self) -> list[Measurement]:
        """Return the measurements that the service keeps, running or not."""
        return list(self.request("GET", "/measurements")["measurements"])

    def measure(self, *uuids: str, **settings: Unpack[MeasurementMembers]) -> Measurement:
        """Measure nodes, a ``group``, or nodes that ``match`` selects as they come, from now on.

        ``rate`` and ``scalar_rate`` in Hz, ``dead_man`` in ms. ``frozen``: the members are fixed at the start.
        """
        found: Measurement = self.request("POST", "/measurements", {"uuids": uuids} | settings)
        return found

    def end_measurement(self, measurement_id: str) -> None:
        """End one and forget it."""
        self.request("DELETE", f"/measurements/{quote(measurement_id, safe='')}")

    def set(
        self, node: str, channel: int, value: float, *, unit: str | None = None, hold: float | None = None
    ) -> Applied:
        """Set an actuator and hold it for ``hold`` seconds (1 by default); set it again in time to keep holding it."""
        body = {"value": value, "unit": unit, "hold": hold}
        found: Applied = self.request("PUT", f"/nodes/{quote(node, safe='')}/channels/{channel}", body)
        return found

    def locate(self, node: str, seconds: int = 10) -> None:
        """Make a node blink or beep for so many seconds, at most 60; 0 stops it."""
        self.request("POST", f"/nodes/{quote(node, safe='')}/locate", {"seconds": seconds})

    def update(
        self,
        image: bytes,
        *nodes: str,
        match: str | None = None,
        dry_run: bool = False,
        other_board: Sequence[str] = (),
        allow_downgrade: bool = False,
        parallel: int | None = None,
        wait: int | None = None,
    ) -> Update:
        """Begin to update the firmware of nodes to an image (the content of its file); ``dry_run``: only the plan.

        ``match`` selects nodes in place of naming them. ``other_board`` names those that get the image although it
        names another board, or none: ask a person about each. Boards are updated ``parallel`` at a time, and a
        restarted one is waited for ``wait`` seconds. Raises ApiError (423) while another update runs.
        """
        asked = {
            "nodes": ",".join(nodes),
            "match": match,
            "dry_run": int(dry_run),
            "other_board": ",".join(other_board),
            "allow_downgrade": int(allow_downgrade),
            "parallel": parallel,
            "wait": wait,
        }
        words = urlencode({name: value for name, value in asked.items() if value})
        found: Update = self.request("POST", f"/updates?{words}", image)
        return found

    def updates(self) -> list[Update]:
        """Return the firmware updates that run or are over, the newest first."""
        return list(self.request("GET", "/updates")["updates"])

    def follow_update(self, update_id: str) -> Update:
        """Return the progress of an update."""
        found: Update = self.request("GET", f"/updates/{quote(update_id, safe='')}")
        return found

    def cancel_update(self, update_id: str) -> Update:
        """Begin no further board of an update; those that were begun are finished."""
        found: Update = self.request("DELETE", f"/updates/{quote(update_id, safe='')}")
        return found

    def release_actuator(self, node: str, channel: int) -> bool | None:
        """Release an actuator; return whether the node reports that it is safe, None without a report."""
        found: Applied = self.request("PUT", f"/nodes/{quote(node, safe='')}/channels/{channel}", {"hold": 0})
        return found["safe"]

    def log(self, last: int = 200) -> list[Entry]:
        """Return the newest entries of the audit log."""
        return list(self.request("GET", f"/log?limit={last}")["entries"])

    def login_url(self, *, read_only: bool = False) -> str:
        """Return the page's address with a token that works once; over the Unix socket only."""
        return str(self.request("POST", "/login-link", {"read_only": read_only})["url"])

    @contextmanager
    def readers(self) -> Iterator[bool]:
        """Borrow the readers of the base station for the block; False if it does not run."""
        connection = _UnixConnection(self._home / SOCKET, self._timeout)
        try:
            connection.request("GET", f"{API}/lend")
            answer = connection.getresponse()
            lent = answer.status == 200 and answer.readline() == b"lent\n"
        except (LinkError, OSError, http.client.HTTPException):
            lent = False
        try:
            yield lent
        finally:
            connection.close()

    @contextmanager
    def released(self, uuid: str, command: str) -> Iterator[bool]:
        """Have the base station release a node that it measures for the block; then it is measured again.

        False if no base station runs, or it does not measure the node (``uuid``: 20 hex digits). Raises PolicyError if
        it is silent for :data:`LETTING_GO` seconds, or cannot release the node. It is not silent while another command
        is before this one.
        """
        connection = _UnixConnection(self._home / SOCKET, LETTING_GO)
        try:
            try:
                connection.request("GET", f"{API}/nodes/{uuid}/let-go?for={quote(command, safe='')}")
                answer = connection.getresponse()
                line = answer.readline() if answer.status == 200 else b""
                while line == STILL_WAITING:
                    line = answer.readline()
            except LinkError:  # no listener
                yield False
                return
            except (OSError, http.client.HTTPException) as error:
                raise PolicyError(
                    f"The base station measures, and did not release node {uuid} within {LETTING_GO:g} s.",
                    hint="See: teds-provision ncap status. Or end the measurement first.",
                ) from error
            if line not in (b"let go\n", b"not measured\n"):
                why = line.decode(errors="replace").removeprefix("refused: ").strip()
                raise PolicyError(
                    why or f"The base station did not release node {uuid}.",
                    hint="See: teds-provision ncap status. Or end the measurement first.",
                )
            yield line == b"let go\n"
        finally:
            connection.close()

    def live(self) -> Iterator[dict[str, Any]]:
        """Yield live messages: ``hello``, then values, events and beats, until the connection ends, however it ends.

        Needs the package websockets (the extra ``ncap``). Raises ApiError, LinkError.
        """
        from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

        try:
            opened = self._open_live()
        except InvalidStatus as refused:
            raise _refusal(refused.response.status_code, refused.response.body) from refused
        except (OSError, InvalidHandshake) as error:
            raise _no_answer(error) from error
        with opened as connection, suppress(ConnectionClosed):
            for text in connection:
                yield json.loads(text)

    def _open_live(self) -> ClientConnection:
        from websockets.sync.client import connect as connect_socket
        from websockets.sync.client import unix_connect

        if self.url is None:
            with short_path(self._home / SOCKET) as path:
                return unix_connect(path, f"ws://localhost{API}/live", compression=None)
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        url = self.url.replace("http", "ws", 1).rstrip("/")
        # as the other requests: a proxy of the environment would get the token
        return connect_socket(f"{url}{API}/live", additional_headers=headers, compression=None, proxy=None)


def _refusal(status: int, body: object) -> ApiError:
    """Return the error for an answer that refuses; ``body`` is its JSON, or its octets."""
    if isinstance(body, bytes):
        with suppress(ValueError):
            body = json.loads(body)
    return ApiError(status, **problem_in(body, otherwise=f"The base station answered {status}."))


def _no_answer(error: Exception) -> LinkError:
    return LinkError(f"The base station is not responding: {error}.", hint="Is it running? teds-provision ncap status")


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path, timeout: float) -> None:
        super().__init__("localhost", timeout=timeout)
        self._path = path

    def connect(self) -> None:
        """Open it; raises LinkError (5) if no server listens."""
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        try:
            with short_path(self._path) as path:
                self.sock.connect(path)
        except OSError as error:
            self.sock.close()
            raise LinkError(
                f"No base station is running in {self._path.parent}.", hint="Start it: teds-provision ncap run"
            ) from error
