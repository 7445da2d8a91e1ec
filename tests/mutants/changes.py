"""Mutants: what may be changed in a module, as spans of its text; by name (a rule of the profile) or by chance.

A pattern names a function and an expression in it, not a file or a line, so that it outlives a move. A random one is
drawn from what a slip of the hand could be: a comparison, and for or, a lost not, a condition that always or never
holds, a number one off, a step or a refusal that is left out, the other of True and False.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from tests.parsed import parsed

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "teds_provision"
SOURCES_IN_C = ROOT / "firmware" / "src"
SCRIPTS = PACKAGE / "ncap" / "page" / "js"

_COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not",
    ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
_SAID_ONLY = ("notice", "debug", "info", "warning", "warn", "note", "tell", "say", "_say", "notify", "_notify", "emit")
_DOERS = (ast.Call, ast.Await)
_NAME = re.compile(r"[A-Za-z_]+")
_JOINED = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")


@dataclass(frozen=True)
class Mutant:
    """One change: in ``path`` (from the root) the characters ``start`` to ``end`` become ``text``."""

    path: str
    start: int
    end: int
    text: str
    function: str
    line: int
    description: str
    words: frozenset[str] = frozenset()
    test: str = ""
    rule: str = ""

    def __str__(self) -> str:
        return f"{self.path}:{self.line} {self.function}: {self.description}"

    def applied(self, source: str) -> str:
        """Return the module with the change in it."""
        return source[: self.start] + self.text + source[self.end :]


@dataclass(frozen=True)
class Pattern:
    """A rule, and what holds it: in ``function`` (``name``, ``Class.name``) the expression ``was`` becomes ``now``.

    ``test`` is the file that holds it, where others seem nearer.
    """

    rule: str
    function: str
    was: str
    now: str
    test: str = ""


@dataclass(frozen=True)
class CPattern:
    """A rule of the node in C, and the text of a file in ``firmware/src`` that holds it; ``test`` notices."""

    rule: str
    file: str
    was: str
    now: str
    test: str

    @property
    def path(self) -> Path:
        """The file."""
        return SOURCES_IN_C / self.file


@dataclass(frozen=True)
class ScriptPattern(CPattern):
    """The same of the page and a script of it, in ``ncap/page/js``."""

    @property
    def path(self) -> Path:
        """The script."""
        return SCRIPTS / self.file


class Module:
    """One module of the package: its text, its tree, and where each node lies in the text."""

    def __init__(self, name: str, source: str, tree: ast.Module | None = None) -> None:
        self.name, self.source = name, source
        self.tree = ast.parse(source) if tree is None else tree

    @cached_property
    def _lines(self) -> list[str]:
        return self.source.splitlines(keepends=True)

    @cached_property
    def _begins(self) -> list[int]:
        return list(itertools.accumulate(map(len, self._lines), initial=0))

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """Return where a node begins and ends, in characters."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._at(node.lineno, node.col_offset), self._at(node.end_lineno, node.end_col_offset)

    def _at(self, line: int, octets: int) -> int:
        text = self._lines[line - 1]
        return self._begins[line - 1] + (octets if text.isascii() else len(text.encode()[:octets].decode()))

    @cached_property
    def functions(self) -> list[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
        """Every function with its name, that of its class before it; an outer one before those in it."""
        return list(_functions(self.tree, ""))

    @cached_property
    def by_name(self) -> dict[str, list[ast.FunctionDef | ast.AsyncFunctionDef]]:
        """The functions of each name: 800 patterns look theirs up in every module."""
        named: dict[str, list[ast.FunctionDef | ast.AsyncFunctionDef]] = {}
        for name, function in self.functions:
            named.setdefault(name, []).append(function)
        return named

    def mutant(
        self,
        node: ast.expr | ast.stmt,
        text: str,
        function: str,
        description: str = "",
        words: frozenset[str] = frozenset(),
    ) -> Mutant:
        """Return a mutant that puts ``text`` in the place of a node; ``words`` are those of its function."""
        start, end = self.span(node)
        was = " ".join(self.source[start:end].split())
        return Mutant(
            self.name, start, end, text, function, node.lineno, description or f"{was[:90]}  ->  {text}", words
        )


def _functions(node: ast.AST, of: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield f"{of}{child.name}", child
            yield from _functions(child, f"{of}{child.name}.")
        elif isinstance(child, ast.ClassDef):
            yield from _functions(child, f"{child.name}.")
        elif not isinstance(child, ast.expr):
            yield from _functions(child, of)


def modules(room: str = "") -> list[Module]:
    """Return every module of the package below ``room`` (``steps``, ``protocol/tim``, ``provisioning/agree.py``)."""
    place = PACKAGE / room
    paths = [place] if place.is_file() else sorted(place.rglob("*.py"))
    return [Module(path.relative_to(ROOT).as_posix(), path.read_text(), parsed(path)) for path in paths]


def words_of(text: str) -> frozenset[str]:
    """Return the words of a text in lower case, names cut where they are joined."""
    return frozenset(
        word.lower() for name in _NAME.findall(text) for word in (name, *_JOINED.findall(name)) if len(word) > 2
    )


def _words(module: Module, tree: ast.stmt) -> frozenset[str]:
    return words_of(module.source[slice(*module.span(tree))])


def found(pattern: Pattern, where: list[Module]) -> list[Mutant]:
    """Return the places of a pattern: an expression, or a statement that is one expression; one, where all is well."""
    parsed = ast.parse(pattern.was, mode="eval")
    kind, wanted = type(parsed.body), ast.unparse(parsed)
    description = f"{pattern.rule}: {pattern.was}  ->  {pattern.now}"
    return [
        replace(
            module.mutant(node, pattern.now, pattern.function, description, _words(module, tree)),
            test=pattern.test,
            rule=pattern.rule,
        )
        for module in where
        for tree in module.by_name.get(pattern.function, ())
        for node in ast.walk(tree)
        if isinstance(node, kind) and ast.unparse(node) == wanted  # to unparse all would take twice as long
    ]


def found_in_c(pattern: CPattern) -> list[Mutant]:
    """Return the places of a pattern in the C library or in a script of the page; one, where all is well."""
    path = pattern.path
    source, name = path.read_text(), path.relative_to(ROOT).as_posix()
    description = f"{pattern.rule}: {' '.join(pattern.was.split())[:90]}  ->  {pattern.now}"
    return [
        Mutant(
            name, place.start(), place.end(), pattern.now, "", source.count("\n", 0, place.start()) + 1, description,
            test=pattern.test, rule=pattern.rule,
        )
        for place in re.finditer(re.escape(pattern.was), source)
    ]  # fmt: skip


def any_of(module: Module) -> list[Mutant]:
    """Return every mutant of a module that chance may draw."""
    return [mutant for function, tree in module.functions for mutant in _of_function(module, function, tree)]


def _of_function(module: Module, function: str, tree: ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[Mutant]:
    if tree.name in ("__repr__", "__str__"):
        return
    words = _words(module, tree)
    for node in _inner(tree):
        for text, part in _changes(module, node):
            yield module.mutant(part, text, function, words=words)


def _inner(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a function's body; not those of functions in it, of annotations, defaults and what errors say."""
    body = tree.body if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef) else ast.iter_child_nodes(tree)
    for child in body:
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.JoinedStr):
            continue
        yield child
        if isinstance(child, ast.Raise | ast.Assert) or _says_only(child):
            continue
        yield from _inner(child)


def _says_only(node: ast.AST) -> bool:
    if not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        return False
    called = node.value.func
    return (called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")) in _SAID_ONLY


def _changes(module: Module, node: ast.AST) -> Iterator[tuple[str, ast.expr | ast.stmt]]:
    match node:
        case ast.Compare(ops=[op]) if type(op) in _COMPARISONS:
            left, right = (module.source[slice(*module.span(side))] for side in (node.left, node.comparators[0]))
            yield f"({left}) {_COMPARISONS[type(op)]} ({right})", node
        case ast.BoolOp():
            other = " or " if isinstance(node.op, ast.And) else " and "
            yield (
                "("
                + other.join(f"({module.source[slice(*module.span(expression))]})" for expression in node.values)
                + ")",
                node,
            )
        case ast.UnaryOp(op=ast.Not()):
            yield f"({module.source[slice(*module.span(node.operand))]})", node
        case ast.If() | ast.IfExp() | ast.While():
            yield "False", node.test
            if not isinstance(node, ast.While):
                yield "True", node.test
        case ast.Constant(value=bool(value)):
            yield str(not value), node
        case ast.Constant(value=int(value)):
            yield str(value + 1), node
        case ast.Raise() | ast.Continue() | ast.Break():
            yield "pass", node
        case ast.Expr(value=value) if isinstance(value, _DOERS) and not _says_only(node):
            yield "pass", node
        case ast.AugAssign():
            yield "pass", node
