"""Reserves each source address on a bus for one process: a second Open on an address pair ends the first session.

On this machine a lock in the home records the user of an address. Another machine, or another home, is noticed by the
frames that it sends from the same address (operation.md section 6).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager

from teds_provision.errors import StoreLockedError
from teds_provision.links import LinkSettings
from teds_provision.links.opening import shared_bus, with_source
from teds_provision.links.ports import SharedBus
from teds_provision.links.streaming import MeasuringLink
from teds_provision.station.station import Station
from teds_provision.station.store.lock import UsageLock, UsageLockTakenError


@contextmanager
def sole_user(station: Station, ports: Iterable[MeasuringLink], command: str) -> Iterator[None]:
    """Reserve the source addresses of the ports that have one for this process; if none is named, the next free one.

    Raises StoreLockedError (7) if another process of this home has the named one; AddressConflictError (5) if another
    machine is heard to measure under it.
    """
    with ExitStack() as stack:
        for port in ports:
            bus = port.shared_bus
            if bus is None:
                continue
            mark, source = _enter(stack, station, bus, command, shared=False)
            if source != bus.source:
                port.use_source(source)
            # After a killed process, nodes go on sending to our address until their lease ends; that is not another
            # station.
            if not mark.left_behind:
                port.require_sole_source()
        yield


@contextmanager
def own_source_address(
    station: Station, links: LinkSettings, command: str, *, shared: bool = True
) -> Iterator[LinkSettings]:
    """Have short sessions from the source address of ``links``, beside others who do; over a reader there is none.

    Yields the links with the address in them: the next free one if none was named and a measurement has it, or, not
    ``shared``, any process. Raises StoreLockedError (7) if a measurement has the named one.
    """
    buses = {place: bus for place in links.places if (bus := shared_bus(place)) is not None}
    if not buses:
        yield links
        return
    with ExitStack() as stack:
        places = []
        for place, bus in buses.items():
            mark, source = _enter(stack, station, bus, command, shared=shared)
            if not shared:
                mark.share()  # the sessions of this command do not count as others
            places.append(with_source(place, source))
        yield links.at_places(places)


def _enter(stack: ExitStack, station: Station, spec: SharedBus, command: str, *, shared: bool) -> tuple[UsageLock, int]:
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
