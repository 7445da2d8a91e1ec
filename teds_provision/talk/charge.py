"""The charge of a node, before its flash is written: power that fails in the middle helps nobody (operation.md 7).

The initial NFC message says it to anyone; over the air the session asks for it (Power, 128.18). On a wired bus nodes
are fed by the bus, and nobody asks. It is a hint: it delays a write, and decides nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from teds_provision.errors import BadData, NodeRefused, PolicyRefused
from teds_provision.protocol.operation.commands import POWER, Power, PowerFlag
from teds_provision.talk.conversation import Conversation

LEAST_PERCENT: Final = 10

Low = Callable[[str], object]
"""Asked, with a whole sentence, before a node with a low battery is written; raises where the answer is no."""


def wait_for_charge(question: str) -> None:
    """The answer where nobody was asked: no. Raises PolicyRefused."""
    raise PolicyRefused(
        question.removesuffix(" Write it?"), hint="Charge it first (leave it on the reader), or write it with --yes."
    )


def require_charge(node: Conversation, low: Low) -> None:
    """Have ``low`` asked where the node says that less than 10 % of its charge is left."""
    percent = _percent(node)
    if percent is not None and percent < LEAST_PERCENT:
        low(
            f"The battery of node {node.uuid.hex()} is at {percent} %: a write may be cut short, and would have to be "
            "begun anew. Write it?"
        )


def _percent(node: Conversation) -> int | None:
    """Per cent, None where nobody knows, or where the node is fed."""
    if node.charging is not None and node.charging.battery_percent is not None:
        return node.charging.battery_percent
    if node.tapped or node.wired or not node.sealed:
        return None
    try:
        power = Power.decode(node.ask(POWER, "to tell its charge"))
    except (NodeRefused, BadData):
        return None  # it has no battery, or does not measure
    return power.level if power.flags & PowerFlag.BATTERY else None
