"""``exec:COMMAND``: a program that prints lines as a simulation does, and receives the values of actuators."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import subprocess
import threading
from collections.abc import Mapping, Sequence

from teds_provision.errors import NotFoundError, UsageError
from teds_provision.node.sources.base import Notify, SimulationClock, SourceChannel
from teds_provision.node.sources.lines import LineSource, feed

_SECONDS_TO_END = 2.0


class CommandSource(LineSource):
    """Runs a program (no shell); lines need no ``t``: without one the node's clock is the host's."""

    def __init__(self, places: Sequence[SourceChannel], notify: Notify, words: Sequence[str]) -> None:
        super().__init__(places, notify, needs_time=False)
        self._words = list(words)
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    def start(self, drive: SimulationClock) -> None:
        """Start the program; raises NotFoundError if there is none. Its errors go to our standard error."""
        try:
            self._process = subprocess.Popen(
                self._words,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C is for the node, which then ends this program
            )
        except OSError as error:
            raise NotFoundError(f"The program {self._words[0]} cannot be started: {error.strerror}.") from error
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self.begin(drive)
        threading.Thread(target=self._run, name="source", daemon=True).start()

    def acted(self, values: Mapping[str, float]) -> None:
        """Write the values of actuators; a program that does not read loses them."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                os.write(self._process.stdin.fileno(), json.dumps({"set": dict(values)}).encode() + b"\n")

    def stop(self) -> None:
        """End the program: SIGTERM, after 2 s SIGKILL."""
        self._stopped = True
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _run(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        feed(lambda: os.read(descriptor, 65536), self.feed_line)
        code = self._process.wait()
        if not self._stopped:
            self.end()
            self._notify(f"The program {self._words[0]} ended with {code}: from now on all values are invalid.")


def make(argument: str, places: Sequence[SourceChannel], notify: Notify) -> CommandSource:
    """Make the source of ``exec:./hand --rate 100``, split as a shell does."""
    try:
        words = shlex.split(argument)
    except ValueError as error:
        raise UsageError(f"exec: {error}.", hint="Close the quotes.") from error
    if not words:
        raise UsageError("exec: needs a program.", hint="Write --source 'exec:./hand --rate 100'.")
    return CommandSource(places, notify, words)
