"""Count the words that hold readers of the code up: a mirror, not a gate.

Usage: python scripts/words.py [DIRECTORY]. Prints two tables; `make words` runs it. The first is about docstrings and
names. Its rates are per 10,000 words of docstrings, so that they can be compared with other codebases (zigpy,
sigstore-python, python-tuf, esptool: the last column has the highest of the four). The second has the same turns, and
some more, in comments: of Python, of the node in C, and of the web page.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "teds_provision"
FIRMWARE = "firmware"
"""The folder beside the package with the node in C, in `src` and `include`."""

RATES = (
    ("where", r"\bwhere\b", "9"),
    ("tell, told, say, says, said", r"\b(tells?|told|says?|said)\b", "0"),
    ("nobody, somebody, anybody, everybody, whoever", r"\b(no|some|any|every)body\b|\bwhoever\b", "0"),
    ("sentences that begin with What or Whether", r"(?:^|[.:] )Wh(?:at|ether)\b", "0"),
    ("stands, lies, hangs", r"\b(stands?|stood|lies|lay|hangs)\b", "0"),
    ("anew, at all, for good, of its own", r"\banew\b|\bat all\b|\bfor good\b|\bof its own\b", "0"),
    ("Return, Raise, Yield", r"\b(Return|Raise|Yield)s?\b", "88 to 144"),
)
"""A label, the expression that is counted in docstrings, and the rate of the codebases compared with."""

IN_COMMENTS = (
    *RATES[:6],
    ("everyone, anyone, someone", r"\b(every|any|some) ?one\b", ""),
    ("hears, asks, looks (of programs)", r"\b(hears?|heard|asks|looks?|looked)\b", ""),
    ("'no' for a complement: is no number", r"\b(is|are) no\b", ""),
)
"""As RATES, for comments, in which `Return` and its kin are rare."""

DIRECTIVE = re.compile(r"(type: ignore|noqa|pragma|fmt|ruff|pyright|SPDX|!|@)")
"""Comments that a tool reads, and Doxygen's commands."""

FOREIGN = re.compile(r'"(?:[^"\\\n]|\\.)*"|\'(?:[^\'\\\n]|\\.)*\'|`(?:[^`\\]|\\.)*`|/\*.*?\*/|//[^\n]*', re.DOTALL)
"""A text or a comment in C or JavaScript."""

FUNCTIONS = ("take", "_take", "let_go", "of", "tell", "_tell", "told", "ask", "found", "sure", "the_one")
"""Names of functions that have meant several things."""

