"""The program, or a file of Python, with 10 s of processor (or as many as are given) and bounded memory.

As a program: python -m tests.teds.limited WORDS of the command line | FILE.py SECONDS
"""

from __future__ import annotations

import resource
import runpy
import sys

from teds_provision.__main__ import main

LIMITED = (sys.executable, "-m", "tests.teds.limited")
SECONDS = 10
# The address space holds the interpreter, numpy and all that the zygote imported (mapped, not used): 700 MB.
SPACE = (300 + 700) << 20


def limit(seconds: int) -> None:
    """Bound what this process may take from now on."""
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 2))
    resource.setrlimit(resource.RLIMIT_AS, (SPACE, SPACE))


if __name__ == "__main__":
    if sys.argv[1].endswith(".py"):
        limit(int(sys.argv[2]))
        runpy.run_path(sys.argv[1])
    else:
        limit(SECONDS)
        main()
