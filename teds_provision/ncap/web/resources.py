"""The resources of the API: each takes a request apart, calls the daemon on a thread, and answers JSON."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterable, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any, Final

from starlette.convertors import IntegerConvertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from teds_provision import client
from teds_provision.api import bodies
from teds_provision.api.operations import (
    FURTHEST,
    LAST_CHANNEL,
    LONGEST_TEXT,
    LONGEST_WAIT,
    MOST_AT_ONCE,
    MOST_ENTRIES,
    MOST_NODES,
    MOST_POINTS,
    document,
)
from teds_provision.errors import NotFoundError, PolicyError, TedsProvisionError, UsageError
from teds_provision.measure.matching import known_nodes
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.measurement_supervisor import LONGEST_LOAN, NodeLoan
from teds_provision.ncap.nodes.directory import for_reader
from teds_provision.ncap.nodes.update_actions import UpdateRequest
from teds_provision.ncap.service_part import ServicePart
from teds_provision.ncap.sinks import for_readers
from teds_provision.ncap.web.guard import CALLER, Caller
from teds_provision.ncap.web.responses import body_of, changing, moving, reading
from teds_provision.provisioning.update import WAIT_SECONDS
from teds_provision.station.store.audit import AuditFilter, is_failure
from teds_provision.station.store.records import iso
from teds_provision.teds.profile import default_folders, list_profiles, listed

Handler = Callable[[Request], Awaitable[Response]]
_LENT_LOOK: Final = 0.5
_STILL: Final = client.LETTING_GO / 3  # seconds between two lines to a command that waits for a node
_OF_UPDATES: Final = ("nodes", "match", "dry_run", "other_board", "allow_downgrade", "parallel", "wait")
_DIGITS: Final = 9  # of a number in a query or a path; Python raises an error for four thousand
_UNIX: Final = re.compile(r"[0-9]{1,12}(\.[0-9]{1,9})?")


class _ShortInteger(IntegerConvertor):
    """A number in a path; the library's own raises an error for four thousand digits."""

    regex = f"[0-9]{{1,{_DIGITS}}}"


register_url_convertor("short_integer", _ShortInteger())


