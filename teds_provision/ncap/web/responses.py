"""Shared by all routes: bodies as values, errors as answers, and the threads that wait for nodes.

A node that does not answer keeps a thread for up to a minute. With one pool for all, a few such reads (a read-only
token is enough) delayed every other request: the status, the check of the next token, the set points. So there is a
pool for reads, one for changes, and one for actuators.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, ParamSpec, TypeVar

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from teds_provision.api import schema
from teds_provision.errors import (
    DatasheetChangedError,
    FrozenError,
    KnownUuidError,
    LinkError,
    NodeBusyError,
    NodeRefusedError,
    NotFoundError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.ncap.sinks import for_readers
from teds_provision.ncap.web.guard import CALLER, Caller, RequestRefusedError
from teds_provision.protocol.messages.frames import Reason
from teds_provision.shapes.problem import Error, Problem, problem_of

Shape = TypeVar("Shape")
_Words = ParamSpec("_Words")
_Found = TypeVar("_Found")

_READING: Final = ThreadPoolExecutor(8, "reads of a node")
_CHANGING: Final = ThreadPoolExecutor(8, "works with a node")
_MOVING: Final = ThreadPoolExecutor(16, "moves an actuator")

_STATUS: Final[tuple[tuple[type[TedsProvisionError], int], ...]] = (
    (NotFoundError, 404),
    (FrozenError, 409),
    (KnownUuidError, 409),
    (DatasheetChangedError, 412),
    (NodeBusyError, 423),
    (LinkError, 503),
    (StoreError, 503),
)
ASKED: Final = "teds.asked"
"""Key in a request's scope of the short members of its body, for the audit log."""
_LONGEST_IN_LOG, _MOST_IN_LOG = 200, 16
_OTHERS: Final = 422  # guard, limits, bad data, policy: the request was understood but refused


def status_of(error: TedsProvisionError) -> int:
    """Return the HTTP status of an error (docs/contract/api.md)."""
    if isinstance(error, NodeRefusedError) and error.reason == Reason.BUSY:
        return 423
    return next((status for kind, status in _STATUS if isinstance(error, kind)), _OTHERS)


def answer_error(request: Request, error: Exception) -> Response:
    """Return a TedsProvisionError as an answer, with the message of the command line."""
    assert isinstance(error, TedsProvisionError)
    problem = problem_of(error)
    caller: Caller = request.scope[CALLER]
    return JSONResponse({"error": for_readers(problem) if caller.read_only else problem}, status_of(error))


def answer_refusal(_request: Request, refusal: Exception) -> Response:
    """Return the answer to a RequestRefusedError of a route (a body is too long or does not match its schema)."""
    assert isinstance(refusal, RequestRefusedError)
    return JSONResponse(Error(error=problem_of(refusal)), refusal.status)


def answer_bug(_request: Request, error: Exception) -> Response:
    """Return the answer to any other error, which is a bug; the client learns only its type."""
    message = f"Unexpected {type(error).__name__}."
    problem = Problem(code="bug", message=message, hint="See the daemon's log.")
    return JSONResponse(Error(error=problem), 500)


async def body_of(request: Request, shape: type[Shape]) -> Shape:
    """Return the body of a request as its type.

    Raises RequestRefusedError (422 bad-request) if the description forbids it.
    """
    try:
        found = schema.read(shape, await request.body())
    except schema.BadRequestError as error:
        raise RequestRefusedError(422, "bad-request", error.message, error.hint) from error
    request.scope[ASKED] = {name: value for name, value in vars(found).items() if _is_short(value)}
    return found


def _is_short(value: object) -> bool:
    """Return True if a member is short enough for the audit log: no datasheet, no calibration."""
    if isinstance(value, list | tuple):
        return len(value) <= _MOST_IN_LOG and all(map(_is_short, value))
    return isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= _LONGEST_IN_LOG)


async def reading(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what reads of a node and changes nothing."""
    return await _run(_READING, lambda: work(*words, **more))


async def changing(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what works with nodes, links, measurements."""
    return await _run(_CHANGING, lambda: work(*words, **more))


async def moving(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what is for an actuator: its set points cannot wait."""
    return await _run(_MOVING, lambda: work(*words, **more))


async def _run(pool: ThreadPoolExecutor, work: Callable[[], _Found]) -> _Found:
    who = contextvars.copy_context()  # keeps the actor for the audit log
    return await asyncio.get_running_loop().run_in_executor(pool, lambda: who.run(work))
