"""The figures of the house: circles, arrows that run back, imports inside functions, complexity, drawers, lines.

Usage: python scripts/house.py. Prints a table; `make house` runs it, and tests/test_house.py holds the figures that
cannot flake against their aims.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeGuard, cast

PACKAGE = Path(__file__).resolve().parent.parent / "teds_provision"
NAME = "teds_provision"


@dataclass(frozen=True)
class Module:
    """One file: its dotted name, its nodes, and the dotted names of ours that it imports, anywhere in it."""

    name: str
    path: Path
    nodes: Sequence[ast.AST]  # as ast.walk finds them: the first is the tree
    imports: frozenset[str]

    @property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return cast("ast.Module", self.nodes[0])


def walked(path: Path) -> Sequence[ast.AST]:
    """Return the nodes of a file."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def modules(walk: Callable[[Path], Sequence[ast.AST]] = walked) -> dict[str, Module]:
    """Return every module of the package by its dotted name; ``walk`` may keep the nodes."""
    found: dict[str, tuple[Path, Sequence[ast.AST]]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = path, walk(path)
    return {
        name: Module(name, path, nodes, frozenset(_targets(nodes, set(found)) - {name}))
        for name, (path, nodes) in found.items()
    }


def _targets(nodes: Iterable[ast.AST], known: set[str]) -> set[str]:
    result: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            result |= {alias.name for alias in node.names if alias.name in known}
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            result |= (whole & known) or {node.module}
    return result


def scripts() -> dict[str, frozenset[str]]:
    """Return the imports of each script of the page, by its path in the page's folder."""
    folder = PACKAGE / "ncap" / "page" / "js"
    found = {}
    for path in folder.rglob("*.js"):
        named = re.findall(r"""from "(\.[^"]+)";""", path.read_text(encoding="utf-8"))
        found[str(path.relative_to(folder))] = frozenset(
            str((path.parent / name).resolve().relative_to(folder)) for name in named
        )
    return found


def c_sources() -> dict[str, frozenset[str]]:
    """Return, for each source of the C library, the sources whose headers it includes or whose functions it calls.

    The functions of teds/node.h are the boards' interface: a source that calls one needs no header of ours, and still
    depends on the source that defines it.
    """
    texts = {path.stem: path.read_text() for path in (PACKAGE.parent / "firmware" / "src").glob("*.c")}
    codes = {name: re.sub(r"/\*.*?\*/", "", text, flags=re.S) for name, text in texts.items()}
    home = {
        function: name
        for name, code in codes.items()
        for function in re.findall(r"^(?!static )\w[^=;{}]*?\b(teds_\w+)\([^;{}]*\)\n\{", code, re.M)
    }
    headers = {path.stem: path.read_text() for path in (PACKAGE.parent / "firmware" / "src").glob("*.h")}
    included = {
        name: re.findall(r'^#include "(\w+)\.h"$', text + headers.get(name, ""), re.M) for name, text in texts.items()
    }
    called = {name: {home.get(word, "") for word in re.findall(r"\bteds_\w+", code)} for name, code in codes.items()}
    return {name: frozenset(texts.keys() & ({*included[name]} | called[name]) - {name}) for name in texts}


def c_shared_names() -> list[str]:
    """Return the static functions of the C library that have one name in several files: a backtrace confuses them."""
    found: dict[str, list[str]] = {}
    for path in sorted((PACKAGE.parent / "firmware" / "src").glob("*.c")):
        for name in re.findall(r"^static [^=;]*?\b(\w+)\([^;]*?\)\n\{", path.read_text(), re.M):
            found.setdefault(name, []).append(path.name)
    return [f"{name} in {', '.join(files)}" for name, files in sorted(found.items()) if len(files) > 1]


def circles(imports: Mapping[str, Collection[str]]) -> list[list[str]]:
    """Return groups of files that import each other (Tarjan's strongly connected components of more than one)."""
    number: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    result: list[list[str]] = []

    def visit(name: str) -> None:
        number[name] = low[name] = len(number)
        stack.append(name)
        for target in imports[name]:
            if target not in number:
                visit(target)
                low[name] = min(low[name], low[target])
            elif target in stack:
                low[name] = min(low[name], number[target])
        if low[name] == number[name]:
            group = []
            while not group or group[-1] != name:
                group.append(stack.pop())
            if len(group) > 1:
                result.append(sorted(group))

    for name in imports:
        if name not in number:
            visit(name)
    return result


def late_imports(found: dict[str, Module]) -> list[str]:
    """Return imports of our own modules inside functions: ``file:line``."""
    result = set()
    for module in found.values():
        ours = [node for node in module.nodes if _imports_ours(node)]
        lines = {
            line
            for node in (module.nodes if ours else ())
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for line in range(node.body[0].lineno, (node.end_lineno or 0) + 1)
        }
        late = (node for node in ours if node.lineno in lines)
        result |= {f"{module.path.relative_to(PACKAGE)}:{node.lineno}" for node in late}
    return sorted(result)


def _imports_ours(node: ast.AST) -> TypeGuard[ast.Import | ast.ImportFrom]:
    if isinstance(node, ast.ImportFrom):
        return (node.module or "").split(".")[0] == NAME
    return isinstance(node, ast.Import) and any(alias.name.split(".")[0] == NAME for alias in node.names)


def complex_functions(found: dict[str, Module]) -> list[str]:
    """Return functions of cyclomatic complexity C or worse (11 and more, as radon counts)."""
    from radon.complexity import cc_visit_ast  # noqa: PLC0415  only this figure needs it

    result = []
    for module in found.values():
        for block in cc_visit_ast(module.tree):
            for item in [block, *getattr(block, "methods", [])]:
                if type(item).__name__ == "Function" and item.complexity > 10:
                    result.append(f"{item.complexity:3} {module.path.relative_to(PACKAGE)}:{item.lineno} {item.name}")
    return sorted(set(result), reverse=True)


def drawers() -> list[tuple[int, str]]:
    """Return the number of files in each folder, the fullest first (``__init__`` not counted)."""
    count = Counter(
        str(path.parent.relative_to(PACKAGE.parent)) for path in PACKAGE.rglob("*.py") if path.stem[0] != "_"
    )
    return sorted(((number, folder) for folder, number in count.items()), reverse=True)


def functions(found: dict[str, Module]) -> int:
    """Return the number of functions and methods, those inside others included."""
    return sum(
        isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for module in found.values() for node in module.nodes
    )


def used_once(found: dict[str, Module]) -> list[str]:
    """Return private functions of at most six lines that are called in one place of their file: ``file:line name``.

    Not those that are given as a value, and not those that a class demands or overrides: a name is all that they have.
    """
    result = []
    for module in found.values():
        text = module.path.read_text(encoding="utf-8")
        called = Counter(_called(node) for node in module.nodes if isinstance(node, ast.Call))
        for node in module.nodes:
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            first = min([node.lineno, *(expression.lineno for expression in node.decorator_list)])
            private = node.name.startswith("_") and not node.name.startswith("__")
            if private and node.end_lineno is not None and node.end_lineno - first < 6 and called[node.name] == 1:
                named = len(re.findall(rf"\b{node.name}\b", text))
                if named == 2 and "abstractmethod" not in {
                    ast.unparse(expression) for expression in node.decorator_list
                }:
                    result.append(f"{module.path.relative_to(PACKAGE)}:{first} {node.name}")
    return sorted(result)


def _called(node: ast.Call) -> str:
    """Return the name that is called; "" for a call of the base class's method."""
    if isinstance(node.func, ast.Attribute):
        return "" if ast.unparse(node.func.value) == "super()" else node.func.attr
    return getattr(node.func, "id", "")


def shared_names(found: dict[str, Module]) -> list[str]:
    """Return names of classes in several files; an answer of the API belongs to the class beside it."""
    homes: dict[str, list[str]] = {}
    for module in found.values():
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(str(module.path.relative_to(PACKAGE)))
    apart = {name: [file for file in files if not file.startswith("api/")] for name, files in homes.items()}
    return [f"{name}: {', '.join(files)}" for name, files in sorted(apart.items()) if len(files) > 1]


def lines(found: dict[str, Module]) -> list[tuple[int, str]]:
    """Return the lines of each room, the longest first."""
    count: Counter[str] = Counter()
    for module in found.values():
        parts = module.path.relative_to(PACKAGE).parts
        count[parts[0] if len(parts) > 1 else "(top)"] += len(module.path.read_text(encoding="utf-8").splitlines())
    return sorted(((number, room) for room, number in count.items()), reverse=True)


def entered() -> str:
    """Return the counts of ``benchmarks/entered.py``; it runs nodes, so that no test needs it."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.entered"],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    if done.returncode != 0:
        return "failed: python -m benchmarks.entered"
    told = done.stdout.splitlines()
    return "\n    ".join([told[-1], *(line for line in told[:-1] if "modules entered" in line)])


def report() -> Iterator[str]:
    """Yield the table, line by line."""
    found = modules()
    rings = circles({name: module.imports for name, module in found.items()}) + circles(scripts())
    late, knots = late_imports(found), complex_functions(found)
    yield f"circles of files                        {len(rings):6}   aim 0"
    yield from (f"    {' ~ '.join(ring)}" for ring in rings)
    yield f"imports of our own inside functions     {len(late):6}"
    yield from (f"    {place}" for place in late[:12])
    yield f"functions of complexity C or worse      {len(knots):6}"
    yield from (f"    {knot}" for knot in knots[:25])
    once, count, folders = used_once(found), functions(found), len({module.path.parent for module in found.values()})
    yield f"modules                                 {len(found):6}   in {folders} folders"
    yield f"functions                               {count:6}"
    yield f"of these private, short, called once    {len(once):6}   {len(once) / count:.1%}"
    shared = shared_names(found)
    yield f"names of classes in several rooms       {len(shared):6}"
    yield from (f"    {shared_name}" for shared_name in shared)
    yield f"files in the fullest folder             {drawers()[0][0]:6}   aim 15 at most"
    yield from (f"    {number:3} {folder}" for number, folder in drawers() if number > 15)
    c_files = c_sources()
    yield f"C: sources of firmware/src              {len(c_files):6}"
    rings_of_c = circles(c_files)
    yield f"C: sources in a circle                  {sum(map(len, rings_of_c)):6}   aim 0"
    yield from (f"    {' ~ '.join(ring)}" for ring in rings_of_c)
    yield f"C: static functions of several files    {len(c_shared_names()):6}   aim 0"
    yield from (f"    {shared_name}" for shared_name in c_shared_names())
    yield f"provision of a factory node             {entered()}"
    yield f"lines                                   {sum(number for number, _ in lines(found)):6}"
    yield from (f"    {number:6} {room}" for number, room in lines(found))


if __name__ == "__main__":
    for line in report():
        print(line)
