"""Threads for requests that wait for a node: some for those that read, some for those that change, some for actuators.

A node that does not answer keeps a thread for up to a minute. With one pool for all, a few such reads (a token that may
only read is enough) kept every other request waiting: the status, the check of the next token, the set points.
"""

from __future__ import annotations

import asyncio
import contextvars
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, ParamSpec, TypeVar

_Words = ParamSpec("_Words")
_Found = TypeVar("_Found")

_READING: Final = ThreadPoolExecutor(8, "reads of a node")
_CHANGING: Final = ThreadPoolExecutor(8, "works with a node")
_MOVING: Final = ThreadPoolExecutor(16, "moves an actuator")


async def reading(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what reads of a node and changes nothing."""
    return await _run(_READING, lambda: work(*words, **more))


async def changing(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what works with nodes, links, measurements."""
    return await _run(_CHANGING, lambda: work(*words, **more))


async def moving(work: Callable[_Words, _Found], *words: _Words.args, **more: _Words.kwargs) -> _Found:
    """Run what is for an actuator: its set points have their time."""
    return await _run(_MOVING, lambda: work(*words, **more))


async def _run(pool: ThreadPoolExecutor, work: Callable[[], _Found]) -> _Found:
    who = contextvars.copy_context()  # on whose word it is done, for the audit log
    return await asyncio.get_running_loop().run_in_executor(pool, lambda: who.run(work))
