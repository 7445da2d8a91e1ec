"""Compile the package with a probe before each statement of its functions, so that every process counts what it runs.

A probe is one store into a file in memory, which all processes of a test share: commands, services, nodes, and whatever
they start. So nothing is traced, foreign code costs what it always costs, and a process killed with -9 has counted as
well. An ``if`` without ``else`` gets one in which a probe alone stands, as does a loop: branches are counted, too.
Statements of modules and classes run once in a process, whichever test comes first, and are not counted.

The sources stay as they are: what is compiled lies where Python looks for it (``__pycache__``), with their time and
size.
"""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator
from importlib import _bootstrap_external
from pathlib import Path

PLACE = "PROBE_HITS"
"""The variable of the environment that names the file with one octet for each probe."""
HITS = "__hit__"

# What a module does first: find the file, unless another module of the process did. A dict takes the hits of a process
# whose environment names none.
_PRELUDE = f"""
try:
    {HITS}
except NameError:
    import builtins as _b, mmap as _m, os as _o
    try:
        _f = _o.open(_o.environ["{PLACE}"], _o.O_RDWR)
        _b.{HITS} = _m.mmap(_f, 0)
        _o.close(_f)
        del _f
    except (KeyError, OSError):
        _b.{HITS} = {{}}
    del _b, _m, _o
"""


class Probes(ast.NodeTransformer):
    """Puts probes into a module; ``places`` says of each where it stands."""

    def __init__(self, name: str, places: list[str]) -> None:
        """Number the probes on from those that ``places`` has."""
        self._name, self._places = name, places
        self._depth = 0

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        """Probe the body of a function."""
        return self._function(node)

    def visit_AsyncFunctionDef(self, node: ast.AsyncFunctionDef) -> ast.AST:
        """Probe the body of a coroutine."""
        return self._function(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        """Probe the methods alone, of a class in a function as well."""
        depth, self._depth = self._depth, 0
        self.generic_visit(node)
        self._depth = depth
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        """Probe every list of statements below a node."""
        super().generic_visit(node)
        if self._depth:
            for name in ("body", "orelse", "finalbody"):
                block = getattr(node, name, None)
                if isinstance(block, list) and block and isinstance(block[0], ast.stmt):
                    setattr(node, name, list(self._probed(block)))
            if isinstance(node, ast.If | ast.For | ast.While | ast.AsyncFor) and not node.orelse:
                node.orelse = [self._probe(node, "else")]
        return node

    def _function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> ast.AST:
        self._depth += 1
        self.generic_visit(node)
        self._depth -= 1
        return node

    def _probed(self, block: list[ast.stmt]) -> Iterator[ast.stmt]:
        for number, statement in enumerate(block):
            text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if not (text and number == 0) and not isinstance(statement, ast.Global | ast.Nonlocal):
                yield self._probe(statement, "")
            yield statement

    def _probe(self, where: ast.stmt, which: str) -> ast.stmt:
        self._places.append(f"{self._name}:{where.lineno}{' ' if which else ''}{which}")
        (made,) = ast.parse(f"{HITS}[{len(self._places) - 1}] = 1").body
        for node in ast.walk(made):
            if "lineno" in node._attributes:
                node.lineno = node.end_lineno = where.lineno  # type: ignore[attr-defined]
                node.col_offset = node.end_col_offset = where.col_offset  # type: ignore[attr-defined]
        return made


def probed(source: str, name: str, places: list[str]) -> ast.Module:
    """Return a module with its probes, whose places are added to ``places``."""
    tree = ast.parse(source)
    Probes(name, places).visit(tree)
    first = next(
        (
            number
            for number, statement in enumerate(tree.body)
            if not (isinstance(statement, ast.ImportFrom) and statement.module == "__future__")
            and not (number == 0 and isinstance(statement, ast.Expr))
        ),
        len(tree.body),
    )
    tree.body[first:first] = ast.parse(_PRELUDE).body
    return ast.fix_missing_locations(tree)


def compile_with_probes(root: Path) -> list[str]:
    """Compile ``teds_provision`` below ``root`` with probes; return the place of each, ``file:line``."""
    places: list[str] = []
    for path in sorted((root / "teds_provision").rglob("*.py")):
        name = path.relative_to(root).as_posix()
        code = compile(probed(path.read_text(encoding="utf-8"), name, places), str(path), "exec", dont_inherit=True)
        found = path.stat()
        octets = _bootstrap_external._code_to_timestamp_pyc(  # type: ignore[attr-defined]
            code, int(found.st_mtime), found.st_size
        )
        compiled = Path(importlib.util.cache_from_source(str(path)))
        compiled.parent.mkdir(exist_ok=True)
        compiled.write_bytes(octets)
    return places
