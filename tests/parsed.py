"""The syntax trees of the package, parsed and walked once for all tests of the house in a process.

Parsing costs a second of CPU each time, and walking half a second; a dozen rules look at every node.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from functools import cache
from pathlib import Path


@cache
def parsed(path: Path) -> ast.Module:
    """Return the tree of a file; who changes it changes it for the others."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@cache
def walked(path: Path) -> Sequence[ast.AST]:
    """Return the nodes of a file in the order of ``ast.walk``; the first is the tree."""
    return tuple(ast.walk(parsed(path)))
