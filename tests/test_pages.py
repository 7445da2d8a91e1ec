"""The pages and sections that the code names exist: who reads a docstring can look them up in docs/."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

from tests.parsed import walked

ROOT = Path(__file__).parent.parent
_FOLDERS = (ROOT / "docs" / "contract", ROOT / "docs" / "internals", ROOT / "docs", ROOT / "docs" / "adr", ROOT)
PAGES = {page.name: page for folder in _FOLDERS for page in folder.glob("*.md")}
PAGES["model/README.md"] = ROOT / "model" / "README.md"
PAGES |= {f"contract/{page.name}": page for page in (ROOT / "docs" / "contract").glob("*.md")}
NAMED = re.compile(r'\b((?:model/|contract/)?[A-Za-z0-9-]+\.md)((?:,?\s+(?:and\s+)?\\?"[^"\\]+\\?")*)')
NUMBERED = re.compile(r"\b((?:contract/)?[a-z-]+\.md),?\s+sections?\s+([0-9]+(?:(?:,|\s+and|\s+to)\s+[0-9]+)*)")


def headings(page: Path) -> set[str]:
    return {line.lstrip("#").strip() for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("#")}


def named(text: str) -> list[tuple[str, str]]:
    """Page and section, "" for the page alone; ``2. `` stands for the section of that number."""
    found = [(match[1], "") for match in NAMED.finditer(text)]
    for match in NAMED.finditer(text):
        found += [(match[1], " ".join(section.split())) for section in re.findall(r'"([^"\\]+)\\?"', match[2])]
    for match in NUMBERED.finditer(text):
        found += [(match[1], f"{number}. ") for number in re.findall("[0-9]+", match[2])]
    return found


def has_section(page: str, section: str) -> bool:
    sections = headings(PAGES[page])
    return section in sections or (section.endswith(". ") and any(name.startswith(section) for name in sections))


def test_pages_and_sections_that_the_code_names_exist() -> None:
    wrong = []
    for path in sorted((ROOT / "teds_provision").rglob("*.py")):
        for page, section in named(path.read_text(encoding="utf-8")):
            if page not in PAGES or (section and not has_section(page, section)):
                wrong.append(f"{path.relative_to(ROOT)}: {page} {section}".strip())
    assert not wrong, "\n".join(wrong)


def test_a_page_that_is_not_there_would_be_found() -> None:
    assert named('see profile.md, "Key agreement"; operation.md sections 2 and 4') == [
        ("profile.md", ""),
        ("operation.md", ""),
        ("profile.md", "Key agreement"),
        ("operation.md", "2. "),
        ("operation.md", "4. "),
    ]
    assert has_section("profile.md", "Key agreement")
    assert not has_section("profile.md", "Key agreements")
    assert not has_section("operation.md", "99. ")


# -- names in pages and docstrings -------------------------------------------------------------------------------------

PACKAGE = ROOT / "teds_provision"
SEE = re.compile(r"\b[Ss]ee\s+(?:``)?((?:[a-z_]+\.)*[A-Z][a-z]\w*(?:\.\w+)*)")
ROLE = re.compile(r":(mod|func|class|meth|data|attr|exc):`~?([^`]+)`")


@cache
def defined(path: Path) -> set[str]:
    """Functions, classes and constants that a file makes."""
    found = set()
    for node in walked(path):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                found.add(name)
    return found


def missing_on_the_way(text: str) -> list[str]:
    """Return files and functions of "file `name`, `name` -> file ..." that are not there."""
    wrong, here, path = [], set[str](), ""
    for match in re.finditer(r"`([a-z_0-9/]+\.py)`|`([A-Za-z_]+)`", text):
        if match[1] is not None:
            path = match[1]
            here = defined(PACKAGE / path) if (PACKAGE / path).is_file() else set()
            wrong += [] if here else [path]
        elif path and here and match[2] not in here:
            wrong.append(f"{path} {match[2]}")
    return wrong


def test_the_ways_through_the_code_are_as_the_page_says() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = page.partition("## Nine ways through the code")[2].partition("\n## ")[0]
    ways = re.split(r"\n[1-9]\. ", section)[1:]
    assert len(ways) == 9
    wrong = [name for way in ways for name in missing_on_the_way(way)]
    assert wrong == []
    assert missing_on_the_way("`provisioning/verify.py` `judge`, `jugde` → `provisioning/verifi.py` `judge`") == [
        "provisioning/verify.py jugde",
        "provisioning/verifi.py",
    ]


def missing_in_the_glossary(text: str) -> list[str]:
    """Return the files that the page names and that are neither in the package nor beside it."""
    places = (PACKAGE, ROOT / "docs")
    return [
        name
        for name in re.findall(r"`((?:\.\./)*[a-z_0-9/]+(?:\.py|/))`", text)
        if not any((p / name).exists() for p in places)
    ]


@pytest.mark.needs_room("plant")
def test_the_glossary_names_files_that_exist_and_defines_each_word_once() -> None:
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    assert missing_in_the_glossary(text) == []
    assert missing_in_the_glossary("`provisioning/verify.py` `provisioning/verifi.py` `../tests/strangers/`") == [
        "provisioning/verifi.py"
    ]
    for section in text.split("\n## ")[1:]:
        words = [line.split("|")[1].strip() for line in section.splitlines() if line.startswith("| ")]
        assert sorted(set(words)) == sorted(words), section.splitlines()[0]


def unknown_roles(path: Path, text: str, nodes: Iterable[ast.AST], every: set[str]) -> list[str]:
    """References such as :func:`name` to what neither the file knows nor, with a dot, the package."""
    if not ROLE.search(text):
        return []
    known = set(defined(path))
    for node in nodes:
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                known.add(name)
            case ast.alias(name=name, asname=other):
                known.add((other or name).rpartition(".")[2])
    wrong = []
    for role, target in ROLE.findall(text):
        if role == "mod":
            whole = PACKAGE.parent.joinpath(*target.split("."))
            near = path.parent.joinpath(*target.lstrip(".").split("."))
            there = any(path.with_suffix(".py").is_file() or path.is_dir() for path in (whole, near))
        else:
            head, _, last = target.rpartition(".")
            there = last in (every if head else known)
        if not there:
            wrong.append(f"{path.relative_to(ROOT)}: :{role}:`{target}`")
    return wrong


def test_what_docstrings_refer_to_exists() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    every = set().union(*map(defined, files))
    assert [
        unknown_role
        for path in files
        for unknown_role in unknown_roles(path, path.read_text(encoding="utf-8"), walked(path), every)
    ] == []
    here = PACKAGE / "limits.py"
    text = "x = 1  # :func:`gone` :mod:`.gone` :func:`x`"
    assert len(unknown_roles(here, text, ast.walk(ast.parse(text)), every)) == 2


def unknown_sees(text: str, every: set[str]) -> list[str]:
    """Return the names behind "see" of which a part is nowhere: a module, a class or what belongs to it."""
    return [name for name in SEE.findall(text) if not every.issuperset(name.split("."))]


def test_each_name_that_a_docstring_says_to_see_exists() -> None:
    files = sorted(PACKAGE.rglob("*.py"))
    every = set().union(*map(defined, files), *(path.relative_to(PACKAGE).with_suffix("").parts for path in files))
    wrong = [
        f"{path.relative_to(ROOT)}: see {name}"
        for path in files
        for node in walked(path)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in unknown_sees(node.value, every)
    ]
    assert wrong == []
    text = "see\\nNodeHandler, see ``links.ports.Trace``; see NodeHandlerHandler; see ``Link.nowhere``"
    assert unknown_sees(text, every) == ["NodeHandlerHandler", "Link.nowhere"]


# -- the form of a page ------------------------------------------------------------------------------------------------

GUIDES = sorted(page for page in (ROOT / "docs").glob("*.md") if page.name != "README.md")


def texts(*folders: str) -> str:
    """Return all literal texts of the code, with a mark where a value comes in, and the page's scripts."""
    found: list[str] = []
    for folder in folders:
        for path in (ROOT / folder).rglob("*.py"):
            for node in walked(path):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    found.append(node.value)
                elif isinstance(node, ast.JoinedStr):
                    parts = (part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
                    found.append("".join(map(str, parts)))
        found += [path.read_text(encoding="utf-8") for path in (ROOT / folder).rglob("page/**/*.[jh]*")]
    return "\n".join(found)


def test_every_page_says_what_for_what_to_type_what_you_will_see_what_can_go_wrong_and_what_is_next() -> None:
    wrong = []
    for page in GUIDES:
        text = page.read_text(encoding="utf-8")
        lacks = [
            part for part in ("\n**For** ", "\n```", "**You will see**", "\n## What can go wrong\n") if part not in text
        ]
        if lacks or re.findall("^## (.+)", text, re.MULTILINE)[-1] != "Next":
            wrong.append(f"{page.name}: {lacks or 'the last section is not Next'}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.needs_room("plant")
def test_what_can_go_wrong_quotes_what_the_program_says() -> None:
    text = texts("teds_provision", "benchmarks", "tests/vectors")
    wrong = []
    for page in GUIDES:
        _, _, part = page.read_text(encoding="utf-8").partition("\n## What can go wrong\n")
        for row in re.findall(r"^\| (?!what |---)([^|]+) \|", part.partition("\n## ")[0], re.MULTILINE):
            for quoted in re.findall("`([^`]+)`", row):
                pieces = [piece.strip(" .") for piece in quoted.split("…")]
                if not quoted.startswith("tests/") and not all(piece in text for piece in pieces):
                    wrong.append(f"{page.name}: {quoted}")
    assert not wrong, "\n".join(wrong)
