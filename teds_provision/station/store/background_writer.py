"""Runs the durable steps of a run in a background thread, during the exchanges with a node.

The run's next access to the store waits for them (:class:`.connection.Connection`), so it never
reads what is older than its own steps, and what it writes comes after them: the order of durable writes is that of the
program, as if each step had been taken at once. Only messages to the node may overtake one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, MutableMapping
from contextvars import copy_context
from queue import SimpleQueue

Step = Callable[[], object]


class BackgroundWriter:
    """Steps of the run of one thread, one at a time; ``waiting`` maps a thread to its waiting statement."""

    def __init__(self, waiting: MutableMapping[int, BackgroundWriter]) -> None:
        self._waiting, self._owner = waiting, threading.get_ident()
        self._steps: SimpleQueue[Step | None] = SimpleQueue()
        self._ended: SimpleQueue[BaseException | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, step: Step) -> None:
        """Queue a step, to run after the previous one; the run's thread continues meanwhile.

        Not inside a transaction: the step needs the store for itself.
        """
        self.wait()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="durable steps", daemon=True)
            self._thread.start()
        self._waiting[self._owner] = self
        context = copy_context()  # keeps the actor for the audit log
        self._steps.put(lambda: context.run(step))

    def wait(self) -> None:
        """Wait until the last queued step is done; raises its error."""
        if self._waiting.get(self._owner) is self:
            error = self._ended.get()
            del self._waiting[self._owner]
            if error is not None:
                raise error

    def close(self) -> None:
        """End the thread; raises an error of a step that was not waited for."""
        try:
            self.wait()
        finally:
            if self._thread is not None:
                self._steps.put(None)
                self._thread.join()

    def _work(self) -> None:
        while (step := self._steps.get()) is not None:
            try:
                step()
            except BaseException as error:  # noqa: BLE001 - raised in the waiting thread
                self._ended.put(error)
            else:
                self._ended.put(None)
