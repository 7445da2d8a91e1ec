"""The trigger: streams wait, one frame goes out on each bus, each node reports its tick (operation.md, 5).

Streams begin 10 ms after that mark. A node whose mark does not match the time of sending is stopped and named.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from teds_provision.errors import TedsProvisionError
from teds_provision.links.streaming import MeasuringLink
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.protocol.operation.stream_commands import Action
from teds_provision.protocol.operation.subscription import TickBounds
from teds_provision.protocol.operation.timing import START_AFTER_MARK, TriggerToken, mark_is_honest
from teds_provision.provisioning.conversation import SessionLostError

TRIGGER_LIFE = 30  # seconds
HELD_BACK = 10_000_000  # ns of tolerance for late frames, see below
# A controller may hold a frame back while others win arbitration, and a busy process sees it late. The clock bounds
# alone are below a millisecond and would reject honest nodes.


def pull(common_start: CommonStart, supervisors: Sequence[NodeSupervisor], note: Callable[[str], None]) -> None:
    """Arm every node, send a frame on each bus, read each node's mark: it must meet the time of sending."""
    common_start.triggered()
    token = TriggerToken.draw()
    armed = _arm(token, supervisors, note)
    ports = {supervisor.bus.place: supervisor.bus.port for supervisor, _ in armed if supervisor.bus is not None}
    sent = {place: _send(port, token) for place, port in ports.items()}
    for supervisor, trusted in armed:
        between = sent.get(supervisor.bus.place) if supervisor.bus is not None else None
        if between is None:
            continue
        mark = _mark(supervisor, trusted, *between, note)
        if mark is None:
            continue
        common_start.record_start(supervisor.uuid, supervisor.streams.clock, mark)
        for heard in list(supervisor.streams.running.values()):
            heard.begin(mark + START_AFTER_MARK)


def _send(port: MeasuringLink, token: TriggerToken) -> tuple[int, int] | None:
    """Send the trigger on one link; return between which two times (monotonic ns) it went out, None if it has none."""
    before = time.monotonic_ns()
    return (before, time.monotonic_ns() + HELD_BACK) if port.trigger(token.octets) else None


def _arm(
    token: TriggerToken, supervisors: Sequence[NodeSupervisor], note: Callable[[str], None]
) -> list[tuple[NodeSupervisor, VerifiedSession]]:
    """Return the nodes that wait for the trigger now."""
    armed = []
    for supervisor in supervisors:
        trusted = supervisor.verified
        if trusted is None or not supervisor.ever_ran:
            continue
        try:
            with supervisor.turn:
                trusted.node.request(token.arm(Action.START, TRIGGER_LIFE).command(), "to wait for the trigger")
            armed.append((supervisor, trusted))
        except (TedsProvisionError, SessionLostError) as error:
            note(f"Node {supervisor.uuid.hex()} did not accept the trigger: {error}")
    return armed


def _mark(
    supervisor: NodeSupervisor, trusted: VerifiedSession, before: int, after: int, note: Callable[[str], None]
) -> int | None:
    """Return the tick at which the node saw the trigger, which went out between two times (monotonic ns).

    None if it does not report one, or reports a moment at which the frame was not on the bus; such a node is stopped.
    """
    try:
        with supervisor.turn:
            mark = supervisor.streams.tell_time(trusted).mark
    except (TedsProvisionError, SessionLostError) as error:
        note(f"Node {supervisor.uuid.hex()} did not report when it saw the trigger: {error}")
        return None
    with supervisor.streams.mapping:
        low, high = supervisor.streams.clock.ticks_at(before).low, supervisor.streams.clock.ticks_at(after).high
    if not mark or not mark_is_honest(mark, TickBounds(low, high)):
        note(f"Node {supervisor.uuid.hex()} reported a different time for the trigger, so it was not started.")
        supervisor.stop()
        return None
    return mark