class Resources:
    """Handlers over one daemon; :meth:`routes` lists them."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon

    def routes(self) -> list[Route]:
        """Return the routes below /api/v1."""
        return [
            Route("/status", self.status),
            Route("/detection", self.detection, methods=["GET", "PUT"]),
            Route("/discover", self.discover, methods=["POST"]),
            Route("/nodes", self.nodes),
            Route("/nodes/{uuid}", self.node),
            Route("/nodes/{uuid}/past", self.past),
            Route("/nodes/{uuid}/teds", self.teds, methods=["GET", "PUT"]),
            Route("/nodes/{uuid}/provision", self.provision, methods=["GET", "POST"]),
            Route("/nodes/{uuid}/locate", self.locate, methods=["POST"]),
            Route("/nodes/{uuid}/channels/{number:short_integer}", self.channel, methods=["GET", "PUT"]),
            Route("/updates", self.updates, methods=["GET", "POST"]),
            Route("/updates/{id}", self.update, methods=["GET", "DELETE"]),
            Route("/groups", self.groups, methods=["GET", "POST"]),
            Route("/groups/{name:path}", self.group, methods=["PUT", "DELETE"]),
            Route("/measurements", self.measurements, methods=["GET", "POST"]),
            Route("/measurements/rate", self.rate),
            Route("/measurements/{id}", self.measurement, methods=["DELETE"]),
            Route("/names", self.names, methods=["GET", "PUT"]),
            Route("/virtual", self.virtual, methods=["GET", "POST"]),
            Route("/virtual/{uuid}", self.one_virtual, methods=["DELETE"]),
            Route("/profiles", self.profiles),
            Route("/log", self.log),
            Route("/login-link", self.login_link, methods=["POST"]),
            Route("/openapi.json", self.openapi),
            Route("/lend", self.lend),
            Route("/nodes/{uuid}/let-go", self.lend_until_closed),
        ]

    async def _node_of(self, request: Request) -> str:
        return await asyncio.to_thread(self._daemon.known, request.path_params["uuid"])

    async def _nodes_of(self, texts: Sequence[str]) -> list[str]:
        return [await asyncio.to_thread(self._daemon.resolve, text) for text in texts]

    # -- the station -------------------------------------------------------------------------------------------------

    async def status(self, request: Request) -> Response:
        """GET /status."""
        caller: Caller = request.scope[CALLER]
        found = await asyncio.to_thread(self._daemon.status)
        return _shown(request, {**found, "write": not caller.read_only})

    async def detection(self, request: Request) -> Response:
        """GET, PUT /detection."""
        if request.method == "PUT":
            body = await body_of(request, bodies.Detection)
            await changing(self._daemon.set_detection, body.mode)
        return JSONResponse({"mode": await asyncio.to_thread(lambda: self._daemon.detection)})

    async def discover(self, request: Request) -> Response:
        """POST /discover."""
        await body_of(request, bodies.Nothing)
        return JSONResponse({"nodes": await changing(self._daemon.discover)})

    async def profiles(self, _request: Request) -> Response:
        """GET /profiles: the transducer types that can be built."""

        def buildable() -> list[dict[str, Any]]:
            entries = [listed(entry) for entry in list_profiles(default_folders(self._daemon.station.home))]
            return [entry for entry in entries if "error" not in entry and not entry.get("abstract")]

        return JSONResponse({"profiles": await asyncio.to_thread(buildable)})

    async def log(self, request: Request) -> Response:
        """GET /log: the newest selected entries, before ``before`` if it is given, and the verdict on them."""
        words = request.query_params
        limit = _integer(request, "limit", 200, MOST_ENTRIES)
        before = _integer(request, "before", 0, FURTHEST, least=1) or None
        text = words.get("text")
        if text is not None and len(text) > LONGEST_TEXT:
            raise UsageError(f"text may have at most {LONGEST_TEXT} characters.")
        failed = _says(request, "failed")
        since = _moment("since", words["since"]) if words.get("since") else None
        choice = AuditFilter(act=words.get("act") or None, failed=failed, text=text or None, before=before, since=since)
        return _shown(request, await reading(self._log, choice, limit, words.get("uuid")))

    def _log(self, choice: AuditFilter, limit: int, uuid: str | None) -> dict[str, Any]:
        log = self._daemon.station.audit_log
        if uuid:
            choice = replace(choice, uuid=bytes.fromhex(self._daemon.resolve(uuid)))
        after = log.entry_before(choice, last=limit)
        verdict = log.check(after)
        entries = [
            {
                "seq": entry.seq,
                "time": datetime.fromisoformat(entry.at).timestamp(),
                "who": entry.who,
                "actor": entry.actor,
                "act": entry.act,
                "uuid": entry.uuid.hex() if entry.uuid is not None else None,
                "subject": entry.uuid.hex() if entry.uuid is not None else "",
                "outcome": entry.outcome,
                "detail": _sentence(entry.outcome, entry.detail),
                "facts": entry.detail,
                "failed": is_failure(entry.outcome),
            }
            for entry in log.chosen(choice, after)
        ]
        return {"entries": entries, "intact": verdict.intact, "why": verdict.why}

    async def openapi(self, _request: Request) -> Response:
        """GET /openapi.json."""
        return JSONResponse(document())

    async def login_link(self, request: Request) -> Response:
        """POST /login-link: the page's address with a token that works once; over the Unix socket alone."""
        caller: Caller = request.scope[CALLER]
        body = await body_of(request, bodies.LoginLink)
        if caller.kind != "socket":
            raise PolicyError(
                "Login links are only issued on the station's own machine.", hint="Run there: teds-provision ncap open"
            )
        return JSONResponse({"url": self._daemon.login_url(read_only=bool(body.read_only))})

    async def lend(self, request: Request) -> Response:
        """GET /lend: the readers are the caller's for as long as this answer is not ended; over the socket alone."""
        caller: Caller = request.scope[CALLER]
        if caller.kind != "socket":
            raise PolicyError("Readers can only be borrowed on the station's own machine.")
        watches = list(self._daemon.watches)

        async def lent() -> AsyncIterator[str]:
            try:
                for watch in watches:
                    await asyncio.to_thread(watch.borrow, request)
                yield "lent\n"
                while True:  # writing shows whether the client is still there
                    await asyncio.sleep(_LENT_LOOK)
                    yield ".\n"
            finally:
                for watch in watches:
                    watch.give_back(request)

        return StreamingResponse(lent(), media_type="text/plain")

    async def lend_until_closed(self, request: Request) -> Response:
        """GET /nodes/UUID/let-go: a measured node is the caller's to write to until this answer ends.

        One whose actuator is in use is not let go for an update: its restart would end that.

        Over the socket alone. A caller that dies closes it, and a silent one has the node for a limited time. It gives
        up if nothing is written for a while, so one that waits (for the node's session to end, for another borrower
        that is served first) gets a line now and then.
        """
        caller: Caller = request.scope[CALLER]
        if caller.kind != "socket":
            raise PolicyError("A measured node is only let go to a command on the station's own machine.")
        uuid = request.path_params["uuid"].lower()
        measuring, until = self._daemon.measuring, time.monotonic() + LONGEST_LOAN
        why = f"let go for {request.query_params.get('for', 'a command')[:40]}"
        loan = NodeLoan(uuid, why)

        def lend() -> bool:
            if request.query_params.get("for") == "update":
                self._daemon.updates.require_free(uuid)
            return measuring.lend_node(loan)

        async def had() -> AsyncIterator[str]:
            lending = asyncio.ensure_future(changing(lend))
            # the client may have left, so retrieve the exception here
            lending.add_done_callback(lambda done: done.cancelled() or done.exception())
            try:
                try:
                    while not (await asyncio.wait({lending}, timeout=_STILL))[0]:
                        yield client.STILL_WAITING.decode()
                    yield "let go\n" if lending.result() else "not measured\n"
                except TedsProvisionError as error:
                    yield f"refused: {error.message}\n"
                    return
                while time.monotonic() < until:  # writing shows whether the client is still there
                    await asyncio.sleep(_LENT_LOOK)
                    yield ".\n"
            finally:  # not awaited: the client may have left
                asyncio.get_running_loop().run_in_executor(None, measuring.return_node, loan)

        return StreamingResponse(had(), media_type="text/plain")

    # -- nodes -------------------------------------------------------------------------------------------------------

    async def nodes(self, request: Request) -> Response:
        """GET /nodes: ``limit`` of them from ``offset`` on, and ``total``."""
        limit = _integer(request, "limit", MOST_NODES, MOST_NODES)
        offset = _integer(request, "offset", 0, FURTHEST, least=0)
        caller: Caller = request.scope[CALLER]
        text = await asyncio.to_thread(self._daemon.directory.nodes_text, limit, offset, reader=caller.read_only)
        return Response(text, media_type="application/json")

    async def node(self, request: Request) -> Response:
        """GET /nodes/UUID."""
        uuid = await self._node_of(request)
        node = await asyncio.to_thread(self._daemon.directory.node, uuid)
        caller: Caller = request.scope[CALLER]
        return JSONResponse(for_reader(node) if caller.read_only else node)

    async def past(self, request: Request) -> Response:
        """GET /nodes/UUID/past: the last hour of a channel."""
        uuid = await self._node_of(request)
        channel = _integer(request, "channel", 1, LAST_CHANNEL)
        points = _integer(request, "points", 600, MOST_POINTS)
        since, until = (_unix(request, name) for name in ("from", "until"))
        past = self._daemon.live.history
        return JSONResponse(await asyncio.to_thread(past.channel_history, uuid, channel, since, until, points))

    async def teds(self, request: Request) -> Response:
        """GET, PUT /nodes/UUID/teds."""
        sheets = self._daemon.sheets
        body = await body_of(request, bodies.SheetText) if request.method == "PUT" else None
        uuid = await self._node_of(request)
        if body is None:
            form = request.query_params.get("format")
            if form is None:
                shown, digest = await reading(sheets.as_json, uuid)
                return JSONResponse(shown, headers=_tagged(digest))
            text, kind, digest = await reading(sheets.document, uuid, form)
            disposition = {"content-disposition": f'attachment; filename="{uuid}.{form}"'}
            return Response(text, media_type=kind, headers={**disposition, **_tagged(digest)})
        dry = _says(request, "dry_run")
        content, accept, retype = body.content, body.accept_calibration, bool(body.retype)
        expected = _expected(request)
        if not dry:
            return JSONResponse(
                await changing(sheets.write, uuid, content, accept=accept, retype=retype, expected=expected)
            )
        shown, digest = await changing(sheets.plan, uuid, content, accept=accept, retype=retype, expected=expected)
        return JSONResponse(shown, headers=_tagged(digest))

    async def locate(self, request: Request) -> Response:
        """POST /nodes/UUID/locate."""
        body = await body_of(request, bodies.Locate)
        uuid = await self._node_of(request)
        await changing(self._daemon.locate, uuid, body.seconds)
        return JSONResponse({"uuid": uuid, "seconds": body.seconds})

    async def provision(self, request: Request) -> Response:
        """GET, POST /nodes/UUID/provision; UUID ``next``: whichever node is tapped next."""
        body = await body_of(request, bodies.Order) if request.method == "POST" else None
        word = request.path_params["uuid"]
        uuid = word if word == "next" else await self._uuid_of_a_label(word)
        runs = self._daemon.provisioning
        if body is None:
            return _shown(request, await asyncio.to_thread(runs.run_of, uuid))
        if body.cancel:
            return JSONResponse(await changing(runs.cancel, uuid))

        def begin() -> dict[str, Any]:
            return runs.begin(
                uuid,
                profile=body.profile,
                name=body.name,
                calibration=body.calibration,
                calibration_name=body.calibration_name,
                channel=body.calibration_channel,
                item=body.calibration_item,
                adopt=bool(body.adopt),
                accept=body.accept_calibration,
            )

        return JSONResponse(await changing(begin), 202)

    async def _uuid_of_a_label(self, word: str) -> str:
        """Return the whole UUID, as on a label, of a node that was never seen."""
        digits = word.lower().removeprefix("0x")
        if len(digits) == 20 and not set(digits) - set("0123456789abcdef"):
            return digits
        return await asyncio.to_thread(self._daemon.resolve, word)

    async def channel(self, request: Request) -> Response:
        """GET, PUT /nodes/UUID/channels/N: a channel with its last value; an actuator's set point."""
        if request.method == "GET":
            uuid, number = await self._node_of(request), request.path_params["number"]
            return JSONResponse(await asyncio.to_thread(self._daemon.directory.channel, uuid, number))
        body = await body_of(request, bodies.SetPoint)
        uuid, number = await self._node_of(request), request.path_params["number"]
        if body.value is None or body.hold == 0:
            return JSONResponse(await moving(self._daemon.leases.release_actuator, uuid, number))
        return JSONResponse(await moving(self._daemon.leases.put, uuid, number, body.value, body.unit, body.hold))

    # -- firmware updates ---------------------------------------------------------------------------------------------

    async def updates(self, request: Request) -> Response:
        """GET, POST /updates: the last updates; a new one, or its plan."""
        updates, caller = self._daemon.updates, request.scope[CALLER]
        if request.method == "GET":
            return _shown(request, {"updates": await asyncio.to_thread(updates.all)})
        _require_known(request, _OF_UPDATES)
        image = await request.body()
        asked = await self._update_request(request)
        if _says(request, "dry_run"):
            return JSONResponse(await changing(updates.plan, image, asked, owner=caller.owner))
        return JSONResponse(await changing(updates.begin, image, asked, owner=caller.owner), 202)

    async def _update_request(self, request: Request) -> UpdateRequest:
        nodes, match = _listed(request, "nodes"), request.query_params.get("match", "")
        if bool(nodes) == bool(match):
            raise UsageError("An update needs nodes or match.", hint="Name the boards, or select them; not both.")
        if match:
            station = self._daemon.station
            uuids = [uuid.hex() for uuid in await changing(known_nodes, station, match)]
        else:
            uuids = [await asyncio.to_thread(self._daemon.known, text) for text in nodes]
        other = [await asyncio.to_thread(self._daemon.known, text) for text in _listed(request, "other_board")]
        return UpdateRequest(
            tuple(dict.fromkeys(uuids)),
            frozenset(other),
            allow_downgrade=_says(request, "allow_downgrade"),
            parallel=_integer(request, "parallel", 1, MOST_AT_ONCE),
            wait=_integer(request, "wait", int(WAIT_SECONDS), LONGEST_WAIT),
        )

    async def update(self, request: Request) -> Response:
        """GET, DELETE /updates/ID: progress of an update; begin no further board."""
        work = self._daemon.updates.get if request.method == "GET" else self._daemon.updates.cancel
        return _shown(request, await changing(work, request.path_params["id"]))

    # -- groups and measurements -------------------------------------------------------------------------------------

    async def groups(self, request: Request) -> Response:
        """GET, POST /groups."""
        if request.method == "POST":
            body = await body_of(request, bodies.NewGroup)
            await changing(self._daemon.make_group, body.name, await self._nodes_of(body.uuids or ()))
        found = {"groups": await asyncio.to_thread(self._daemon.groups)}
        return JSONResponse(found, 201 if request.method == "POST" else 200)

    async def group(self, request: Request) -> Response:
        """PUT, DELETE /groups/NAME."""
        name = request.path_params["name"]
        if request.method == "DELETE":
            await changing(self._daemon.drop_group, name)
        else:
            body = await body_of(request, bodies.GroupMembers)
            await changing(self._daemon.change_group, name, await self._nodes_of(body.uuids))
        return JSONResponse({"groups": await asyncio.to_thread(self._daemon.groups)})

    async def measurements(self, request: Request) -> Response:
        """GET, POST /measurements."""
        measuring = self._daemon.measuring
        if request.method == "GET":
            return _shown(request, {"measurements": await asyncio.to_thread(measuring.all)})
        body = await body_of(request, bodies.NewMeasurement)
        members = vars(body) | {"uuids": await self._nodes_of(body.uuids)}
        caller: Caller = request.scope[CALLER]
        return JSONResponse(await changing(lambda: measuring.add(members, caller.owner)), 201)

    async def rate(self, request: Request) -> Response:
        """GET /measurements/rate: of a group, or of nodes."""
        group, named = request.query_params.get("group"), request.query_params.get("uuids", "")
        uuids = await self._nodes_of([text for text in named.split(",") if text][:MOST_NODES])
        found = await reading(lambda: self._daemon.measuring.proposed_rate(group=group, uuids=uuids))
        return JSONResponse({"proposal": None if found is None else asdict(found)})

    async def measurement(self, request: Request) -> Response:
        """DELETE /measurements/ID."""
        await changing(self._daemon.measuring.delete, request.path_params["id"])
        return JSONResponse({"measurements": await asyncio.to_thread(self._daemon.measuring.all)})

    # -- names, virtual transducers ----------------------------------------------------------------------------------

    async def names(self, request: Request) -> Response:
        """GET, PUT /names."""
        names = self._daemon.names
        if request.method == "PUT":
            body = await body_of(request, bodies.NewName)
            [uuid] = await self._nodes_of([body.uuid])
            await changing(names.rename, uuid, body.channel or 0, body.name or None)
        return JSONResponse({"names": await asyncio.to_thread(names.all)})

    async def virtual(self, request: Request) -> Response:
        """GET, POST /virtual."""
        if request.method == "GET":
            return _shown(request, {"virtual": self._daemon.virtuals.all()})
        body = await body_of(request, bodies.NewVirtual)
        source = body.source or "noise"
        caller: Caller = request.scope[CALLER]
        if caller.kind != "socket" and source.startswith(("file:", "unix:")):
            # An error about a file quotes a part of it, and a token must not give access to this user's files.
            raise PolicyError(
                "A file or socket can only be named as a source on the station's own machine.",
                hint="Use noise, sine:S, ramp:S or simulation.",
            )

        def make() -> dict[str, Any]:
            return self._daemon.make_virtual(
                name=body.name,
                source=source,
                content=body.content,
                profile=body.profile,
                new_uuid=bool(body.new_uuid),
            )

        return JSONResponse(await changing(make), 201)

    async def one_virtual(self, request: Request) -> Response:
        """DELETE /virtual/UUID."""
        uuid = request.path_params["uuid"].lower()
        if uuid not in self._daemon.virtuals:
            raise NotFoundError(f"{uuid} is not a virtual transducer of this station.")
        await changing(self._daemon.drop_virtual, uuid)
        return JSONResponse({"virtual": self._daemon.virtuals.all()})


