"""The description of the API: a right OpenAPI document, of exactly the routes that there are."""

from __future__ import annotations

import dataclasses
import re
from typing import Any, cast
from urllib.parse import quote

import jsonschema
import pytest

from teds_provision.api.operations import OPERATIONS, document
from teds_provision.client import ApiError, Client
from teds_provision.ncap.service_part import KINDS
from teds_provision.ncap.web.resources import Resources, routes_of_parts
from tests.ncap.service import Service


@pytest.mark.needs_room("plant")
def test_every_route_is_described_and_nothing_else() -> None:
    nothing = cast("Any", None)
    parts = [kind.make(nothing, nothing, list) for kind in KINDS.parts()]
    routes = [*Resources(nothing).routes(), *routes_of_parts(parts)]
    there = {
        (method, re.sub(r":\w+}", "}", route.path))
        for route in routes
        for method in (route.methods or set()) - {"HEAD"}
    }
    assert there == {(operation.method, operation.path) for operation in OPERATIONS}


def test_every_schema_is_one_and_every_reference_leads_somewhere() -> None:
    described = document()
    for schema in described["components"]["schemas"].values():
        jsonschema.Draft202012Validator.check_schema(schema)

    def walk(value: Any) -> None:
        if isinstance(value, dict):
            if "$ref" in value:
                where = described
                for part in value["$ref"].removeprefix("#/").split("/"):
                    where = where[part]
            for inner in value.values():
                walk(inner)
        elif isinstance(value, list):
            for inner in value:
                walk(inner)

    walk(described)
    names = [item["operationId"] for path in described["paths"].values() for item in path.values()]
    assert len(names) == len(set(names))


def test_it_is_a_valid_openapi_document() -> None:
    import openapi_spec_validator

    openapi_spec_validator.validate(document())


def _status(asked: Client, method: str, path: str, body: Any) -> int:
    try:
        asked.request(method, path, body)
    except ApiError as error:
        return error.status
    return 200


@pytest.mark.link
def test_the_running_daemon_gives_it(service: Service) -> None:
    with service.client() as asked:
        assert asked.request("GET", "/openapi.json") == document()


@pytest.mark.link
def test_bodies_made_from_the_description_never_break_the_daemon(service: Service) -> None:
    """What fits a described body, and what does not, gets an answer that is described: never a bug."""
    odd: list[Any] = [None, "", "x" * 5000, -1, 1e400, 10**30, True, [], [[]], {}, {"a": 1}, "\u0000", "\ud83d", "../x"]
    with service.client() as asked:
        for operation in OPERATIONS:
            if operation.body is None or operation.path == "/login-link":
                continue
            path = operation.path.replace("{number}", "1")
            path = re.sub(r"{\w+}", "nobody", path)
            names = [member.name for member in dataclasses.fields(operation.body)] or ["x"]
            for name in names:
                for value in odd:
                    status = _status(asked, operation.method, path, {name: value})
                    assert status in (200, 201, 202, 404, 422), (operation.method, path, name, value)
        groups = asked.request("GET", "/groups")["groups"]
        for group in groups:
            asked.request("DELETE", f"/groups/{quote(group['name'], safe='')}")
        for made in asked.request("GET", "/virtual")["virtual"]:
            asked.request("DELETE", f"/virtual/{made['uuid']}")
