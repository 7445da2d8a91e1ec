"""The charge of a node before it is written: power that fails in the middle helps neither side.

The initial NFC message contains it in plain; over the air the session asks for it (Power, 128.18). On a wired bus nodes
are fed by the bus, and there is no check. It is a hint: it delays a write, and decides nothing else (operation.md
section 7).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from teds_provision.errors import BadDataError, NodeRefusedError, PolicyError
from teds_provision.protocol.operation.commands import POWER, PowerFlag, PowerReply
from teds_provision.provisioning.conversation import Conversation

LEAST_PERCENT: Final = 10


Low = Callable[[str], object]
"""Asks, with a whole sentence, before a node with a low battery is written; raises if the answer is no."""


def wait_for_charge(question: str) -> None:
    """Refuse, as without a question there is no answer. Raises PolicyError."""
    raise PolicyError(
        question.removesuffix(" Write it?"), hint="Charge it first (leave it on the reader), or add --yes."
    )


def require_charge(node: Conversation, low: Low) -> None:
    """Ask ``low`` before a node with less than :data:`LEAST_PERCENT` percent is written."""
    percent = _percent(node)
    if percent is not None and percent < LEAST_PERCENT:
        low(
            f"The battery of node {node.uuid.hex()} is at {percent} %: the write may fail halfway and have to"
            " be repeated. Write it?"
        )


def _percent(node: Conversation) -> int | None:
    """Return per cent, None if it is unknown, or if the node is fed."""
    if node.charging is not None and node.charging.battery_percent is not None:
        return node.charging.battery_percent
    if node.tapped or node.wired or not node.sealed:
        return None
    try:
        power = PowerReply.decode(node.request_idempotent(POWER, "to report its charge"))
    except (NodeRefusedError, BadDataError):
        return None  # it has no battery, or does not measure
    return power.level if power.flags & PowerFlag.BATTERY else None
