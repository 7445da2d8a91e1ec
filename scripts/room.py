"""The tests of a room and of the rooms that import it, as arguments for pytest.

Usage: python scripts/room.py ROOM. ``make room ROOM=station`` runs what it prints. The arrows are read from the imports
(scripts/house.py), so the answer cannot drift from the code. Tests that see the whole program (tests/e2e) are named
only for the rooms that a command is made of: cli, ncap, measure, provisioning.
"""

from __future__ import annotations

import sys
from pathlib import Path

import house

TESTS = Path(__file__).resolve().parent.parent / "tests"
WHOLE_RUNS = {"cli", "ncap", "measure", "provisioning"}


def rooms() -> dict[str, set[str]]:
    """Return which rooms import each room, itself among them."""
    found = house.modules()
    result: dict[str, set[str]] = {}
    for name, module in found.items():
        importer = name.split(".")[1] if "." in name else name
        for target in {name, *module.imports}:
            if "." in target:
                result.setdefault(target.split(".")[1], set()).add(importer)
    return result


def main() -> int:
    """Print the folders, or what rooms there are."""
    known = rooms()
    wanted = sys.argv[1] if len(sys.argv) == 2 else ""
    if wanted not in known:
        print(f"There is no room {wanted!r}. Rooms: {', '.join(sorted(known))}", file=sys.stderr)
        return 2
    names = known[wanted] | ({"e2e"} if wanted in WHOLE_RUNS else set())
    folders = [f"tests/{name}" for name in sorted(names) if (TESTS / name).is_dir()]
    print(*folders, "tests/test_architecture.py", "tests/test_house.py")
    return 0


if __name__ == "__main__":
    sys.exit(main())
