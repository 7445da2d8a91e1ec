"""Hooks of mkdocs: the references that follow from code, and links that leave docs/ (mkdocs.yml names this file).

``reference/commands.md`` follows from the command line's definitions, ``reference/api.md`` from the OpenAPI
description. Neither is a file of the repository, so neither can be out of date.
"""

from __future__ import annotations

import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

sys.path.insert(0, str(Path(__file__).resolve().parent))
from options import commands

from teds_provision.api import operations

ROOT: Final = Path(__file__).resolve().parent.parent
LINK: Final = re.compile(r"(\]\()([^)#:\s]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    for path, text in (("reference/commands.md", commands_page()), ("reference/api.md", api_page())):
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page whose links to files outside docs/ lead to the repository.

    Such a file must exist; a link within docs/ is left to mkdocs, which checks page and heading.
    """
    folder = posixpath.dirname(page.file.src_uri)

    def to_repository(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join("docs", folder, match[2]))
        if target.startswith("docs/") and files.get_file_from_path(target.removeprefix("docs/")) is not None:
            return match[0]
        path = ROOT / target
        if not path.exists():
            return match[0]  # mkdocs reports it
        kind = "tree" if path.is_dir() else "blob"
        return f"{match[1]}{config.repo_url}/{kind}/main/{target}{match[3]}"

    return LINK.sub(to_repository, markdown)


def commands_page() -> str:
    """Return the reference of every command: its help text as the program prints it."""
    parts = ["# Commands\n\nEvery command as `--help` prints it.\n"]
    for path, command in commands():
        name = f"teds-provision {path}".strip()
        context = click.Context(command, info_name=name, max_content_width=110, terminal_width=110)
        help_text = click.unstyle(command.get_help(context)).replace("\b", "")
        parts.append(f"## {name}\n\n```text\n{help_text.rstrip()}\n```\n")
    return "\n".join(parts)


def api_page() -> str:
    """Return the reference of the API: paths with what they do, then every shape of a body or an answer."""
    document = operations.document()
    parts = [f"# The API\n\n{document['info'].get('description', '').strip()}\n\nPaths are below `/api/v1`.\n"]
    for path, methods in document["paths"].items():
        parts.append(f"## {path}\n")
        for method, operation in methods.items():
            parts.append("\n".join(operation_lines(method, operation)))
    parts.append("## Shapes {#shapes}\n")
    for name, schema in document["components"]["schemas"].items():
        parts.append(f"### {name}\n\n" + "\n".join(schema_lines(schema)))
    return "\n".join(parts) + "\n"


def operation_lines(method: str, operation: dict[str, Any]) -> Iterator[str]:
    """Yield what one method of a path does, takes and answers."""
    yield f"**{method.upper()}**: {operation['summary']}\n"
    for parameter in operation.get("parameters", []):
        yield f"* parameter `{parameter['name']}` ({parameter['in']}): {shape(parameter['schema'])}"
    for media in operation.get("requestBody", {}).get("content", {}).values():
        yield f"* body: {shape(media['schema'])}"
    for code, answer in operation["responses"].items():
        for media in answer.get("content", {}).values():
            yield f"* answer {code}: {shape(media.get('schema', {}))}"
    yield ""


def schema_lines(schema: dict[str, Any]) -> Iterator[str]:
    """Yield the members of a shape as a table; a shape without members in one line."""
    if "properties" not in schema:
        yield shape(schema) + "\n"
        return
    yield "| member | type | required |\n|---|---|---|"
    required = schema.get("required", [])
    for name, member in schema["properties"].items():
        yield f"| `{name}` | {shape(member)} | {'yes' if name in required else ''} |"
    yield ""


def shape(schema: dict[str, Any]) -> str:
    """Return a schema in a few words, with a link to each shape that it names."""
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in schema:
        return " or ".join(shape(item) for item in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    kind = schema.get("type", "any")
    if isinstance(kind, list):
        kind = " or ".join(kind)
    if "items" in schema:
        return f"list of {shape(schema['items'])}"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"object of {shape(schema['additionalProperties'])}"
    return str(kind)
