"""From datasheet to measurement: sessions, streams, clocks, groups, and the sinks that take calibrated values."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure import (
        blocks,
        clock,
        facts,
        finding,
        grid,
        hearing,
        held_actuator,
        interpreter,
        keeper,
        planning,
        rest,
        runner,
        running,
        sampling,
        sinks,
        topic_actuators,
        trusting,
        wish,
    )
else:
    __getattr__ = lazy(__name__)