def routes_of_parts(parts: Iterable[ServicePart]) -> list[Route]:
    """Return the paths below /api/v1 that optional rooms bring."""
    return [Route(path, _of_part(answer)) for part in parts for path, answer in part.resources().items()]


def _of_part(answer: Callable[[Request], Awaitable[dict[str, Any]]]) -> Handler:
    """Return the handler of a resource that an optional room brings."""

    async def handle(request: Request) -> Response:
        return _shown(request, await answer(request))

    return handle


def _shown(request: Request, found: dict[str, Any]) -> JSONResponse:
    """Return an answer; for a read-only token without files and users of this machine."""
    caller: Caller = request.scope[CALLER]
    return JSONResponse(for_readers(found) if caller.read_only else found)


def _integer(request: Request, name: str, default: int, most: int, least: int = 1) -> int:
    text = request.query_params.get(name)
    if text is None:
        return default
    if not (text.isascii() and text.isdecimal() and len(text) <= _DIGITS and least <= int(text) <= most):
        raise UsageError(f"{name} must be a whole number from {least} to {most}.")
    return int(text)


def _says(request: Request, name: str) -> bool:
    """Return True if a switch of the query is on; raises UsageError if it is neither on nor off."""
    word = request.query_params.get(name, "").lower()
    if word not in ("", "0", "1", "false", "true"):
        raise UsageError(f"{name} must be 1 or 0.")
    return word in ("1", "true")


