"""Pages of every public name, from the docstrings, by pdoc: ``python scripts/api.py FOLDER``; `make api` runs it.

A warning of pdoc (an annotation that cannot be read) is an error here.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys
import typing
import warnings
from pathlib import Path

import pdoc

PACKAGE = "teds_provision"


def resolve_named_tuples() -> None:
    """Write what the fields of named tuples are into their constructors.

    ``typing`` leaves them there as text, in a namespace in which the names are not found.
    """
    for info in pkgutil.walk_packages(importlib.import_module(PACKAGE).__path__, f"{PACKAGE}."):
        if info.name.endswith("__main__"):
            continue
        for thing in vars(importlib.import_module(info.name)).values():
            if isinstance(thing, type) and issubclass(thing, tuple) and thing.__module__ == info.name:
                thing.__new__.__annotations__.update(typing.get_type_hints(thing))


def main(folder: str) -> None:
    """Write the pages."""
    warnings.filterwarnings("error", module="pdoc")
    # A member that is named like a keyword: `from`.
    warnings.filterwarnings("ignore", "Cannot determine where .* is taken from")
    resolve_named_tuples()
    pdoc.render.configure(docformat="restructuredtext")
    pdoc.pdoc(PACKAGE, output_directory=Path(folder))
    print(f"{folder}/{PACKAGE}.html")


if __name__ == "__main__":
    main(sys.argv[1])
