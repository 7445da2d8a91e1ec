"""The syntax trees of the package, parsed once for all tests of the house in a process: a second of CPU each time."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path


@cache
def parsed(path: Path) -> ast.Module:
    """Return the tree of a file; who changes it changes it for the others."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))
