"""What the documentation shows can be typed, and what it links to exists."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import click
import pytest

from teds_provision.station.store.schema import SCHEMA_VERSION
from tests.cli.test_help import chain

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), ROOT / "firmware" / "README.md"]
PAGES += sorted((ROOT / "firmware" / "docs").glob("*.md"))
LINK = re.compile(r"\]\(([^)\s]+)\)")
PROMPT = re.compile(r"^(?:[a-z]+)?\$ ")


def prose(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def anchor(heading: str) -> str:
    """Return the anchor that a forge makes of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", prose(page.read_text(encoding="utf-8")), flags=re.MULTILINE)
    return {anchor(heading) for heading in headings}


def broken_links(page: Path) -> Iterator[str]:
    for target in LINK.findall(prose(page.read_text(encoding="utf-8"))):
        place, _, part = target.partition("#")
        if ":" in place:
            continue
        path = (page.parent / place).resolve() if place else page
        if not path.exists():
            yield f"{page.relative_to(ROOT)}: {target}"
        elif part and path.suffix == ".md" and part not in anchors(path):
            yield f"{page.relative_to(ROOT)}: {target} (no such heading)"


def shown(page: Path) -> Iterator[str]:
    """Yield every command of ours in a code block, continued lines joined, without what a shell does around it."""
    for block in re.findall(r"^```[a-z]*\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            command = PROMPT.sub("", line.strip())
            if command.startswith("teds-provision "):
                yield re.split(r"\s+(?:#|&&|\||[0-9]?<|>|&)(?:\s|$)", command, maxsplit=1)[0].removesuffix("&")


def wrong(line: str) -> str:
    """Why a command line would be refused before it ran; "" where it would not."""
    try:
        words = shlex.split(line)[1:]
    except ValueError as error:
        return str(error)
    if not words:
        return ""  # the program alone
    try:
        with ExitStack() as stack:
            chain(stack, words)
    except click.UsageError as error:
        return error.format_message()
    except click.exceptions.Exit:
        return ""
    return ""


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_links_lead_to_pages_and_headings_that_exist(page: Path) -> None:
    assert list(broken_links(page)) == []


@pytest.mark.needs_room("plant")
@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_commands_that_are_shown_can_be_typed(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused = []
    for line in shown(page):
        why = wrong(line)
        if why and not any(item in why for item in ("There is no file", "There is no folder")):
            refused.append(f"{line}: {why}")
    assert refused == []


def test_a_broken_link_and_a_wrong_option_would_be_found(tmp_path: Path) -> None:
    assert wrong("teds-provision nodes --nonsense")
    assert wrong("teds-provision vouch --all")
    assert wrong("teds-provision nodes") == ""
    page = ROOT / "docs" / "README.md"
    assert "measure-what-comes" in anchors(ROOT / "docs" / "ncap.md")
    assert anchor("What `make demo` prints") == "what-make-demo-prints"
    assert page in PAGES


def test_the_store_page_and_the_changelog_name_the_schema_of_today() -> None:
    assert f"## Tables (schema {SCHEMA_VERSION})" in (ROOT / "docs" / "store.md").read_text(encoding="utf-8")
    assert f"The store now has schema {SCHEMA_VERSION}." in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
