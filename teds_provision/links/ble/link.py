"""The link to one node over BLE: requests, replies, and recovery after a lost connection."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Final, TypeVar

from teds_provision.links.ble import ble_errors
from teds_provision.links.ble.connection import BleConnection, ConnectionLostError, NotConnectedError
from teds_provision.links.ports import BLE, Capabilities, Notice, NoticeSink
from teds_provision.protocol.repetition import REPEAT_SECONDS, REPLY_SECONDS, TRIES

# The one asyncio loop of a Bluetooth port, in its own thread: bleak runs there, and other threads call into it.

Result = TypeVar("Result")
_END_SECONDS: Final = 3.0


class Loop:
    """Runs coroutines for threads. Ctrl-C in the waiting thread cancels what runs for it."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="bluetooth", daemon=True)
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Result]) -> Result:
        """Run ``work`` to its end and return what it returns; raises what it raises."""
        running = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return running.result()
        except BaseException:
            running.cancel()
            raise

    def stop(self) -> None:
        """Cancel what still runs, and end; never raises."""
        with suppress(Exception):
            asyncio.run_coroutine_threadsafe(_cancel_all(), self._loop).result(_END_SECONDS)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_END_SECONDS)


async def _cancel_all() -> None:
    others = asyncio.all_tasks() - {asyncio.current_task()}
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)


_FIRST_PAUSE, _LAST_PAUSE = 0.3, 2.0


class BleLink:
    """The link to one node. ``make_room`` gives up an idle connection; it returns False if there is none."""

    via: Final = "ble"

    def __init__(
        self,
        loop: Loop,
        connection: BleConnection,
        number: Callable[[], int],
        make_room: Callable[[], bool],
        notice: NoticeSink,
    ) -> None:
        self._loop, self.connection, self._number = loop, connection, number
        self._make_room, self._notice = make_room, notice
        self._last = 0

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of a node over the air."""
        return BLE

    @property
    def mtu(self) -> int:
        """ATT MTU of the present connection."""
        return self.connection.mtu

    def exchange(self, frame: bytes) -> bytes:
        """Send one command frame and return its reply; see ``Link.exchange``.

        A lost connection is made again, and the request repeated: the session is gone then, so a sealed one is refused,
        and the caller opens a new session.
        """
        self._last = self._number()
        return self._ask(frame, self._last)

    def exchange_within(self, frame: bytes, seconds: float) -> bytes:
        """Send one command frame that is of no use after ``seconds``; see ``DeadlineLink.exchange_within``.

        It is not repeated: the radio's link layer does that by itself.
        """
        self._last = self._number()
        try:
            return self._loop.run(self.connection.exchange(self._last, frame, seconds))
        except (ConnectionLostError, TimeoutError) as lost:
            raise ble_errors.silent(
                self.connection.address, lost if isinstance(lost, ConnectionLostError) else None
            ) from lost

    def resend(self, frame: bytes) -> bytes:
        """Send the last frame once more under its transaction; see ``ResendLink.resend``."""
        return self._ask(frame, self._last)

    def drive(self, message: bytes) -> None:
        """Write a Drive message; raises LinkError."""
        try:
            self._loop.run(self.connection.write_data(message))
        except ConnectionLostError as lost:
            raise ble_errors.silent(self.connection.address, lost) from lost

    def close(self) -> None:
        """Disconnect; never raises."""
        self._loop.run(self.connection.disconnect())

    def _ask(self, frame: bytes, transaction: int) -> bytes:
        began, last = time.monotonic(), None
        tries, pause = 0, _FIRST_PAUSE
        while tries < TRIES and time.monotonic() - began < REPEAT_SECONDS:
            try:
                return self._loop.run(self.connection.exchange(transaction, frame, REPLY_SECONDS))
            except ConnectionLostError as lost:
                last = lost
                # A busy adapter does not count as a try, because without a connection nothing was sent.
                tries += not (isinstance(lost, NotConnectedError) and self.connection.was_up)
                self._notice(Notice("retry", f"BLE: {str(lost).rstrip('.')}. Connecting again"))
                time.sleep(pause)
                pause = min(2 * pause, _LAST_PAUSE)
            except TimeoutError:
                last, tries = None, tries + 1
            except ble_errors.TooManyConnectionsError:
                if not self._make_room():
                    raise
        raise ble_errors.silent(self.connection.address, last)
