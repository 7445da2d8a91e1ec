"""Errors as answers, and bodies as values: the same for every route."""

from __future__ import annotations

import json
from typing import Any, Final

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from teds_provision.errors import (
    Frozen,
    LinkFailure,
    NodeBusy,
    NodeRefused,
    NotFound,
    StoreFailure,
    TedsProvisionError,
    UsageFailure,
)
from teds_provision.ncap.web.guard import Refusal
from teds_provision.protocol.messages.frames import Reason

_STATUS: Final[tuple[tuple[type[TedsProvisionError], int], ...]] = (
    (NotFound, 404),
    (Frozen, 409),
    (NodeBusy, 423),
    (LinkFailure, 503),
    (StoreFailure, 503),
)
_OTHERS: Final = 422  # guard, limits, bad data, policy: the request is understood and not done


def status_of(error: TedsProvisionError) -> int:
    """The status of an error (docs/contract/api.md)."""
    if isinstance(error, NodeRefused) and error.reason == Reason.BUSY:
        return 423
    return next((status for kind, status in _STATUS if isinstance(error, kind)), _OTHERS)


def told(error: TedsProvisionError) -> dict[str, Any]:
    """``{"error": {…}}``, with the words of the command line."""
    return {"error": {"code": error.code, "message": error.message, "hint": error.hint}}


def answer_error(_request: Request, error: Exception) -> Response:
    """A TedsProvisionError as an answer."""
    assert isinstance(error, TedsProvisionError)
    return JSONResponse(told(error), status_of(error))


def answer_refusal(_request: Request, refusal: Exception) -> Response:
    """A Refusal from within a route (a body that is too long)."""
    assert isinstance(refusal, Refusal)
    error = {"code": refusal.code, "message": refusal.message, "hint": refusal.hint}
    return JSONResponse({"error": error}, refusal.status)


def answer_bug(_request: Request, error: Exception) -> Response:
    """Whatever else escapes is a bug; nothing of it is told to the client."""
    message = f"Unexpected {type(error).__name__}."
    return JSONResponse({"error": {"code": "bug", "message": message, "hint": "See the daemon's log."}}, 500)


class Body:
    """The JSON object of a request: each ``take_…`` gives one member, typed; :meth:`done` refuses what is left over."""

    def __init__(self, members: dict[str, Any]) -> None:
        self._members = members

    @classmethod
    async def of(cls, request: Request) -> Body:
        """Read it; raises UsageFailure (422), and Refusal (400) where a member comes twice (RFC 8259, section 4).

        Of two members of one name each reader takes another: what was checked in front of us is not what we would do.
        """
        octets = await request.body()
        try:
            value = json.loads(octets, object_pairs_hook=_once) if octets else {}
            json.dumps(value, ensure_ascii=False).encode()  # half a character pair is no text
        except (ValueError, RecursionError) as error:
            raise UsageFailure("The body is no JSON.") from error
        if not isinstance(value, dict):
            raise UsageFailure("The body has to be a JSON object.")
        return cls(value)

    @property
    def members(self) -> dict[str, Any]:
        """All that is left."""
        return self._members

    def take(self, name: str, kind: type | tuple[type, ...], default: Any = None) -> Any:
        """A member of that kind, the default where it is absent or null; raises UsageFailure."""
        value = self._members.pop(name, None)
        if value is None:
            return default
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wrong = isinstance(value, bool) and bool not in kinds
        if wrong or not isinstance(value, kinds):
            names = " or ".join(one.__name__ for one in kinds)
            raise UsageFailure(f"{name!r} has to be {names}, not {json.dumps(value)[:40]}.")
        return value

    def need(self, name: str, kind: type | tuple[type, ...]) -> Any:
        """A member that has to be there."""
        if self._members.get(name) is None:
            raise UsageFailure(f"{name!r} is missing.")
        return self.take(name, kind)

    def number(self, name: str, least: float, most: float) -> float | None:
        """A finite number within bounds, None where it is absent."""
        value = self.take(name, (int, float))
        if value is not None and not least <= value <= most:
            raise UsageFailure(f"{name!r} has to be from {least:g} to {most:g}, not {value}.")
        return None if value is None else float(value)

    def texts(self, name: str, *, needed: bool = False) -> tuple[str, ...]:
        """A list of texts; () where it is absent, unless it is needed."""
        value = self.need(name, list) if needed else self.take(name, list, [])
        if not all(isinstance(one, str) for one in value):
            raise UsageFailure(f"{name!r} has to be a list of texts.")
        return tuple(value)

    def done(self) -> None:
        """Raise UsageFailure where a member was not taken: a typing error must not be passed over."""
        if self._members:
            raise UsageFailure(f"Nobody knows {next(iter(self._members))!r} here.", hint="See openapi.json.")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise Refusal(400, "usage", f"The member {twice[:64]!r} comes twice.", "Send each once.")
    return members
