"""An error has one form: --json, the API and its description, and what ``client`` raises follow from it."""

from __future__ import annotations

import ast
import json
from typing import get_type_hints

import pytest
from starlette.requests import Request

from teds_provision import client
from teds_provision.api.operations import document
from teds_provision.cli.main import run
from teds_provision.errors import NotFoundError
from teds_provision.ncap.web.guard import RequestRefusedError
from teds_provision.ncap.web.responses import answer_refusal
from teds_provision.shapes.problem import Error, Failure, Problem, failure_of, problem_in, problem_of

from ..test_architecture import MODULES, name_of, parsed

MEMBERS = list(get_type_hints(Problem))


def test_an_error_of_the_command_line_has_the_members_of_the_shape(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--json", "unknown-command"]) == 2
    line = json.loads(capsys.readouterr().out)
    assert list(line) == list(get_type_hints(Error))
    assert list(line["error"]) == MEMBERS


def test_a_refusal_of_the_api_has_the_members_of_the_shape() -> None:
    refusal = RequestRefusedError(422, "bad-request", "It is wrong.", "Mend it.")
    body = json.loads(bytes(answer_refusal(Request({"type": "http"}), refusal).body))
    assert list(body["error"]) == MEMBERS
    assert dict(client.ApiError(422, **problem_in(body, otherwise="")).__dict__) == {
        "status": 422, "code": "bad-request", "message": "It is wrong.", "hint": "Mend it.", "exit_code": 2,
    }  # fmt: skip


def test_the_description_has_the_members_of_the_shape() -> None:
    schemas = document()["components"]["schemas"]
    assert list(schemas["Problem"]["properties"]) == schemas["Problem"]["required"] == MEMBERS
    assert schemas["Error"]["properties"] == {"error": {"$ref": "#/components/schemas/Problem"}}


def test_an_error_is_written_with_every_member() -> None:
    error = NotFoundError("There is no node.", hint="Look.")
    assert list(problem_of(error)) == MEMBERS
    assert problem_of(error) == {"code": "not-found", "message": "There is no node.", "hint": "Look."}
    assert list(failure_of(error)) == list(get_type_hints(Failure))
    assert problem_in({"error": problem_of(error)}, otherwise="?") == problem_of(error)


@pytest.mark.parametrize("body", [None, "text", [], {}, {"error": "text"}, {"error": {"message": ""}}])
def test_what_is_no_error_reads_as_a_failure(body: object) -> None:
    assert problem_in(body, otherwise="No answer.") == {"code": "failed", "message": "No answer.", "hint": ""}


def test_no_other_place_writes_an_error_as_json() -> None:
    """Neither as a literal nor as a typed dictionary of its own; a finding of the guard is no error."""
    found = [
        f"{name_of(path)}:{node.lineno}"
        for path in MODULES
        for node in ast.walk(parsed(path))
        if {"code", "message"} <= names_of(node) and "severity" not in names_of(node)
    ]
    assert found == []


def names_of(node: ast.AST) -> set[str]:
    """Return the members that a dict literal has, or a typed dictionary in its own body."""
    if isinstance(node, ast.Dict):
        return {str(key.value) for key in node.keys if isinstance(key, ast.Constant)}
    if isinstance(node, ast.ClassDef) and "TypedDict" in {ast.unparse(base) for base in node.bases}:
        own = [line.target for line in node.body if isinstance(line, ast.AnnAssign)]
        return {ast.unparse(target) for target in own} if node.name != "Failure" else set()
    return set()


def test_what_an_error_lacks_is_filled_in_member_by_member() -> None:
    for given, whole in (
        ({"code": "busy"}, {"code": "busy", "message": "No answer.", "hint": ""}),
        ({"message": "It is busy."}, {"code": "failed", "message": "It is busy.", "hint": ""}),
        ({"hint": "Wait.", "more": 1}, {"code": "failed", "message": "No answer.", "hint": "Wait."}),
    ):
        assert problem_in({"error": given}, otherwise="No answer.") == whole