def _require_known(request: Request, names: Collection[str]) -> None:
    """Raise UsageError for an unknown word of the query: a mistyped dry_run must not begin the update."""
    unknown = sorted(set(request.query_params) - set(names))
    if unknown:
        raise UsageError(f"Unknown in the query: {', '.join(unknown)}.", hint=f"Known: {', '.join(sorted(names))}.")


def _listed(request: Request, name: str) -> list[str]:
    """Return the words of a list in the query; raises UsageError for too many."""
    words = [word.strip() for word in request.query_params.get(name, "").split(",") if word.strip()]
    if len(words) > MOST_NODES:
        raise UsageError(f"{name} may name at most {MOST_NODES} nodes.")
    return words


def _unix(request: Request, name: str) -> float | None:
    """Return a moment in unix seconds, or from ISO 8601; None if it is left out."""
    text = request.query_params.get(name)
    if not text:
        return None
    return float(text) if _UNIX.fullmatch(text) else datetime.fromisoformat(_moment(name, text)).timestamp()


def _moment(name: str, text: str) -> str:
    """Return a parameter as the log writes moments: ISO 8601 with a zone, or unix seconds."""
    try:
        at = datetime.fromtimestamp(float(text), UTC) if _UNIX.fullmatch(text) else datetime.fromisoformat(text)
        # with its zone, the year may be out of range
        return iso(at if at.tzinfo is not None else at.replace(tzinfo=UTC))
    except (ValueError, OverflowError, OSError):
        raise UsageError(f"{name} must be a time such as 2026-11-22T10:00:00Z, or unix seconds.") from None


def _sentence(outcome: str, detail: dict[str, Any]) -> str:
    facts = ", ".join(
        f"{key} {value}" for key, value in detail.items() if isinstance(value, str | int | float) and value
    )
    return f"{outcome}: {facts}" if facts else outcome


def _tagged(digest: str) -> dict[str, str]:
    """Return the headers of an answer about a datasheet with this digest."""
    return {"etag": f'"{digest}"'}


def _expected(request: Request) -> frozenset[str] | None:
    """Return the digests that If-Match names; None if it is missing or accepts any datasheet (``*``)."""
    named = [tag.strip() for value in request.headers.getlist("if-match") for tag in value.split(",")]
    if not named or "*" in named:
        return None
    return frozenset(tag[1:-1] for tag in named if len(tag) > 1 and tag[0] == tag[-1] == '"')
