"""Identify over CAN: one functional request, the answers of all, and what they mean."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from teds_provision.errors import Garbled
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.gathering import Gathering
from teds_provision.links.can.isotp import FUNCTIONAL, single
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.messages.identity import Identity

IDENTIFY: Final = security_command(Function.IDENTIFY).encode()
_SLICE: Final = 0.02


def ask_all(bus: Bus, gathering: Gathering, seconds: float, *, enough: Callable[[], bool], settle: float) -> None:
    """Send a functional Identify and collect answers for ``seconds``, or until ``enough`` once ``settle`` is over.

    The request is a classic single frame also on an FD bus, unless the option says FD. Raises LinkFailure.
    """
    bus.drain()
    fd = bus.spec.fd
    body = bytes([gathering.transaction]) + IDENTIFY
    bus.send(Frame(FUNCTIONAL | gathering.own, single(body, fd=fd), fd))
    began = time.monotonic()
    while (passed := time.monotonic() - began) < seconds:
        if passed >= settle and not gathering.busy and enough():
            return
        frame = bus.receive(min(_SLICE, seconds - passed))
        if frame is None:
            continue
        flow = gathering.take(frame)
        if flow is not None:
            bus.send(flow)


def read_identity(reply: bytes) -> Identity:
    """Read a reply frame to Identify; raises Garbled or BadData."""
    answer = decode_reply(reply)
    if not answer.ok:
        raise Garbled("The node refuses Identify, which no node may.", hint="It does not keep to the profile.")
    return Identity.decode(answer.payload)


def conflict_text(node: int) -> str:
    """One sentence that names the address."""
    return f"Two nodes answer under the CAN address 0x{node:02X}."
