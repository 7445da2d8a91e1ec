"""Every benchmark at its smallest size, so that none breaks unseen: ``python -m benchmarks.short [NAME …]``.

The figures mean nothing: an aim that is missed is no failure here. A benchmark that ends in an error is; its last lines
are printed, and the exit code is 1.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import benchmarks

LEAST: dict[str, tuple[tuple[str, ...], ...]] = {
    "bare_checks": (),
    "commands": (("--nodes", "5"),),
    "crowd": (("--nodes", "5"),),
    "entered": ((),),
    "footprint": (("--nodes", "5", "--seconds", "1", "--soak", "2"),),
    "handover": (("20",),),
    "limits": (),
    "line": (("20",),),
    "line_readers": (("--readers", "2", "--boards", "4"),),
    "machine": ((),),
    "measure": ((),),
    "measure_load": (("--seconds", "1", "--nodes", "1", "--to", "run.csv"),),
    "measure_time": (("--seconds", "1", "--nodes", "1"),),
    "ncap": (("--nodes", "10", "--clients", "5", "--deaf", "1", "--seconds", "1"),),
    "newcomers": (("--joins", "1", "--many", "5", "--seconds", "1"),),
    "nodes": (),
    "page": (("--seconds", "1"),),
    "plant": (("--stations", "3", "--pages", "2", "--events", "1"), ("--local", "12")),
    "provisioning": (("--nodes", "1"),),
    "radio": ((),),
    "recordings": (("--samples", "10000"),),
    "scale": (("10", "20"),),
    "sensor": (("--seconds", "1"),),
    "sinks": (("--seconds", "1", "--kills", "1"),),
    "teds_codec": (("--images", "10"),),
    "timeline": (("--nodes", "1"),),
    "updating": (("--kib", "4", "--boards", "2"),),
    "verifying": (("20",),),
    "wrapped": (("--seconds", "1", "--nodes", "1", "--rate", "100"),),
}
"""The arguments of each run of each module; none for those that other benchmarks import or start."""
_LONGEST = 900.0  # seconds


def run(name: str, words: tuple[str, ...]) -> str:
    """Run one benchmark; return why it failed, empty if it did not."""
    with tempfile.TemporaryFile("w+") as printed:
        try:
            code = subprocess.run(
                [sys.executable, "-m", f"benchmarks.{name}", *words],
                stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.STDOUT, timeout=_LONGEST, check=False,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            return f"not finished after {_LONGEST:.0f} s"
        printed.seek(0)
        text = printed.read()
    return "" if code == 0 else f"exit {code}\n" + "\n".join(text.splitlines()[-12:])


def unlisted() -> list[str]:
    """Return the modules of this folder without a line in :data:`LEAST`, and the lines without a module."""
    there = {file.stem for file in Path(benchmarks.__file__).parent.glob("*.py")} - {"__init__", "short"}
    return sorted(there ^ LEAST.keys())


def main(names: list[str]) -> int:
    """Run the named benchmarks, all without names; return the exit code."""
    if unlisted():
        print(f"Without a line in benchmarks/short.py, or without a file: {', '.join(unlisted())}.")
        return 1
    failed = 0
    for name in names or LEAST:
        for words in LEAST[name]:
            began = time.monotonic()
            why = run(name, words)
            print(
                f"{time.monotonic() - began:6.1f} s  {' '.join((name, *words))}{': ' + why if why else ''}", flush=True
            )
            failed += bool(why)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
