"""The disk as it was at the last fsync: put together from the shadow that cut.c keeps."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("cut.c")


def build_library(folder: Path) -> Path:
    """Compile cut.c; raises RuntimeError with the compiler's words."""
    library = folder / "cut.so"
    command = ["cc", "-O1", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl", "-lpthread"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"cut.c was not compiled:\n{done.stderr}")
    return library


def put_back(shadow: Path, root: Path) -> None:
    """Replace ``root`` by what the shadow says of it: files without fsync are empty, entries without are not there."""
    roots = dict(line.split("\t", 1)[::-1] for line in (shadow / "roots").read_text().splitlines())
    key = roots[str(root)]
    shutil.rmtree(root)
    _folder(shadow, key, root, 0o700)


def _folder(shadow: Path, key: str, to: Path, mode: int) -> None:
    to.mkdir(mode=0o700)
    entries = shadow / f"d{key}"
    for line in entries.read_text(errors="surrogateescape").splitlines() if entries.exists() else ():
        child, kind, permissions, name = line.split("\t", 3)
        if kind == "d":
            _folder(shadow, child, to / name, int(permissions, 8))
        elif kind == "f":
            octets = shadow / f"f{child}"
            (to / name).write_bytes(octets.read_bytes() if octets.exists() else b"")
            os.chmod(to / name, int(permissions, 8))
    os.chmod(to, mode)
