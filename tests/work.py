"""How much work something is, whatever the machine does: steps of the interpreter and octets are counted, not time."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any


def steps_of(work: Callable[[], object]) -> int:
    """Return the bytecodes that ``work`` takes in this thread; what C does in one of them counts as one."""
    steps = 0

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal steps
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        steps += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return steps


COUNTS_BLOCKS = hasattr(ctypes.CDLL(None), "mallinfo2")
"""True if the C library counts the blocks that it has given out (glibc)."""

_MANY_THREADS = """
import ctypes, threading

class Blocks(ctypes.Structure):  # mallinfo2(3)
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "used", "free", "keepcost")
    ]

mallinfo = ctypes.CDLL(None).mallinfo2
mallinfo.restype = Blocks
turns, done = [threading.Semaphore(0) for _ in range(THREADS)], threading.Semaphore(0)

def run(turn):
    act = begin()
    while True:
        turn.acquire()
        act()
        done.release()

for turn in turns:
    threading.Thread(target=run, args=(turn,), daemon=True).start()
for round in range(ROUNDS):
    if round == FIRST:
        before = mallinfo().used
    for turn in turns:
        turn.release()
        done.acquire()
print((mallinfo().used - before) // THREADS)
"""


def kept_by_each_thread(begin: str, *, first: int, rounds: int, threads: int = 97) -> int:
    """Return by how many octets of the C library each of many threads grows from round ``first`` to ``rounds``.

    ``begin`` is the text of a function of that name, which returns what a thread does in a round; the threads take
    turns. The library keeps up to seven freed blocks of each size up to 1,032 octets for each thread.
    """
    script = f"THREADS, FIRST, ROUNDS = {threads}, {first}, {rounds}\n{begin}\n{_MANY_THREADS}"
    asked = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True, text=True)
    return int(asked.stdout)
