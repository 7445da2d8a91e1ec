"""The pages and sections that the code names exist: who reads a docstring can look them up in docs/."""

from __future__ import annotations

import re
from pathlib import Path

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
    return section in sections or (section.endswith(". ") and any(one.startswith(section) for one in sections))


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
