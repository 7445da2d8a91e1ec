"""Repetition on a link: an octet-equal request gets its stored reply, nothing is run twice (profile.md, "Repetition").

The node keeps, for each link, the last request and its reply for 20 s from the reply's end. Commands that change
nothing (Identify, Prove, About, List, Query, Read, outside Sealed) always run again.
"""

from __future__ import annotations

from collections.abc import Callable

REPLY_SECONDS, REPEAT_SECONDS, TRIES = 5.0, 15.0, 3
"""A station waits 5 s for a reply, and repeats its request at most twice, within 15 s."""
KEEP_SECONDS = 20.0
"""Longer than the 15 s in which a station repeats, so that no repetition finds its reply gone and is run again."""
_IDEMPOTENT = {(128, 7), (128, 8), (128, 11), (128, 21), (1, 1), (1, 2)}
"""Identify, Prove, List, About, Query, Read change nothing: they always run again, and answer the present state."""


class Repetition:
    """The stored last request and reply of one link, node side."""

    def __init__(self) -> None:
        self._request: tuple[int, bytes] | None = None
        self._reply = b""
        self._at = 0.0

    def answer(self, transaction: int, frame: bytes, run: Callable[[bytes], bytes], *, now: float) -> bytes:
        """Return the stored reply to an octet-equal repetition, else run the command and store its reply.

        ``now`` is a monotonic time in seconds.
        """
        if len(frame) >= 4 and (frame[2], frame[3]) in _IDEMPOTENT:
            reply = run(frame)
        elif self._request == (transaction, frame) and now - self._at < KEEP_SECONDS:
            return self._reply
        else:
            reply = run(frame)
        self._request, self._reply, self._at = (transaction, frame), reply, now
        return reply

    def reply_sent(self, now: float) -> None:
        """Start the time for which the reply is kept: it has left. A commit, or a long reply, may take seconds."""
        self._at = now

    def forget(self) -> None:
        """Forget the stored reply, after loss of the field or link, bus-off or restart."""
        self._request, self._reply = None, b""
