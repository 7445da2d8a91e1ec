"""Make the published vectors of the profile again: ``python -m tests.vectors.generate [--check]``.

Keys, nonces and times are fixed, signatures deterministic (RFC 6979): the same code gives the same files. ``--check``
writes nothing and fails where a file differs from what would be written.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Iterator
from typing import Any

from . import (
    recipes,
    recipes_handover,
    recipes_links,
    recipes_operation,
    recipes_refusals,
    recipes_repetition,
    recipes_teds,
)
from .scene import FOLDER, KAT, Scene, keys

logging.getLogger("isotp").setLevel(logging.CRITICAL)  # it logs every flow control that came late
FORMAT = "teds1-vectors/1"
Recipe = Callable[[], Iterator[Any]]
_MODULES = (
    recipes,
    recipes_refusals,
    recipes_teds,
    recipes_repetition,
    recipes_links,
    recipes_operation,
    recipes_handover,
)
FILES: dict[str, Recipe] = {name: recipe for module in _MODULES for name, recipe in module.FILES.items()}


def document(name: str) -> str:
    """Return the text of one file."""
    recipe = FILES[name]
    entries = [made.entry() if isinstance(made, Scene) else made for made in recipe()]
    about = " ".join((recipe.__doc__ or "").split())
    head = {"format": FORMAT, "about": about, "uuid": KAT["uuid"], "keys": keys(), "entries": entries}
    return json.dumps(head, indent=1, ensure_ascii=False) + "\n"


def differing() -> list[str]:
    """Return names of files that are not what this program would write."""
    changed = []
    for name in FILES:
        path = FOLDER / f"{name}.json"
        if not path.is_file() or path.read_text(encoding="utf-8") != document(name):
            changed.append(path.name)
    return changed


def main() -> int:
    """Write every file, or check them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 where a file would change")
    if parser.parse_args().check:
        changed = differing()
        print("\n".join(f"{name} would change" for name in changed) or f"{len(FILES)} files are as they should be.")
        return 1 if changed else 0
    for name in FILES:
        path = FOLDER / f"{name}.json"
        path.write_text(document(name), encoding="utf-8")
        print(f"{path.name}: {len(json.loads(path.read_text(encoding='utf-8'))['entries'])} entries")
    return 0


if __name__ == "__main__":
    sys.exit(main())
