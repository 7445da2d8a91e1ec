"""docs/security.md says which test holds which promise: each of them is there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILE = re.compile(r"tests/[\w/]+\.py")
TEST = re.compile(r"`(test_\w+)`")
RULE = re.compile(r"\b(M\d|[A-Z]{4,}(?:_[A-Z]+)*)\b")


def promises() -> list[str]:
    """Return the cells of the page's table that name tests."""
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    table = page.partition("## Which test holds which promise")[2].partition("\n## ")[0]
    return [line.split("|")[2] for line in table.splitlines() if line.startswith("| ")][1:]


def test_every_test_that_the_page_names_is_there() -> None:
    cells = promises()
    assert len(cells) > 25
    missing: list[str] = []
    for cell in cells:
        files = [ROOT / name for name in FILE.findall(cell)]
        assert files, f"no test in {cell!r}"
        missing += [str(file) for file in files if not file.is_file()]
        code = "".join(file.read_text(encoding="utf-8") for file in files if file.is_file())
        missing += [name for name in TEST.findall(cell) if f"def {name}(" not in code]
    assert not missing


def test_every_rule_of_the_model_that_the_page_names_is_there() -> None:
    rules = [rule for cell in promises() for part in cell.split("model/")[1:] for rule in RULE.findall(part)]
    assert rules
    model = (ROOT / "model" / "README.md").read_text(encoding="utf-8")
    assert [rule for rule in rules if not re.search(rf"^\| {rule} ", model, re.MULTILINE)] == []
