"""From datasheet to measurement: sessions, streams, clocks, groups, and the sinks that take calibrated values."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.measure import (
        blocks,
        buses,
        capturing,
        clock,
        grid,
        hearing,
        held_actuator,
        interpreter,
        keeper,
        lookout,
        matching,
        planning,
        recordings,
        request,
        rest,
        runner,
        running,
        sampling,
        settled,
        sightings,
        sinks,
        sources,
        standing,
        topic_actuators,
        trusting,
        zeroing,
    )
else:
    __getattr__ = lazy(__name__)
