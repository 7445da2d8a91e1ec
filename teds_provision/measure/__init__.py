"""From datasheet to measurement: sessions, streams, clocks, groups, and the sinks that take calibrated values."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure import (
        acting,
        actuators,
        blocks,
        clock,
        facts,
        finding,
        grid,
        hearing,
        interpreter,
        keeper,
        orders,
        planning,
        runner,
        running,
        sampling,
        sinks,
        trusting,
    )
else:
    __getattr__ = lazy(__name__)
