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


if __name__ == "__main__":
    SHAPES.write_text("".join(f"{line}\n" for line in shapes()))
