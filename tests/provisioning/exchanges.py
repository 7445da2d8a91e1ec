"""What a station asks a node while it provisions it, word for word. A new exchange is added here, with its reason."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import pytest

from teds_provision.protocol.messages.frames import Command, Function, Reply, TedsFunction
from teds_provision.provisioning.conversation import Conversation

WRITTEN: Final = 5
"""TEDS of the angle sensor without a calibration: Meta, TransducerChannel, two names, Security."""

IDENTIFIED: Final = ["read 128", "prove"]
AGREED: Final = ["request", "confirm", "open c", "open", "[identify]", "[about]"]
OPENED: Final = ["open c", "open", "[about]", "[identify]"]
"""About is asked before Identify if the session is under a key that was held already."""
CLAIMED: Final = ["[operation]", "[operate]", "[sample]", "[idle]"]
"""One sensor: who claims it, a claim that shows that the hardware accepts the datasheet, a reading, and the end."""

FIRST: Final = [
    *IDENTIFIED,
    "list",  # in plain: a board of another type is refused before it becomes ours
    *AGREED,
    "[list]",  # authentic, and so is all that follows
    *["[write]"] * (WRITTEN - 1),
    "[write 128]",  # the last one: a node that cannot rewind counts on it
    "[update]",
    *["[read]"] * (WRITTEN - 1),
    "[read 128]",
    "[prove]",
]
"""A board without any TEDS, up to the question to its hardware."""

AGAIN: Final = ["prove", *OPENED, "[list]", *["[read]"] * (WRITTEN - 1), "[read 128]", "[prove]"]
"""The same board once more."""

_NAMES: Final = {
    (1, TedsFunction.QUERY): "query",
    (1, TedsFunction.READ): "read",
    (1, TedsFunction.WRITE): "write",
    (1, TedsFunction.UPDATE): "update",
    (3, 1): "read data set",
    (4, 1): "operate",
    (4, 2): "idle",
    (128, Function.REQUEST): "request",
    (128, Function.CONFIRM): "confirm",
    (128, Function.CLOSE): "close",
    (128, Function.IDENTIFY): "identify",
    (128, Function.PROVE): "prove",
    (128, Function.LIST): "list",
    (128, 12): "sample",
    (128, 19): "operation",
    (128, 21): "about",
}
_BY_TEDS: Final = (TedsFunction.READ, TedsFunction.WRITE)


def named(command: Command) -> str:
    """Return the name of a command; Open, and Read and Write of the Security TEDS, by their kind."""
    key = command.command_class, command.function
    if key == (128, Function.OPEN):
        return "open" if command.payload else "open c"
    if command.command_class == 1 and key in _NAMES and command.payload[:1] == b"\x80":
        return f"{_NAMES[key]} 128" if command.function in _BY_TEDS else _NAMES[key]
    return _NAMES.get(key, f"{command.command_class}.{command.function}")


@contextmanager
def asked() -> Iterator[list[str]]:
    """Yield the commands of this process's conversations, in their order; those in a session stand in brackets."""
    plain = Conversation._exchange
    found: list[str] = []

    def exchange(
        node: Conversation, command: Command, inside: Command | None = None, within: float | None = None
    ) -> Reply:
        found.append(named(command) if inside is None else f"[{named(inside)}]")
        return plain(node, command, inside, within)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Conversation, "_exchange", exchange)
        yield found


def in_order(found: list[str]) -> list[str]:
    """The same with the reads of each read-back sorted, Security TEDS last: where it stands follows from its number."""
    reads = [place for place, word in enumerate(found) if word in ("[read]", "[read 128]")]
    ordered = sorted((found[place] for place in reads), key=len)
    by_place = dict(zip(reads, ordered, strict=True))
    return [by_place.get(place, word) for place, word in enumerate(found)]
