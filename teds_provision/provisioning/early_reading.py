"""Read new boards of a bus, and have them prove their keys, while the broadcast for them is still running.

After a broadcast the station waits some seconds for the last possible answer, with an idle wire. Two boards with one
UUID must both be noticed before either is keyed, so this phase changes nothing, neither on a board nor in the store. It
only reads what provisioning would read first, outside a session: Security TEDS, proof of the key, List. A failed early
reading is dropped; provisioning then reads the board itself and reports the error.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import TedsProvisionError
from teds_provision.links import Contact, Notice
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.conversation import Conversation, EarlyAnswers
from teds_provision.provisioning.identify import show_key
from teds_provision.provisioning.teds_read import list_blocks

_FRESH_SECONDS: Final = 60.0
"""Seconds for which a proof counts: as long as a node keeps what a Request made (profile.md, "Key agreement")."""


@dataclass
class _Look:
    contact: Contact
    ended: threading.Event = field(default_factory=threading.Event)
    answers: EarlyAnswers | None = None
    at: float = 0.0


class EarlyReading:
    """Reads boards that are in factory state, ``at_once`` at a time, each in a thread, until :meth:`stop`."""

    def __init__(self, *, at_once: int) -> None:
        self._at_once = at_once
        self._looks: dict[bytes, _Look] = {}
        self._waiting: deque[_Look] = deque()
        self._working = 0
        self._stopped = False
        self._lock = threading.Lock()

    def add(self, contact: Contact) -> None:
        """Read this board soon, if it is new, and the first one that answers under its UUID."""
        uuid = contact.identity.uuid
        with self._lock:
            if self._stopped or uuid in self._looks or contact.identity.state != NodeState.FACTORY:
                return
            self._looks[uuid] = look = _Look(contact)
            self._waiting.append(look)
            if self._working == self._at_once:
                return
            self._working += 1
        threading.Thread(target=self._work, name=f"early {uuid.hex()}", daemon=True).start()

    def stop(self) -> None:
        """Begin no further board; those that were begun are finished."""
        with self._lock:
            self._stopped = True
            for look in self._waiting:
                look.ended.set()
            self._waiting.clear()

    def answers_of(self, contact: Contact) -> EarlyAnswers | None:
        """Return what this board answered, once; None if it was not read, or too long ago.

        Waits for the end of its exchanges, if they were begun.
        """
        with self._lock:
            look = self._looks.pop(contact.identity.uuid, None)
        if look is None or (look.contact.address, look.contact.identity) != (contact.address, contact.identity):
            return None
        look.ended.wait()
        return look.answers if time.monotonic() - look.at < _FRESH_SECONDS else None

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._working -= 1
                    return
                look = self._waiting.popleft()
            look.at = time.monotonic()
            try:
                with suppress(TedsProvisionError):
                    look.answers = _ask(look.contact)
            finally:
                look.ended.set()


def _ask(contact: Contact) -> EarlyAnswers:
    """Read a board and have it prove its key; raises what provisioning raises there."""
    node = Conversation(contact, notice=_unreported, busy_seconds=0.0)
    try:
        return EarlyAnswers(show_key(node), tuple(list_blocks(node)))
    finally:
        contact.link.close()


def _unreported(_notice: Notice) -> None:
    """Drop it: if the board is still busy later, provisioning reports it."""
