"""The tool that counts words finds the comments of each language, and nothing else."""

import importlib.util
from pathlib import Path

import pytest

_SPEC = importlib.util.spec_from_file_location("words", Path(__file__).parents[1] / "scripts" / "words.py")
assert _SPEC is not None
assert _SPEC.loader is not None
words = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(words)


def test_comments_of_python_are_its_comments_and_no_strings() -> None:
    text = '"""# not this"""\nx = "# nor this"  # this\n# and this\n'
    assert list(words.comments_of_python(text)) == ["this", "and this"]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('char *a = "/* no */"; /* yes,\n * both lines */', ["yes, both lines"]),
        ("int b; /**< its meaning */", ["its meaning"]),
        ("const c = `// no`; // yes", ["yes"]),
    ],
)
def test_comments_of_c_and_javascript_are_not_looked_for_in_texts(text: str, found: list[str]) -> None:
    assert list(words.comments_of_c(text)) == found


def test_turns_are_counted_in_comments_of_each_kind_but_not_in_what_a_tool_reads(tmp_path: Path) -> None:
    package = tmp_path / "teds_provision"
    for path, text in {
        "teds_provision/a.py": "x = 1  # nobody told it\ny = 2  # noqa: nobody\n",
        "teds_provision/ncap/page/js/a.js": "// where it stands\n",
        "firmware/src/a.c": "/* at all */\n",
    }.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text, encoding="utf-8")
    rows = {label: figures for label, *figures in words.table_of_comments(package)}
    assert rows["words in comments"] == ["3", "2", "3"]
    assert [figure.split()[1] for figure in rows["nobody, somebody, anybody, everybody, whoever"]] == [
        "(1)",
        "(0)",
        "(0)",
    ]
    assert [figure.split()[1] for figure in rows["where"]] == ["(0)", "(0)", "(1)"]
    assert [figure.split()[1] for figure in rows["anew, at all, for good, of its own"]] == ["(0)", "(1)", "(0)"]
