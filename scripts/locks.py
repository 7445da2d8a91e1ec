"""Resolve the locks again and show what changed: `make locks`.

Each lock is for one purpose and holds every package with its version and hashes, for every Python and platform at once:
``base`` (the tool), ``ncap`` (with the service and its page: a station, the container), ``dev`` (the tests) and
``release`` (what builds and checks a release).
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Final

FOLDER: Final = Path("locks")
SOURCES: Final = {
    "base": ["pyproject.toml"],
    "ncap": ["pyproject.toml", "--extra", "ncap"],
    "dev": ["pyproject.toml", "--extra", "dev"],
    "release": [str(FOLDER / "release.in")],
}
OLDEST: Final = "3.11"


def pinned(lock: Path) -> dict[str, str]:
    """Return the versions in a lock by package name; empty if there is no lock yet."""
    if not lock.exists():
        return {}
    return dict(re.findall(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", lock.read_text(), re.MULTILINE))


def changes(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return one line for each package that came, went or has another version."""
    lines = []
    for name in sorted(before.keys() | after.keys()):
        old, new = before.get(name), after.get(name)
        if old != new:
            lines.append(f"  {name}: {old or 'new'} -> {new or 'gone'}")
    return lines


def main() -> int:
    """Write every lock and print its changes."""
    for name, source in SOURCES.items():
        lock = FOLDER / f"{name}.txt"
        before = pinned(lock)
        command = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--upgrade", "--universal"]
        command += ["--generate-hashes", "--no-header", "--python-version", OLDEST, "--output-file", str(lock), *source]
        subprocess.run(command, check=True)
        lines = changes(before, pinned(lock))
        print(f"{lock}: {len(pinned(lock))} packages, {len(lines)} changed")
        print("\n".join(lines), end="\n" if lines else "")
    return 0


if __name__ == "__main__":
    sys.exit(main())
