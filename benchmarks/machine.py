"""Speed of this machine, printed beside every figure in seconds: such a figure holds for its machine alone.

``python -m benchmarks.machine`` prints the line by itself.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

_WAKES = 2_000
_SYNCS = 20


def checks_a_second(cores: int) -> float:
    """Return openssl's P-256 signature checks here and now, in a second of the processor, on so many cores."""
    words = ["openssl", "speed", "-seconds", "2", "ecdsap256"]
    speeds = [
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) for _ in range(cores)
    ]
    total = 0.0
    for speed in speeds:
        output = speed.communicate()[0]
        found = re.search(r"nistp256\).*\s(\d+\.\d)\s*$", output, re.MULTILINE)
        if found is None:
            raise SystemExit(f"openssl printed something else:\n{output}")
        total += float(found[1])
    return total


def fsync() -> float:
    """Return median seconds until 4 KiB, appended to a file, are safe on the disk of the benches (``BENCH_DISK``)."""
    with tempfile.TemporaryFile(dir=os.environ.get("BENCH_DISK")) as file:

        def append() -> None:
            file.write(bytes(4096))
            file.flush()
            os.fsync(file.fileno())

        return _median(append, _SYNCS)


def wake() -> float:
    """Return median seconds from an octet written to a pipe to the answer of the process sleeping on its other end."""
    echo = "import os\nwhile os.read(0, 1): os.write(1, b'.')"
    with subprocess.Popen([sys.executable, "-c", echo], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        there, back = other.stdin.fileno(), other.stdout.fileno()

        def ask() -> None:
            os.write(there, b".")
            os.read(back, 1)

        taken = _median(ask, _WAKES)
        other.stdin.close()
    return taken


def _median(act: Callable[[], None], times: int) -> float:
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        act()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def line() -> str:
    """Return the line: Python, cores, load, and the present speed of openssl, the disk and the scheduler."""
    cores = len(os.sched_getaffinity(0))
    return (
        f"machine: Python {sys.version.split()[0]}, {cores} cores, load {os.getloadavg()[0]:.1f}; openssl"
        f" {checks_a_second(1):,.0f} checks/s on one core, {checks_a_second(cores):,.0f} on all;"
        f" fsync {fsync() * 1e3:.1f} ms; a process asked and answering {wake() * 1e6:.0f} µs"
    )


if __name__ == "__main__":
    print(line())
