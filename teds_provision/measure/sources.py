"""One process for each source address on a bus: a second Open on a pair of addresses ends the first's session.

On this machine a lock in the home records the user of an address. Another machine, or another home, is noticed by the
frames that it sends from the same address (operation.md section 6).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from teds_provision.errors import AddressConflictError, StoreLockedError
from teds_provision.links import LinkSettings
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import CanSpec, parse_spec
from teds_provision.protocol.operation.can_frames import DATA
from teds_provision.station.station import Station
from teds_provision.station.store.lock import UsageLock, UsageLockTakenError

LISTENING = 0.25  # seconds in which the data of another station's streams to our address is heard
SIGN_OF_LIFE = 4.0  # seconds in which whoever reads it sends something: lease / 3 is 3.3 s unless he says otherwise
_MASK = 0x1FFF0000


@contextmanager
def sole_user(station: Station, ports: Sequence[CanPort], command: str) -> Iterator[None]:
    """Use the source addresses of these ports alone; without a named one, each takes the next free one.

    Raises StoreLockedError (7) if another process of this home has the named one; AddressConflictError (5) if another
    machine is heard to measure under it.
    """
    with ExitStack() as stack:
        for port in ports:
            mark, source = _enter(stack, station, port.spec, command, shared=False)
            if source != port.spec.source:
                port.use_source(source)
            # After a process that was killed its nodes still send to us, for a lease: nobody else is behind that.
            if not mark.left_behind:
                _require_alone(port)
        yield


@contextmanager
def beside(station: Station, links: LinkSettings, command: str, *, shared: bool = True) -> Iterator[LinkSettings]:
    """Have short sessions from the source address of ``links``, beside others who do; over a reader there is none.

    Yields the links with the address in them: the next free one if none was named and a measurement has it, or, not
    ``shared``, any process. Raises StoreLockedError (7) if a measurement has the named one.
    """
    if links.via != "can":
        yield links
        return
    with ExitStack() as stack:
        wheres = []
        for place in links.places:
            where = place.removeprefix("can:")
            spec = parse_spec(where)
            mark, source = _enter(stack, station, spec, command, shared=shared)
            if not shared:
                mark.share()  # the sessions of this very command are no others
            word = "" if spec.source_named else f"{'&' if '?' in where else '?'}source=0x{source:02X}"
            wheres.append(where + word)
        yield replace(links, can=tuple(wheres))


def _enter(stack: ExitStack, station: Station, spec: CanSpec, command: str, *, shared: bool) -> tuple[UsageLock, int]:
    """Hold the mark of the first source address that is free; gives both."""
    first: UsageLockTakenError | None = None
    for source in spec.sources:
        mark = station.measurements.source(spec.wire, source, command=command, shared=shared)
        try:
            return stack.enter_context(mark), source
        except UsageLockTakenError as taken:
            first = first or taken
    assert first is not None
    if not spec.source_named:
        raise StoreLockedError(
            f"Every source address on {spec.text} is in use, 0x{spec.source:02X} by {first.holder}.",
            hint="Stop one of those processes.",
        ) from first
    another = "0xF2" if spec.source == 0xF1 else "0xF1"
    raise StoreLockedError(
        f"Source address 0x{spec.source:02X} on {spec.text} is in use by {first.holder}.",
        hint=f"Add source={another} to --can, omit source=, or stop that process.",
    ) from first


def _require_alone(port: CanPort) -> None:
    """Raise AddressConflictError if data comes for our address, and another station sends from it."""
    bus, own = port.bus(), port.spec.source & 7

    def ours(frame: Frame) -> bool:
        return frame.identifier & _MASK == DATA and frame.identifier >> 13 & 7 == own

    with bus.listen(ours, most=64) as listener:
        if listener.get(LISTENING) is None:
            return
    until = time.monotonic() + SIGN_OF_LIFE
    while time.monotonic() < until:
        if bus.conflicts.seen():
            raise AddressConflictError(bus.conflicts.text, hint=bus.conflicts.hint)
        time.sleep(0.05)
