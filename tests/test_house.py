"""The figures of the house (scripts/house.py) stay at what was reached, and what code cites of docs/ is there.

A figure may sink: then the number here sinks with it. It may not rise: split the function, divide the folder, put the
import on top. An exception has a name and a reason.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "contract").glob("*.md"), *ROOT.glob("*.md")]

COMPLEX_FUNCTIONS = 14
FILES_IN_A_FOLDER = 15
FULLER: dict[str, int] = {}
"""Folders that have more files, and how many."""
LATE_IMPORTS = {
    "__main__.py": 2,  # Ctrl-C while Python imports the command line ends with 130 as later
}
"""Imports of our own inside functions, by file."""


@pytest.fixture(scope="module")
def house() -> ModuleType:
    spec = importlib.util.spec_from_file_location("house", ROOT / "scripts" / "house.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["house"] = module  # where its dataclasses look for their annotations
    spec.loader.exec_module(module)
    return module


def test_imports_of_our_own_stand_on_top(house: ModuleType) -> None:
    found = Counter(place.rpartition(":")[0] for place in house.late_imports(house.modules()))
    more = [f"{file}: {count}" for file, count in found.items() if count > LATE_IMPORTS.get(file, 0)]
    assert not more, "import on top, through the room if it must load late (CONTRIBUTING.md, The house)"


def test_no_more_functions_have_too_many_branches(house: ModuleType) -> None:
    found = house.complex_functions(house.modules())
    assert len(found) <= COMPLEX_FUNCTIONS, "\n".join(["a function of complexity C more:", *found])


def test_a_folder_holds_what_can_be_looked_over(house: ModuleType) -> None:
    over = [f"{folder}: {n} files" for n, folder in house.drawers() if n > FULLER.get(folder, FILES_IN_A_FOLDER)]
    assert not over


# -- what code says about docs/ -------------------------------------------------------------------------------------

_CITED = re.compile(
    r"(?<![\w/.-])(?P<page>(?:docs/)?[A-Za-z0-9][\w.-]*\.md)"
    r"(?:,? (?:sections? )?(?P<numbers>\d+(?:\.\d+)?(?:(?:,| and|, and| to) \d+(?:\.\d+)?)*)|, \"(?P<words>[^\"]+)\")?"
)
_NUMBERED = re.compile(r"^#+ (\d+(?:\.\d+)?)[. :]", re.MULTILINE)


def cited() -> Iterator[tuple[str, str, list[str], str]]:
    """(file, page, numbers of sections, quoted words) of each place in the code that names a page."""
    for path in sorted((ROOT / "teds_provision").rglob("*.py")):
        text = re.sub(r"\s+", " ", path.read_text(encoding="utf-8"))
        for found in _CITED.finditer(text):
            numbers = re.findall(r"\d+(?:\.\d+)?", found["numbers"] or "")
            yield str(path.relative_to(ROOT)), found["page"].removeprefix("docs/"), numbers, found["words"] or ""


def test_every_page_and_section_that_code_names_exists() -> None:
    pages: dict[str, str] = {}
    for path in PAGES:
        pages[path.name] = path.read_text(encoding="utf-8")
    wrong = []
    for file, page, numbers, words in cited():
        text = pages.get(page)
        if text is None:
            wrong.append(f"{file}: there is no page {page}")
            continue
        headings = set(_NUMBERED.findall(text))
        wrong += [f"{file}: {page} has no section {number}" for number in numbers if number not in headings]
        if words and words.lower() not in re.sub(r"[\s*`]+", " ", text).lower():
            wrong.append(f"{file}: {page} does not say {words!r}")
    assert not wrong, "\n".join(wrong)


def test_pages_are_named_at_all() -> None:
    found = list(cited())
    assert len(found) > 80, "the pattern above reads no citation any more"
    assert any(numbers for _, _, numbers, _ in found)
    assert any(words for _, _, _, words in found)
