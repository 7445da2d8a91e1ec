"""The whole API as it is published, word for word but for its descriptions: `shapes.txt` beside this file.

Every other test of the API asks the schemas what is right; a limit, a default or a member that changed by mistake would
be right with them. Who changes the API on purpose writes the new file: python -m tests.api.test_contract
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from teds_provision.api.operations import OPERATIONS, document
from teds_provision.api.schema import schema_of

SHAPES = Path(__file__).with_name("shapes.txt")


def bare(schema: Any) -> Any:
    """Return a schema without its descriptions, and a reference as the name that it leads to."""
    if isinstance(schema, list):
        return [bare(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return "→" + schema["$ref"].rpartition("/")[2]
    return {name: bare(part) for name, part in schema.items() if name != "description" or isinstance(part, dict)}


def text(schema: Any) -> str:
    return json.dumps(bare(schema), ensure_ascii=False, separators=(",", ":"))


def shapes() -> Iterator[str]:
    """Yield a line for each operation, then one for each member of each schema; ``?``: it may be left out."""
    for operation in OPERATIONS:
        answers = operation.answer if isinstance(operation.answer, tuple) else (operation.answer,)
        words = [operation.method, operation.path, str(operation.status)]
        words += [f"body={operation.body.__name__}"] if operation.body is not None else []
        words += [f"octets={operation.octets}"] if operation.octets else []
        words += [f"?{name}={text(schema)}" for name, schema in operation.query.items()]
        words += [f"header {name}={text(schema)}" for name, schema in operation.header.items()]
        words += ["document"] if operation.document else []
        words += ["tag"] if operation.tag else []
        yield " ".join([*words, "→", *(getattr(answer, "__name__", str(answer)) for answer in answers)])
    bodies = {operation.body.__name__: schema_of(operation.body, {}) for operation in OPERATIONS if operation.body}
    for name, schema in sorted((bodies | document()["components"]["schemas"]).items()):
        members, required = schema.get("properties", {}), schema.get("required", ())
        yield f"{name} {text({key: part for key, part in schema.items() if key not in ('properties', 'required')})}"
        for member, part in members.items():
            yield f"  {member}{'' if member in required else '?'} {text(part)}"


def test_the_api_is_what_its_contract_has() -> None:
    assert list(shapes()) == SHAPES.read_text().splitlines()


def test_an_operation_is_described_with_all_that_it_takes_and_answers() -> None:
    """What `shapes.txt` has of each, as a generator of clients reads it."""
    whole = document()
    every = ["400", "401", "403", "404", "405", "409", "412", "413", "415", "421", "422", "423", "429", "500", "503"]
    write, read, update = (
        whole["paths"][path][method]
        for path, method in (("/nodes/{uuid}/teds", "put"), ("/nodes/{uuid}/teds", "get"), ("/updates", "post"))
    )
    assert [operation["operationId"] for operation in (write, read, update)] == [
        "putNodesUuidTeds", "getNodesUuidTeds", "postUpdates",
    ]  # fmt: skip
    assert [(one["name"], one["in"], one.get("required", False)) for one in write["parameters"]] == [
        ("uuid", "path", True), ("dry_run", "query", False), ("If-Match", "header", False),
    ]  # fmt: skip
    assert sorted(write["responses"]) == ["200", *every]
    assert sorted(update["responses"]) == ["200", "202", *every]
    assert update["responses"]["200"] == update["responses"]["202"], "a plan"
    assert (list(write["responses"]["200"]["content"]), list(read["responses"]["200"]["content"])) == (
        ["application/json"], ["application/json", "application/xml", "text/plain"],
    )  # fmt: skip
    assert all("ETag" in operation["responses"]["200"]["headers"] for operation in (write, read))
    assert "headers" not in update["responses"]["202"]
    assert (list(write["requestBody"]["content"]), write["requestBody"]["required"]) == (["application/json"], True)
    assert update["requestBody"] == {
        "required": True,
        "content": {
            "application/octet-stream": {"schema": {"type": "string", "format": "binary", "maxLength": 4194304}}
        },
    }
    assert "requestBody" not in read
    number = whole["paths"]["/nodes/{uuid}/channels/{number}"]["put"]["parameters"][1]
    assert number == {"name": "number", "in": "path", "required": True, "schema": {"type": "integer"}}
    assert not whole["paths"]["/discover"]["post"]["requestBody"]["required"]
    assert (whole["openapi"], whole["servers"]) == ("3.1.0", [{"url": "/api/v1"}])
    assert whole["security"] == [{"token": []}, {"browser": []}]
    assert whole["components"]["securitySchemes"] == {
        "token": {"type": "http", "scheme": "bearer"},
        "browser": {"type": "apiKey", "in": "cookie", "name": "ncap-PORT"},
    }
    for code in every:
        assert write["responses"][code] == {"$ref": f"#/components/responses/{code}"}
        content = whole["components"]["responses"][code]["content"]
        assert content == {"application/json": {"schema": {"$ref": "#/components/schemas/Error"}}}


def test_every_operation_is_described_by_what_it_does_with_its_own_parameters() -> None:
    paths = document()["paths"]
    for operation in OPERATIONS:
        found = paths[operation.path][operation.method.lower()]
        answer = found["responses"][str(operation.status)]
        assert (found["summary"], answer["description"]) == (operation.does, operation.does)
        assert found["operationId"].startswith(operation.method.lower())
        given = [(one["name"], one["in"], one["schema"]) for one in found["parameters"] if one["in"] != "path"]
        assert given == [
            *((name, "query", schema) for name, schema in operation.query.items()),
            *((name, "header", schema) for name, schema in operation.header.items()),
        ]
        schema = answer["content"]["application/json"]["schema"]
        assert ("anyOf" in schema) is isinstance(operation.answer, tuple), operation.path
        assert schema == {"type": "object"} or operation.answer is not None, operation.path
        if operation.tag:
            assert f"({operation.tag})" in answer["headers"]["ETag"]["description"]


if __name__ == "__main__":
    SHAPES.write_text("".join(f"{line}\n" for line in shapes()))
