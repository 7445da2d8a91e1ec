"""A CAN bus on which frames are lost, doubled, swapped, late or corrupted: a python-can interface over another one.

``lossy:CHANNEL?under=udp_multicast&loss=0.03&seed=7&…``: shares of frames, each way, that meet with it (``loss``,
``double``, ``swap``, ``delay``, ``corrupt``); ``late`` seconds for a delayed one. Everything else goes to the interface
below. The faults of one direction come from one generator each, so that a run can be repeated as far as timing allows.

``python -m tests.links.can.lossy ARGUMENTS…`` is the program with this interface put in.
"""

from __future__ import annotations

import random
import sys
import time
from collections import deque
from typing import Any

import can
import can.interfaces
import can.util

from teds_provision.links.can.bus import SentFrames
from teds_provision.links.can.isotp import Frame

KINDS = ("loss", "double", "swap", "delay", "corrupt")


class Faults:
    """What becomes of the frames of one direction."""

    def __init__(self, seed: object, shares: dict[str, float], late: float) -> None:
        self._random = random.Random(str(seed))
        self._shares, self._late = shares, late
        self._held: can.Message | None = None
        self._later: deque[tuple[float, can.Message]] = deque()
        self.met = dict.fromkeys(KINDS, 0)

    def meet(self, message: can.Message) -> list[can.Message]:
        """Return the frames that go on instead of this one, those before that were late included."""
        out = self.due()
        held, self._held = self._held, None
        kind = self._kind()
        if kind == "double":
            out += [message, message]
        elif kind == "swap" and held is None:
            self._held = message
        elif kind == "delay":
            self._later.append((time.monotonic() + self._late, message))
        elif kind != "loss":
            out.append(_corrupted(message, self._random) if kind == "corrupt" else message)
        return out if held is None else [*out, held]

    def due(self) -> list[can.Message]:
        """Delayed frames whose time has come."""
        out = []
        while self._later and self._later[0][0] <= time.monotonic():
            out.append(self._later.popleft()[1])
        return out

    def _kind(self) -> str:
        drawn = self._random.random()
        for kind in KINDS:
            share = self._shares[kind]
            if drawn < share:
                self.met[kind] += 1
                return kind
            drawn -= share
        return ""


def _corrupted(message: can.Message, chance: random.Random) -> can.Message:
    data = bytearray(message.data)
    if data:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return can.Message(
        arbitration_id=message.arbitration_id,
        is_extended_id=message.is_extended_id,
        is_fd=message.is_fd,
        bitrate_switch=message.bitrate_switch,
        data=data,
        timestamp=message.timestamp,
    )


class LossyBus(can.BusABC):
    """The interface."""

    def __init__(self, channel: str, under: str = "udp_multicast", seed: int = 0, **options: Any) -> None:
        shares = {kind: float(options.pop(kind, 0.0)) for kind in KINDS}
        late = float(options.pop("late", 0.02))
        if under == "udp_multicast":
            options.setdefault("hop_limit", 0)
        self._under = can.Bus(interface=under, channel=channel, **options)
        self._out, self._in = Faults(f"{seed}o", shares, late), Faults(f"{seed}i", shares, late)
        self._ready: deque[can.Message] = deque()
        self._echoes = SentFrames()
        self.channel_info = f"lossy {self._under.channel_info}"
        super().__init__(channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        for message in self._out.meet(msg):
            self._echoes.sent(Frame(message.arbitration_id, bytes(message.data)))
            self._under.send(message, timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._ready += self._in.due()
        if not self._ready:
            message = self._under.recv(timeout)
            if message is not None and not self._echoes.discard_echo(
                Frame(message.arbitration_id, bytes(message.data))
            ):
                self._ready += self._in.meet(message)
        return (self._ready.popleft() if self._ready else None), False

    def shutdown(self) -> None:
        super().shutdown()
        self._under.shutdown()


def install() -> None:
    """Make the interface known to python-can."""
    can.interfaces.BACKENDS["lossy"] = ("tests.links.can.lossy", "LossyBus")
    can.util.VALID_INTERFACES = frozenset({*can.VALID_INTERFACES, "lossy"})


if __name__ == "__main__":
    from teds_provision.__main__ import main

    install()
    sys.argv[0] = "teds-provision"
    main()
