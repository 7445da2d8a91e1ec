"""An error as JSON, and the line or answer that carries it: of ``--json``, of the API, and in ``client``.

One more member is a line of :class:`Problem` and its value in :func:`problem_of`; the schema follows. Codes and their
exit codes are in ``errors.py``. A typed dictionary, as nothing is done with an error but to write it and to read it.
"""

from __future__ import annotations

from typing import Protocol, TypedDict


class Failure(TypedDict):
    """An error without its remedy, of one node or file among many."""

    code: str
    message: str


class Problem(Failure):
    """An error and its remedy."""

    hint: str


class Error(TypedDict):
    """A refusal."""

    error: Problem


class Explained(Protocol):
    """An exception of ours, or a refusal of the API's guard."""

    @property
    def code(self) -> str:
        """The stable word."""

    @property
    def message(self) -> str:
        """The fault, as one sentence."""

    @property
    def hint(self) -> str:
        """The remedy, empty for none."""


def problem_of(error: Explained) -> Problem:
    """Return an error as JSON."""
    return Problem(code=error.code, message=error.message, hint=error.hint)


def failure_of(error: Explained) -> Failure:
    """Return an error of one among many as JSON."""
    return Failure(code=error.code, message=error.message)


def problem_in(body: object, *, otherwise: str) -> Problem:
    """Return the error of a line or answer that was parsed; what it lacks has code ``failed`` and that message."""
    found = body.get("error") if isinstance(body, dict) else None
    members = found if isinstance(found, dict) else {}
    message = str(members.get("message") or otherwise)
    return Problem(code=str(members.get("code", "failed")), message=message, hint=str(members.get("hint", "")))