VARIABLES = ("one", "each")
"""Loop variables that do not name what they hold."""

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def trees(folder: Path) -> dict[Path, ast.Module]:
    """Return the syntax tree of every module below a folder."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("*.py"))}


def docstrings(modules: dict[Path, ast.Module]) -> Iterator[tuple[Documented, str]]:
    """Yield every docstring with the module, class or function that has it."""
    for tree in modules.values():
        for node in ast.walk(tree):
            if isinstance(node, Documented) and (text := ast.get_docstring(node)):
                yield node, text


def exceptions(modules: dict[Path, ast.Module]) -> list[str]:
    """Return the names of all exception classes: those that derive from Exception, over any number of steps."""
    bases = {
        node.name: [base.id for base in node.bases if isinstance(base, ast.Name)]
        for tree in modules.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    known = {"Exception", "ValueError", "OSError", "RuntimeError"}
    while more := {name for name, of in bases.items() if name not in known and known.intersection(of)}:
        known |= more
    return sorted(name for name in known if name in bases)


def targets(modules: dict[Path, ast.Module]) -> Counter[str]:
    """Count the loops (statements and comprehensions) by the variables that they bind."""
    loops = (
        node.target
        for tree in modules.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.For | ast.AsyncFor | ast.comprehension)
    )
    return Counter(name.id for target in loops for name in ast.walk(target) if isinstance(name, ast.Name))


def no_shorter_than_its_function(node: Documented, text: str) -> bool:
    """Return True if the docstring of a function has at least as many lines as the rest of its body."""
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) or len(node.body) < 2:
        return False
    last = node.body[-1].end_lineno or node.body[-1].lineno
    return text.count("\n") + 1 >= last - node.body[1].lineno + 1


def table(folder: Path) -> list[tuple[str, str, str]]:
    """Return the rows of the table: a label, the figure here, and the highest figure of the codebases compared with."""
    modules = trees(folder)
    documented = list(docstrings(modules))
    texts = [text for _, text in documented]
    words = sum(len(text.split()) for text in texts)
    rows = [("words in docstrings", str(words), "")]
    for label, expression, anchor in RATES:
        count = sum(len(re.findall(expression, text, re.MULTILINE)) for text in texts)
        rows.append((f"{label}, per 10,000 words", f"{count * 10_000 / max(words, 1):.1f} ({count})", anchor))
    for first in ("What", "Whether"):
        rows.append((f"docstrings that begin with {first}", str(sum(t.split()[0] == first for t in texts)), ""))
    same = sum(no_shorter_than_its_function(node, text) for node, text in documented)
    rows.append(("docstrings as long as their function", str(same), ""))
    loops = targets(modules)
    rows += [(f"loop variables named `{name}`", str(loops[name]), "0") for name in VARIABLES]
    defined = Counter(
        node.name
        for tree in modules.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )
    rows += [(f"functions named `{name}`", str(defined[name]), "") for name in FUNCTIONS]
    raised = exceptions(modules)
    short = [name for name in raised if not name.endswith("Error")]
    rows.append(("exceptions without Error at the end", f"{len(short)} of {len(raised)}", "0"))
    return rows


def comments_of_python(text: str) -> Iterator[str]:
    """Yield the comments of a Python source, each line by itself."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.string.lstrip("# ")


def comments_of_c(text: str) -> Iterator[str]:
    """Yield the comments of a source in C or JavaScript, each as one line without its markers."""
    for found in FOREIGN.finditer(text):
        if found[0].startswith("//"):
            yield found[0].lstrip("/ ")
        elif found[0].startswith("/*"):
            yield " ".join(re.sub(r"\n\s*\*", " ", found[0][2:-2].lstrip("*<")).split())


def comments(folder: Path) -> dict[str, list[str]]:
    """Return the comments of a package, of the node in C beside it, and of its web page, by a name for each."""
    beside = folder.resolve().parent / FIRMWARE
    sources = {
        "Python": (comments_of_python, sorted(folder.rglob("*.py"))),
        "C": (comments_of_c, sorted([*beside.glob("src/*.[ch]"), *beside.glob("include/**/*.h")])),
        "page": (comments_of_c, sorted(folder.glob("ncap/page/js/**/*.js"))),
    }
    return {
        name: [
            comment
            for path in paths
            for comment in read(path.read_text(encoding="utf-8"))
            if not DIRECTIVE.match(comment)
        ]
        for name, (read, paths) in sources.items()
    }


def table_of_comments(folder: Path) -> list[tuple[str, ...]]:
    """Return the rows of the second table: a label, and a figure for each kind of source."""
    found = comments(folder)
    words = {name: sum(len(comment.split()) for comment in texts) for name, texts in found.items()}
    rows: list[tuple[str, ...]] = [("words in comments", *map(str, words.values()))]
    for label, expression, _ in IN_COMMENTS:
        counts = {name: sum(len(re.findall(expression, text)) for text in texts) for name, texts in found.items()}
        rows.append(
            (label, *(f"{count * 10_000 / max(words[name], 1):.1f} ({count})" for name, count in counts.items()))
        )
    return rows


def main() -> None:
    """Print the tables."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else PACKAGE
    for label, figure, anchor in [("", "here", "anchors"), *table(folder)]:
        print(f"{label:55} {figure:>14} {anchor:>12}")
    print()
    for label, *figures in [("comments, per 10,000 words", "Python", "C", "page"), *table_of_comments(folder)]:
        print(f"{label:55} " + " ".join(f"{figure:>14}" for figure in figures))


if __name__ == "__main__":
    main()
